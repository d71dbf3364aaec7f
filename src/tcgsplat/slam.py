"""RGB-D SLAM over local Gaussian submaps with temporal confidence: Section 3.1 of the paper. Read this file first.

A frame travels one way: synchronised, tracked, perhaps a new submap, perhaps grown into the map. The map is then
optimised and judged on a thread of its own while the next frames are tracked, and comes into use a fixed number of
frames later: what a run gives does not depend on how fast either thread was. A finished submap is put away and compared
with those before it on a third thread; what follows moves submaps as a whole. Nothing flows back except through the
submap and where it stands. Progress and pictures are made by whoever consumes the reports.
"""

import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import takewhile

import torch

from tcgsplat.config import SlamConfig
from tcgsplat.geometry import se3
from tcgsplat.loop.closer import Closure, LoopCloser, import_late_modules
from tcgsplat.loop.edge import Edge, odometry
from tcgsplat.loop.places import measured
from tcgsplat.loop.relocalization import Relocalized
from tcgsplat.mapping.completion import completed
from tcgsplat.mapping.feedback import judged
from tcgsplat.mapping.mapper import Grown, Mapper
from tcgsplat.mapping.optimization import never
from tcgsplat.mapping.schedule import Schedule
from tcgsplat.mapping.seeding import IdSource
from tcgsplat.priority import step_back
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import render_view
from tcgsplat.scene.atlas import Atlas
from tcgsplat.scene.exposure import UNCHANGED, Exposure
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.scene.trajectory import TrackedPose, Trajectory
from tcgsplat.storage.checkpoint import Checkpoint
from tcgsplat.storage.store import InMemory, SubmapStore
from tcgsplat.tensors import Pose
from tcgsplat.tracking.delay import DepthDelay
from tcgsplat.tracking.motion import ConstantVelocity
from tcgsplat.tracking.smoothing import smoothed
from tcgsplat.tracking.synchronization import synchronized
from tcgsplat.tracking.tracker import Tracked, Tracker

EXPOSURE_LEAK = 0.01
"""How much nearer to none a keyframe's exposure is taken than it was found. Each is found beside a map that was made
with those before it; an error of theirs that is always the same adds up to a hundred times itself, not more."""
KNOWN = 0.5
"""Share of what a live camera measures that is in the map, below which the map is grown as soon as may be: where half
is new, the rest is soon out of the picture."""
BEHIND = 3
"""Finished submaps that a live system keeps waiting; with more, it remembers the next one and compares it with none:
each holds its pictures while it waits, and a lost camera waits for all of them."""


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
    """Its pose is in the submap that was active when the frame came: in `sealed`, where that is given. Of a frame that
    was found again it is in the submap where it was found."""
    mapped: bool
    """Whether the frame began a mapping update."""
    update: MapUpdate | None
    """The mapping update, of an earlier frame as a rule, that came into use with this frame."""
    sealed: Submap | None
    """The submap that this frame ended."""
    closure: Closure | None
    """What comparing an earlier submap with those before it has shown, if it came into use with this frame."""
    found: Relocalized | None
    """Where the camera is after some lost frames, if the place was known again."""
    submap_index: int
    """Submap that the frame belongs to."""
    gaussians: int
    """In the active submap."""
    seconds: Mapping[str, float]
    """Wall time by stage: waiting for the map, tracking, looking up a lost frame, growing the map."""


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

    def __init__(
        self,
        config: SlamConfig,
        rasterizer: Rasterizer,
        *,
        live: bool = False,
        store: SubmapStore | None = None,
        mapper: Callable[..., Mapper] = Mapper,
    ) -> None:
        """A system that has seen nothing yet.

        Args:
            config: All settings.
            rasterizer: Backend of tracking and mapping.
            live: Never wait for the map: it grows beside tracking, is optimised until the next frame is due to be
                mapped or the submap to end, and comes into use when it is ready. For a camera that does not wait
                either; what comes out then depends on the machine's speed.
            store: Where finished submaps go, and are read back from when their place is seen again; if left out,
                memory.
            mapper: Makes the mapper, of the arguments of `Mapper`: for experiments with another one.
        """
        self.config = config
        self._live = live
        self._rasterizer, self._device, self._core = rasterizer, rasterizer.device, rasterizer.reserved
        self._store = InMemory() if store is None else store
        self._ids = IdSource()
        # Not `torch.Generator()`, which is not to be had in a process that `cli.imports` has made start at once.
        self._generator = torch.default_generator.clone_state().manual_seed(config.seed)
        self._tracker = Tracker(config.tracker, config.confidence, rasterizer)
        self._mapper = mapper(config.mapper, config.confidence, rasterizer, self._ids, self._generator)
        self._schedule = Schedule(config.schedule)
        self._closer = LoopCloser(
            config.loop, config.tracker, config.confidence, rasterizer, self._store.load_submap, config.seed
        )
        if live and config.loop.enabled:
            import_late_modules()
        behind = step_back if live else None  # a camera's next frame does not wait
        self._mapping_thread = ThreadPoolExecutor(1, thread_name_prefix="mapping", initializer=behind)
        self._growing: Future[Grown] | None = None
        self._updating: Future[tuple[Submap, MapUpdate]] | None = None
        self._since_mapped, self._presses = 0, False
        self._keeping_thread = ThreadPoolExecutor(1, thread_name_prefix="keeping", initializer=behind)
        self._keeping: deque[Future[Closure]] = deque()
        self._since_sealed = 0
        self._resumed_at: int | None = None
        self._synchronizes = config.tracker.synchronization != "none"
        self._learns_delay = config.tracker.synchronization == "learnt"
        self.motion = ConstantVelocity()
        self.delay = DepthDelay()
        self.lost = 0
        self.submap = self._anchored(se3.identity(), index=0)
        self.reference = Reference(self.submap)
        self.atlas = Atlas().with_submap(self.submap.T_world_map)
        self.trajectory = Trajectory()
        self.closures: tuple[Closure, ...] = ()

    @staticmethod
    def resumed(config: SlamConfig, rasterizer: Rasterizer, store: SubmapStore, checkpoint: Checkpoint) -> "Slam":
        """The system as it was when it made a checkpoint; the next frame to step it through is `frame_index`.

        All that follows is what followed then, to the bit.
        """
        slam, then = Slam(config, rasterizer, store=store), checkpoint
        slam.trajectory, slam.atlas, slam.motion, slam.delay = then.trajectory, then.atlas, then.motion, then.delay
        slam.submap = slam._anchored(then.atlas.T_world_map[then.sealed], index=then.sealed)
        reference = measured(store.load_submap(then.reference)).to(slam._device)
        slam.reference = Reference(reference, then.T_map_reference, then.exposure)
        slam._ids.next, slam._resumed_at = then.next_id, then.frame_index
        slam._generator.set_state(then.generator)
        if config.loop.enabled:
            *edges, newest = then.edges
            slam._closer.restore(then.atlas.T_world_map[:-1], edges)
            slam._keeping.append(slam._keeping_thread.submit(slam._closer.closed, then.sealed - 1, newest))
        return slam

    def step(self, frame: Frame) -> StepReport:
        """Track, perhaps switch submap, perhaps map; the first frame's camera is the origin of the world."""
        frame, sealed, found, clock = frame.cpu(), None, None, _Laps()
        frame = smoothed(frame) if self.config.tracker.smoothing else frame
        self._since_mapped += 1

        # The map that was optimised meanwhile comes into use, and the submaps stand where comparing the last one with
        # those before has shown them to be: after as many frames on a slow machine as on a fast one.
        if self._growing is not None and self._growing.done():  # a live system's: else it has been waited for
            self._take_growth()
        update = self._finished_update() if self._adopts_update else None
        closure = self._finished_closure(wait=not self._live) if self._adopts_closure else None
        clock.lap("wait")

        # Track: the map stands still, only the camera moves (equations 17 to 19).
        resumed = frame.index == self._resumed_at  # it was tracked before the run was interrupted, and anchors a submap
        tracked = Tracked(se3.identity()) if resumed else self._moved(frame)
        T_map_cam, exposure = tracked.T_map_cam, tracked.exposure
        clock.lap("track")

        # Lost for a while: the place is looked up, in this submap and in all before.
        if self._looks_up and frame.has_depth:
            update, closure = self._finished_update() or update, self._finished_closure() or closure
            found = self._closer.relocalized(self._synchronized(frame), self.submap)
            clock.lap("relocalize")
        if found is not None:
            self.lost, tracked = 0, found.tracked
            T_map_cam, exposure = tracked.T_map_cam, tracked.exposure
            self.motion = self.motion.advanced(T_map_cam, frame.timestamp)
        elsewhere = found.reference if found is not None and found.reference is not self.submap else None

        # Switch: seal the submap and anchor the next one at this camera (equation 16), which may be in an old submap.
        far = tracked.converged and self._schedule.switches_submap(frame.index, T_map_cam, self.submap)
        leaves = far and frame.has_depth
        may_map = tracked.converged and not (self._live and self._updates)
        switches = leaves and may_map
        self._presses = leaves or (self._live and tracked.coverage < KNOWN * frame.measured)
        if switches or elsewhere is not None:
            fresh = self._finished_update()
            closure = closure if self._live else self._finished_closure() or closure
            clock.lap("wait")
            if fresh is not None:  # all that follows hangs on this pose: it is found again in the newest map
                update, anchor = fresh, self._tracked(self._synchronized(frame), guess=T_map_cam)
                tracked = anchor if anchor.converged else tracked
                clock.lap("track")
            sealed = self._switched(frame.index, tracked, elsewhere)
            T_map_cam, exposure = se3.identity(), UNCHANGED

        # Map: grow where the view is new, and have it all optimised and judged while the next frames are tracked.
        maps = may_map and self._schedule.maps(frame.index, self._since_mapped, self.submap)
        if maps:
            update = self._finished_update() or update
            clock.lap("wait")
            keyframe = Keyframe(self._synchronized(frame), T_map_cam, exposure.relaxed(EXPOSURE_LEAK))
            self._growing = self._mapping_thread.submit(self._grown, keyframe, self.submap, self.reference)
            self._updating = self._mapping_thread.submit(self._updated, self._growing)
            self._since_mapped, self._presses = 0, False
            if not self._live or not len(self.reference.submap):
                self._take_growth()
            clock.lap("grow")
            raw = len(self.submap.keyframes) == 1 and self.reference.submap is self.submap  # seeds are all there is
            if (raw or self.config.schedule.map_lag == 0) and not self._live:
                update = self._finished_update()
                clock.lap("wait")
        self._since_sealed += 1

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
            closure=closure,
            found=found,
            submap_index=self.submap.index,
            gaussians=len(self.submap),
            seconds=clock.seconds,
        )

    def finish(self) -> Submap | None:
        """The last submap, sealed, kept and compared like all others; None if nothing was ever mapped."""
        self._finished_update()
        self._finished_closure()
        if not self.submap.keyframes:
            return None
        sealed = self._sealed()
        self._keeping.append(self._keeping_thread.submit(self._kept, sealed, None, None))
        self._finished_closure()
        return sealed

    def abandon(self) -> None:
        """Give up what is queued on the other threads, so that nobody waits for it; nothing can be done after that."""
        for thread in (self._mapping_thread, self._keeping_thread):
            thread.shutdown(wait=False, cancel_futures=True)

    def rescue(self) -> Submap | None:
        """The last submap kept after a step, or `finish`, has failed because a device had too little memory.

        Nothing is computed on the device any more: an update under way is given up, and the submap is kept as it was
        before that, or was seeded, with its holes open, and compared with none.
        """
        for under_way in (self._growing, self._updating):
            if under_way is not None:
                under_way.exception()  # waits, and raises nothing
        self._growing = self._updating = None
        self._keeping = deque(keeping for keeping in self._keeping if keeping.exception() is None)
        self._finished_closure()
        if not self.submap.keyframes:
            return None
        self.submap = self.submap.cpu()
        sealed = self._sealed()
        self._store.keep(sealed, None)
        return sealed

    def _moved(self, frame: Frame) -> Tracked:
        """The frame tracked, and what it tells of motion and of the depth images' delay."""
        velocity = self.motion.steady
        with self._core():
            together = self._synchronized(frame)
            tracked = self._tracked(together, guess=self.motion.predict(frame.timestamp))
        if not tracked.converged:
            self.lost, self.motion = self.lost + 1, self.motion.coasted(tracked.T_map_cam, frame.timestamp)
            return tracked
        self.lost, self.motion = 0, self.motion.advanced(tracked.T_map_cam, frame.timestamp)
        if self._learns_delay and tracked.color and tracked.depth:
            moved = self.delay.seconds if together.depth is not frame.depth else -frame.depth_delay
            applied = (velocity * moved).numpy()
            self.delay = self.delay.observed(self.motion.steady.numpy(), applied, tracked.color, tracked.depth)
        return tracked

    def _synchronized(self, frame: Frame) -> Frame:
        """The frame with its depth as at the instant of its colours, as far as delay and velocity are known now."""
        if not self._synchronizes:
            return frame
        later = frame.with_depth_later(self.delay.seconds) if self._learns_delay else frame
        return synchronized(later, self.motion.steady)

    def _tracked(self, frame: Frame, guess: Pose) -> Tracked:
        """The frame's pose and exposure in the active submap, found in the reference."""
        reference = self.reference
        T_map_reference = reference.T_map_reference
        tracked = self._tracker.track(frame, reference.submap, se3.inverse(T_map_reference) @ guess)
        return replace(
            tracked,
            T_map_cam=T_map_reference @ tracked.T_map_cam,
            exposure=tracked.exposure.relative_to(reference.exposure) if tracked.converged else UNCHANGED,
        )

    def _switched(self, frame_index: int, tracked: Tracked, elsewhere: Submap | None) -> Submap:
        """Seal the active submap and begin the next one at a frame tracked in it, or found again in another one."""
        sealed, index = self._sealed(), len(self.atlas)
        reference = sealed if elsewhere is None else elsewhere.to(self._device)
        edge = odometry(index, reference.index, tracked.T_map_cam)
        self.submap = self._anchored(self.atlas.T_world_map[reference.index] @ tracked.T_map_cam, index)
        self.atlas = self.atlas.with_submap(self.submap.T_world_map)
        self.motion = self.motion.rebased()
        self.reference = Reference(reference, se3.inverse(tracked.T_map_cam), tracked.exposure)
        checkpoint = Checkpoint(
            frame_index=frame_index,
            sealed=index,
            trajectory=self.trajectory,
            atlas=self.atlas,
            edges=(*self._closer.edges, edge),
            motion=self.motion,
            delay=self.delay,
            reference=reference.index,
            T_map_reference=self.reference.T_map_reference,
            exposure=self.reference.exposure,
            next_id=self._ids.next,
            generator=self._generator.get_state(),
            exact=not self._live,
        )
        self._keeping.append(self._keeping_thread.submit(self._kept, sealed, checkpoint, edge))
        self._since_sealed = 0
        return sealed

    def _sealed(self) -> Submap:
        """The active submap as it is kept: calibrated (Eq. 16), and where it stands by now."""
        sealed = self.submap.sealed(self.config.confidence)
        return replace(sealed, T_world_map=self.atlas.T_world_map[sealed.index])

    def _kept(self, sealed: Submap, checkpoint: Checkpoint | None, edge: Edge | None) -> Closure:
        """Put a finished submap away, its holes closed by guesses, and compare it; runs beside all else.

        From here on it is in the CPU's memory, or on disk: a device holds what is tracked against and mapped.
        """
        whole = sealed.cpu()
        if self.config.mapper.complete:
            try:
                whole = completed(whole, self.config.mapper.seeding, self.config.confidence, self._rasterizer)
            except torch.OutOfMemoryError:  # the run ends; it cannot go on from here to the same bits
                self._store.keep(whole, None)
                raise
        self._store.keep(whole, checkpoint)
        if not self.config.loop.enabled:
            return Closure(sealed.index)
        behind = self._live and len(self._keeping) > BEHIND
        return self._closer.closed(sealed.index, edge, compare=not behind)

    def _grown(self, keyframe: Keyframe, submap: Submap, before: Reference) -> Grown:
        """The submap with a keyframe taken in, and seeds where that shows something new.

        The view that a submap begins with is compared with what the one before shows of it: its own map shows nothing.
        """
        known = None
        if not submap.keyframes and len(before.submap) and self.config.confidence.model != "paper":
            T_reference_cam = se3.inverse(before.T_map_reference) @ keyframe.T_map_cam
            known = render_view(before.submap, keyframe.frame.camera, T_reference_cam, self._rasterizer)
        return self._mapper.grown(keyframe, submap, known)

    def _updated(self, growing: Future[Grown]) -> tuple[Submap, MapUpdate]:
        """Optimise (equations 20 to 24), then judge what moved (equations 4 to 15); runs beside tracking."""
        grown, started = growing.result(), time.perf_counter()
        mapped = self._mapper.optimized(grown, self._makes_room if self._live else never)
        config = self.config
        submap = judged(mapped, grown.frame, config.confidence, config.mapper.depth_mode, self._rasterizer)
        seconds = time.perf_counter() - started
        frame_index = grown.submap.keyframes[-1].frame.index
        return submap, MapUpdate(frame_index, grown.seeded, mapped.pruned, mapped.loss, seconds)

    def _makes_room(self, steps: int) -> bool:
        """Whether the update under way ends after so many steps.

        At once if little of what is seen is in the map, or if the submap is to end: the farther the camera goes on, the
        less will be, and the next submap hangs on the pose that is found there. For a frame that is due to be mapped,
        after half the steps.
        """
        half = 2 * steps >= self.config.mapper.iterations  # of a submap's first, too, which is waited for
        return self._presses or (half and self._schedule.due(self._since_mapped))

    def _take_growth(self) -> None:
        """Wait for the map that is growing, if any, and use it from now on, not yet optimised."""
        if self._growing is None:
            return
        grown, self._growing = self._growing.result(), None
        self.submap = grown.submap
        if not grown.first or not len(self.reference.submap):
            self._refer_to(self.submap)

    @property
    def _updates(self) -> bool:
        """Whether a mapping update is being worked on."""
        return self._updating is not None and not self._updating.done()

    @property
    def _adopts_update(self) -> bool:
        """Whether the update under way comes into use now."""
        return not self._updates if self._live else self._schedule.adopts(self._since_mapped)

    @property
    def _adopts_closure(self) -> bool:
        """Whether the closure under way comes into use now."""
        if self._live:
            return bool(self._keeping) and self._keeping[0].done()
        return self._since_sealed >= self.config.loop.lag

    @property
    def _looks_up(self) -> bool:
        """Whether the camera has been lost for so long that its place is looked up now."""
        config = self.config.loop
        return config.enabled and self.lost > 0 and self.lost % config.relocalize_after == 0

    def _finished_update(self) -> MapUpdate | None:
        """Wait for the update that is under way, if any, and use its map from now on."""
        self._take_growth()
        if self._updating is None:
            return None
        self.submap, update = self._updating.result()
        self._updating = None
        self._refer_to(self.submap)
        return update

    def _finished_closure(self, *, wait: bool = True) -> Closure | None:
        """The closures under way, waited for or as far as they are done; the submaps stand where the last one says."""
        ended = takewhile(lambda closing: wait or closing.done(), tuple(self._keeping))
        closures = [closing.result() for closing in ended]
        for closure in closures:
            self._keeping.popleft()
            self.atlas = self.atlas.corrected(closure.T_world_map)
        if closures:  # what an older one says of all submaps and edges, the newest says too
            older = (*self.closures[-1:], *closures[:-1])
            self.closures = (*self.closures[:-1], *(closure.brief() for closure in older), closures[-1])
        return closures[-1] if closures else None

    def _refer_to(self, submap: Submap) -> None:
        """Track against the active submap from now on, if there is anything in it."""
        if len(submap):
            self.reference = Reference(submap)

    def _anchored(self, T_world_map: torch.Tensor, index: int) -> Submap:
        return Submap.anchored(T_world_map, index, self.config.mapper.sh_degree, self._device)


class _Laps:
    """Wall time by stage."""

    def __init__(self) -> None:
        self.seconds = {"wait": 0.0, "track": 0.0, "relocalize": 0.0, "grow": 0.0}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] += now - self._last
        self._last = now
