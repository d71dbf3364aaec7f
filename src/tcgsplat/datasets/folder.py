"""A plain folder: `color/` (or `rgb/`) and `depth/` images, and a `camera.toml` that says what took them."""

import logging
import re
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
    """Pair images of equal names or numbers. Where names are not time stamps, the colour images come `fps` a second.

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
    colors = image_files(color_folder)
    stamps = [_stamp(path, place / calibration.fps) for place, path in enumerate(colors)]
    matched = _matched(colors, image_files(depth_folder))
    pairs = tuple(ImagePair(colors[k], depth, timestamp=stamps[k], number=k) for k, depth in matched)
    if (root / "poses.txt").exists():
        return Recording(root, pairs, calibration, partial(matrices_by_row, root / "poses.txt"))
    return Recording(root, pairs, calibration, partial(poses_by_time, root / "groundtruth.txt"))


def _stamp(path: Path, otherwise: float) -> float:
    """Seconds, where the name is a time stamp such as 1305031102.033."""
    return float(path.stem) if re.fullmatch(r"\d+\.\d+", path.stem) else otherwise


def _matched(colors: list[Path], depths: list[Path]) -> list[tuple[int, Path]]:
    """Places of colour images, each with its depth image: of the same name, else of the same number, else in order.

    As many images on either side whose numbers are apart by the same everywhere belong together in order, too.
    """
    for key in (_name, _number):
        depth_of = {key(path): path for path in depths}
        matched = [(k, depth_of[key(path)]) for k, path in enumerate(colors) if key(path) and key(path) in depth_of]
        if matched and not (key is _number and _in_step(colors, depths)):
            break
    else:
        if len(colors) != len(depths):
            raise DatasetError(
                f"{len(colors)} images in {colors[0].parent} but {len(depths)} in {depths[0].parent}, and no names or "
                "numbers in common; give each pair the same name"
            )
        matched = list(enumerate(depths))
    if left := len(colors) + len(depths) - 2 * len(matched):
        logger.warning("images left out in %s: %d, colour without depth or the reverse", colors[0].parents[1], left)
    return matched


def _name(path: Path) -> str:
    return path.stem


def _number(path: Path) -> str:
    """The last number of a name, without leading zeros; empty if there is none, or it is a time stamp's fraction."""
    found = re.search(r"(?<![.\d])0*(\d+)\D*$", path.stem)
    return found[1] if found else ""


def _in_step(colors: list[Path], depths: list[Path]) -> bool:
    if len(colors) != len(depths):
        return False
    apart = {int(_number(a) or 0) - int(_number(b) or 0) for a, b in zip(colors, depths, strict=True)}
    return len(apart) == 1
