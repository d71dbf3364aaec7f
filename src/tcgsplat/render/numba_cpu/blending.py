"""Front-to-back compositing over 4 x 4 blocks, forward and backward, tile by tile.

Forward, per tile: every listed splat is tested against all sixteen blocks at once (lanes are blocks) by the exact
maximum of its footprint over each block; survivors' records are copied side by side; then block by block, with
transmittance and sums in registers, the block's splats are composited. What a block did not draw is cleared from its
mask, so the mask is the one truth that backward needs.

Backward goes splat by splat over the blocks of its mask, front to back, with the remaining sum of the loss instead of
a stored transmittance: with d_i = f_i . dL/dout, dL/dalpha_i = T_i d_i - (sum_{j>i} w_j d_j) / (1 - alpha_i).
"""

import math

import numpy as np
from numba import carray

from tcgsplat.render.conventions import MIN_ALPHA, MIN_TRANSMITTANCE
from tcgsplat.render.numba_cpu.compilation import inner
from tcgsplat.render.numba_cpu.lanes import (
    append_where_bit,
    lane_sums,
    load,
    load_first,
    load_rows,
    load_spread,
    mask_ge,
    prefetch,
    prefetch_to_write,
    regrouped,
    stack_floats,
    store,
    store_first,
    store_rows,
    trailing_zeros,
)
from tcgsplat.render.numba_cpu.layout import (
    BLOCK,
    BLOCK_X,
    BLOCK_Y,
    CHANNELS,
    DEPTH,
    FEATURES,
    FORM_A,
    FORM_B,
    FORM_C,
    LANE_X,
    LANE_Y,
    RECORD,
    RECORD_FEATURE,
    RECORD_LOG2_OPACITY,
    RIDGE_X,
    RIDGE_Y,
    SLOPE_U,
    SLOPE_V,
    SPLAT,
    TILE,
    TILE_FLOATS,
    TILE_PIXELS,
    U,
    V,
)
from tcgsplat.render.numba_cpu.simd import Vector, Vectors, exp2, fma, formula, maximum, minimum, spread, where_ge

_LOG2_MIN_ALPHA = np.float32(math.log2(MIN_ALPHA))
_MIN_TRANSMITTANCE = np.float32(MIN_TRANSMITTANCE)
_BLOCK_SPAN = np.float32(BLOCK - 1)
BACKWARD_FLOATS = 2 * TILE_PIXELS
"""Length of the `local` that `backward` needs."""
_AHEAD = 24  # records asked for in advance: about the latency of memory over the time of one ellipse test


@formula
def _highest(record: Vectors, from_x: Vector, from_y: Vector) -> Vector:
    """Of each block log2 alpha at its highest point; `from_x`, `from_y`: from the splat's centre to its first pixel.

    The form is concave, so its maximum over a rectangle away from the centre lies on one of the two nearest edges;
    each edge's best point is where the ridge meets it, clamped to the edge.
    """
    A, B, C = record[FORM_A : FORM_C + 1]
    x0, y0, zero = from_x, from_y, from_x.of(0)
    x1, y1 = x0 + _BLOCK_SPAN, y0 + _BLOCK_SPAN
    x_near, y_near = maximum(x0, minimum(zero, x1)), maximum(y0, minimum(zero, y1))
    y_best = maximum(y0, minimum(x_near * record[RIDGE_Y], y1))
    x_best = maximum(x0, minimum(y_near * record[RIDGE_X], x1))
    on_column = fma(fma(A, x_near, B * y_best), x_near, C * y_best * y_best)
    on_row = fma(fma(A, x_best, B * y_near), x_best, C * y_near * y_near)
    return maximum(on_column, on_row)


def _alpha(record: Vectors, dx: Vector, dy: Vector) -> Vector:
    """Opacity at sixteen pixels that are (dx, dy) away from the splat's centre; 0 below its threshold (Eq. 3)."""
    row = fma(record[FORM_C] * dy, dy, record[RECORD_LOG2_OPACITY])
    log2_alpha = fma(fma(record[FORM_A], dx, record[FORM_B] * dy), dx, row)
    return where_ge(log2_alpha, dx.of(_LOG2_MIN_ALPHA), exp2(log2_alpha), dx.of(0))


def _plane_depth(record: Vectors, dx: Vector, dy: Vector) -> Vector:
    return fma(record[SLOPE_U], dx, fma(record[SLOPE_V], dy, record[DEPTH]))


@formula
def _drawn(record: Vectors, px: Vector, py: Vector, T: Vector, sums: Vectors) -> tuple[Vector, Vectors]:
    """A splat over sixteen pixels: the transmittance behind it, and features, depth and plane depth with it."""
    dx, dy = px - record[U], py - record[V]
    weight = _alpha(record, dx, dy) * T
    shown = (*record[RECORD_FEATURE : RECORD_FEATURE + FEATURES], record[DEPTH], _plane_depth(record, dx, dy))
    return T - weight, tuple(fma(weight, value, total) for value, total in zip(shown, sums, strict=True))


@formula
def _differentiated(
    record: Vectors, dx: Vector, dy: Vector, T: Vector, remaining: Vector, D: Vectors, sums: Vectors
) -> tuple[Vector, Vector, Vectors]:
    """The way back: transmittance and remaining loss behind the splat, and the sums that `backward` tells."""
    alpha = _alpha(record, dx, dy)
    weight = alpha * T
    *D_features, D_depth, D_plane, D_alpha = D
    d = fma(_plane_depth(record, dx, dy), D_plane, fma(record[DEPTH], D_depth, D_alpha))
    for feature, D_feature in zip(record[RECORD_FEATURE : RECORD_FEATURE + FEATURES], D_features, strict=True):
        d = fma(feature, D_feature, d)
    behind = remaining - weight * d
    g = weight * d - behind * (alpha / (dx.of(1) - alpha))
    gx, gy, weighted = g * dx, g * dy, weight * D_plane
    s, sx, sy, sxx, sxy, syy, *s_features, s_depth, s_plane, s_plane_x, s_plane_y = sums
    totals = (
        s + g, sx + gx, sy + gy, fma(gx, dx, sxx), fma(gx, dy, sxy), fma(gy, dy, syy),
        *(fma(weight, D_feature, total) for D_feature, total in zip(D_features, s_features, strict=True)),
        fma(weight, D_depth, s_depth), s_plane + weighted, fma(weighted, dx, s_plane_x), fma(weighted, dy, s_plane_y),
    )  # fmt: skip
    return T - weight, behind, totals


@inner
def forward(tile_from, tile_to, tile_ends, pairs, records, tiles_x, width, height, grid, local, lists, masks, planes):
    """Composite a range of tiles into `planes` and leave in `masks` the blocks that each pair drew.

    `local` and the three `lists` are this thread's own, for the records and the numbers of a tile's splats.
    """
    blocks = carray(stack_floats(1792), TILE_FLOATS)
    local_masks, pair_of, block_list = lists[0], lists[1], lists[2]
    last_pair = np.int64(tile_ends[tile_ends.size - 1]) - 1
    zero, one = spread(np.float32(0)), spread(np.float32(1))
    for tile in range(tile_from, tile_to):
        origin_x, origin_y = np.float32((tile % tiles_x) * TILE), np.float32((tile // tiles_x) * TILE)
        begin, end = np.int64(tile_ends[tile]), np.int64(tile_ends[tile + 1])
        count = np.int64(0)
        for pair in range(begin, end):
            prefetch(records, (pairs[min(pair + _AHEAD, last_pair)] & SPLAT) * RECORD)
            at = (pairs[pair] & SPLAT) * RECORD
            from_x, from_y = records[at + U] - origin_x, records[at + V] - origin_y
            highest = _highest(load_spread(records, at, 8), load(grid, BLOCK_X) - from_x, load(grid, BLOCK_Y) - from_y)
            touched = mask_ge(highest, spread(_LOG2_MIN_ALPHA - records[at + RECORD_LOG2_OPACITY]))
            masks[pair] = touched
            local_masks[count] = touched
            pair_of[count] = pair
            store(local, count * RECORD, load(records, at))
            count += np.int64(touched != 0)
        for block in range(16):
            bit = np.int32(1 << block)
            listed, k = np.int64(0), np.int64(0)
            while k < count:
                listed += append_where_bit(block_list, listed, local_masks, k, bit, np.int32(min(count - k, 16)))
                k += 16
            px, py = load(grid, LANE_X) + (grid[BLOCK_X + block] + origin_x), load(grid, LANE_Y) + (grid[BLOCK_Y + block] + origin_y)
            T, sums = one, (zero, zero, zero, zero, zero, zero)
            group = np.int64(0)
            while group < listed:
                for j in range(group, min(group + 16, listed)):
                    T, sums = _drawn(load_spread(local, np.int64(block_list[j]) * RECORD, RECORD), px, py, T, sums)
                group += 16
                if group < listed and mask_ge(T, spread(_MIN_TRANSMITTANCE)) == 0:
                    for j in range(group, listed):
                        masks[pair_of[block_list[j]]] &= ~bit
                    break
            store_rows(blocks, block * 16, TILE_PIXELS, sums)
            store(blocks, block * 16 + (CHANNELS - 1) * TILE_PIXELS, one - T)
        _from_blocks(blocks, tile, tiles_x, width, height, planes)


@inner
def backward(tile_from, tile_to, tile_ends, pairs, records, tiles_x, width, height, grid, masks, planes, d_planes, local, pair_sums):
    """Sums over pixels for each pair of a range of tiles, sixteen floats a slot, from the loss's derivative by the planes.

    With g = dL/d ln(alpha), dx = pixel - centre and w the compositing weight, the sums are
    g, g dx, g dy, g dx^2, g dx dy, g dy^2, w D_feature (4), w D_depth, w D_plane, w D_plane dx, w D_plane dy.
    `local` is this thread's own.
    """
    d_blocks = carray(stack_floats(1792), TILE_FLOATS)
    transmittance, remaining = local[:TILE_PIXELS], local[TILE_PIXELS : 2 * TILE_PIXELS]
    last_pair = np.int64(tile_ends[tile_ends.size - 1]) - 1
    zero, one = spread(np.float32(0)), spread(np.float32(1))
    lane_x, lane_y = load(grid, LANE_X), load(grid, LANE_Y)
    for tile in range(tile_from, tile_to):
        origin_x, origin_y = np.float32((tile % tiles_x) * TILE), np.float32((tile // tiles_x) * TILE)
        _to_blocks(planes, d_planes, tile, tiles_x, width, height, d_blocks, remaining)
        for block in range(16):
            store(transmittance, block * 16, one)
        for pair in range(tile_ends[tile], tile_ends[tile + 1]):
            ahead = pairs[min(pair + 8, last_pair)]
            prefetch(records, (ahead & SPLAT) * RECORD)
            prefetch_to_write(pair_sums, (ahead >> 32) * RECORD)
            at = (pairs[pair] & SPLAT) * RECORD
            from_center_x, from_center_y = lane_x - (records[at + U] - origin_x), lane_y - (records[at + V] - origin_y)
            sums = (zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero)
            mask = masks[pair]
            while mask != 0:
                block = trailing_zeros(mask)
                mask &= mask - np.int32(1)
                lanes = block * 16
                T, behind, sums = _differentiated(
                    load_spread(records, at, RECORD), from_center_x + grid[BLOCK_X + block],
                    from_center_y + grid[BLOCK_Y + block], load(transmittance, lanes), load(remaining, lanes),
                    load_rows(d_blocks, lanes, TILE_PIXELS, CHANNELS), sums,
                )  # fmt: skip
                store(transmittance, lanes, T)
                store(remaining, lanes, behind)
            store(pair_sums, (pairs[pair] >> 32) * RECORD, lane_sums(sums))


@inner
def _columns(tile, tiles_x, width, height, line):  # type: ignore[no-untyped-def]
    """Where a tile's row of pixels begins in a plane, and how many of its pixels are in the image."""
    x, y = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE + line
    return y * width + x, min(TILE, width - x) if y < height else 0


@inner
def _from_blocks(blocks, tile, tiles_x, width, height, planes):
    """A tile's blocks to its pixels in the planes."""
    for line in range(0, TILE, 4):
        at0, n0 = _columns(tile, tiles_x, width, height, line)
        at1, n1 = _columns(tile, tiles_x, width, height, line + 1)
        at2, n2 = _columns(tile, tiles_x, width, height, line + 2)
        at3, n3 = _columns(tile, tiles_x, width, height, line + 3)
        for channel in range(CHANNELS):
            b0, b1, b2, b3 = load_rows(blocks, channel * TILE_PIXELS + line * TILE, 16, 4)
            r0, r1, r2, r3 = regrouped(b0, b1, b2, b3)
            plane = channel * width * height
            store_first(planes, plane + at0, r0, n0)
            store_first(planes, plane + at1, r1, n1)
            store_first(planes, plane + at2, r2, n2)
            store_first(planes, plane + at3, r3, n3)


@inner
def _to_blocks(planes, d_planes, tile, tiles_x, width, height, d_blocks, products):
    """A tile's pixels of `d_planes` to blocks, and by pixel the product with `planes`, summed over the channels."""
    for line in range(0, TILE, 4):
        at0, n0 = _columns(tile, tiles_x, width, height, line)
        at1, n1 = _columns(tile, tiles_x, width, height, line + 1)
        at2, n2 = _columns(tile, tiles_x, width, height, line + 2)
        at3, n3 = _columns(tile, tiles_x, width, height, line + 3)
        p0, p1, p2, p3 = spread(np.float32(0)), spread(np.float32(0)), spread(np.float32(0)), spread(np.float32(0))
        for channel in range(CHANNELS):
            plane = channel * width * height
            d0, d1 = load_first(d_planes, plane + at0, n0), load_first(d_planes, plane + at1, n1)
            d2, d3 = load_first(d_planes, plane + at2, n2), load_first(d_planes, plane + at3, n3)
            p0 = fma(load_first(planes, plane + at0, n0), d0, p0)
            p1 = fma(load_first(planes, plane + at1, n1), d1, p1)
            p2 = fma(load_first(planes, plane + at2, n2), d2, p2)
            p3 = fma(load_first(planes, plane + at3, n3), d3, p3)
            store_rows(d_blocks, channel * TILE_PIXELS + line * TILE, 16, regrouped(d0, d1, d2, d3))
        store_rows(products, line * TILE, 16, regrouped(p0, p1, p2, p3))
