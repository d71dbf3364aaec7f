"""Kernels that measure a machine and count a scene: what `limit` computes the physical limit from.

A rate is the best of many short runs, because whatever else the machine does can only make a run longer.
"""

import math
import time
from collections.abc import Callable

import numpy as np
from numba import njit

from tcgsplat.render.conventions import MIN_ALPHA, MIN_TRANSMITTANCE
from tcgsplat.render.numba_cpu.compilation import FLAGS
from tcgsplat.render.numba_cpu.lanes import load, store
from tcgsplat.render.numba_cpu.layout import (
    BLOCK,
    FORM_A,
    FORM_B,
    FORM_C,
    RECORD,
    RECORD_LOG2_OPACITY,
    TILE,
    TILE_PIXELS,
    Floats,
    U,
    V,
    aligned,
)
from tcgsplat.render.numba_cpu.simd import LANES, fma, spread
from tcgsplat.render.numba_cpu.workers import Workers

_LOG2_MIN_ALPHA = np.float32(math.log2(MIN_ALPHA))
_MIN_TRANSMITTANCE = np.float32(MIN_TRANSMITTANCE)
_RUNS = 2000
_ROUNDS = 20_000
"""Tens of microseconds a run: short enough to fall between two interruptions."""


@njit(fastmath=set(FLAGS), error_model="numpy", nogil=True, cache=True)
def _five_chains(rounds, numbers):
    """Five chains of vector multiply-adds that do not wait for each other: all that sixteen registers hold."""
    a, b = spread(numbers[0]), spread(numbers[1])
    v0, v1, v2, v3, v4 = a, b, a, b, a
    for _ in range(rounds):
        v0, v1, v2, v3, v4 = fma(v0, a, b), fma(v1, a, b), fma(v2, a, b), fma(v3, a, b), fma(v4, a, b)
    store(numbers, 0, ((v0 + v1) + (v2 + v3)) + v4)


@njit(fastmath=set(FLAGS), error_model="numpy", nogil=True, cache=True)
def _ten_chains(rounds, numbers):
    """Ten of them: two pipes of a latency of four or five are full, where a vector is one register."""
    a, b = spread(numbers[0]), spread(numbers[1])
    v0, v1, v2, v3, v4, v5, v6, v7, v8, v9 = a, b, a, b, a, b, a, b, a, b
    for _ in range(rounds):
        v0, v1, v2, v3, v4 = fma(v0, a, b), fma(v1, a, b), fma(v2, a, b), fma(v3, a, b), fma(v4, a, b)
        v5, v6, v7, v8, v9 = fma(v5, a, b), fma(v6, a, b), fma(v7, a, b), fma(v8, a, b), fma(v9, a, b)
    store(numbers, 0, (((v0 + v1) + (v2 + v3)) + ((v4 + v5) + (v6 + v7))) + (v8 + v9))


def vector_rate() -> float:
    """Multiply-adds of sixteen lanes that one thread does in a second."""

    def run(chains: Callable[[int, Floats], object]) -> float:
        numbers = np.full(LANES, 0.5, np.float32)  # 0.5 x + 0.5 stays near 1
        return _shortest(lambda: chains(_ROUNDS, numbers))

    return max(5 * _ROUNDS / run(_five_chains), 10 * _ROUNDS / run(_ten_chains))


@njit(error_model="numpy", nogil=True, cache=True)
def _integer_chain(rounds, a, b):
    """Eight integer operations a round, each waiting for the one before: a cycle each, on any processor."""
    x = a
    for _ in range(rounds):
        x = (((((((x + a) ^ b) + a) ^ b) + a) ^ b) + a) ^ b
    return x


def clock_rate() -> float:
    """Cycles that one thread goes through in a second, while it is busy."""
    return 8 * _ROUNDS / _shortest(lambda: _integer_chain(_ROUNDS, 0x12345, 0x54321))


@njit(fastmath=set(FLAGS), error_model="numpy", nogil=True, cache=True)
def _scaled(start, stop, source, target):
    for i in range(start, stop, 16):
        store(target, i, load(source, i) * np.float32(0.5))


def stream_rate(moved: int, workers: Workers) -> float:
    """Bytes that the workers together read and write in a second, half of each, on arrays of `moved` bytes in all."""
    count = max(moved // 8 // LANES, 1) * LANES
    source: Floats = aligned(count)  # type: ignore[assignment]
    target: Floats = aligned(count)  # type: ignore[assignment]
    source[:] = target[:] = 1.0
    cuts = workers.cuts(count, LANES)
    return 8 * count / _shortest(lambda: workers.run(lambda a, b: _scaled(a, b, source, target), cuts), runs=12)


def _shortest(work: Callable[[], object], runs: int = _RUNS) -> float:
    """Seconds, after a run that is not counted."""
    work()
    seconds = []
    for _ in range(runs):
        started = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - started)
    return min(seconds)


@njit(fastmath=set(FLAGS), error_model="numpy", nogil=True, cache=True)
def needed(tile_ends, pair_splats, records, masks, tiles_x, width, height):
    """Pixels, blocks and tiles that compositing cannot leave out: each splat counts with each one that it shows in.

    A (splat, pixel) pair is needed where alpha >= MIN_ALPHA and what is before lets more than MIN_TRANSMITTANCE
    through. A (splat, block) pair is needed where the mask says that the ellipse alpha = MIN_ALPHA reaches the block
    and the block was not yet opaque; a (splat, tile) pair where one of its blocks is. Beyond the image, nothing is.
    """
    pixels, blocks, pairs = 0, 0, 0
    transmittance = np.empty(TILE_PIXELS, np.float32)
    for tile in range(tile_ends.size - 1):
        transmittance[:] = np.float32(1)
        x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        for pair in range(tile_ends[tile], tile_ends[tile + 1]):
            at = pair_splats[pair] * RECORD
            before = blocks
            for block in range(16):
                left, top = x0 + BLOCK * (block % 4), y0 + BLOCK * (block // 4)
                if not (masks[pair] >> block) & 1 or left >= width or top >= height:
                    continue
                blocks += 1
                for lane in range(16):
                    x, y, pixel = left + lane % BLOCK, top + lane // BLOCK, block * 16 + lane
                    if x >= width or y >= height or transmittance[pixel] <= _MIN_TRANSMITTANCE:
                        continue
                    dx, dy = np.float32(x) - records[at + U], np.float32(y) - records[at + V]
                    form = (records[at + FORM_A] * dx + records[at + FORM_B] * dy) * dx + records[at + FORM_C] * dy * dy
                    log2_alpha = form + records[at + RECORD_LOG2_OPACITY]
                    if log2_alpha >= _LOG2_MIN_ALPHA:
                        pixels += 1
                        transmittance[pixel] *= np.float32(1) - np.float32(2) ** log2_alpha
            pairs += blocks > before
    return pixels, blocks, pairs
