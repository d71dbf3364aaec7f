"""How kernels are compiled, side by side in several processes, and kept on disk.

Numba keeps a compiled function until its own file changes. It does not look into the files of the functions and the
constants that went into it, and would go on to use old ones, even where callers and callees no longer agree on their
arguments. So what it remembers of a kernel's file here also says which sources there were.
"""

import gc
import hashlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen
from threading import Thread
from typing import Any, Final

from numba import njit
from numba.core import sigutils

FLAGS: Final = ("contract", "nsz", "arcp")
"""What arithmetic may do: contraction to fused multiply-adds, and reciprocals. No reassociation: the rounding trick of
`simd.exp2` must survive."""
_OPTIONS: Final[dict[str, Any]] = {
    "fastmath": set(FLAGS),
    "error_model": "numpy",
    "nogil": True,
    "no_cfunc_wrapper": True,
}

_MOST_PROCESSES: Final = 4
"""With more, all but one would wait for the kernel that takes longest."""

inner: Final = njit(**_OPTIONS | {"no_cpython_wrapper": True, "forceinline": True})
"""Of functions that only kernels call, and are written into: without a way in from elsewhere they compile faster. Where
one stayed a function, a kernel would call another copy of it when it has just been compiled than when it comes from
disk, and the two may round differently."""


def _digest() -> str:
    """Of this folder's sources, of the kernels of other packages, and of where they have constants from."""
    package = Path(__file__).parents[2]
    patterns = (
        "render/numba_cpu/*.py",
        "*/*_kernels.py",
        "render/conventions.py",
        "mapping/adam.py",
        "scene/harmonics.py",
    )
    sources = sorted(path for pattern in patterns for path in package.glob(pattern))
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()


_SOURCES = _digest()


def kernel(types: str) -> Callable[[Any], Any]:
    """A kernel that Python calls, always with arguments of these types (as numba writes them: "f4[::1], i8").

    It is compiled when it is first called, or in `compiled`, and anew when any of the sources is another.
    """

    def decorate(function: Any) -> Any:
        dispatcher: Any = njit(**_OPTIONS, cache=True)(function)
        index = dispatcher._cache._cache_file
        index._source_stamp = index._source_stamp, _SOURCES
        dispatcher.types, _ = sigutils.normalize_signature(f"({types},)")  # type: ignore[no-untyped-call]
        return dispatcher

    return decorate


@dataclass(frozen=True)
class Kernel:
    """A kernel by where it is, so that another process can find it."""

    module: str
    name: str

    @property
    def dispatcher(self) -> Any:
        """What numba made of the function."""
        return getattr(import_module(self.module), self.name)

    @property
    def kept(self) -> bool:
        """Whether a compiled one is on disk."""
        dispatcher = self.dispatcher
        cache = dispatcher._cache
        dispatcher.targetctx.refresh()
        key = cache._index_key(dispatcher.types, dispatcher.targetctx.codegen())
        return key in cache._cache_file._load_index()

    def compile(self) -> None:
        """Compile it and keep it on disk, if it is not there yet."""
        dispatcher = self.dispatcher
        dispatcher.compile(dispatcher.types)


def kernels_of(modules: Sequence[str]) -> list[Kernel]:
    """Every `kernel` that is defined in these modules."""
    found = []
    for module in modules:
        for name, value in vars(import_module(module)).items():
            if hasattr(value, "types") and hasattr(value, "py_func") and value.py_func.__module__ == module:
                found.append(Kernel(module, name))
    return found


@contextmanager
def compiled(kernels: Sequence[Kernel], processes: int) -> Iterator[None]:
    """Have kernels compiled by the end: by other processes while inside, and at last by this one too.

    The others import nothing but kernels. (Numba has one lock around its compiler: threads would wait for each other.)
    What one of them could not do, for whatever reason, is left to this process's first call.
    """
    left, helping = iter(kernels), min(processes, len(kernels), _MOST_PROCESSES) - 1
    helpers = [Thread(target=_compile_elsewhere, args=(left,), daemon=True) for _ in range(helping)]
    for helper in helpers:
        helper.start()
    yield
    with _uncollected():
        for kernel in left:
            kernel.compile()
    for helper in helpers:
        helper.join()


@contextmanager
def _uncollected() -> Iterator[None]:
    """Without the collector of garbage: it looks at all that torch has made, again and again as the compiler makes more."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


def _compile_elsewhere(kernels: Iterator[Kernel]) -> None:
    """Have another process compile one kernel after the other, until none is left or it fails."""
    command = [sys.executable, "-c", f"import {__name__} as compilation; compilation.compile_as_told()"]
    with suppress(OSError), Popen(command, stdin=PIPE, stdout=PIPE, stderr=DEVNULL, text=True, bufsize=1) as other:
        assert other.stdin is not None
        assert other.stdout is not None
        for kernel in kernels:
            other.stdin.write(f"{kernel.module} {kernel.name}\n")
            if not other.stdout.readline():
                return


def compile_as_told() -> None:
    """Compile the kernels that are named on standard input, a line each, and answer each with a line."""
    gc.disable()
    for line in sys.stdin:
        Kernel(*line.split()).compile()
        os.write(sys.stdout.fileno(), b"compiled\n")
    os._exit(0)  # taking the compiler down properly takes half a second
