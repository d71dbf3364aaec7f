"""Image errors as per-pixel maps; what to mask, weight and sum is the caller's choice."""

import torch
from jaxtyping import Float
from torch import Tensor

from tcgsplat.tensors import Image, Plane

_SSIM_C1, _SSIM_C2 = 0.01**2, 0.03**2
_SSIM_RADIUS, _SSIM_SIGMA = 5, 1.5


def color_error(rendered: Image, observed: Image) -> Plane:
    """Mean over the channels of |rendered - observed|."""
    return (rendered - observed).abs().mean(dim=-1)


def depth_error(rendered: Plane, observed: Plane) -> Plane:
    """|rendered - observed|, metres; 0 where there is no reading (observed 0)."""
    return torch.where(observed > 0, (rendered - observed).abs(), 0.0)


def _blurred(images: Float[Tensor, "k h w"]) -> Float[Tensor, "k h w"]:
    """Gaussian window of 11 pixels and sigma 1.5, zeros beyond the border, one axis after the other."""
    x = torch.arange(-_SSIM_RADIUS, _SSIM_RADIUS + 1, dtype=images.dtype, device=images.device)
    window = torch.exp(-0.5 * (x / _SSIM_SIGMA) ** 2)
    window = window / window.sum()
    rows = torch.nn.functional.pad(images, (_SSIM_RADIUS, _SSIM_RADIUS))
    width, height = images.shape[2], images.shape[1]
    across = sum(window[k] * rows[:, :, k : k + width] for k in range(len(x)))
    columns = torch.nn.functional.pad(across, (0, 0, _SSIM_RADIUS, _SSIM_RADIUS))  # type: ignore[arg-type]
    return sum(window[k] * columns[:, k : k + height] for k in range(len(x)))  # type: ignore[return-value]


def ssim_map(rendered: Image, observed: Image) -> Float[Tensor, "h w 3"]:
    """Structural similarity at every pixel and channel, in [-1, 1] (Wang et al. 2004), differentiable."""
    a, b = rendered.permute(2, 0, 1), observed.permute(2, 0, 1)
    mean_a, mean_b, aa, bb, ab = _blurred(torch.cat((a, b, a * a, b * b, a * b))).chunk(5)
    var_a, var_b, cov = aa - mean_a * mean_a, bb - mean_b * mean_b, ab - mean_a * mean_b
    structure = (2 * cov + _SSIM_C2) / (var_a + var_b + _SSIM_C2)
    luminance = (2 * mean_a * mean_b + _SSIM_C1) / (mean_a * mean_a + mean_b * mean_b + _SSIM_C1)
    return (luminance * structure).permute(1, 2, 0)


def isotropy_error(scales: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """Mean deviation of a Gaussian's three scales from their mean, metres (the base system's regulariser)."""
    return (scales - scales.mean(dim=1, keepdim=True)).abs().mean()
