"""What a map claims of a view before it has seen it, held against what is true there.

A claim is made of a frame that the map was not optimised on: online, by the map as it was before the frame came;
offline, by a finished map, of a frame that was kept back. It holds several measures of doubt: that of the confidence,
and those that are to be had for less, which it must beat to be worth anything.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from tcgsplat.confidence.expectation import noise, reading_error
from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.evaluation.uncertainty import Ordered, Scores, Sparsification, Values, auroc, sparsification
from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import Rendering, render_view
from tcgsplat.scene.submap import Submap
from tcgsplat.tensors import Image, Mask, Plane, Pose

OURS = "confidence"
"""The measure that is judged: 1 less the rendered confidence P of equation 17."""
BAD_METERS, BAD_SHARE, BAD_COLOR = 0.02, 0.05, 0.1
"""A depth is bad if it is off by more than both of the first two (metres, share), a colour by more than the last."""
_MANY = 20.0
"""Observations from which on a Gaussian counts as well observed."""


@dataclass(frozen=True, eq=False)
class Seen:
    """How far off a map was from the readings of a frame, from where that was taken: what the next view may learn."""

    residual: Plane
    """Metres; NaN where nothing could be compared."""
    T_map_cam: Pose
    map_index: int
    """Of the submap that the pose is in."""


@dataclass(frozen=True, eq=False)
class Claim:
    """What a map shows from somewhere, and how doubtful it is there by each measure."""

    rendering: Rendering
    doubt: Mapping[str, Plane]
    """By measure; more is more doubtful, units differ."""
    controls: Mapping[str, Plane]
    """Cheap cues that the confidence is to know more than."""


def claim(
    submap: Submap,
    camera: Camera,
    T_map_cam: Pose,
    rasterizer: Rasterizer,
    config: ConfidenceConfig,
    rng: np.random.Generator,
    previous: Seen | None = None,
) -> Claim:
    """What a map claims of a view.

    Args:
        submap: The map, as it was before it saw anything of the view.
        camera: Of the view.
        T_map_cam: Its estimated pose.
        rasterizer: Backend.
        config: Of the sensor's noise.
        rng: For the shuffled measure.
        previous: Of an earlier frame.
    """
    rendering = render_view(submap, camera, T_map_cam, rasterizer)
    counted = replace(submap.confidence, value=(submap.confidence.updates.float() / _MANY).clamp_max(1.0))
    observed = render_view(replace(submap, confidence=counted), camera, T_map_cam, rasterizer).confidence
    depth, alpha = rendering.depth, rendering.alpha
    edge = reading_error(depth, noise_floor=0.0, noise_slope=0.0, largest=config.error_max)
    ours = 1.0 - rendering.confidence
    shuffled = torch.from_numpy(rng.permutation(ours.numpy().ravel()).reshape(ours.shape))
    return Claim(
        rendering,
        {
            OURS: ours,
            "confidence over opacity": 1.0 - rendering.confidence / alpha.clamp_min(1e-3),
            "constant": torch.ones_like(ours),
            "shuffled": shuffled,
            "opacity": 1.0 - alpha,
            "observations": 1.0 - observed,
            "previous residual": _carried(previous, submap, depth, camera, T_map_cam),
            "depth noise": noise(depth, noise_floor=config.noise_floor, noise_slope=config.noise_slope),
            "depth edge": edge,
        },
        {"depth": depth, "opacity": alpha, "observations": observed, "gradient": _gradient(rendering.color)},
    )


def _gradient(color: Image) -> Plane:
    """Slope of the mean colour, per pixel."""
    dy, dx = torch.gradient(color.mean(dim=-1))
    return torch.hypot(dx, dy)


def _carried(previous: Seen | None, submap: Submap, depth: Plane, camera: Camera, T_map_cam: Pose) -> Plane:
    """An earlier frame's residual where the surfaces of this view were in it; elsewhere its mean."""
    if previous is None or previous.map_index != submap.index:
        return torch.zeros_like(depth)
    mean = torch.nanmean(previous.residual)
    points = (camera.rays() * depth[..., None]).reshape(-1, 3)
    there = se3.transform(se3.inverse(previous.T_map_cam) @ T_map_cam, points)
    pixels = camera.project(torch.cat((there[:, :2], there[:, 2:].clamp_min(1e-3)), dim=1))
    inside = camera.contains(pixels) & (there[:, 2] > 1e-3) & (depth.flatten() > 0)
    columns, rows = pixels.nan_to_num().round().long().unbind(-1)
    read = previous.residual[rows.clamp(0, camera.height - 1), columns.clamp(0, camera.width - 1)]
    return torch.where(inside & ~read.isnan(), read, mean).reshape(depth.shape).nan_to_num()


def seen(claimed: Claim, depth: Plane, T_map_cam: Pose, map_index: int) -> Seen:
    """What comparing a claim with the readings of its frame leaves for the next one."""
    mapped = claimed.rendering.depth
    compared = (mapped > 0) & (depth > 0)
    return Seen(torch.where(compared, (mapped - depth).abs(), torch.nan), T_map_cam, map_index)


@dataclass(frozen=True, eq=False)
class Judged:
    """How well each measure of a claim tells where the map is wrong."""

    scores: Mapping[str, Scores]
    """By measure; without those that are not finite."""
    curves: Mapping[str, Sparsification]
    """Of the same measures."""
    doubt: Values
    """Of the confidence, at some pixels."""
    error: Values
    """There."""


def of_depth(claimed: Claim, true_depth: Plane, valid: Mask, rng: np.random.Generator, sampled: int = 500) -> Judged:
    """Held against the true depth, metres, of the pixels that the map covers; 0 where the truth is not known."""
    depth = claimed.rendering.depth
    compared = valid & (true_depth > 0) & (depth > 0)
    return _judged(claimed, (depth - true_depth).abs(), _bad_depth(depth, true_depth), compared, rng, sampled)


def _bad_depth(depth: Plane, true_depth: Plane) -> Mask:
    return (depth - true_depth).abs() > torch.clamp_min(BAD_SHARE * true_depth, BAD_METERS)


@dataclass(frozen=True)
class FaultTold:
    """How well doubt tells a known fault: areas under the curve, NaN where there is nothing to tell apart."""

    in_picture: float
    """The pixels of the fault from all others, whatever the map shows there."""
    in_map: float
    """Those of the fault at which the map is wrong from all at which it is right. A map that shows what stands behind
    a passer-by is right to be sure of it, and one that still shows him where he was is right to doubt it."""


def of_fault(rendering: Rendering, true_depth: Plane, fault: Mask) -> FaultTold:
    """Held against a known fault, over the pixels that the map covers.

    Args:
        rendering: Of a map that has used the frame.
        true_depth: Of what stands still, metres; 0 where it is not known.
        fault: Where the frame was wrong.
    """
    depth = rendering.depth
    doubt = 1.0 - rendering.confidence / rendering.alpha.clamp_min(1e-3)
    wrong = _bad_depth(depth, true_depth)
    mapped = depth > 0
    compared = mapped & (true_depth > 0) & (fault | ~wrong)
    return FaultTold(_told(doubt, fault, mapped), _told(doubt, fault & wrong, compared))


def _told(doubt: Plane, flags: Mask, among: Mask) -> float:
    return auroc(doubt[among].numpy().astype(np.float64), flags[among].numpy()) if bool(among.any()) else math.nan


def of_color(
    claimed: Claim, shown: Image, picture: Image, valid: Mask, rng: np.random.Generator, sampled: int = 500
) -> Judged:
    """Held against the camera's picture, in units of the colour range, where the map covers it.

    Args:
        claimed: The claim.
        shown: The map's colours, as exposed as the picture.
        picture: RGB in [0, 1].
        valid: Pixels to compare.
        rng: For the sample.
        sampled: Pixels of it.
    """
    error = (shown - picture).abs().mean(dim=-1)
    return _judged(claimed, error, error > BAD_COLOR, valid & (claimed.rendering.depth > 0), rng, sampled)


def _judged(claimed: Claim, error: Plane, bad: Mask, compared: Mask, rng: np.random.Generator, sampled: int) -> Judged:
    mask = compared.numpy()
    if not mask.any():
        return Judged({}, {}, np.empty(0), np.empty(0))

    def flat(plane: Tensor) -> Values:
        return plane.numpy()[mask].astype(np.float64)  # type: ignore[no-any-return]

    e, flags = Ordered.of(flat(error), "an error"), flat(bad).astype(bool)
    controls = [Ordered.of(flat(plane), "a control") for plane in claimed.controls.values()]
    doubts = {name: Ordered.of(flat(plane), "an uncertainty") for name, plane in claimed.doubt.items()}
    picked = rng.integers(0, len(e), sampled)
    return Judged(
        {name: Scores.of(u, e, flags, controls if name == OURS else ()) for name, u in doubts.items()},
        {name: sparsification(u, e) for name, u in doubts.items()},
        doubts[OURS].values[picked],
        e.values[picked],
    )
