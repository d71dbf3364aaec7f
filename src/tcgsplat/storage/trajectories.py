"""A trajectory and the atlas that it stands in as named arrays: what `trajectory.npz` and a checkpoint hold."""

from collections.abc import Mapping
from dataclasses import astuple

import numpy as np
import torch

from tcgsplat.scene.atlas import Atlas
from tcgsplat.scene.exposure import UNCHANGED, Exposure
from tcgsplat.scene.trajectory import TrackedPose, Trajectory
from tcgsplat.storage.archive import Array
from tcgsplat.tensors import Pose


def trajectory_arrays(trajectory: Trajectory, atlas: Atlas) -> dict[str, Array]:
    """All rows by columns, and the pose of every submap."""
    rows = trajectory.rows
    return {
        "frame_index": np.array([row.frame_index for row in rows], dtype=np.int64),
        "timestamp": np.array([row.timestamp for row in rows], dtype=np.float64),
        "submap_index": np.array([row.submap_index for row in rows], dtype=np.int64),
        "lost": np.array([row.lost for row in rows], dtype=np.bool_),
        "mapped": np.array([row.mapped for row in rows], dtype=np.bool_),
        "exposure": np.array([astuple(row.exposure) for row in rows], dtype=np.float64).reshape(-1, 2),
        "T_map_cam": _stacked([row.T_map_cam for row in rows]),
        "T_world_map": _stacked(list(atlas.T_world_map)),
    }


def trajectory_of(columns: Mapping[str, Array]) -> tuple[Trajectory, Atlas]:
    """What `trajectory_arrays` was given.

    A run of an older tcgsplat does not say which frames it mapped: then no row is `mapped`, while in any other run
    at least the first row of each submap is. One that does not tell exposures took pictures as they came.
    """
    unknown = np.zeros(len(columns["lost"]), np.bool_)
    unchanged = np.tile(astuple(UNCHANGED), (len(unknown), 1))
    rows = tuple(
        TrackedPose(int(frame), float(stamp), int(submap), torch.from_numpy(T), bool(lost), bool(mapped), exposure)
        for frame, stamp, submap, lost, mapped, T, exposure in zip(
            columns["frame_index"],
            columns["timestamp"],
            columns["submap_index"],
            columns["lost"],
            columns.get("mapped", unknown),
            columns["T_map_cam"],
            (Exposure(*pair) for pair in columns.get("exposure", unchanged).tolist()),
            strict=True,
        )
    )
    return Trajectory(rows), Atlas(tuple(torch.from_numpy(T) for T in columns["T_world_map"]))


def _stacked(poses: list[Pose]) -> Array:
    return np.array([T.detach().cpu().numpy() for T in poses], dtype=np.float64).reshape(-1, 4, 4)
