"""Choosing a backend by name; an explicit name never falls back silently."""

from typing import Literal

import torch

from tcgsplat.errors import BackendUnavailableError
from tcgsplat.render.protocol import Rasterizer

BackendName = Literal["auto", "numba", "reference", "cuda", "gsplat"]


def open_rasterizer(name: BackendName = "auto") -> Rasterizer:
    """A rasterizer that this machine can run; `auto` takes our GPU kernels where torch sees a GPU, else the CPU's.

    Raises:
        BackendUnavailableError: if the named backend cannot run here, or no backend has that name.
    """
    if name == "cuda" or (name == "auto" and torch.cuda.is_available()):
        device = _gpu("cuda")
        from tcgsplat.render.cuda import CudaRasterizer  # noqa: PLC0415  a CPU needs none of it

        return CudaRasterizer(device)
    if name == "gsplat":
        device = _gpu("gsplat")
        from tcgsplat.render.gsplat_cuda import GsplatRasterizer  # noqa: PLC0415

        return GsplatRasterizer(device)
    if name in ("auto", "numba"):
        from tcgsplat.render.numba_cpu import NumbaRasterizer  # noqa: PLC0415  numba takes its time to import

        return NumbaRasterizer()
    if name == "reference":
        from tcgsplat.render.reference import ReferenceRasterizer  # noqa: PLC0415

        return ReferenceRasterizer(torch.device("cpu"))
    raise BackendUnavailableError(f"there is no rasterizer {name!r}; choose auto, numba, reference, cuda or gsplat")


def _gpu(name: str) -> torch.device:
    """The GPU that torch sees, for the rasterizer of that name."""
    if torch.cuda.is_available():
        return torch.device("cuda", torch.cuda.current_device())
    missing = "is built without CUDA" if torch.version.cuda is None else "sees no NVIDIA GPU"
    raise BackendUnavailableError(
        f"the rasterizer {name} needs an NVIDIA GPU, and torch {torch.__version__} {missing}; `tcgsplat doctor` says "
        "what to do, `--backend numba` uses the CPU"
    )
