"""From a submap and a camera to meaningful images: the one place where Gaussians become splats.

Colour and confidence are composited as channels of one pass, so that Eq. 17's map has the very weights of the picture.

**A picture is where its submap is.** Whatever device draws, a submap that is kept in the CPU's memory gives pictures
there, and one that is on the device gives them there: nobody else need know where the drawing was done. Only `render`,
for the loops of optimisation, wants everything on the rasterizer's device.
"""

from dataclasses import dataclass, fields, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.conventions import MAX_OPACITY
from tcgsplat.render.protocol import Raster, Rasterizer, Splats
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.submap import Submap
from tcgsplat.tensors import Image, PerGaussian, PerGaussianFlag, Plane, Pose

MIN_COVERAGE = 0.5
"""Below this alpha most of the pixel is unmapped, and a depth divided by alpha would be a guess."""

DepthMode = Literal["composited", "expected", "planar"]
"""Which depth a loss compares with the sensor: composited with alpha as the paper has it; that divided by alpha; or
the splats' planes divided by alpha."""


@dataclass(frozen=True)
class Rendering:
    """What one view of a map looks like."""

    color: Image
    """RGB times alpha: black where nothing is mapped."""
    composited_depth: Plane
    """Centre depth times alpha, metres."""
    composited_plane_depth: Plane
    """Plane depth times alpha, metres."""
    alpha: Plane
    """In [0, 1)."""
    confidence: Plane
    """P of Eq. 17, in [0, alpha]; never carries a gradient."""
    visible: PerGaussianFlag

    @property
    def depth(self) -> Plane:
        """The surface's depth: planes divided by alpha, metres; 0 where coverage is below MIN_COVERAGE."""
        covered = self.alpha > MIN_COVERAGE
        return torch.where(covered, self.composited_plane_depth / self.alpha.clamp_min(MIN_COVERAGE), 0.0)

    def depth_as(self, mode: DepthMode) -> Plane:
        """Depth for a loss, metres; where it is divided by alpha, thin coverage keeps it finite."""
        if mode == "composited":
            return self.composited_depth
        depth = self.composited_plane_depth if mode == "planar" else self.composited_depth
        return depth / self.alpha.clamp_min(1e-3)

    def to(self, device: torch.device) -> "Rendering":
        """The same images on another device; itself if they are there already."""
        if self.alpha.device == device:
            return self
        return Rendering(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})

    def cpu(self) -> "Rendering":
        """The same images where numpy and the CPU's kernels can read them; itself if they are there already."""
        if self.alpha.is_cpu:
            return self
        return Rendering(**{f.name: getattr(self, f.name).cpu() for f in fields(self)})


def render(
    gaussians: Gaussians,
    confidence: PerGaussian,
    camera: Camera,
    T_cam_map: Pose,
    rasterizer: Rasterizer,
) -> Rendering:
    """Draw Gaussians, differentiable in all of their parameters and in the pose.

    Args:
        gaussians: n Gaussians in the map frame, on the rasterizer's device.
        confidence: p of each, composited alongside; detached, or tracking could lower its loss by moving towards
            doubtful regions.
        camera: Intrinsics.
        T_cam_map: Map frame to camera frame; on the CPU or on the rasterizer's device.
        rasterizer: Backend.
    """
    return _drawn(_splats(gaussians, confidence, T_cam_map), camera, T_cam_map, rasterizer)


@torch.no_grad()
def render_view(submap: Submap, camera: Camera, T_map_cam: Pose, rasterizer: Rasterizer) -> Rendering:
    """Draw a submap from a camera in its frame, without gradients; the images are where the submap is."""
    return SubmapView(submap, rasterizer)(camera, T_map_cam)


class SubmapView:
    """A submap to be drawn again and again, without gradients: what no camera changes is done once."""

    def __init__(self, submap: Submap, rasterizer: Rasterizer) -> None:
        self.submap = submap
        self._rasterizer = rasterizer
        self._there = submap.to(rasterizer.device)
        self._splats: Splats | None = None

    @torch.no_grad()
    def __call__(self, camera: Camera, T_map_cam: Pose) -> Rendering:
        """The view of a camera in the submap's frame; the images are where the submap is."""
        T_cam_map, submap = se3.inverse(T_map_cam), self._there
        splats = self._splats or _splats(submap.gaussians, submap.confidence.value, T_cam_map)
        if submap.gaussians.sh_degree == 0:  # else colours depend on where they are seen from
            self._splats = splats
        return _drawn(splats, camera, T_cam_map, self._rasterizer).to(self.submap.device)


@dataclass(frozen=True)
class Blend:
    """A view of n Gaussians, and which of them is how much of each pixel."""

    rendering: Rendering
    """What it looks like, where the submap is."""
    _features: Tensor
    _drawn: Tensor

    def shared_out(self, images: Float[Tensor, "h w c"]) -> Float[Tensor, "n c"]:
        """For each Gaussian the sum over all pixels of some images, times its weight T alpha in each pixel's blend.

        This is drawing turned round: what a picture says, handed to those that it shows, and to none that they hide.
        The images, four at most, are where the submap is, and so are the sums.
        """
        filled_up = functional.pad(images.to(self._drawn.device), (0, self._drawn.shape[-1] - images.shape[-1]))
        with torch.enable_grad():  # autograd handed the images themselves imports sympy to look at their shapes: 0.2 s
            product = (self._drawn * filled_up).sum()
        (shares,) = torch.autograd.grad(product, self._features, retain_graph=True)
        return shares[:, : images.shape[-1]].to(self.rendering.alpha.device)


def blend(submap: Submap, camera: Camera, T_map_cam: Pose, rasterizer: Rasterizer) -> Blend:
    """Draw a submap from a camera in its frame, so that pixels can be asked what they are made of."""
    there, T_cam_map = submap.to(rasterizer.device), se3.inverse(T_map_cam)
    with torch.no_grad():
        splats = _splats(there.gaussians, there.confidence.value, T_cam_map)
    asked = replace(splats, features=splats.features.requires_grad_())
    with torch.enable_grad():
        raster = rasterizer(asked, camera, T_cam_map)
    plain = replace(raster, **{f.name: getattr(raster, f.name).detach() for f in fields(raster)})
    return Blend(_rendering(plain).to(submap.device), asked.features, raster.features)


def _splats(gaussians: Gaussians, confidence: PerGaussian, T_cam_map: Pose) -> Splats:
    viewpoint = se3.inverse(T_cam_map)[:3, 3].to(gaussians.means, non_blocking=True)
    features = torch.cat((gaussians.colors(viewpoint), confidence.detach()[:, None]), dim=1)
    return Splats(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities.clamp_max(MAX_OPACITY), features
    )


def _drawn(splats: Splats, camera: Camera, T_cam_map: Pose, rasterizer: Rasterizer) -> Rendering:
    return _rendering(rasterizer(splats, camera, T_cam_map))


def _rendering(raster: Raster) -> Rendering:
    return Rendering(
        color=raster.features[..., :3],
        composited_depth=raster.depth,
        composited_plane_depth=raster.plane_depth,
        alpha=raster.alpha,
        confidence=raster.features[..., 3].detach(),
        visible=raster.visible,
    )
