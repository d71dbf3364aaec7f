"""Where a picture stands in a map that was not made of it, and whether to believe it."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.loop.settings import LoopConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Submap
from tcgsplat.tensors import Pose
from tcgsplat.tracking.settings import TrackerConfig
from tcgsplat.tracking.tracker import Tracked, Tracker

ALIKE = 64
"""Residuals that count as one measurement: those of neighbouring pixels are alike. With it, the errors of registered
views on a synthetic apartment with a Kinect's noise were as large as their covariance says (chi2 a degree of freedom
1.6 at the median, without any floor)."""
_SETTLED_METERS, _SETTLED_RADIANS = 0.005, 0.005
"""A second alignment, begun where the first ended, may move the pose by no more: else it has not arrived."""


@dataclass(frozen=True, eq=False)
class Localized:
    """A picture in a map, and why its pose is not believed, if it is not."""

    tracked: Tracked
    failed: str
    """Why not; empty if it is believed."""

    @property
    def information(self) -> Float64[np.ndarray, "6 6"]:
        """Inverse covariance of a left perturbation of map to camera, translation first; zero if nothing is known."""
        tracked = self.tracked
        if tracked.color is None or tracked.depth is None:
            return np.zeros((6, 6))
        H = (tracked.color.H + tracked.depth.H) / ALIKE
        return np.asarray(0.5 * (H + H.T))


class Localizer:
    """Aligns pictures to maps, from guesses that may be wrong."""

    def __init__(
        self, config: LoopConfig, tracker: TrackerConfig, confidence: ConfidenceConfig, rasterizer: Rasterizer
    ) -> None:
        self._config = config
        self._tracker = Tracker(replace(tracker, solver="alignment"), confidence, rasterizer)

    def localized(self, frame: Frame, submap: Submap, guesses: Iterable[Pose]) -> Localized:
        """The pose of a picture in a submap, from the first guess that leads to one that is believed.

        Args:
            frame: The picture; depth helps, and is not needed.
            submap: Where it may be.
            guesses: `T_map_cam`, the best first. None at all is a failure, too.
        """
        frame = frame.to(submap.device)  # where its pictures are
        nowhere = Tracked(se3.identity(), "nothing tells where in the map it might be", coverage=0.0)
        found = Localized(nowhere, "no guess")
        for guess in guesses:
            found = self._from(guess, frame, submap)
            if not found.failed:
                break
        return found

    def _from(self, guess: Pose, frame: Frame, submap: Submap) -> Localized:
        first = self._tracker.track(frame, submap, guess)
        second = self._tracker.track(frame, submap, first.T_map_cam) if first.converged else first
        if not second.converged:
            return Localized(second, second.lost)
        return Localized(second, self._objection(first, second))

    def _objection(self, first: Tracked, second: Tracked) -> str:
        """What speaks against a pose; empty if nothing does."""
        config = self._config
        moved = se3.inverse(first.T_map_cam) @ second.T_map_cam
        step, turn = se3.translation_norm(moved), se3.rotation_angle(moved)
        if step > _SETTLED_METERS or turn > _SETTLED_RADIANS:
            return f"its pose is not settled: it moved on by {1e3 * step:.0f} mm and {math.degrees(turn):.1f} degrees"
        if second.coverage < config.min_coverage:
            return f"the map covers only {100 * second.coverage:.0f} % of it"
        if second.agreement < config.min_agreement:
            return f"only {100 * second.agreement:.0f} % of its depth agrees with the map"
        if second.correlation < config.min_correlation:
            return f"its colours correlate by only {second.correlation:.2f} with the map's"
        return ""
