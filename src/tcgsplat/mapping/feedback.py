"""From a mapping update to confidence: what each Gaussian did, and how well it explains the frame (Eqs. 5 to 15)."""

from dataclasses import replace

import torch

from tcgsplat.confidence import equations as eq
from tcgsplat.confidence.state import ConfidenceConfig, Observation
from tcgsplat.geometry import se3
from tcgsplat.mapping.mapper import Mapped
from tcgsplat.render.losses import color_error, depth_error
from tcgsplat.render.view import DepthMode
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Submap


@torch.no_grad()
def observation(mapped: Mapped, frame: Frame, config: ConfidenceConfig, depth_mode: DepthMode) -> Observation:
    """Self-distance and residual of every surviving Gaussian; valid where it was there before and is in view."""
    submap, rendering = mapped.submap, mapped.rendering
    points = se3.transform(se3.inverse(submap.keyframes[-1].T_map_cam), submap.gaussians.means)
    pixels = frame.camera.project(torch.cat((points[:, :2], points[:, 2:].clamp_min(1e-6)), dim=1))

    residual = eq.residual_map(
        color_error(rendering.color, frame.color),
        depth_error(rendering.depth_as(depth_mode), frame.depth),
        frame.depth > 0,
        color_weight=config.color_residual_weight,
        depth_weight=config.depth_residual_weight,
    )
    seen = rendering.visible & frame.camera.contains(pixels) & (eq.sample_at(frame.valid.float(), pixels) > 0.5)
    return Observation(
        valid=seen & (submap.confidence.born < submap.clock),
        distance=mapped.distance,
        residual=eq.sample_at(residual, pixels),
    )


def judged(mapped: Mapped, frame: Frame, config: ConfidenceConfig, depth_mode: DepthMode) -> Submap:
    """The mapped submap one tick of its clock later, every Gaussian's confidence updated."""
    seen = observation(mapped, frame, config, depth_mode)
    submap = mapped.submap
    return replace(submap, confidence=submap.confidence.observed(seen, config), clock=submap.clock + 1)
