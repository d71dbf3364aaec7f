"""Choosing a backend by name; an explicit name never falls back silently."""

from typing import Literal

import torch

from tcgsplat.errors import BackendUnavailableError
from tcgsplat.render.protocol import Rasterizer

BackendName = Literal["auto", "numba", "reference"]


def open_rasterizer(name: BackendName = "auto") -> Rasterizer:
    """A rasterizer that this machine can run; `auto` takes the fastest, today the CPU kernels.

    Raises:
        BackendUnavailableError: if the named backend cannot run here, or no backend has that name.
    """
    if name in ("auto", "numba"):
        from tcgsplat.render.numba_cpu import NumbaRasterizer  # noqa: PLC0415  numba takes its time to import

        return NumbaRasterizer()
    if name == "reference":
        from tcgsplat.render.reference import ReferenceRasterizer  # noqa: PLC0415

        return ReferenceRasterizer(torch.device("cpu"))
    raise BackendUnavailableError(f"there is no rasterizer {name!r}; choose auto, numba or reference")
