"""The whole online system where a camera comes back: loops, places known again, and a run that goes on."""

import math
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic_room import RoomSequence, errors, pose
from mapped_room import CAMERA
from patterned_room import PatternedRoom

from tcgsplat.config import SlamConfig
from tcgsplat.geometry import se3
from tcgsplat.loop import relocalization
from tcgsplat.loop.closer import LoopCloser
from tcgsplat.loop.features import Features, features
from tcgsplat.loop.settings import LoopConfig
from tcgsplat.mapping.schedule import ScheduleConfig
from tcgsplat.mapping.seeding import SeedingConfig
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Submap
from tcgsplat.slam import Slam, StepReport
from tcgsplat.storage.checkpoint import Checkpoint
from tcgsplat.tensors import Pose
from tcgsplat.tracking.settings import AlignmentConfig, TrackerConfig

CONFIG = SlamConfig(
    tracker=TrackerConfig(
        alignment=AlignmentConfig(iterations=(4, 3, 3), stride=2),
        synchronization="none",
        smoothing=False,  # which would take most of the drift that there is to mend
    ),
    mapper=MapperConfig(
        seeding=SeedingConfig(recipe="surface", spacing=2, opacity=0.9),
        iterations=4,
        first_iterations=8,
        complete=False,
    ),
    schedule=ScheduleConfig(map_every=4, map_lag=4, submap_by="interval", submap_interval=8),
    loop=LoopConfig(candidates=2, views=2, min_interval=2, min_score=0.5, lag=6),
    seed=3,
)
WITHOUT = replace(CONFIG, loop=replace(CONFIG.loop, enabled=False))


def turned(degrees: float, bob: float = 0.0) -> Pose:
    """A camera at arm's length from the middle of the room, that has turned so far."""
    return pose(degrees=(0, degrees, 0)) @ pose(0.0, bob, 0.15)


def walk(steps: Sequence[float]) -> tuple[Pose, ...]:
    """Poses at headings, degrees, relative to the first."""
    poses = [turned(at, 0.03 * math.sin(at / 28)) for at in steps]
    return tuple(se3.inverse(poses[0]) @ T for T in poses)


ROUND = walk([3.6 * i for i in range(112)])  # once around, and 40 degrees more


def noisy(frames: Iterable[Frame]) -> list[Frame]:
    """Worse than a Kinect's: 1 cm at one metre."""
    generator = torch.Generator().manual_seed(1)
    return [
        replace(
            frame,
            depth=frame.depth + 0.01 * frame.depth**2 * torch.randn(frame.depth.shape, generator=generator),
            color=(frame.color + 0.05 * torch.randn(frame.color.shape, generator=generator)).clamp(0, 1),
        )
        for frame in frames
    ]


@dataclass
class Keeping:
    """A store that remembers checkpoints, too."""

    submaps: dict[int, Submap] = field(default_factory=dict)
    checkpoints: list[Checkpoint] = field(default_factory=list)

    def keep(self, submap: Submap, *rest: object) -> None:
        self.submaps[submap.index] = submap
        self.checkpoints += [each for each in rest if isinstance(each, Checkpoint)]

    def load_submap(self, index: int) -> Submap:
        return self.submaps[index]

    def until(self, checkpoint: Checkpoint) -> "Keeping":
        """What it held when a checkpoint was made."""
        return Keeping({index: submap for index, submap in self.submaps.items() if index < checkpoint.sealed})


@dataclass(frozen=True)
class Run:
    """Everything that came out of a run."""

    slam: Slam
    store: Keeping
    reports: list[StepReport]
    seen: list[Pose]
    """Where each frame stood in the world just after it was tracked."""

    @property
    def T_world_cam(self) -> list[Pose]:
        return self.slam.trajectory.world(self.slam.atlas)

    def off(self, truth: Sequence[Pose]) -> float:
        """Root of the mean squared distance from the truth, millimetres."""
        return math.sqrt(np.mean([errors(T, true)[0] ** 2 for T, true in zip(self.T_world_cam, truth, strict=True)]))


def run(frames: Iterable[Frame], rasterizer: Rasterizer, config: SlamConfig = CONFIG) -> Run:
    store = Keeping()
    slam, reports, seen = Slam(config, rasterizer, store=store), [], []
    for frame in frames:
        reports.append(slam.step(frame))
        row = slam.trajectory.rows[-1]
        seen.append(slam.atlas.T_world_map[row.submap_index] @ row.T_map_cam)
    slam.finish()
    return Run(slam, store, reports, seen)


def same_rows(a: Slam, b: Slam) -> bool:
    """Whether two runs have the same poses within submaps, to the bit."""
    pairs = list(zip(a.trajectory.rows, b.trajectory.rows, strict=True))
    return all(torch.equal(r.T_map_cam, s.T_map_cam) and r.submap_index == s.submap_index for r, s in pairs)


def same_world(a: Slam, b: Slam) -> bool:
    return len(a.atlas) == len(b.atlas) and all(
        torch.equal(S, T) for S, T in zip(a.atlas.T_world_map, b.atlas.T_world_map, strict=True)
    )


def same_submap(a: Submap, b: Submap) -> bool:
    g, h = a.gaussians, b.gaussians
    return all(torch.equal(getattr(g, f.name), getattr(h, f.name)) for f in fields(g)) and torch.equal(
        a.confidence.value, b.confidence.value
    )


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return noisy(RoomSequence(ROUND, room=PatternedRoom(), camera=CAMERA))


@pytest.fixture(scope="module")
def closed(frames: list[Frame], rasterizer: Rasterizer) -> Run:
    return run(frames, rasterizer)


@pytest.fixture(scope="module")
def open_ended(frames: list[Frame], rasterizer: Rasterizer) -> Run:
    return run(frames, rasterizer, WITHOUT)


class TestLoop:
    def test_the_path_is_nearer_to_the_truth(self, closed: Run, open_ended: Run) -> None:
        assert not any(report.tracked.lost for report in closed.reports)
        drift = open_ended.off(ROUND)
        assert drift > 15  # or there would be nothing to mend
        assert closed.off(ROUND) < 0.75 * drift

    def test_loops_are_of_submaps_that_show_the_same(self, closed: Run) -> None:
        loops = [edge for edge in closed.slam.closures[-1].edges if edge.loop]
        assert any(edge.source - edge.target > 10 for edge in loops)
        rejected = closed.slam.closures[-1].rejected
        truth = [ROUND[8 * index] for index in range(len(closed.slam.atlas))]
        for edge in loops:
            off = errors(edge.T_target_source, se3.inverse(truth[edge.target]) @ truth[edge.source])[0]
            assert off < 40 or any(edge is each for each in rejected)

    def test_each_submap_hangs_on_the_one_before(self, closed: Run) -> None:
        path = [edge for edge in closed.slam.closures[-1].edges if not edge.loop]
        assert [(edge.source, edge.target) for edge in path] == [(i, i - 1) for i in range(1, len(closed.slam.atlas))]

    def test_poses_within_submaps_stay_bit_by_bit(self, closed: Run, open_ended: Run) -> None:
        assert same_rows(closed.slam, open_ended.slam)
        for index in range(len(closed.slam.atlas)):
            assert same_submap(closed.store.load_submap(index), open_ended.store.load_submap(index))

    def test_corrections_reach_every_frame_the_current_one_included(self, closed: Run) -> None:
        """Between two frames of which the second brings a correction, the whole path jumps; tracking feels nothing."""
        rows, jumps = closed.slam.trajectory.rows, []
        for before, (row, report) in pairwise(zip(rows, closed.reports, strict=True)):
            if report.closure is None or not report.closure.T_world_map:
                continue
            said, now = report.closure.T_world_map, closed.seen[row.frame_index]
            assert len(said) == row.submap_index + 1
            assert torch.equal(now, said[row.submap_index] @ row.T_map_cam)
            within = se3.inverse(before[0].T_map_cam) @ row.T_map_cam
            assert errors(within, se3.inverse(ROUND[row.frame_index - 1]) @ ROUND[row.frame_index])[0] < 20
            jumps.append(errors(now, closed.seen[row.frame_index - 1] @ within)[0])
        assert max(jumps) > 5  # millimetres
        later = [errors(was, now)[0] for was, now in zip(closed.seen, closed.T_world_cam, strict=True)]
        assert sum(moved > 1 for moved in later) > len(later) // 2
        assert torch.equal(closed.slam.atlas.T_world_map[0], se3.identity())

    def test_a_correction_comes_into_use_a_fixed_number_of_frames_later(self, closed: Run) -> None:
        begun = [report.frame_index for report in closed.reports if report.sealed]
        used = [report.frame_index for report in closed.reports if report.closure]
        assert [b - a for a, b in zip(begun, used, strict=False)] == [CONFIG.loop.lag] * len(used)
        assert [closure.submap for closure in closed.slam.closures] == list(range(len(closed.slam.atlas)))

    def test_the_world_is_what_the_last_closure_says(self, closed: Run) -> None:
        said = [closure.T_world_map for closure in closed.slam.closures if closure.T_world_map][-1]
        for T, world in zip(said, closed.slam.atlas.T_world_map, strict=False):
            assert torch.equal(T, world)

    def test_the_same_run_twice(self, closed: Run, frames: list[Frame], rasterizer: Rasterizer) -> None:
        again = run(frames, rasterizer)
        assert same_rows(closed.slam, again.slam)
        assert same_world(closed.slam, again.slam)
        assert all(torch.equal(S, T) for S, T in zip(closed.seen, again.seen, strict=True))
        for a, b in zip(closed.slam.closures[-1].edges, again.slam.closures[-1].edges, strict=True):
            assert (a.source, a.target, a.loop) == (b.source, b.target, b.loop)
            assert torch.equal(a.T_target_source, b.T_target_source)
            assert np.array_equal(a.information, b.information)

    def test_a_submap_that_is_not_compared_is_remembered(self, closed: Run, rasterizer: Rasterizer) -> None:
        """So does a live system that has fallen behind; later submaps are compared with it."""
        load, last = closed.slam._store.load_submap, len(closed.slam.atlas) - 1
        edges = {edge.source: edge for edge in closed.slam.closures[-1].edges if not edge.loop}
        closer = LoopCloser(CONFIG.loop, CONFIG.tracker, CONFIG.confidence, rasterizer, load, CONFIG.seed)
        for index in range(last):
            assert not closer.closed(index, edges.get(index + 1), compare=False).registrations
        found = closer.closed(last, None)
        assert any(not pair.failed for pair in found.registrations)
        assert all(not closure.edges for closure in closed.slam.closures[:-1]), "kept once is enough"

    def test_switched_off_nothing_is_compared(self, open_ended: Run) -> None:
        assert all(not c.registrations and not c.edges and not c.T_world_map for c in open_ended.slam.closures)
        for index, (a, b) in enumerate(pairwise(open_ended.slam.atlas.T_world_map), start=1):
            anchor = next(report for report in open_ended.reports if report.submap_index == index)
            assert errors(b, a @ anchor.tracked.T_map_cam)[0] < 1e-6

    def test_switched_off_nothing_that_was_said_moves(self, open_ended: Run) -> None:
        assert all(torch.equal(S, T) for S, T in zip(open_ended.seen, open_ended.T_world_cam, strict=True))


def test_a_live_system_imports_nothing_while_frames_come(easy_walk: Path) -> None:
    """In a process of its own, since this one has long imported all; in the ordinary mode, where a loop is closed."""
    done = subprocess.run(
        [sys.executable, "-c", STEPPED_AFTER_LIVE, str(easy_walk)], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert set(done.stdout.split()) <= {"tcgsplat", "encodings"}


STEPPED_AFTER_LIVE = """
import sys
from pathlib import Path
from tcgsplat import SlamConfig, open_rasterizer
from tcgsplat.cli.kernels import compile_kernels
from tcgsplat.datasets import open_sequence
from tcgsplat.slam import Slam

config, rasterizer = SlamConfig(), open_rasterizer("numba")
compile_kernels(config, rasterizer)
frames = list(open_sequence(Path(sys.argv[1])).frames_from(0))
Slam(config, rasterizer, live=True)
before, slam = set(sys.modules), Slam(config, rasterizer)
for frame in frames:
    slam.step(frame)
slam.finish()
assert any(edge.loop for edge in slam.closures[-1].edges), "no loop was closed"
print(*(name.split(".")[0] for name in set(sys.modules) - before))
"""


class TestResumed:
    @pytest.mark.parametrize("at", [-7, -2])
    def test_ends_as_the_run_that_was_not_interrupted(
        self, at: int, closed: Run, frames: list[Frame], rasterizer: Rasterizer
    ) -> None:
        """From before a loop was closed, and from after."""
        checkpoint = closed.store.checkpoints[at]
        store = closed.store.until(checkpoint)
        slam = Slam.resumed(CONFIG, rasterizer, store, checkpoint)
        for frame in frames[checkpoint.frame_index :]:
            slam.step(frame)
        slam.finish()
        assert same_rows(slam, closed.slam)
        assert same_world(slam, closed.slam)
        for index in range(len(slam.atlas)):
            assert same_submap(store.load_submap(index), closed.store.load_submap(index))
        last, expected = slam.closures[-1], closed.slam.closures[-1]
        assert [(e.source, e.target) for e in last.edges] == [(e.source, e.target) for e in expected.edges]
        assert [(e.source, e.target) for e in last.rejected] == [(e.source, e.target) for e in expected.rejected]
        assert len(checkpoint.trajectory) == checkpoint.frame_index


COVERED = 12


def carried(back: Sequence[Pose], *, room: PatternedRoom | None = None) -> tuple[list[Frame], list[Pose]]:
    """A third of a turn; the lens is covered; and the camera is uncovered elsewhere, perhaps in another room."""
    out = list(walk([3 * i for i in range(40)]))
    T = [*out, *[out[-1]] * COVERED, *back]
    frames = list(RoomSequence(tuple(T), room=PatternedRoom(), camera=CAMERA))
    first = len(out) + COVERED
    for index in range(len(out), first):
        f = frames[index]
        frames[index] = replace(f, color=torch.zeros_like(f.color), depth=torch.zeros_like(f.depth))
    if room is not None:
        frames[first:] = [room.frame(T[i], i, CAMERA) for i in range(first, len(T))]
    return frames, T


BACK = walk([0, *[6 + 2 * i for i in range(20)]])[1:]
AHEAD = walk([0, *[160 - 2 * i for i in range(12)]])[1:]


def assert_right(result: Run, truth: Sequence[Pose], millimetres: float) -> None:
    for row, T, true in zip(result.slam.trajectory.rows, result.T_world_cam, truth, strict=True):
        assert row.lost or errors(T, true)[0] < millimetres


@pytest.fixture(scope="module")
def found(rasterizer: Rasterizer) -> tuple[Run, list[Pose]]:
    frames, T = carried(BACK)
    return run(frames, rasterizer), T


class TestLost:
    def test_a_camera_is_found_again_in_an_old_submap(self, found: tuple[Run, list[Pose]]) -> None:
        result, T = found
        (report,) = [report for report in result.reports if report.found]
        assert report.found is not None
        assert report.found.reference.index < report.submap_index - 1
        assert report.sealed is not None
        truth = se3.inverse(T[8 * report.found.reference.index]) @ T[report.frame_index]
        assert errors(report.found.tracked.T_map_cam, truth)[0] < 10
        (edge,) = [e for e in result.slam.closures[-1].edges if e.source == report.submap_index and not e.loop]
        assert edge.target == report.found.reference.index
        assert torch.equal(edge.T_target_source, report.found.tracked.T_map_cam)

    def test_the_time_lost_is_in_the_path(self, found: tuple[Run, list[Pose]]) -> None:
        result, _ = found
        lost = [row.frame_index for row in result.slam.trajectory.rows if row.lost]
        (again,) = [report.frame_index for report in result.reports if report.found]
        assert lost == list(range(40, again))
        assert 40 + COVERED <= again < 40 + COVERED + CONFIG.loop.relocalize_after
        assert len(result.slam.trajectory) == len(result.reports)

    def test_the_pose_is_right_from_then_on(self, found: tuple[Run, list[Pose]]) -> None:
        assert_right(*found, 15)

    def test_it_goes_on_from_there_when_killed(self, found: tuple[Run, list[Pose]], rasterizer: Rasterizer) -> None:
        """The submap that hangs on an old one begins with a checkpoint as any other."""
        result, _ = found
        (report,) = [report for report in result.reports if report.found]
        (checkpoint,) = [c for c in result.store.checkpoints if c.frame_index == report.frame_index]
        store = result.store.until(checkpoint)
        slam = Slam.resumed(CONFIG, rasterizer, store, checkpoint)
        for frame in carried(BACK)[0][checkpoint.frame_index :]:
            slam.step(frame)
        slam.finish()
        assert same_rows(slam, result.slam)
        assert same_world(slam, result.slam)

    def test_one_in_an_unknown_place_is_not_found(self, rasterizer: Rasterizer) -> None:
        frames, _ = carried(BACK, room=PatternedRoom(seed=7))
        result = run(frames, rasterizer)
        assert not any(report.found for report in result.reports)
        assert [row.frame_index for row in result.slam.trajectory.rows if row.lost] == list(range(40, len(frames)))
        assert not any(row.mapped for row in result.slam.trajectory.rows[40:])

    def test_pictures_of_the_submap_that_grows_are_looked_at_once(
        self, rasterizer: Rasterizer, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        asked: Counter[int] = Counter()

        def counted(frame: Frame) -> Features:
            asked[frame.index] += 1
            return features(frame)

        monkeypatch.setattr(relocalization, "features", counted)
        frames, _ = carried(BACK, room=PatternedRoom(seed=7))
        result = run(frames, rasterizer)
        lost = [row.frame_index for row in result.slam.trajectory.rows if row.lost]
        looked_up = set(lost) & asked.keys()
        assert len(looked_up) >= 2 and asked.keys() > looked_up
        assert set(asked.values()) == {1}

    def test_without_loop_closure_nobody_looks_for_it(self, rasterizer: Rasterizer) -> None:
        frames, _ = carried(BACK[:8])
        result = run(frames, rasterizer, WITHOUT)
        assert all(report.seconds["relocalize"] == 0 or not report.found for report in result.reports)
        assert all(row.lost for row in result.slam.trajectory.rows[40:])

    def test_in_the_submap_that_is_growing_no_new_one_begins(self, rasterizer: Rasterizer) -> None:
        """Uncovered where only the active submap looks, and farther than tracking reaches."""
        config = replace(CONFIG, schedule=replace(CONFIG.schedule, submap_by="motion", submap_angle=80.0))
        frames, T = carried(AHEAD)
        result = run(frames, rasterizer, config)
        (report,) = [report for report in result.reports if report.found]
        assert report.found is not None
        assert report.found.reference.index == report.submap_index == 1
        assert report.sealed is None
        assert_right(result, T, 15)

    def test_in_the_submap_that_is_growing_where_the_next_one_is_due(self, rasterizer: Rasterizer) -> None:
        """The next one hangs on it as it is kept; a run that goes on from there has the same to track against."""
        frames, T = carried(AHEAD)
        result = run(frames, rasterizer)
        (report,) = [report for report in result.reports if report.found]
        assert report.found is not None
        assert report.sealed is not None
        assert report.found.reference.index == report.sealed.index == report.submap_index - 1
        assert_right(result, T, 15)
        (checkpoint,) = [c for c in result.store.checkpoints if c.frame_index == report.frame_index]
        slam = Slam.resumed(CONFIG, rasterizer, result.store.until(checkpoint), checkpoint)
        for frame in frames[checkpoint.frame_index :]:
            slam.step(frame)
        slam.finish()
        assert same_rows(slam, result.slam)
        assert same_world(slam, result.slam)
