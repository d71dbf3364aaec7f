"""The passes as kernels of phases that threads share, see `phases.py`: two forward, two back.

Between `arrange` and `composite` Python makes room for as many (splat, tile) pairs as there are.
"""

import numpy as np

from tcgsplat.render.numba_cpu import blending, projection, tiling
from tcgsplat.render.numba_cpu.compilation import inner, kernel
from tcgsplat.render.numba_cpu.phases import BEGIN, DONE, WAITING, next_unit

UNIT = 1024
"""Splats in a unit of projection and of the chain rule. Fixed, because pose sums are made unit by unit."""
TILES = 2
"""Tiles in a unit of compositing: side by side, so that the second finds splats of the first in the cache."""

_VISIBLE, _PAIRS = np.int64(0), np.int64(1)  # columns of `tiling.tally`

# Phases of `arrange`. Each digit of the sorting keys is counted, placed and moved; LIST counts the first.
PROJECT, LIST, DIGITS = 0, 1, 4
COUNT_TILES = LIST + 3 * DIGITS
PLACE_TILES = COUNT_TILES + 1
# Phases of `composite`.
FILL, FORWARD = 0, 1
ONLY_PHASE = np.int64(0)

_WHOLE = np.int64(0)  # `grads` begin with the first splat


@inner
def _before(unit_sums, unit, column):  # type: ignore[no-untyped-def]
    total = np.int64(0)
    for k in range(unit):
        total += unit_sums[k, column]
    return total


@kernel(
    "i8[::1], i8, f4[::1], i8, f4[::1], i8, f4[::1], f4[::1], i4[::1], u4[::1], i8[:, ::1], u4[::1], i8[::1], i8[::1], u4[:, ::1], i4[::1], u4[:, ::1], i4[::1]"
)
def arrange(
    progress, last_phase, P, n, cam, tiles_x, records, depths, depth_bits, rectangles, unit_sums, slot_starts, entries,
    swapped, digit_counts, digit_ends, tile_counts, tile_ends,
):  # type: ignore[no-untyped-def]  # fmt: skip
    """Project, sort by depth into `entries` and make room in the tiles' lists. False: has waited for long.

    `unit_sums` gets `tiling.tally`'s numbers of each unit.
    """
    units, strips = unit_sums.shape[0], digit_counts.shape[0]
    visible, digits = np.int64(0), np.int64(0)
    for phase in range(last_phase + 1):
        digit, step = (phase - LIST) // 3, (phase - LIST) % 3
        shift = min(32 + tiling.DIGIT_BITS * digit, 63)  # a fourth digit is 0 for all
        if phase == LIST:
            visible, digits = _before(unit_sums, units, _VISIBLE), tiling.used_digits(unit_sums)
        if phase == PROJECT:
            count = units
        elif phase == PLACE_TILES:
            count = 1
        elif phase == COUNT_TILES:
            count = strips
        else:
            count = 0 if digit >= digits else (1 if step == 1 else strips)
        k = next_unit(progress, phase, count, BEGIN)
        while k >= 0:
            start, stop = visible * k // strips, visible * (k + 1) // strips
            unit, unit_after = units * k // strips, units * (k + 1) // strips
            if phase == PROJECT:
                start, stop = k * UNIT, min((k + 1) * UNIT, n)
                projection.forward(P, start, stop, cam, tiles_x, records, depths, rectangles)
                tiling.tally(start, stop, depth_bits, rectangles, unit_sums[k])
            elif phase == LIST:
                at, slot = _before(unit_sums, unit, _VISIBLE), _before(unit_sums, unit, _PAIRS)
                tiling.list_visible(
                    unit * UNIT, min(unit_after * UNIT, n), at, slot, depth_bits, rectangles, entries, digit_counts[k],
                    slot_starts,
                )  # fmt: skip
            elif phase == COUNT_TILES:
                tiling.count_tiles(entries, start, stop, rectangles, tiles_x, tile_counts[k])
            elif phase == PLACE_TILES:
                tiling.places(tile_counts, tile_ends)
                for strip in range(strips):
                    tile_counts[strip, tile_ends.size - 1] = tile_ends[tile_ends.size - 1] + tiling.LINE * strip
            elif step == 1:
                tiling.places(digit_counts, digit_ends)
            else:
                source, target = (swapped, entries) if digit & 1 else (entries, swapped)
                if step == 0:
                    tiling.count_digits(source, start, stop, shift, digit_counts[k])
                else:
                    if digit == 0:
                        start, stop = _before(unit_sums, unit, _VISIBLE), _before(unit_sums, unit_after, _VISIBLE)
                    tiling.move(source, start, stop, shift, digit_counts[k], target)
            k = next_unit(progress, phase, count, DONE)
        if k == WAITING:
            return False
    return True


@kernel(
    "i8[::1], i8, i8[::1], i8, u4[::1], u4[::1], i8, u4[:, ::1], i4[::1], i8[::1], f4[::1], i8, i8, f4[::1], f4[::1], i4[:, ::1], i4[::1], f4[::1]"
)
def composite(
    progress, last_phase, entries, visible, rectangles, slot_starts, tiles_x, tile_counts, tile_ends, pairs, records,
    width, height, grid, local, lists, masks, planes,
):  # type: ignore[no-untyped-def]  # fmt: skip
    """Fill the tiles' lists and draw them. False: has waited for long."""
    strips, tiles = tile_counts.shape[0], tile_ends.size - 1
    for phase in range(last_phase + 1):
        count = strips if phase == FILL else -(-tiles // TILES)
        k = next_unit(progress, phase, count, BEGIN)
        while k >= 0:
            if phase == FILL:
                tiling.fill_tiles(
                    entries, visible * k // strips, visible * (k + 1) // strips, rectangles, slot_starts, tiles_x,
                    tile_counts[k], pairs,
                )  # fmt: skip
            else:
                blending.forward(
                    k * TILES, min((k + 1) * TILES, tiles), tile_ends, pairs, records, tiles_x, width, height, grid,
                    local, lists, masks, planes,
                )  # fmt: skip
            k = next_unit(progress, phase, count, DONE)
        if k == WAITING:
            return False
    return True


@kernel("i8[::1], i4[::1], i8[::1], f4[::1], i8, i8, i8, f4[::1], i4[::1], f4[::1], f4[::1], f4[::1], f4[::1]")
def differentiate(
    progress, tile_ends, pairs, records, tiles_x, width, height, grid, masks, planes, d_planes, local, pair_sums
):  # type: ignore[no-untyped-def]  # fmt: skip
    """From `d_planes` to the sums of all pairs. False: has waited for long."""
    tiles = tile_ends.size - 1
    units = -(-tiles // TILES)
    k = next_unit(progress, ONLY_PHASE, units, BEGIN)
    while k >= 0:
        blending.backward(
            k * TILES, min((k + 1) * TILES, tiles), tile_ends, pairs, records, tiles_x, width, height, grid, masks,
            planes, d_planes, local, pair_sums,
        )  # fmt: skip
        k = next_unit(progress, ONLY_PHASE, units, DONE)
    return k != WAITING


@kernel("i8[::1], f4[::1], f4[::1], i8, f4[::1], u4[::1], f4[::1], f4[:, ::1]")
def chain(progress, pair_sums, P, n, cam, slot_starts, grads, pose_sums):  # type: ignore[no-untyped-def]
    """From the sums of all pairs to `grads` and to each unit's `pose_sums`. False: has waited for long."""
    k = next_unit(progress, ONLY_PHASE, pose_sums.shape[0], BEGIN)
    while k >= 0:
        projection.backward(
            P, n, k * UNIT, min((k + 1) * UNIT, n), cam, slot_starts, pair_sums, grads, _WHOLE, pose_sums[k]
        )
        k = next_unit(progress, ONLY_PHASE, pose_sums.shape[0], DONE)
    return k != WAITING
