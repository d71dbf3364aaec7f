import math

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError

from tcgsplat.render.numba_cpu import lanes, simd
from tcgsplat.render.numba_cpu.compilation import FLAGS

_compiled = njit(fastmath=set(FLAGS))


@_compiled
def _arithmetic(a, b, out):
    x, y = lanes.load(a, 0), lanes.load(b, 0)
    lanes.store(out, 0, x + y)
    lanes.store(out, 16, x - y * np.float32(2))
    lanes.store(out, 32, 3 * x / y)
    lanes.store(out, 48, simd.fma(x, y, simd.spread(np.float32(1))))
    lanes.store(out, 64, simd.minimum(x, y))
    lanes.store(out, 80, simd.maximum(x, y))
    lanes.store(out, 96, simd.where_ge(x, y, x, simd.spread(np.float32(-7))))
    lanes.store(out, 112, simd.sqrt(y))
    lanes.store(out, 128, simd.floor(x))
    return lanes.mask_ge(x, y), lanes.sum_lanes(x)


def test_arithmetic_is_lane_by_lane():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=16).astype(np.float32), rng.uniform(0.5, 2, 16).astype(np.float32)
    out = np.zeros(144, np.float32)
    mask, total = _arithmetic(a, b, out)
    rows = out.reshape(9, 16)
    expected = [a + b, a - 2 * b, 3 * a / b, a * b + 1, np.minimum(a, b), np.maximum(a, b), np.where(a >= b, a, -7)]
    expected += [np.sqrt(b), np.floor(a)]
    for row, values in zip(rows, expected, strict=True):
        np.testing.assert_allclose(row, values, rtol=3e-7, atol=1e-7)
    assert mask == sum(1 << k for k in range(16) if a[k] >= b[k])
    assert total == pytest.approx(a.sum(), abs=1e-6)


@_compiled
def _exp2(a, out):
    for i in range(0, a.size, 16):
        lanes.store(out, i, simd.exp2(lanes.load(a, i)))


def test_exp2_is_accurate_over_the_range_that_the_kernels_use():
    a = np.linspace(-20, 20, 1 << 14).astype(np.float32)
    out = np.empty_like(a)
    _exp2(a, out)
    relative = np.abs(out.astype(np.float64) / np.exp2(a.astype(np.float64)) - 1)
    assert relative.max() < 3e-7


@_compiled
def _sums(rows, out):
    lanes.store(out, 0, lanes.lane_sums((lanes.load(rows, 0), lanes.load(rows, 16), lanes.load(rows, 32))))


def test_lane_sums_puts_each_total_in_its_lane():
    rows = np.arange(48, dtype=np.float32)
    out = np.full(16, -1, np.float32)
    _sums(rows, out)
    np.testing.assert_array_equal(out, [*rows.reshape(3, 16).sum(1), *[0] * 13])


@_compiled
def _transpose(matrix, out):
    lanes.store_rows(out, 0, 16, lanes.columns_of(lanes.columns_of(lanes.load_rows(matrix, 0, 16, 16))))
    lanes.store(out, 256, lanes.columns_of(lanes.load_rows(matrix, 0, 16, 16))[3])


def test_transposed_load_and_store_are_inverse():
    matrix = np.arange(256, dtype=np.float32)
    out = np.zeros(272, np.float32)
    _transpose(matrix, out)
    np.testing.assert_array_equal(out[:256], matrix)
    np.testing.assert_array_equal(out[256:], matrix.reshape(16, 16)[:, 3])


@_compiled
def _append(out, masks, start, bit, length):
    return lanes.append_where_bit(out, 2, masks, start, np.int32(bit), np.int32(length))


@pytest.mark.parametrize("length", [16, 5, 0])
def test_append_where_bit_keeps_order_and_length(length):
    rng = np.random.default_rng(1)
    masks = rng.integers(0, 8, 48).astype(np.int32)
    out = np.full(40, -1, np.int32)
    count = _append(out, masks, 16, 2, length)
    expected = [i for i in range(16, 16 + length) if masks[i] & 2]
    assert count == len(expected)
    assert out[2 : 2 + count].tolist() == expected


@_compiled
def _integers(values, out):
    lanes.store_int32_pairs(out, 0, lanes.load(values, 0), lanes.load(values, 0) * np.float32(2))
    return lanes.trailing_zeros(np.int32(40))


def test_integers():
    out = np.zeros(32, np.int32)
    values = np.linspace(-3, 40, 16).astype(np.float32)
    assert _integers(values, out) == int(math.log2(8))
    np.testing.assert_array_equal(out[0::2], values.astype(np.int32))
    np.testing.assert_array_equal(out[1::2], (2 * values).astype(np.int32))


@_compiled
def _regroup(blocks, out):
    rows = lanes.regrouped(*lanes.load_rows(blocks, 0, 16, 4))
    for k in range(4):
        lanes.store(out, 16 * k, rows[k])


def test_regrouped_makes_rows_of_pixels_from_blocks_and_back():
    blocks, rows, back = np.arange(64, dtype=np.float32), np.zeros(64, np.float32), np.zeros(64, np.float32)
    _regroup(blocks, rows)
    np.testing.assert_array_equal(rows.reshape(4, 4, 4), blocks.reshape(4, 4, 4).transpose(1, 0, 2))
    _regroup(rows, back)
    np.testing.assert_array_equal(back, blocks)


@_compiled
def _log2(a, out):
    for i in range(0, a.size, 16):
        lanes.store(out, i, simd.log2(lanes.load(a, i)))


def test_log2_is_accurate_from_tiny_to_huge_and_near_one():
    a = np.concatenate((np.exp2(np.linspace(-100, 100, 4096)), np.linspace(0.5, 2, 4096))).astype(np.float32)
    out = np.empty_like(a)
    _log2(a, out)
    true = np.log2(a.astype(np.float64))
    assert np.all(np.abs(out - true) < 2e-7 + 1e-7 * np.abs(true))


@_compiled
def _gather(array, indices, out):
    lanes.store(out, 0, lanes.gather(array, 3, lanes.load(indices, 0)))


def test_gather_takes_a_value_for_every_lane():
    rng = np.random.default_rng(2)
    array = rng.normal(size=100).astype(np.float32)
    indices = rng.integers(-3, 97, 16)
    out = np.zeros(16, np.float32)
    _gather(array, (indices + np.where(indices >= 0, 0.9, 0)).astype(np.float32), out)
    np.testing.assert_array_equal(out, array[3 + indices])


@_compiled
def _squares(image, x, y, out):
    squares = lanes.gather_squares(image, 4 * image.shape[1], lanes.load(x, 0), lanes.load(y, 0))
    lanes.store_rows(out, 0, 16, lanes.columns_of(squares))


def test_gather_squares_takes_four_pixels_for_every_lane():
    rng = np.random.default_rng(3)
    image = rng.normal(size=(7, 9, 4)).astype(np.float32)
    x, y = rng.uniform(0, 8, 16).astype(np.float32), rng.uniform(0, 6, 16).astype(np.float32)
    x[0], y[0], x[1], y[1] = 0, 0, 7.9, 5.9  # the first square and the last
    out = np.zeros((16, 2, 2, 4), np.float32)
    _squares(image, x, y, out.reshape(-1))
    for square, column, row in zip(out, x.astype(int), y.astype(int), strict=True):
        np.testing.assert_array_equal(square, image[row : row + 2, column : column + 2])


@_compiled
def _matrices(rows, out):
    A, B = lanes.load_rows(rows, 0, 16, 9), lanes.load_rows(rows, 144, 16, 9)
    lanes.store_rows(out, 0, 16, simd.product(A, B))
    lanes.store_rows(out, 144, 16, simd.transposed(A))
    lanes.store_rows(out, 288, 16, simd.times_columns(A, B[:3]))
    lanes.store_rows(out, 432, 32, (simd.dot(A[:4], B[:4]), lanes.load_spread(rows, 5, 2)[1]))


def test_matrices_are_lane_by_lane():
    rows, out = np.random.default_rng(2).normal(size=(18, 16)).astype(np.float32), np.zeros((30, 16), np.float32)
    _matrices(rows.reshape(-1), out.reshape(-1))
    A, B = rows[:9].T.reshape(16, 3, 3), rows[9:].T.reshape(16, 3, 3)

    def close(row: int, expected: np.ndarray) -> None:
        flat = expected.reshape(16, -1)
        np.testing.assert_allclose(out[row : row + flat.shape[1]].T, flat, rtol=1e-5, atol=1e-6)

    close(0, A @ B)
    close(9, A.transpose(0, 2, 1))
    close(18, A * B[:, :1])
    close(27, (rows[:4] * rows[9:13]).sum(axis=0))
    close(29, np.full(16, rows[0, 6]))


@_compiled
def _copy_first(source, at, count, out):
    lanes.store_first(out, at, lanes.load_first(source, at, count), count)
    lanes.store(out, 32, lanes.load_first(source, at, count))


@pytest.mark.parametrize("count", [0, 5, 16])
def test_first_lanes_are_all_that_is_touched(count):
    source, out = np.arange(1, 17, dtype=np.float32), np.full(48, -1, np.float32)
    _copy_first(source[16 - count :] if count else source[:0], 0, count, out)
    np.testing.assert_array_equal(out[:count], source[16 - count :] if count else [])
    assert (out[count:32] == -1).all()
    assert (out[32 + count :] == 0).all()


@simd.formula
def _turned(a, b, more):
    """Python's own tuples, comprehensions, numbers of NumPy and of Python on either side, another formula, a minus."""
    first, (second, third) = more
    mixed = tuple(1 - np.float32(2) * x for x in (a, -b))
    return mixed[0] / 4 + first, (simd.maximum(mixed[1], 0), np.float32(0.5) * second - third)


@_compiled
def _call(x, y, factor, count, out):
    a, b = lanes.load(x, 0), lanes.load(y, 0)
    first, (second, third) = _turned(a, b, (factor, (count, b)))
    lanes.store_rows(out, 0, 16, (first, second, third))


def test_a_formula_takes_and_gives_tuples_and_spreads_numbers():
    x, y = np.linspace(-2, 2, 16, dtype=np.float32), np.linspace(3, -1, 16, dtype=np.float32)
    out = np.zeros(48, np.float32)
    _call(x, y, np.float32(7), 5, out)
    expected = [(1 - 2 * x) / 4 + 7, np.maximum(1 + 2 * y, 0), 2.5 - y]
    np.testing.assert_allclose(out.reshape(3, 16), expected, rtol=1e-6, atol=1e-6)


def test_a_formula_takes_no_doubles():
    """They would lose digits without a word."""
    with pytest.raises(TypingError, match="_turned"):
        _call(np.zeros(16, np.float32), np.zeros(16, np.float32), 7.0, 5, np.zeros(48, np.float32))


@_compiled
def _mix(a, out):
    rows = lanes.load_rows(a, 0, 16, 4)
    lanes.store_rows(out, 0, 16, lanes.even_and_odd(rows[0], rows[1]))
    lanes.store_rows(out, 32, 16, lanes.side_by_side(rows[0], rows[1], rows[2], rows[3]))
    lanes.store(out, 96, simd.ramp(5, 3))
    lanes.store(out, 112, simd.apart(rows[0], rows[1]))
    lanes.add_rows(out, 96, 16, (rows[2], rows[3]))


def test_lanes_are_taken_apart_and_put_side_by_side():
    a = np.random.default_rng(0).permutation(64).astype(np.float32)
    out = np.zeros(128, np.float32)
    _mix(a, out)
    rows = a.reshape(4, 16)
    np.testing.assert_array_equal(out[:32].reshape(2, 16), [a[0:32:2], a[1:32:2]])
    np.testing.assert_array_equal(out[32:96].reshape(16, 4), rows.T)
    np.testing.assert_array_equal(out[96:112], 5 + 3 * np.arange(16) + rows[2])
    np.testing.assert_array_equal(out[112:], np.abs(rows[0] - rows[1]) + rows[3])
