"""The system on a device that is not the CPU: the same results, nothing mixed, and no waiting in the inner loops.

The device is the pretended one of `elsewhere.py`; where a real one is, `tests/parity` looks at that.
"""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic_room import CAMERA, Room, RoomSequence, pose, walk

if torch.cuda.is_available():
    pytest.skip("torch has room for one device beside the CPU, and a GPU is here", allow_module_level=True)

from elsewhere import DEVICE, Distant, Near, counted_waits
from twice_mapped import assert_same

from tcgsplat.cli.bench import confidence as confidence_bench
from tcgsplat.cli.bench import track as track_bench
from tcgsplat.cli.main import main
from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.config import SlamConfig, to_toml
from tcgsplat.evaluation.prediction import claim
from tcgsplat.geometry import se3
from tcgsplat.loop.relocalization import Relocalizer
from tcgsplat.loop.settings import LoopConfig
from tcgsplat.mapping import optimization
from tcgsplat.mapping.completion import completed
from tcgsplat.mapping.feedback import judged
from tcgsplat.mapping.mapper import Mapper
from tcgsplat.mapping.optimization import AutogradOptimization
from tcgsplat.mapping.refinement import for_steps, refined
from tcgsplat.mapping.schedule import ScheduleConfig
from tcgsplat.mapping.seeding import IdSource, SeedingConfig
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render import backends
from tcgsplat.render.losses import plain_ssim_map
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import render_view
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.slam import Slam
from tcgsplat.storage.run_directory import RunDirectory
from tcgsplat.storage.world_map import newly_merged
from tcgsplat.tracking.descent import DescentConfig, descend
from tcgsplat.tracking.settings import AlignmentConfig, TrackerConfig
from tcgsplat.tracking.tracker import Tracker

T_TRUE = pose(0.01, -0.006, 0.012, degrees=(0.4, 0.6, -0.3))
ALIGNMENT = TrackerConfig(alignment=AlignmentConfig(iterations=(4, 3, 3), stride=2))
DESCENT = TrackerConfig(
    solver="descent",
    descent=DescentConfig(
        iterations=12, rotation_rate=1e-3, translation_rate=2e-3, depth_mode="planar", outlier_factor=10.0
    ),
)
SURFACE = MapperConfig(
    seeding=SeedingConfig(recipe="surface", spacing=1, footprint=0.5, opacity=0.9), iterations=4, first_iterations=8
)
POINTS = MapperConfig(
    seeding=SeedingConfig(recipe="points", first_points=1500, first_gradient_points=500, points=500),
    iterations=4, first_iterations=8, isotropy_weight=1.0, sh_degree=1,
)  # fmt: skip
PAPER = ConfidenceConfig(model="paper", guide_mapping=True, stability_weight=10.0, slack_min=0.0, slack_max=1e-4)


@pytest.fixture(scope="module")
def distant(rasterizer: Rasterizer) -> Distant:
    return Distant(rasterizer)


@pytest.fixture(scope="module")
def near(rasterizer: Rasterizer) -> Near:
    return Near(rasterizer)


def there(submap: Submap) -> Submap:
    return replace(submap.to(DEVICE), keyframes=tuple(keyframe.to(DEVICE) for keyframe in submap.keyframes))


@pytest.fixture(autouse=True)
def one_ssim(monkeypatch: pytest.MonkeyPatch) -> None:
    """On the CPU, too, SSIM in torch: its kernels round otherwise, and nothing else does."""
    monkeypatch.setattr(optimization, "ssim_map", plain_ssim_map)


def test_the_pretended_device_refuses_what_a_gpu_refuses() -> None:
    table = torch.arange(6.0, device=DEVICE).reshape(2, 3)
    assert torch.equal((2.0 * table + torch.tensor(1.0)).cpu(), 2 * torch.arange(6.0).reshape(2, 3) + 1)
    with pytest.raises(RuntimeError, match="on the CPU"):
        table + torch.ones(3)
    with pytest.raises(RuntimeError, match="numpy"):
        table.numpy()
    with counted_waits() as waits:
        float(table.sum())
        table[table > 2]
        (table > 2).nonzero()
        torch.ones(3).to(DEVICE)
        torch.ones(3).to(DEVICE, non_blocking=True)
        table.cpu()
    assert sorted(waits.values()) == [1, 1, 1, 1, 1]


@pytest.mark.parametrize("config", [ALIGNMENT, DESCENT], ids=["alignment", "descent"])
def test_a_frame_is_tracked_as_on_the_cpu(
    config: TrackerConfig, room: Room, corner: Submap, near: Near, distant: Distant
) -> None:
    ours = Tracker(config, ConfidenceConfig(), distant).track(room.frame(T_TRUE).to(DEVICE), there(corner), pose())
    expected = Tracker(config, ConfidenceConfig(), near).track(room.frame(T_TRUE), corner, pose())
    assert ours.converged and expected.converged
    torch.testing.assert_close(ours.T_map_cam, expected.T_map_cam, atol=1e-5, rtol=0)
    assert ours.agreement == pytest.approx(expected.agreement, abs=1e-3)


@pytest.mark.parametrize(
    ("config", "confidence"), [(SURFACE, ConfidenceConfig()), (POINTS, PAPER)], ids=["ours", "paper"]
)
def test_a_submap_grows_as_on_the_cpu(
    config: MapperConfig, confidence: ConfidenceConfig, room: Room, near: Near, distant: Distant
) -> None:
    submaps = []
    for rasterizer in (near, distant):
        mapper = Mapper(config, confidence, rasterizer, IdSource(), torch.Generator().manual_seed(0))
        submap = Submap.anchored(se3.identity(), 0, config.sh_degree, rasterizer.device)
        for index, T in enumerate((pose(), pose(0.05, 0.02, degrees=(0, 12, 0)), pose(0.02, 0.0, 0.03))):
            mapped = mapper.optimized(mapper.grown(Keyframe(room.frame(T, index), T), submap))
            frame = mapped.submap.keyframes[-1].balanced
            submap = judged(mapped, frame, confidence, config.depth_mode, rasterizer)
        submaps.append(submap)
    assert submaps[1].device == DEVICE and submaps[1].keyframes[0].frame.color.device == DEVICE
    assert_same(submaps[1], submaps[0])


def experienced(config: MapperConfig, confidence: ConfidenceConfig, room: Room, distant: Distant) -> Submap:
    """A submap that has been mapped and judged twice: with baselines for the stability loss."""
    mapper = Mapper(config, confidence, distant, IdSource(), torch.Generator().manual_seed(0))
    submap = Submap.anchored(se3.identity(), 0, config.sh_degree, DEVICE)
    for index in range(2):
        mapped = mapper.optimized(mapper.grown(Keyframe(room.frame(index=index), pose()), submap))
        frame = mapped.submap.keyframes[-1].balanced
        submap = judged(mapped, frame, confidence, config.depth_mode, distant)
    return submap


@pytest.mark.parametrize(
    ("config", "confidence"), [(SURFACE, ConfidenceConfig()), (POINTS, PAPER)], ids=["ours", "paper"]
)
def test_a_step_of_mapping_waits_for_nothing(
    config: MapperConfig, confidence: ConfidenceConfig, room: Room, distant: Distant
) -> None:
    update = AutogradOptimization(experienced(config, confidence, room, distant), config, confidence, distant)
    with counted_waits() as waits:
        update.steps([0], frozen=("sh",))
        update.steps([1])
    assert not waits
    assert update.loss > 0


@pytest.mark.parametrize("floor", [None, 0.3])
def test_an_iteration_of_the_papers_solver_waits_for_nothing(
    floor: float | None, room: Room, corner: Submap, distant: Distant
) -> None:
    frame, submap, counts = room.frame(T_TRUE).to(DEVICE), there(corner), []
    for iterations in (1, 5):
        config = replace(DESCENT.descent, iterations=iterations)
        with counted_waits() as waits:
            descend(frame, submap, pose(), distant, config, floor=floor)
        counts.append(waits)
    assert counts[0] == counts[1] and counts[0].total() <= 3  # the guess is brought there, pose and loss come back


def test_a_picture_is_where_its_submap_is(room: Room, corner: Submap, distant: Distant, rasterizer: Rasterizer) -> None:
    expected = render_view(corner, CAMERA, T_TRUE, rasterizer)
    for submap in (corner, there(corner)):
        drawn = render_view(submap, CAMERA, T_TRUE, distant)
        assert drawn.color.device == submap.device
        torch.testing.assert_close(drawn.cpu().color, expected.color)
        torch.testing.assert_close(drawn.cpu().depth, expected.depth)


def config_of(solver: TrackerConfig, mapper: MapperConfig, confidence: ConfidenceConfig) -> SlamConfig:
    schedule = ScheduleConfig(map_every=2, map_lag=2, submap_by="motion", submap_distance=0.05, submap_angle=50.0)
    return SlamConfig(solver, mapper, schedule, confidence, LoopConfig(min_interval=0, candidates=1, lag=1), seed=3)


@pytest.mark.parametrize(
    "config",
    [config_of(ALIGNMENT, SURFACE, ConfidenceConfig()), config_of(DESCENT, POINTS, PAPER)],
    ids=["ours", "paper"],
)
def test_a_run_goes_as_on_the_cpu_and_is_read_back(
    config: SlamConfig, near: Near, distant: Distant, tmp_path: Path
) -> None:
    sequence, runs, paths = RoomSequence(tuple(walk(8))), [], []
    for rasterizer in (near, distant):
        run = RunDirectory.create(tmp_path / rasterizer.name, config_toml=to_toml(config), sequence="room")
        slam = Slam(config, rasterizer, store=run)
        reports = [slam.step(with_a_hole(frame)) for frame in sequence]
        slam.finish()
        assert not any(report.tracked.lost for report in reports)
        assert all(report.sealed is None or report.sealed.device == rasterizer.device for report in reports)
        run.write_trajectory(slam.trajectory, slam.atlas)
        runs.append(RunDirectory.open(run.path))
        paths.append(slam.trajectory.world(slam.atlas))
    assert runs[0].submap_count == runs[1].submap_count >= 2
    assert all(torch.equal(T, expected) for T, expected in zip(paths[1], paths[0], strict=True))
    for index in range(runs[0].submap_count):
        expected, ours = (run.load_submap(index) for run in runs)
        assert ours.gaussians.means.is_cpu and len(ours.keyframes) == len(expected.keyframes)
        assert_same(ours, expected)
    assert_same(newly_merged(runs[1], distant).submap, newly_merged(runs[0], near).submap)


def with_a_hole(frame: Frame) -> Frame:
    depth = frame.depth.clone()
    depth[10:14, 20:26] = 0.0
    return replace(frame, depth=depth)


def test_a_run_goes_on_from_its_checkpoint(distant: Distant, tmp_path: Path) -> None:
    config, sequence = config_of(ALIGNMENT, SURFACE, ConfidenceConfig()), RoomSequence(tuple(walk(8)))
    run = RunDirectory.create(tmp_path / "run", config_toml=to_toml(config), sequence="room")
    slam = Slam(config, distant, store=run)
    for frame in sequence:
        slam.step(frame)
    slam.finish()
    checkpoint = run.checkpoint()
    assert checkpoint is not None
    again = Slam.resumed(config, distant, run, checkpoint)
    for frame in sequence.frames_from(checkpoint.frame_index):
        again.step(frame)
    again.finish()
    for T, expected in zip(again.trajectory.world(again.atlas), slam.trajectory.world(slam.atlas), strict=True):
        assert torch.equal(T, expected)


def test_a_lost_camera_is_found_in_a_submap_wherever_that_is(
    room: Room, corner: Submap, distant: Distant, rasterizer: Rasterizer
) -> None:
    """In the active one, on the device, and in a finished one, in the CPU's memory."""
    frame, found = room.frame(T_TRUE), []
    for submap, device in ((corner, rasterizer), (corner, distant), (there(corner), distant)):
        known = Relocalizer(LoopConfig(), ALIGNMENT, ConfidenceConfig(), device, lambda _, s=submap: s, 0)
        found.append(known.localizer.localized(frame, submap, (pose(),)))
    assert found[0].failed == found[1].failed == found[2].failed
    for one in found[1:]:
        torch.testing.assert_close(one.tracked.T_map_cam, found[0].tracked.T_map_cam, atol=1e-6, rtol=0)


def test_finished_maps_are_worked_on_in_the_cpus_memory(
    room: Room, corner: Submap, near: Near, distant: Distant
) -> None:
    """Completed, refined and asked what they claim: with a rasterizer elsewhere as with one here."""
    keyframe = Keyframe(with_a_hole(room.frame()), pose())
    submap = replace(corner, keyframes=(keyframe,))
    confidence = ConfidenceConfig()
    whole = [
        completed(submap.kept(submap.gaussians.means[:, 0] > 0), SURFACE.seeding, confidence, r)
        for r in (near, distant)
    ]
    assert torch.equal(whole[0].gaussians.ids, whole[1].gaussians.ids)
    generators = (torch.Generator().manual_seed(0) for _ in range(2))
    better = [
        refined(submap, SURFACE, confidence, r, generator, for_steps(3))
        for r, generator in zip((near, distant), generators, strict=True)
    ]
    assert_same(better[1], better[0])
    claims = [claim(submap, CAMERA, T_TRUE, r, confidence, np.random.default_rng(0)) for r in (near, distant)]
    for name, doubt in claims[0].doubt.items():
        torch.testing.assert_close(claims[1].doubt[name], doubt, msg=name)


@pytest.mark.slow
def test_the_commands_work_there(
    easy_walk: Path,
    distant: Distant,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for module in (backends, confidence_bench, track_bench):
        monkeypatch.setattr(module, "open_rasterizer", lambda *_: distant)
    walk, run = tmp_path / "walk", str(tmp_path / "run")
    shutil.copytree(easy_walk, walk)
    for name in ("rgb.txt", "depth.txt"):
        (walk / name).write_text("".join((walk / name).read_text().splitlines(keepends=True)[:16]))
    assert main(["run", str(walk), "--out", run]) == 0
    assert main(["eval", run]) == 0
    assert main(["refine", run, "--steps", "1"]) == 0
    assert main(["export", run]) == 0
    assert main(["localize", run, str(walk), "--stride", "8"]) == 0
    assert main(["bench", "track", str(walk)]) == 0
    assert main(["bench", "confidence", str(walk), "--out", str(tmp_path / "page"), "--every", "5"]) == 0
    report = (tmp_path / "run" / "report.json").read_text()
    assert "psnr_withheld" in report and (tmp_path / "run" / "map.ply").stat().st_size > 10_000
    assert "distant" in capsys.readouterr().out
