"""What a run knows at the moment when it begins a new submap: with the submaps on disk, enough to go on from there.

At that moment the active submap is empty and no update is under way, so little is to be remembered, and exactly.
"""

from dataclasses import astuple, dataclass, field, fields
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from tcgsplat.errors import ArchiveError
from tcgsplat.loop.edge import Edge, Verdict
from tcgsplat.scene.atlas import Atlas
from tcgsplat.scene.exposure import Exposure
from tcgsplat.scene.trajectory import Trajectory
from tcgsplat.storage import archive
from tcgsplat.storage.trajectories import trajectory_arrays, trajectory_of
from tcgsplat.tensors import Pose
from tcgsplat.tracking.delay import DepthDelay
from tcgsplat.tracking.motion import ConstantVelocity


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """The state of the online system between tracking a frame and mapping it as the first of a submap."""

    frame_index: int
    """Of that frame, which is at the origin of the new submap."""
    sealed: int
    """Submaps that are finished; the new one has this index."""
    trajectory: Trajectory
    """Of the frames before that one."""
    atlas: Atlas
    """With the new submap."""
    edges: tuple[Edge, ...]
    """Of the pose graph, without what comparing the submap that was sealed last will add."""
    motion: ConstantVelocity
    delay: DepthDelay
    reference: int
    """Submap that frames are tracked against until the new one is optimised."""
    T_map_reference: Pose
    exposure: Exposure
    """As the new submap shows what the reference shows."""
    next_id: int
    """Of Gaussians."""
    generator: UInt8[Tensor, " bytes"] = field(repr=False)
    """State of the one random generator."""
    exact: bool = True
    """Nothing was under way; false in a live system, which does not wait for what it is finding out. One that is not
    exact tells the path so far, and nobody can go on from it."""


_KINDS: Final[tuple[tuple[bool, Verdict], ...]] = ((False, ""), (True, ""), (True, "believed"), (True, "rejected"))
"""Whether an edge closes a loop, and what was said of it."""


def _kind(edge: Edge) -> int:
    return _KINDS.index((edge.loop, edge.verdict))


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Put a checkpoint on disk, all of it or nothing."""
    c, motion = checkpoint, checkpoint.motion
    archive.write_arrays(
        path,
        "checkpoint",
        {
            **trajectory_arrays(c.trajectory, c.atlas),
            "now": np.array([c.frame_index, c.sealed, c.reference, c.next_id], np.int64),
            "T_map_reference": c.T_map_reference.numpy(),
            "reference_exposure": np.array(astuple(c.exposure)),
            "generator": c.generator.numpy(),
            "edge": np.array([(e.source, e.target, _kind(e)) for e in c.edges], np.int64).reshape(-1, 3),
            "edge_pose": np.array([e.T_target_source.numpy() for e in c.edges]).reshape(-1, 4, 4),
            "edge_information": np.array([e.information for e in c.edges]).reshape(-1, 6, 6),
            "motion_pose": motion.T_map_cam.numpy(),
            "motion": np.array([np.nan if motion.timestamp is None else motion.timestamp, motion.lost]),
            "velocity": torch.stack((motion.velocity, motion.before)).numpy(),
            **{f"delay.{f.name}": np.array(getattr(c.delay, f.name)) for f in fields(DepthDelay)},
        },
    )


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint back, every bit as it was.

    Raises:
        ArchiveError: if the file is missing, damaged or of another version.
    """
    arrays = archive.read_arrays(path, "checkpoint")
    try:
        trajectory, atlas = trajectory_of(arrays)
        frame_index, sealed, reference, next_id = arrays["now"].tolist()
        timestamp, lost = arrays["motion"].tolist()
        velocity, before = torch.from_numpy(arrays["velocity"]).unbind()
        edges = zip(arrays["edge"].tolist(), arrays["edge_pose"], arrays["edge_information"], strict=True)
        columns = {f.name: arrays[f"delay.{f.name}"] for f in fields(DepthDelay)}
        delay: dict[str, Any] = {name: value if value.ndim else value.item() for name, value in columns.items()}
        return Checkpoint(
            frame_index=frame_index,
            sealed=sealed,
            trajectory=trajectory,
            atlas=atlas,
            edges=tuple(Edge(s, t, torch.from_numpy(T), info, *_KINDS[kind]) for (s, t, kind), T, info in edges),
            motion=ConstantVelocity(
                torch.from_numpy(arrays["motion_pose"]),
                None if np.isnan(timestamp) else timestamp,
                velocity,
                before,
                bool(lost),
            ),
            delay=DepthDelay(**delay),
            reference=reference,
            T_map_reference=torch.from_numpy(arrays["T_map_reference"]),
            exposure=Exposure(*arrays["reference_exposure"].tolist()),
            next_id=next_id,
            generator=torch.from_numpy(arrays["generator"]),
        )
    except KeyError as error:
        raise ArchiveError(f"{path} lacks the entry {error}; run again with --overwrite") from error
