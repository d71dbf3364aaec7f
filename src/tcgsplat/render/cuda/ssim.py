"""Structural similarity on the GPU, differentiable by the rendered image."""

from functools import cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from tcgsplat.render.cuda.launching import Compiled, Kernels, source
from tcgsplat.render.cuda.rasterizer import TILE
from tcgsplat.tensors import Image


def ssim_text(radius: int, c1: float, c2: float) -> str:
    """The kernels as C++, for a window of so many pixels to each side and with SSIM's constants."""
    return source(
        {"RADIUS": str(radius), "SSIM_C1": f"{c1!r}f", "SSIM_C2": f"{c2!r}f"},
        "render/cuda/kernel.cuh",
        "render/cuda/ssim.cu",
    )


@cache
def ssim_kernels(device: torch.device, radius: int, c1: float, c2: float) -> Kernels:
    """Compiled for a GPU."""
    return Compiled(ssim_text(radius, c1, c2), device)


def similarity(kernels: Kernels, rendered: Image, observed: Image, window: Float[Tensor, " k"]) -> Image:
    """Structural similarity at every pixel and channel, differentiable by `rendered`; see `losses.ssim_map`."""
    found: Image = _Similarity.apply(kernels, rendered, observed, window)  # type: ignore[no-untyped-call]
    return found


class _Similarity(torch.autograd.Function):
    """Its derivative is by `rendered` alone, since the observed image is data."""

    @staticmethod
    def forward(ctx: Any, kernels: Kernels, rendered: Tensor, observed: Tensor, window: Tensor) -> Tensor:
        a, b = (image.detach().permute(2, 0, 1).contiguous() for image in (rendered, observed))
        maps = {name: torch.empty_like(a) for name in ("by_mean", "by_aa", "by_ab")}
        similarity, (channels, height, width) = torch.empty_like(a), a.shape
        ctx.blocks = channels * -(-height // TILE) * -(-width // TILE)
        ctx.kernels, ctx.given = kernels, {"a": a, "b": b, "window": window, "width": width, "height": height, **maps}
        kernels.launch("ssim", ctx.blocks, ctx.given | {"similarity": similarity})
        return similarity.permute(1, 2, 0)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, Tensor, None, None]:
        upstream, d_a = gradient.permute(2, 0, 1).contiguous(), torch.empty_like(ctx.given["a"])
        ctx.kernels.launch("ssim_backward", ctx.blocks, ctx.given | {"upstream": upstream, "d_a": d_a})
        return None, d_a.permute(1, 2, 0), None, None
