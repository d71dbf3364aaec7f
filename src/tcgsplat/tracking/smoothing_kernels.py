"""A pixel loop that smooths a depth image within its surfaces, sixteen pixels at a time."""

import numpy as np

from tcgsplat.render.numba_cpu.compilation import kernel
from tcgsplat.render.numba_cpu.lanes import load_rows, store_first
from tcgsplat.render.numba_cpu.simd import LANES, Vector, Vectors, apart, formula, maximum

SMOOTH = np.float32(0.03)
"""Neighbouring depths that differ by less than this share lie on one surface: slanted ones are steeper only beyond 80
degrees, and what a sensor rounds is less up to 3.5 metres."""


@formula
def _mean(above: Vectors, beside: Vectors, below: Vectors) -> Vector:
    """Of three times three readings, those on the surface of the middle one."""
    center = beside[1]
    reach, total, count = center * SMOOTH, center.of(0), center.of(0)
    for reading in (*above, *beside, *below):
        step, away = reading - center, apart(reading, center)
        total = total + away.where("<", reach, step, 0)
        count = count + away.where("<", reach, 1, 0)
    return center + total / maximum(count, count.of(1))


@kernel("f4[::1], i8, i8, f4[::1]")
def smoothed(depth, height, width, out):  # type: ignore[no-untyped-def]
    """Mean of each reading and those of its eight neighbours on its surface; the outermost pixels are left as they are.

    No reading is 0, which is on no surface: farther from each reading than its share of it, and from 0 by no less.
    Images are flat; behind `depth` are sixteen more floats, whatever they are.
    """
    for y in range(1, height - 1):
        for x in range(1, width - 1, LANES):
            at = y * width + x - 1
            above, beside = load_rows(depth, at - width, 1, 3), load_rows(depth, at, 1, 3)
            store_first(out, at + 1, _mean(above, beside, load_rows(depth, at + width, 1, 3)), width - 1 - x)
