"""Closing the holes of a finished submap: what its pictures show and the sensor could not measure.

A structured-light sensor has no reading in the shadow of its own projector, on black and shining things and beyond its
range. The online map leaves such places open: a guess in it would be tracked against, and stand in front of surfaces
that a later frame measures. Once a submap is finished nobody tracks against it, and all its frames are there to object.
"""

from dataclasses import replace

import cv2
import numpy as np
import torch

from tcgsplat.confidence import equations as eq
from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.mapping.seeding import IdSource, SeedingConfig, surface_seeds
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import SubmapView
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.tensors import PerGaussianFlag, Plane

_NEIGHBOURHOOD = 1 / 36
"""Of the image's width: how far about the nearest reading the farthest one is looked for. What hides from the sensor
lies behind the edge that hides it, and there the readings of both sides are some pixels apart."""
_REACH = 1 / 4
"""Of the image's width: farther from any reading nothing is guessed. A picture with a handful of readings would become
a curtain at their depth."""
_BEHIND = 1.02
"""Times the farthest reading nearby: a guess had better lie behind what was measured than in front of it."""


def completed(submap: Submap, config: SeedingConfig, confidence: ConfidenceConfig, rasterizer: Rasterizer) -> Submap:
    """A finished submap with guessed Gaussians where its keyframes show something that is neither mapped nor measured.

    A guess lies a little behind the farthest reading nearby, if there is any within a quarter of the image's width. It
    has the picture's colour and the lowest confidence there is. One that any keyframe has measured free space at is not
    made. All others stay as they are, and so does the order. Guesses have negative ids, unique in a run: nothing else
    tells them from what was measured.

    Args:
        submap: Sealed, with its keyframes.
        config: How dense and how large seeds are, and by how much a reading must lie behind a guess to refute it.
        confidence: For the lowest one.
        rasterizer: Backend.
    """
    ids, view = IdSource(first=-(submap.index + 1) << 32), SubmapView(submap, rasterizer)
    lowest = replace(confidence, initial=confidence.p_min)
    for keyframe in submap.keyframes:
        frame = keyframe.balanced
        if not frame.has_depth:
            continue
        alpha = view(frame.camera, keyframe.T_map_cam).alpha
        open_ = frame.valid & (frame.depth <= 0) & (alpha < config.min_alpha)
        if not bool(open_.any()):
            continue
        guessed = replace(frame, depth=_guessed_depth(frame))
        open_ = open_ & (guessed.depth > 0)
        seeds = surface_seeds(guessed, keyframe.T_map_cam, open_, submap.gaussians.sh_degree, ids, config)
        for other in submap.keyframes:
            seeds = seeds.kept(~_refuted(seeds.means, other, config.behind))
        submap = submap.grown(seeds, lowest)
        view = SubmapView(submap, rasterizer)
    return submap


def _guessed_depth(frame: Frame) -> Plane:
    """The frame's depth, and where there is none, a little more than the farthest reading about the nearest one; 0
    where that is too far away.
    """
    depth = frame.depth.numpy()
    missing = depth <= 0
    distance, labels = cv2.distanceTransformWithLabels(
        missing.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(labels.max() + 1, np.float32)
    of_label[labels[~missing]] = depth[~missing]
    reach = max(round(_NEIGHBOURHOOD * frame.camera.width), 1) // 2 * 2 + 1
    farthest = cv2.dilate(of_label[labels], np.ones((reach, reach), np.uint8))
    guess = np.where(distance <= _REACH * frame.camera.width, np.float32(_BEHIND) * farthest, np.float32(0))
    return torch.from_numpy(np.where(missing, guess, depth))


def _refuted(means: torch.Tensor, keyframe: Keyframe, behind: float) -> PerGaussianFlag:
    """Which centres [n, 3] in the map frame a keyframe has looked through: it has a reading well behind them."""
    camera, depth = keyframe.frame.camera, keyframe.frame.depth
    points = se3.transform(se3.inverse(keyframe.T_map_cam), means)
    z = points[:, 2]
    pixels = camera.project(torch.cat((points[:, :2], z.clamp_min(1e-3)[:, None]), dim=1))
    return (z > 0) & camera.contains(pixels) & (eq.sample_at(depth, pixels) - z > behind)
