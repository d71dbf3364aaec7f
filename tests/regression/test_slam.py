"""The whole online system on the room: where the camera went, what was mapped, and what must never matter."""

import sys
import threading
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import pytest
import torch
from analytic_room import CAMERA, Room, RoomSequence, errors, pose, walk

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.config import SlamConfig, with_settings
from tcgsplat.datasets.sequence import Sequence
from tcgsplat.geometry import se3
from tcgsplat.loop.closer import Closure
from tcgsplat.loop.edge import odometry
from tcgsplat.loop.settings import LoopConfig
from tcgsplat.mapping.mapper import Grown, Mapped, Mapper
from tcgsplat.mapping.optimization import Enough, never
from tcgsplat.mapping.schedule import ScheduleConfig
from tcgsplat.mapping.seeding import SeedingConfig
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.priority import niceness
from tcgsplat.render.numba_cpu.rasterizer import NumbaRasterizer
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import Rendering, render_view
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.slam import KNOWN, Slam, StepReport
from tcgsplat.tensors import Pose
from tcgsplat.tracking.settings import AlignmentConfig, TrackerConfig
from tcgsplat.tracking.tracker import Tracker

CONFIG = SlamConfig(
    tracker=TrackerConfig(solver="alignment", alignment=AlignmentConfig(iterations=(4, 3, 3), stride=2)),
    mapper=MapperConfig(
        seeding=SeedingConfig(recipe="surface", spacing=1, footprint=0.5, opacity=0.9),
        iterations=6,
        first_iterations=20,
    ),
    schedule=ScheduleConfig(map_every=4, map_lag=4, submap_by="motion", submap_distance=0.15, submap_angle=50.0),
    confidence=ConfidenceConfig(),
    loop=LoopConfig(enabled=False),
    seed=3,
)
SEQUENCE = RoomSequence(tuple(walk(34)))


@dataclass(frozen=True)
class Run:
    """Everything that came out of a run."""

    slam: Slam
    reports: list[StepReport]
    submaps: list[Submap]
    """Sealed, in order, the last one included."""
    T_world_cam: list[Pose]


def run(frames: Iterable[Frame], rasterizer: Rasterizer, config: SlamConfig = CONFIG) -> Run:
    slam = Slam(config, rasterizer)
    reports = [slam.step(frame) for frame in frames]
    last = slam.finish()
    submaps = [report.sealed for report in reports if report.sealed is not None]
    return Run(slam, reports, submaps + ([last] if last else []), slam.trajectory.world(slam.atlas))


@pytest.fixture(scope="module")
def walked(rasterizer: Rasterizer) -> Run:
    return run(SEQUENCE, rasterizer)


def test_the_camera_is_where_it_was(walked: Run) -> None:
    off = [errors(T, true) for T, true in zip(walked.T_world_cam, SEQUENCE.T_world_cam, strict=True)]
    assert max(millimetres for millimetres, _ in off) < 10  # of a way of 45 cm
    assert max(degrees for _, degrees in off) < 1
    assert not any(report.tracked.lost for report in walked.reports)


def test_the_map_looks_like_the_room(walked: Run, rasterizer: Rasterizer) -> None:
    for submap in walked.submaps:
        for keyframe in submap.keyframes:
            view = render_view(submap, CAMERA, keyframe.T_map_cam, rasterizer)
            assert (view.color - keyframe.frame.color).abs().mean() < 0.03
            assert (view.depth - keyframe.frame.depth).abs().median() < 0.006


def test_every_frame_has_one_row(walked: Run) -> None:
    rows = walked.slam.trajectory.rows
    assert [row.frame_index for row in rows] == list(range(len(SEQUENCE)))
    assert [row.timestamp for row in rows] == [frame.timestamp for frame in SEQUENCE]
    assert [row.submap_index for row in rows] == [report.submap_index for report in walked.reports]
    assert not any(row.lost for row in rows)


def test_the_first_camera_is_the_origin(walked: Run) -> None:
    assert torch.equal(walked.T_world_cam[0], se3.identity())
    assert torch.equal(walked.slam.atlas.T_world_map[0], se3.identity())


def test_reports_tell_what_happened(walked: Run) -> None:
    for report in walked.reports:
        assert report.seconds.keys() == {"wait", "track", "relocalize", "grow"}
        assert all(seconds >= 0 for seconds in report.seconds.values())
    mapped = [report.frame_index for report in walked.reports if report.mapped]
    switched = [report.frame_index for report in walked.reports if report.sealed]
    assert set(switched) <= set(mapped)  # a new submap begins with its first frame
    assert all(b - a <= 4 for a, b in zip(mapped, mapped[1:], strict=False))


class TestLag:
    def test_an_update_comes_into_use_the_same_number_of_frames_later(self, walked: Run) -> None:
        begun = [report.frame_index for report in walked.reports if report.mapped]
        used = {r.update.frame_index: r.frame_index for r in walked.reports if r.update}
        switched = [report.frame_index for report in walked.reports if report.sealed]
        assert list(used) == begun[: len(used)] and len(used) >= len(begun) - 1
        assert used.pop(0) == 0  # the run's first map is waited for: there is none before it
        for frame, later in used.items():
            assert later == min(frame + 4, *(s for s in switched if s > frame), 99)

    def test_without_lag_a_frame_sees_its_own_update(self, rasterizer: Rasterizer) -> None:
        slam = Slam(replace(CONFIG, schedule=replace(CONFIG.schedule, map_lag=0)), rasterizer)
        for index in range(6):
            report = slam.step(SEQUENCE.frame(index))
            assert bool(report.update) is report.mapped
            if report.update:
                assert report.update.frame_index == index
                assert slam.submap.clock == 1 + index // 4

    def test_a_live_system_takes_the_closures_that_are_done(self, rasterizer: Rasterizer) -> None:
        """Not only when none is under way any more: where comparing falls behind, that would be never."""
        slam = Slam(CONFIG, rasterizer, live=True)
        comparing = [Future[Closure]() for _ in range(3)]
        slam._keeping.extend(comparing)
        assert slam.step(SEQUENCE.frame(0)).closure is None
        for index in range(2):
            comparing[index].set_result(Closure(index, edges=(odometry(1, 0, se3.identity()),)))
        taken = slam.step(SEQUENCE.frame(1)).closure
        assert taken is not None and taken.submap == 1
        assert [(closure.submap, len(closure.edges)) for closure in slam.closures] == [(0, 0), (1, 1)]
        comparing[2].set_exception(OSError("the disk is full"))
        with pytest.raises(OSError, match="full"):
            slam.step(SEQUENCE.frame(2))

    def test_what_is_seeded_is_tracked_against_at_once(self, rasterizer: Rasterizer) -> None:
        slam = Slam(CONFIG, rasterizer, live=True)  # which does not even wait for the first map
        report = slam.step(SEQUENCE.frame(0))
        assert report.update is None and report.gaussians == len(slam.submap) > 1000
        assert not slam.step(SEQUENCE.frame(1)).tracked.lost

    def test_a_submap_begins_where_the_newest_map_has_its_first_frame(self, rasterizer: Rasterizer) -> None:
        """Not where the map that is a lag old has it, which the frames before were tracked against."""
        config = replace(
            CONFIG,
            # Frames as they come, and none aligned to the view that was drawn for another.
            tracker=replace(CONFIG.tracker, synchronization="none", smoothing=False, view_distance=0.0),
            schedule=replace(CONFIG.schedule, submap_by="interval", submap_interval=6),
            confidence=replace(CONFIG.confidence, guide_tracking=False),  # sealing changes confidence
        )
        slam, tracker = Slam(config, rasterizer), Tracker(config.tracker, config.confidence, rasterizer)
        for frame in SEQUENCE:
            old, guess = slam.submap, slam.motion.predict(frame.timestamp)
            report = slam.step(frame)
            if report.sealed is not None:
                break
        assert report.frame_index == 6 and report.update and report.update.frame_index == 4
        stale = tracker.track(frame, old, guess).T_map_cam
        fresh = tracker.track(frame, report.sealed, stale).T_map_cam
        torch.testing.assert_close(report.tracked.T_map_cam, fresh, atol=1e-9, rtol=0)
        assert not torch.allclose(fresh, stale, atol=1e-5)


class TestHandedOn:
    @pytest.mark.parametrize(("model", "doubted"), [("expectation", True), ("paper", False)])
    def test_who_came_into_the_picture_as_a_submap_begins_is_doubted(
        self, model: str, doubted: bool, walked: Run, rasterizer: Rasterizer
    ) -> None:
        """The submap itself shows nothing yet; the one before knows what is behind him."""
        begins = next(report.frame_index for report in walked.reports if report.sealed)
        then = {"schedule.submap_by": "interval", "schedule.submap_interval": begins}  # not by how far, to a hair
        slam = Slam(with_settings(CONFIG, {"confidence.model": model, **then}), rasterizer)
        for frame in SEQUENCE:
            depth = frame.depth.clone()
            if frame.index == begins:
                depth[20:40, 30:50] -= 0.4
            report = slam.step(replace(frame, depth=depth))
            if frame.index == begins:
                break
        assert report.sealed is not None
        pixels = CAMERA.project(slam.submap.gaussians.means)
        him = ((pixels > torch.tensor([33, 23])) & (pixels < torch.tensor([47, 37]))).all(dim=-1)
        far = ((pixels - torch.tensor([40, 30])).abs() > torch.tensor([15, 15])).any(dim=-1)
        value = slam.submap.confidence.value
        assert him.sum() > 100 and far.sum() > 1000
        assert bool(value[him].median() < 0.5 * value[far].median()) == doubted


class TestReference:
    @pytest.mark.parametrize("blind", [1, 2, 3])
    def test_frames_without_depth_where_a_submap_would_begin(
        self, blind: int, walked: Run, rasterizer: Rasterizer
    ) -> None:
        """Colour alone still tracks, and the new submap waits for a surface."""
        begins = next(report.frame_index for report in walked.reports if report.sealed)

        def frames() -> Iterator[Frame]:
            for frame in SEQUENCE:
                gone = begins <= frame.index < begins + blind
                yield replace(frame, depth=torch.zeros_like(frame.depth)) if gone else frame

        result = run(frames(), rasterizer)
        assert not any(report.tracked.iterations == 0 for report in result.reports[1:])
        for T, true in zip(result.T_world_cam, SEQUENCE.T_world_cam, strict=True):
            assert errors(T, true)[0] < 15


def filmed(frames: Iterable[Frame]) -> Iterator[Frame]:
    """With time between them, in which the map can be worked on however busy the machine is otherwise."""
    for frame in frames:
        yield frame
        time.sleep(0.05)


class Endless(Mapper):
    """One whose updates would take for ever, did they not give way after a step, or once all is over."""

    def __init__(self, over: threading.Event, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._over = over

    def optimized(self, grown: Grown, enough: Enough = never) -> Mapped:
        while not (enough(1) or self._over.is_set()):
            time.sleep(0.001)
        return super().optimized(grown, enough)


class TestLive:
    def test_a_live_system_maps_when_it_can(self, rasterizer: Rasterizer) -> None:
        """Whatever its speed, one update is worked on at a time, none is lost, and the camera is where it was."""
        slam = Slam(CONFIG, rasterizer, live=True)
        reports = [slam.step(frame) for frame in filmed(SEQUENCE)]
        slam.finish()
        begun = [report.frame_index for report in reports if report.mapped]
        used = [report.update.frame_index for report in reports if report.update]
        assert begun[: len(used)] == used and len(used) >= len(begun) - 1
        assert len(begun) >= 2
        off = [errors(T, true) for T, true in zip(slam.trajectory.world(slam.atlas), SEQUENCE.T_world_cam, strict=True)]
        assert max(millimetres for millimetres, _ in off) < 20

    def test_tracking_comes_first_and_the_map_makes_room_for_the_next_frame(self, rasterizer: Rasterizer) -> None:
        """The map is grown and optimised by a nicer thread, and not to the end when a frame is due to be mapped; half
        of the steps are made in any case.
        """
        threads, over, early = set[tuple[str, int]](), threading.Event(), set[bool]()

        class Seen(Mapper):
            def grown(self, keyframe: Keyframe, submap: Submap, known: Rendering | None = None) -> Grown:
                threads.add((threading.current_thread().name.split("_")[0], niceness()))
                return super().grown(keyframe, submap, known)

            def optimized(self, grown: Grown, enough: Enough = never) -> Mapped:
                threads.add((threading.current_thread().name.split("_")[0], niceness()))
                half = CONFIG.mapper.iterations // 2
                while not (enough(half) or over.is_set()):  # as if it took that long
                    time.sleep(0.001)
                early.add(enough(half - 1))
                return super().optimized(grown, enough)

        slam = Slam(with_settings(CONFIG, {"schedule.submap_distance": 9.0}), rasterizer, live=True, mapper=Seen)
        used = dict[int, int]()
        for frame in filmed(SEQUENCE):
            report = slam.step(frame)
            used |= {report.update.frame_index: frame.index} if report.update else {}
        over.set()
        slam.finish()
        assert early == {False}
        assert threads == {("mapping", niceness() + 5 if sys.platform == "linux" else 0)}
        assert len(used) >= 2 and all(later >= begun + CONFIG.schedule.map_every for begun, later in used.items())

    def test_a_submap_ends_when_it_should_though_it_is_worked_on(self, rasterizer: Rasterizer) -> None:
        """An update that would go on for ever gives way after its next step, and that step's map is what is sealed."""
        over = threading.Event()
        slam = Slam(CONFIG, rasterizer, live=True, mapper=partial(Endless, over))
        left, sealed = list[int](), list[StepReport]()
        for frame in filmed(SEQUENCE):
            report = slam.step(frame)
            sealed += [report] if report.sealed else []
            far = se3.translation_norm(slam.trajectory.rows[-1].T_map_cam) > CONFIG.schedule.submap_distance
            left += [frame.index] if far and len(left) == len(sealed) else []
        over.set()
        slam.finish()
        assert len(left) >= len(sealed) >= 2 and all(report.update is not None for report in sealed)
        assert all(0 < report.frame_index - frame <= 4 for frame, report in zip(left, sealed, strict=False))

    def test_what_is_seen_for_the_first_time_does_not_wait_for_what_is_known(self, rasterizer: Rasterizer) -> None:
        """A camera that turns away from its map has more of it before the last of it is out of the picture."""
        over = threading.Event()
        one = with_settings(CONFIG, {"schedule.submap_distance": 9.0, "schedule.submap_angle": 180.0})
        slam = Slam(one, rasterizer, live=True, mapper=partial(Endless, over))
        turning = RoomSequence(tuple(pose(degrees=(0.0, 1.5 * i, 0.0)) for i in range(50)))
        reports = [slam.step(frame) for frame in filmed(turning)]
        over.set()
        slam.finish()
        updated = [report.frame_index for report in reports if report.update is not None]
        assert len(updated) >= 2 and not any(report.tracked.lost for report in reports)
        assert all(min(r.tracked.coverage for r in reports[i - 4 : i]) < KNOWN for i in updated)
        assert min(report.tracked.coverage for report in reports[1:]) > 0.2  # the first one begins the map


class TestSubmaps:
    def test_each_is_sealed_once_and_in_order(self, walked: Run) -> None:
        assert len(walked.submaps) >= 3
        assert [submap.index for submap in walked.submaps] == list(range(len(walked.submaps)))
        assert len(walked.slam.atlas) == len(walked.submaps)

    def test_the_world_does_not_jump_where_a_submap_begins(self, walked: Run) -> None:
        """The frame that begins a submap stands in the world where it was tracked in the one before."""
        for index, report in enumerate(walked.reports):
            if report.sealed is None:
                continue
            tracked = report.sealed.T_world_map @ report.tracked.T_map_cam
            torch.testing.assert_close(walked.T_world_cam[index], tracked, atol=1e-6, rtol=0)
            torch.testing.assert_close(walked.slam.trajectory.rows[index].T_map_cam, se3.identity())

    def test_seals_what_was_judged_last(self, rasterizer: Rasterizer) -> None:
        """Sealed confidence is the active one after Eq. 16, and nothing else of the submap changes."""
        slam = Slam(replace(CONFIG, schedule=replace(CONFIG.schedule, map_lag=0)), rasterizer)
        for frame in SEQUENCE:
            before = slam.submap
            report = slam.step(frame)
            if report.sealed is not None:
                assert torch.equal(report.sealed.confidence.value, before.sealed(CONFIG.confidence).confidence.value)
                assert report.sealed.gaussians is before.gaussians
                assert report.sealed.keyframes is before.keyframes
                break
        else:
            raise AssertionError("no submap was sealed")

    def test_finishing_seals_the_last_and_may_be_asked_twice(self, walked: Run) -> None:
        again = walked.slam.finish()
        assert again is not None
        assert torch.equal(again.confidence.value, walked.submaps[-1].confidence.value)

    def test_ids_are_unique_in_the_run(self, walked: Run) -> None:
        ids = torch.cat([submap.gaussians.ids for submap in walked.submaps])
        assert len(ids.unique()) == len(ids)

    def test_the_clock_counts_mapping_updates(self, walked: Run) -> None:
        for submap in walked.submaps:
            updates = sum(r.mapped and r.submap_index == submap.index for r in walked.reports)
            assert submap.clock == updates
            assert submap.confidence.born.max() < submap.clock

    def test_they_end_by_frames_too(self, rasterizer: Rasterizer) -> None:
        schedule = replace(CONFIG.schedule, submap_by="interval", submap_interval=5)
        short = run((SEQUENCE.frame(i) for i in range(12)), rasterizer, replace(CONFIG, schedule=schedule))
        assert [r.frame_index for r in short.reports if r.sealed] == [5, 10]


def same_bits(a: Run, b: Run) -> bool:
    poses = all(torch.equal(S, T) for S, T in zip(a.T_world_cam, b.T_world_cam, strict=True))
    pairs = zip((s.gaussians for s in a.submaps), (s.gaussians for s in b.submaps), strict=True)
    return poses and all(torch.equal(getattr(g, f.name), getattr(h, f.name)) for g, h in pairs for f in fields(g))


class TestBits:
    def test_the_same_run_twice(self, walked: Run, rasterizer: Rasterizer) -> None:
        again = run(SEQUENCE, rasterizer)
        assert same_bits(walked, again)
        for a, b in zip(walked.submaps, again.submaps, strict=True):
            assert torch.equal(a.confidence.value, b.confidence.value)

    def test_threads_do_not_matter(self, walked: Run) -> None:
        assert same_bits(walked, run(SEQUENCE, NumbaRasterizer(threads=3)))

    def test_the_global_generator_does_not_matter(self, walked: Run, rasterizer: Rasterizer) -> None:
        torch.manual_seed(99)
        torch.rand(7)
        state = torch.random.get_rng_state()
        assert same_bits(walked, run(SEQUENCE, rasterizer))
        assert torch.equal(torch.random.get_rng_state(), state)

    def test_the_seed_does(self, walked: Run, rasterizer: Rasterizer) -> None:
        assert not same_bits(walked, run(SEQUENCE, rasterizer, replace(CONFIG, seed=4)))

    def test_the_base_system_does_not_feel_confidence(self, rasterizer: Rasterizer) -> None:
        """With all switches off, whatever confidence does in the background, poses and Gaussians stay the same."""
        off = ConfidenceConfig(guide_mapping=False, guide_tracking=False, rerank_views=False)
        wild = replace(
            off,
            model="paper",
            p_min=0.9,
            initial=0.95,
            decay_time=0.5,
            update_rate=1.0,
            penalty_gain=50.0,
            tracking_floor=0.01,
            stability_weight=1e4,
            slack_min=0.0,
            slack_max=0.0,
            step_scale_min=0.0,
            step_scale_max=9.0,
            stability_reduction="mean",
        )
        a, b, on = (run(SEQUENCE, rasterizer, replace(CONFIG, confidence=c)) for c in (off, wild, CONFIG.confidence))
        assert same_bits(a, b)
        assert not torch.equal(a.submaps[0].confidence.value, b.submaps[0].confidence.value)
        assert not same_bits(a, on)


class TestGroundTruth:
    def test_the_room_is_a_sequence_that_keeps_its_truth(self) -> None:
        """The runs above never touched it: `RoomSequence.ground_truth` raises."""
        assert isinstance(SEQUENCE, Sequence)
        with pytest.raises(AssertionError, match="looked at the ground truth"):
            SEQUENCE.ground_truth()

    def test_a_frame_has_no_room_for_a_pose(self) -> None:
        names = {"index", "timestamp", "depth_timestamp", "color", "depth", "valid", "camera"}
        assert {field.name for field in fields(Frame)} == names


def spoiled(bad: range) -> Iterator[Frame]:
    """The walk with a covered lens on some frames."""
    for frame in SEQUENCE:
        dark = replace(frame, color=torch.zeros_like(frame.color), depth=torch.zeros_like(frame.depth))
        yield dark if frame.index in bad else frame


class TestLost:
    def test_a_lost_frame_is_reported_guessed_and_not_mapped(self, rasterizer: Rasterizer) -> None:
        bad = range(7, 10)
        result = run(spoiled(bad), rasterizer)
        for report, row in zip(result.reports, result.slam.trajectory.rows, strict=True):
            assert bool(report.tracked.lost) is row.lost is (report.frame_index in bad)
            if row.lost:
                assert not report.mapped and report.sealed is None
        assert len(result.T_world_cam) == len(SEQUENCE)
        assert 8 not in [k.frame.index for submap in result.submaps for k in submap.keyframes]
        assert errors(result.T_world_cam[6], SEQUENCE.T_world_cam[6])[0] < 5
        for index in (10, 11, 12):  # found again at once, and held
            assert errors(result.T_world_cam[index], SEQUENCE.T_world_cam[index])[0] < 10

    def test_a_covered_lens_does_not_darken_the_map(self, rasterizer: Rasterizer) -> None:
        result = run(spoiled(range(8, 9)), rasterizer)
        submap = result.submaps[0]
        view = render_view(submap, CAMERA, submap.keyframes[1].T_map_cam, rasterizer)
        assert (view.color - submap.keyframes[1].frame.color).abs().mean() < 0.03

    def test_a_sequence_may_begin_blind(self, rasterizer: Rasterizer) -> None:
        result = run(spoiled(range(2)), rasterizer)
        assert [report.frame_index for report in result.reports if report.tracked.lost] == [0, 1]
        assert result.reports[2].mapped
        apart = se3.inverse(SEQUENCE.T_world_cam[2]) @ SEQUENCE.T_world_cam[20]
        found = se3.inverse(result.T_world_cam[2]) @ result.T_world_cam[20]
        assert errors(found, apart)[0] < 10

    def test_a_sequence_that_shows_nothing_leaves_no_submap(self, rasterizer: Rasterizer) -> None:
        result = run((f for f in spoiled(range(34)) if f.index < 5), rasterizer)
        assert result.submaps == []
        assert all(torch.equal(T, se3.identity()) for T in result.T_world_cam)
        assert len(result.slam.trajectory) == 5


def test_dropped_frames_leave_gaps(rasterizer: Rasterizer) -> None:
    kept = [0, 1, 2, 5, 6, 7, 11, 12]
    result = run((SEQUENCE.frame(i) for i in kept), rasterizer)
    assert [row.frame_index for row in result.slam.trajectory.rows] == kept
    for index, T in zip(kept, result.T_world_cam, strict=True):
        assert errors(T, SEQUENCE.T_world_cam[index])[0] < 8


def test_the_papers_solver_walks_too(rasterizer: Rasterizer) -> None:
    tracker = replace(
        CONFIG.tracker,
        solver="descent",
        descent=replace(
            CONFIG.tracker.descent,
            iterations=30,
            rotation_rate=1e-3,
            translation_rate=2e-3,
            color_weight=0.3,
            depth_mode="planar",
            min_alpha=0.9,
        ),
    )
    result = run((SEQUENCE.frame(i) for i in range(8)), rasterizer, replace(CONFIG, tracker=tracker))
    assert not any(report.tracked.lost for report in result.reports)
    assert errors(result.T_world_cam[-1], SEQUENCE.T_world_cam[7])[0] < 20  # of 95 mm


def test_a_moved_room_is_the_same_room(rasterizer: Rasterizer) -> None:
    """The world begins at the first camera, wherever the recording says that is."""
    elsewhere = replace(Room(), T_room_world=Room().T_room_world @ pose(0.05, 0.02, 0.0))
    sequence = RoomSequence(tuple(pose(-0.05, -0.02, 0.0) @ T for T in SEQUENCE.T_world_cam), room=elsewhere)
    a, b = (run((s.frame(i) for i in range(6)), rasterizer) for s in (SEQUENCE, sequence))
    for S, T in zip(a.T_world_cam, b.T_world_cam, strict=True):
        assert errors(S, T)[0] < 1
