"""Fields over the world that the Gaussians of each submap add up to: how much of it there is about a place, of what.

Values are spread over the corners of cubic cells by the weights of linear interpolation and read in between by the
same weights: continuous, and blurred by about 0.6 of a cell.
"""

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
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
        corners = [_corners(some, cell) for some in points]
        keys = np.unique(np.concatenate([np.unique(key) for key, _ in corners]))
        self._spread = [_matrix(np.searchsorted(keys, key), weight, len(keys)) for key, weight in corners]
        self._filled, self._sums = [], []
        for spread, some in zip(self._spread, values, strict=True):
            cells = np.unique(spread.indices)
            self._filled.append(cells)
            self._sums.append((spread.T @ some)[cells])
        self._columns = [self._of_channel(channel, len(keys)) for channel in range(values[0].shape[1])]

    def __len__(self) -> int:
        return len(self._spread)

    def at_points_of(self, submap: int) -> Float[np.ndarray, "n s c"]:
        """All fields at the points of one submap: of each point, by submap, by channel."""
        spread = self._spread[submap]
        return np.stack([(spread @ column).toarray() for column in self._columns], axis=-1)

    def shared(self, a: int, b: int) -> tuple[Float[np.ndarray, "m c"], Float[np.ndarray, "m c"]]:
        """The sums of two submaps at the corners that both have spread something to."""
        _, in_a, in_b = np.intersect1d(self._filled[a], self._filled[b], assume_unique=True, return_indices=True)
        return self._sums[a][in_a], self._sums[b][in_b]

    def _of_channel(self, channel: int, corners: int) -> sp.csr_matrix:
        """Corners by submaps."""
        rows = np.concatenate(self._filled)
        columns = np.repeat(np.arange(len(self)), [len(cells) for cells in self._filled])
        sums = np.concatenate([some[:, channel] for some in self._sums])
        return sp.csr_matrix((sums, (rows, columns)), shape=(corners, len(self)))


def _corners(points: Points, cell: float) -> tuple[Int[np.ndarray, "n 8"], Float[np.ndarray, "n 8"]]:
    """Key and weight of the eight corners of the cell about each point."""
    scaled = points.astype(np.float64) / cell
    low = np.floor(scaled)
    share = (scaled - low)[:, None]
    weights = np.where(_CORNERS == 1, share, 1.0 - share).prod(axis=-1)
    x, y, z = np.moveaxis(low.astype(np.int64)[:, None] + _CORNERS + (1 << (_BITS - 1)), -1, 0)
    return x << (2 * _BITS) | y << _BITS | z, weights


def _matrix(columns: Int[np.ndarray, "n 8"], weights: Float[np.ndarray, "n 8"], corners: int) -> sp.csr_matrix:
    """Points by corners."""
    starts = np.arange(0, columns.size + 1, columns.shape[1])
    return sp.csr_matrix((weights.ravel(), columns.ravel(), starts), shape=(len(columns), corners))
