"""RGB-D SLAM over local Gaussian submaps with temporal confidence: Section 3.1 of the paper. Read this file first.

A frame travels one way: synchronised, tracked, perhaps a new submap, perhaps grown into the map. The map is then
optimised and judged on a thread of its own while the next frames are tracked, and comes into use a fixed number of
frames later: what a run gives does not depend on how fast either thread was. Nothing flows back except through the
submap. Files, progress and pictures are made by whoever consumes the reports.
"""

import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import torch

from tcgsplat.config import SlamConfig
from tcgsplat.geometry import se3
from tcgsplat.mapping.completion import completed
from tcgsplat.mapping.feedback import judged
from tcgsplat.mapping.mapper import Grown, Mapper
from tcgsplat.mapping.schedule import Schedule
from tcgsplat.mapping.seeding import IdSource
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.atlas import Atlas
from tcgsplat.scene.exposure import UNCHANGED, Exposure
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.scene.trajectory import TrackedPose, Trajectory
from tcgsplat.tensors import Pose
from tcgsplat.tracking.delay import DepthDelay
from tcgsplat.tracking.motion import ConstantVelocity
from tcgsplat.tracking.synchronization import synchronized
from tcgsplat.tracking.tracker import Tracked, Tracker

EXPOSURE_LEAK = 0.01
"""How much nearer to none a keyframe's exposure is taken than it was found. Each is found beside a map that was made
with those before it; an error of theirs that is always the same adds up to a hundred times itself, not more."""


@dataclass(frozen=True)
class MapUpdate:
    """What one mapping update did."""

    frame_index: int
    """Of the frame that it was made for."""
    seeded: int
    pruned: int
    loss: float
    """Eq. 21 at the last step."""
    seconds: float
    """Of optimising and judging, beside tracking."""


@dataclass(frozen=True)
class StepReport:
    """What one frame did."""

    frame_index: int
    tracked: Tracked
    """Its pose is in the submap that was active when the frame came: in `sealed`, where that is given."""
    mapped: bool
    """Whether the frame began a mapping update."""
    update: MapUpdate | None
    """The mapping update, of an earlier frame as a rule, that came into use with this frame."""
    sealed: Submap | None
    """The submap that this frame ended: to be written down, since SLAM forgets it now."""
    submap_index: int
    """Submap that the frame belongs to."""
    gaussians: int
    """In the active submap."""
    seconds: Mapping[str, float]
    """Wall time by stage: waiting for the map, tracking, growing the map."""


@dataclass(frozen=True)
class Reference:
    """What frames are tracked against: the active submap, or where that is a few frames old and not yet optimised, the
    one before it, which still shows the place better.
    """

    submap: Submap
    T_map_reference: Pose = field(default_factory=se3.identity)
    """The reference's frame in that of the active submap."""
    exposure: Exposure = UNCHANGED
    """As the active submap shows what the reference shows."""


class Slam:
    """The whole online system; `step` it through the frames, then `finish`."""

    def __init__(self, config: SlamConfig, rasterizer: Rasterizer, *, live: bool = False) -> None:
        """A system that has seen nothing yet.

        Args:
            config: All settings.
            rasterizer: Backend of tracking and mapping.
            live: Never wait for the map: it comes into use when it is ready, and nothing new is mapped before. For a
                camera that does not wait either; what comes out then depends on the machine's speed.
        """
        self.config = config
        self._live = live
        self._rasterizer, self._device, self._core = rasterizer, rasterizer.device, rasterizer.reserved
        generator = torch.Generator().manual_seed(config.seed)
        self._tracker = Tracker(config.tracker, config.confidence, rasterizer)
        self._mapper = Mapper(config.mapper, config.confidence, rasterizer, IdSource(), generator)
        self._schedule = Schedule(config.schedule)
        self._mapping_thread = ThreadPoolExecutor(1, thread_name_prefix="mapping")
        self._updating: Future[tuple[Submap, MapUpdate]] | None = None
        self._since_mapped = 0
        self._synchronizes = config.tracker.synchronization != "none"
        self._learns_delay = config.tracker.synchronization == "learnt"
        self.motion = ConstantVelocity()
        self.delay = DepthDelay()
        self.submap = self._anchored(se3.identity(), index=0)
        self._reference = Reference(self.submap)
        self.atlas = Atlas().with_submap(self.submap.T_world_map)
        self.trajectory = Trajectory()

    def step(self, frame: Frame) -> StepReport:
        """Track, perhaps switch submap, perhaps map; the first frame's camera is the origin of the world."""
        frame, sealed, clock = frame.to(self._device), None, _Laps()
        self._since_mapped += 1

        # The map that was optimised meanwhile comes into use, after as many frames on a slow machine as on a fast one.
        ready = not self._updates if self._live else self._schedule.adopts(self._since_mapped)
        update = self._finished_update() if ready else None
        clock.lap("wait")

        # Track: the map stands still, only the camera moves (equations 17 to 19).
        velocity, stamped = self.motion.steady, frame.depth_delay
        frame = frame.with_depth_later(self.delay.seconds) if self._learns_delay else frame
        with self._core():
            together = synchronized(frame, velocity) if self._synchronizes else frame
            tracked = self._tracked(together, guess=self.motion.predict(frame.timestamp))
        T_map_cam, exposure = tracked.T_map_cam, tracked.exposure
        advance = self.motion.advanced if tracked.converged else self.motion.coasted
        self.motion = advance(T_map_cam, frame.timestamp)
        if self._learns_delay and tracked.converged and tracked.color and tracked.depth:
            moved = (frame.depth_delay if together is not frame else 0.0) - stamped
            applied = (velocity * moved).numpy()
            self.delay = self.delay.observed(self.motion.steady.numpy(), applied, tracked.color, tracked.depth)
        clock.lap("track")

        # Switch: seal the submap and anchor the next one at this camera (equation 16).
        may_map = tracked.converged and not (self._live and self._updates)
        if may_map and self._schedule.switches_submap(frame.index, T_map_cam, self.submap) and frame.has_depth:
            fresh = self._finished_update()
            clock.lap("wait")
            if fresh is not None:  # all that follows hangs on this pose: it is found again in the newest map
                update, anchor = fresh, self._tracked(together, guess=T_map_cam)
                tracked = anchor if anchor.converged else tracked
                T_map_cam, exposure = tracked.T_map_cam, tracked.exposure
                clock.lap("track")
            sealed = self.submap.sealed(self.config.confidence)
            self._reference = Reference(self.submap, se3.inverse(T_map_cam), tracked.exposure)
            self.submap = self._anchored(self.submap.T_world_map @ T_map_cam, index=len(self.atlas))
            self.atlas = self.atlas.with_submap(self.submap.T_world_map)
            self.motion, T_map_cam, exposure = self.motion.rebased(), se3.identity(), UNCHANGED

        # Map: grow where the view is new, and have it all optimised and judged while the next frames are tracked.
        maps = may_map and self._schedule.maps(self._since_mapped, self.submap)
        if maps:
            update = self._finished_update() or update
            clock.lap("wait")
            with self._core():
                together = synchronized(frame, self.motion.steady) if self._synchronizes else frame
                grown = self._mapper.grown(Keyframe(together, T_map_cam, exposure.relaxed(EXPOSURE_LEAK)), self.submap)
            self.submap, self._since_mapped = grown.submap, 0
            if not grown.first or not len(self._reference.submap):
                self._refer_to(self.submap)
            self._updating = self._mapping_thread.submit(self._updated, grown)
            clock.lap("grow")
            raw = grown.first and self._reference.submap is self.submap  # one picture's seeds are all there is
            if (raw or self.config.schedule.map_lag == 0) and not self._live:
                update = self._finished_update()
                clock.lap("wait")

        row = TrackedPose(
            frame_index=frame.index,
            timestamp=frame.timestamp,
            submap_index=self.submap.index,
            T_map_cam=T_map_cam,
            lost=not tracked.converged,
            mapped=maps,
            exposure=exposure,
        )
        self.trajectory = self.trajectory.with_row(row)
        return StepReport(
            frame_index=frame.index,
            tracked=tracked,
            mapped=maps,
            update=update,
            sealed=sealed,
            submap_index=self.submap.index,
            gaussians=len(self.submap),
            seconds=clock.seconds,
        )

    def finish(self) -> Submap | None:
        """The last submap, sealed like all others, or None if nothing was ever mapped."""
        self._finished_update()
        return self.submap.sealed(self.config.confidence) if self.submap.keyframes else None

    def completed(self, sealed: Submap) -> Submap:
        """A sealed submap with its holes closed by guesses, if the settings say so: for whoever keeps it.

        It takes as long as some frames, reads nothing that changes, and may be called on any thread.
        """
        if not self.config.mapper.complete:
            return sealed
        return completed(sealed, self.config.mapper.seeding, self.config.confidence, self._rasterizer)

    def _tracked(self, frame: Frame, guess: Pose) -> Tracked:
        """The frame's pose and exposure in the active submap, found in the reference."""
        reference = self._reference
        T_map_reference = reference.T_map_reference
        tracked = self._tracker.track(frame, reference.submap, se3.inverse(T_map_reference) @ guess)
        return replace(
            tracked,
            T_map_cam=T_map_reference @ tracked.T_map_cam,
            exposure=tracked.exposure.relative_to(reference.exposure) if tracked.converged else UNCHANGED,
        )

    def _updated(self, grown: Grown) -> tuple[Submap, MapUpdate]:
        """Optimise (equations 20 to 24), then judge what moved (equations 4 to 15); runs beside tracking."""
        started = time.perf_counter()
        mapped = self._mapper.optimized(grown)
        submap = judged(mapped, grown.frame, self.config.confidence, self.config.mapper.depth_mode)
        seconds = time.perf_counter() - started
        frame_index = grown.submap.keyframes[-1].frame.index
        return submap, MapUpdate(frame_index, grown.seeded, mapped.pruned, mapped.loss, seconds)

    @property
    def _updates(self) -> bool:
        """Whether a mapping update is being worked on."""
        return self._updating is not None and not self._updating.done()

    def _finished_update(self) -> MapUpdate | None:
        """Wait for the update that is under way, if any, and use its map from now on."""
        if self._updating is None:
            return None
        self.submap, update = self._updating.result()
        self._updating = None
        self._refer_to(self.submap)
        return update

    def _refer_to(self, submap: Submap) -> None:
        """Track against the active submap from now on, if there is anything in it."""
        if len(submap):
            self._reference = Reference(submap)

    def _anchored(self, T_world_map: torch.Tensor, index: int) -> Submap:
        return Submap.anchored(T_world_map, index, self.config.mapper.sh_degree, self._device)


class _Laps:
    """Wall time by stage."""

    def __init__(self) -> None:
        self.seconds = {"wait": 0.0, "track": 0.0, "grow": 0.0}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] += now - self._last
        self._last = now
