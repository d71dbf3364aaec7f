"""The oracle: the rendering equations in plain torch, to be read beside the paper, far too slow to use.

Every pixel meets every splat. Works in float32 and float64, so that `gradcheck` can hold it; all gradients are
autograd's. Faster backends are held to this file by tests, forward and backward.
"""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tcgsplat.geometry import quaternion
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.conventions import BLUR, JACOBIAN_MARGIN, MIN_ALPHA, NEAR_PLANE, PLANE_SOFTENING
from tcgsplat.render.protocol import Raster, Splats
from tcgsplat.tensors import PerGaussian, PerGaussianFlag, Pose


@dataclass(frozen=True)
class Projected:
    """2D Gaussians on the image plane, and the plane of each."""

    centers: Float[Tensor, "n 2"]
    """Pixels."""
    covariances: Float[Tensor, "n 2 2"]
    """Square pixels, blurred."""
    depths: PerGaussian
    """Metres."""
    slopes: Float[Tensor, "n 2"]
    """Metres per pixel: how the most likely depth changes across the image."""


def project(splats: Splats, camera: Camera, T_cam_map: Pose) -> Projected:
    """Project Gaussians by the pinhole's first-order expansion at their centres (EWA splatting, Zwicker et al. 2001).

    The expansion is taken to (u, v, z), not only (u, v): the third row of the covariance, regressed on the image,
    gives each splat's plane, E[z | u, v] (Zhang et al. 2024, RaDe-GS, derive the same plane geometrically).
    """
    R, t = T_cam_map[:3, :3].to(splats.means), T_cam_map[:3, 3].to(splats.means)
    centers_cam = splats.means @ R.T + t
    x, y, z = centers_cam.unbind(-1)
    z = z.clamp_min(0.5 * NEAR_PLANE)  # those behind are never drawn; keep their numbers finite

    margin_x = JACOBIAN_MARGIN * 0.5 * camera.width / camera.fx
    margin_y = JACOBIAN_MARGIN * 0.5 * camera.height / camera.fy
    a = (x / z).clamp(
        (-0.5 - camera.cx) / camera.fx - margin_x, (camera.width - 0.5 - camera.cx) / camera.fx + margin_x
    )
    b = (y / z).clamp(
        (-0.5 - camera.cy) / camera.fy - margin_y, (camera.height - 0.5 - camera.cy) / camera.fy + margin_y
    )
    zero, one = torch.zeros_like(z), torch.ones_like(z)
    duvz_dcam = torch.stack(
        (camera.fx / z, zero, -camera.fx * a / z, zero, camera.fy / z, -camera.fy * b / z, zero, zero, one), dim=-1
    ).reshape(-1, 3, 3)

    M = duvz_dcam @ R @ (quaternion.to_matrix(splats.quats) * splats.scales[:, None, :])
    covariance_uvz = M @ M.transpose(-1, -2)
    covariance_uv = covariance_uvz[:, :2, :2]
    eye = torch.eye(2, dtype=z.dtype, device=z.device)
    slopes = (inverted(covariance_uv + PLANE_SOFTENING * eye) @ covariance_uvz[:, :2, 2:])[..., 0]
    centers = torch.stack((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), dim=-1)
    return Projected(centers, covariance_uv + BLUR * eye, centers_cam[:, 2], slopes)


def inverted(covariances: Float[Tensor, "n 2 2"]) -> Float[Tensor, "n 2 2"]:
    """Cramer's rule: `torch.linalg.inv` would ask the GPU for each one's success, and wait for the answer."""
    a, b, c = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    adjugate = torch.stack((c, -b, -b, a), dim=-1).reshape(-1, 2, 2)
    return adjugate / (a * c - b * b)[:, None, None]


def half_sizes(projected: Projected, opacities: PerGaussian) -> Float[Tensor, "n 2"]:
    """Half the width and height, pixels, of the box around alpha >= MIN_ALPHA; nothing for those that are fainter."""
    k = 2 * (opacities / MIN_ALPHA).log().clamp_min(0)
    return (k[:, None] * projected.covariances.diagonal(dim1=-2, dim2=-1)).sqrt()


def visible_footprints(projected: Projected, opacities: PerGaussian, camera: Camera) -> PerGaussianFlag:
    """Whether the box around alpha >= MIN_ALPHA holds a pixel centre of the image."""
    half = half_sizes(projected, opacities)
    limit = torch.tensor([camera.width - 1, camera.height - 1], dtype=half.dtype, device=half.device)
    first = (projected.centers - half).ceil().clamp_min(0)
    last = torch.minimum((projected.centers + half).floor(), limit)
    return (opacities / MIN_ALPHA >= 1) & (first <= last).all(dim=-1) & (projected.depths > NEAR_PLANE)


class ReferenceRasterizer:
    """Eqs. 1 to 3 and front-to-back compositing, in plain torch."""

    name = "reference"

    def __init__(self, device: str | torch.device = "cpu") -> None:
        self.device = torch.device(device)

    def reserved(self) -> AbstractContextManager[None]:
        """See `Rasterizer`; nothing is shared here."""
        return nullcontext()

    def __call__(self, splats: Splats, camera: Camera, T_cam_map: Pose) -> Raster:
        """Composite all splats over all pixels; memory grows with pixels times splats of one image row."""
        projected = project(splats, camera, T_cam_map)
        with torch.no_grad():
            visible = visible_footprints(projected, splats.opacities, camera)
            order = projected.depths.argsort(stable=True)
            order = order[visible[order]]
        inverse = torch.linalg.inv(projected.covariances[order])
        columns = torch.arange(camera.width, dtype=splats.means.dtype, device=splats.means.device)

        rows = []
        for row in range(camera.height):
            pixels = torch.stack((columns, torch.full_like(columns, row)), dim=-1)
            offset = pixels[:, None, :] - projected.centers[order]  # [w, n, 2]
            power = -0.5 * torch.einsum("wni,nij,wnj->wn", offset, inverse, offset)
            alpha = splats.opacities[order] * power.exp()
            alpha = torch.where(alpha >= MIN_ALPHA, alpha, torch.zeros_like(alpha))
            through = torch.cumprod(1 - alpha, dim=1)
            transmittance = torch.cat((torch.ones_like(through[:, :1]), through[:, :-1]), dim=1)
            weight = transmittance * alpha  # [w, n]
            planes = projected.depths[order] + torch.einsum("wni,ni->wn", offset, projected.slopes[order])
            rows.append(
                torch.cat(
                    (
                        weight @ splats.features[order],
                        (weight @ projected.depths[order])[:, None],
                        (weight * planes).sum(dim=1, keepdim=True),
                        weight.sum(dim=1, keepdim=True),
                    ),
                    dim=1,
                )
            )
        image = torch.stack(rows)
        c = splats.features.shape[1]
        return Raster(image[..., :c], image[..., c], image[..., c + 1], image[..., c + 2], visible)
