"""What belongs together: colour and depth, frames and poses; by time, by the number in a name, by the row of a file."""

import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from tcgsplat.errors import DatasetError
from tcgsplat.scene.trajectory import parse_tum
from tcgsplat.tensors import Pose

logger = logging.getLogger(__name__)

MAX_GAP = 0.02
"""Seconds between two time stamps that still belong together: the tolerance of the TUM benchmark's own tools."""
MAX_SKEW = 1e-2
"""Largest entry of R R^T - I, and of the last row's error, in a pose that is only rounded."""


@dataclass(frozen=True)
class ImagePair:
    """A colour image and the depth image that belongs to it, not yet read."""

    color: Path
    depth: Path
    timestamp: float
    """Seconds, of the colour image."""
    number: int
    """Place in the layout's own numbering, by which it finds the pose."""
    depth_timestamp: float | None = None
    """Seconds, of the depth image; None where the layout gives a pair one time."""


def read_text(path: Path) -> str:
    """A text file.

    Raises:
        DatasetError: if it cannot be opened.
    """
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise DatasetError(f"{path} cannot be read ({error.strerror}); check the file and its permissions") from error


def nearest(times: NDArray[np.float64], others: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """For each time, the index of the nearest of `others` (sorted, not empty) and the gap to it, seconds."""
    right = np.searchsorted(others, times).clip(max=len(others) - 1)
    left = (right - 1).clip(min=0)
    index = np.where(np.abs(times - others[left]) <= np.abs(others[right] - times), left, right)
    return index.astype(np.int64), np.abs(others[index] - times)


def paired_by_number(colors: Iterable[Path], depths: Iterable[Path], fps: float) -> tuple[ImagePair, ...]:
    """Images with the same last number in their names (12 of `frame_00012.png`), in its order; time is number / fps.

    Raises:
        DatasetError: if no number is in both.
    """
    color_of, depth_of = _by_number(colors), _by_number(depths)
    numbers = sorted(color_of.keys() & depth_of.keys())
    if not numbers:
        raise DatasetError(
            f"no colour image has a depth image of the same number: {_examples(color_of)}, but {_examples(depth_of)}"
        )
    if lonely := len(color_of.keys() ^ depth_of.keys()):
        logger.warning(
            "images left out beside %s: %d, colour without depth or the reverse", color_of[numbers[0]], lonely
        )
    return tuple(ImagePair(color_of[n], depth_of[n], timestamp=n / fps, number=n) for n in numbers)


def _by_number(files: Iterable[Path]) -> dict[int, Path]:
    return {int(digits[-1]): path for path in files if (digits := re.findall(r"\d+", path.stem))}


def _examples(files: Mapping[int, Path]) -> str:
    return f"{next(iter(files.values()))} and so on" if files else "no file with a number"


def poses_by_time(path: Path, pairs: Sequence[ImagePair]) -> dict[int, Pose]:
    """`T_world_cam` by place in `pairs`, from a trajectory in the TUM format; the nearest pose within `MAX_GAP`.

    Nearest and not interpolated, because the benchmark's tools and `evo` do the same, so that figures compare; and
    because interpolation would invent poses in the gaps of the motion capture (fr1/xyz has one of 110 ms).

    Raises:
        DatasetError: if the file is there but cannot be read or has a malformed line.
    """
    stamps, poses = _read_tum(path)
    if not poses:
        return {}
    order = np.argsort(stamps, kind="stable")
    times = np.array([pair.timestamp for pair in pairs])
    index, gap = nearest(times, np.array(stamps)[order])
    near = {i: poses[order[index[i]]] for i in np.flatnonzero(gap <= MAX_GAP).tolist()}
    return {i: T for i, T in near.items() if _is_usable(T, f"frame {i} in {path}")}


def tum_poses_by_row(path: Path, pairs: Sequence[ImagePair]) -> dict[int, Pose]:
    """`T_world_cam` by place in `pairs`, from a file in the TUM format whose rows, not whose times, count the frames.

    Raises:
        DatasetError: if the file is there but cannot be read or has a malformed line.
    """
    _, poses = _read_tum(path)
    counted = {i: poses[pair.number] for i, pair in enumerate(pairs) if pair.number < len(poses)}
    return {i: T for i, T in counted.items() if _is_usable(T, f"frame {i} in {path}")}


def matrices_by_row(path: Path, pairs: Sequence[ImagePair]) -> dict[int, Pose]:
    """`T_world_cam` by place in `pairs`, from a file with a 4x4 matrix a line (or its first three rows).

    Raises:
        DatasetError: if the file is there but cannot be read or has a malformed line.
    """
    lines = [line for line in (read_text(path) if path.exists() else "").splitlines() if line.strip()]
    rows = {i: pair.number for i, pair in enumerate(pairs) if pair.number < len(lines)}
    counted = {i: _matrix(lines[row], f"pose {row} of {path}") for i, row in rows.items()}
    return {i: T for i, T in counted.items() if _is_usable(T, f"frame {i} in {path}")}


def matrices_by_file(folder: Path, pairs: Sequence[ImagePair]) -> dict[int, Pose]:
    """`T_world_cam` by place in `pairs`, from one file with a 4x4 matrix a frame: `12.txt`.

    Raises:
        DatasetError: if a file is there but cannot be read or is malformed.
    """
    path_of = _by_number(folder.glob("*.txt"))
    found = {i: path_of[pair.number] for i, pair in enumerate(pairs) if pair.number in path_of}
    numbered = {i: _matrix(read_text(path), str(path)) for i, path in found.items()}
    return {i: T for i, T in numbered.items() if _is_usable(T, f"frame {i} in {found[i]}")}


def _is_usable(T: Pose, of: str) -> bool:
    """Whether a pose is a rigid transform. Infinite ones mean "unknown" in ScanNet; others deserve a warning."""
    eye = torch.eye(4, dtype=T.dtype)
    R = T[:3, :3]
    error = torch.cat(((R @ R.T - eye[:3, :3]).flatten(), T[3] - eye[3]))
    rigid = bool(T.isfinite().all()) and float(error.abs().max()) < MAX_SKEW and float(torch.linalg.det(R)) > 0
    if not rigid and not bool(T.isinf().any()):
        logger.warning("the pose of %s is left out: it is not a rigid transform", of)
    return rigid


def _read_tum(path: Path) -> tuple[list[float], list[Pose]]:
    text = read_text(path).lstrip() if path.exists() else ""
    if text.startswith("timestamp"):  # LoopSplat's preparation writes the header without a comment sign
        text = "#" + text
    try:
        return parse_tum(text)
    except ValueError as error:
        raise DatasetError(f"{path}: {error}; repair the line or remove it") from error


def _matrix(text: str, where: str) -> Pose:
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) == 12:
        values += [0.0, 0.0, 0.0, 1.0]
    if len(values) != 16:
        raise DatasetError(f"{where} is not a 4x4 matrix of numbers; repair it or remove it")
    return torch.tensor(values, dtype=torch.float64).reshape(4, 4)
