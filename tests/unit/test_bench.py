"""`tcgsplat bench`: what is timed, what is counted, and the physical limit that follows."""

import importlib.util
import json
import math
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
import torch
from analytic_room import CAMERA, Room, walk

from tcgsplat.cli.bench import limit, probes, render, track
from tcgsplat.cli.bench.iteration import Iteration
from tcgsplat.cli.bench.limit import Machine, Needs, floors
from tcgsplat.cli.main import main
from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.conventions import MIN_ALPHA, MIN_TRANSMITTANCE
from tcgsplat.render.numba_cpu.layout import from_blocks
from tcgsplat.render.numba_cpu.passes import Passes
from tcgsplat.render.numba_cpu.rasterizer import NumbaRasterizer
from tcgsplat.render.numba_cpu.workers import Workers
from tcgsplat.render.protocol import Splats
from tcgsplat.render.reference import project
from tcgsplat.scene.trajectory import format_tum

SMALL = render.Size(80, 60, 2500)  # as dense as 320x240/40k
SLOW_MACHINE = Machine(threads=2, vector_rate=1e9, clock_rate=2e9)


# Times.


def test_every_stage_is_timed():
    size = render.Size(64, 48, 1000)
    times = render.timed(size, render.scene(size), 15, threads=1, warm_up=1)
    assert list(times) == ["project", "sort", "bin", "forward", "backward", "step", "iteration"]
    assert all(0 < stage.minimum <= stage.median for stage in times.values())


def test_runs_have_a_median_and_a_minimum():
    assert render.Times.of([0.003, 0.001, 0.002, 0.009]) == render.Times(median=2.5, minimum=1.0)


def test_each_iteration_meets_the_same_scene():
    splats = render.scene(SMALL)
    iteration = Iteration(splats, SMALL.camera, Passes(2))
    raw, parameters, planes = iteration.raw.copy(), iteration.parameters.copy(), iteration.draw().planes
    iteration.step()
    iteration.step()
    assert np.array_equal(iteration.raw, raw) and np.array_equal(iteration.parameters, parameters)
    assert np.array_equal(iteration.draw().planes, planes)
    drawn = iteration.draw().visible
    assert drawn[:2500].mean() > 0.95 and not drawn[2500:].any()
    assert (from_blocks(iteration.second)[drawn] > 0).mean() > 0.8  # Adam had something to do for most
    assert not from_blocks(iteration.second)[~drawn].any()


def test_what_is_timed_draws_the_splats():
    splats = render.scene(SMALL)
    raster = NumbaRasterizer(1)(splats, SMALL.camera, se3.identity())
    planes = render.drawn(SMALL, splats, threads=1).planes
    assert np.abs(planes[:4] - raster.features.permute(2, 0, 1).numpy()).max() < 1e-4
    assert np.abs(planes[4] - raster.depth.numpy()).max() < 1e-4


def test_the_file_holds_the_object_that_was_promised(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(render, "SIZES", (render.Size(64, 48, 1000), render.Size(32, 32, 2000)))
    assert main(["bench", "render", "--json", str(tmp_path / "times.json"), "--repeats", "1", "--threads", "1"]) == 0
    written = json.loads((tmp_path / "times.json").read_text())
    assert list(written) == ["64x48/1k", "32x32/2k"]
    small = written["32x32/2k"]
    assert small["forward_ms"] >= small["forward_min_ms"] > small["forward_floor_ms"] > 0
    assert small["iteration_ms"] > small["iteration_floor_ms"] > small["step_floor_ms"] > 0
    assert small["threads"] == 1
    assert all(isinstance(value, int | float) for value in small.values())
    said = capsys.readouterr().out
    assert said.count("64x48/1k") == said.count("32x32/2k") == 2  # a table of times, and one of the limit
    assert f" {small['forward_ms']:.2f} " in said and f" {small['lane_use']:.0%} " in said


def test_sizes_are_those_that_were_promised():
    assert [str(size) for size in render.SIZES] == ["320x240/40k", "640x480/150k", "1200x680/600k"]


def test_about_twenty_five_splats_show_in_a_pixel():
    splats = render.scene(SMALL)
    with torch.no_grad():
        projected = project(splats, SMALL.camera, se3.identity())
        reach = 2 * (255 * splats.opacities).clamp_min(1).log()
        area = math.pi * reach * torch.linalg.det(projected.covariances).sqrt()
    assert float(area.sum()) / (80 * 60) == pytest.approx(25, abs=3)
    again = render.scene(SMALL)
    assert torch.equal(again.means, splats.means) and torch.equal(again.features, splats.features)


def test_help_loads_nothing_heavy():
    code = (
        "import sys; from tcgsplat.cli.main import main; main(['bench', 'track', '--help'])\n"
        "sys.exit(str({'torch', 'numba', 'numpy', 'cv2'} & set(sys.modules) or ''))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stderr.strip() == ""
    assert done.stdout.startswith("usage: tcgsplat bench track")


# Counts.


def dots(pixels: list[tuple[float, float]], opacity: float) -> tuple[render.Size, Splats]:
    """Points before a camera of 60 x 44 pixels, each but its blur: a variance of 0.3 square pixels."""
    size = render.Size(60, 44, len(pixels))
    camera, n = size.camera, len(pixels)
    z = 1.0 + 0.01 * torch.arange(n)
    u, v = torch.tensor(pixels).T
    means = torch.stack(((u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy, z), dim=-1)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1)
    return size, Splats(means, quats, torch.full((n, 3), 1e-6), torch.full((n,), opacity), torch.ones(n, 4))


@pytest.mark.parametrize(
    ("at", "needed"),
    [
        ((10.0, 9.0), (9, 1, 1)),  # alpha reaches 1/255 at a distance of 1.81: the nine pixels around
        ((16.0, 16.0), (9, 4, 4)),  # over the corner of four tiles
        ((59.0, 43.0), (4, 1, 1)),  # at the corner of the image; the block around it ends there
        ((-9.0, 9.0), (0, 0, 0)),
    ],
)
def test_one_dot_needs_what_it_covers(at: tuple[float, float], needed: tuple[int, int, int]):
    size, splats = dots([at], 0.9)
    counted = Needs.of(render.drawn(size, splats, threads=1))
    assert (counted.pixels, counted.blocks, counted.pairs) == needed


def test_behind_what_is_opaque_nothing_is_needed():
    # At the centre 1, 0.02 and 4e-4 are let through, then less than 1e-4; around it, five splats are not enough.
    size, splats = dots([(10.0, 9.0)] * 5, 0.98)
    assert Needs.of(render.drawn(size, splats, threads=1)).pixels == 3 + 8 * 5


def test_pixels_agree_with_the_oracle():
    splats = render.scene(SMALL)
    counted = Needs.of(render.drawn(SMALL, splats, threads=2))
    with torch.no_grad():
        projected = project(splats, SMALL.camera, se3.identity())
    assert counted.pixels == pytest.approx(needed_pixels(splats, SMALL.camera, projected), rel=1e-3)
    assert counted.pixels / 16 < counted.blocks < counted.pixels
    assert counted.lane_use == pytest.approx(0.47, abs=0.03)  # as in the study that the kernels are built on


def needed_pixels(splats: Splats, camera: Camera, projected: object) -> int:
    """All splats at all pixels, in plain torch."""
    order = projected.depths.argsort()
    order = order[projected.depths[order] > 0.2]
    v, u = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    pixels = torch.stack((u, v), dim=-1).reshape(-1, 1, 2).to(projected.centers.dtype)
    count = 0
    for some in pixels.split(300):
        offset = some - projected.centers[order]
        exponent = -0.5 * torch.einsum(
            "pni,nij,pnj->pn", offset, torch.linalg.inv(projected.covariances[order]), offset
        )
        alpha = splats.opacities.detach()[order] * exponent.exp()
        alpha = torch.where(alpha >= MIN_ALPHA, alpha, 0.0)
        through = torch.cumprod(1 - alpha, dim=1) / (1 - alpha)
        count += int(((alpha > 0) & (through > MIN_TRANSMITTANCE)).sum())
    return count


# The limit.


def test_floors_by_hand():
    least = floors(Needs(splats=16_000, pixels=5_000_000, blocks=1_000_000, pairs=200_000), SLOW_MACHINE)
    assert least["forward"] == pytest.approx(15 * 1e6 / 2e9 * 1e3)
    assert least["backward"] == pytest.approx((31 * 1e6 / 2e9 + 11 * 2e5 / 4e9) * 1e3)
    assert all(ms > 0 for ms in least.values())
    assert {"project", "step"} < set(least)


def test_bytes_by_hand():
    assert limit.PROJECT_BYTES == 15 * 4 + 64 + 4 + 16
    assert limit.STEP_BYTES == 4 * 11 + 4 * 15 * 6


def test_rates_are_those_of_a_computer():
    clock, vectors = probes.clock_rate(), probes.vector_rate()
    assert 0.3e9 < clock < 10e9
    assert 0.02 < vectors / clock < 4.5  # two pipes, or four, of a whole vector or a part
    assert 1e8 < probes.stream_rate(1_000_000, Workers(1)) < 1e13


# The whole system.


def test_the_first_frame_does_not_count_and_a_skipped_stage_takes_no_time():
    rows = [{"track": 9.0, "map": 9.0}, {"track": 0.010}, {"track": 0.030, "map": 0.100}]
    spreads = track.Timed({}, rows, lost=0).milliseconds()
    assert list(spreads) == ["track", "map"]
    assert spreads["track"].mean == pytest.approx(20.0)
    assert (spreads["map"].mean, spreads["map"].median) == pytest.approx((50.0, 50.0))
    assert spreads["map"].percentile_95 == pytest.approx(95.0)
    assert track.Timed({}, rows[:1], lost=0).milliseconds()["track"].median == pytest.approx(9000.0)


def test_updates_beside_have_a_line_of_their_own():
    timed = track.Timed({}, [{"track": 0.010}], lost=0, updates=[9.0, 0.010, 0.030])
    assert track.table(timed).splitlines()[1:] == [
        "track             10.00    10.00    10.00",
        "update            20.00    20.00    29.00   beside the frames, 2 of them",
    ]
    assert len(track.table(track.Timed({}, [{"track": 0.010}], lost=0)).splitlines()) == 2


def test_ate_is_of_the_frames_whose_pose_is_known():
    moved = se3.exp(torch.tensor([1.0, 2.0, 3.0, 0.4, 0.5, 0.6], dtype=torch.float64))
    truth = {i: se3.exp(torch.tensor([0.1 * i, 0.01 * i**2, 0, 0, 0, 0], dtype=torch.float64)) for i in range(6)}
    timed = track.Timed({i: moved @ T for i, T in truth.items() if i != 2} | {9: moved}, [], lost=0)
    assert timed.ate_cm(truth) == pytest.approx(0.0, abs=1e-9)
    assert timed.ate_cm({0: truth[0], 1: truth[1], 2: truth[2]}) is None
    off = {**timed.T_world_cam, 5: moved @ truth[5] @ se3.exp(torch.tensor([0, 0, 0.1, 0, 0, 0], dtype=torch.float64))}
    assert 1.0 < track.Timed(off, [], lost=0).ate_cm(truth) < 5.0


@pytest.fixture
def flat(tmp_path: Path) -> Path:
    """Eight frames of the analytic room."""
    folder, poses = tmp_path / "flat", walk(8)
    camera = "".join(f"{name} = {value}\n" for name, value in asdict(CAMERA).items())
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
        (folder / f"{kind}.txt").write_text("".join(f"{i / 30:.6f} {kind}/{i}.png\n" for i in range(len(poses))))
    for i, T_world_cam in enumerate(poses):
        frame = Room().frame(T_world_cam, i)
        color = (255 * frame.color.flip(-1).clamp(0, 1)).round().byte().numpy()
        assert cv2.imwrite(str(folder / f"rgb/{i}.png"), color)
        assert cv2.imwrite(str(folder / f"depth/{i}.png"), (5000 * frame.depth).round().numpy().astype(np.uint16))
    (folder / "groundtruth.txt").write_text(format_tum([i / 30 for i in range(len(poses))], poses))
    (folder / "camera.toml").write_text(camera + "depth_scale = 5000.0\n")
    return folder


def test_a_recorded_sequence_is_timed(flat: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / "times.json"
    flags = ["--limit", "6", "--mapper.iterations", "2", "--seed", "4", "--json", str(file)]
    assert main(["bench", "track", str(flat), *flags]) == 0
    written = json.loads(file.read_text())
    assert (written["frames"], written["width"], written["seed"]) == (6, 80, 4)
    assert "iterations = 2" in written["config"]
    ms = {stage: spread["mean"] for stage, spread in written["milliseconds"].items()}
    stages = list(ms)
    assert stages[0] == "load" and stages[-1] == "frame" and "track" in stages[1:-1]
    assert 0.5 * ms["frame"] < sum(ms.values()) - ms["frame"] < 1.01 * ms["frame"]  # stages are parts of the frame
    assert 0.0 < written["ate_rmse_cm"] < 1.0
    assert 0.0 < written["finish_ms"] < 1e5
    assert written["updates"] == 0 or written["update_milliseconds"]["median"] > 0.0
    said = capsys.readouterr().out
    assert "flat, 80x60, 6 frames; " in said and "mapper.iterations = 2, seed 4\n" in said
    assert f"{ms['track']:.2f}" in said and f"ATE {written['ate_rmse_cm']:.3f} cm" in said


def test_without_truth_there_is_no_error_of_it(flat: Path, capsys: pytest.CaptureFixture[str]):
    (flat / "groundtruth.txt").unlink()
    assert main(["bench", "track", str(flat), "--limit", "3", "--mapper.iterations", "1"]) == 0
    assert "ATE unknown: fewer than 3 true poses" in capsys.readouterr().out


# Scripts of benchmarks/.


def script(name: str) -> ModuleType:
    """One of the scripts as a module."""
    path = Path(__file__).parents[2] / "benchmarks" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_open3d_is_asked_for_where_it_is_missing(flat: Path, capsys: pytest.CaptureFixture[str]):
    if importlib.util.find_spec("open3d"):
        pytest.skip("open3d is here")
    open3d_slam = script("open3d_slam")
    assert open3d_slam.main(open3d_slam.Args(flat)) == 1
    said = capsys.readouterr().err
    assert said.startswith("open3d_slam: open3d is not installed for this Python; run `python -m pip install ")
    assert said.count("\n") == 1


def test_both_systems_are_counted_alike():
    open3d_slam = script("open3d_slam")
    rows = [{"load": 9.0, "frame": 18.0}, {"load": 0.010, "frame": 0.030}, {"load": 0.020, "frame": 0.080}]
    truth = {i: se3.exp(torch.tensor([0.1 * i, 0.01 * i**2, 0, 0, 0, 0], dtype=torch.float64)) for i in range(3)}
    figures = open3d_slam.figures(track.Timed(truth, rows, lost=1, finish=0.006), truth)
    assert figures["ate_rmse_cm"] == pytest.approx(0.0, abs=1e-9)
    assert figures["ms_mean"] == pytest.approx((20 + 60 + 6) / 2)
    assert figures["ms_median"] == pytest.approx(40.0)
    assert figures["ms_mean_with_reading"] == pytest.approx((30 + 80 + 6) / 2)
    row = open3d_slam.table({"us": figures}).splitlines()[-1].split()
    assert row == ["us", "0.00", "43.0", "40.0", "58.0", "58.0", "1"]


def test_the_same_is_run_at_several_sizes(flat: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    full_resolution = script("full_resolution")
    flat.rename(tmp_path / "80x60")  # a sequence that is there is not made again
    args = full_resolution.Args(tmp_path, sizes=("80x60",), limit=4, json=tmp_path / "times.json")
    assert full_resolution.main(args) == 0
    assert "\n80x60, 4 frames: ATE 0." in capsys.readouterr().out
    written = json.loads((tmp_path / "times.json").read_text())
    assert written["80x60"]["milliseconds"]["frame"]["mean"] > 0
    assert full_resolution.main(full_resolution.Args(tmp_path, sizes=("80",))) == 1
    assert "full_resolution: --sizes: 80 is not a size; write it like 640x480" in capsys.readouterr().err
