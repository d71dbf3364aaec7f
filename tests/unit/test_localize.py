"""`tcgsplat localize`: pictures are found where they were taken, or not at all; and whoever gives others is told."""

import importlib.util
import json
import math
import re
import shutil
import signal
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from analytic_room import errors, pose
from patterned_room import CAMERA, PatternedRoom

from tcgsplat.cli.main import main
from tcgsplat.cli.pictures import frames_of
from tcgsplat.config import SlamConfig, to_toml
from tcgsplat.datasets.synthetic.raster import View
from tcgsplat.datasets.synthetic.writer import sequence_files
from tcgsplat.errors import DatasetError
from tcgsplat.geometry import se3
from tcgsplat.loop.relocalization import Relocalizer
from tcgsplat.scene.trajectory import parse_tum
from tcgsplat.storage.run_directory import RunDirectory
from tcgsplat.tensors import Pose

FRAMES = 16
QUICK = ["--schedule.submap_by", "interval", "--schedule.submap-interval", "4", "--mapper.iterations", "20"]
SQUARE_PIXELS = replace(CAMERA, fy=CAMERA.fx)


def path() -> list[Pose]:
    """Around a corner of the room, some 3 cm and 2 degrees a frame; the first camera is not where the world begins."""
    poses = [pose(0.1, -0.05, 0.2, degrees=(3.0, -7.0, 2.0))]
    for _ in range(FRAMES - 1):
        poses.append(poses[-1] @ pose(0.02, 0.005, 0.012, degrees=(0.3, -2.0, 0.4)))
    return poses


def recorded(root: Path, room: PatternedRoom, poses: list[Pose]) -> Path:
    """Pictures of a room in TUM layout."""
    root.mkdir()
    camera, seconds = SQUARE_PIXELS, np.arange(len(poses)) / 30
    files = sequence_files(root, "tum", seconds, extras=())
    for index, T_world_cam in enumerate(poses):
        frame = room.frame(T_world_cam, index, camera)
        color = (255 * frame.color.clamp(0, 1)).round().byte().numpy()
        files.write_frame(index, color, frame.depth.double().numpy(), None)
    view = View(camera.width, camera.height, camera.fx, camera.cx, camera.cy)
    files.write_index(view, seconds, torch.stack(poses).numpy(), np.ones(len(poses), dtype=bool))
    return root


@dataclass(frozen=True)
class World:
    room: Path
    """A recorded sequence."""
    run: Path
    """Over every other frame of it, in two submaps."""

    def color(self, index: int) -> Path:
        return sorted((self.room / "rgb").iterdir())[index]

    def truth(self, index: int) -> Pose:
        """In the run's world, which begins at its first camera; the run has no error to speak of in so small a room."""
        return se3.inverse(path()[0]) @ path()[index]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    folder = tmp_path_factory.mktemp("localize")
    found = World(recorded(folder / "room", PatternedRoom(), path()), folder / "run")
    assert main(["run", str(found.room), "--stride", "2", "--out", str(found.run), *QUICK]) == 0
    assert RunDirectory.open(found.run).submap_count == 2
    return found


def localized(world: World, *arguments: str | Path, out: Path) -> dict[float, Pose]:
    """Poses by time stamp, as the file has them."""
    assert main(["localize", str(world.run), *map(str, arguments), "--out", str(out), "--overwrite"]) == 0
    stamps, poses = parse_tum(out.read_text())
    return dict(zip(stamps, poses, strict=True))


def assert_near(T: Pose, truth: Pose) -> None:
    millimeters, degrees = errors(T, truth)
    assert millimeters < 20 and degrees < 1


# Found.


def test_frames_between_those_that_were_mapped_are_found(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "poses.txt"
    found = localized(world, world.room, "--start", "1", "--stride", "2", out=out)
    odd = range(1, FRAMES, 2)
    assert list(found) == pytest.approx([index / 30 for index in odd], abs=1e-5)
    for index, T in zip(odd, found.values(), strict=True):
        assert_near(T, world.truth(index))
    said = capsys.readouterr()
    *lines, total = said.out.splitlines()
    assert said.err == "" and total == f"8 of 8 pictures found: {out}"
    x, y, z = next(iter(found.values()))[:3, 3].tolist()
    assert re.fullmatch(rf"frame 1: {x:.3f} {y:.3f} {z:.3f} m, in submap [01]", lines[0])
    assert [line.split(":")[0] for line in lines] == [f"frame {index}" for index in odd]


def test_bare_pictures_are_found_in_the_order_in_which_they_are_given(world: World, tmp_path: Path):
    files = [world.color(13), world.color(3), world.color(11)]
    found = localized(world, *files, out=tmp_path / "poses.txt")
    assert list(found) == [0.0, 1.0, 2.0]
    for T, index in zip(found.values(), (13, 3, 11), strict=True):
        assert_near(T, world.truth(index))


def test_a_folder_of_pictures_is_taken_as_people_count(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "pictures").mkdir()
    for index in (3, 7, 11, 15):
        shutil.copy(world.color(index), tmp_path / "pictures" / f"holiday {index}.png")
    (tmp_path / "pictures" / "letter.txt").write_text("dear")
    part = ["--start", "1", "--stride", "2", "--limit", "2"]
    found = localized(world, tmp_path / "pictures", *part, out=tmp_path / "poses.txt")
    assert list(found) == [0.0, 1.0]
    for T, index in zip(found.values(), (7, 15), strict=True):
        assert_near(T, world.truth(index))
    assert re.findall(r"holiday (\d+)\.png: ", capsys.readouterr().out) == ["7", "15"]


def test_poses_go_to_the_run_directory_unless_told_otherwise(world: World, tmp_path: Path):
    run = Path(shutil.copytree(world.run, tmp_path / "run"))
    before = {file: file.read_bytes() for file in run.rglob("*") if file.is_file()}
    assert main(["localize", str(run), str(world.color(5))]) == 0
    (stamp,), (T,) = parse_tum((run / "localized.txt").read_text())
    assert stamp == 0.0
    assert_near(T, world.truth(5))
    assert before == {file: file.read_bytes() for file in before}


def test_poses_are_replaced_only_when_asked_to(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run = Path(shutil.copytree(world.run, tmp_path / "run"))
    poses = run / "localized.txt"
    poses.write_text("of another day")
    assert main(["localize", str(run), str(world.color(5))]) == 2
    told = f"tcgsplat: {poses} exists; choose another file by --out, or replace it by --overwrite\n"
    assert capsys.readouterr().err == told
    assert poses.read_text() == "of another day"
    assert main(["localize", str(run), str(world.color(5)), "--overwrite"]) == 0
    assert len(parse_tum(poses.read_text())[0]) == 1


def test_a_picture_beside_a_sequence_does_not_hide_it(world: World, tmp_path: Path):
    room = Path(shutil.copytree(world.room, tmp_path / "room"))
    assert cv2.imwrite(str(room / "preview.png"), np.zeros((8, 8, 3), np.uint8))
    assert list(localized(world, room, "--limit", "1", out=tmp_path / "poses.txt")) == [0.0]


# Not found.


def test_another_place_and_the_dark_are_not_found(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    elsewhere = recorded(tmp_path / "elsewhere", PatternedRoom(seed=1), path()[:2])
    dark, noise = tmp_path / "dark.png", tmp_path / "noise.png"
    assert cv2.imwrite(str(dark), np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8))
    snow = np.random.default_rng(0).integers(0, 256, (CAMERA.height, CAMERA.width, 3), np.uint8)
    assert cv2.imwrite(str(noise), snow)
    strange = sorted((elsewhere / "rgb").iterdir())[0]
    pictures = [dark, world.color(9), strange, noise]
    found = localized(world, *pictures, out=tmp_path / "poses.txt")
    assert list(found) == [1.0]
    assert_near(found[1.0], world.truth(9))
    *lines, total = capsys.readouterr().out.splitlines()
    assert [line for line in lines if line.endswith(": not found")] == [
        f"{dark}: not found", f"{strange}: not found", f"{noise}: not found",
    ]  # fmt: skip
    assert total.startswith("1 of 4 pictures found: ")
    assert localized(world, elsewhere, out=tmp_path / "poses.txt") == {}
    assert (tmp_path / "poses.txt").read_text().startswith("# timestamp")


# What is wrong is said at once.


@pytest.mark.parametrize(
    ("images", "code", "sentence"),
    [
        ([], 2, "tcgsplat: give IMAGES too: a sequence's folder, a folder of pictures, or pictures\n"),
        (["empty"], 1, "empty has none of the known layouts: "),
        (["empty", "empty"], 1, "tcgsplat: no pictures in empty empty; give .bmp, "),
        (["nowhere"], 1, "tcgsplat: nowhere cannot be opened (No such file or directory)\n"),
        (["large.png"], 1, "tcgsplat: large.png is 640x480 and the run's pictures are 320x240; give pictures of the"),
        (["broken.png"], 1, "tcgsplat: broken.png is broken or cut off, 9 bytes; copy it again from its source\n"),
        (["letter.txt"], 1, "tcgsplat: letter.txt is no picture that can be read; give .bmp, "),
        (["good.png", "large.png"], 1, "large.png is 640x480"),
        (["good.png", "--start", "1"], 1, "there are 1 pictures, counted from 0, and --start is 1; begin earlier\n"),
        (["good.png", "--stride", "0"], 1, "--start 0, --stride 0, --limit None make no sense"),
        (["good.png", "--out", "nowhere/poses.txt"], 2, "--out nowhere/poses.txt cannot be written: give the name of"),
        (["good.png", "--out", "empty"], 2, "--out empty cannot be written: give the name of a file"),
    ],
)
def test_what_is_wrong_with_pictures_is_said_before_they_are_looked_up(
    images: list[str], code: int, sentence: str, world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    Path("broken.png").write_bytes(b"\x89PNG\r\n\x1a\n0")
    Path("letter.txt").write_text("dear")
    assert cv2.imwrite("large.png", np.zeros((480, 640, 3), np.uint8))
    shutil.copy(world.color(1), "good.png")
    monkeypatch.setattr(Relocalizer, "relocalized", None)
    assert main(["localize", str(world.run), *images]) == code
    said = capsys.readouterr()
    assert said.out == "" and sentence in said.err and "Traceback" not in said.err
    if said.err.startswith("tcgsplat: "):
        assert said.err.count("\n") == 1


def test_what_is_broken_in_a_folder_is_skipped(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for name in ("0.png", "2.png"):
        shutil.copy(world.color(1), pictures / name)
    (pictures / "1.png").write_bytes(b"\x89PNG\r\n\x1a\n0")
    assert main(["localize", str(world.run), str(pictures), "--out", str(tmp_path / "poses.txt")]) == 0
    said = capsys.readouterr()
    assert said.err.startswith(f"tcgsplat: warning: a picture is skipped: {pictures / '1.png'} is broken or cut off")
    assert [float(row.split()[0]) for row in (tmp_path / "poses.txt").read_text().splitlines()[1:]] == [0.0, 2.0]


def test_a_folder_that_is_no_run_and_a_run_without_submaps_are_told(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["localize", str(tmp_path), str(world.color(1))]) == 1
    assert "is not a run; give the folder that `tcgsplat run` wrote" in capsys.readouterr().err
    RunDirectory.create(tmp_path / "young", config_toml=to_toml(SlamConfig()), sequence=str(world.room))
    for images in (world.room, world.color(1)):
        assert main(["localize", str(tmp_path / "young"), str(images)]) == 1
        said = capsys.readouterr().err
        assert said.startswith(f"tcgsplat: {tmp_path / 'young'} has no finished submap to find anything in; let the")


def test_ctrl_c_saves_what_is_found(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    look_up = Relocalizer.relocalized

    def interrupted(self: Relocalizer, *picture: Any) -> object:
        signal.raise_signal(signal.SIGINT)
        return look_up(self, *picture)

    monkeypatch.setattr(Relocalizer, "relocalized", interrupted)
    assert main(["localize", str(world.run), str(world.room), "--out", str(tmp_path / "poses.txt")]) == 130
    said = capsys.readouterr()
    assert said.out.endswith(f"1 of 1 pictures found: {tmp_path / 'poses.txt'}\n")
    assert "tcgsplat: stopping after this frame; " in said.err
    assert len(parse_tum((tmp_path / "poses.txt").read_text())[0]) == 1


# Frames of bare pictures.


def test_a_bare_picture_is_a_frame_of_the_runs_camera(world: World):
    run = RunDirectory.open(world.run)
    ((name, frame),) = frames_of(run, [world.color(4)], 0, 1, None)
    assert name == str(world.color(4))
    assert (frame.index, frame.timestamp, frame.has_depth) == (0, 0.0, False)
    known = run.load_submap(0).keyframes[0].frame
    assert frame.camera == known.camera and frame.valid.all()
    color = PatternedRoom().frame(path()[4], 4, SQUARE_PIXELS).color
    assert (frame.color - color).abs().max() < 0.51 / 255


def test_a_wrong_picture_is_told_before_any_frame_is_given(world: World, tmp_path: Path):
    assert cv2.imwrite(str(tmp_path / "small.png"), np.zeros((60, 80, 3), np.uint8))
    with pytest.raises(DatasetError, match=r"small\.png is 80x60 and"):
        frames_of(RunDirectory.open(world.run), [world.color(4), tmp_path / "small.png"], 0, 1, None)


# benchmarks/localization.py.


def script() -> ModuleType:
    path = Path(__file__).parents[2] / "benchmarks" / "localization.py"
    spec = importlib.util.spec_from_file_location("localization", path)
    module = sys.modules["localization"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_benchmark_counts_what_is_near_and_what_is_wrong(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    localization = script()
    shutil.copytree(world.run, tmp_path / "room")  # a run that is there is not made again
    elsewhere = recorded(tmp_path / "elsewhere", PatternedRoom(seed=1), path()[:2])
    out = tmp_path / "figures.json"
    args = localization.Args((world.room,), (elsewhere,), tmp_path, every=4, strangers_every=1, json=out)
    assert localization.main(args) == 0
    lines = json.loads(out.read_text())["lines"]
    assert [line["pictures"] for line in lines] == [
        "between, with depth", "between, bare", "elsewhere, with depth", "elsewhere, bare",
    ]  # fmt: skip
    assert [(line["looked_up"], len(line["found"]), line["near"], line["wrong"]) for line in lines] == [
        (2, 2, 100.0, 0), (2, 2, 100.0, 0), (2, 0, 0.0, 0), (2, 0, 0.0, 0),
    ]  # fmt: skip
    assert [one["frame"] for one in lines[0]["found"]] == [1, 9]
    assert all(0 < one["centimeters"] < 2 and 0 < one["degrees"] < 1 for one in lines[0]["found"])
    assert capsys.readouterr().out.splitlines()[-1].split() == ["room", "elsewhere,", "bare", "2", "0", "0.0", "-", "0"]

    found = [
        localization.Lookup(1, 0, *error) for error in ((1, 0.5), (3, 0.5), (1, 2), (6, 0), (0, 4), (math.nan,) * 2)
    ]
    line = localization.Line("map", "pictures", 10, tuple(found))
    assert line.near == 10.0
    assert line.wrong == found[3:]


def test_errors_are_in_the_frame_of_the_truth():
    localization = script()
    T_truth_world, truth, off = pose(1.0, degrees=(0, 90, 0)), pose(0, 2.0), pose(0.03, degrees=(0, 0, 2))
    seen = (4, se3.inverse(T_truth_world) @ truth @ off)
    found = localization.lookup(7, seen, T_truth_world, truth)
    assert (found.frame, found.submap) == (7, 4)
    assert (found.centimeters, found.degrees) == pytest.approx((3.0, 2.0), abs=0.01)
