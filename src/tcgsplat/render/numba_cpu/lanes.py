"""Memory to vectors and back, and what goes across their lanes; arithmetic is in `simd.py`."""

from functools import partial
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

from tcgsplat.render.numba_cpu.simd import (
    F32,
    INTEGERS,
    LANES,
    VECTOR,
    Vector,
    Vectors,
    float32x16,
    formula,
    spread_value,
)

_I1, _I16, _I32, _I64 = ir.IntType(1), ir.IntType(16), ir.IntType(32), ir.IntType(64)
_BITS = ir.VectorType(_I1, LANES)


def _pointer(
    context: Any, builder: Any, array_type: Any, array: Any, index: Any, pointee: Any, inside: bool = True
) -> Any:
    data = make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index], inbounds=inside), pointee.as_pointer())


@intrinsic
def load(typingctx: Any, array: Any, index: Any) -> Any:
    """The sixteen floats of a flat array that begin at `index`."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_pointer(context, builder, sig.args[0], args[0], args[1], VECTOR), align=4)

    return float32x16(array, types.int64), lower


@intrinsic
def store(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """Write sixteen floats to a flat array from `index` on."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _pointer(context, builder, sig.args[0], args[0], args[1], VECTOR), align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, float32x16), lower


@intrinsic
def store_int32_pairs(typingctx: Any, array: Any, index: Any, first: Any, second: Any) -> Any:
    """Truncate two vectors to integers and write them to a flat array of 32-bit integers, side by side lane by lane."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        integers = [builder.fptosi(value, INTEGERS) for value in args[2:]]
        interleaved = [k // 2 + LANES * (k % 2) for k in range(2 * LANES)]
        pairs = ir.VectorType(_I32, 2 * LANES)
        both = builder.shuffle_vector(*integers, ir.Constant(pairs, interleaved))
        builder.store(both, _pointer(context, builder, sig.args[0], args[0], args[1], pairs), align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, float32x16, float32x16), lower


def _first_lanes(builder: Any, count: Any) -> Any:
    """Which lanes come before `count`, an int64."""
    lanes = ir.Constant(INTEGERS, list(range(LANES)))
    return builder.icmp_signed("<", lanes, spread_value(builder, builder.trunc(count, _I32)))


@intrinsic
def load_first(typingctx: Any, array: Any, index: Any, count: Any) -> Any:
    """The `count` floats from `index` on in the first lanes, 0 in the rest, of which memory is not touched.

    Less than 1 is none, more than sixteen are all.
    """

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = ir.FunctionType(VECTOR, [VECTOR.as_pointer(), _I32, _BITS, VECTOR])
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.masked.load.v{LANES}f32.p0")
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1], VECTOR, inside=False)
        return builder.call(
            function,
            [pointer, ir.Constant(_I32, 4), _first_lanes(builder, args[2]), ir.Constant(VECTOR, [0.0] * LANES)],
        )

    return float32x16(array, types.int64, types.int64), lower


@intrinsic
def store_first(typingctx: Any, array: Any, index: Any, value: Any, count: Any) -> Any:
    """Write the first `count` lanes from `index` on, and nothing else."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.VoidType(), [VECTOR, VECTOR.as_pointer(), _I32, _BITS])
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.masked.store.v{LANES}f32.p0")
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1], VECTOR, inside=False)
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
            rows.append(builder.load(_pointer(context, builder, sig.args[0], args[0], at, VECTOR), align=4))
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
            builder.store(row, _pointer(context, builder, sig.args[0], args[0], at, VECTOR), align=4)
            at = builder.add(at, args[2])
        return context.get_dummy_value()

    return types.void(array, types.int64, types.int64, rows), lower


@intrinsic
def add_rows(typingctx: Any, array: Any, index: Any, pitch: Any, rows: Any) -> Any:
    """Add a tuple of vectors to what is at index, index + pitch, ..."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        at = args[1]
        for k in range(sig.args[3].count):
            pointer = _pointer(context, builder, sig.args[0], args[0], at, VECTOR)
            total = Vector(builder, builder.load(pointer, align=4)) + Vector(builder, builder.extract_value(args[3], k))
            builder.store(total.value, pointer, align=4)
            at = builder.add(at, args[2])
        return context.get_dummy_value()

    return types.void(array, types.int64, types.int64, rows), lower


@intrinsic
def load_spread(typingctx: Any, array: Any, index: Any, count: Any) -> Any:
    """Tuple of `count` (a literal) vectors: one float of the array in every lane, then the next."""
    if not isinstance(count, types.IntegerLiteral):
        return None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        first = _pointer(context, builder, sig.args[0], args[0], args[1], F32)
        floats = [
            builder.load(builder.gep(first, [ir.Constant(_I64, k)]), align=4) for k in range(sig.args[2].literal_value)
        ]
        return context.make_tuple(builder, sig.return_type, [spread_value(builder, value) for value in floats])

    return types.UniTuple(float32x16, count.literal_value)(array, types.int64, count), lower


@intrinsic
def mask_ge(typingctx: Any, a: Any, b: Any) -> Any:
    """Bit k is set where a >= b in lane k (int32)."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(builder.fcmp_ordered(">=", args[0], args[1]), _I16)
        return builder.zext(bits, _I32)

    return types.int32(float32x16, float32x16), lower


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
        lanes = ir.Constant(INTEGERS, list(range(LANES)))

        masks_pointer = _pointer(context, builder, sig.args[2], masks_value, start_value, INTEGERS)
        has_bit = builder.icmp_signed(
            "!=",
            builder.and_(builder.load(masks_pointer, align=4), spread_value(builder, bit_value)),
            ir.Constant(INTEGERS, [0] * LANES),
        )
        inside = builder.icmp_signed("<", lanes, spread_value(builder, length_value))
        chosen = builder.and_(has_bit, inside)
        pointer = _pointer(context, builder, sig.args[0], out_value, count_value, _I32)
        first = builder.trunc(start_value, _I32)
        bits = builder.bitcast(chosen, _I16)
        if "+avx512f" in context.codegen().magic_tuple()[2]:
            # In a register: straight to memory takes some processors a hundred cycles.
            compress = cgutils.get_or_insert_function(
                builder.module,
                ir.FunctionType(INTEGERS, [INTEGERS, INTEGERS, _BITS]),
                f"llvm.x86.avx512.mask.compress.v{LANES}i32",
            )
            indices = builder.add(lanes, spread_value(builder, first))
            compressed = builder.call(compress, [indices, ir.Constant(INTEGERS, [0] * LANES), chosen])
            builder.store(compressed, builder.bitcast(pointer, INTEGERS.as_pointer()), align=4)
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


@formula
def lane_sums(vectors: Vectors) -> Vector:
    """Vector whose lane k holds the sum of all lanes of the k-th vector of a tuple (up to sixteen; the rest 0).

    log2(16) rounds of halving, in fixed order.
    """
    level: list[Vector | None] = [*vectors, *([None] * (LANES - len(vectors)))]
    for group in (8, 4, 2, 1):
        half = len(level) // 2
        low, high = _halves(group)
        level = [
            None if a is None else a.shuffled(low, b or a.of(0)) + a.shuffled(high, b or a.of(0))
            for a, b in zip(level[:half], level[half:], strict=True)
        ]
    assert level[0] is not None
    return level[0]


@intrinsic
def sum_lanes(typingctx: Any, a: Any) -> Any:
    """Sum over the sixteen lanes, in a fixed order."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.extract_element(lane_sums((Vector(builder, args[0]),)).value, ir.Constant(_I32, 0))

    return types.float32(float32x16), lower


@formula
def columns_of(rows: Vectors) -> Vectors:
    """Sixteen vectors as the rows of a matrix, transposed by four rounds of butterfly shuffles."""
    vectors = list(rows)
    for group in (1, 2, 4, 8):
        even = [lane if not lane & group else LANES + (lane ^ group) for lane in range(LANES)]
        odd = [lane | group if not lane & group else LANES + lane for lane in range(LANES)]
        for row in range(LANES):
            if not row & group:
                a, b = vectors[row], vectors[row | group]
                vectors[row], vectors[row | group] = a.shuffled(even, b), a.shuffled(odd, b)
    return tuple(vectors)


@formula
def even_and_odd(a: Vector, b: Vector) -> Vectors:
    """Every other float of two vectors one after the other, from the first and from the second on."""
    return a.shuffled(range(0, 2 * LANES, 2), b), a.shuffled(range(1, 2 * LANES, 2), b)


@formula
def side_by_side(a: Vector, b: Vector, c: Vector, d: Vector) -> Vectors:
    """First lanes of all four, then second lanes ...: four planes to pixels of four channels."""
    halves = [([lane for k in range(4) for lane in (first + k, LANES + first + k)]) for first in (0, 4, 8, 12)]
    pairs = [(a.shuffled(half + half, b), c.shuffled(half + half, d)) for half in halves]
    mixed = [lane for k in range(4) for lane in (2 * k, 2 * k + 1, LANES + 2 * k, LANES + 2 * k + 1)]
    return tuple(ab.shuffled(mixed, cd) for ab, cd in pairs)


@formula
def regrouped(a: Vector, b: Vector, c: Vector, d: Vector) -> Vectors:
    """Four vectors, as a matrix of 4 x 4 groups of four floats, transposed: blocks side by side to rows of pixels, or back."""
    low, high = ([k + part for k in starts for part in (0, 1, 2, 3, 16, 17, 18, 19)] for starts in ((0, 4), (8, 12)))
    first, second = [*range(8), *range(16, 24)], [*range(8, 16), *range(24, 32)]
    halves = [(a.shuffled(half, b), c.shuffled(half, d)) for half in (low, high)]
    return tuple(ab.shuffled(part, cd) for ab, cd in halves for part in (first, second))


@intrinsic
def stack_floats(typingctx: Any, count: Any) -> Any:
    """Pointer to `count` floats (a literal) on the stack, at the beginning of a cache line.

    As a by-product the function's spilled vectors are aligned too; elsewhere they straddle cache lines at will, which
    made the backward kernel up to 1.5 times slower on some stacks.
    """

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        with builder.goto_entry_block():
            floats = builder.alloca(F32, ir.Constant(_I64, sig.args[0].literal_value))
        floats.align = 64
        return floats

    return (types.CPointer(types.float32)(count), lower) if isinstance(count, types.IntegerLiteral) else None


@intrinsic
def gather(typingctx: Any, array: Any, start: Any, index: Any) -> Any:
    """Lane by lane `array[start + index]` of a flat float32 array; the index is truncated.

    Sixteen loads: they work anywhere, and a Zen 5 takes 5.9 ns for them, 9.2 ns for its own gather.
    """

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        array_value, start_value, index_value = args
        first = _pointer(context, builder, sig.args[0], array_value, start_value, F32)
        integers = builder.fptosi(index_value, INTEGERS)
        gathered = ir.Constant(VECTOR, ir.Undefined)
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
        rows = spread_value(builder, builder.trunc(pitch_value, _I32))
        columns = builder.mul(builder.fptosi(x_value, INTEGERS), ir.Constant(INTEGERS, [4] * LANES))
        starts = builder.add(builder.mul(builder.fptosi(y_value, INTEGERS), rows), columns)
        two_pixels, both_rows = ir.VectorType(F32, 8), ir.Constant(INTEGERS, list(range(LANES)))
        squares = []
        for lane in range(LANES):
            start = builder.sext(builder.extract_element(starts, ir.Constant(_I32, lane)), _I64)
            above, below = (
                builder.load(_pointer(context, builder, sig.args[0], image_value, at, two_pixels), align=4)
                for at in (start, builder.add(start, pitch_value))
            )
            squares.append(Vector(builder, builder.shuffle_vector(above, below, both_rows)))
        return context.make_tuple(builder, sig.return_type, [channel.value for channel in columns_of(tuple(squares))])

    return types.UniTuple(float32x16, LANES)(image, types.int64, float32x16, float32x16), lower
