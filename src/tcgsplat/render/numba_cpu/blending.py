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
from numba import carray, njit

from tcgsplat.render.numba_cpu.compilation import kept
from tcgsplat.render.numba_cpu.layout import (
    BLOCK_X,
    BLOCK_Y,
    CHANNELS,
    DEPTH,
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
from tcgsplat.render.numba_cpu.simd import (
    INNER,
    MATH,
    append_where_bit,
    exp2,
    fma,
    lane_sums,
    load,
    load_first,
    load_rows,
    mask_ge,
    maximum,
    minimum,
    prefetch,
    prefetch_to_write,
    regrouped,
    spread,
    stack_floats,
    store,
    store_first,
    store_rows,
    trailing_zeros,
    where_ge,
)
from tcgsplat.render.protocol import MIN_ALPHA, MIN_TRANSMITTANCE

_LOG2_MIN_ALPHA = np.float32(math.log2(MIN_ALPHA))
_MIN_TRANSMITTANCE = np.float32(MIN_TRANSMITTANCE)
BACKWARD_FLOATS = 2 * TILE_PIXELS
"""Length of the `local` that `backward` needs."""
_AHEAD = 24  # records asked for in advance: about the latency of memory over the time of one ellipse test


@njit(fastmath=MATH, **INNER, inline="always")
def _blocks_touched(records, at, origin_x, origin_y, grid):
    """Mask of the blocks in which log2 alpha reaches its threshold at some point of the block's pixel rectangle.

    The form is concave, so its maximum over a rectangle away from the centre lies on one of the two nearest edges;
    each edge's best point is where the ridge meets it, clamped to the edge.
    """
    u, v = records[at + U] - origin_x, records[at + V] - origin_y
    A, B, C = spread(records[at + FORM_A]), spread(records[at + FORM_B]), spread(records[at + FORM_C])
    three, zero = np.float32(3), spread(np.float32(0))
    x0, y0 = load(grid, BLOCK_X) - u, load(grid, BLOCK_Y) - v
    x1, y1 = x0 + three, y0 + three
    x_near, y_near = maximum(x0, minimum(zero, x1)), maximum(y0, minimum(zero, y1))
    y_best = maximum(y0, minimum(x_near * records[at + RIDGE_Y], y1))
    x_best = maximum(x0, minimum(y_near * records[at + RIDGE_X], x1))
    on_column = fma(fma(A, x_near, B * y_best), x_near, C * y_best * y_best)
    on_row = fma(fma(A, x_best, B * y_near), x_best, C * y_near * y_near)
    return mask_ge(maximum(on_column, on_row), spread(_LOG2_MIN_ALPHA - records[at + RECORD_LOG2_OPACITY]))


@kept(njit(fastmath=MATH, **INNER))
def forward(tile_from, tile_to, tile_ends, pairs, records, tiles_x, width, height, grid, local, lists, masks, planes):
    """Composite a range of tiles into `planes` and leave in `masks` the blocks that each pair drew.

    `local` and the three `lists` are this thread's own, for the records and the numbers of a tile's splats.
    """
    blocks = carray(stack_floats(1792), TILE_FLOATS)
    local_masks, pair_of, block_list = lists[0], lists[1], lists[2]
    last_pair = np.int64(tile_ends[tile_ends.size - 1]) - 1
    threshold, zero, one = spread(_LOG2_MIN_ALPHA), spread(np.float32(0)), spread(np.float32(1))
    for tile in range(tile_from, tile_to):
        origin_x, origin_y = np.float32((tile % tiles_x) * TILE), np.float32((tile // tiles_x) * TILE)
        begin, end = np.int64(tile_ends[tile]), np.int64(tile_ends[tile + 1])
        count = np.int64(0)
        for pair in range(begin, end):
            prefetch(records, (pairs[min(pair + _AHEAD, last_pair)] & SPLAT) * RECORD)
            at = (pairs[pair] & SPLAT) * RECORD
            touched = _blocks_touched(records, at, origin_x, origin_y, grid)
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
            T, c0, c1, c2, c3, cz, cp = one, zero, zero, zero, zero, zero, zero
            group = np.int64(0)
            while group < listed:
                for j in range(group, min(group + 16, listed)):
                    at = np.int64(block_list[j]) * RECORD
                    dx, dy = px - local[at + U], py - local[at + V]
                    row = fma(spread(local[at + FORM_C]) * dy, dy, spread(local[at + RECORD_LOG2_OPACITY]))
                    log2_alpha = fma(fma(spread(local[at + FORM_A]), dx, spread(local[at + FORM_B]) * dy), dx, row)
                    weight = where_ge(log2_alpha, threshold, exp2(log2_alpha), zero) * T
                    T = T - weight
                    z = spread(local[at + DEPTH])
                    plane = fma(spread(local[at + SLOPE_U]), dx, fma(spread(local[at + SLOPE_V]), dy, z))
                    c0 = fma(weight, spread(local[at + RECORD_FEATURE]), c0)
                    c1 = fma(weight, spread(local[at + RECORD_FEATURE + 1]), c1)
                    c2 = fma(weight, spread(local[at + RECORD_FEATURE + 2]), c2)
                    c3 = fma(weight, spread(local[at + RECORD_FEATURE + 3]), c3)
                    cz = fma(weight, z, cz)
                    cp = fma(weight, plane, cp)
                group += 16
                if group < listed and mask_ge(T, spread(_MIN_TRANSMITTANCE)) == 0:
                    for j in range(group, listed):
                        masks[pair_of[block_list[j]]] &= ~bit
                    break
            out = block * 16
            store(blocks, out, c0)
            store(blocks, out + 256, c1)
            store(blocks, out + 512, c2)
            store(blocks, out + 768, c3)
            store(blocks, out + 1024, cz)
            store(blocks, out + 1280, cp)
            store(blocks, out + 1536, one - T)
        _from_blocks(blocks, tile, tiles_x, width, height, planes)


@kept(njit(fastmath=MATH, **INNER))
def backward(tile_from, tile_to, tile_ends, pairs, records, tiles_x, width, height, grid, masks, planes, d_planes, local, pair_sums):
    """Sums over pixels for each pair of a range of tiles, sixteen floats a slot, from the loss's derivative by the planes.

    With g = dL/d ln(alpha), dx = pixel - centre and w the compositing weight, the sums are
    g, g dx, g dy, g dx^2, g dx dy, g dy^2, w D_feature (4), w D_depth, w D_plane, w D_plane dx, w D_plane dy.
    `local` is this thread's own.
    """
    d_blocks = carray(stack_floats(1792), TILE_FLOATS)
    transmittance, remaining = local[:TILE_PIXELS], local[TILE_PIXELS : 2 * TILE_PIXELS]
    last_pair = np.int64(tile_ends[tile_ends.size - 1]) - 1
    threshold, zero, one = spread(_LOG2_MIN_ALPHA), spread(np.float32(0)), spread(np.float32(1))
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
            g, gx, gy, gxx, gxy, gyy = zero, zero, zero, zero, zero, zero
            w0, w1, w2, w3, wz, wp, wpx, wpy = zero, zero, zero, zero, zero, zero, zero, zero
            mask = masks[pair]
            while mask != 0:
                block = trailing_zeros(mask)
                mask &= mask - np.int32(1)
                dx, dy = from_center_x + grid[BLOCK_X + block], from_center_y + grid[BLOCK_Y + block]
                row = fma(spread(records[at + FORM_C]) * dy, dy, spread(records[at + RECORD_LOG2_OPACITY]))
                log2_alpha = fma(fma(spread(records[at + FORM_A]), dx, spread(records[at + FORM_B]) * dy), dx, row)
                alpha = where_ge(log2_alpha, threshold, exp2(log2_alpha), zero)
                lanes = block * 16
                T = load(transmittance, lanes)
                weight = alpha * T
                store(transmittance, lanes, T - weight)
                D0, D1, D2, D3 = load(d_blocks, lanes), load(d_blocks, lanes + 256), load(d_blocks, lanes + 512), load(d_blocks, lanes + 768)
                Dz, Dp = load(d_blocks, lanes + 1024), load(d_blocks, lanes + 1280)
                z = spread(records[at + DEPTH])
                plane = fma(spread(records[at + SLOPE_U]), dx, fma(spread(records[at + SLOPE_V]), dy, z))
                d = fma(plane, Dp, fma(z, Dz, load(d_blocks, lanes + 1536)))
                d = fma(spread(records[at + RECORD_FEATURE + 1]), D1, fma(spread(records[at + RECORD_FEATURE]), D0, d))
                d = fma(spread(records[at + RECORD_FEATURE + 3]), D3, fma(spread(records[at + RECORD_FEATURE + 2]), D2, d))
                behind = load(remaining, lanes) - weight * d
                store(remaining, lanes, behind)
                d_ln_alpha = weight * d - behind * (alpha / (one - alpha))
                mx, my = d_ln_alpha * dx, d_ln_alpha * dy
                g, gx, gy = g + d_ln_alpha, gx + mx, gy + my
                gxx, gxy, gyy = fma(mx, dx, gxx), fma(mx, dy, gxy), fma(my, dy, gyy)
                w0, w1, w2, w3 = fma(weight, D0, w0), fma(weight, D1, w1), fma(weight, D2, w2), fma(weight, D3, w3)
                weighted = weight * Dp
                wz, wp = fma(weight, Dz, wz), wp + weighted
                wpx, wpy = fma(weighted, dx, wpx), fma(weighted, dy, wpy)
            sums = lane_sums((g, gx, gy, gxx, gxy, gyy, w0, w1, w2, w3, wz, wp, wpx, wpy))
            store(pair_sums, (pairs[pair] >> 32) * RECORD, sums)


@kept(njit(**INNER))
def _columns(tile, tiles_x, width, height, line):  # type: ignore[no-untyped-def]
    """Where a tile's row of pixels begins in a plane, and how many of its pixels are in the image."""
    x, y = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE + line
    return y * width + x, min(TILE, width - x) if y < height else 0


@kept(njit(fastmath=MATH, **INNER))
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


@kept(njit(fastmath=MATH, **INNER))
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
