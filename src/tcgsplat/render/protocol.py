"""What a rasterizer takes and gives; the numbers that all backends share are in `conventions.py`.

A backend knows neither confidence nor colour: it composites feature channels, depth and alpha front to back,
    out(u) = sum_i T_i(u) alpha_i(u) f_i,   T_i = prod_{j<i} (1 - alpha_j),
with alpha of Eq. 3 evaluated at pixel centres (integer coordinates), splats in the order of their centre's depth.
Nothing is divided by alpha here.
"""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from tcgsplat.geometry.camera import Camera
from tcgsplat.tensors import PerGaussian, PerGaussianFlag, Plane, Pose


@dataclass(frozen=True, eq=False)
class Splats:
    """Activated Gaussians in the map frame, ready to draw."""

    means: Float[Tensor, "n 3"]
    """Centres, metres."""
    quats: Float[Tensor, "n 4"]
    """Own axes to map frame, wxyz, any non-zero length."""
    scales: Float[Tensor, "n 3"]
    """Standard deviations, metres, > 0."""
    opacities: PerGaussian
    """In (0, MAX_OPACITY]."""
    features: Float[Tensor, "n c"]
    """Channels to composite."""


@dataclass(frozen=True)
class Raster:
    """Composited images of one view."""

    features: Float[Tensor, "h w c"]
    depth: Plane
    """Composited depth of the splats' centres, metres times alpha (the paper's D)."""
    plane_depth: Plane
    """Composited depth of the splats' planes, metres times alpha: each splat counts with the depth that it most
    likely has at this very pixel, z_i + cov(z, uv) cov(uv)^-1 (u - u_i), an inclined plane."""
    alpha: Plane
    """Sum of the weights, in [0, 1)."""
    visible: PerGaussianFlag
    """The footprint holds at least one pixel centre of the image and the centre is beyond the near plane. A splat
    hidden behind others is still visible in this sense."""


@runtime_checkable
class Rasterizer(Protocol):
    """A backend: values in, value out, differentiable in every tensor of `Splats` and in the pose."""

    name: str
    device: torch.device

    def __call__(self, splats: Splats, camera: Camera, T_cam_map: Pose) -> Raster:
        """Draw splats as the camera at `T_cam_map` (map frame to camera frame) sees them."""
        ...

    def reserved(self) -> AbstractContextManager[None]:
        """A core for the calling thread while inside; other threads that draw share the rest among them."""
        ...
