"""Absolute trajectory error: by hand, under any rigid motion, and against evo."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tcgsplat.errors import EvaluationError
from tcgsplat.evaluation import ate


def path(n: int = 200, seed: int = 0) -> np.ndarray:
    return np.cumsum(np.random.default_rng(seed).normal(0.0, 0.05, (n, 3)), axis=0)


def moved(positions: np.ndarray, scale: float = 1.0) -> np.ndarray:
    R = Rotation.from_rotvec([0.3, -1.9, 0.7]).as_matrix()
    return scale * positions @ R.T + np.array([3.0, -2.0, 0.5])


def test_by_hand() -> None:
    truth = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 2, 0], [0, -2, 0]])
    estimated = truth + np.array([[0.0, 0, 0.1], [0, 0, 0.1], [0, 0, -0.1], [0, 0, -0.1]])
    np.testing.assert_allclose(ate.errors(estimated, truth), 0.1, rtol=0, atol=1e-12)
    assert ate.ate_rmse(estimated, truth) == pytest.approx(0.1)


def test_rigid_motion_costs_nothing_and_scale_does() -> None:
    truth = path()
    assert ate.ate_rmse(moved(truth), truth) < 1e-12
    alignment = ate.align(moved(truth, scale=0.9), truth, with_scale=True)
    assert alignment.scale == pytest.approx(1 / 0.9)
    assert ate.ate_rmse(moved(truth, scale=0.9), truth, with_scale=True) < 1e-12
    assert ate.ate_rmse(moved(truth, scale=0.9), truth) > 0.01


def test_a_mirrored_path_is_not_aligned_by_mirroring() -> None:
    truth = path()
    alignment = ate.align(truth * np.array([1.0, 1.0, -1.0]), truth)
    assert np.linalg.det(alignment.rotation) == pytest.approx(1.0)
    assert ate.ate_rmse(truth * np.array([1.0, 1.0, -1.0]), truth) > 0.05


def test_straight_and_flat_paths() -> None:
    line = np.linspace(0.0, 1.0, 50)[:, None] * np.array([[1.0, 2.0, 3.0]])
    assert ate.ate_rmse(moved(line), line) < 1e-12
    flat = path() * np.array([1.0, 1.0, 0.0])
    assert ate.ate_rmse(moved(flat), flat) < 1e-12


@pytest.mark.parametrize("with_scale", [False, True])
def test_agrees_with_evo(with_scale: bool) -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    trajectory = pytest.importorskip("evo.core.trajectory")
    truth = path(500)
    estimated = moved(truth, scale=1.07) + np.random.default_rng(1).normal(0.0, 0.02, truth.shape)
    no_turn = np.tile([1.0, 0.0, 0.0, 0.0], (len(truth), 1))
    stamps = np.arange(len(truth)) / 30.0
    reference = trajectory.PoseTrajectory3D(truth, no_turn, stamps)
    aligned = trajectory.PoseTrajectory3D(estimated.copy(), no_turn, stamps)
    aligned.align(reference, correct_scale=with_scale)
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data((reference, aligned))
    expected = error.get_statistic(metrics.StatisticsType.rmse)
    assert ate.ate_rmse(estimated, truth, with_scale=with_scale) == pytest.approx(expected, abs=1e-6)

    poses = torch.eye(4, dtype=torch.float64).repeat(2, len(truth), 1, 1)
    poses[0, :, :3, 3], poses[1, :, :3, 3] = torch.from_numpy(estimated), torch.from_numpy(truth)
    of_poses = ate.ate_rmse_of_poses(list(poses[0]), list(poses[1]), with_scale=with_scale)
    assert of_poses == pytest.approx(expected, abs=1e-6)


def test_two_poses_are_too_few() -> None:
    with pytest.raises(EvaluationError, match="only 2 poses have a true counterpart"):
        ate.ate_rmse(path(2), path(2))
