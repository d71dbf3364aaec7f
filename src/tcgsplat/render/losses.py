"""Image errors as per-pixel maps; what to mask, weight and sum is the caller's choice."""

from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tcgsplat.render import ssim_kernels
from tcgsplat.tensors import Image, Plane

SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
_SSIM_RADIUS, _SSIM_SIGMA = ssim_kernels.RADIUS, 1.5


def color_error(rendered: Image, observed: Image) -> Plane:
    """Mean over the channels of |rendered - observed|."""
    return (rendered - observed).abs().mean(dim=-1)


def depth_error(rendered: Plane, observed: Plane) -> Plane:
    """|rendered - observed|, metres; 0 where there is no reading (observed 0)."""
    return torch.where(observed > 0, (rendered - observed).abs(), 0.0)


def ssim_window(dtype: torch.dtype = torch.float32, device: torch.device | None = None) -> Float[Tensor, " k"]:
    """The Gaussian weights of SSIM's windows, 11 pixels wide; made where they are wanted, which nothing waits for."""
    x = torch.arange(-_SSIM_RADIUS, _SSIM_RADIUS + 1, dtype=torch.float64, device=device)
    window = torch.exp(-0.5 * (x / _SSIM_SIGMA) ** 2)
    return (window / window.sum()).to(dtype)


@cache
def _window_on(device: torch.device) -> Tensor:
    return ssim_window().to(device)


class _CpuSsim(torch.autograd.Function):
    """The map by the kernels; its derivative by `rendered` alone, since the observed image is data."""

    @staticmethod
    def forward(ctx: Any, rendered: Tensor, observed: Tensor) -> Tensor:
        a, b = (np.ascontiguousarray(x.detach().permute(2, 0, 1).numpy()) for x in (rendered, observed))
        window = ssim_window().numpy()
        similarity, *partials = (np.empty_like(a) for _ in range(4))
        ssim_kernels.forward(a, b, window, np.float32(SSIM_C1), np.float32(SSIM_C2), similarity, *partials)
        ctx.inputs = a, b, partials, window
        return torch.from_numpy(similarity).permute(1, 2, 0)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        a, b, partials, window = ctx.inputs
        upstream, out = np.ascontiguousarray(gradient.permute(2, 0, 1).numpy()), np.empty_like(a)
        ssim_kernels.backward(upstream, a, b, *partials, window, out)  # type: ignore[call-arg]
        return torch.from_numpy(out).permute(1, 2, 0), None


def _blurred(images: Float[Tensor, "h w c"]) -> Float[Tensor, "h w c"]:
    """Gaussian window of 11 pixels and sigma 1.5, zeros beyond the border."""
    window = ssim_window(images.dtype, images.device)
    planes = images.permute(2, 0, 1)[:, None]
    across = torch.nn.functional.conv2d(planes, window[None, None, None, :], padding=(0, _SSIM_RADIUS))
    down = torch.nn.functional.conv2d(across, window[None, None, :, None], padding=(_SSIM_RADIUS, 0))
    return down[:, 0].permute(1, 2, 0)


def ssim_map(rendered: Image, observed: Image) -> Float[Tensor, "h w 3"]:
    """Structural similarity at every pixel and channel, in [-1, 1] (Wang et al. 2004), differentiable by `rendered`.

    In float32 by kernels of its own on the CPU and on a GPU, else in torch.
    """
    a, b = rendered, observed
    if a.device.type == "cpu" and a.dtype == torch.float32:
        similarity: Tensor = _CpuSsim.apply(a, b)  # type: ignore[no-untyped-call]
        return similarity
    if a.device.type == "cuda" and a.dtype == torch.float32:
        from tcgsplat.render.cuda import ssim  # noqa: PLC0415  nobody without a GPU needs it

        kernels = ssim.ssim_kernels(a.device, _SSIM_RADIUS, SSIM_C1, SSIM_C2)
        return ssim.similarity(kernels, a, b, _window_on(a.device))
    return plain_ssim_map(a, b)


def plain_ssim_map(a: Image, b: Image) -> Float[Tensor, "h w 3"]:
    """The same in torch: on any device, differentiable by both."""
    mean_a, mean_b, aa, bb, ab = _blurred(torch.cat((a, b, a * a, b * b, a * b), dim=-1)).chunk(5, dim=-1)
    var_a, var_b, cov = aa - mean_a * mean_a, bb - mean_b * mean_b, ab - mean_a * mean_b
    structure = (2 * cov + SSIM_C2) / (var_a + var_b + SSIM_C2)
    luminance = (2 * mean_a * mean_b + SSIM_C1) / (mean_a * mean_a + mean_b * mean_b + SSIM_C1)
    return luminance * structure


def isotropy_error(scales: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """Mean deviation of a Gaussian's three scales from their mean, metres (the base system's regulariser)."""
    return (scales - scales.mean(dim=1, keepdim=True)).abs().mean()
