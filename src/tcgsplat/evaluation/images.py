"""How near a rendering is to the camera's image; each measure says which pixels it counts."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from tcgsplat.render.losses import SSIM_C1, SSIM_C2, ssim_map, ssim_window
from tcgsplat.tensors import Image, Mask, Plane

_SSIM_RADIUS = 5
_SMALLEST_MSE = 1e-10
_SCALES = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of MS-SSIM, from the finest scale to the coarsest."""
MS_SSIM_SMALLEST = 2 * _SSIM_RADIUS * 2 ** (len(_SCALES) - 1) + 1
"""Pixels that an image must have across and down for a window to fit into it at the coarsest scale."""


def psnr(a: Image, b: Image, valid: Mask) -> float:
    """Peak signal-to-noise ratio in dB, of RGB in [0, 1], over all channels of the valid pixels.

    At most 100, which identical images have. NaN if no pixel is valid.
    """
    mse = float((a - b)[valid].to(torch.float64).square().mean())
    return math.nan if math.isnan(mse) else -10.0 * math.log10(max(mse, _SMALLEST_MSE))


def ssim(a: Image, b: Image, valid: Mask) -> float:
    """Structural similarity of RGB in [0, 1] (Wang et al. 2004): 1 for identical images, 0 for unrelated ones.

    Windows of 11 x 11 pixels with Gaussian weights of 1.5 pixels. Only windows that lie within the image and on valid
    pixels count; their mean over all channels is returned. NaN if there is no such window.
    """
    return float(ssim_map(a, b)[_whole_windows(valid)].mean(dtype=torch.float64))


def ms_ssim(a: Image, b: Image, valid: Mask) -> float:
    """Multi-scale structural similarity of RGB in [0, 1] (Wang et al. 2003), five scales, as pytorch_msssim has it.

    The contrast and structure of the four finest scales and the similarity of the coarsest, each its mean over windows
    of 11 x 11 pixels and not below 0, to the power of its exponent, multiplied; the mean over the channels. From scale
    to scale images are halved by the mean of 2 x 2 pixels, with a row or column of zeros in front where there is an odd
    number of them. Only windows of valid pixels count, and a pixel of a coarser scale is valid if all that it is the
    mean of are. NaN if a scale has no such window: always where an image is narrower or lower than `MS_SSIM_SMALLEST`
    (161) pixels. Fewer scales would give a number that compares with no other.
    """
    if min(valid.shape) < MS_SSIM_SMALLEST:
        return math.nan
    images = torch.stack((a, b)).permute(0, 3, 1, 2).to(torch.float64)
    holes, product = (~valid).to(torch.float32)[None], torch.ones(3, dtype=torch.float64, device=a.device)
    for scale, exponent in enumerate(_SCALES):
        if scale > 0:
            odd = (holes.shape[1] % 2, holes.shape[2] % 2)
            images = functional.avg_pool2d(images, 2, padding=odd)
            holes = functional.max_pool2d(holes, 2, padding=odd)
        luminance, structure = _similarity(images[0], images[1])
        similar = structure if scale < len(_SCALES) - 1 else luminance * structure
        whole = functional.max_pool2d(holes, 2 * _SSIM_RADIUS + 1, stride=1)[0] == 0
        product = product * similar[:, whole].mean(dim=1).clamp_min(0.0) ** exponent
    return float(product.mean())


def depth_l1(a: Plane, b: Plane, valid: Mask) -> float:
    """Mean absolute difference of two depth images over the valid pixels, metres. NaN if no pixel is valid.

    The caller's mask decides what a hole costs: a pixel with no depth (0) that is called valid counts in full.
    """
    return float((a - b)[valid].abs().mean(dtype=torch.float64))


def _whole_windows(valid: Mask) -> Mask:
    """Centres of the windows that lie within the image and on valid pixels only."""
    holes = functional.pad((~valid).to(torch.float32), (_SSIM_RADIUS,) * 4, value=1.0)
    return functional.max_pool2d(holes[None, None], 2 * _SSIM_RADIUS + 1, stride=1)[0, 0] == 0


def _similarity(a: Float[Tensor, "c h w"], b: Float[Tensor, "c h w"]) -> tuple[Tensor, Tensor]:
    """Likeness in luminance, and in contrast and structure, of all windows that lie within the images."""
    blurred = _blurred(_blurred(torch.cat((a, b, a * a, b * b, a * b)), dim=1), dim=2)
    mean_a, mean_b, aa, bb, ab = blurred.chunk(5)
    luminance = (2 * mean_a * mean_b + SSIM_C1) / (mean_a.square() + mean_b.square() + SSIM_C1)
    spread = aa - mean_a.square() + bb - mean_b.square()
    return luminance, (2 * (ab - mean_a * mean_b) + SSIM_C2) / (spread + SSIM_C2)


def _blurred(planes: Float[Tensor, "c h w"], dim: int) -> Float[Tensor, "c rows columns"]:
    """The windows' weighted means along one dimension; several times faster than a convolution of one channel."""
    weights, kept = ssim_window(planes.dtype).tolist(), planes.shape[dim] - 2 * _SSIM_RADIUS
    total: Tensor = weights[0] * planes.narrow(dim, 0, kept)
    for shift, weight in enumerate(weights[1:], start=1):
        total.add_(planes.narrow(dim, shift, kept), alpha=weight)
    return total
