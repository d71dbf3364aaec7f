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
from numba import njit

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
    TILE,
    TILE_FLOATS,
    U,
    V,
)
from tcgsplat.render.numba_cpu.simd import (
    MATH,
    append_where_bit,
    exp2,
    fma,
    lane_sums,
    load,
    mask_ge,
    maximum,
    minimum,
    prefetch,
    spread,
    store,
    trailing_zeros,
    where_ge,
)
from tcgsplat.render.protocol import MIN_ALPHA, MIN_TRANSMITTANCE

_LOG2_MIN_ALPHA = np.float32(math.log2(MIN_ALPHA))
_MIN_TRANSMITTANCE = np.float32(MIN_TRANSMITTANCE)
_AHEAD = 24  # records asked for in advance: about the latency of memory over the time of one ellipse test


@njit(fastmath=MATH, error_model="numpy", nogil=True, cache=True, inline="always")
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


@njit(fastmath=MATH, error_model="numpy", nogil=True, cache=True)
def forward(tile_from, tile_to, tile_ends, pair_splats, records, tiles_x, grid, masks, image):
    """Composite a range of tiles into `image` (tile layout) and leave in `masks` the blocks that each pair drew."""
    longest = np.int64(0)
    for tile in range(tile_from, tile_to):
        longest = max(longest, np.int64(tile_ends[tile + 1]) - np.int64(tile_ends[tile]))
    local = np.empty((longest + 1) * RECORD + 16, np.float32)
    local_masks, pair_of, block_list = np.empty(longest + 16, np.int32), np.empty(longest + 16, np.int32), np.empty(longest + 16, np.int32)
    last_pair = np.int64(pair_splats.size - 1)
    threshold, zero, one = spread(_LOG2_MIN_ALPHA), spread(np.float32(0)), spread(np.float32(1))
    for tile in range(tile_from, tile_to):
        origin_x, origin_y = np.float32((tile % tiles_x) * TILE), np.float32((tile // tiles_x) * TILE)
        begin, end = np.int64(tile_ends[tile]), np.int64(tile_ends[tile + 1])
        count = np.int64(0)
        for pair in range(begin, end):
            prefetch(records, np.int64(pair_splats[min(pair + _AHEAD, last_pair)]) * RECORD)
            at = np.int64(pair_splats[pair]) * RECORD
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
            out = np.int64(tile) * TILE_FLOATS + block * 16
            store(image, out, c0)
            store(image, out + 256, c1)
            store(image, out + 512, c2)
            store(image, out + 768, c3)
            store(image, out + 1024, cz)
            store(image, out + 1280, cp)
            store(image, out + 1536, one - T)


@njit(fastmath=MATH, error_model="numpy", nogil=True, cache=True)
def backward(tile_from, tile_to, tile_ends, pair_splats, records, tiles_x, grid, masks, image, d_image, pair_sums):
    """Sums over pixels for each pair of a range of tiles, sixteen floats a pair, from the loss's derivative by the image.

    With g = dL/d ln(alpha), dx = pixel - centre and w the compositing weight, the sums are
    g, g dx, g dy, g dx^2, g dx dy, g dy^2, w D_feature (4), w D_depth, w D_plane, w D_plane dx, w D_plane dy.
    """
    transmittance, remaining = np.empty(256 + 16, np.float32), np.empty(256 + 16, np.float32)
    threshold, zero, one = spread(_LOG2_MIN_ALPHA), spread(np.float32(0)), spread(np.float32(1))
    lane_x, lane_y = load(grid, LANE_X), load(grid, LANE_Y)
    for tile in range(tile_from, tile_to):
        origin_x, origin_y = np.float32((tile % tiles_x) * TILE), np.float32((tile // tiles_x) * TILE)
        base = np.int64(tile) * TILE_FLOATS
        for block in range(16):
            total = zero
            for channel in range(CHANNELS):
                at = base + channel * 256 + block * 16
                total = fma(load(image, at), load(d_image, at), total)
            store(remaining, block * 16, total)
            store(transmittance, block * 16, one)
        begin, end = np.int64(tile_ends[tile]), np.int64(tile_ends[tile + 1])
        for pair in range(begin, end):
            mask = masks[pair]
            prefetch(records, np.int64(pair_splats[min(pair + 8, end - 1)]) * RECORD)
            if mask == 0:
                continue
            at = np.int64(pair_splats[pair]) * RECORD
            u, v = spread(records[at + U] - origin_x), spread(records[at + V] - origin_y)
            A, B, C = spread(records[at + FORM_A]), spread(records[at + FORM_B]), spread(records[at + FORM_C])
            log2_opacity = spread(records[at + RECORD_LOG2_OPACITY])
            f0, f1 = spread(records[at + RECORD_FEATURE]), spread(records[at + RECORD_FEATURE + 1])
            f2, f3 = spread(records[at + RECORD_FEATURE + 2]), spread(records[at + RECORD_FEATURE + 3])
            z, slope_u, slope_v = spread(records[at + DEPTH]), spread(records[at + SLOPE_U]), spread(records[at + SLOPE_V])
            g, gx, gy, gxx, gxy, gyy = zero, zero, zero, zero, zero, zero
            w0, w1, w2, w3, wz, wp, wpx, wpy = zero, zero, zero, zero, zero, zero, zero, zero
            while mask != 0:
                block = trailing_zeros(mask)
                mask &= mask - np.int32(1)
                dx, dy = lane_x - u + grid[BLOCK_X + block], lane_y - v + grid[BLOCK_Y + block]
                log2_alpha = fma(fma(A, dx, B * dy), dx, fma(C * dy, dy, log2_opacity))
                alpha = where_ge(log2_alpha, threshold, exp2(log2_alpha), zero)
                lanes = block * 16
                T = load(transmittance, lanes)
                weight = alpha * T
                store(transmittance, lanes, T - weight)
                out = base + lanes
                D0, D1, D2, D3 = load(d_image, out), load(d_image, out + 256), load(d_image, out + 512), load(d_image, out + 768)
                Dz, Dp = load(d_image, out + 1024), load(d_image, out + 1280)
                plane = fma(slope_u, dx, fma(slope_v, dy, z))
                d = fma(plane, Dp, fma(z, Dz, load(d_image, out + 1536)))
                d = fma(f3, D3, fma(f2, D2, fma(f1, D1, fma(f0, D0, d))))
                behind = load(remaining, lanes) - weight * d
                store(remaining, lanes, behind)
                d_ln_alpha = alpha * (T * d - behind / (one - alpha))
                mx, my = d_ln_alpha * dx, d_ln_alpha * dy
                g, gx, gy = g + d_ln_alpha, gx + mx, gy + my
                gxx, gxy, gyy = fma(mx, dx, gxx), fma(mx, dy, gxy), fma(my, dy, gyy)
                w0, w1, w2, w3 = fma(weight, D0, w0), fma(weight, D1, w1), fma(weight, D2, w2), fma(weight, D3, w3)
                weighted = weight * Dp
                wz, wp = fma(weight, Dz, wz), wp + weighted
                wpx, wpy = fma(weighted, dx, wpx), fma(weighted, dy, wpy)
            store(pair_sums, pair * RECORD, lane_sums((g, gx, gy, gxx, gxy, gyy, w0, w1, w2, w3, wz, wp, wpx, wpy)))


@njit(fastmath=MATH, error_model="numpy", nogil=True, cache=True)
def gather_sums(start, stop, first, slot_starts, slot_pairs, masks, pair_sums, sums):
    """Each splat's pairs summed in the order of its tiles: the same bits whatever threads made the pairs."""
    last = np.int64(slot_starts[stop])
    for slot in range(slot_starts[start], min(last, np.int64(slot_starts[start]) + _AHEAD)):
        prefetch(pair_sums, np.int64(slot_pairs[slot]) * RECORD)
    for i in range(start, stop):
        total = spread(np.float32(0))
        for slot in range(slot_starts[i], slot_starts[i + 1]):
            prefetch(pair_sums, np.int64(slot_pairs[min(slot + _AHEAD, last - 1)]) * RECORD)
            pair = np.int64(slot_pairs[slot])
            if masks[pair] != 0:
                total = total + load(pair_sums, pair * RECORD)
        store(sums, (i - first) * RECORD, total)


@njit(error_model="numpy", nogil=True, cache=True)
def to_planes(tile_from, tile_to, tiles_x, width, height, image, planes):  # type: ignore[no-untyped-def]
    """Tile layout to [CHANNELS, height, width], four pixels of a block's row at a time."""
    for tile in range(tile_from, tile_to):
        x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        columns, rows = min(TILE, width - x0), min(TILE, height - y0)
        for channel in range(CHANNELS):
            base = tile * TILE_FLOATS + channel * 256
            for y in range(rows):
                row, out = base + (y >> 2) * 64 + (y & 3) * 4, planes[channel, y0 + y]
                if columns == TILE:
                    for block in range(4):
                        for x in range(4):
                            out[x0 + block * 4 + x] = image[row + block * 16 + x]
                else:
                    for x in range(columns):
                        out[x0 + x] = image[row + (x >> 2) * 16 + (x & 3)]


@njit(error_model="numpy", nogil=True, cache=True)
def to_tiles(tile_from, tile_to, tiles_x, width, height, planes, image):  # type: ignore[no-untyped-def]
    """[CHANNELS, height, width] to tile layout; pixels of a tile that hang over the image's edge become 0."""
    for tile in range(tile_from, tile_to):
        x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        columns, rows = min(TILE, width - x0), min(TILE, height - y0)
        for channel in range(CHANNELS):
            base = tile * TILE_FLOATS + channel * 256
            if columns < TILE or rows < TILE:
                for k in range(256):
                    image[base + k] = np.float32(0)
            for y in range(rows):
                row, source = base + (y >> 2) * 64 + (y & 3) * 4, planes[channel, y0 + y]
                if columns == TILE:
                    for block in range(4):
                        for x in range(4):
                            image[row + block * 16 + x] = source[x0 + block * 4 + x]
                else:
                    for x in range(columns):
                        image[row + (x >> 2) * 16 + (x & 3)] = source[x0 + x]
