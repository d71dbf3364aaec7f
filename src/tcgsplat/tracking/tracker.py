"""Tracking: one frame against the standing submap, by the solver that the configuration names.

A failure is a result: the frame is reported lost, keeps the predicted pose, and is not mapped.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from tcgsplat.confidence import equations as eq
from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import Rendering, SubmapView, render_view
from tcgsplat.scene.exposure import UNCHANGED, Exposure
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Submap
from tcgsplat.tensors import Pose
from tcgsplat.tracking import cuda_alignment, pyramids
from tcgsplat.tracking.alignment import Equations, align, correlation
from tcgsplat.tracking.descent import descend
from tcgsplat.tracking.pyramids import luma
from tcgsplat.tracking.reference import ReferenceView, reference_view
from tcgsplat.tracking.settings import TrackerConfig


@dataclass(frozen=True)
class Tracked:
    """Where the camera is, and how sure that is."""

    T_map_cam: Pose
    """The solver's pose, or the guess where `lost`."""
    lost: str = ""
    """Why the solver's pose is not believed; empty if it is."""
    iterations: int = 0
    """Passes or steps of the solver."""
    coverage: float = 1.0
    """Share of the frame's valid pixels that the map covers, as seen from where it was rendered."""
    overlap: float = 1.0
    """Share of the mapped view that is in the picture."""
    agreement: float = 1.0
    """Share of the depth readings there that agree with the map."""
    correlation: float = 1.0
    """Between the colours of the picture and of the map, in [-1, 1]."""
    exposure: Exposure = UNCHANGED
    """Of the picture, beside the map's."""
    color: Equations | None = None
    """What colour alone asks for at this pose, from solvers that know."""
    depth: Equations | None = None
    """What depth alone asks for there."""

    @property
    def converged(self) -> bool:
        """Whether the pose may be mapped with."""
        return not self.lost


def _compared(rendering: Rendering, frame: Frame, gate: float) -> tuple[float, float, float, float]:
    """Share of valid pixels that are covered, of those the share that have a reading, of these the share whose depth
    agrees, and the correlation of colours.
    """
    rendering, frame = rendering.cpu(), frame.cpu()
    depth = rendering.depth
    both = (depth > 0) & (frame.depth > 0) & frame.valid
    agreeing = both & ((depth - frame.depth).abs() < gate * (1 + 0.5 * frame.depth))
    covered = float((depth > 0).sum())
    pixels = ((depth > 0) & frame.valid).numpy()
    x, y = luma(rendering.color)[pixels].astype(np.float64), luma(frame.color)[pixels].astype(np.float64)
    return (
        len(x) / max(float(frame.valid.sum()), 1.0),
        float(both.sum()) / max(covered, 1.0),
        float(agreeing.sum()) / max(float(both.sum()), 1.0),
        correlation(len(x), x.sum(), y.sum(), x @ x, x @ y, y @ y),
    )


class Tracker:
    """Finds a frame's pose in the active submap (Eqs. 17 to 19)."""

    def __init__(self, config: TrackerConfig, confidence: ConfidenceConfig, rasterizer: Rasterizer) -> None:
        self._config = config
        self._floor = confidence.tracking_floor if confidence.guide_tracking else None
        self._rasterizer = rasterizer
        self._drawing: SubmapView | None = None
        self._view: ReferenceView[Any] | None = None

    def track(self, frame: Frame, submap: Submap, guess: Pose) -> Tracked:
        """Pose of `frame` in `submap`, starting from `guess` (`T_map_cam`).

        In an empty submap the guess is the pose, unless there is no depth to begin a map with.
        """
        if len(submap) == 0:
            lost = "" if frame.has_depth else "there is no map yet, and no depth to begin one with"
            return Tracked(guess, lost, coverage=0.0)
        if self._config.solver == "descent":
            found = descend(frame, submap, guess, self._rasterizer, self._config.descent, floor=self._floor)
            rendering = render_view(submap, frame.camera, found.T_map_cam, self._rasterizer)
            compared = _compared(rendering, frame, self._config.alignment.gate)
            return self._believed(guess, Tracked(found.T_map_cam, "", found.iterations, *compared))
        kept = self._kept_view(submap, frame.camera, guess)
        tracked = None if kept is None else self._aligned(frame, kept, guess)
        if tracked is None or not tracked.converged:
            self._view = self._reference_view(submap, frame.camera, guess)
            tracked = self._aligned(frame, self._view, guess)
        return tracked

    def _kept_view(self, submap: Submap, camera: Camera, guess: Pose) -> ReferenceView[Any] | None:
        """The last one, if it is of this map and from near the guess."""
        view, config = self._view, self._config
        if view is None or self._drawing is None or self._drawing.submap is not submap or view.camera != camera:
            return None
        T_ref_guess = se3.inverse(view.T_map_ref) @ guess
        turned = math.degrees(se3.rotation_angle(T_ref_guess))
        near = se3.translation_norm(T_ref_guess) <= config.view_distance and turned <= config.view_angle
        return view if near else None

    def _aligned(self, frame: Frame, view: ReferenceView[Any], guess: Pose) -> Tracked:
        """By the solver where the view is, on a GPU or on the CPU."""
        if isinstance(view.solid_points, torch.Tensor):
            images = cuda_alignment.images(view.solid_points.device)
            there = frame.to(view.solid_points.device)
            found = cuda_alignment.align(images, there, view, guess, self._config.alignment)
        else:
            found = align(frame.cpu(), view, guess, self._config.alignment)
        tracked = Tracked(
            found.T_map_cam,
            iterations=found.iterations,
            coverage=found.coverage,
            overlap=found.overlap,
            agreement=found.agreement,
            correlation=found.correlation,
            exposure=found.exposure if self._config.exposure else UNCHANGED,
            color=found.color,
            depth=found.depth,
        )
        return self._believed(guess, tracked)

    def _reference_view(self, submap: Submap, camera: Camera, T_map_ref: Pose) -> ReferenceView[Any]:
        """The map seen from there: on a GPU if it is drawn there, else on the CPU."""
        if self._drawing is None or self._drawing.submap is not submap:
            self._drawing = SubmapView(submap, self._rasterizer)
        rendering = self._drawing(camera, T_map_ref)
        rendering = rendering if rendering.alpha.is_cuda else rendering.cpu()
        if self._floor is None:
            weight = torch.ones_like(rendering.confidence)
        else:
            weight = eq.tracking_weight(rendering.confidence, floor=self._floor)
        seen = (rendering, weight, camera, T_map_ref, self._config.alignment)
        if rendering.alpha.is_cuda:
            return reference_view(cuda_alignment.images(rendering.alpha.device), *seen)
        return reference_view(pyramids, *seen)

    def _believed(self, guess: Pose, found: Tracked) -> Tracked:
        """The solver's answer, or the guess and the reason why not."""
        config = self._config
        reason = ""
        if not bool(torch.isfinite(found.T_map_cam).all()):
            reason = "the solver diverged"
        else:
            moved = se3.inverse(guess) @ found.T_map_cam
            step, turn = se3.translation_norm(moved), math.degrees(se3.rotation_angle(moved))
            if step > config.max_step or turn > config.max_turn:
                reason = f"a step of {100 * step:.0f} cm and {turn:.0f} degrees from the predicted pose"
            elif found.overlap < config.min_overlap:
                reason = f"only {100 * found.overlap:.0f} % of the mapped view is in the picture"
            elif found.agreement < config.min_agreement:
                reason = f"only {100 * found.agreement:.0f} % of the depth agrees with the map"
            elif not found.correlation >= config.min_correlation:  # NaN, too
                reason = f"its colours correlate by only {found.correlation:.2f} with the map's"
        if reason:
            return replace(found, T_map_cam=guess, lost=reason, exposure=UNCHANGED)
        return replace(found, T_map_cam=se3.orthonormalized(found.T_map_cam))
