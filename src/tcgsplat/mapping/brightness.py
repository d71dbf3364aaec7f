"""One brightness for all submaps: each has that of its first picture, and a camera's exposure changes on the way."""

import numpy as np
from jaxtyping import Float

from tcgsplat.mapping.fields import Fields
from tcgsplat.scene.exposure import Exposure

_ENOUGH = 0.1
"""Summed confidence at a corner that makes its colour worth comparing: one Gaussian nearby."""
_FEWEST = 50
"""Corners that two submaps must share."""
_PER_CELL = 8.0
"""Corners that one surface patch has spread to: they do not vote one by one."""
_FLAT = 5e-4
"""Variance of colours that a gain of 1 is worth: two submaps may share nothing but a plain wall, and the ratio of what
noise (0.01 to 0.02) does to either tells no gain."""
_ROUNDS = 20
_ERROR = 0.02
"""Of a pair's relative brightness, however many corners agree on it: surfaces look different from elsewhere."""
_SPREAD = 0.3
"""How far submaps are expected to be from their mean: holds those that share nothing with the others."""


def exposures_of(fields: Fields) -> tuple[Exposure, ...]:
    """Of the map beside each submap, map = gain * submap + offset, such that the submaps agree where they overlap.

    Each pair of submaps is fitted by itself; then all gains, and after them all offsets, by least squares over the
    pairs. The map has the mean brightness of the submaps, geometric in gain.

    Args:
        fields: With the channels summed confidence, and red, green and blue times confidence.
    """
    count = len(fields)
    gains, offsets = _Graph(count), _Graph(count)
    pairs = {(a, b): pair for a, b in fields.overlaps(_FEWEST) if (pair := _relative(fields, a, b))}
    for (a, b), (gain, _, sigma) in pairs.items():  # gain_a a + offset_a = gain_b b + offset_b
        gains.measure(a, b, float(np.log(gain)), sigma)
    gain_of = np.exp(gains.solved())
    for (a, b), (_, offset, sigma) in pairs.items():
        offsets.measure(a, b, float(gain_of[b]) * offset, sigma)
    return tuple(Exposure(float(gain), float(offset)) for gain, offset in zip(gain_of, offsets.solved(), strict=True))


class _Graph:
    """Unknowns, of which differences are measured."""

    def __init__(self, count: int) -> None:
        self._rows = [*(np.eye(count) / _SPREAD)]
        self._sides = [0.0] * count

    def measure(self, a: int, b: int, difference: float, sigma: float) -> None:
        """Unknown a less unknown b."""
        row = np.zeros_like(self._rows[0])
        row[a], row[b] = 1.0 / sigma, -1.0 / sigma
        self._rows.append(row)
        self._sides.append(difference / sigma)

    def solved(self) -> Float[np.ndarray, " n"]:
        """The unknowns; their mean is zero."""
        found = np.linalg.lstsq(np.stack(self._rows), np.array(self._sides), rcond=None)[0]
        return np.asarray(found - found.mean())


def _relative(fields: Fields, a: int, b: int) -> tuple[float, float, float] | None:
    """Gain and offset such that b = gain * a + offset, and how sure that is; None where little is shared.

    The line through the middle whose slope is the ratio of the deviations does not care which of the two is noisier.
    Corners far from it do not show the same surface in both: they lose their weight.
    """
    in_a, in_b = fields.shared(a, b)
    weight = np.minimum(in_a[:, 0], in_b[:, 0])
    enough = weight > _ENOUGH
    if enough.sum() < _FEWEST:
        return None
    x, y = (some[enough, 1:] / some[enough, :1] for some in (in_a, in_b))
    weight = np.repeat(weight[enough, None], 3, axis=1)
    trusted = weight
    for _ in range(_ROUNDS):
        middle_x, middle_y = np.average(x, weights=trusted), np.average(y, weights=trusted)
        variance_x, variance_y = (
            np.average((z - middle) ** 2, weights=trusted) + _FLAT for z, middle in ((x, middle_x), (y, middle_y))
        )
        gain = np.sqrt(variance_y / variance_x)
        residual = np.abs(y - middle_y - gain * (x - middle_x))
        sigma = max(1.4826 * float(np.median(residual)), 1e-4)
        trusted = weight / (1.0 + (residual / (2.0 * sigma)) ** 2)
    independent = max(trusted.sum() / weight.mean() / 3.0 / _PER_CELL, 1.0)
    error = sigma / np.sqrt(variance_x * independent)
    return float(gain), float(middle_y - gain * middle_x), float(np.hypot(error, _ERROR))
