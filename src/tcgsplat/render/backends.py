"""Choosing a backend by name; an explicit name never falls back."""

import logging
from typing import Literal

import torch

from tcgsplat.errors import BackendUnavailableError
from tcgsplat.render.availability import gpu_obstacles, prove
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.reference import ReferenceRasterizer

logger = logging.getLogger(__name__)

BackendName = Literal["auto", "numba", "reference", "cuda", "gsplat"]


def open_rasterizer(name: BackendName = "auto") -> Rasterizer:
    """A rasterizer that this machine can run; one on a GPU has proved here that it draws what it should.

    `auto` takes our GPU kernels where torch sees a GPU, else the CPU's. If the GPU's fail it says so once, and takes
    the CPU's; that is the only case in which one backend stands in for another.

    Raises:
        BackendUnavailableError: if the named backend cannot run here, or no backend has that name.
    """
    if name == "auto" and torch.cuda.is_available():
        try:
            return _on_gpu("cuda")
        except (BackendUnavailableError, RuntimeError) as error:
            logger.warning("the GPU is not used: %s", error)
    if name in ("cuda", "gsplat"):
        return _on_gpu(name)
    if name in ("auto", "numba"):
        from tcgsplat.render.numba_cpu.rasterizer import NumbaRasterizer  # noqa: PLC0415  numba takes its time to import

        return NumbaRasterizer()
    if name == "reference":
        return ReferenceRasterizer(torch.device("cpu"))
    raise BackendUnavailableError(f"there is no rasterizer {name!r}; choose auto, numba, reference, cuda or gsplat")


def _on_gpu(name: str) -> Rasterizer:
    """On the GPU that torch sees, having drawn something."""
    if obstacles := gpu_obstacles():
        raise BackendUnavailableError(
            f"the rasterizer {name} needs an NVIDIA GPU: {'; '.join(obstacles)}; `--backend numba` uses the CPU"
        )
    device = torch.device("cuda", torch.cuda.current_device())
    if name == "gsplat":
        from tcgsplat.render.gsplat_cuda import GsplatRasterizer  # noqa: PLC0415  an extra

        return GsplatRasterizer(device)
    from tcgsplat.render.cuda import CudaRasterizer, Graphs  # noqa: PLC0415  a CPU needs none of it

    rasterizer = CudaRasterizer(device, recorder=Graphs(device))
    prove(rasterizer)
    return rasterizer
