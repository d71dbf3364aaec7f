"""From a mapping update to confidence: what each Gaussian did, and how well it explains the frame (Eqs. 5 to 15)."""

from dataclasses import replace

import torch

from tcgsplat.confidence import equations as eq
from tcgsplat.confidence.state import ConfidenceConfig, Observation
from tcgsplat.geometry import se3
from tcgsplat.mapping.mapper import Mapped
from tcgsplat.render.conventions import NEAR_PLANE
from tcgsplat.render.losses import color_error, depth_error
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import DepthMode, render_view
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Submap


@torch.no_grad()
def observation(
    mapped: Mapped, frame: Frame, config: ConfidenceConfig, depth_mode: DepthMode, rasterizer: Rasterizer
) -> Observation:
    """Self-distance and residual of every surviving Gaussian; valid where it was there before and is in view.

    Residuals are the paper's model's: for others they are 0, and nothing is drawn.
    """
    submap, T_map_cam = mapped.submap, mapped.submap.keyframes[-1].T_map_cam
    points = se3.transform(se3.inverse(T_map_cam), submap.gaussians.means)
    pixels = frame.camera.project(torch.cat((points[:, :2], points[:, 2:].clamp_min(1e-6)), dim=1))
    seen, residual = points[:, 2] > NEAR_PLANE, torch.zeros_like(mapped.distance)
    if config.model == "paper":
        rendering = render_view(submap, frame.camera, T_map_cam, rasterizer)
        residual_map = eq.residual_map(
            color_error(rendering.color, frame.color),
            depth_error(rendering.depth_as(depth_mode), frame.depth),
            frame.depth > 0,
            color_weight=config.color_residual_weight,
            depth_weight=config.depth_residual_weight,
        )
        seen, residual = rendering.visible, eq.sample_at(residual_map, pixels)
    seen = seen & frame.camera.contains(pixels) & (eq.sample_at(frame.valid.float(), pixels) > 0.5)
    return Observation(
        valid=seen & (submap.confidence.born < submap.clock), distance=mapped.distance, residual=residual
    )


def judged(
    mapped: Mapped, frame: Frame, config: ConfidenceConfig, depth_mode: DepthMode, rasterizer: Rasterizer
) -> Submap:
    """The mapped submap one tick of its clock later, every Gaussian's confidence updated."""
    seen = observation(mapped, frame, config, depth_mode, rasterizer)
    submap = mapped.submap
    return replace(submap, confidence=submap.confidence.observed(seen, config), clock=submap.clock + 1)
