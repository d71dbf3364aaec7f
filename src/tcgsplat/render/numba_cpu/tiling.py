"""Which splats each tile must draw, in order of depth: an exact radix sort of all splats, then counting into tiles.

All is shared over strips, consecutive ranges of splats: each counts on its own, the counts of all become places, and
each fills its places. The outcome, a stable order, is the same however the strips are cut.

Places are kept in unsigned integers, which as indices need no test for the end that negative ones count from.
"""

import numpy as np

from tcgsplat.render.conventions import NEAR_PLANE
from tcgsplat.render.numba_cpu.compilation import inner
from tcgsplat.render.numba_cpu.lanes import prefetch, prefetch_to_write
from tcgsplat.render.numba_cpu.layout import SPAN_UNIT, SPLAT

DIGIT_BITS = 13
DIGIT_VALUES = 1 << DIGIT_BITS
_DIGIT_MASK = DIGIT_VALUES - 1
LINE = 8
"""Entries, or pairs, of a cache line. Lists have room for one more at their end: where one is written to in thousands of
places by turns, the line after each place is asked for as soon as the place is used, or every eighth write would wait."""
_AHEAD = 24  # splats asked for in advance: in order of depth they are anywhere in memory
_BEYOND_TWO = ~(1 | SPAN_UNIT)
_NEAREST = int(np.float32(NEAR_PLANE).view(np.int32))


@inner
def tally(start, stop, depth_bits, rectangles, sums):  # type: ignore[no-untyped-def]
    """Of a range: visible splats, (splat, tile) pairs, and the largest sorting key."""
    visible, pairs, largest = np.int64(0), np.int64(0), np.int64(0)
    for i in range(start, stop):
        if depth_bits[i] > 0:
            span = np.int64(rectangles[2 * i + 1])
            visible += 1
            pairs += ((span & (SPAN_UNIT - 1)) + 1) * ((span >> 12) + 1)
            largest = max(largest, np.int64(depth_bits[i]) - _NEAREST)
    sums[0], sums[1], sums[2] = visible, pairs, largest


@inner
def used_digits(sums):  # type: ignore[no-untyped-def]
    """How many digits to sort by: an even number, so that the entries end where they began; two nearly always."""
    largest = np.int64(0)
    for k in range(sums.shape[0]):
        largest = max(largest, sums[k, 2])
    return 4 if largest >> (2 * DIGIT_BITS) else 2


@inner
def list_visible(start, stop, at, slot, depth_bits, rectangles, entries, counts, slot_starts):  # type: ignore[no-untyped-def]
    """List the visible splats of a range from `entries[at]` on, count their keys' first digits, and number their slots.

    An entry is a key over a splat. Positive floats sort like their bits; less those of the near plane, which is the
    nearest that is visible, keys of rooms (up to 51 m) have two digits of thirteen bits.
    """
    counts[:] = 0
    for i in range(start, stop):
        slot_starts[i] = slot
        if depth_bits[i] > 0:
            key = np.int64(depth_bits[i]) - _NEAREST
            entries[at] = key << 32 | i
            counts[key & _DIGIT_MASK] += 1
            at += 1
            span = np.int64(rectangles[2 * i + 1])
            slot += ((span & (SPAN_UNIT - 1)) + 1) * ((span >> 12) + 1)
    slot_starts[stop] = slot


@inner
def count_digits(entries, start, stop, shift, counts):  # type: ignore[no-untyped-def]
    """How often each value of the digit at bit `shift` occurs in a range."""
    counts[:] = 0
    for j in range(start, stop):
        counts[(entries[j] >> shift) & _DIGIT_MASK] += 1


@inner
def places(counts, ends):  # type: ignore[no-untyped-def]
    """Turn each strip's counts of values into the places of its first items, by value, then strip.

    `ends[v + 1]` gets the end of value v's items; there may be more counts than values.
    """
    total = np.int64(0)
    ends[0] = 0
    for value in range(ends.size - 1):
        for strip in range(counts.shape[0]):
            count = counts[strip, value]
            counts[strip, value] = total
            total += count
        ends[value + 1] = total


@inner
def move(entries, start, stop, shift, cursors, moved):  # type: ignore[no-untyped-def]
    """Put a range's entries to their places by one digit."""
    for j in range(start, stop):
        entry = entries[j]
        value = (entry >> shift) & _DIGIT_MASK
        place = cursors[value]
        cursors[value] = place + 1
        moved[place] = entry
        prefetch_to_write(moved, np.int64(place) + LINE)


@inner
def count_tiles(entries, start, stop, rectangles, tiles_x, counts):  # type: ignore[no-untyped-def]
    """How many splats of a range each tile has.

    Nearly all splats touch at most two by two tiles. For those, all four are counted, by 0 or 1, without a branch that
    the processor would guess wrong every other time; beyond the last tile there is a count for the rest.
    """
    counts[:] = 0
    spare = counts.size - 1
    for j in range(start, stop):
        prefetch(rectangles, 2 * (entries[min(j + _AHEAD, stop - 1)] & SPLAT))
        i = entries[j] & SPLAT
        first, span = np.int64(rectangles[2 * i]), np.int64(rectangles[2 * i + 1])
        if span & _BEYOND_TWO == 0:
            dx, dy = span & 1, span >> 12
            counts[first] += 1
            counts[first + 1 if dx else spare] += 1
            counts[first + tiles_x if dy else spare] += 1
            counts[first + tiles_x + 1 if dx & dy else spare] += 1
        else:
            for row in range((span >> 12) + 1):
                for tile in range(first + row * tiles_x, first + row * tiles_x + (span & (SPAN_UNIT - 1)) + 1):
                    counts[tile] += 1


@inner
def fill_tiles(entries, start, stop, rectangles, slot_starts, tiles_x, cursors, pairs):  # type: ignore[no-untyped-def]
    """List a range's splats in their tiles. A pair is a slot over a splat; each of a splat's pairs has its own slot.

    A splat's slots lie side by side, in the order of its tiles: the backward pass leaves its sums there.
    """
    spare = np.int64(cursors.size - 1)
    for j in range(start, stop):
        ahead = entries[min(j + _AHEAD, stop - 1)] & SPLAT
        prefetch(rectangles, 2 * ahead)
        prefetch(slot_starts, ahead)
        i = entries[j] & SPLAT
        first, span, slot = np.int64(rectangles[2 * i]), np.int64(rectangles[2 * i + 1]), np.int64(slot_starts[i])
        if span & _BEYOND_TWO == 0:
            dx, dy = span & 1, span >> 12
            place = np.int64(cursors[first])
            cursors[first] = place + 1
            pairs[place] = slot << 32 | i
            prefetch_to_write(pairs, place + LINE)
            tile = first + 1 if dx else spare
            place = np.int64(cursors[tile])
            cursors[tile] = place + dx
            pairs[place] = (slot + 1) << 32 | i
            prefetch_to_write(pairs, place + LINE)
            tile = first + tiles_x if dy else spare
            place = np.int64(cursors[tile])
            cursors[tile] = place + dy
            pairs[place] = (slot + 1 + dx) << 32 | i
            prefetch_to_write(pairs, place + LINE)
            tile = first + tiles_x + 1 if dx & dy else spare
            place = np.int64(cursors[tile])
            cursors[tile] = place + (dx & dy)
            pairs[place] = (slot + 3) << 32 | i
            prefetch_to_write(pairs, place + LINE)
        else:
            for row in range((span >> 12) + 1):
                for tile in range(first + row * tiles_x, first + row * tiles_x + (span & (SPAN_UNIT - 1)) + 1):
                    place = np.int64(cursors[tile])
                    cursors[tile] = place + 1
                    pairs[place] = slot << 32 | i
                    slot += 1
