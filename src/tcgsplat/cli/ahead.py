"""Compiling kernels while torch is imported: this module imports none of it."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Final

from tcgsplat.cli.imports import as_if_missing, here_to_stay, import_torch, load_meanwhile
from tcgsplat.cli.logs import say
from tcgsplat.render.numba_cpu.workers import available_cores

UNNEEDED: Final = ("scipy", "scipy.linalg.cython_blas", "yaml")
"""What numba imports where it finds it, 0.1 s: for products of matrices, and for a file of settings."""
with as_if_missing(*UNNEEDED):
    from tcgsplat.render.numba_cpu.compilation import compiled, kernels_of

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
PURE: Final = ("rich.progress", "torchgen.model")
"""Of what is imported sooner or later, big modules that hold no library: nothing waits for them while those load."""
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
    with as_if_missing(*UNNEEDED):
        all_kernels = kernels_of(MODULES)
        load_meanwhile()
        waited, kernels = Waited(), [kernel for kernel in all_kernels if not kernel.kept]
    if kernels:
        say(ANNOUNCEMENT)
    with compiled(kernels, available_cores()), here_to_stay():
        for module in PURE:
            import_module(module)
        import_torch()
        yield waited
        inside = time.perf_counter()
    waited.seconds = time.perf_counter() - inside
