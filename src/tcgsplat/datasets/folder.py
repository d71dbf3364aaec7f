"""A plain folder: `color/` (or `rgb/`) and `depth/` images, and a `camera.toml` that says what took them."""

import logging
from functools import partial
from pathlib import Path

from tcgsplat.datasets.association import ImagePair, matrices_by_row, poses_by_time
from tcgsplat.datasets.calibration import read_calibration
from tcgsplat.datasets.images import image_files
from tcgsplat.datasets.recording import Recording
from tcgsplat.errors import DatasetError

logger = logging.getLogger(__name__)


def recognises(root: Path) -> bool:
    """Whether the folder has any of the three image folders."""
    return any((root / name).is_dir() for name in ("color", "rgb", "depth"))


def open_recording(root: Path) -> Recording:
    """Pair images of equal names, or of equal number in sorted order; time is counted from 0 at `fps`.

    Poses, if known, are in `groundtruth.txt` (TUM format, by time) or `poses.txt` (a 4x4 matrix a line, by order).

    Raises:
        DatasetError: if a folder is missing or empty, the images do not match, or there is no camera.
    """
    color_folder = root / "color" if (root / "color").is_dir() else root / "rgb"
    depth_folder = root / "depth"
    for folder in (color_folder, depth_folder):
        if not folder.is_dir():
            raise DatasetError(f"no folder {folder}; {root} needs color/ (or rgb/) and depth/ with the images of both")
        if not image_files(folder):
            raise DatasetError(f"no images in {folder}; the sequence is empty")
    calibration = read_calibration(root, {})
    matched = _matched(image_files(color_folder), image_files(depth_folder))
    pairs = tuple(ImagePair(c, d, timestamp=i / calibration.fps, number=i) for i, (c, d) in enumerate(matched))
    if (root / "poses.txt").exists():
        return Recording(root, pairs, calibration, partial(matrices_by_row, root / "poses.txt"))
    return Recording(root, pairs, calibration, partial(poses_by_time, root / "groundtruth.txt"))


def _matched(colors: list[Path], depths: list[Path]) -> list[tuple[Path, Path]]:
    depth_of = {path.stem: path for path in depths}
    named = [(color, depth_of[color.stem]) for color in colors if color.stem in depth_of]
    if named:
        if len(named) < max(len(colors), len(depths)):
            logger.info("%d of %d colour images in %s have a depth image", len(named), len(colors), colors[0].parent)
        return named
    if len(colors) != len(depths):
        raise DatasetError(
            f"{len(colors)} images in {colors[0].parent} but {len(depths)} in {depths[0].parent}, and no names in "
            "common; give each pair the same name"
        )
    return list(zip(colors, depths, strict=True))
