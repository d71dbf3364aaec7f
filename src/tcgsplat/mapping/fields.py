"""Fields over the world that the Gaussians of each submap add up to: how much of it there is about a place, of what.

Values are spread over the corners of cubic cells by the weights of linear interpolation and read in between by the
same weights: continuous, and blurred by about 0.6 of a cell.
"""

from collections.abc import Sequence

import numpy as np
import scipy  # its parts when they are used
from jaxtyping import Float, Int

Points = Float[np.ndarray, "_ 3"]
Values = Float[np.ndarray, "_ c"]

_BITS = 21
"""Of each coordinate in a corner's key: at 5 cm, a world 100 km across."""
_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])


class Fields:
    """One field with c channels for each submap, on cells that all of them share."""

    def __init__(self, points: Sequence[Points], values: Sequence[Values], cell: float) -> None:
        """Spread values.

        Args:
            points: Of each submap, in one frame, metres.
            values: Of each point, to be summed.
            cell: Edge of a cell, metres.
        """
        self._cell = cell
        self._filled = [np.unique(_corners(some, cell)[0]) for some in points]
        self._keys = np.unique(np.concatenate(self._filled))
        self._filled = [np.searchsorted(self._keys, filled) for filled in self._filled]
        spread = zip(points, values, self._filled, strict=True)
        self._sums = [(self._weights(some).T @ value)[filled] for some, value, filled in spread]
        self._columns = [self._of_channel(channel) for channel in range(values[0].shape[1])]

    def __len__(self) -> int:
        return len(self._filled)

    def near(self, points: Points) -> tuple[Int[np.ndarray, " s"], Float[np.ndarray, "n s c"]]:
        """The submaps with something about some of these points, and what: of each point, by submap, by channel.

        Points must be among those that were spread.
        """
        weights = self._weights(points)
        submaps = np.unique((weights @ self._columns[0]).indices)
        return submaps, np.stack([(weights @ column[:, submaps]).toarray() for column in self._columns], axis=-1)

    def overlaps(self, fewest: int) -> list[tuple[int, int]]:
        """Pairs of submaps that have spread something to at least so many of the same corners, the earlier first."""
        filled = self._columns[0].copy()
        filled.data[:] = 1.0
        shared = scipy.sparse.triu(filled.T @ filled, k=1).tocoo()
        return [(int(a), int(b)) for a, b, n in zip(shared.row, shared.col, shared.data, strict=True) if n >= fewest]

    def shared(self, a: int, b: int) -> tuple[Float[np.ndarray, "m c"], Float[np.ndarray, "m c"]]:
        """The sums of two submaps at the corners that both have spread something to."""
        _, in_a, in_b = np.intersect1d(self._filled[a], self._filled[b], assume_unique=True, return_indices=True)
        return self._sums[a][in_a], self._sums[b][in_b]

    def _weights(self, points: Points) -> "scipy.sparse.csr_matrix":
        """Points by corners."""
        keys, weights = _corners(points, self._cell)
        columns, starts = np.searchsorted(self._keys, keys), np.arange(0, keys.size + 1, len(_CORNERS))
        return scipy.sparse.csr_matrix((weights.ravel(), columns.ravel(), starts), shape=(len(points), len(self._keys)))

    def _of_channel(self, channel: int) -> "scipy.sparse.csr_matrix":
        """Corners by submaps."""
        rows = np.concatenate(self._filled)
        columns = np.repeat(np.arange(len(self)), [len(filled) for filled in self._filled])
        sums = np.concatenate([some[:, channel] for some in self._sums])
        return scipy.sparse.csr_matrix((sums, (rows, columns)), shape=(len(self._keys), len(self)))


def _corners(points: Points, cell: float) -> tuple[Int[np.ndarray, "n 8"], Float[np.ndarray, "n 8"]]:
    """Key and weight of the eight corners of the cell about each point."""
    scaled = points.astype(np.float64) / cell
    low = np.floor(scaled)
    share = (scaled - low)[:, None]
    weights = np.where(_CORNERS == 1, share, 1.0 - share).prod(axis=-1)
    x, y, z = np.moveaxis(low.astype(np.int64)[:, None] + _CORNERS + (1 << (_BITS - 1)), -1, 0)
    return x << (2 * _BITS) | y << _BITS | z, weights
