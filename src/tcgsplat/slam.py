"""RGB-D SLAM over local Gaussian submaps with temporal confidence: Section 3.1 of the paper. Read this file first.

A frame travels one way: tracked pose, perhaps a new submap, mapped submap, judged submap, report. Nothing flows back
except through the submap. Files, progress and pictures are made by whoever consumes the reports.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass

import torch

from tcgsplat.config import SlamConfig
from tcgsplat.geometry import se3
from tcgsplat.mapping.feedback import judged
from tcgsplat.mapping.mapper import Mapped, Mapper
from tcgsplat.mapping.schedule import Schedule
from tcgsplat.mapping.seeding import IdSource
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.atlas import Atlas
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Submap
from tcgsplat.scene.trajectory import TrackedPose, Trajectory
from tcgsplat.tracking.motion import ConstantVelocity
from tcgsplat.tracking.tracker import Tracked, Tracker


@dataclass(frozen=True)
class StepReport:
    """What one frame did."""

    frame_index: int
    tracked: Tracked
    """Its pose is in the submap that was active when the frame came: in `sealed`, where that is given."""
    mapped: Mapped | None
    """None where the frame was not mapped. Holds the submap with its keyframes: read it, do not keep it."""
    sealed: Submap | None
    """The submap that this frame ended: to be written down, since SLAM forgets it now."""
    submap_index: int
    """Submap that the frame belongs to."""
    gaussians: int
    """In the active submap."""
    seconds: Mapping[str, float]
    """Wall time by stage: track, map."""


class Slam:
    """The whole online system; `step` it through the frames, then `finish`."""

    def __init__(self, config: SlamConfig, rasterizer: Rasterizer) -> None:
        self.config = config
        self._device = rasterizer.device
        generator = torch.Generator().manual_seed(config.seed)
        self._tracker = Tracker(config.tracker, config.confidence, rasterizer)
        self._mapper = Mapper(config.mapper, config.confidence, rasterizer, IdSource(), generator)
        self._schedule = Schedule(config.schedule)
        self.motion = ConstantVelocity()
        self.submap = self._anchored(se3.identity(), index=0)
        self.atlas = Atlas().with_submap(self.submap.T_world_map)
        self.trajectory = Trajectory()

    def step(self, frame: Frame) -> StepReport:
        """Track, perhaps switch submap, perhaps map; the first frame's camera is the origin of the world."""
        frame, mapped, sealed = frame.to(self._device), None, None
        started = time.perf_counter()

        # Track: the map stands still, only the camera moves (equations 17 to 19).
        tracked = self._tracker.track(frame, self.submap, guess=self.motion.predict(frame.timestamp))
        T_map_cam = tracked.T_map_cam
        advance = self.motion.advanced if tracked.converged else self.motion.coasted
        self.motion = advance(T_map_cam, frame.timestamp)
        tracked_at = time.perf_counter()

        # Switch: seal the submap and anchor the next one at this camera (equation 16).
        if tracked.converged and self._schedule.switches_submap(frame.index, T_map_cam, self.submap):
            sealed = self.submap.sealed(self.config.confidence)
            self.submap = self._anchored(self.submap.T_world_map @ T_map_cam, index=len(self.atlas))
            self.atlas = self.atlas.with_submap(self.submap.T_world_map)
            self.motion, T_map_cam = self.motion.rebased(), se3.identity()

        # Map: grow where the view is new, optimise (equations 20 to 24), judge what moved (equations 4 to 15).
        if tracked.converged and self._schedule.maps(frame.index, self.submap):
            mapped = self._mapper.map(frame, T_map_cam, self.submap)
            self.submap = judged(mapped, frame, self.config.confidence, self.config.mapper.depth_mode)

        self.trajectory = self.trajectory.with_row(
            TrackedPose(
                frame.index,
                frame.timestamp,
                self.submap.index,
                T_map_cam,
                lost=not tracked.converged,
                mapped=mapped is not None,
            )
        )
        return StepReport(
            frame_index=frame.index,
            tracked=tracked,
            mapped=mapped,
            sealed=sealed,
            submap_index=self.submap.index,
            gaussians=len(self.submap),
            seconds={"track": tracked_at - started, "map": time.perf_counter() - tracked_at},
        )

    def finish(self) -> Submap | None:
        """The last submap, sealed like all others, or None if nothing was ever mapped."""
        return self.submap.sealed(self.config.confidence) if self.submap.keyframes else None

    def _anchored(self, T_world_map: torch.Tensor, index: int) -> Submap:
        return Submap.anchored(T_world_map, index, self.config.mapper.sh_degree, self._device)
