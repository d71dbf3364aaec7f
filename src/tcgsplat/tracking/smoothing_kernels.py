"""Pixel loop that smooths a depth image within its surfaces."""

import numpy as np
from numba import njit

SMOOTH = np.float32(0.03)
"""Neighbouring depths that differ by less than this share lie on one surface: slanted ones are steeper only beyond 80
degrees, and what a sensor rounds is less up to 3.5 metres."""
_ZERO, _ONE = np.float32(0), np.float32(1)


@njit(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", nogil=True, cache=True)
def smoothed(depth):  # type: ignore[no-untyped-def]
    """Mean of each reading and those of its eight neighbours that lie on its surface; the outermost pixels stay.

    No reading is 0, which is on no surface: farther from each reading than its share of it, and from 0 by no less.
    """
    h, w = depth.shape
    out = depth.copy()
    for y in range(1, h - 1):
        for x in range(1, w - 1):
            center, total, count = depth[y, x], _ZERO, _ZERO
            reach = SMOOTH * center
            for dy in range(-1, 2):
                for dx in range(-1, 2):
                    step = depth[y + dy, x + dx] - center
                    near = abs(step) < reach
                    total += step if near else _ZERO
                    count += _ONE if near else _ZERO
            out[y, x] = center + total / max(count, _ONE)
    return out
