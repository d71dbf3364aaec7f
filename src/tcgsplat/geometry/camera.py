"""The pinhole camera, and where a pixel's centre is.

**Pixel (column 0, row 0) has its centre at u = 0, v = 0** (OpenCV's convention): the image spans [-0.5, w - 0.5].
Loaders convert to it, the rasterizers evaluate Gaussians at integer u, v, and adapters to libraries that put the
first centre at (0.5, 0.5) add the half pixel at their own door. Camera frame: x right, y down, z forward, metres.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tcgsplat.tensors import Plane


@dataclass(frozen=True)
class Camera:
    """Pinhole intrinsics of an undistorted image, in pixels, with pixel centres at integer coordinates."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def scaled(self, factor: float) -> "Camera":
        """Intrinsics of the image resized by `factor`: 0.5 means each new pixel covers two by two old ones."""
        return Camera(
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=(self.cx + 0.5) * factor - 0.5,
            cy=(self.cy + 0.5) * factor - 0.5,
            width=round(self.width * factor),
            height=round(self.height * factor),
        )

    def cropped(self, border: int) -> "Camera":
        """Intrinsics after `border` pixels are cut off on every side."""
        return Camera(
            self.fx, self.fy, self.cx - border, self.cy - border, self.width - 2 * border, self.height - 2 * border
        )

    def project(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """Pixel coordinates (u, v) of points in the camera frame; the caller sees to it that z > 0."""
        x, y, z = points.unbind(-1)
        return torch.stack((self.fx * x / z + self.cx, self.fy * y / z + self.cy), dim=-1)

    def contains(self, pixels: Float[Tensor, "*batch 2"]) -> Bool[Tensor, " *batch"]:
        """Whether pixel coordinates (u, v) are in the image, which spans [-0.5, width - 0.5] x [-0.5, height - 0.5]."""
        u, v = pixels.unbind(-1)
        return (u > -0.5) & (u < self.width - 0.5) & (v > -0.5) & (v < self.height - 0.5)

    def rays(self, device: torch.device | None = None) -> Float[Tensor, "h w 3"]:
        """The ray through each pixel's centre, scaled to z = 1."""
        v, u = torch.meshgrid(
            torch.arange(self.height, dtype=torch.float32, device=device),
            torch.arange(self.width, dtype=torch.float32, device=device),
            indexing="ij",
        )
        return torch.stack(((u - self.cx) / self.fx, (v - self.cy) / self.fy, torch.ones_like(u)), dim=-1)

    def backproject(self, depth: Plane) -> Float[Tensor, "h w 3"]:
        """Points in the camera frame of every pixel of a depth image (metres along z)."""
        return self.rays(depth.device) * depth[..., None]
