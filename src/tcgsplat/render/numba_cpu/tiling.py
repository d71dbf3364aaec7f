"""Which splats each tile must draw, in order of depth: an exact radix sort of all splats, then counting into tiles."""

import numpy as np
from numba import njit

_LOW = np.uint32(2047)
_MIDDLE, _HIGH = np.uint32(11), np.uint32(22)


@njit(error_model="numpy", nogil=True, cache=True)
def depth_order(depth_bits, tiles, n, order):
    """Fill `order` with the visible splats, nearest first, ties by index; gives how many.

    Positive floats sort like their bits; three passes of eleven bits each keep earlier order, so the sort is exact and
    stable.
    """
    counts = np.zeros((3, 2048), np.int64)
    keys, swap_keys = np.empty(n, np.uint32), np.empty(n, np.uint32)
    swap = np.empty(n, np.int32)
    m = 0
    for i in range(n):
        if tiles[2 * n + i] >= tiles[i]:
            key = depth_bits[i]
            keys[m] = key
            order[m] = i
            m += 1
            counts[0, key & _LOW] += 1
            counts[1, (key >> _MIDDLE) & _LOW] += 1
            counts[2, key >> _HIGH] += 1
    for digit in range(3):
        total = 0
        for value in range(2048):
            count = counts[digit, value]
            counts[digit, value] = total
            total += count
    for j in range(m):
        place = counts[0, keys[j] & _LOW]
        counts[0, keys[j] & _LOW] += 1
        swap[place], swap_keys[place] = order[j], keys[j]
    for j in range(m):
        digit_value = (swap_keys[j] >> _MIDDLE) & _LOW
        place = counts[1, digit_value]
        counts[1, digit_value] += 1
        order[place], keys[place] = swap[j], swap_keys[j]
    for j in range(m):
        place = counts[2, keys[j] >> _HIGH]
        counts[2, keys[j] >> _HIGH] += 1
        swap[place] = order[j]
    for j in range(m):
        order[j] = swap[j]
    return m


@njit(error_model="numpy", nogil=True, cache=True)
def count_pairs(tiles, n, tiles_x, tile_ends, slot_starts):  # type: ignore[no-untyped-def]
    """Count (splat, tile) pairs; `tile_ends[t + 1]` gets the end of tile t's list, `slot_starts[i]` splat i's first slot.

    A slot is a place in the table that `fill_pairs` writes: the slots of one splat lie side by side and tell where its
    pairs are in the tiles' lists, so that the backward pass can sum a splat's pairs in a fixed order.

    Nearly all splats touch at most two by two tiles. For those, all four are counted, by 0 or 1, without a branch that
    the processor would guess wrong every other time.
    """
    tile_ends[:] = 0
    slots = 0
    for i in range(n):
        slot_starts[i] = slots
        dx, dy = tiles[2 * n + i] - tiles[i], tiles[3 * n + i] - tiles[n + i]
        first = tiles[n + i] * tiles_x + tiles[i] + 1
        if (dx | dy) & ~1 == 0:
            tile_ends[first] += 1
            tile_ends[first + dx] += dx
            tile_ends[first + dy * tiles_x] += dy
            tile_ends[first + dx + dy * tiles_x] += dx & dy
            slots += (dx + 1) * (dy + 1)
        elif dx >= 0:
            for ty in range(dy + 1):
                for tx in range(dx + 1):
                    tile_ends[first + ty * tiles_x + tx] += 1
            slots += (dx + 1) * (dy + 1)
    slot_starts[n] = slots
    for t in range(1, tile_ends.size):
        tile_ends[t] += tile_ends[t - 1]
    return slots


@njit(error_model="numpy", nogil=True, cache=True)
def fill_pairs(order, visible, tiles, n, tiles_x, tile_ends, slot_starts, pair_splats, slot_pairs):  # type: ignore[no-untyped-def]
    """List each tile's splats by depth in `pair_splats`, and each splat's pairs in `slot_pairs`."""
    cursor = tile_ends[:-1].copy()
    for j in range(visible):
        i = order[j]
        slot = slot_starts[i]
        dx, dy = tiles[2 * n + i] - tiles[i], tiles[3 * n + i] - tiles[n + i]
        first = tiles[n + i] * tiles_x + tiles[i]
        if (dx | dy) & ~1 == 0:
            below = first + dy * tiles_x
            pair = cursor[first]
            cursor[first] = pair + 1
            pair_splats[pair] = i
            slot_pairs[slot] = pair
            if dx:
                pair = cursor[first + 1]
                cursor[first + 1] = pair + 1
                pair_splats[pair] = i
                slot_pairs[slot + 1] = pair
            if dy:
                pair = cursor[below]
                cursor[below] = pair + 1
                pair_splats[pair] = i
                slot_pairs[slot + dx + 1] = pair
                if dx:
                    pair = cursor[below + 1]
                    cursor[below + 1] = pair + 1
                    pair_splats[pair] = i
                    slot_pairs[slot + 3] = pair
        else:
            for ty in range(dy + 1):
                for tx in range(dx + 1):
                    tile = first + ty * tiles_x + tx
                    pair = cursor[tile]
                    cursor[tile] = pair + 1
                    pair_splats[pair] = i
                    slot_pairs[slot] = pair
                    slot += 1
