"""The camera's path, kept relative to submaps, so that moving a submap moves every frame that was tracked in it."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tcgsplat.geometry import quaternion, se3
from tcgsplat.scene.atlas import Atlas
from tcgsplat.scene.exposure import UNCHANGED, Exposure
from tcgsplat.tensors import Pose


@dataclass(frozen=True)
class TrackedPose:
    """One frame's pose in the submap that was active when it was tracked."""

    frame_index: int
    timestamp: float
    """Seconds."""
    submap_index: int
    T_map_cam: Pose
    lost: bool = False
    """The pose is a prediction: tracking did not converge."""
    mapped: bool = False
    """The map was optimised on this frame; it may have been dropped from the keyframes since. A frame that is neither
    mapped nor lost is withheld from the map: what the map shows of it tells how well it shows new views."""
    exposure: Exposure = UNCHANGED
    """Of its picture, beside the map's."""


@dataclass(frozen=True)
class Trajectory:
    """Poses in the order of the frames."""

    rows: tuple[TrackedPose, ...] = ()

    def __len__(self) -> int:
        return len(self.rows)

    def with_row(self, row: TrackedPose) -> "Trajectory":
        """With one more frame."""
        return Trajectory((*self.rows, row))

    @property
    def seconds_lost(self) -> float:
        """In which nobody knew where the camera was: from each lost frame to the next one."""
        return sum(b.timestamp - a.timestamp for a, b in pairwise(self.rows) if a.lost)

    def world(self, atlas: Atlas) -> list[Pose]:
        """`T_world_cam` of every row; composed late, so that corrections of the atlas reach every frame."""
        return [atlas.T_world_map[row.submap_index] @ row.T_map_cam for row in self.rows]

    def velocities(self, atlas: Atlas) -> list[Float[Tensor, "6"]]:
        """Tangent per second (metres, radians) of every row in the camera's own frame: T(t + dt) = T(t) exp(v dt).

        From the row before to the row after, as far as there are these; zero where no time passes between them.
        """
        poses, last = self.world(atlas), len(self.rows) - 1
        found: list[Tensor] = []
        for i in range(len(poses)):
            a, b = max(i - 1, 0), min(i + 1, last)
            elapsed = self.rows[b].timestamp - self.rows[a].timestamp
            step = se3.log(se3.inverse(poses[a]) @ poses[b])
            found.append(step / elapsed if elapsed > 0 else torch.zeros_like(step))
        return found


def format_tum(
    timestamps: "list[float] | np.ndarray[tuple[int], np.dtype[np.float64]]", T_world_cam: list[Pose]
) -> str:
    """Trajectory as text in the TUM format: `timestamp tx ty tz qx qy qz qw`, metres, camera to world.

    Enough digits that reading it back gives the same numbers.
    """
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    T = torch.stack(T_world_cam) if T_world_cam else torch.empty(0, 4, 4)
    turns, places = quaternion.from_matrix(T[:, :3, :3]).tolist(), T[:, :3, 3].tolist()
    for stamp, (w, x, y, z), (tx, ty, tz) in zip(timestamps, turns, places, strict=True):
        lines.append(f"{float(stamp)!r} " + " ".join(f"{value:.17g}" for value in (tx, ty, tz, x, y, z, w)))
    return "\n".join(lines) + "\n"


def parse_tum(text: str) -> tuple[list[float], list[Pose]]:
    """Time stamps (s) and `T_world_cam` from text in the TUM format; lines that begin with `#` are skipped.

    Raises:
        ValueError: if a line has not eight numbers; the message gives its number.
    """
    stamps: list[float] = []
    poses: list[Pose] = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            stamp, tx, ty, tz, qx, qy, qz, qw = (float(word) for word in words)
        except ValueError as error:
            raise ValueError(f"line {number} is not 'timestamp tx ty tz qx qy qz qw': {line.strip()!r}") from error
        T = torch.eye(4, dtype=torch.float64)
        T[:3, :3] = quaternion.to_matrix(torch.tensor([qw, qx, qy, qz], dtype=torch.float64))
        T[:3, 3] = torch.tensor([tx, ty, tz], dtype=torch.float64)
        stamps.append(stamp)
        poses.append(T)
    return stamps, poses
