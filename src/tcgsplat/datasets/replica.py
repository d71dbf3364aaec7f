"""Replica as rendered for iMAP and NICE-SLAM: `results/frame*.jpg`, `results/depth*.png`, `traj.txt`."""

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Final

from tcgsplat.datasets.association import matrices_by_row, paired_by_number, read_text
from tcgsplat.datasets.calibration import read_calibration
from tcgsplat.datasets.images import image_files
from tcgsplat.datasets.recording import Recording
from tcgsplat.errors import DatasetError

# The centre is half of (width - 1, height - 1): pixel centres are integers.
CAMERA: Mapping[str, object] = {
    "width": 1200, "height": 680, "fx": 600.0, "fy": 600.0, "cx": 599.5, "cy": 339.5, "depth_scale": 6553.5,
}  # fmt: skip
KEYS: Final = {"w": "width", "h": "height", "fx": "fx", "fy": "fy", "cx": "cx", "cy": "cy", "scale": "depth_scale"}
"""Names in `cam_params.json`, and ours."""


def recognises(root: Path) -> bool:
    """Whether the folder has rendered images in `results/`."""
    return bool(image_files(root / "results", "frame"))


def open_recording(root: Path) -> Recording:
    """Pair the images by number; the camera stands in `cam_params.json`, else it is the published one.

    Raises:
        DatasetError: if there is no depth or no pair, or the camera's file is malformed.
    """
    folder = root / "results"
    depths = image_files(folder, "depth")
    if not depths:
        raise DatasetError(
            f"no depth images (depth000000.png and so on) in {folder}; they belong beside the colour images"
        )
    calibration = read_calibration(root, _camera(root))
    pairs = paired_by_number(image_files(folder, "frame"), depths, calibration.fps)
    return Recording(root, pairs, calibration, partial(matrices_by_row, root / "traj.txt"))


def _camera(root: Path) -> Mapping[str, object]:
    found = [path for path in (root / "cam_params.json", root.parent / "cam_params.json") if path.is_file()]
    if not found:
        return CAMERA
    try:
        table = json.loads(read_text(found[0]))["camera"]
        return {ours: table[theirs] for theirs, ours in KEYS.items()}
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{found[0]} is not the camera file of Replica ({error!r}); it holds "
            '{"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale"}}'
        ) from error
