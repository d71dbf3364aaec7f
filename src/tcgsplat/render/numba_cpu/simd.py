"""Formulas of sixteen floats at a time, for kernels: Python functions that run once, while a kernel is compiled.

`Float32x16` is an LLVM `<16 x float>`: with AVX-512 one register, on other processors LLVM splits it into the widest
registers there are, with the same results up to the rounding of fused multiply-adds. Loops that keep sums in such
values across iterations are what numba's own loop vectorisation cannot make.

In a kernel, `Float32x16` values know the four operations, with numbers or each other, and every `formula`. A formula
is called with `Vector`s when a kernel that uses it is compiled, and what is done to them becomes instructions of that
kernel. So it may be any Python: tuples, comprehensions, other formulas; but nothing in it can depend on a vector's
value. Numba sees one call, where it would have taken a millisecond to find the type of each operation.
"""

import math
import operator
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, ClassVar, TypeVar

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import models, register_model

from tcgsplat.render.numba_cpu.compilation import FLAGS

LANES = 16
F32, I32 = ir.FloatType(), ir.IntType(32)
VECTOR, INTEGERS = ir.VectorType(F32, LANES), ir.VectorType(I32, LANES)
Number = float | np.float32


class Float32x16(types.Type):
    """Numba type of a `<16 x float>`."""

    def __init__(self) -> None:
        super().__init__(name="Float32x16")


float32x16 = Float32x16()


@register_model(Float32x16)
class _Float32x16Model(models.PrimitiveModel):
    def __init__(self, manager: Any, fe_type: Any) -> None:
        super().__init__(manager, fe_type, VECTOR)


def spread_value(builder: Any, scalar: Any) -> Any:
    """A scalar LLVM value in all lanes of a vector of its type."""
    undefined = ir.Constant(ir.VectorType(scalar.type, LANES), ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(I32, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(INTEGERS, [0] * LANES))


class Vector:
    """Sixteen floats of a kernel that is being compiled: arithmetic on them writes the kernel's instructions."""

    __slots__ = ("builder", "value")
    __array_ufunc__ = None  # so that NumPy's numbers leave operations with vectors to them

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    def of(self, value: Any) -> "Vector":
        """Another vector of the same kernel: an LLVM value, or a number for all lanes."""
        if isinstance(value, Vector):
            return value
        if not isinstance(value, ir.Value):
            value = ir.Constant(VECTOR, [float(np.float32(value))] * LANES)
        return Vector(self.builder, value)

    def instruction(self, name: str, *others: "Vector | Number", flags: Sequence[str] = FLAGS) -> "Vector":
        """One of LLVM's arithmetic instructions, with this vector first."""
        values = (self.of(other).value for other in others)
        return self.of(getattr(self.builder, name)(self.value, *values, flags=flags))

    def function(self, name: str, *others: "Vector | Number") -> "Vector":
        """One of LLVM's functions of vectors, by its name without `llvm.` and type."""
        values = [self.value, *(self.of(other).value for other in others)]
        kind = ir.FunctionType(VECTOR, [VECTOR] * len(values))
        name = f"llvm.{name}.v{LANES}f32"
        return self.of(self.builder.call(cgutils.get_or_insert_function(self.builder.module, kind, name), values))

    def where(
        self, comparison: str, other: "Vector | Number", yes: "Vector | Number", no: "Vector | Number"
    ) -> "Vector":
        """Lane by lane, `yes` where the comparison holds, else `no`; with NaN it does not."""
        holds = self.builder.fcmp_ordered(comparison, self.value, self.of(other).value)
        return self.of(self.builder.select(holds, self.of(yes).value, self.of(no).value))

    def __add__(self, other: "Vector | Number") -> "Vector":
        return self.instruction("fadd", other)

    def __radd__(self, other: Number) -> "Vector":
        return self.of(other) + self

    def __sub__(self, other: "Vector | Number") -> "Vector":
        return self.instruction("fsub", other)

    def __rsub__(self, other: Number) -> "Vector":
        return self.of(other) - self

    def __mul__(self, other: "Vector | Number") -> "Vector":
        return self.instruction("fmul", other)

    def __rmul__(self, other: Number) -> "Vector":
        return self.of(other) * self

    def __truediv__(self, other: "Vector | Number") -> "Vector":
        return self.instruction("fdiv", other)

    def __rtruediv__(self, other: Number) -> "Vector":
        return self.of(other) / self

    def __neg__(self) -> "Vector":
        return self.of(0) - self

    def shuffled(self, lanes: Sequence[int], other: "Vector") -> "Vector":
        """These lanes of this vector, which are 0 to 15, and of another, 16 to 31."""
        return self.of(self.builder.shuffle_vector(self.value, other.value, ir.Constant(INTEGERS, list(lanes))))

    def bits(self) -> Any:
        """The LLVM integers that these floats are."""
        return self.builder.bitcast(self.value, INTEGERS)


Vectors = tuple[Vector, ...]


def _accepted(kind: Any) -> bool:
    """Whether formulas take arguments of this type."""
    if isinstance(kind, types.BaseTuple):
        return all(_accepted(part) for part in kind.types)
    return kind in (float32x16, types.float32) or (isinstance(kind, types.Integer) and kind.signed)


def _argument(kind: Any, value: Any, builder: Any) -> Any:
    """A kernel's value as formulas take it."""
    if isinstance(kind, types.BaseTuple):
        return tuple(_argument(part, builder.extract_value(value, k), builder) for k, part in enumerate(kind.types))
    if isinstance(kind, types.Integer):
        value, kind = builder.sitofp(value, F32), types.float32
    return Vector(builder, spread_value(builder, value) if kind == types.float32 else value)


def _unknown(kind: Any, builder: Any) -> Any:
    """An argument of a type, good enough to find out what a formula gives."""
    if isinstance(kind, types.BaseTuple):
        return tuple(_unknown(part, builder) for part in kind.types)
    return Vector(builder, ir.Constant(VECTOR, ir.Undefined))


def _type(result: Any) -> Any:
    """Numba's type of what a formula gives."""
    return types.BaseTuple.from_types(tuple(map(_type, result))) if isinstance(result, tuple) else float32x16


def _value(context: Any, builder: Any, result: Any) -> Any:
    """What a formula gives as the kernel's value."""
    if not isinstance(result, tuple):
        return result.value
    return context.make_tuple(builder, _type(result), [_value(context, builder, part) for part in result])


def _let_kernels_call(function: Any, accepted: Callable[[Any], bool], *cases: Any) -> None:
    """Have numba compile calls of `function` as what Python does to vectors; `cases` are numba's types to do it for."""

    @cache
    def typed(args: tuple[Any, ...]) -> Any:
        if not accepted(args):
            return None
        scratch = ir.Function(ir.Module(), ir.FunctionType(ir.VoidType(), []), "scratch")
        builder = ir.IRBuilder(scratch.append_basic_block())
        return signature(_type(function(*(_unknown(kind, builder) for kind in args))), *args)

    class Template(AbstractTemplate):
        key = function
        # What is for this target is tried before numba's own dozen of general cases: compiling takes a quarter less.
        metadata: ClassVar = {"target": "cpu"}

        def generic(self, args: Any, kws: Any) -> Any:
            return None if kws else typed(tuple(args))

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vectors = (_argument(kind, arg, builder) for kind, arg in zip(sig.args, args, strict=True))
        return _value(context, builder, function(*vectors))

    infer_global(function, types.Function(Template))
    for case in cases:
        lower_builtin(function, *case)(lower)


_Function = TypeVar("_Function", bound=Callable[..., Any])


def formula(function: _Function) -> _Function:
    """Let kernels call a Python function of vectors.

    A kernel may pass `Float32x16` values, numbers (float32 or signed integers, which the formula sees as vectors that
    have them in every lane), and tuples of these. What it gets are `Float32x16` values, one or nested tuples of them.
    """
    _let_kernels_call(function, lambda args: all(map(_accepted, args)), (types.VarArg(types.Any),))
    return function


def _register_operators() -> None:
    kinds = (float32x16, types.float32, types.int64)
    cases = {(a, b) for a in kinds for b in kinds if float32x16 in (a, b)}  # numba has its own for two numbers
    for function in (operator.add, operator.sub, operator.mul, operator.truediv):
        _let_kernels_call(function, cases.__contains__, *cases)


_register_operators()


@formula
def spread(a: Vector) -> Vector:
    """Vector with a kernel's number in every lane."""
    return a


@formula
def ramp(start: Vector, step: Vector) -> Vector:
    """Start, start + step, start + 2 step ..."""
    return start + step * Vector(start.builder, ir.Constant(VECTOR, [float(lane) for lane in range(LANES)]))


@formula
def fma(a: Vector, b: Vector, c: Vector) -> Vector:
    """A * b + c, fused where the processor can (llvm.fmuladd: never a library call)."""
    return a.function("fmuladd", b, c)


@formula
def minimum(a: Vector, b: Vector) -> Vector:
    """Lane by lane, the smaller."""
    return a.where("<", b, a, b)


@formula
def maximum(a: Vector, b: Vector) -> Vector:
    """Lane by lane, the larger."""
    return a.where(">", b, a, b)


@formula
def where_ge(a: Vector, b: Vector, yes: Vector, no: Vector) -> Vector:
    """Lane by lane, `yes` where a >= b, else `no`."""
    return a.where(">=", b, yes, no)


@formula
def sqrt(a: Vector) -> Vector:
    """Lane by lane square root."""
    return a.function("sqrt")


@formula
def floor(a: Vector) -> Vector:
    """Lane by lane, the largest integer that is not larger."""
    return a.function("floor")


@formula
def apart(a: Vector, b: Vector) -> Vector:
    """Lane by lane, |a - b|."""
    return maximum(a - b, b - a)


@formula
def dot(a: Vectors, b: Vectors) -> Vector:
    """Scalar product, lane by lane."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = fma(x, y, total)
    return total


@formula
def product(a: Vectors, b: Vectors) -> Vectors:
    """Matrix product of two 3 x 3 matrices, lane by lane; tuples of nine, row by row."""
    return tuple(dot(a[3 * row : 3 * row + 3], b[column::3]) for row in range(3) for column in range(3))


@formula
def transposed(a: Vectors) -> Vectors:
    """Transpose of a 3 x 3 matrix, a tuple of nine."""
    return tuple(a[3 * column + row] for row in range(3) for column in range(3))


@formula
def times_columns(a: Vectors, scales: Vectors) -> Vectors:
    """A 3 x 3 matrix, a tuple of nine, with its columns multiplied by the three of `scales`."""
    return tuple(entry * scales[k % 3] for k, entry in enumerate(a))


def _exp2_coefficients(degree: int = 5) -> list[float]:
    """2^x on [-0.5, 0.5] as a polynomial of least relative error (Chebyshev nodes), highest power first."""
    x = 0.5 * np.cos(np.pi * (np.arange(256) + 0.5) / 256)
    vandermonde = np.vander(x, degree + 1) / np.exp2(x)[:, None]
    return [float(c) for c in np.linalg.lstsq(vandermonde, np.ones_like(x), rcond=None)[0]]


_EXP2 = _exp2_coefficients()


def _integers(value: int) -> Any:
    return ir.Constant(INTEGERS, [value] * LANES)


@formula
def exp2(a: Vector) -> Vector:
    """2^a for -126 < a < 127, relative error below 3e-7; outside, a meaningless number (select it away).

    Adding 1.5 * 2^23 rounds to the nearest integer in the low bits of the mantissa; shifted into the exponent, those
    bits scale the polynomial of the remainder.
    """
    builder, magic = a.builder, 12582912.0
    shifted = a.instruction("fadd", magic, flags=())  # no flags: must not be folded
    remainder = a.instruction("fsub", shifted.instruction("fsub", magic, flags=()), flags=())
    # Pairs of terms side by side: the kernels wait for latency more than for arithmetic.
    high, middle, low = (a.of(_EXP2[k]).function("fmuladd", remainder, _EXP2[k + 1]) for k in (0, 2, 4))
    square = remainder.instruction("fmul", remainder, flags=())
    power = fma(fma(high, square, middle), square, low)
    exponent = builder.shl(shifted.bits(), _integers(23))
    return a.of(builder.bitcast(builder.add(power.bits(), exponent), VECTOR))


@formula
def log2(a: Vector) -> Vector:
    """Binary logarithm of positive normal numbers, absolute error below 2e-7 near 1; else a meaningless number.

    a = 2^e m with m in [sqrt(1/2), sqrt(2)), and ln m = 2 artanh t with t = (m - 1) / (m + 1), an odd series.
    """
    builder, bits = a.builder, a.bits()
    exponent = builder.ashr(builder.sub(bits, _integers(0x3F3504F3)), _integers(23))  # bits of sqrt(1/2)
    mantissa = a.of(builder.bitcast(builder.sub(bits, builder.shl(exponent, _integers(23))), VECTOR))
    t = mantissa.instruction("fsub", 1, flags=()).instruction(
        "fdiv", mantissa.instruction("fadd", 1, flags=()), flags=()
    )
    square = t.instruction("fmul", t, flags=())
    series = a.of(2 / math.log(2) / 9)
    for power in (7, 5, 3, 1):
        series = fma(series, square, a.of(2 / math.log(2) / power))
    return fma(series, t, a.of(builder.sitofp(exponent, VECTOR)))
