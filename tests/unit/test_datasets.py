"""Every layout on small real files: what is read, what is skipped, and the sentence for each thing that is bad."""

import itertools
import json
import logging
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tcgsplat.datasets import open_sequence
from tcgsplat.datasets.association import MAX_GAP
from tcgsplat.errors import DatasetError

W, H = 32, 24
CAMERA_TOML = f"width = {W}\nheight = {H}\nfx = 30.0\nfy = 31.0\ncx = 15.5\ncy = 11.25\ndepth_scale = 1000.0\n"
DAMAGE = b"\x89PNG\r\n\x1a\n this is no image"


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def gray(i: int, width: int = W, height: int = H) -> np.ndarray:
    return np.full((height, width, 3), 10 * (i % 20 + 1), np.uint8)


def metres(depth: float, scale: float, width: int = W, height: int = H) -> np.ndarray:
    return np.full((height, width), round(depth * scale), np.uint16)


def T_world_cam(i: int) -> torch.Tensor:
    T = torch.eye(4, dtype=torch.float64)
    T[:3, 3] = torch.tensor([0.1 * i, 0.2, -0.3])
    return T


def row(i: int) -> str:
    return " ".join(repr(x) for x in T_world_cam(i).flatten().tolist())


def tum_row(stamp: float, i: int) -> str:
    x, y, z = T_world_cam(i)[:3, 3].tolist()
    return f"{stamp:.6f} {x} {y} {z} 0 0 0 1"


def write_tum(root: Path, frames: int = 4, width: int = W, height: int = H, toml: str | None = CAMERA_TOML) -> Path:
    """Depth comes 5 ms after colour; poses 2 ms before it, at every frame but the last."""
    rgb, depth, poses = ["# color images"], ["# depth maps"], ["# ground truth"]
    for i in range(frames):
        t = 100.0 + i / 30
        write_image(root / "rgb" / f"{t:.6f}.png", gray(i, width, height))
        write_image(root / "depth" / f"{t + 0.005:.6f}.png", metres(1 + 0.1 * i, 5000, width, height))
        rgb.append(f"{t:.6f} rgb/{t:.6f}.png")
        depth.append(f"{t + 0.005:.6f} depth/{t + 0.005:.6f}.png")
        poses += [tum_row(t - 0.002, i)] * (i < frames - 1)
    for name, lines in (("rgb", rgb), ("depth", depth), ("groundtruth", poses)):
        (root / f"{name}.txt").write_text("\n".join(lines) + "\n")
    if toml is not None:
        (root / "camera.toml").write_text(toml.replace("1000.0", "5000.0"))
    return root


def write_replica(root: Path, frames: int = 4) -> Path:
    for i in range(frames):
        write_image(root / "results" / f"frame{i:06d}.jpg", gray(i))
        write_image(root / "results" / f"depth{i:06d}.png", metres(1 + 0.1 * i, 6553.5))
    (root / "traj.txt").write_text("\n".join(row(i) for i in range(frames)) + "\n")
    camera = {"w": W, "h": H, "fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.25, "scale": 6553.5}
    (root / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return root


def write_scannet(root: Path, frames: int = 4) -> Path:
    for i in range(frames):
        write_image(root / "color" / f"{i}.jpg", gray(i, 2 * W, 2 * H))
        write_image(root / "depth" / f"{i}.png", metres(1 + 0.1 * i, 1000))
        (root / "pose").mkdir(exist_ok=True)
        (root / "pose" / f"{i}.txt").write_text(
            "\n".join(" ".join(map(repr, line)) for line in T_world_cam(i).tolist()) + "\n"
        )
    (root / "intrinsic").mkdir()
    K = "30.0 0 15.5 0\n0 31.0 11.25 0\n0 0 1 0\n0 0 0 1\n"
    (root / "intrinsic" / "intrinsic_depth.txt").write_text(K)
    (root / "intrinsic" / "intrinsic_color.txt").write_text(K)
    return root


def write_prepared(
    root: Path, frames: int = 4, width: int = W, height: int = H, toml: str | None = CAMERA_TOML
) -> Path:
    for i in range(frames):
        write_image(root / "rgb" / f"frame_{i:05d}.png", gray(i, width, height))
        write_image(root / "depth" / f"frame_{i:05d}.TIFF", np.full((height, width), 1 + 0.1 * i, np.float32))
    header = "timestamp tx ty tz qx qy qz qw"
    (root / "gt_pose.txt").write_text("\n".join([header, *(tum_row(i / 20, i) for i in range(frames))]) + "\n")
    if toml is not None:
        (root / "camera.toml").write_text(toml.replace("1000.0", "1.0"))
    return root


def write_folder(root: Path, frames: int = 4) -> Path:
    for i in range(frames):
        write_image(root / "color" / f"{i}.png", gray(i))
        write_image(root / "depth" / f"{i}.png", metres(1 + 0.1 * i, 1000))
    (root / "camera.toml").write_text(CAMERA_TOML)
    (root / "poses.txt").write_text("\n".join(row(i) for i in range(frames)) + "\n")
    return root


LAYOUTS: dict[str, Callable[..., Path]] = {
    "tum": write_tum,
    "replica": write_replica,
    "scannet": write_scannet,
    "prepared": write_prepared,
    "folder": write_folder,
}
POSES = {
    "tum": "groundtruth.txt",
    "replica": "traj.txt",
    "scannet": "pose/1.txt",
    "prepared": "gt_pose.txt",
    "folder": "poses.txt",
}
FIRST_TIME = {"tum": 100.0, "replica": 0.0, "scannet": 0.0, "prepared": 0.0, "folder": 0.0}
RATE = {"tum": 30, "replica": 30, "scannet": 30, "prepared": 20, "folder": 30}
every_layout = pytest.mark.parametrize("layout", LAYOUTS)


def the_files(root: Path, kind: str) -> list[Path]:
    """Colour or depth files of any of the layouts, in order."""
    names = {"color": ("color/*.*", "rgb/*.*", "results/frame*"), "depth": ("depth/*.*", "results/depth*")}[kind]
    return sorted(itertools.chain.from_iterable(root.glob(name) for name in names))


@every_layout
def test_frames_are_read(tmp_path: Path, layout: str) -> None:
    sequence = open_sequence(LAYOUTS[layout](tmp_path / "sequence"))
    assert (sequence.name, len(sequence)) == ("sequence", 4)
    assert (sequence.camera.fx, sequence.camera.fy, sequence.camera.cx, sequence.camera.cy) == (30.0, 31.0, 15.5, 11.25)
    for i, frame in enumerate(sequence):
        assert frame.index == i
        assert frame.timestamp == pytest.approx(FIRST_TIME[layout] + i / RATE[layout], abs=1e-6)
        assert frame.depth_delay == pytest.approx(0.005 if layout == "tum" else 0.0, abs=1e-6)
        assert frame.camera == sequence.camera
        assert (frame.color.dtype, frame.depth.dtype, frame.valid.dtype) == (torch.float32, torch.float32, torch.bool)
        assert frame.color.shape == (H, W, 3)
        torch.testing.assert_close(frame.color, torch.full((H, W, 3), 10 * (i + 1) / 255), atol=1.5 / 255, rtol=0)
        torch.testing.assert_close(frame.depth, torch.full((H, W), 1 + 0.1 * i), atol=1e-3, rtol=0)
        assert bool(frame.valid.all())
    assert i == 3


@every_layout
def test_random_access_gives_the_same_frame(tmp_path: Path, layout: str) -> None:
    sequence = open_sequence(LAYOUTS[layout](tmp_path))
    for frame in sequence:
        again = sequence.frame(frame.index)
        assert torch.equal(frame.color, again.color)
        assert torch.equal(frame.depth, again.depth)
        assert frame.timestamp == again.timestamp
    with pytest.raises(DatasetError, match="has no frame 4; it has 4"):
        sequence.frame(4)
    with pytest.raises(DatasetError, match="has no frame -1"):
        sequence.frame(-1)


@every_layout
def test_ground_truth_is_by_frame_index(tmp_path: Path, layout: str) -> None:
    poses = open_sequence(LAYOUTS[layout](tmp_path)).ground_truth()
    assert list(poses) == ([0, 1, 2] if layout == "tum" else [0, 1, 2, 3])
    for i, T in poses.items():
        assert T.dtype == torch.float64
        torch.testing.assert_close(T, T_world_cam(i))


@every_layout
def test_a_part_keeps_times_and_poses(tmp_path: Path, layout: str) -> None:
    part = open_sequence(LAYOUTS[layout](tmp_path, frames=9), start=1, stride=3, limit=2)
    assert len(part) == 2
    frames = list(part)
    assert [frame.index for frame in frames] == [0, 1]
    times = [FIRST_TIME[layout] + n / RATE[layout] for n in (1, 4)]
    assert [frame.timestamp for frame in frames] == pytest.approx(times, abs=1e-6)
    poses = part.ground_truth()
    torch.testing.assert_close(poses[0], T_world_cam(1))
    torch.testing.assert_close(poses[1], T_world_cam(4))


@every_layout
def test_ground_truth_is_not_touched_before_it_is_asked_for(tmp_path: Path, layout: str) -> None:
    root = LAYOUTS[layout](tmp_path)
    path = root / POSES[layout]
    path.unlink()
    path.mkdir()
    sequence = open_sequence(root)
    assert len(list(sequence)) == 4
    with pytest.raises(DatasetError, match=f"{path.name} cannot be read"):
        sequence.ground_truth()


@every_layout
def test_poses_are_optional(tmp_path: Path, layout: str) -> None:
    root = LAYOUTS[layout](tmp_path)
    (root / POSES[layout]).unlink()
    sequence = open_sequence(root)
    assert len(list(sequence)) == 4
    assert list(sequence.ground_truth()) == ([0, 2, 3] if layout == "scannet" else [])


@every_layout
@pytest.mark.parametrize("kind", ["color", "depth"])
def test_a_broken_frame_is_skipped_with_one_warning(
    tmp_path: Path, layout: str, kind: str, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    root = LAYOUTS[layout](tmp_path)
    broken = the_files(root, kind)[1]
    broken.write_bytes(DAMAGE)
    sequence = open_sequence(root)
    assert len(sequence) == 4
    assert caplog.records == []
    assert [frame.index for frame in sequence] == [0, 2, 3]
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert f"a frame is skipped: {broken} is broken" in record.message
    with pytest.raises(DatasetError, match="is broken"):
        sequence.frame(1)
    assert capfd.readouterr().err == ""


@every_layout
def test_a_pose_that_is_not_a_number_is_left_out_with_one_warning(
    tmp_path: Path, layout: str, caplog: pytest.LogCaptureFixture
) -> None:
    root = LAYOUTS[layout](tmp_path)
    path = root / POSES[layout]
    lines = path.read_text().splitlines()
    at = 1 if layout in ("replica", "folder", "scannet") else 2
    words = lines[at].split()
    lines[at] = " ".join([words[0], "nan", *words[2:]])
    path.write_text("\n".join(lines) + "\n")
    sequence = open_sequence(root)
    assert len(list(sequence)) == 4
    assert 1 not in sequence.ground_truth()
    assert 2 in sequence.ground_truth()
    (record, _, *_) = caplog.records
    assert record.message == f"the pose of frame 1 in {path} is left out: it is not a rigid transform"


@every_layout
def test_a_pose_file_with_a_malformed_line_is_an_error(tmp_path: Path, layout: str) -> None:
    root = LAYOUTS[layout](tmp_path)
    with (root / POSES[layout]).open("a") as file:
        file.write("1 2 three\n")
    sequence = open_sequence(root)
    if layout in ("replica", "folder"):  # a row that belongs to no frame does no harm
        assert len(sequence.ground_truth()) == 4
    else:
        with pytest.raises(DatasetError, match=rf"{Path(POSES[layout]).name}.* is not .*repair"):
            sequence.ground_truth()


def test_unknown_poses_of_scannet_are_left_out_silently(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    root = write_scannet(tmp_path)
    (root / "pose" / "2.txt").write_text("-inf -inf -inf -inf\n" * 4)
    assert list(open_sequence(root).ground_truth()) == [0, 1, 3]
    assert caplog.records == []


# What is bad about the whole sequence: one sentence with what, where, and what to do.


def test_no_folder(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=f"no folder {tmp_path}/nowhere"):
        open_sequence(tmp_path / "nowhere")
    (tmp_path / "file").touch()
    with pytest.raises(DatasetError, match="file is a file; give the folder around it"):
        open_sequence(tmp_path / "file")


def test_unknown_layout(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"none of the known layouts.*TUM.*Replica.*ScanNet.*it holds nothing; give"):
        open_sequence(tmp_path)
    (tmp_path / "movie.mp4").touch()
    (tmp_path / "scene").mkdir()
    with pytest.raises(DatasetError, match=r"it holds movie\.mp4, scene/; give the folder of one sequence"):
        open_sequence(str(tmp_path))
    write_folder(tmp_path / "scene")
    with pytest.raises(DatasetError, match=r"did you mean .*/scene\?"):
        open_sequence(tmp_path)


@pytest.mark.parametrize(("layout", "match"), [
    ("tum", r"no depth\.txt in .*give the folder that holds both"),
    ("replica", "no depth images .*results"),
    ("scannet", "no depth images in .*depth; extract"),
    ("folder", "no folder .*depth; .*needs color/"),
])  # fmt: skip
def test_no_depth(tmp_path: Path, layout: str, match: str) -> None:
    root = LAYOUTS[layout](tmp_path)
    for path in the_files(root, "depth"):
        path.unlink()
    if (root / "depth").is_dir():
        (root / "depth").rmdir()
    (root / "depth.txt").unlink(missing_ok=True)
    with pytest.raises(DatasetError, match=match):
        open_sequence(root)


def test_empty_sequences(tmp_path: Path) -> None:
    root = write_tum(tmp_path / "tum")
    (root / "rgb.txt").write_text("# nothing\n")
    with pytest.raises(DatasetError, match=r"rgb\.txt lists no images; the sequence is empty"):
        open_sequence(root)
    root = write_folder(tmp_path / "folder")
    for path in the_files(root, "color"):
        path.unlink()
    with pytest.raises(DatasetError, match=r"no images in .*color; the sequence is empty"):
        open_sequence(root)


@every_layout
def test_sizes_that_differ(tmp_path: Path, layout: str) -> None:
    root = LAYOUTS[layout](tmp_path)
    for path in the_files(root, "color" if layout != "scannet" else "depth"):
        write_image(path, gray(0, 16, 12) if layout != "scannet" else metres(1, 1000, 16, 12))
    if layout == "scannet":
        write_image(the_files(root, "depth")[0], metres(1, 1000, 20, 12))
        match = "depth/.* is 16x12 but its camera is 20x12"
    else:
        match = r"colour and depth differ in size: .* is 16x12, .* is 32x24; give depth that is registered"
    with pytest.raises(DatasetError, match=match):
        open_sequence(root)


@every_layout
def test_a_depth_scale_that_cannot_be_right(tmp_path: Path, layout: str) -> None:
    root = LAYOUTS[layout](tmp_path)
    (root / "camera.toml").write_text(CAMERA_TOML.replace("1000.0", "0.001"))
    with pytest.raises(DatasetError, match=r"median depth in .* is .* m with depth_scale = 0\.001 .*camera\.toml"):
        open_sequence(root)


def test_depth_images_without_any_reading(tmp_path: Path) -> None:
    root = write_folder(tmp_path)
    for path in the_files(root, "depth"):
        write_image(path, metres(0, 1000))
    with pytest.raises(DatasetError, match="hold no reading"):
        open_sequence(root)


@every_layout
def test_all_frames_broken(tmp_path: Path, layout: str) -> None:
    root = LAYOUTS[layout](tmp_path)
    for path in the_files(root, "depth"):
        path.write_bytes(DAMAGE)
    with pytest.raises(DatasetError, match=r"none of the 4 (frames|depth images) .* can be read"):
        open_sequence(root)


def test_one_good_frame_among_broken_ones_is_found(tmp_path: Path) -> None:
    root = write_folder(tmp_path, frames=40)
    for path in the_files(root, "depth"):
        if path.name != "17.png":
            path.write_bytes(DAMAGE)
    assert [frame.index for frame in open_sequence(root)] == [17]


def test_a_listed_file_that_is_not_there_is_a_broken_frame(tmp_path: Path) -> None:
    root = write_tum(tmp_path)
    the_files(root, "color")[2].unlink()
    assert [frame.index for frame in open_sequence(root)] == [0, 1, 3]


@pytest.mark.parametrize("part", [{"stride": 0}, {"limit": 0}, {"start": -1}])
def test_a_part_that_makes_no_sense(tmp_path: Path, part: dict[str, int]) -> None:
    with pytest.raises(DatasetError, match=r"select no frames of .*; start counts from 0"):
        open_sequence(write_folder(tmp_path), **part)


def test_a_start_behind_the_end(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"start = 4 is behind the end of .*, which has 4 frames"):
        open_sequence(write_folder(tmp_path), start=4)


def test_leaving_an_iteration_early_leaves_no_thread(tmp_path: Path) -> None:
    import threading

    for frame in open_sequence(write_folder(tmp_path)):
        assert frame.index == 0
        break
    assert not [t for t in threading.enumerate() if t.name.startswith("read-ahead")]


# camera.toml


def rewrite(root: Path, old: str, new: str) -> Path:
    text = (root / "camera.toml").read_text()
    assert old in text
    (root / "camera.toml").write_text(text.replace(old, new))
    return root


def test_a_plain_folder_needs_a_camera(tmp_path: Path) -> None:
    root = write_folder(tmp_path)
    (root / "camera.toml").unlink()
    with pytest.raises(
        DatasetError, match=r"camera of .* is not known; write a file .*camera\.toml with width, height, fx"
    ):
        open_sequence(root)


@pytest.mark.parametrize(("old", "new", "match"), [
    ("fx = 30.0", "", r"camera\.toml lacks fx; it needs width, height"),
    ("fx = 30.0", "fx = -30.0", r"fx = -30 in .*camera\.toml must be above zero"),
    ("fx = 30.0", "fx = nan", "fx = nan in .* is not a number"),
    ("fx = 30.0", "fx = true", "fx = True in .* is not a number"),
    ("width = 32", "width = 32.5", "width = 32.5 .* whole number of pixels"),
    ("fx = 30.0", "fx = ", "cannot be read as TOML"),
    ("depth_scale", "depthscale", "unknown key 'depthscale'; did you mean depth_scale"),
    ("fx = 30.0", "fx = 30.0\nzzz = 1", "unknown key 'zzz'; it may hold width"),
    ("fx = 30.0", "fx = 30.0\ndistortion = [1, 2, 3]", r"distortion = \[1, 2, 3\] .* must be a list"),
    ("fx = 30.0", "fx = 30.0\ndepth_distorted = 1", "depth_distorted = 1 .* must be true or false"),
    ("fx = 30.0", "fx = 30.0\ncrop = 12", "crop = 12 .* leaves nothing of 32x24"),
    ("fx = 30.0", "fx = 30.0\ncrop = -1", "crop = -1 .* whole number"),
    ("fx = 30.0", "fx = 30.0\nfps = 0", "fps = 0 .* above zero"),
    ("width = 32", "width = 64", r"depth/.* is 32x24 but its camera is 64x24; write the camera .*camera\.toml"),
])  # fmt: skip
def test_bad_camera_files(tmp_path: Path, old: str, new: str, match: str) -> None:
    with pytest.raises(DatasetError, match=match):
        open_sequence(rewrite(write_folder(tmp_path), old, new))


@every_layout
def test_a_crop_alone_keeps_the_known_camera(tmp_path: Path, layout: str) -> None:
    root = LAYOUTS[layout](tmp_path)
    with (root / "camera.toml").open("a") as file:
        file.write("crop = 3\n")
    frame = open_sequence(root).frame(0)
    assert (frame.camera.cx, frame.camera.cy, frame.camera.width, frame.camera.height) == (12.5, 8.25, W - 6, H - 6)
    assert frame.color.shape == (H - 6, W - 6, 3)
    assert frame.depth.shape == frame.valid.shape == (H - 6, W - 6)


def test_frame_rate_of_a_plain_folder(tmp_path: Path) -> None:
    root = rewrite(write_folder(tmp_path), "fx = 30.0", "fx = 30.0\nfps = 10")
    assert [frame.timestamp for frame in open_sequence(root)] == pytest.approx([0, 0.1, 0.2, 0.3])


@pytest.mark.parametrize("depth_distorted", [True, False])
def test_depth_is_undistorted_with_the_colour_unless_told_otherwise(tmp_path: Path, depth_distorted: bool) -> None:
    root = write_folder(tmp_path)
    switch = "" if depth_distorted else "\ndepth_distorted = false"
    rewrite(root, "fx = 30.0", f"fx = 30.0\ndistortion = [-0.8, 0.0, 0.2, 0.0]{switch}")
    columns = np.arange(W)[None, :].repeat(H, axis=0)
    for path in the_files(root, "color"):
        write_image(path, np.repeat((columns * 8).astype(np.uint8)[..., None], 3, axis=2))
    for path in the_files(root, "depth"):
        write_image(path, (1000 + columns * 50).astype(np.uint16))
    frame = open_sequence(root).frame(0)
    assert not bool(frame.valid.all())
    assert bool((frame.depth[~frame.valid] == 0).all())
    column_by_depth = (frame.depth - 1) / 0.05
    column_by_color = frame.color[..., 0] * 255 / 8
    expected = column_by_color if depth_distorted else torch.from_numpy(columns).float()
    difference = (column_by_depth - expected)[frame.valid].abs()
    assert float(difference.max()) <= (0.6 if depth_distorted else 1e-3)
    assert float((column_by_color - torch.from_numpy(columns))[frame.valid].abs().max()) > 1.5


# TUM


@pytest.mark.parametrize(("name", "fx", "distorted"), [
    ("rgbd_dataset_freiburg1_desk", 517.3, True),
    ("fr1_xyz", 517.3, True),
    ("FR2-xyz", 520.9, True),
    ("rgbd_dataset_freiburg3_long_office_household", 535.4, False),
])  # fmt: skip
def test_tum_cameras_are_known_by_the_folder(tmp_path: Path, name: str, fx: float, distorted: bool) -> None:
    sequence = open_sequence(write_tum(tmp_path / name, frames=1, width=640, height=480, toml=None))
    assert (sequence.camera.fx, sequence.camera.width) == (fx, 640)
    assert bool(sequence.frame(0).valid.all()) is not distorted


def test_tum_camera_is_known_by_the_list_if_the_folder_was_renamed(tmp_path: Path) -> None:
    root = write_tum(tmp_path / "renamed", frames=1, width=640, height=480, toml=None)
    text = (root / "rgb.txt").read_text()
    (root / "rgb.txt").write_text("# color images\n# file: 'rgbd_dataset_freiburg3_teddy.bag'\n" + text)
    assert open_sequence(root).camera.fx == 535.4


def test_tum_camera_file_wins_and_brings_its_own_distortion(tmp_path: Path) -> None:
    sequence = open_sequence(write_tum(tmp_path / "fr1_xyz"))
    assert sequence.camera.fx == 30.0
    assert bool(sequence.frame(0).valid.all())


def test_tum_known_camera_of_another_size(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"is 32x24 but its camera is 640x480; write the camera"):
        open_sequence(write_tum(tmp_path / "fr1_xyz", toml=None))


def test_tum_unknown_camera(tmp_path: Path) -> None:
    with pytest.raises(
        DatasetError, match=r"camera of .*kitchen is not known; write .*camera\.toml with .*distortion = \[k1"
    ):
        open_sequence(write_tum(tmp_path / "kitchen", toml=None))


def test_tum_association_takes_the_nearest_and_says_what_it_drops(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = write_tum(tmp_path, frames=4)
    lines = (root / "depth.txt").read_text().splitlines()
    del lines[2]  # frame 1 has no depth within 20 ms
    lines.append("100.0120 depth/decoy.png")  # and frame 0 has a farther one
    (root / "depth.txt").write_text("\n".join(lines) + "\n")
    with caplog.at_level(logging.INFO):
        sequence = open_sequence(root)
    assert [round(frame.timestamp, 3) for frame in sequence] == [100.0, 100.067, 100.1]
    assert sequence.frame(0).depth[0, 0] == pytest.approx(1.0)
    assert sequence.frame(0).depth_timestamp == 100.005
    assert "1 of 4 colour images" in caplog.text
    torch.testing.assert_close(sequence.ground_truth()[1], T_world_cam(2))


def test_tum_nothing_within_20_ms(tmp_path: Path) -> None:
    root = write_tum(tmp_path, frames=1)
    (root / "depth.txt").write_text("100.5 depth/100.005000.png\n")
    with pytest.raises(
        DatasetError, match=r"no colour image .* within 0\.02 s: the nearest are 0\.5 s apart; the time stamps"
    ):
        open_sequence(root)


@pytest.mark.parametrize("line", ["now rgb/a.png", "100.0", "nan rgb/a.png"])
def test_tum_malformed_list(tmp_path: Path, line: str) -> None:
    root = write_tum(tmp_path)
    (root / "rgb.txt").write_text(f"# color\n{line}\n")
    with pytest.raises(DatasetError, match=r"line 2 of .*rgb\.txt is not 'timestamp filename'"):
        open_sequence(root)


# Replica


def test_replica_camera_beside_the_scenes(tmp_path: Path) -> None:
    root = write_replica(tmp_path / "room0")
    (root / "cam_params.json").rename(tmp_path / "cam_params.json")
    assert open_sequence(root).camera.cy == 11.25


def test_replica_without_camera_file_is_the_published_one(tmp_path: Path) -> None:
    root = write_replica(tmp_path)
    (root / "cam_params.json").unlink()
    with pytest.raises(DatasetError, match="is 32x24 but its camera is 1200x680"):
        open_sequence(root)
    for i, path in enumerate(the_files(root, "color")):
        write_image(path, gray(i, 1200, 680))
    for path in the_files(root, "depth"):
        write_image(path, metres(2, 6553.5, 1200, 680))
    camera = open_sequence(root, limit=1).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (600.0, 600.0, 599.5, 339.5)


def test_replica_malformed_camera_file(tmp_path: Path) -> None:
    root = write_replica(tmp_path)
    (root / "cam_params.json").write_text('{"camera": {"w": 32}}')
    with pytest.raises(DatasetError, match=r"cam_params\.json is not the camera file of Replica"):
        open_sequence(root)


def test_numbers_in_the_names_hold_images_and_poses_together(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    root = write_replica(tmp_path)
    (root / "results" / "frame000000.jpg").unlink()
    (root / "results" / "depth000002.png").unlink()
    with caplog.at_level(logging.INFO):
        sequence = open_sequence(root)
    assert [round(frame.timestamp * 30) for frame in sequence] == [1, 3]
    torch.testing.assert_close(sequence.ground_truth()[1], T_world_cam(3))
    assert "images left out beside" in caplog.text


def test_no_number_in_common(tmp_path: Path) -> None:
    root = write_replica(tmp_path, frames=2)
    (root / "results" / "frame000000.jpg").unlink()
    (root / "results" / "depth000001.png").unlink()
    with pytest.raises(DatasetError, match=r"no colour image has a depth image of the same number: .*frame000001"):
        open_sequence(root)


# ScanNet


def test_scannet_colour_is_resized_about_pixel_areas(tmp_path: Path) -> None:
    root = write_scannet(tmp_path, frames=1)
    image = np.zeros((2 * H, 2 * W, 3), np.uint8)
    image[2 * 9 : 2 * 9 + 2, 2 * 21 : 2 * 21 + 2] = 255
    path = root / "color" / "0.jpg"
    path.unlink()
    write_image(path.with_suffix(".png"), image)
    color = open_sequence(root).frame(0).color[..., 0]
    assert color[9, 21] == 1
    assert float(color.sum()) == 1


def test_scannet_without_intrinsics(tmp_path: Path) -> None:
    root = write_scannet(tmp_path)
    (root / "intrinsic" / "intrinsic_depth.txt").write_text("1 two\n")
    with pytest.raises(DatasetError, match=r"intrinsic_depth\.txt is not a matrix of intrinsics"):
        open_sequence(root)
    (root / "intrinsic" / "intrinsic_depth.txt").unlink()
    with pytest.raises(DatasetError, match=r"is not known; write a file .*camera\.toml"):
        open_sequence(root)


def test_prepared_scannet_knows_its_scenes(tmp_path: Path) -> None:
    write = {"frames": 1, "width": 640, "height": 480, "toml": None}
    camera = open_sequence(write_prepared(tmp_path / "scene0181_00", **write)).camera
    assert (camera.fx, camera.cy) == (575.547668, 236.417465)
    with pytest.raises(DatasetError, match=r"scene0999_00 is not known; write a file .*camera\.toml"):
        open_sequence(write_prepared(tmp_path / "scene0999_00", **write))


# A plain folder


def test_folder_pairs_equal_counts_in_the_order_people_count(tmp_path: Path) -> None:
    root = write_folder(tmp_path, frames=12)
    for path in the_files(root, "color"):
        path.rename(path.with_name(f"left_{path.name}"))
    assert [round(float(frame.depth[0, 0]), 3) for frame in open_sequence(root)] == [
        round(1 + 0.1 * i, 3) for i in range(12)
    ]


def test_folder_pairs_equal_names_only(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """And who lacks a partner leaves a gap in time, or the camera would seem to have moved twice as fast."""
    root = write_folder(tmp_path)
    (root / "depth" / "1.png").unlink()
    sequence = open_sequence(root)
    assert [round(float(frame.depth[0, 0]), 3) for frame in sequence] == [1.0, 1.2, 1.3]
    assert [frame.timestamp for frame in sequence] == pytest.approx([0, 2 / 30, 3 / 30])
    assert sorted(sequence.ground_truth()) == [0, 1, 2]
    torch.testing.assert_close(sequence.ground_truth()[1], T_world_cam(2))
    assert f"images left out in {root}: 1," in caplog.text


@pytest.mark.parametrize("without", [("depth/1",), ("color/left_1", "depth/3"), ("color/left_0", "depth/0")])
def test_folder_pairs_equal_numbers(tmp_path: Path, without: tuple[str, ...]) -> None:
    root = write_folder(tmp_path, frames=6)
    for path in the_files(root, "color"):
        path.rename(path.with_name(f"left_0{path.name}"))
    for name in without:
        (root / f"{name.replace('left_', 'left_0')}.png").unlink()
    missing = {int(name[-1]) for name in without}
    assert [round(float(frame.depth[0, 0]), 3) for frame in open_sequence(root)] == [
        round(1 + 0.1 * i, 3) for i in range(6) if i not in missing
    ]


def test_folder_pairs_numbers_that_are_apart_by_one_in_order(tmp_path: Path) -> None:
    root = write_folder(tmp_path)
    for number, path in enumerate(the_files(root, "color"), start=1):
        path.rename(path.with_name(f"left_{number}.png"))
    assert [round(float(frame.depth[0, 0]), 3) for frame in open_sequence(root)] == [1.0, 1.1, 1.2, 1.3]


def test_folder_takes_time_from_names_that_are_time_stamps(tmp_path: Path) -> None:
    root = write_folder(tmp_path)
    for kind in ("color", "depth"):
        for number, path in enumerate(the_files(root, kind)):
            path.rename(path.with_name(f"1305031102.{100 + 40 * number}.png"))
    assert [frame.timestamp for frame in open_sequence(root)] == pytest.approx(
        [1305031102 + 0.1 + 0.04 * i for i in range(4)], abs=1e-6
    )


def test_folder_counts_that_differ_without_common_names(tmp_path: Path) -> None:
    root = write_folder(tmp_path)
    for path in the_files(root, "color"):
        path.rename(path.with_name(f"left_{'abcd'[int(path.stem)]}.png"))
    (root / "depth" / "3.png").unlink()
    with pytest.raises(DatasetError, match=r"4 images in .*color but 3 in .*depth, and no names or numbers in common"):
        open_sequence(root)


def test_folder_may_say_rgb_and_have_timed_poses(tmp_path: Path) -> None:
    root = write_folder(tmp_path)
    (root / "color").rename(root / "rgb")
    (root / "poses.txt").unlink()
    (root / "groundtruth.txt").write_text("\n".join(tum_row(i / 30, i) for i in (2, 0)) + "\n")
    poses = open_sequence(root).ground_truth()
    assert sorted(poses) == [0, 2]
    torch.testing.assert_close(poses[2], T_world_cam(2))


# Real data


SHARED = Path(__file__).parents[3] / "shared" / "data"


@pytest.mark.parametrize(
    ("name", "listed", "with_pose"), [("tum_fr1_xyz_half", 798, 796), ("tum_fr3_teddy_half", 193, 189)]
)
def test_real_tum_sequences(name: str, listed: int, with_pose: int) -> None:
    if not (SHARED / name).is_dir():
        pytest.skip(f"{SHARED / name} is not here; these tests read the real sequences of the project")
    sequence = open_sequence(SHARED / name)
    poses = sequence.ground_truth()
    assert (len(sequence), len(poses)) == (listed, with_pose)
    frame = sequence.frame(10)
    assert 0.3 < float(frame.depth[frame.depth > 0].median()) < 6
    assert 0.05 < float(frame.color[frame.valid].mean()) < 0.95
    assert float(frame.valid.float().mean()) > (0.9 if "fr1" in name else 0.999)
    assert 0 < abs(frame.depth_delay) <= MAX_GAP
