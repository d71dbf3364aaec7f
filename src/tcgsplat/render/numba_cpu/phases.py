"""Sharing a kernel of several phases over threads without going back to Python between them.

Every thread runs the same kernel. A phase consists of units; a thread takes one after the other from a shared counter
until none is left, and goes on to the next phase when all are finished. Nobody waits for a thread to arrive, only for
units that one is working on: a late thread joins where the others are, and one alone gets everything done. A thread
that has waited for long gives up, so that Python may let others run, and simply starts again: phases that are over
have no units left.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

from tcgsplat.render.numba_cpu.compilation import inner

OVER, WAITING = -1, -2
"""What `next_unit` gives when there is no unit: all are finished, or others have been working on some for long."""
BEGIN, DONE = np.int64(0), np.int64(1)
"""What `next_unit` is told: whether the caller has just finished a unit. (Of literal numbers numba would compile each.)"""
COUNTERS = 16
"""Integers of `progress` for each phase: units taken and, on another cache line, units finished."""
_FINISHED = 8
_PATIENCE = 20_000
"""Looks at the counter before giving up: some tenths of a millisecond."""


def _counter(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.gep(make_array(sig.args[0])(context, builder, args[0]).data, [args[1]], inbounds=True)


@intrinsic
def _add(typingctx: Any, array: Any, index: Any) -> Any:
    """Count one up; gives the count before. What was written before is seen by those who see the count."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        one = ir.Constant(ir.IntType(64), 1)
        return builder.atomic_rmw("add", _counter(context, builder, sig, args), one, "acq_rel")

    return types.int64(array, types.int64), lower


@intrinsic
def _look(typingctx: Any, array: Any, index: Any) -> Any:
    """Read a count, after a breath."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if "x86" in builder.module.triple:
            pause = ir.FunctionType(ir.VoidType(), [])
            builder.call(cgutils.get_or_insert_function(builder.module, pause, "llvm.x86.sse2.pause"), [])
        return builder.load_atomic(_counter(context, builder, sig, args), "acquire", 8)

    return types.int64(array, types.int64), lower


@inner
def next_unit(progress, phase, units, finished):  # type: ignore[no-untyped-def]
    """The next of a phase's units (0 .. units-1), or OVER, or WAITING; `finished` is BEGIN or DONE."""
    at = np.int64(phase) * COUNTERS
    if finished:
        _add(progress, at + _FINISHED)
    if units == 0:
        return OVER
    unit = _add(progress, at)
    if unit < units:
        return unit
    for _ in range(_PATIENCE):
        if _look(progress, at + _FINISHED) >= units:
            return OVER
    return WAITING
