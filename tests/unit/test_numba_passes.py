"""The passes over arrays: exact lists, equal bits on any threads, several callers at once, arrays used again."""

import threading

import numpy as np
import pytest
from numba import njit

from tcgsplat.geometry.camera import Camera
from tcgsplat.render.numba_cpu import pass_kernels
from tcgsplat.render.numba_cpu.layout import (
    LOG2_OPACITY,
    MEAN,
    PARAMETERS,
    QUAT,
    SCALE,
    aligned,
    from_blocks,
    to_blocks,
)
from tcgsplat.render.numba_cpu.passes import Passes
from tcgsplat.render.numba_cpu.phases import COUNTERS, OVER, WAITING, next_unit
from tcgsplat.render.numba_cpu.workers import Workers

CAMERA = Camera(fx=90.0, fy=90.0, cx=60.2, cy=45.1, width=121, height=90)
THREADS = (1, 2, 3, 7)


def parameters(n: int, seed: int, nearest: float = 0.1, farthest: float = 4.0) -> np.ndarray:
    """Random splats, many at the very same depth, some behind, some as large as many tiles."""
    rng = np.random.default_rng(seed)
    P = np.empty((PARAMETERS, n), np.float32)
    z = np.round(rng.uniform(nearest, farthest, n), 1 if farthest < 10 else -1)
    P[MEAN : MEAN + 3] = rng.uniform(-0.8, 0.8, n) * z, rng.uniform(-0.6, 0.6, n) * z, z
    P[QUAT : QUAT + 4] = rng.normal(size=(4, n))
    P[SCALE : SCALE + 3] = rng.uniform(0.005, 0.03, (3, n)) * np.where(rng.random(n) < 0.02, 20, 1) * np.maximum(z, 0.2)
    P[LOG2_OPACITY] = np.log2(rng.uniform(0.002, 0.99, n))
    P[LOG2_OPACITY + 1 :] = rng.uniform(size=(4, n))
    blocks = aligned((n // 16, PARAMETERS, 16))
    to_blocks(blocks, P.T)
    return blocks


def passed(passes: Passes, P: np.ndarray) -> list[np.ndarray]:
    """Everything that the two passes give."""
    drawn = passes.draw(P, CAMERA, np.eye(4))
    visible, planes = drawn.visible, drawn.planes
    grads, d_T = passes.differentiate(drawn, np.cos(np.arange(planes.size, dtype=np.float32)).reshape(planes.shape))
    return [planes, visible, grads, d_T]


@pytest.mark.parametrize("threads", THREADS)
@pytest.mark.parametrize(("nearest", "farthest"), [(-0.5, 4.0), (30.0, 3000.0)])
def test_lists_are_in_exact_order_and_slots_in_place(threads: int, nearest: float, farthest: float):
    """Also where two digits of a sorting key are not enough: beyond 51 m."""
    P = parameters(2512, 1, nearest, farthest)
    drawn = Passes(threads).draw(P, CAMERA, np.eye(4))
    splats, slots = drawn.pair_splats, drawn.pairs[: drawn.tile_ends[-1]] >> 32
    tiles = np.repeat(np.arange(drawn.tile_ends.size - 1), np.diff(drawn.tile_ends))
    assert len(np.unique(drawn.depths)) < 500  # ties are what stability is about
    keys = np.stack((tiles, drawn.depths[splats].astype(np.float64), splats))
    np.testing.assert_array_equal(np.lexsort(keys[::-1]), np.arange(len(splats)))

    assert 0 < drawn.visible.sum() < 2512
    counts = np.bincount(splats, minlength=2512)
    np.testing.assert_array_equal(counts > 0, drawn.visible)
    np.testing.assert_array_equal(np.diff(drawn.slot_starts.astype(np.int64)), counts)
    assert counts.max() > 9  # some are larger than two by two tiles
    by_splat = np.lexsort((tiles, splats))
    np.testing.assert_array_equal(slots[by_splat], np.arange(len(slots)))
    for i in np.flatnonzero(counts > 1):
        x, y = tiles[splats == i] % drawn.tiles_x, tiles[splats == i] // drawn.tiles_x
        assert counts[i] == (x.max() - x.min() + 1) * (y.max() - y.min() + 1)


def test_everything_has_the_same_bits_on_any_threads():
    P = parameters(9008, 2)
    expected = passed(Passes(1), P)
    for threads in THREADS[1:]:
        for a, b in zip(expected, passed(Passes(threads), P), strict=True):
            assert np.array_equal(a, b)


def test_two_callers_share_passes():
    passes, scenes = Passes(2), [parameters(3008, 3), parameters(4000, 4)]
    expected = [passed(Passes(1), P) for P in scenes]
    wrong = []

    def call(k: int) -> None:
        for _ in range(10):
            wrong.extend(
                k for a, b in zip(expected[k], passed(passes, scenes[k]), strict=True) if not np.array_equal(a, b)
            )

    threads = [threading.Thread(target=call, args=(k,)) for k in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


def test_a_pass_that_is_kept_is_not_overwritten_and_one_that_is_dropped_gives_its_arrays_back():
    passes, P, other = Passes(2), parameters(3008, 5), parameters(3008, 6)
    expected = passed(Passes(1), P)
    kept = passes.draw(P, CAMERA, np.eye(4))
    for _ in range(3):
        between = passes.draw(other, CAMERA, np.eye(4))
        assert between.workspace is not kept.workspace
    d_planes = np.cos(np.arange(kept.planes.size, dtype=np.float32)).reshape(kept.planes.shape)
    np.testing.assert_array_equal(passes.differentiate(kept, d_planes)[0], expected[2])
    used = kept.records.ctypes.data
    del kept
    assert passes.draw(P, CAMERA, np.eye(4)).records.ctypes.data == used


def test_derivatives_go_where_the_caller_wants_them():
    P, passes, grads = parameters(1008, 7), Passes(2), aligned((63, PARAMETERS, 16))
    expected = passed(passes, P)
    drawn = passes.draw(P, CAMERA, np.eye(4))
    d_planes = np.cos(np.arange(drawn.planes.size, dtype=np.float32)).reshape(drawn.planes.shape)
    assert passes.differentiate(drawn, d_planes, grads)[0] is grads
    np.testing.assert_array_equal(grads, expected[2])


def test_laps_are_called_in_order_and_change_nothing():
    laps: list[str] = []
    P = parameters(1008, 8)
    for a, b in zip(passed(Passes(2), P), passed(Passes(2, laps.append), P), strict=True):
        assert np.array_equal(a, b)
    assert laps == ["project", "sort", "bin", "forward", "backward", "chain"]


@njit
def _take(progress, phase, units, finished):
    return next_unit(progress, phase, units, finished)


def test_units_are_given_out_once_and_waited_for():
    progress = np.zeros(2 * COUNTERS, np.int64)
    assert [_take(progress, 1, 2, 0), _take(progress, 1, 2, 0)] == [0, 1]
    assert _take(progress, 1, 2, 0) == WAITING  # two others are at work
    assert _take(progress, 1, 2, 1) == WAITING
    assert _take(progress, 1, 2, 1) == OVER
    assert _take(progress, 1, 2, 0) == OVER  # who starts again finds nothing to do
    assert _take(progress, 0, 0, 0) == OVER


def test_workers_raise_what_a_helper_raises_and_wait_for_all():
    workers, seen = Workers(3), []

    def work(worker: int) -> None:
        seen.append(worker)
        if worker == 1:
            raise ValueError("one")
        while 1 not in seen:
            pass

    with pytest.raises(ValueError, match="one"):
        workers.together(work)
    ranges: list[tuple[int, int]] = []
    workers.run(lambda a, b: ranges.append((a, b)), workers.cuts(100, 16))
    assert sorted(ranges) == [(0, 32), (32, 64), (64, 100)]


def test_a_unit_is_whole_vectors():
    assert pass_kernels.UNIT % 16 == 0


@pytest.mark.parametrize("n", [1, 15, 16, 17, 48])
def test_blocks_hold_sixteen_rows_of_a_table_side_by_side(n: int) -> None:
    table = np.arange(5 * n, dtype=np.float32).reshape(n, 5)
    blocks = np.full((-(-n // 16), 5, 16), -1, np.float32)
    to_blocks(blocks, table)
    assert all(blocks[i // 16, k, i % 16] == table[i, k] for i in range(n) for k in range(5))
    assert (blocks == -1).sum() == 5 * (-n % 16)
    np.testing.assert_array_equal(from_blocks(blocks)[:n], table)
