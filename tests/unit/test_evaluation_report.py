"""Reports of small run directories on disk, whose figures are known."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tcgsplat.confidence.state import ConfidenceConfig, ConfidenceState
from tcgsplat.errors import EvaluationError
from tcgsplat.evaluation import figures
from tcgsplat.evaluation.accuracy import associate
from tcgsplat.evaluation.lpips import Lpips
from tcgsplat.evaluation.report import Metric, Report, evaluate, score_trajectory, unfinished
from tcgsplat.evaluation.views import spread
from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.backends import open_rasterizer
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import render_view
from tcgsplat.scene.atlas import Atlas
from tcgsplat.scene.exposure import Exposure
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.scene.trajectory import TrackedPose, Trajectory, format_tum
from tcgsplat.storage.run_directory import RunDirectory
from tcgsplat.storage.world_map import world_map
from tcgsplat.tensors import Image, Pose

CAMERA = Camera(fx=40.0, fy=40.0, cx=23.5, cy=15.5, width=48, height=32)
OFFSET = 0.05
"""Metres by which the sensor's depth is greater than the map's."""
COLOR_OFFSET = 0.1
"""By which the colours of the sequence differ from the map's: 20 dB."""


@pytest.fixture(scope="module")
def rasterizer() -> Rasterizer:
    return open_rasterizer("reference")


@dataclass(frozen=True)
class Recorded:
    """Frames in memory, with or without ground truth."""

    frames: tuple[Frame, ...]
    truth: dict[int, Pose] = field(default_factory=dict)
    asked: list[int] = field(default_factory=list)
    """Indices of the frames that were read out of turn."""
    name: str = "wall"
    camera: Camera = CAMERA

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[Frame]:
        return self.frames_from(0)

    def frames_from(self, first: int) -> Iterator[Frame]:
        return iter(self.frames[first:])

    def frame(self, index: int) -> Frame:
        self.asked.append(index)
        return self.frames[index]

    def ground_truth(self) -> dict[int, Pose]:
        return self.truth


def at(x: float, y: float = 0.0, z: float = 0.0) -> Pose:
    T = se3.identity()
    T[:3, 3] = torch.tensor([x, y, z], dtype=torch.float64)
    return T


def wall(index: int, T_world_map: Pose) -> Submap:
    """A textured wall 2 m ahead of the first camera."""
    y, x = torch.meshgrid(torch.arange(-1.2, 1.2, 0.12), torch.arange(-1.8, 1.8, 0.12), indexing="ij")
    n = x.numel()
    generator = torch.Generator().manual_seed(index)
    return Submap(
        index=index,
        T_world_map=T_world_map,
        gaussians=Gaussians(
            ids=torch.arange(n) + 1000 * index,
            means=torch.stack((x.flatten(), y.flatten(), torch.full((n,), 2.0)), dim=1),
            log_scales=torch.log(torch.tensor([0.08, 0.08, 0.01])).repeat(n, 1),
            quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
            logit_opacities=torch.full((n,), 3.0),
            sh=torch.randn(n, 1, 3, generator=generator),
        ),
        confidence=replace(
            ConfidenceState.born_at(0, n, ConfidenceConfig()),
            value=torch.rand(n, generator=generator),
            updates=torch.ones(n, dtype=torch.int64),
        ),
        clock=1,
    )


def stepped(index: int, T_world_map: Pose) -> Submap:
    """The wall with its left half a metre nearer."""
    submap = wall(index, T_world_map)
    means = submap.gaussians.means.clone()
    means[means[:, 0] < 0.0, 2] = 1.0
    return replace(submap, gaussians=replace(submap.gaussians, means=means))


def seen(submap: Submap, index: int, T_map_cam: Pose, rasterizer: Rasterizer) -> Keyframe:
    """A keyframe whose image is the map's own picture, and whose depth is `OFFSET` farther, with a hole."""
    rendering = render_view(submap, CAMERA, T_map_cam, rasterizer)
    depth = rendering.depth + OFFSET
    depth[:4, :4] = 0.0
    valid = torch.ones(CAMERA.height, CAMERA.width, dtype=torch.bool)
    valid[-3:] = False
    color = rendering.color.clamp(0, 1).clone()
    color[-3:] = 0.0
    return Keyframe(Frame(index, 100.0 + index / 30, color, depth, valid, CAMERA), T_map_cam)


@pytest.fixture
def run(tmp_path: Path, rasterizer: Rasterizer) -> RunDirectory:
    """Two submaps, eight frames at 10 cm steps, 0, 2, 4 and 6 mapped and keyframes; frame 7 is lost and 4 cm off."""
    run = RunDirectory.create(tmp_path / "run", config_toml="", sequence="/data/wall")
    atlas = Atlas((at(0.0), at(0.4)))
    rows = []
    for index, T_world_map in enumerate(atlas.T_world_map):
        submap = wall(index, T_world_map)
        for i in range(4):
            T_map_cam = at(0.1 * i, 0.04 if index == 1 and i == 3 else 0.0)
            frame_index = 4 * index + i
            stamp, lost = 100.0 + frame_index / 30, frame_index == 7
            rows.append(TrackedPose(frame_index, stamp, index, T_map_cam, lost=lost, mapped=i % 2 == 0))
            if i % 2 == 0:
                keyframe = seen(submap, frame_index, T_map_cam, rasterizer)
                submap = replace(submap, keyframes=(*submap.keyframes, keyframe))
        run.write_submap(submap)
    run.write_trajectory(Trajectory(tuple(rows)), atlas)
    costs = {"ms_per_frame": 250.0, "peak_rss_mb": 512.5, "stage_ms": {"track": 1.0}}
    run.write_summary({"frames": 8, "loops": 3, **costs})
    return run


@pytest.fixture
def sequence(run: RunDirectory, rasterizer: Rasterizer) -> Recorded:
    """The truth is the estimate without its error, in another world frame; frame 3 has none.

    All colours are off by `COLOR_OFFSET`, but for the keyframes' own images, which the run has.
    """
    frames = []
    for row in run.trajectory()[0].rows:
        frame = seen(run.load_submap(row.submap_index), row.frame_index, row.T_map_cam, rasterizer).frame
        color = frame.color + COLOR_OFFSET * torch.where(frame.color < 0.5, 1.0, -1.0)
        color[-3:] = 0.0
        frames.append(replace(frame, color=color))
    T_other_world = se3.exp(torch.tensor([1.0, 2.0, 3.0, 0.3, -0.2, 0.9], dtype=torch.float64))
    return Recorded(tuple(frames), {i: T_other_world @ at(0.1 * i) for i in range(8) if i != 3})


def expected_ate_cm() -> float:
    """By the same least squares, written out for this path in a plane: seven points, one of them 4 cm off."""
    x = 0.1 * np.array([0, 1, 2, 4, 5, 6, 7])
    true, estimated = x + 0j, x + 0.04j * (np.arange(7) == 6)
    true, estimated = true - true.mean(), estimated - estimated.mean()
    turn = np.vdot(estimated, true)
    return float(100 * np.sqrt(np.mean(np.abs(estimated * turn / abs(turn) - true) ** 2)))


def test_figures_of_a_run(run: RunDirectory, sequence: Recorded, rasterizer: Rasterizer) -> None:
    report = evaluate(run, sequence, rasterizer)
    value = {name: metric.value for name, metric in report.metrics.items()}
    unit = {name: metric.unit for name, metric in report.metrics.items()}
    assert value["ate_rmse"] == pytest.approx(expected_ate_cm(), abs=1e-6)
    assert 0.5 < value["ate_rmse"] < 4.0
    assert value["psnr"] > 50.0  # all that parts them is rounding to 8 bits
    assert value["ssim"] > 0.999
    assert value["depth_l1"] == pytest.approx(100 * OFFSET, abs=0.02)
    assert value["psnr_withheld"] == value["psnr_withheld_mapped"] == pytest.approx(20.0, abs=1e-4)
    assert 0.3 < value["ssim_withheld"] < 0.99
    assert value["depth_l1_withheld"] == pytest.approx(100 * OFFSET, abs=0.02)
    assert value["coverage_withheld"] == 100.0
    assert value["coverage_map_withheld"] == 100.0
    assert 10.0 < value["psnr_map_withheld"] < 20.0  # the two walls are painted differently, and one of them is kept
    assert value["depth_l1_map_withheld"] == pytest.approx(100 * OFFSET, abs=0.1)
    assert value["depth_coverage"] == pytest.approx(100.0)
    assert (value["frames"], value["frames_lost"], value["submaps"]) == (8, 1, 2)
    assert value["seconds_lost"] == 0.0  # the last frame is lost, and nothing comes after it
    assert value["loops"] == 3
    assert value["gaussians"] == 2 * len(wall(0, at(0.0)))
    assert (value["ms_per_frame"], value["peak_rss_mb"]) == (250.0, 512.5)
    assert value["frames_tracked"] == 87.5
    assert value["psnr_map"] > 10.0 and value["psnr_map"] != value["psnr"]
    assert value["coverage"] == value["coverage_map"] == 100.0
    assert value["rpe_translation"] > 1.0 and value["ate_rmse_sim3"] < value["ate_rmse"]
    assert value["rpe_rotation"] == pytest.approx(0.0, abs=1e-5)
    kinds, figures_of_views = ("", "_withheld", "_map", "_map_withheld"), ("psnr", "ssim", "depth_l1", "coverage")
    assert {f"{figure}{kind}" for figure in figures_of_views for kind in kinds} <= value.keys()
    too_small = "views are too small for its five scales: 161 valid pixels across and down"
    assert report.missing == {
        **{f"ms_ssim{kind}": too_small for kind in kinds},
        **{f"lpips{kind}": "not available: give the weights by --lpips" for kind in kinds},
        "rpe_translation_1s": "no two poses are a second apart",
        "rpe_rotation_1s": "no two poses are a second apart",
    }
    assert {name: unit[name] for name in ("ate_rmse", "rpe_rotation", "frames_tracked", "seconds_lost")} == {
        "ate_rmse": "cm", "rpe_rotation": "deg", "frames_tracked": "%", "seconds_lost": "s",
    }  # fmt: skip
    assert {name: unit[name] for name in unit if "withheld" in name} == {
        "psnr_withheld": "dB", "ssim_withheld": "", "depth_l1_withheld": "cm",
        "psnr_withheld_unexposed": "dB", "psnr_withheld_mapped": "dB", "coverage_withheld": "%",
        "depth_coverage_withheld": "%",
        "psnr_map_withheld": "dB", "ssim_map_withheld": "", "depth_l1_map_withheld": "cm", "coverage_map_withheld": "%",
        "psnr_map_withheld_unexposed": "dB", "psnr_map_withheld_mapped": "dB", "depth_coverage_map_withheld": "%",
    }  # fmt: skip
    assert report.evaluated["poses"].startswith("estimated, and so are exposures")
    assert report.evaluated["training"] == "all keyframes of the saved submaps"
    assert report.evaluated["withheld"].startswith("3 of 3 frames")
    assert report.evaluated["withheld"].endswith("spread evenly")
    assert report.evaluated["trajectory"].startswith("7 of 8 frames")


def test_withheld_views_are_drawn_from_the_one_map_too(
    run: RunDirectory, sequence: Recorded, rasterizer: Rasterizer
) -> None:
    """At the poses and with the exposures that they have in it."""
    submaps = [run.load_submap(index) for index in range(2)]
    darker, moved = Exposure(0.8, 0.05), submaps[0].gaussians.transformed(at(-0.4))
    sh = (darker.removed(0.28209479177387814 * moved.sh + 0.5) - 0.5) / 0.28209479177387814
    keyframes = tuple(replace(keyframe, exposure=darker) for keyframe in submaps[1].keyframes)
    gaussians = replace(moved, ids=moved.ids + 1000, sh=sh)  # the same wall, such that it looks so in darker pictures
    surer = replace(submaps[0].confidence, value=2 * submaps[0].confidence.value)
    run.write_submap(replace(submaps[1], gaussians=gaussians, confidence=surer, keyframes=keyframes))
    trajectory, atlas = run.trajectory()
    rows = tuple(replace(row, exposure=darker) if row.submap_index else row for row in trajectory.rows)
    run.write_trajectory(Trajectory(rows), atlas)
    frames = [
        replace(frame, color=row.exposure.applied(drawn_at(run, row, rasterizer)).clamp(0, 1))
        for row, frame in zip(rows, sequence.frames, strict=True)
    ]
    report = evaluate(run, replace(sequence, frames=tuple(frames)), rasterizer)
    value = {name: metric.value for name, metric in report.metrics.items()}
    assert value["psnr_withheld"] > 90.0 and value["psnr_map_withheld"] > 35.0
    assert value["gaussians_map"] == len(submaps[0])
    assert report.evaluated["map"].endswith("not refined")

    whole = world_map(run, rasterizer)
    black = replace(whole.submap.gaussians, sh=torch.full_like(whole.submap.gaussians.sh, -2.0))
    run.write_map(replace(whole, submap=replace(whole.submap, gaussians=black), steps=3))
    report = evaluate(run, replace(sequence, frames=tuple(frames)), rasterizer)
    assert report.metrics["psnr_map_withheld"].value < 12.0 and report.metrics["psnr_withheld"].value > 90.0
    assert report.evaluated["map"] == "refined by 3 steps"


def drawn_at(run: RunDirectory, row: TrackedPose, rasterizer: Rasterizer) -> Image:
    """The map's own colours, not clipped."""
    return render_view(run.load_submap(row.submap_index), CAMERA, row.T_map_cam, rasterizer).color


def exposed(run: RunDirectory, sequence: Recorded, rasterizer: Rasterizer, exposure: Exposure) -> Recorded:
    """The run, with all its rows and keyframes told to be exposed so, and the pictures that are."""
    trajectory, atlas = run.trajectory()
    rows = tuple(replace(row, exposure=exposure) for row in trajectory.rows)
    run.write_trajectory(Trajectory(rows), atlas)
    frames = []
    for row, frame in zip(rows, sequence.frames, strict=True):
        color = drawn_at(run, row, rasterizer)
        frames.append(replace(frame, color=exposure.applied(color).clamp(0, 1)))
    return replace(sequence, frames=tuple(frames))


@pytest.mark.parametrize("exposure", [Exposure(0.8), Exposure(0.9, -0.05), Exposure(1.25, 0.05)], ids=str)
def test_withheld_views_are_drawn_as_exposed(
    run: RunDirectory, sequence: Recorded, rasterizer: Rasterizer, exposure: Exposure
) -> None:
    """And clipped after that, as the camera does it."""
    re_exposed = exposed(run, sequence, rasterizer, exposure)
    value = {name: metric.value for name, metric in evaluate(run, re_exposed, rasterizer).metrics.items()}
    assert value["psnr_withheld"] > 90.0 and value["psnr_withheld_mapped"] > 90.0
    assert value["ssim_withheld"] > 0.999
    change = [
        (drawn_at(run, row, rasterizer).clamp(0, 1) - frame.color)[frame.valid]
        for row, frame in zip(run.trajectory()[0].rows, re_exposed.frames, strict=True)
        if row.frame_index in (1, 3, 5)
    ]
    unexposed = float(np.mean([-10 * np.log10(float(part.square().mean())) for part in change]))
    assert value["psnr_withheld_unexposed"] == pytest.approx(unexposed, abs=0.01)
    assert unexposed < 24.0


def test_unexposed_views_are_drawn_with_the_mean_of_the_keyframes(
    run: RunDirectory, sequence: Recorded, rasterizer: Rasterizer
) -> None:
    re_exposed = exposed(run, sequence, rasterizer, Exposure(0.8, 0.05))
    for index in range(2):
        submap = run.load_submap(index)
        around = zip(submap.keyframes, (Exposure(0.64, 0.1), Exposure(1.0, 0.0)), strict=True)
        keyframes = tuple(replace(keyframe, exposure=exposure) for keyframe, exposure in around)
        run.write_submap(replace(submap, keyframes=keyframes))
    metrics = evaluate(run, re_exposed, rasterizer).metrics
    assert metrics["psnr_withheld_unexposed"].value > 90.0 and metrics["psnr_withheld"].value > 90.0


def test_keyframes_are_drawn_as_exposed(run: RunDirectory, rasterizer: Rasterizer) -> None:
    for index in range(2):
        submap = run.load_submap(index)
        keyframes = []
        for keyframe, gain in zip(submap.keyframes, (0.8, 1.25), strict=True):
            color = gain * seen(submap, 0, keyframe.T_map_cam, rasterizer).frame.color
            frame = replace(keyframe.frame, color=color.clamp(0, 1))
            keyframes.append(replace(keyframe, frame=frame, exposure=Exposure(gain)))
        run.write_submap(replace(submap, keyframes=tuple(keyframes)))
    assert evaluate(run, None, rasterizer).metrics["psnr"].value > 50.0  # all that parts them is rounding to 8 bits


def test_the_contact_sheet_shows_the_map_as_exposed(
    run: RunDirectory, sequence: Recorded, rasterizer: Rasterizer
) -> None:
    re_exposed = exposed(run, sequence, rasterizer, Exposure(0.5, 0.1))
    sheets = [figures.contact_sheet_of(run, re_exposed, rasterizer, columns=3, width=400)]
    exposed(run, sequence, rasterizer, Exposure())
    sheets.append(figures.contact_sheet_of(run, re_exposed, rasterizer, columns=3, width=400))
    tile = (len(sheets[0]) - 36 - 12 - 3 * 6) // 4
    inner = slice(0, tile * 4 // 5), slice(34, -80)  # of the first row of tiles, without the border of the pictures
    apart = [np.abs(np.diff([sheet[36:][inner], sheet[36 + tile + 6 :][inner]], axis=0)) for sheet in np.int64(sheets)]
    assert apart[0].mean() < 3.0 < 20.0 < apart[1].mean()


def test_withheld_are_frames_neither_mapped_nor_lost(
    run: RunDirectory, sequence: Recorded, rasterizer: Rasterizer
) -> None:
    told: list[tuple[int, int]] = []
    evaluate(run, sequence, rasterizer, progress=lambda done, total: told.append((done, total)))
    assert sequence.asked == [1, 3, 5]
    assert told == [(frame + 1, 8) for frame in (0, 1, 2, 3, 4, 5, 6)]
    report = evaluate(run, replace(sequence, asked=[]), rasterizer, withheld_every=3)
    assert report.evaluated["withheld"].startswith("1 of 3 frames")

    trajectory, atlas = run.trajectory()
    run.write_trajectory(Trajectory(tuple(replace(row, mapped=row.frame_index != 3) for row in trajectory.rows)), atlas)
    sequence.asked.clear()
    evaluate(run, sequence, rasterizer)
    assert sequence.asked == [3]
    run.write_trajectory(Trajectory(tuple(replace(row, mapped=True) for row in trajectory.rows)), atlas)
    assert "was mapped or lost" in evaluate(run, sequence, rasterizer).missing["psnr_withheld"]


def test_older_runs_withhold_all_but_keyframes(run: RunDirectory, sequence: Recorded, rasterizer: Rasterizer) -> None:
    trajectory, atlas = run.trajectory()
    run.write_trajectory(Trajectory(tuple(replace(row, mapped=False) for row in trajectory.rows)), atlas)
    submap = run.load_submap(1)
    run.write_submap(replace(submap, keyframes=submap.keyframes[:1]))
    report = evaluate(run, sequence, rasterizer)
    assert sequence.asked == [1, 3, 5, 6]
    assert "former keyframes that the submap dropped" in report.evaluated["withheld"]


def test_withheld_frames_of_an_unsaved_submap_do_not_count(
    run: RunDirectory, sequence: Recorded, rasterizer: Rasterizer
) -> None:
    (run.path / "submaps" / "0001.npz").unlink()
    assert evaluate(run, sequence, rasterizer).metrics["psnr_withheld"].value == pytest.approx(20.0, abs=1e-4)
    assert sequence.asked == [1, 3]


def test_holes_are_told_apart_from_errors(run: RunDirectory, sequence: Recorded, rasterizer: Rasterizer) -> None:
    for index in range(2):
        submap = run.load_submap(index)
        run.write_submap(submap.kept(submap.gaussians.means[:, 0] < 0.0))
    value = {name: metric.value for name, metric in evaluate(run, sequence, rasterizer).metrics.items()}
    assert 20.0 < value["coverage_withheld"] < 60.0
    assert value["psnr_withheld"] < 10.0
    assert 15.0 < value["psnr_withheld_mapped"] < 20.5


def test_spread_is_even_and_out_of_step_with_mapping() -> None:
    rows = tuple(TrackedPose(i, i / 30, 0, at(0.0)) for i in range(480))
    chosen = [row.frame_index for row in spread(rows, 120)]
    assert chosen == sorted(set(chosen))
    assert 100 < len(chosen) <= 120
    assert max(np.diff([0, *chosen, 480])) <= 8
    phases = np.bincount(np.array(chosen) % 4)  # a fixed step of four would see one of them only
    assert phases.min() > 20
    assert spread(rows, 480) == rows == spread(rows, 9999)
    assert len(spread(rows, 1)) == 1
    assert spread((), 5) == ()


def test_dropped_frames_are_told(run: RunDirectory, rasterizer: Rasterizer) -> None:
    run.write_summary(run.summary() | {"realtime": False, "frames_dropped": 0, "ms_late_median": None})
    assert "frames_dropped" not in evaluate(run, None, rasterizer).metrics
    run.write_summary(run.summary() | {"realtime": True, "frames_dropped": 3, "ms_late_median": 21.5})
    metrics = evaluate(run, None, rasterizer).metrics
    assert (metrics["frames_dropped"], metrics["ms_late"]) == (Metric(3), Metric(21.5, "ms"))


def test_depth_of_another_instant_is_brought_to_that_of_colour(
    run: RunDirectory, sequence: Recorded, rasterizer: Rasterizer
) -> None:
    """The camera moves at 3 m/s along a wall with a step; depth comes late, and shows the step where it is then."""
    delay, late = 0.03, []
    submaps = [stepped(0, at(0.0)), stepped(1, at(0.4))]
    for row, frame in zip(run.trajectory()[0].rows, sequence.frames, strict=True):
        depth = seen(submaps[row.submap_index], 0, row.T_map_cam @ at(3.0 * delay), rasterizer).frame.depth
        late.append(replace(frame, depth=depth, depth_timestamp=frame.timestamp + delay))
    for submap in submaps:
        run.write_submap(submap)
    as_if_together = tuple(replace(frame, depth_timestamp=None) for frame in late)
    compensated, ignored = (
        evaluate(run, replace(sequence, frames=frames), rasterizer).metrics["depth_l1_withheld"].value - 100 * OFFSET
        for frames in (tuple(late), as_if_together)
    )
    assert abs(compensated) < 2.0
    assert ignored > 5.0


def test_unmapped_pixels_count_in_full(run: RunDirectory, rasterizer: Rasterizer) -> None:
    submap = run.load_submap(0)
    half = submap.kept(submap.gaussians.means[:, 0] < 0.0)
    run.write_submap(half)
    report = evaluate(run, None, rasterizer)
    assert 60.0 < report.metrics["depth_coverage"].value < 90.0
    assert report.metrics["depth_l1"].value > 30.0


def test_killed_run_without_data_is_still_scored(run: RunDirectory, rasterizer: Rasterizer) -> None:
    (run.path / "summary.json").unlink()
    (run.path / "submaps" / "0001.npz").unlink()
    report = evaluate(run, None, rasterizer, stride=2)
    assert report.metrics["submaps"].value == 1
    assert report.metrics["psnr"].value > 50.0
    withheld = {name for name in report.missing if "withheld" in name}
    of_path = {name for name in report.missing if name.startswith(("ate_", "rpe_"))}
    never = {"lpips", "lpips_map", "ms_ssim", "ms_ssim_map"}
    assert report.missing.keys() == {"loops", "ms_per_frame", "peak_rss_mb"} | of_path | withheld | never
    assert (len(withheld), len(of_path)) == (18, 6)
    assert report.missing["psnr_withheld"] == "the sequence is not at hand"
    assert report.evaluated["withheld"].startswith("0 of 2 frames")
    assert report.missing["ate_rmse"] == "no ground truth"
    assert "was killed" in report.missing["ms_per_frame"]
    assert "one keyframe in 2" in report.evaluated["training"]
    assert report.metrics["psnr_map"].value > 10.0
    assert "/data/wall" in report.evaluated["sequence"]
    assert report.evaluated["part"].startswith("only the first 8 frames, since the run was killed, or ")


def test_how_far_an_unfinished_run_has_come_is_told(run: RunDirectory, sequence: Recorded) -> None:
    assert unfinished(run, sequence) is None
    longer = replace(sequence, frames=sequence.frames * 2)
    run.write_summary(run.summary() | {"interrupted": True})
    told = unfinished(run, longer)
    assert told is not None and told.startswith("only the first 8 of 16 frames, since the run was stopped ")
    assert "--resume" in told
    (run.path / "request.json").write_text('{"command": "tcgsplat run wall --realtime"}')
    told = unfinished(run, longer)
    assert told is not None and "--resume" not in told  # a live run cannot go on
    run.write_summary(run.summary() | {"interrupted": False})
    assert unfinished(run, longer) is None


def test_run_that_sealed_nothing(tmp_path: Path, rasterizer: Rasterizer) -> None:
    run = RunDirectory.create(tmp_path / "new", config_toml="", sequence="")
    with pytest.raises(EvaluationError, match="has no sealed submap yet"):
        evaluate(run, None, rasterizer)
    with pytest.raises(EvaluationError, match="has no sealed submap yet"):
        figures.contact_sheet_of(run, None, rasterizer)
    with pytest.raises(EvaluationError, match="has no trajectory yet"):
        figures.trajectory_plot_of(run, None)


def test_report_on_disk_and_on_a_terminal(tmp_path: Path) -> None:
    report = Report(
        {"ate_rmse": Metric(1.23456, "cm"), "frames": Metric(12345), "ms_per_frame": Metric(1234.56, "ms")},
        {"poses": "estimated"},
        {"psnr": "no view has a pixel that counts"},
    )
    report.write(tmp_path / "report.json")
    assert json.loads((tmp_path / "report.json").read_text()) == {
        "ate_rmse": {"value": 1.23456, "unit": "cm"},
        "frames": {"value": 12345, "unit": ""},
        "ms_per_frame": {"value": 1234.56, "unit": "ms"},
        "evaluated": {"poses": "estimated", "missing": {"psnr": "no view has a pixel that counts"}},
    }
    assert report.table().splitlines() == [
        "ate_rmse        1.235 cm",
        "frames          12345",
        "ms_per_frame    1235 ms",
        "",
        "                submaps, as mapped online   all in one map",
        "                training      withheld      training      withheld",
        "psnr            - (1)",
        "(1)  no view has a pixel that counts",
        "",
        "poses  estimated",
    ]


def test_views_stand_side_by_side_on_a_terminal() -> None:
    metrics = {
        "ate_rmse": Metric(1.23456, "cm"),
        "psnr": Metric(26.2, "dB"), "psnr_withheld": Metric(25.02, "dB"), "psnr_map": Metric(27.5, "dB"),
        "psnr_map_withheld": Metric(26.111, "dB"), "psnr_withheld_unexposed": Metric(24.68, "dB"),
        "ssim": Metric(0.8745), "ssim_map": Metric(0.9), "frames": Metric(193),
    }  # fmt: skip
    away, no_weights = "the sequence is not at hand", "not available: give the weights by --lpips"
    missing = {"ssim_withheld": away, "lpips": no_weights, "lpips_withheld": no_weights, "ssim_map_withheld": away}
    assert Report(metrics, {}, missing | {"rpe_rotation": "no ground truth"}).figures().splitlines() == [
        "ate_rmse        1.235 cm",
        "",
        "                submaps, as mapped online   all in one map",
        "                training      withheld      training      withheld",
        "psnr            26.20 dB      25.02 dB      27.50 dB      26.11 dB",
        "psnr_unexposed                24.68 dB",
        "ssim            0.8745        - (1)         0.9000        - (1)",
        "lpips           - (2)         - (2)",
        "(1)  the sequence is not at hand",
        "(2)  not available: give the weights by --lpips",
        "",
        "frames          193",
        "rpe_rotation    - (no ground truth)",
    ]
    long = Report({"frames": Metric(3)}, {"poses": "estimated " * 30, "run": "r"}).table().splitlines()
    assert max(map(len, long)) <= 120 and long[3].startswith("       estimated") and long[-1] == "run    r"


def test_frames_kept_back_on_purpose_are_the_withheld_ones(
    run: RunDirectory, sequence: Recorded, rasterizer: Rasterizer
) -> None:
    """All of them, and no others, though more were never mapped; the first is mapped, and one is lost."""
    (run.path / "config.toml").write_text("[schedule]\nwithhold_every = 3\n")
    report = evaluate(run, sequence, rasterizer)
    assert sequence.asked == [3]
    assert report.evaluated["withheld"].startswith("1 of 1 frames that schedule.withhold_every kept back")
    assert "a multiple of 3" in report.evaluated["withheld"]
    (run.path / "config.toml").write_text("[schedule]\nwithhold_every = 7\n")
    assert "was mapped or lost" in evaluate(run, sequence, rasterizer).missing["psnr_withheld"]


def test_all_frames_kept_back_are_drawn_unless_told_otherwise(
    run: RunDirectory, sequence: Recorded, rasterizer: Rasterizer
) -> None:
    (run.path / "config.toml").write_text("[schedule]\nwithhold_every = 2\n")
    trajectory, atlas = run.trajectory()
    rows = tuple(replace(row, mapped=row.frame_index % 2 == 1, lost=False) for row in trajectory.rows)
    run.write_trajectory(Trajectory(rows), atlas)
    evaluate(run, sequence, rasterizer)
    assert sequence.asked == [0, 2, 4, 6]
    sequence.asked.clear()
    evaluate(run, sequence, rasterizer, withheld_every=2)
    assert len(sequence.asked) == 2


def test_perceptual_distance_with_weights(run: RunDirectory, sequence: Recorded, rasterizer: Rasterizer) -> None:
    """Random ones: that of the keyframes, which the map shows as they are, is near 0."""
    generator = torch.Generator().manual_seed(0)
    shapes = {0: (64, 3, 11, 11), 3: (192, 64, 5, 5), 6: (384, 192, 3, 3), 8: (256, 384, 3, 3), 10: (256, 256, 3, 3)}
    weights = {f"lin{i}.model.1.weight": torch.ones(1, n[0], 1, 1) for i, n in enumerate(shapes.values())}
    for number, shape in shapes.items():
        weights[f"features.{number}.weight"] = 0.1 * (torch.rand(shape, generator=generator) - 0.5)
        weights[f"features.{number}.bias"] = torch.zeros(shape[0])
    value = {name: m.value for name, m in evaluate(run, sequence, rasterizer, lpips=Lpips(weights)).metrics.items()}
    assert 0.0 < value["lpips"] < 1e-3 and value["lpips_withheld"] > 10 * value["lpips"]
    assert value["lpips_map"] > 10 * value["lpips"] and value["lpips_map_withheld"] > 0.0


def test_pictures_of_a_run(run: RunDirectory, sequence: Recorded, rasterizer: Rasterizer) -> None:
    sheet = figures.contact_sheet_of(run, None, rasterizer, columns=3, width=800)
    assert sheet.shape[1] == 800
    assert figures.contact_sheet_of(run, None, rasterizer, columns=9, width=800).shape[0] < sheet.shape[0]  # keyframes
    withheld = figures.contact_sheet_of(run, sequence, rasterizer, columns=3, width=800)
    assert sequence.asked == [1, 3, 5]
    assert withheld.shape == sheet.shape
    assert not np.array_equal(withheld[40:60], sheet[40:60])
    assert figures.trajectory_plot_of(run, sequence).shape[1] == 1200
    assert figures.trajectory_plot_of(run, None).shape[1] == 1200


def test_association_is_by_time_and_one_to_one() -> None:
    times = np.array([0.0, 0.100, 0.104, 0.2, 0.5])
    others = np.array([0.215, 0.103, 0.0, 0.9])
    assert associate(times, others) == [(3, 0), (2, 1), (0, 2)]
    assert associate(times, others, max_gap=0.01) == [(2, 1), (0, 2)]
    assert associate(np.zeros(0), others) == associate(times, np.zeros(0)) == []


def test_trajectory_of_another_system(tmp_path: Path, sequence: Recorded) -> None:
    stamps = [100.0 + i / 30 + 0.004 for i in range(8)]
    poses = [at(0.1 * i, 0.04 if i == 7 else 0.0) for i in range(8)]
    (tmp_path / "other.txt").write_text(format_tum(stamps, poses))
    report = score_trajectory(tmp_path / "other.txt", sequence)
    assert report.metrics["ate_rmse"].value == pytest.approx(expected_ate_cm(), abs=1e-6)
    assert report.metrics["frames"].value == 7
    assert report.metrics["frames_tracked"].value == 100.0
    assert {"ate_rmse_sim3", "rpe_translation", "rpe_rotation"} <= report.metrics.keys()
    assert "7 of its 8 poses, against 7 frames" in report.evaluated["trajectory"]


def test_frames_without_a_pose_are_not_tracked(tmp_path: Path, sequence: Recorded) -> None:
    (tmp_path / "other.txt").write_text(
        format_tum([100.0 + i / 30 for i in range(3, 8)], [at(0.1 * i) for i in range(5)])
    )
    metrics = score_trajectory(tmp_path / "other.txt", sequence).metrics
    assert (metrics["frames_tracked"], metrics["frames"]) == (Metric(62.5, "%"), Metric(4))  # frame 3 has no truth


def test_trajectory_that_cannot_be_scored(tmp_path: Path, sequence: Recorded) -> None:
    path = tmp_path / "other.txt"
    with pytest.raises(EvaluationError, match=r"cannot read .*other\.txt"):
        score_trajectory(path, sequence)
    path.write_text("1 2 3\n")
    with pytest.raises(EvaluationError, match="line 1 is not"):
        score_trajectory(path, sequence)
    path.write_text(format_tum([0.0, 1.0, 2.0], [at(0.0)] * 3))
    with pytest.raises(EvaluationError, match=r"only 0 of 3 poses .* same clock"):
        score_trajectory(path, sequence)
    with pytest.raises(EvaluationError, match="wall has no ground truth"):
        score_trajectory(path, Recorded(sequence.frames))
