"""The TUM RGB-D benchmark: `rgb.txt`, `depth.txt` and, if known, `groundtruth.txt` (Sturm et al., IROS 2012)."""

import logging
import math
import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from tcgsplat.datasets.association import MAX_GAP, ImagePair, nearest, poses_by_time, read_text
from tcgsplat.datasets.calibration import read_calibration
from tcgsplat.datasets.recording import Recording
from tcgsplat.errors import DatasetError

logger = logging.getLogger(__name__)

DEPTH_SCALE = 5000.0
"""Units per metre; the correction factors of the three sensors are already in the published files."""

# The benchmark's calibrations at 640x480 come from OpenCV: pixel centres are integers, distortion is k1 k2 p1 p2 k3.
# The files of freiburg3 are already undistorted.
CAMERAS: Mapping[str, Mapping[str, object]] = {
    "1": {"width": 640, "height": 480, "fx": 517.3, "fy": 516.5, "cx": 318.6, "cy": 255.3,
          "distortion": (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)},
    "2": {"width": 640, "height": 480, "fx": 520.9, "fy": 521.0, "cx": 325.1, "cy": 249.7,
          "distortion": (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)},
    "3": {"width": 640, "height": 480, "fx": 535.4, "fy": 539.2, "cx": 320.1, "cy": 247.6},
}  # fmt: skip


def recognises(root: Path) -> bool:
    """Whether the folder has one of the benchmark's lists of images."""
    return (root / "rgb.txt").exists() or (root / "depth.txt").exists()


def open_recording(root: Path) -> Recording:
    """List the colour images that have a depth image within `MAX_GAP`.

    Two colour images may share a depth image: the sensor's two clocks drift through each other, and to take each
    depth image only once would drop 6 of the 798 frames of fr1/xyz, all of which have a reading within 18 ms.

    Raises:
        DatasetError: if a list is missing, empty or malformed, nothing belongs together, or the camera is unknown.
    """
    for needed in ("rgb.txt", "depth.txt"):
        if not (root / needed).exists():
            raise DatasetError(f"no {needed} in {root}; give the folder that holds both rgb.txt and depth.txt")
    colors, depths = _read_list(root / "rgb.txt"), _read_list(root / "depth.txt")
    times = np.array([stamp for stamp, _ in colors])
    index, gap = nearest(times, np.array([stamp for stamp, _ in depths]))
    if gap.min() > MAX_GAP:
        raise DatasetError(
            f"no colour image in {root} has a depth image within {MAX_GAP:g} s: the nearest are {gap.min():.3g} s "
            "apart; the time stamps of rgb.txt and depth.txt must come from one clock"
        )
    pairs = tuple(
        ImagePair(root / name, root / depths[k][1], timestamp=stamp, number=i, depth_timestamp=depths[k][0])
        for i, ((stamp, name), k, g) in enumerate(zip(colors, index, gap, strict=True))
        if g <= MAX_GAP
    )
    if len(pairs) < len(colors):
        logger.info(
            "%d of %d colour images in %s are left out: no depth image within %g s",
            len(colors) - len(pairs), len(colors), root, MAX_GAP,
        )  # fmt: skip
    known = {"depth_scale": DEPTH_SCALE, **CAMERAS.get(_sensor(root), {})}
    return Recording(root, pairs, read_calibration(root, known), partial(poses_by_time, root / "groundtruth.txt"))


def _sensor(root: Path) -> str:
    """The digit of freiburg1, freiburg2 or freiburg3, from the folder's name, else from the head of `rgb.txt`."""
    head = "".join(line for line in read_text(root / "rgb.txt").splitlines()[:3] if line.startswith("#"))
    for text in (root.name, root.resolve().name, head):
        found = re.search(r"(?<![a-z])(?:freiburg|fr)[_-]?([123])(?!\d)", text.lower())
        if found:
            return found[1]
    return ""


def _read_list(path: Path) -> list[tuple[float, str]]:
    """Time stamps (s) and file names, in order of time."""
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        stamp, _, name = line.strip().partition(" ")
        try:
            time = float(stamp)
        except ValueError:
            time = math.nan
        if not math.isfinite(time) or not name.strip():
            raise DatasetError(
                f"line {number} of {path} is not 'timestamp filename': {line.strip()!r}; repair or remove it"
            )
        rows.append((time, name.strip()))
    if not rows:
        raise DatasetError(f"{path} lists no images; the sequence is empty")
    return sorted(rows)
