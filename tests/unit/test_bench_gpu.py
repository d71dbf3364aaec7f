"""`tcgsplat bench gpu`: what it times runs here on the CPU; the GPU's own figures come from a machine that has one."""

import json
import logging
from pathlib import Path

import pytest
import torch

from tcgsplat.cli.bench import gpu
from tcgsplat.cli.bench.contenders import BareGsplat, Ours, Scene
from tcgsplat.cli.bench.gpu import BARE, Iterations, Results, Run, iterations, parsed
from tcgsplat.cli.bench.render import Size, Times
from tcgsplat.cli.main import main
from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.numba_cpu.rasterizer import NumbaRasterizer
from tcgsplat.render.protocol import Splats

SMALL = Size(80, 60, 1500)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.of(SMALL, NumbaRasterizer(1))


def drawn_like_gsplat(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, *, near_plane, eps2d, packed, render_mode
):
    """`gsplat.rasterization` for a single camera, through our kernels: its arguments, shapes and pixel centres."""
    assert (near_plane, eps2d, packed, render_mode) == (0.2, 0.3, False, "RGB+D")
    assert viewmats.shape == (1, 4, 4) and Ks.shape == (1, 3, 3)
    (fx, _, cx), (_, fy, cy), _ = Ks[0].tolist()
    camera = Camera(fx, fy, cx - 0.5, cy - 0.5, width, height)
    features = torch.cat((colors, torch.zeros(len(colors), 1)), dim=1)
    raster = NumbaRasterizer(1)(Splats(means, quats, scales, opacities, features), camera, viewmats[0].double())
    return torch.cat((raster.features[..., :3], raster.depth[..., None]), dim=-1)[None], raster.alpha[None], {}


def test_our_iterations_are_the_system_s_own(scene: Scene):
    ours = Ours(scene, NumbaRasterizer(1))
    off = se3.translation_norm(scene.guess)
    found = ours.track(40)
    assert found.iterations == 40
    assert se3.translation_norm(found.T_map_cam) < 0.5 * off  # the picture was taken at the origin
    optimization = ours.map(2)
    assert optimization.loss > 0.01  # the keyframe's pose is the wrong guess
    for name in ("means", "log_scales", "quats", "logit_opacities", "sh"):
        before, after = getattr(scene.submap.gaussians, name), getattr(optimization.submap().gaussians, name)
        assert torch.equal(before, after), name  # each iteration meets the same scene


def test_the_bare_loop_optimises_what_it_says(scene: Scene):
    bare = BareGsplat(scene, torch.device("cpu"), drawn_like_gsplat)
    q, t = bare.track(40)
    T_cam_map = torch.eye(4, dtype=torch.float64)
    T_cam_map[:3, 3] = t.detach().double()
    left = se3.translation_norm(T_cam_map @ se3.inverse(scene.guess))
    assert left < 0.7 * se3.translation_norm(scene.guess)
    assert q.grad.abs().sum() > 0
    parameters = bare.map(2)
    assert len(parameters) == 5 and all(float(table.grad.abs().sum()) > 0 for table in parameters)
    assert torch.equal(parameters[0].detach(), scene.submap.gaussians.means)


def test_contenders_are_timed_in_turn_and_want_of_memory_is_told(caplog: pytest.LogCaptureFixture):
    def greedy(*arguments, **named):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory.\nmore about it")

    with caplog.at_level(logging.WARNING):
        rows = iterations(SMALL, (NumbaRasterizer(1),), greedy, repeats=2, steps=2)
    assert [(one.size, one.contender) for one in rows] == [("80x60x1500", "numba"), ("80x60x1500", BARE)]
    assert 0 < rows[0].tracking.minimum <= rows[0].tracking.median and rows[0].mapping.median > 0
    assert rows[0].peak_mb is None  # no GPU
    assert rows[1] == Iterations("80x60x1500", BARE)
    assert caplog.messages == ["gsplat alone at 80x60x1500: not enough GPU memory (CUDA out of memory.)"]
    rows = iterations(SMALL, (NumbaRasterizer(1),), drawn_like_gsplat, repeats=1, steps=2)
    assert rows[1].tracking.median > 0 and rows[1].mapping.median > 0


def test_the_page_has_ratios_and_what_is_missing():
    rows = (
        Iterations("640x480x150000", "cuda", Times(3.0, 2.5), Times(6.0, 5.0), 900.4),
        Iterations("640x480x150000", BARE, Times(2.0, 2.0), Times(4.0, 4.0), 700.0),
        Iterations("1200x680x600000", "cuda"),
    )
    runs = (Run("default", "cuda", "cuda", 300, 41.23, 20.0, 0.1534, 0, 2000.0), Run("paper-tum", "cuda", "cuda", 300))
    page = Results("A GPU", "About.", rows, runs, {"gsplat": "it is not there"}).page()
    assert "| 640x480x150000 | cuda | 3.00 (2.50) | 6.00 (5.00) | 1.50 and 1.50 | 900 |" in page
    assert "| 640x480x150000 | gsplat alone | 2.00 (2.00) | 4.00 (4.00) | 1.00 and 1.00 | 700 |" in page
    assert "| 1200x680x600000 | cuda | not enough GPU memory | – | – | – |" in page
    assert "| default | cuda | cuda | 300 | 41.2 | 20.0 | 0.153 | 0 | 2000 |" in page
    assert "| paper-tum | cuda | cuda | 300 | not enough GPU memory | – | – | – | – |" in page
    assert "- gsplat is left out: it is not there\n" in page


def test_the_whole_bench_runs_on_the_cpu(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    flags = ["--backends", "numba", "--sizes", "64x48x500", "--steps", "2", "--repeats", "2", "--presets", "default"]
    small = ["--frames", "8", "--width", "64", "--mapper.iterations", "1", "--out", str(tmp_path / "out")]
    assert main(["bench", "gpu", *flags, *small]) == 0
    written = json.loads((tmp_path / "out" / "gpu.json").read_text())
    (row,), (run,) = written["iterations"], written["runs"]
    assert (row["size"], row["contender"], row["peak_mb"]) == ("64x48x500", "numba", None)
    assert row["mapping"]["median"] >= row["mapping"]["minimum"] > 0 < row["tracking"]["minimum"]
    assert (run["preset"], run["backend"], run["device"], run["frames"]) == ("default", "numba", "cpu", 8)
    assert run["fps"] > 0 and run["ate_cm"] > 0
    assert {"torch", "source"} < set(written["versions"])
    page = (tmp_path / "out" / "README.md").read_text()
    assert f"| {run['fps']:.1f} |" in page and f"{row['mapping']['median']:.2f} (" in page
    assert capsys.readouterr().out.startswith(page)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_there_is_nothing_to_time(capsys: pytest.CaptureFixture[str]):
    assert main(["bench", "gpu"]) == 1
    said = capsys.readouterr().err
    assert said.startswith("tcgsplat: there is no GPU that torch can use, so there is nothing to time; ")
    assert said.count("\n") == 1


def test_wrong_sizes_and_numbers_are_told(capsys: pytest.CaptureFixture[str]):
    assert str(parsed("1200x680x600000")) == "1200x680/600k"
    for size in ("640x480", "640x480x", "8x480x100", "640x480x0", "-1x2x3"):
        assert main(["bench", "gpu", "--backends", "numba", "--sizes", size]) == 2
        assert capsys.readouterr().err.startswith(f"tcgsplat: --sizes: {size} is not WIDTHxHEIGHTxGAUSSIANS")
    assert main(["bench", "gpu", "--backends", "numba", "--steps", "0"]) == 2
    assert "--steps must be at least 1" in capsys.readouterr().err


def test_what_was_measured_is_kept_as_it_comes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def interrupted(folder, configs, rasterizer):
        yield Run("default", "numba", "cpu", 3, 1.0, 1.0, 1.0, 0)
        raise KeyboardInterrupt

    monkeypatch.setattr(gpu, "runs", interrupted)
    flags = ["--backends", "numba", "--sizes", "--frames", "2", "--width", "32", "--out", str(tmp_path)]
    assert main(["bench", "gpu", *flags]) == 130
    assert len(json.loads((tmp_path / "gpu.json").read_text())["runs"]) == 1
