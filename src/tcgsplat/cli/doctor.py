"""`tcgsplat doctor`: which backend this machine can use, why not another, and what to do about it."""

import importlib.util
import os
import platform
import sys
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path


@dataclass(frozen=True)
class Args:
    """Look at this machine; needs no arguments."""


@dataclass(frozen=True)
class Finding:
    """What is known of one backend, or of what is not always installed."""

    backend: str
    usable: bool
    facts: tuple[str, ...]

    def __str__(self) -> str:
        """A headline and a line for each fact."""
        lines = (f"{self.backend}: {'usable' if self.usable else 'not usable'}", *self.facts)
        return "\n  ".join(lines)


def command(args: Args) -> int:  # noqa: ARG001
    """Print the findings; the exit code is 0 if `tcgsplat run` can work here."""
    from tcgsplat.cli.summary import machine, versions

    packages = ", ".join(f"{name} {number}" for name, number in versions().items())
    reference = Finding("reference", True, ("plain torch, slow: for checking",))
    numba = numba_finding()
    findings = (numba, cuda_finding(), gsplat_finding(), reference, mesh_finding())
    sys.stdout.write(f"{packages}\n{platform.platform()}; {machine()}\n")
    sys.stdout.writelines(f"{finding}\n" for finding in findings)
    return 0 if numba.usable else 1


def numba_finding() -> Finding:
    """The CPU backend; its kernels also work where a GPU draws, on what is done once a frame."""
    try:
        from tcgsplat.cli.ahead import MODULES
        from tcgsplat.render.numba_cpu.compilation import kernels_of

        kernels = kernels_of(MODULES)
    except (ImportError, RuntimeError) as error:  # numba raises the latter where it finds no place for its cache
        advice = "set NUMBA_CACHE_DIR to a folder that can be written, or install numba again"
        return Finding("numba", False, (f"the kernels cannot be loaded: {error}; {advice}",))
    from llvmlite import binding

    cache = Path(str(kernels[0].dispatcher.stats.cache_path))
    missing = [kernel for kernel in kernels if not kernel.kept]
    place = f"compiled kernels are kept in {cache}"
    facts = (
        "the default where there is no GPU",
        "AVX-512: yes, the kernels' vectors fill its registers"
        if binding.get_host_cpu_features().get("avx512f")
        else "AVX-512: no; results are the same, more slowly; a processor with AVX-512 is faster",
        f"{place}; {'some are missing: the first run takes some seconds longer' if missing else 'they are there'}"
        if os.access(cache if cache.exists() else cache.parent, os.W_OK)
        else f"{place}, which cannot be written: every run compiles anew; set NUMBA_CACHE_DIR to another folder",
    )
    return Finding("numba", True, facts)


def cuda_finding() -> Finding:
    """The GPU backend, which has to compile its kernels and draw something before it is called usable."""
    from tcgsplat.errors import BackendUnavailableError
    from tcgsplat.render.availability import driver, gpu_obstacles, torch_with_cuda
    from tcgsplat.render.backends import open_rasterizer

    if obstacles := gpu_obstacles():
        return Finding("cuda", False, obstacles)
    try:
        open_rasterizer("cuda")
    except (BackendUnavailableError, RuntimeError) as error:
        advice = "NVRTC, which compiles the kernels, comes with torch; to install both again"
        return Finding("cuda", False, (str(error), f"{advice}: {torch_with_cuda(driver())}", "`auto` takes the CPU"))
    return Finding("cuda", True, ("the default, on the GPU; needs no compiler", gpu()))


def gsplat_finding() -> Finding:
    """The alternative on a GPU. It is not opened, since that would compile it."""
    from tcgsplat.render.availability import extension_obstacles, gpu_obstacles

    unseen = ("what `cuda` needs comes first",) if gpu_obstacles() else ()
    if obstacles := unseen + extension_obstacles():
        return Finding("gsplat", False, obstacles)
    compiled = importlib.util.find_spec("gsplat.csrc") is not None
    kernels = "its kernels are in the wheel" if compiled else "its kernels are compiled when first used, some minutes"
    return Finding("gsplat", True, (f"gsplat {version('gsplat')}; {kernels}", gpu()))


def gpu() -> str:
    """The one that torch would use, and what torch is built for."""
    import torch

    found = torch.cuda.get_device_properties(torch.cuda.current_device())
    return (
        f"{found.name}, {found.total_memory / 2**30:.1f} GiB, compute capability {found.major}.{found.minor}; torch is "
        f"built for CUDA {torch.version.cuda}"
    )


def mesh_finding() -> Finding:
    """Open3D, for `export --mesh` and the scores of a surface."""
    from tcgsplat.errors import BackendUnavailableError
    from tcgsplat.mapping.fusion import open3d

    try:
        number = open3d().__version__
    except BackendUnavailableError as error:
        return Finding("mesh", False, (str(error),))
    return Finding("mesh", True, (f"Open3D {number}: `export --mesh`, and scores of the surface",))
