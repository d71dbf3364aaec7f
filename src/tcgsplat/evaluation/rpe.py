"""Relative pose error: what a motion from one pose to a later one is off by (Sturm et al. 2012).

Drift, where the absolute error tells of the whole path; no alignment enters. The errors are those of the evo package:
E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j) for true poses Q and estimated ones P, the length of its translation, and the angle of
its rotation.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from tcgsplat.datasets.association import MAX_GAP, nearest
from tcgsplat.tensors import Pose

Pairs = Int[np.ndarray, "k 2"]
"""Rows (i, j) of a trajectory, i before j."""


@dataclass(frozen=True)
class RelativeError:
    """Roots of the mean squares over some pairs of poses."""

    translation: float
    """Metres."""
    rotation: float
    """Degrees."""


def rpe_rmse(estimated: Sequence[Pose], truth: Sequence[Pose], pairs: Pairs) -> RelativeError:
    """The relative error over pairs of rows.

    Args:
        estimated: `T_world_cam`, row i belongs to row i of `truth`.
        truth: `T_world_cam`, in any other world frame.
        pairs: At least one.
    """
    P, Q = (torch.stack(list(poses)).numpy() for poses in (estimated, truth))
    i, j = pairs.T
    E = np.linalg.solve(np.linalg.solve(Q[i], Q[j]), np.linalg.solve(P[i], P[j]))
    angles = Rotation.from_matrix(E[:, :3, :3]).magnitude()
    squares = np.square(E[:, :3, 3]).sum(axis=1)
    return RelativeError(float(np.sqrt(squares.mean())), float(np.degrees(np.sqrt(np.square(angles).mean()))))


def successive(rows: int) -> Pairs:
    """Each of so many rows with the next one."""
    i = np.arange(max(rows - 1, 0))
    return np.stack((i, i + 1), axis=1)


def apart(times: Float[np.ndarray, " n"], seconds: float) -> Pairs:
    """Each row with the one whose time is nearest to so much later.

    Half the usual interval between rows is the most that it may be off by, or 20 ms where that is more; rows that have
    none are left out.

    Args:
        times: Of the rows, seconds, increasing.
        seconds: Above 0.
    """
    if len(times) < 2:
        return successive(0)
    tolerance = max(MAX_GAP, 0.5 * float(np.median(np.diff(times))))
    j, gap = nearest(times + seconds, times)
    i = np.arange(len(times))
    return np.stack((i, j), axis=1)[(gap <= tolerance) & (j > i)]
