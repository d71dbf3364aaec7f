"""Images to arrays: where a pixel is before and after undistortion, and which files count as broken."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tcgsplat.datasets import open_sequence
from tcgsplat.datasets.images import Rectification, UnreadableImageError, image_files, read_color, read_depth
from tcgsplat.errors import DatasetError
from tcgsplat.geometry.camera import Camera

CAMERA = Camera(fx=80.0, fy=82.0, cx=47.3, cy=35.6, width=96, height=72)
BROWN = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)


def distorted(u: float, v: float) -> tuple[float, float]:
    """Brown's model, written out: where the lens puts what a pinhole would see at pixel (u, v)."""
    k1, k2, p1, p2, k3 = BROWN
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return xd * CAMERA.fx + CAMERA.cx, yd * CAMERA.fy + CAMERA.cy


def blob(u: float, v: float) -> np.ndarray:
    """A soft white dot whose centre is at (u, v), pixel centres being integers."""
    columns, rows = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    dot = 255 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 1.5**2))
    return np.repeat(dot[..., None], 3, axis=2).round().astype(np.uint8)


def test_undistortion_with_no_distortion_changes_nothing() -> None:
    rectification = Rectification.of(CAMERA, (0.0, 0.0, 0.0, 0.0, 0.0))
    gradient = np.repeat(np.arange(96, dtype=np.uint8)[None, :, None], 72, axis=0).repeat(3, axis=2)
    inner = (slice(1, -1), slice(1, -1))
    np.testing.assert_array_equal(rectification.color(gradient)[inner], gradient[inner])
    np.testing.assert_allclose(rectification.u, np.arange(96)[None, :].repeat(72, 0), atol=1e-4)
    np.testing.assert_allclose(rectification.v, np.arange(72)[:, None].repeat(96, 1), atol=1e-4)


@pytest.mark.parametrize(("u", "v"), [(20, 15), (70, 12), (47, 36), (75, 58)])
def test_undistortion_brings_a_point_to_its_integer_pixel(u: int, v: int) -> None:
    image = Rectification.of(CAMERA, BROWN).color(blob(*distorted(u, v))).astype(float)[..., 0]
    columns, rows = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    assert (image * columns).sum() / image.sum() == pytest.approx(u, abs=0.1)
    assert (image * rows).sum() / image.sum() == pytest.approx(v, abs=0.1)


def test_undistorted_depth_takes_whole_readings_only() -> None:
    depth = np.where(np.arange(96)[None, :] < 48, np.float32(1), np.float32(3)).repeat(72, axis=0)
    assert set(np.unique(Rectification.of(CAMERA, BROWN).depth(depth)).tolist()) == {0.0, 1.0, 3.0}


def test_valid_leaves_out_the_empty_border_and_two_pixels_more() -> None:
    rectification = Rectification.of(CAMERA, BROWN)
    white = np.full((72, 96, 3), 255, np.uint8)
    assert rectification.color(white)[rectification.valid].min() == 255
    outside = (rectification.u < 0) | (rectification.u > 95) | (rectification.v < 0) | (rectification.v > 71)
    assert outside.any()
    grown = cv2.dilate(outside.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    np.testing.assert_array_equal(rectification.valid, ~grown)


def test_backprojected_pixel_centres_project_to_integers() -> None:
    depth = torch.rand(72, 96, generator=torch.Generator().manual_seed(0)) + 0.5
    pixels = CAMERA.project(CAMERA.backproject(depth))
    v, u = torch.meshgrid(torch.arange(72.0), torch.arange(96.0), indexing="ij")
    torch.testing.assert_close(pixels, torch.stack((u, v), dim=-1), atol=1e-4, rtol=0)


def test_a_rendered_corner_is_at_its_integer_pixel_after_opening_and_cropping(tmp_path: Path) -> None:
    """A checker corner square at pixel (30, 20): the loader's camera must project its 3D point onto that pixel."""
    X, Y, Z = ((30 - CAMERA.cx) / CAMERA.fx * 2.0, (20 - CAMERA.cy) / CAMERA.fy * 2.0, 2.0)
    color = np.zeros((72, 96, 3), np.uint8)
    color[20, 30] = 255
    for name, image in (("color", color), ("depth", np.full((72, 96), 2000, np.uint16))):
        (tmp_path / name).mkdir()
        assert cv2.imwrite(str(tmp_path / name / "0.png"), image)
    (tmp_path / "camera.toml").write_text(
        "width = 96\nheight = 72\nfx = 80.0\nfy = 82.0\ncx = 47.3\ncy = 35.6\ndepth_scale = 1000\ncrop = 7\n"
    )
    frame = open_sequence(tmp_path).frame(0)
    u, v = frame.camera.project(torch.tensor([X, Y, Z])).tolist()
    row, column = divmod(int(frame.color[..., 0].argmax()), frame.camera.width)
    assert (u, v) == pytest.approx((column, row), abs=1e-4)
    assert frame.color.shape == (58, 82, 3)


@pytest.mark.parametrize("suffix", ["png", "jpg", "tiff"])
@pytest.mark.parametrize("damage", ["cut in half", "end missing", "empty", "text"])
def test_a_broken_file_is_refused_quietly(
    tmp_path: Path, suffix: str, damage: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"image.{suffix}"
    noise = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    assert cv2.imwrite(str(path), noise)
    whole = path.read_bytes()
    broken = {"cut in half": whole[: len(whole) // 2], "end missing": whole[:-6], "empty": b"", "text": b"hello" * 40}
    assert read_color(path).shape == (48, 64, 3)
    path.write_bytes(broken[damage])
    with pytest.raises(UnreadableImageError, match=r"image\.\w+ is broken or cut off"):
        read_color(path)
    if (suffix, damage) != ("tiff", "end missing"):  # its directory is there, and only OpenCV follows every entry
        assert capfd.readouterr().err == ""


def test_a_png_with_one_flipped_byte_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "d.png"
    assert cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 9999, (48, 64)).astype(np.uint16))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(UnreadableImageError, match="broken"):
        read_depth(path, 1000.0)
    assert capfd.readouterr().err == ""


def test_color_is_rgb(tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "c.png"), np.full((4, 4, 3), (10, 20, 30), np.uint8))
    assert read_color(tmp_path / "c.png")[0, 0].tolist() == [30, 20, 10]


def test_depth_without_reading_is_zero(tmp_path: Path) -> None:
    depth = np.array([[1.5, np.nan, np.inf, -1.0, 0.0, 2.0]], np.float32)
    assert cv2.imwrite(str(tmp_path / "d.tiff"), depth)
    assert read_depth(tmp_path / "d.tiff", 1.0)[0].tolist() == [1.5, 0, 0, 0, 0, 2.0]


@pytest.mark.parametrize("image", [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3), np.uint16)])
def test_a_picture_of_depth_is_not_depth(tmp_path: Path, image: np.ndarray) -> None:
    assert cv2.imwrite(str(tmp_path / "d.png"), image)
    with pytest.raises(DatasetError, match=r"d\.png is no depth image.*16-bit"):
        read_depth(tmp_path / "d.png", 1.0)


def test_files_are_in_the_order_people_count(tmp_path: Path) -> None:
    for name in ("10.png", "9.png", "1.png", "._1.png", "notes.txt"):
        (tmp_path / name).touch()
    assert [p.name for p in image_files(tmp_path)] == ["1.png", "9.png", "10.png"]
