"""Compiling kernels while torch is imported: this module imports none of it."""

import gc
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

from tcgsplat.cli.logs import say
from tcgsplat.render.numba_cpu.compilation import compiled, kernels_of
from tcgsplat.render.numba_cpu.workers import available_cores

MODULES: Final = (
    "tcgsplat.render.numba_cpu.pass_kernels",
    "tcgsplat.mapping.loss_kernels",
    "tcgsplat.mapping.native_kernels",
    "tcgsplat.tracking.alignment_kernels",
    "tcgsplat.mapping.seeding_kernels",
    "tcgsplat.tracking.synchronization_kernels",
    "tcgsplat.tracking.smoothing_kernels",
)
"""What a run on the CPU draws on; what takes long to compile first, so that processes finish together."""
ANNOUNCEMENT: Final = "compiling kernels, once per machine: some seconds"


@dataclass
class Waited:
    """Seconds that compiling made somebody wait for."""

    seconds: float = 0.0


@contextmanager
def compiled_meanwhile() -> Iterator[Waited]:
    """Compile what is missing beside what is done inside, which should be long imports; says so if there is any.

    Gives how long it took beyond that, once it is over.
    """
    with _as_if_missing("scipy.linalg.cython_blas"):  # which numba takes 0.1 s to import, for products of matrices
        waited, kernels = Waited(), [kernel for kernel in kernels_of(MODULES) if not kernel.kept]
    if kernels:
        say(ANNOUNCEMENT)
    with compiled(kernels, available_cores()), _here_to_stay():
        yield waited
        inside = time.perf_counter()
    waited.seconds = time.perf_counter() - inside


@contextmanager
def _as_if_missing(module: str) -> Iterator[None]:
    """Whoever imports it inside finds that it is not installed, unless it is there already."""
    absent = module not in sys.modules
    if absent:
        sys.modules[module] = None  # type: ignore[assignment]  # what Python itself puts there to say so
    try:
        yield
    finally:
        if absent:
            del sys.modules[module]


@contextmanager
def _here_to_stay() -> Iterator[None]:
    """Python looks for no garbage inside, nor ever again among what was made there: imports make 340 000 objects.

    Only where they are made indeed: if torch was imported before, what is around may be garbage some day.
    """
    if "torch" in sys.modules:
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
