"""Sixteen floats as one value inside numba kernels.

`Float32x16` is an LLVM `<16 x float>`: with AVX-512 one register, on other processors LLVM splits it into the widest
registers there are, with the same results up to the rounding of fused multiply-adds. Loops that keep sums in such
values across iterations are what numba's own loop vectorisation cannot make.

Only what the kernels need is here: arithmetic by operators (a float or an int beside a vector is spread over the
lanes), loads and stores on flat float32 arrays, comparisons as 16-bit masks, exp2, and a transposing sum.
"""

import math
import operator
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar, Final

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, models, register_model
from numba.np.arrayobj import make_array

LANES = 16
_F32, _I1, _I16, _I32, _I64 = ir.FloatType(), ir.IntType(1), ir.IntType(16), ir.IntType(32), ir.IntType(64)
_VF, _VI, _VB = ir.VectorType(_F32, LANES), ir.VectorType(_I32, LANES), ir.VectorType(_I1, LANES)

# Contraction to fused multiply-adds and reciprocals, but no reassociation: exp2's rounding trick must survive.
_FLAGS = ("contract", "nsz", "arcp")
MATH: Final = {"contract", "nsz", "arcp"}
"""The `fastmath` argument of every kernel, for the same reason."""
KERNEL: Final = {"error_model": "numpy", "nogil": True, "cache": True, "no_cfunc_wrapper": True}
"""Arguments of kernels that Python calls."""
INNER: Final = {**KERNEL, "no_cpython_wrapper": True}
"""Arguments of kernels that only kernels call: without ways in from elsewhere they compile faster."""


class Float32x16(types.Type):
    """Numba type of a `<16 x float>`."""

    def __init__(self) -> None:
        super().__init__(name="Float32x16")


float32x16 = Float32x16()


@register_model(Float32x16)
class _Float32x16Model(models.PrimitiveModel):
    def __init__(self, manager: Any, fe_type: Any) -> None:
        super().__init__(manager, fe_type, _VF)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_VF, [float(value)] * LANES)


def _spread(builder: Any, scalar: Any) -> Any:
    undefined = ir.Constant(_VF, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_I32, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(_VI, [0] * LANES))


def _pointer(
    context: Any, builder: Any, array_type: Any, array: Any, index: Any, pointee: Any, inside: bool = True
) -> Any:
    data = make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index], inbounds=inside), pointee.as_pointer())


def _register_operator(op: Callable[..., Any], instruction: str) -> None:
    """Let `op` take two vectors, or a vector and a scalar on either side."""
    kinds = (float32x16, types.float32, types.int64)
    cases = [(a, b) for a in kinds for b in kinds if float32x16 in (a, b)]

    class VectorOperator(AbstractTemplate):
        # What is for this target is tried before numba's own dozen of general cases: compiling takes a quarter less.
        metadata: ClassVar = {"target": "cpu"}

        def generic(self, args: Any, kws: Any) -> Any:  # noqa: ARG002
            return signature(float32x16, *args) if tuple(args) in cases else None

    infer_global(op)(VectorOperator)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vectors = []
        for kind, arg in zip(sig.args, args, strict=True):
            if kind == types.int64:
                vectors.append(_spread(builder, builder.sitofp(arg, _F32)))
            else:
                vectors.append(_spread(builder, arg) if kind == types.float32 else arg)
        return getattr(builder, instruction)(*vectors, flags=_FLAGS)

    for case in cases:
        lower_builtin(op, *case)(lower)


for _op, _instruction in (
    (operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul"), (operator.truediv, "fdiv"),
):  # fmt: skip
    _register_operator(_op, _instruction)


@intrinsic
def spread(typingctx: Any, scalar: Any) -> Any:
    """Vector with `scalar` in every lane."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _spread(builder, args[0])

    return float32x16(types.float32), lower


@intrinsic
def load(typingctx: Any, array: Any, index: Any) -> Any:
    """The sixteen floats of a flat array that begin at `index`."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_pointer(context, builder, sig.args[0], args[0], args[1], _VF), align=4)

    return float32x16(array, types.int64), lower


@intrinsic
def store(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """Write sixteen floats to a flat array from `index` on."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _pointer(context, builder, sig.args[0], args[0], args[1], _VF), align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, float32x16), lower


@intrinsic
def store_int32_pairs(typingctx: Any, array: Any, index: Any, first: Any, second: Any) -> Any:
    """Truncate two vectors to integers and write them to a flat array of 32-bit integers, side by side lane by lane."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        integers = [builder.fptosi(value, _VI) for value in args[2:]]
        interleaved = [k // 2 + LANES * (k % 2) for k in range(2 * LANES)]
        pairs = ir.VectorType(_I32, 2 * LANES)
        both = builder.shuffle_vector(*integers, ir.Constant(pairs, interleaved))
        builder.store(both, _pointer(context, builder, sig.args[0], args[0], args[1], pairs), align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, float32x16, float32x16), lower


def _first_lanes(builder: Any, count: Any) -> Any:
    """Which lanes come before `count`, an int64."""
    undefined, lanes = ir.Constant(_VI, ir.Undefined), ir.Constant(_VI, list(range(LANES)))
    first = builder.insert_element(undefined, builder.trunc(count, _I32), ir.Constant(_I32, 0))
    return builder.icmp_signed("<", lanes, builder.shuffle_vector(first, undefined, ir.Constant(_VI, [0] * LANES)))


@intrinsic
def load_first(typingctx: Any, array: Any, index: Any, count: Any) -> Any:
    """The `count` floats from `index` on in the first lanes, 0 in the rest, of which memory is not touched.

    Less than 1 is none, more than sixteen are all.
    """

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = ir.FunctionType(_VF, [_VF.as_pointer(), _I32, _VB, _VF])
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.masked.load.v{LANES}f32.p0")
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1], _VF, inside=False)
        return builder.call(function, [pointer, ir.Constant(_I32, 4), _first_lanes(builder, args[2]), _constant(0.0)])

    return float32x16(array, types.int64, types.int64), lower


@intrinsic
def store_first(typingctx: Any, array: Any, index: Any, value: Any, count: Any) -> Any:
    """Write the first `count` lanes from `index` on, and nothing else."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.VoidType(), [_VF, _VF.as_pointer(), _I32, _VB])
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.masked.store.v{LANES}f32.p0")
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1], _VF, inside=False)
        builder.call(function, [args[2], pointer, ir.Constant(_I32, 4), _first_lanes(builder, args[3])])
        return context.get_dummy_value()

    return types.void(array, types.int64, float32x16, types.int64), lower


@intrinsic
def load_rows(typingctx: Any, array: Any, index: Any, pitch: Any, count: Any) -> Any:
    """Tuple of `count` (a literal) vectors that begin at index, index + pitch, ..."""
    if not isinstance(count, types.IntegerLiteral):
        return None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        rows, at = [], args[1]
        for _ in range(sig.return_type.count):
            rows.append(builder.load(_pointer(context, builder, sig.args[0], args[0], at, _VF), align=4))
            at = builder.add(at, args[2])
        return context.make_tuple(builder, sig.return_type, rows)

    return types.UniTuple(float32x16, count.literal_value)(array, types.int64, types.int64, count), lower


@intrinsic
def store_rows(typingctx: Any, array: Any, index: Any, pitch: Any, rows: Any) -> Any:
    """Write a tuple of vectors from index, index + pitch, ... on."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        at = args[1]
        for k in range(sig.args[3].count):
            row = builder.extract_value(args[3], k)
            builder.store(row, _pointer(context, builder, sig.args[0], args[0], at, _VF), align=4)
            at = builder.add(at, args[2])
        return context.get_dummy_value()

    return types.void(array, types.int64, types.int64, rows), lower


@intrinsic
def load_spread(typingctx: Any, array: Any, index: Any, count: Any) -> Any:
    """Tuple of `count` (a literal) vectors: one float of the array in every lane, then the next."""
    if not isinstance(count, types.IntegerLiteral):
        return None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        first = _pointer(context, builder, sig.args[0], args[0], args[1], _F32)
        floats = [
            builder.load(builder.gep(first, [ir.Constant(_I64, k)]), align=4) for k in range(sig.args[2].literal_value)
        ]
        return context.make_tuple(builder, sig.return_type, [_spread(builder, value) for value in floats])

    return types.UniTuple(float32x16, count.literal_value)(array, types.int64, count), lower


@intrinsic
def fma(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """A * b + c, fused where the processor can (llvm.fmuladd: never a library call)."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _fma(builder, *args)

    return float32x16(float32x16, float32x16, float32x16), lower


def _fma(builder: Any, a: Any, b: Any, c: Any) -> Any:
    name = f"llvm.fmuladd.v{LANES}f32"
    return builder.call(
        cgutils.get_or_insert_function(builder.module, ir.FunctionType(_VF, [_VF] * 3), name), [a, b, c]
    )


def _dot(builder: Any, a: Sequence[Any], b: Sequence[Any]) -> Any:
    total = builder.fmul(a[0], b[0], flags=_FLAGS)
    for x, y in zip(a[1:], b[1:], strict=True):
        total = _fma(builder, x, y, total)
    return total


@intrinsic
def dot(typingctx: Any, a: Any, b: Any) -> Any:
    """Scalar product of two tuples of vectors, lane by lane.

    This and `product` say in one call what many operators would: compiling takes time by the call.
    """

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        a, b = (
            [builder.extract_value(arg, k) for k in range(kind.count)] for arg, kind in zip(args, sig.args, strict=True)
        )
        return _dot(builder, a, b)

    return float32x16(a, b), lower


@intrinsic
def product(typingctx: Any, a: Any, b: Any) -> Any:
    """Matrix product of two 3 x 3 matrices, lane by lane; tuples of nine vectors, row by row."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        a, b = ([builder.extract_value(arg, k) for k in range(9)] for arg in args)
        entries = [_dot(builder, a[3 * row : 3 * row + 3], b[column::3]) for row in range(3) for column in range(3)]
        return context.make_tuple(builder, sig.return_type, entries)

    return types.UniTuple(float32x16, 9)(a, b), lower


@intrinsic
def transposed(typingctx: Any, a: Any) -> Any:
    """Transpose of a 3 x 3 matrix, a tuple of nine."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        entries = [builder.extract_value(args[0], 3 * column + row) for row in range(3) for column in range(3)]
        return context.make_tuple(builder, sig.return_type, entries)

    return types.UniTuple(float32x16, 9)(a), lower


@intrinsic
def times_columns(typingctx: Any, a: Any, scales: Any) -> Any:
    """A 3 x 3 matrix, a tuple of nine, with its columns multiplied by the three of `scales`."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        entries = [
            builder.fmul(builder.extract_value(args[0], k), builder.extract_value(args[1], k % 3), flags=_FLAGS)
            for k in range(9)
        ]
        return context.make_tuple(builder, sig.return_type, entries)

    return types.UniTuple(float32x16, 9)(a, scales), lower


@intrinsic
def minimum(typingctx: Any, a: Any, b: Any) -> Any:
    """Lane by lane, the smaller."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", args[0], args[1]), args[0], args[1])

    return float32x16(float32x16, float32x16), lower


@intrinsic
def maximum(typingctx: Any, a: Any, b: Any) -> Any:
    """Lane by lane, the larger."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", args[0], args[1]), args[0], args[1])

    return float32x16(float32x16, float32x16), lower


@intrinsic
def where_ge(typingctx: Any, a: Any, b: Any, yes: Any, no: Any) -> Any:
    """Lane by lane, `yes` where a >= b, else `no`."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">=", args[0], args[1]), args[2], args[3])

    return float32x16(float32x16, float32x16, float32x16, float32x16), lower


@intrinsic
def mask_ge(typingctx: Any, a: Any, b: Any) -> Any:
    """Bit k is set where a >= b in lane k (int32)."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(builder.fcmp_ordered(">=", args[0], args[1]), _I16)
        return builder.zext(bits, _I32)

    return types.int32(float32x16, float32x16), lower


@intrinsic
def sqrt(typingctx: Any, a: Any) -> Any:
    """Lane by lane square root."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(_VF, [_VF]), f"llvm.sqrt.v{LANES}f32")
        return builder.call(function, [args[0]])

    return float32x16(float32x16), lower


@intrinsic
def floor(typingctx: Any, a: Any) -> Any:
    """Lane by lane, the largest integer that is not larger."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_VF, [_VF]), f"llvm.floor.v{LANES}f32"
        )
        return builder.call(function, [args[0]])

    return float32x16(float32x16), lower


def _exp2_coefficients(degree: int = 5) -> list[float]:
    """2^x on [-0.5, 0.5] as a polynomial of least relative error (Chebyshev nodes), highest power first."""
    x = 0.5 * np.cos(np.pi * (np.arange(256) + 0.5) / 256)
    vandermonde = np.vander(x, degree + 1) / np.exp2(x)[:, None]
    return [float(c) for c in np.linalg.lstsq(vandermonde, np.ones_like(x), rcond=None)[0]]


_EXP2 = _exp2_coefficients()


@intrinsic
def exp2(typingctx: Any, a: Any) -> Any:
    """2^a for -126 < a < 127, relative error below 3e-7; outside, a meaningless number (select it away).

    Adding 1.5 * 2^23 rounds to the nearest integer in the low bits of the mantissa; shifted into the exponent, those
    bits scale the polynomial of the remainder.
    """

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        magic = _constant(12582912.0)
        shifted = builder.fadd(args[0], magic)  # no flags: must not be folded
        remainder = builder.fsub(args[0], builder.fsub(shifted, magic))
        # Pairs of terms side by side: the kernels wait for latency more than for arithmetic.
        high, middle, low = (_fma(builder, _constant(_EXP2[k]), remainder, _constant(_EXP2[k + 1])) for k in (0, 2, 4))
        square = builder.fmul(remainder, remainder)
        power = _fma(builder, _fma(builder, high, square, middle), square, low)
        exponent = builder.shl(builder.bitcast(shifted, _VI), ir.Constant(_VI, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(power, _VI), exponent), _VF)

    return float32x16(float32x16), lower


@intrinsic
def trailing_zeros(typingctx: Any, mask: Any) -> Any:
    """Index of the lowest set bit of a non-zero int32, as int64."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(_I32, [_I32, _I1]), "llvm.cttz.i32")
        return builder.zext(builder.call(function, [args[0], ir.Constant(_I1, 1)]), _I64)

    return types.int64(types.int32), lower


@intrinsic
def append_where_bit(typingctx: Any, out: Any, count: Any, masks: Any, start: Any, bit: Any, length: Any) -> Any:
    """Append to `out[count:]` those of start .. start+length-1 whose mask has the bit, in order; gives how many.

    `out` and `masks` are flat int32 arrays with sixteen spare entries at the end, which may be written; `bit` is the
    mask's value 1 << b.
    """

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        out_value, count_value, masks_value, start_value, bit_value, length_value = args
        lanes = ir.Constant(_VI, list(range(LANES)))

        def spread_int(value: Any) -> Any:
            undefined = ir.Constant(_VI, ir.Undefined)
            first = builder.insert_element(undefined, value, ir.Constant(_I32, 0))
            return builder.shuffle_vector(first, undefined, ir.Constant(_VI, [0] * LANES))

        masks_pointer = _pointer(context, builder, sig.args[2], masks_value, start_value, _VI)
        has_bit = builder.icmp_signed(
            "!=",
            builder.and_(builder.load(masks_pointer, align=4), spread_int(bit_value)),
            ir.Constant(_VI, [0] * LANES),
        )
        inside = builder.icmp_signed("<", lanes, spread_int(length_value))
        chosen = builder.and_(has_bit, inside)
        pointer = _pointer(context, builder, sig.args[0], out_value, count_value, _I32)
        first = builder.trunc(start_value, _I32)
        bits = builder.bitcast(chosen, _I16)
        if "+avx512f" in context.codegen().magic_tuple()[2]:
            # In a register: straight to memory takes some processors a hundred cycles.
            compress = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(_VI, [_VI, _VI, _VB]), f"llvm.x86.avx512.mask.compress.v{LANES}i32"
            )
            indices = builder.add(lanes, spread_int(first))
            compressed = builder.call(compress, [indices, ir.Constant(_VI, [0] * LANES), chosen])
            builder.store(compressed, builder.bitcast(pointer, _VI.as_pointer()), align=4)
            count_bits = cgutils.get_or_insert_function(builder.module, ir.FunctionType(_I16, [_I16]), "llvm.ctpop.i16")
            return builder.zext(builder.call(count_bits, [bits]), _I64)
        # Without branches: each is written, and overwritten if it was not chosen.
        number, wide = ir.Constant(_I64, 0), builder.zext(bits, _I64)
        for lane in range(LANES):
            builder.store(builder.add(first, ir.Constant(_I32, lane)), builder.gep(pointer, [number]), align=4)
            bit_of_lane = builder.lshr(wide, ir.Constant(_I64, lane))
            number = builder.add(number, builder.and_(bit_of_lane, ir.Constant(_I64, 1)))
        return number

    sig = types.int64(out, types.int64, masks, types.int64, types.int32, types.int32)
    return sig, lower


def _prefetch(context: Any, builder: Any, sig: Any, args: Any, to_write: bool) -> Any:
    byte_pointer = ir.IntType(8).as_pointer()
    pointer = builder.bitcast(_pointer(context, builder, sig.args[0], args[0], args[1], ir.IntType(8)), byte_pointer)
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(ir.VoidType(), [byte_pointer, _I32, _I32, _I32]), "llvm.prefetch.p0"
    )
    builder.call(function, [pointer, *(ir.Constant(_I32, number) for number in (int(to_write), 3, 1))])
    return context.get_dummy_value()


@intrinsic
def prefetch(typingctx: Any, array: Any, index: Any) -> Any:
    """Ask for the cache line of `array[index]`; the index must be inside."""
    return types.void(array, types.int64), partial(_prefetch, to_write=False)


@intrinsic
def prefetch_to_write(typingctx: Any, array: Any, index: Any) -> Any:
    """Ask for the cache line of `array[index]`, not to be shared; the index must be inside."""
    return types.void(array, types.int64), partial(_prefetch, to_write=True)


def _halves(group: int) -> tuple[list[int], list[int]]:
    """Shuffle indices that put, in each group of 2*group lanes, the low (high) halves of two vectors side by side."""
    low: list[int] = []
    high: list[int] = []
    for base in range(0, LANES, 2 * group):
        low += [base + k for k in range(group)] + [LANES + base + k for k in range(group)]
        high += [base + group + k for k in range(group)] + [LANES + base + group + k for k in range(group)]
    return low, high


def _sum_tree(builder: Any, vectors: Sequence[Any]) -> Any:
    """One vector whose lane k is the sum over the lanes of vector k: log2(16) rounds of halving, in fixed order."""
    level: list[Any] = [*vectors, *([None] * (LANES - len(vectors)))]
    zero = _constant(0.0)
    for group in (8, 4, 2, 1):
        low, high = (ir.Constant(_VI, indices) for indices in _halves(group))
        half = len(level) // 2
        merged = []
        for a, b in zip(level[:half], level[half:], strict=True):
            if a is None:
                merged.append(None)
                continue
            b_or_zero = zero if b is None else b
            merged.append(
                builder.fadd(
                    builder.shuffle_vector(a, b_or_zero, low), builder.shuffle_vector(a, b_or_zero, high), flags=_FLAGS
                )
            )
        level = merged
    return level[0]


@intrinsic
def lane_sums(typingctx: Any, vectors: Any) -> Any:
    """Vector whose lane k holds the sum of all lanes of the k-th vector of a tuple (up to sixteen; the rest 0)."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _sum_tree(builder, [builder.extract_value(args[0], k) for k in range(sig.args[0].count)])

    return float32x16(vectors), lower


@intrinsic
def sum_lanes(typingctx: Any, a: Any) -> Any:
    """Sum over the sixteen lanes, in a fixed order."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.extract_element(_sum_tree(builder, [args[0]]), ir.Constant(_I32, 0))

    return types.float32(float32x16), lower


def _transposed(builder: Any, rows: Sequence[Any]) -> list[Any]:
    """Sixteen vectors as the rows of a matrix, transposed by four rounds of butterfly shuffles."""
    vectors = list(rows)
    for group in (1, 2, 4, 8):
        even = [lane if not lane & group else LANES + (lane ^ group) for lane in range(LANES)]
        odd = [lane | group if not lane & group else LANES + lane for lane in range(LANES)]
        swapped: list[Any] = [None] * LANES
        for row in range(LANES):
            if row & group:
                continue
            a, b = vectors[row], vectors[row | group]
            swapped[row] = builder.shuffle_vector(a, b, ir.Constant(_VI, even))
            swapped[row | group] = builder.shuffle_vector(a, b, ir.Constant(_VI, odd))
        vectors = swapped
    return vectors


@intrinsic
def store_transposed(typingctx: Any, array: Any, index: Any, columns: Any) -> Any:
    """Write a tuple of sixteen vectors as the columns of a row-major 16 x 16 matrix that begins at `index`."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        rows = _transposed(builder, [builder.extract_value(args[2], k) for k in range(LANES)])
        for number, row in enumerate(rows):
            at = builder.add(args[1], ir.Constant(_I64, number * LANES))
            builder.store(row, _pointer(context, builder, sig.args[0], args[0], at, _VF), align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, columns), lower


@intrinsic
def load_transposed(typingctx: Any, array: Any, index: Any) -> Any:
    """The columns of the row-major 16 x 16 matrix that begins at `index`, as a tuple of vectors."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        rows = []
        for number in range(LANES):
            at = builder.add(args[1], ir.Constant(_I64, number * LANES))
            rows.append(builder.load(_pointer(context, builder, sig.args[0], args[0], at, _VF), align=4))
        return context.make_tuple(builder, sig.return_type, _transposed(builder, rows))

    return types.UniTuple(float32x16, LANES)(array, types.int64), lower


@intrinsic
def regrouped(typingctx: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Four vectors, as a matrix of 4 x 4 groups of four floats, transposed: blocks side by side to rows of pixels, or back."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        a, b, c, d = args
        low = ir.Constant(_VI, [k + part for k in (0, 4) for part in (0, 1, 2, 3, 16, 17, 18, 19)])
        high = ir.Constant(_VI, [k + part for k in (8, 12) for part in (0, 1, 2, 3, 16, 17, 18, 19)])
        first = ir.Constant(_VI, [*range(8), *range(16, 24)])
        second = ir.Constant(_VI, [*range(8, 16), *range(24, 32)])
        rows = []
        for half in (low, high):
            ab, cd = builder.shuffle_vector(a, b, half), builder.shuffle_vector(c, d, half)
            rows += [builder.shuffle_vector(ab, cd, first), builder.shuffle_vector(ab, cd, second)]
        return context.make_tuple(builder, sig.return_type, rows)

    return types.UniTuple(float32x16, 4)(float32x16, float32x16, float32x16, float32x16), lower


@intrinsic
def stack_floats(typingctx: Any, count: Any) -> Any:
    """Pointer to `count` floats (a literal) on the stack, at the beginning of a cache line.

    As a by-product the function's spilled vectors are aligned too; elsewhere they straddle cache lines at will, which
    made the backward kernel up to 1.5 times slower on some stacks.
    """

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        with builder.goto_entry_block():
            floats = builder.alloca(_F32, ir.Constant(_I64, sig.args[0].literal_value))
        floats.align = 64
        return floats

    return (types.CPointer(types.float32)(count), lower) if isinstance(count, types.IntegerLiteral) else None


@intrinsic
def log2(typingctx: Any, a: Any) -> Any:
    """Binary logarithm of positive normal numbers, absolute error below 2e-7 near 1; else a meaningless number.

    a = 2^e m with m in [sqrt(1/2), sqrt(2)), and ln m = 2 artanh t with t = (m - 1) / (m + 1), an odd series.
    """

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        def integers(value: int) -> ir.Constant:
            return ir.Constant(_VI, [value] * LANES)

        bits = builder.bitcast(args[0], _VI)
        exponent = builder.ashr(builder.sub(bits, integers(0x3F3504F3)), integers(23))  # bits of sqrt(1/2)
        mantissa = builder.bitcast(builder.sub(bits, builder.shl(exponent, integers(23))), _VF)
        one = _constant(1.0)
        t = builder.fdiv(builder.fsub(mantissa, one), builder.fadd(mantissa, one))
        square = builder.fmul(t, t)
        series = _constant(2 / math.log(2) / 9)
        for power in (7, 5, 3, 1):
            series = _fma(builder, series, square, _constant(2 / math.log(2) / power))
        return _fma(builder, series, t, builder.sitofp(exponent, _VF))

    return float32x16(float32x16), lower


@intrinsic
def gather(typingctx: Any, array: Any, start: Any, index: Any) -> Any:
    """Lane by lane `array[start + index]` of a flat float32 array; the index is truncated.

    Sixteen loads: they work anywhere, and a Zen 5 takes 5.9 ns for them, 9.2 ns for its own gather.
    """

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        array_value, start_value, index_value = args
        first = _pointer(context, builder, sig.args[0], array_value, start_value, _F32)
        integers = builder.fptosi(index_value, _VI)
        gathered = ir.Constant(_VF, ir.Undefined)
        for lane in range(LANES):
            number = ir.Constant(_I32, lane)
            value = builder.load(builder.gep(first, [builder.extract_element(integers, number)]), align=4)
            gathered = builder.insert_element(gathered, value, number)
        return gathered

    return float32x16(array, types.int64, float32x16), lower


@intrinsic
def gather_squares(typingctx: Any, image: Any, pitch: Any, x: Any, y: Any) -> Any:
    """Lane by lane the pixels (x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1), as for bilinear interpolation.

    `image` holds four float32 channels a pixel, side by side, and `pitch` floats a row; x and y are truncated. Gives
    sixteen vectors: pixel after pixel, each with its channels. Two loads a lane and a transposition, about the time
    of three `gather`s.
    """

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        image_value, pitch_value, x_value, y_value = args
        undefined = ir.Constant(_VI, ir.Undefined)
        row = builder.insert_element(undefined, builder.trunc(pitch_value, _I32), ir.Constant(_I32, 0))
        rows = builder.shuffle_vector(row, undefined, ir.Constant(_VI, [0] * LANES))
        columns = builder.mul(builder.fptosi(x_value, _VI), ir.Constant(_VI, [4] * LANES))
        starts = builder.add(builder.mul(builder.fptosi(y_value, _VI), rows), columns)
        two_pixels, both_rows = ir.VectorType(_F32, 8), ir.Constant(_VI, list(range(LANES)))
        squares = []
        for lane in range(LANES):
            start = builder.sext(builder.extract_element(starts, ir.Constant(_I32, lane)), _I64)
            above, below = (
                builder.load(_pointer(context, builder, sig.args[0], image_value, at, two_pixels), align=4)
                for at in (start, builder.add(start, pitch_value))
            )
            squares.append(builder.shuffle_vector(above, below, both_rows))
        return context.make_tuple(builder, sig.return_type, _transposed(builder, squares))

    return types.UniTuple(float32x16, LANES)(image, types.int64, float32x16, float32x16), lower
