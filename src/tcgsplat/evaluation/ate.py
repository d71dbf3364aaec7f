"""Absolute trajectory error: the distance of camera centres after the best alignment (Umeyama 1991).

The error measure of the TUM RGB-D benchmark: align the estimated positions to the true ones by least squares, then
take the root of the mean squared distance. Orientations do not enter.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tcgsplat.errors import EvaluationError
from tcgsplat.tensors import Pose

Positions = Float[np.ndarray, "n 3"]


@dataclass(frozen=True)
class Alignment:
    """`scale * rotation @ p + translation` takes an estimated position p to the frame of the truth."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    """Metres."""
    scale: float = 1.0

    def apply(self, positions: Positions) -> Positions:
        """Estimated positions in the frame of the truth, metres."""
        return np.asarray(self.scale * positions @ self.rotation.T + self.translation)


def align(estimated: Positions, truth: Positions, *, with_scale: bool = False) -> Alignment:
    """The rigid motion (or similarity) that brings estimated positions nearest to true ones, by least squares.

    Args:
        estimated: Metres, row i belongs to row i of `truth`.
        truth: Metres.
        with_scale: Also fit the scale, as for monocular systems; RGB-D has none to fit.

    Raises:
        EvaluationError: if there are fewer than three pairs: any two trajectories of two poses nearly agree.
    """
    if len(estimated) < 3:
        raise EvaluationError(f"only {len(estimated)} poses have a true counterpart; at least 3 are needed to align")
    mean_e, mean_t = estimated.mean(axis=0), truth.mean(axis=0)
    centred_e, centred_t = estimated - mean_e, truth - mean_t
    U, singular, Vt = np.linalg.svd(centred_t.T @ centred_e)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])  # a reflection would fit noise better, and be wrong
    rotation = (U * signs) @ Vt
    spread = float(np.square(centred_e).sum())
    scale = float(singular @ signs) / spread if with_scale and spread > 0 else 1.0
    return Alignment(rotation, mean_t - scale * rotation @ mean_e, scale)


def errors(estimated: Positions, truth: Positions, *, with_scale: bool = False) -> Float[np.ndarray, " n"]:
    """Distance of each aligned position from the true one, metres.

    Raises:
        EvaluationError: if there are fewer than three pairs.
    """
    aligned = align(estimated, truth, with_scale=with_scale).apply(estimated)
    return np.asarray(np.linalg.norm(aligned - truth, axis=1))


def ate_rmse(estimated: Positions, truth: Positions, *, with_scale: bool = False) -> float:
    """Root of the mean squared distance after alignment, metres.

    Raises:
        EvaluationError: if there are fewer than three pairs.
    """
    return float(np.sqrt(np.square(errors(estimated, truth, with_scale=with_scale)).mean()))


def positions(T_world_cam: Sequence[Pose]) -> Positions:
    """Camera centres of poses, metres, in their world frame."""
    return np.array([T[:3, 3].tolist() for T in T_world_cam], dtype=np.float64).reshape(-1, 3)


def ate_rmse_of_poses(estimated: Sequence[Pose], truth: Sequence[Pose], *, with_scale: bool = False) -> float:
    """`ate_rmse` of the camera centres of two lists of `T_world_cam`, metres.

    Raises:
        EvaluationError: if there are fewer than three pairs.
    """
    return ate_rmse(positions(estimated), positions(truth), with_scale=with_scale)
