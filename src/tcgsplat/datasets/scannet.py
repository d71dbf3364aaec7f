"""ScanNet, extracted by its own tool (`color/ depth/ pose/ intrinsic/`) or prepared by LoopSplat (`rgb/ depth/`)."""

import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from tcgsplat.datasets.association import (
    matrices_by_file,
    paired_by_number,
    read_text,
    tum_poses_by_row,
)
from tcgsplat.datasets.calibration import read_calibration
from tcgsplat.datasets.images import UnreadableImageError, image_files, read_depth
from tcgsplat.datasets.recording import Recording
from tcgsplat.errors import DatasetError

DEPTH_SCALE = 1000.0
"""Units per metre of the extracted depth images."""
PREPARED_FPS = 20.0
"""Frames a second that LoopSplat's preparation writes down; the sensor's own rate is 30."""

# fx, fy, cx, cy of the depth camera at 640x480 by scene, from the data set's own files: pixel centres are integers.
CAMERAS: Mapping[str, tuple[float, float, float, float]] = {
    "0000": (577.6, 578.7, 318.9, 242.7),
    "0054": (578.0, 578.0, 319.5, 239.5),
    "0059": (577.6, 578.7, 318.9, 242.7),
    "0106": (577.6, 578.7, 318.9, 242.7),
    "0169": (574.5, 577.6, 322.5, 238.6),
    "0181": (575.547668, 577.459778, 323.171967, 236.417465),
    "0207": (577.6, 578.7, 318.9, 242.7),
    "0233": (577.9, 577.9, 319.5, 239.5),
    "0465": (577.9, 577.9, 319.5, 239.5),
}


def recognises_extracted(root: Path) -> bool:
    """Whether the folder looks as ScanNet's own tool leaves it."""
    return (root / "color").is_dir() and ((root / "pose").is_dir() or (root / "intrinsic").is_dir())


def open_extracted(root: Path) -> Recording:
    """Pair the images by number. Colour is resized to the depth image's size, whose intrinsics hold for both.

    Raises:
        DatasetError: if there is no depth or no pair, or the intrinsics are missing or malformed.
    """
    colors, depths = image_files(root / "color"), image_files(root / "depth")
    if not depths:
        raise DatasetError(f"no depth images in {root / 'depth'}; extract the sequence with its depth")
    intrinsics = root / "intrinsic" / "intrinsic_depth.txt"
    defaults: dict[str, object] = {"depth_scale": DEPTH_SCALE}
    if intrinsics.is_file():
        defaults |= _matrix_intrinsics(intrinsics) | _size(depths)
    calibration = read_calibration(root, defaults)
    pairs = paired_by_number(colors, depths, calibration.fps)
    return Recording(root, pairs, calibration, partial(matrices_by_file, root / "pose"), resize_color=True)


def recognises_prepared(root: Path) -> bool:
    """Whether the folder looks as LoopSplat's preparation leaves it: PNG colour, and depth as floating-point TIFF."""
    return bool(image_files(root / "rgb", "frame_")) and any(
        path.suffix.lower() in (".tif", ".tiff") for path in image_files(root / "depth", "frame_")
    )


def open_prepared(root: Path) -> Recording:
    """Pair the images by number; the camera is known by the scene's number in the folder's name.

    Raises:
        DatasetError: if no image has a partner, or the scene is unknown and there is no `camera.toml`.
    """
    colors, depths = image_files(root / "rgb", "frame_"), image_files(root / "depth", "frame_")
    defaults: dict[str, object] = {"depth_scale": 1.0, "fps": PREPARED_FPS}
    scene = re.search(r"(?<!\d)(\d{4})(?!\d)", root.resolve().name)
    if scene and scene[1] in CAMERAS:
        defaults |= dict(zip(("fx", "fy", "cx", "cy"), CAMERAS[scene[1]], strict=True)) | {"width": 640, "height": 480}
    calibration = read_calibration(root, defaults)
    pairs = paired_by_number(colors, depths, calibration.fps)
    return Recording(root, pairs, calibration, partial(tum_poses_by_row, root / "gt_pose.txt"))


def _matrix_intrinsics(path: Path) -> dict[str, object]:
    try:
        K = [[float(word) for word in line.split()] for line in read_text(path).splitlines() if line.strip()]
        return {"fx": K[0][0], "fy": K[1][1], "cx": K[0][2], "cy": K[1][2]}
    except (ValueError, IndexError) as error:
        raise DatasetError(f"{path} is not a matrix of intrinsics; extract it again, or write a camera.toml") from error


def _size(depths: Sequence[Path]) -> dict[str, object]:
    for path in depths:
        try:
            height, width = read_depth(path, DEPTH_SCALE).shape
        except UnreadableImageError:
            continue
        return {"width": width, "height": height}
    raise DatasetError(f"none of the {len(depths)} depth images in {depths[0].parent} can be read; extract them again")
