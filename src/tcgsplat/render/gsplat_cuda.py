"""gsplat's CUDA kernels behind our protocol: the alternative to `render.cuda`, for those who can compile them.

Projection is the oracle's own, in torch, so that near plane, blur, margin and planes are ours, and the gradient reaches
the pose by autograd. gsplat (Ye et al. 2024, arXiv:2409.06765) bins, sorts and composites, in one pass: a plane's depth
is affine in the pixel, so the composited planes follow from their composited coefficients. Of gsplat's conventions,

* the first pixel's centre is at (0.5, 0.5), so centres are moved by half a pixel at this door;
* alpha is cut at 1/255, as everywhere here, and clipped to 0.999, which opacities of MAX_OPACITY never reach;
* a pixel is finished *before* the splat behind which less than MIN_TRANSMITTANCE would be let through, and lacks that
  splat: up to MIN_TRANSMITTANCE / (1 - MAX_OPACITY) of its weight, one percent.

gsplat asks the GPU once a pass how many pairs of splats and tiles there are, and waits for the answer.
"""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tcgsplat.errors import BackendUnavailableError
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.availability import extension_obstacles, gpu_obstacles, prove
from tcgsplat.render.protocol import Raster, Splats
from tcgsplat.render.reference import half_sizes, inverted, project, visible_footprints
from tcgsplat.tensors import PerGaussian, PerGaussianFlag, Plane, Pose

TILE = 16
"""Width and height of a tile, pixels."""


@dataclass(frozen=True)
class Footprints:
    """Splats on the image plane, as gsplat composites them."""

    centers: Float[Tensor, "n 2"]
    """Pixels, the first pixel's centre at (0.5, 0.5)."""
    radii: Int[Tensor, "n 2"]
    """Half the sides of the box that may be drawn in, whole pixels; 0 for what is not visible."""
    depths: PerGaussian
    """Order of drawing, metres."""
    conics: Float[Tensor, "n 3"]
    """Inverse covariance: uu, uv, vv."""
    opacities: PerGaussian
    channels: Float[Tensor, "n c_and_4"]
    """Features, centre depth, and the plane: depth at the principal point, slopes along u and v."""
    visible: PerGaussianFlag


def footprints(splats: Splats, camera: Camera, T_cam_map: Pose) -> Footprints:
    """Project splats, and write their planes as three channels."""
    projected = project(splats, camera, T_cam_map)
    with torch.no_grad():
        visible = visible_footprints(projected, splats.opacities, camera)
        radii = half_sizes(projected, splats.opacities).ceil().clamp_min(1)
    slope_u, slope_v = projected.slopes.unbind(-1)
    u, v = projected.centers.unbind(-1)
    constant = projected.depths - slope_u * (u - camera.cx) - slope_v * (v - camera.cy)
    planes = torch.stack((projected.depths, constant, slope_u, slope_v), dim=-1)
    return Footprints(
        centers=projected.centers + 0.5,
        radii=torch.where(visible[:, None], radii, 0.0).int(),
        depths=projected.depths,
        conics=inverted(projected.covariances).flatten(1)[:, [0, 1, 3]],
        opacities=splats.opacities,
        channels=torch.cat((splats.features, planes), dim=-1),
        visible=visible,
    )


def raster(channels: Float[Tensor, "h w c_and_4"], alpha: Plane, visible: PerGaussianFlag, camera: Camera) -> Raster:
    """What the protocol gives, from the composited channels of `Footprints`."""
    v = torch.arange(camera.height, dtype=alpha.dtype, device=alpha.device)[:, None] - camera.cy
    u = torch.arange(camera.width, dtype=alpha.dtype, device=alpha.device) - camera.cx
    depth, constant, slope_u, slope_v = channels[..., -4:].unbind(-1)
    return Raster(channels[..., :-4], depth, constant + slope_u * u + slope_v * v, alpha, visible)


def composited(footprints: Footprints, width: int, height: int) -> tuple[Float[Tensor, "h w c"], Plane]:
    """Channels and alpha, by gsplat."""
    from gsplat import isect_offset_encode, isect_tiles, rasterize_to_pixels  # noqa: PLC0415  an extra; compiles itself

    centers = footprints.centers[None]
    columns, rows = -(-width // TILE), -(-height // TILE)
    _, pairs, ids = isect_tiles(
        centers.detach(), footprints.radii[None], footprints.depths.detach()[None], TILE, columns, rows
    )
    channels, alpha = rasterize_to_pixels(
        centers,
        footprints.conics[None],
        footprints.channels[None],
        footprints.opacities[None],
        width,
        height,
        TILE,
        isect_offset_encode(pairs, 1, columns, rows),
        ids,
    )
    return channels[0], alpha[0, ..., 0]


class GsplatRasterizer:
    """gsplat's kernels; float32."""

    name = "gsplat"

    def __init__(self, device: str | torch.device = "cuda") -> None:
        """A rasterizer on a GPU. The first one on a machine compiles gsplat's kernels, which takes some minutes.

        Raises:
            BackendUnavailableError: if torch has no GPU here, or gsplat is not installed or does not compile.
        """
        if obstacles := gpu_obstacles() + extension_obstacles():
            raise BackendUnavailableError(f"gsplat cannot draw here: {'; '.join(obstacles)}")
        self.device = torch.empty(0, device=device).device  # with its number, as tensors have it
        try:
            prove(self)
        except (ImportError, AttributeError, RuntimeError, OSError) as error:  # as many as there are ways to fail
            raise BackendUnavailableError(
                f"gsplat's kernels cannot be compiled or loaded: {error}; `VERBOSE=1 python -c 'from gsplat.cuda."
                "_backend import _C'` shows what the compiler says; `--backend cuda` needs no compiler"
            ) from error

    def __call__(self, splats: Splats, camera: Camera, T_cam_map: Pose) -> Raster:
        """Draw; see `Rasterizer`."""
        found = footprints(splats, camera, T_cam_map.to(self.device, non_blocking=True))
        channels, alpha = composited(found, camera.width, camera.height)
        return raster(channels, alpha, found.visible, camera)

    def reserved(self) -> AbstractContextManager[None]:
        """See `Rasterizer`; a GPU shares itself."""
        return nullcontext()
