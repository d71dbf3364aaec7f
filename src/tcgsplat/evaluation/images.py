"""How near a rendering is to the camera's image; each measure says which pixels it counts."""

import math

import torch
from torch.nn import functional

from tcgsplat.render.losses import ssim_map
from tcgsplat.tensors import Image, Mask, Plane

_SSIM_RADIUS = 5
_SMALLEST_MSE = 1e-10


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


def depth_l1(a: Plane, b: Plane, valid: Mask) -> float:
    """Mean absolute difference of two depth images over the valid pixels, metres. NaN if no pixel is valid.

    The caller's mask decides what a hole costs: a pixel with no depth (0) that is called valid counts in full.
    """
    return float((a - b)[valid].abs().mean(dtype=torch.float64))


def _whole_windows(valid: Mask) -> Mask:
    """Centres of the windows that lie within the image and on valid pixels only."""
    holes = functional.pad((~valid).to(torch.float32), (_SSIM_RADIUS,) * 4, value=1.0)
    return functional.max_pool2d(holes[None, None], 2 * _SSIM_RADIUS + 1, stride=1)[0, 0] == 0
