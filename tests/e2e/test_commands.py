"""The commands as a person types them, on a small recorded room: real processes, real files, real kills."""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from analytic_room import CAMERA, Room, walk

from tcgsplat.cli import demo
from tcgsplat.cli.main import main
from tcgsplat.cli.progress import RunProgress
from tcgsplat.cli.recorder import Part, begin
from tcgsplat.config import SlamConfig, from_toml, with_settings
from tcgsplat.datasets import open_sequence
from tcgsplat.evaluation.metrics import Metric
from tcgsplat.geometry import se3
from tcgsplat.scene.trajectory import format_tum, parse_tum
from tcgsplat.slam import StepReport
from tcgsplat.storage.ply import read_gaussians
from tcgsplat.storage.run_directory import RunDirectory

FRAMES = 24
SHORT_SUBMAPS = ["--schedule.submap_by", "interval", "--schedule.submap-interval", "8"]
SLOW = ["--mapper.iterations", "60", "--schedule.map_every", "1"]
PATIENCE = 120  # seconds for what takes a few on an idle machine


def record_room(folder: Path) -> Path:
    """The analytic room in TUM layout."""
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    rows: dict[str, list[str]] = {"rgb": [], "depth": []}
    poses = walk(FRAMES)
    for index, T_world_cam in enumerate(poses):
        frame = Room().frame(T_world_cam, index)
        color = (255 * frame.color.clamp(0, 1)).round().byte().numpy()
        depth = (5000 * frame.depth).round().numpy().astype(np.uint16)
        for kind, image in (("rgb", color[..., ::-1]), ("depth", depth)):
            name = f"{kind}/{index:04d}.png"
            assert cv2.imwrite(str(folder / name), np.ascontiguousarray(image))
            rows[kind].append(f"{frame.timestamp:.6f} {name}")
    for kind, lines in rows.items():
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    (folder / "groundtruth.txt").write_text(format_tum([i / 30 for i in range(FRAMES)], poses))
    camera = {name: getattr(CAMERA, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    text = "".join(f"{name} = {value}\n" for name, value in (camera | {"depth_scale": 5000.0}).items())
    (folder / "camera.toml").write_text(text)
    return folder


def tcgsplat(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own, its output in pipes."""
    return subprocess.run(line(*arguments), capture_output=True, text=True, timeout=PATIENCE)


def line(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "tcgsplat.cli.main", *map(str, arguments)]


@pytest.fixture(scope="session")
def room_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_room(tmp_path_factory.mktemp("data") / "room")


@pytest.fixture(scope="session")
def finished(room_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> subprocess.CompletedProcess[str]:
    """`tcgsplat run` over the whole room, in three submaps; the last argument is the run directory."""
    out = tmp_path_factory.mktemp("runs") / "room"
    return tcgsplat("run", room_folder, *SHORT_SUBMAPS, "--out", out)


@pytest.fixture
def run(finished: subprocess.CompletedProcess[str], tmp_path: Path) -> RunDirectory:
    """A copy of the finished run."""
    return RunDirectory.open(Path(shutil.copytree(finished.args[-1], tmp_path / "room")))


def test_a_run_imports_no_symbolic_mathematics(room_folder: Path, tmp_path: Path):
    """Autograd does when it is handed derivatives of a whole picture, and a live camera waits a quarter of a second."""
    told = "import sys; from tcgsplat.cli.main import main; sys.exit(main(sys.argv[1:]) or 'sympy' in sys.modules)"
    arguments = ["run", str(room_folder), *SHORT_SUBMAPS, "--out", str(tmp_path / "run")]
    done = subprocess.run([sys.executable, "-c", told, *arguments], capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr


def test_run_is_quiet_in_a_pipe_and_leaves_a_whole_run(finished: subprocess.CompletedProcess[str]):
    assert finished.returncode == 0, finished.stderr
    assert finished.stderr == ""
    out = finished.args[-1]
    (said,) = finished.stdout.splitlines()
    assert said.startswith(f"{FRAMES} frames in ") and said.endswith(f" Gaussians: {out}")

    run = RunDirectory.open(Path(out))
    trajectory, atlas = run.trajectory()
    assert [row.frame_index for row in trajectory.rows] == list(range(FRAMES))
    assert run.submap_count == len(atlas) == 3
    keyframes = {keyframe.frame.index for i in range(3) for keyframe in run.load_submap(i).keyframes}
    assert {row.frame_index for row in trajectory.rows if row.mapped} == keyframes == {0, 6, 8, 14, 16, 22}
    assert sum(len(run.load_submap(i)) for i in range(3)) == run.summary()["gaussians"]
    summary = run.summary()
    assert (summary["frames"], summary["frames_lost"], summary["submaps"]) == (FRAMES, 0, 3)
    assert (summary["backend"], summary["preset"], summary["interrupted"]) == ("numba", "default", False)
    for name in ("seconds", "ms_per_frame", "ms_per_frame_median", "peak_rss_mb"):
        assert summary[name] > 0, name
    assert 0 < summary["stage_ms"]["track"] < summary["ms_per_frame"]
    asked = {"schedule.submap_by": "interval", "schedule.submap_interval": 8}
    assert from_toml(run.config_toml) == with_settings(SlamConfig(), asked)


def test_eval_then_export(run: RunDirectory, capsys: pytest.CaptureFixture[str]):
    assert main(["eval", str(run.path)]) == 0
    table = capsys.readouterr().out
    report = json.loads((run.path / "report.json").read_text())
    for name in ("ate_rmse", "psnr", "ssim", "depth_l1", "frames", "ms_per_frame", "peak_rss_mb"):
        assert {"value", "unit"} <= report[name].keys() and name in table
    assert report["frames"]["value"] == FRAMES
    assert report["ate_rmse"]["value"] < 1.0 and report["ate_rmse"]["unit"] == "cm"
    assert report["psnr"]["value"] > 20 and report["psnr_withheld"]["value"] > 20
    assert report["coverage_withheld"]["value"] > 90
    for name in ("contact_sheet.png", "trajectory.png"):
        picture = cv2.imread(str(run.path / name))
        assert picture is not None and picture.std() > 10

    assert main(["export", str(run.path)]) == 0
    assert "merged now" in capsys.readouterr().out
    gaussians, confidence = read_gaussians(run.path / "map.ply")
    assert len(gaussians) == report["gaussians_map"]["value"] < 0.7 * run.summary()["gaussians"]
    assert confidence is not None and 0 < confidence.min() < confidence.max() <= 1
    submap = run.load_submap(2)
    world = submap.gaussians.means @ submap.T_world_map[:3, :3].T.float() + submap.T_world_map[:3, 3].float()
    apart, row = torch.cdist(gaussians.means[-1:], world).min(dim=1)
    assert apart.item() < 1e-5
    torch.testing.assert_close(confidence[-1:], submap.confidence.value[row])


def test_refine_then_eval_and_export(run: RunDirectory, capsys: pytest.CaptureFixture[str]):
    def map_row(name: str) -> float:
        assert main(["eval", str(run.path)]) == 0
        return json.loads((run.path / "report.json").read_text())[name]["value"]

    submaps = [(run.path / "submaps" / f"{index:04d}.npz").read_bytes() for index in range(3)]
    before = map_row("psnr_map_withheld")
    capsys.readouterr()
    assert main(["refine", str(run.path), "--steps", "20"]) == 0
    said = capsys.readouterr()
    merged, refined = said.out.splitlines()
    assert merged.startswith("3 submaps merged: ") and said.err == ""
    assert refined.endswith(f" Gaussians refined by 120 steps over 6 keyframes: {run.path / 'map.npz'}")
    assert submaps == [(run.path / "submaps" / f"{index:04d}.npz").read_bytes() for index in range(3)]
    assert map_row("psnr_map_withheld") > before + 0.3
    first = (run.path / "map.npz").read_bytes()

    capsys.readouterr()
    assert main(["export", str(run.path), "--ply"]) == 0
    assert "refined by 120 steps" in capsys.readouterr().out
    whole = run.load_map()
    assert whole is not None
    assert torch.equal(read_gaussians(run.path / "map.ply")[0].means, whole.submap.gaussians.means)

    assert main(["refine", str(run.path), "--steps", "20"]) == 0
    assert (run.path / "map.npz").read_bytes() == first


def test_ctrl_c_keeps_what_is_refined_so_far(run: RunDirectory):
    process = subprocess.Popen(
        line("refine", run.path, "--seconds", str(PATIENCE)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline().startswith("3 submaps merged")
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    said, complaints = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert complaints == "tcgsplat: stopping; Ctrl-C again to leave the run as it was\n"
    assert said.endswith(f"{run.path / 'map.npz'}\n")
    whole = run.load_map()
    assert whole is not None and whole.steps > 0


def test_export_writes_only_what_was_asked_for(run: RunDirectory, tmp_path: Path):
    assert main(["export", str(run.path), "--trajectory", "--out", str(tmp_path / "path")]) == 0
    assert [path.name for path in (tmp_path / "path").iterdir()] == ["trajectory.txt"]
    assert (tmp_path / "path" / "trajectory.txt").read_bytes() == (run.path / "trajectory.txt").read_bytes()
    assert main(["export", str(run.path), "--ply", "--out", str(tmp_path / "map")]) == 0
    assert [path.name for path in (tmp_path / "map").iterdir()] == ["map.ply"]


def test_eval_scores_the_trajectory_of_any_system(run: RunDirectory, room_folder: Path, tmp_path: Path, capsys):
    stamps, poses = parse_tum((room_folder / "groundtruth.txt").read_text())
    elsewhere = se3.exp(torch.tensor([3.0, 1.0, -2.0, 0.4, -0.9, 0.2], dtype=torch.float64))
    (tmp_path / "other.txt").write_text(format_tum(stamps, [elsewhere @ T for T in poses]))
    assert main(["eval", str(run.path), "--trajectory", str(tmp_path / "other.txt")]) == 0
    report = json.loads((run.path / "report_other.json").read_text())
    assert report["ate_rmse"]["value"] < 1e-6 and report["frames"]["value"] == FRAMES
    assert not (run.path / "report.json").exists()
    assert main(["eval", "--sequence", str(room_folder), "--trajectory", str(tmp_path / "other.txt")]) == 0
    assert "ate_rmse" in capsys.readouterr().out


def test_eval_knows_which_part_of_the_data_was_used(room_folder: Path, tmp_path: Path):
    part = ["--start", "3", "--stride", "2", "--limit", "8"]
    assert main(["run", str(room_folder), *part, "--out", str(tmp_path / "part")]) == 0
    assert main(["eval", str(tmp_path / "part")]) == 0
    report = json.loads((tmp_path / "part" / "report.json").read_text())
    assert report["frames"]["value"] == 8
    assert report["ate_rmse"]["value"] < 1.0  # against the wrong frames it would be 5 cm


def test_eval_refuses_data_that_the_run_was_not_made_of(
    run: RunDirectory, room_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    other = Path(shutil.copytree(room_folder, tmp_path / "other"))
    assert main(["eval", str(run.path), "--sequence", str(other)]) == 0  # a copy is as good
    text = (other / "camera.toml").read_text()
    (other / "camera.toml").write_text(text.replace(f"fx = {CAMERA.fx}", "fx = 99.0"))
    capsys.readouterr()
    report = (run.path / "report.json").read_bytes()
    assert main(["eval", str(run.path), "--sequence", str(other)]) == 1
    said = capsys.readouterr()
    assert said.out == "" and f"tcgsplat: other is not what {run.path} was made of: frame 0 is " in said.err
    assert "fx 99, " in said.err and (run.path / "report.json").read_bytes() == report


def test_a_full_disk_ends_a_run_with_what_is_saved_and_what_to_do(room_folder: Path, tmp_path: Path):
    """A limit on the size of a file, here: writing fails as on a full disk."""
    limited = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (50_000, 50_000))
    arguments = line("run", room_folder, *SHORT_SUBMAPS, "--out", tmp_path / "run")
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=PATIENCE, preexec_fn=limited)
    assert done.returncode == 1
    (said,) = done.stderr.splitlines()
    file = tmp_path / "run" / "submaps" / "0000.npz"
    assert said.startswith(f"tcgsplat: {file}: File too large; the run has stopped, 0 submaps sealed before are saved")
    assert said.endswith("; mend it and go on by --resume")


def test_eval_without_the_data_says_so_and_goes_on(run: RunDirectory, capsys: pytest.CaptureFixture[str]):
    about = json.loads((run.path / "run.json").read_text())
    (run.path / "run.json").write_text(json.dumps(about | {"sequence": "/gone/away"}))
    assert main(["eval", str(run.path)]) == 0
    assert "warning: /gone/away, the data of the run, is not there" in capsys.readouterr().err
    report = json.loads((run.path / "report.json").read_text())
    assert "ate_rmse" not in report and "psnr_withheld" not in report and report["psnr"]["value"] > 20


def test_the_same_command_twice_gives_the_same_bytes(
    finished: subprocess.CompletedProcess[str], room_folder: Path, tmp_path: Path
):
    first = Path(finished.args[-1])
    assert tcgsplat("run", room_folder, "--config", first / "config.toml", "--out", tmp_path / "again").returncode == 0
    assert (tmp_path / "again" / "trajectory.txt").read_bytes() == (first / "trajectory.txt").read_bytes()
    for index in range(3):
        a, b = (RunDirectory.open(path).load_submap(index) for path in (first, tmp_path / "again"))
        assert torch.equal(a.gaussians.means, b.gaussians.means)
        assert torch.equal(a.confidence.value, b.confidence.value)


@pytest.mark.parametrize("poison", ["garbage", "folder", "absent"])
def test_the_ground_truth_plays_no_part_in_a_run(
    finished: subprocess.CompletedProcess[str], room_folder: Path, tmp_path: Path, poison: str, capsys
):
    data = Path(shutil.copytree(room_folder, tmp_path / "room"))
    (data / "groundtruth.txt").unlink()
    if poison == "garbage":
        (data / "groundtruth.txt").write_bytes(b"\xff\x00 not a pose\n")
    elif poison == "folder":
        (data / "groundtruth.txt").mkdir()
    assert main(["run", str(data), *SHORT_SUBMAPS, "--out", str(tmp_path / "run")]) == 0
    unpoisoned = Path(finished.args[-1]) / "trajectory.txt"
    assert (tmp_path / "run" / "trajectory.txt").read_bytes() == unpoisoned.read_bytes()
    capsys.readouterr()
    assert main(["eval", str(tmp_path / "run")]) == (0 if poison == "absent" else 1)
    said = capsys.readouterr()
    assert "no ground truth" in said.out if poison == "absent" else "groundtruth.txt" in said.err


def test_a_run_in_real_time_tells_what_it_dropped(room_folder: Path, tmp_path: Path):
    out = tmp_path / "live"
    work = ["--tracker.solver", "descent", "--tracker.descent.iterations", "60"]  # more than a camera leaves time for
    done = tcgsplat("run", room_folder, *work, "--realtime", "--out", out)
    assert done.returncode == 0, done.stderr
    summary = RunDirectory.open(out).summary()
    trajectory, _ = RunDirectory.open(out).trajectory()
    used = [row.frame_index for row in trajectory.rows]
    assert summary["realtime"] is True
    assert used == sorted(set(used)) and used[0] == 0 and used[-1] == FRAMES - 1
    assert len(used) == summary["frames"] == FRAMES - summary["frames_dropped"] < FRAMES
    assert summary["frames_total"] == FRAMES
    assert 0 < summary["ms_late_median"] <= summary["ms_late_p95"]
    assert summary["seconds"] > (FRAMES - 1) / 30
    assert f"; {FRAMES - len(used)} of {FRAMES} frames dropped (" in done.stdout
    assert main(["eval", str(out)]) == 0

    (out / "summary.json").unlink()  # as if it had been killed
    before = files(out)
    again = tcgsplat("run", room_folder, "--out", out)
    assert again.returncode == 1 and "--resume" not in again.stderr and "--overwrite" in again.stderr
    resumed = tcgsplat("run", room_folder, *work, "--out", out, "--resume")
    assert resumed.returncode == 1
    assert resumed.stderr == (
        f"tcgsplat: the run in {out} was made in real time: nothing resumes it; replace it by --overwrite\n"
    )
    assert files(out) == before


def test_waiting_for_the_camera_can_be_stopped_and_is_not_work(room_folder: Path, tmp_path: Path):
    data = Path(shutil.copytree(room_folder, tmp_path / "room"))
    for name in ("rgb", "depth"):
        rows = (data / f"{name}.txt").read_text().splitlines()[:6]
        later = [f"{float(row.split()[0]) + 1000.0:.6f} {row.split()[1]}" for row in rows[3:]]
        (data / f"{name}.txt").write_text("\n".join(rows[:3] + later) + "\n")
    out = tmp_path / "stopped"
    arguments = line("run", data, "--realtime", "--out", out)
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    waiting = process.stderr.readline()
    assert "warning: frame 3 comes " in waiting and waiting.endswith(" s after the one before: waiting\n")
    process.send_signal(signal.SIGINT)
    _, complaints = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert "tcgsplat: stopped; saved " in complaints
    summary = RunDirectory.open(out).summary()
    assert (summary["interrupted"], summary["frames_total"]) == (True, 3)
    assert RunDirectory.open(out).submap_count == 1


def started(room: Path, out: Path) -> subprocess.Popen[str]:
    """A run that has sealed a submap, has written the path so far, and is still going."""
    arguments = ("run", room, *SHORT_SUBMAPS, *SLOW, "--out", out)
    process = subprocess.Popen(line(*arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + PATIENCE
    while not (out / "trajectory.txt").exists():
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.005)
    assert process.poll() is None
    return process


def test_a_killed_run_loses_no_sealed_submap(room_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "killed"
    process = started(room_folder, out)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    run = RunDirectory.open(out)
    assert run.summary() == {}
    assert 1 <= run.submap_count < 3
    for index in range(run.submap_count):
        assert len(run.load_submap(index)) > 100
    assert main(["eval", str(out)]) == 0
    evaluated = json.loads((out / "report.json").read_text())["evaluated"]
    assert "ms_per_frame" in evaluated["missing"]
    part = f"only the first {len(run.trajectory()[0])} of {FRAMES} frames, since the run was killed"
    assert evaluated["part"].startswith(part)
    said = capsys.readouterr()
    assert said.err.startswith(f"tcgsplat: warning: {out} holds {part}") and "--resume" in said.err


def test_ctrl_c_saves_what_there_is(room_folder: Path, tmp_path: Path):
    out = tmp_path / "stopped"
    process = started(room_folder, out)
    process.send_signal(signal.SIGINT)
    said, complaints = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130 and said == ""
    announced, told = complaints.splitlines()
    assert announced == "tcgsplat: stopping after this frame; Ctrl-C again to stop at once"
    assert told.startswith("tcgsplat: stopped; saved ") and told.endswith(str(out))
    run = RunDirectory.open(out)
    trajectory, _ = run.trajectory()
    assert run.summary()["interrupted"] is True
    assert 8 <= len(trajectory) < FRAMES
    assert {row.submap_index for row in trajectory.rows} == set(range(run.submap_count))
    assert main(["eval", str(out)]) == 0


# Going on with an interrupted run.


def cut_off(run: RunDirectory) -> RunDirectory:
    """The run as if it had been killed just before its end: the last submap is to be made again."""
    (run.path / "summary.json").unlink()
    (run.path / "submaps" / "0002.npz").unlink()
    return run


def resumed(room: Path, out: Path, *more: str) -> int:
    return main(["run", str(room), *SHORT_SUBMAPS, "--out", str(out), "--resume", *more])


def files(out: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}


def assert_same_run(ours: Path, theirs: Path) -> None:
    """To the bit; but for pictures' compression and the like, the archives' bytes are those of their arrays."""
    assert (ours / "trajectory.txt").read_bytes() == (theirs / "trajectory.txt").read_bytes()
    names = [f"submaps/{path.name}" for path in sorted((theirs / "submaps").iterdir())]
    assert names == [f"submaps/{path.name}" for path in sorted((ours / "submaps").iterdir())]
    for name in (*names, "trajectory.npz", "checkpoint.npz"):
        with np.load(ours / name, allow_pickle=False) as a, np.load(theirs / name, allow_pickle=False) as b:
            assert a.files == b.files
            assert all(a[entry].tobytes() == b[entry].tobytes() for entry in a.files), name


def test_a_killed_run_is_resumed_as_if_nothing_had_happened(
    finished: subprocess.CompletedProcess[str],
    run: RunDirectory,
    room_folder: Path,
    capsys: pytest.CaptureFixture[str],
):
    assert resumed(room_folder, cut_off(run).path) == 0
    said = capsys.readouterr()
    assert said.err == "" and said.out.startswith(f"{FRAMES} frames, ") and " of them now, in " in said.out
    assert_same_run(run.path, Path(finished.args[-1]))
    summary = run.summary()
    assert (summary["resumed_at"], summary["frames"], summary["submaps"]) == (16, FRAMES, 3)
    assert summary["interrupted"] is False and summary["gaussians"] == run.gaussians
    assert RunDirectory.open(Path(finished.args[-1])).summary()["resumed_at"] is None


@pytest.mark.parametrize("begun", [False, True])
def test_without_a_sealed_submap_a_run_begins_anew(
    begun: bool, finished: subprocess.CompletedProcess[str], room_folder: Path, tmp_path: Path
):
    out, whole = tmp_path / "run", Path(finished.args[-1])
    if begun:
        begin(out, from_toml(RunDirectory.open(whole).config_toml), room_folder, Part(), overwrite=False)
    assert resumed(room_folder, out) == 0
    assert RunDirectory.open(out).summary()["resumed_at"] is None
    assert_same_run(out, whole)


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (["--start", "1"], "--start 0, --stride 1, no --limit; resume it with the same"),
        (["--stride", "2"], "--start 0, --stride 1, no --limit; resume it with the same"),
        (["--limit", "20"], "--start 0, --stride 1, no --limit; resume it with the same"),
        (
            ["--mapper.iterations", "7", "--seed", "9"],
            "has other settings: mapper.iterations was 10 and is 7; seed was 0 and is 9; resume it with the same ones",
        ),
        (["--preset", "paper-tum"], "has other settings: "),
        (["--backend", "reference"], "was drawn by numba, and reference has other bits; add --backend numba"),
    ],
)
def test_another_run_is_not_resumed(
    more: list[str], sentence: str, run: RunDirectory, room_folder: Path, capsys: pytest.CaptureFixture[str]
):
    before = files(cut_off(run).path)
    assert resumed(room_folder, run.path, *more) == 1
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1
    assert said.err.startswith(f"tcgsplat: the run in {run.path} ") and sentence in said.err
    assert files(run.path) == before


def test_a_run_of_another_folder_is_not_resumed(
    run: RunDirectory, room_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    other = Path(shutil.copytree(room_folder, tmp_path / "other"))
    assert resumed(other, cut_off(run).path) == 1
    assert f"the run in {run.path} is of {room_folder}, --start 0" in capsys.readouterr().err


def test_the_same_folder_may_be_named_otherwise(run: RunDirectory, room_folder: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(room_folder / "rgb")
    assert resumed(Path(".."), cut_off(run).path) == 0


def test_what_has_ended_or_is_damaged_is_not_resumed(
    run: RunDirectory, room_folder: Path, capsys: pytest.CaptureFixture[str]
):
    before = files(run.path)
    assert resumed(room_folder, run.path) == 1
    said = capsys.readouterr().err
    assert said == (
        f"tcgsplat: the run in {run.path} has ended, and there is nothing to resume; use --overwrite to repeat it\n"
    )
    assert files(run.path) == before

    cut_off(run)
    whole = (run.path / "checkpoint.npz").read_bytes()
    (run.path / "checkpoint.npz").write_bytes(whole[: len(whole) // 2])
    assert resumed(room_folder, run.path) == 1
    assert f"{run.path / 'checkpoint.npz'} is not a complete archive" in capsys.readouterr().err
    (run.path / "checkpoint.npz").write_bytes(whole)
    (run.path / "submaps" / "0000.npz").unlink()
    assert resumed(room_folder, run.path) == 1
    assert f"{run.path} has lost submap 0 of 2; run again with --overwrite\n" in capsys.readouterr().err


@pytest.mark.parametrize("flag", ["--overwrite", "--realtime"])
def test_resume_goes_with_neither_a_new_run_nor_real_time(
    flag: str, run: RunDirectory, room_folder: Path, capsys: pytest.CaptureFixture[str]
):
    before = files(cut_off(run).path)
    assert resumed(room_folder, run.path, flag) == 2
    assert "tcgsplat: --resume goes with neither --overwrite nor --realtime" in capsys.readouterr().err
    assert files(run.path) == before


@pytest.mark.parametrize("at", [3, 12, 20])  # in the first submap, between, and in the last one
def test_ctrl_c_and_on_again(
    at: int, finished: subprocess.CompletedProcess[str], room_folder: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
):  # fmt: skip
    out, observe = tmp_path / "stopped", RunProgress.observe

    def interrupting(progress: RunProgress, report: StepReport, dropped: int = 0) -> None:
        observe(progress, report, dropped)
        if report.frame_index == at:
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patched:
        patched.setattr(RunProgress, "observe", interrupting)
        assert main(["run", str(room_folder), *SHORT_SUBMAPS, "--out", str(out)]) == 130
    run, sealed = RunDirectory.open(out), at // 8
    assert (run.summary()["interrupted"], run.summary()["frames"]) == (True, at + 1)
    assert run.submap_count == sealed + 1
    assert main(["eval", str(out)]) == 0
    capsys.readouterr()
    assert resumed(room_folder, out) == 0
    assert capsys.readouterr().out.startswith(
        f"{FRAMES} frames, {FRAMES - 8 * sealed} of them now, " if sealed else "24 "
    )
    assert_same_run(out, Path(finished.args[-1]))
    assert (run.summary()["interrupted"], run.summary()["resumed_at"]) == (False, 8 * sealed or None)


def test_broken_frames_are_skipped_and_told(room_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    data = Path(shutil.copytree(room_folder, tmp_path / "room"))
    broken = ["0005", "0008"]  # in the middle, and the last one
    for name in broken:
        (data / "rgb" / f"{name}.png").write_bytes(b"no picture")
    assert main(["run", str(data), "--limit", "9", "--out", str(tmp_path / "run")]) == 0
    said = capsys.readouterr()
    for name, warning in zip(broken, said.err.splitlines(), strict=True):
        assert warning.startswith("tcgsplat: warning: a frame is skipped: ") and f"{name}.png" in warning
    assert said.out.startswith("7 frames in ") and " Gaussians; 2 more could not be read: " in said.out
    assert RunDirectory.open(tmp_path / "run").summary()["frames_unreadable"] == 2


def test_a_run_goes_to_runs_and_is_not_overwritten_by_accident(
    room_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    assert main(["run", str(room_folder), "--limit", "2"]) == 0
    assert RunDirectory.open(tmp_path / "runs" / "room").submap_count == 1
    assert main(["run", str(room_folder), "--limit", "3"]) == 1
    assert "runs/room exists; choose another folder by --out, or replace the run" in capsys.readouterr().err
    assert main(["run", str(room_folder), "--limit", "3", "--overwrite"]) == 0
    assert len(RunDirectory.open(tmp_path / "runs" / "room").trajectory()[0]) == 3


def test_synth_writes_a_sequence(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "apartment"
    small = ["--frames", "3", "--width", "64", "--height", "48", "--free-views", "2"]
    assert main(["synth", str(out), *small, "--depth-noise"]) == 0
    assert capsys.readouterr().out == f"3 frames, 64x48: {out}\n"
    sequence = open_sequence(out)
    assert len(list(sequence)) == len(sequence.ground_truth()) == 3
    assert main(["synth", str(out)]) == 1
    assert "exists and is not an empty folder" in capsys.readouterr().err


def test_demo_makes_everything_that_it_shows(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    small = ["demo", "--out", str(tmp_path / "demo"), "--frames", "4", "--width", "64"]
    assert main(small) == 0
    text = capsys.readouterr().out
    shown = [Path(word) for word in text.split() if word.startswith(str(tmp_path))]
    assert [path.name for path in shown] == ["contact_sheet.png", "trajectory.png", "map.ply", "report.json"]
    assert all(path.stat().st_size > 100 for path in shown)
    report = json.loads(shown[-1].read_text())
    assert all(str(Metric(**row)) in text for name, row in report.items() if name != "evaluated")
    assert all(f"\n{name} " in text for name in ("ate_rmse", "psnr", "coverage", "submaps", "gaussians_map"))

    assert main(small) == 1
    assert "exists; choose another folder by --out, or make it anew by --overwrite" in capsys.readouterr().err
    (tmp_path / "demo" / "letter.txt").write_text("dear")
    assert main([*small, "--overwrite"]) == 1
    assert "holds more than a demo" in capsys.readouterr().err
    assert (tmp_path / "demo" / "sequence" / "rgb.txt").is_file()
    (tmp_path / "demo" / "letter.txt").unlink()
    demo.make_way(tmp_path / "demo", overwrite=True)
    assert list((tmp_path / "demo").iterdir()) == []


@pytest.mark.parametrize("arguments", [("presets",), ("presets", "default")])  # less and more than a buffer
def test_a_reader_may_have_seen_enough(arguments: tuple[str, ...]):
    reading, writing = os.pipe()
    os.close(reading)
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    done = subprocess.run(line(*arguments), stdout=writing, stderr=subprocess.PIPE, text=True, env=buffered)
    os.close(writing)
    assert (done.returncode, done.stderr) == (0, "")
