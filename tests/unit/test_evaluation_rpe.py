"""Relative pose error: by hand, and beside evo."""

import numpy as np
import pytest
import torch

from tcgsplat.evaluation import ate, rpe
from tcgsplat.evaluation.accuracy import accuracy
from tcgsplat.geometry import se3
from tcgsplat.tensors import Pose

T_OTHER_WORLD = se3.exp(torch.tensor([1.0, 2.0, 3.0, 0.3, -0.2, 0.9], dtype=torch.float64))


def noisy_path(n: int) -> tuple[list[Pose], list[Pose]]:
    """A random walk, and what a system with noise and a scale of its own makes of it in another world."""
    generator = torch.Generator().manual_seed(3)
    steps = torch.randn(2, n, 6, generator=generator, dtype=torch.float64)
    truth, estimated = [se3.identity()], []
    for step in steps[0]:
        truth.append(truth[-1] @ se3.exp(0.05 * step))
    for T, noise in zip(truth, steps[1], strict=False):
        scaled = T.clone()
        scaled[:3, 3] *= 1.03
        estimated.append(T_OTHER_WORLD @ scaled @ se3.exp(0.01 * noise))
    return estimated, truth[:n]


def test_by_hand() -> None:
    truth = [se3.exp(torch.tensor([0.1 * i, 0, 0, 0, 0, 0], dtype=torch.float64)) for i in range(3)]
    turn = se3.exp(torch.tensor([0, 0, 0, 0, 0, 0.02], dtype=torch.float64))
    estimated = [T_OTHER_WORLD @ T for T in (truth[0], truth[1] @ turn, truth[2] @ turn)]
    error = rpe.rpe_rmse(estimated, truth, rpe.successive(3))
    assert error.rotation == pytest.approx(np.degrees(0.02 / np.sqrt(2)))  # one of two steps turns too far
    assert error.translation == pytest.approx(0.1 * 2 * np.sin(0.01) / np.sqrt(2))  # the other goes astray by it


def test_no_motion_of_the_world_counts() -> None:
    _, truth = noisy_path(50)
    error = rpe.rpe_rmse([T_OTHER_WORLD @ T for T in truth], truth, rpe.successive(50))
    assert error.translation < 1e-12 and error.rotation < 1e-6


@pytest.mark.parametrize(("seconds", "frames"), [(None, 1), (1.0, 30)])
def test_agrees_with_evo(seconds: float | None, frames: int) -> None:
    metrics, trajectory = (pytest.importorskip(f"evo.core.{name}") for name in ("metrics", "trajectory"))
    estimated, truth = noisy_path(200)
    times = 1.3e9 + np.arange(200) / 30.0
    pairs = rpe.successive(200) if seconds is None else rpe.apart(times, seconds)
    ours = rpe.rpe_rmse(estimated, truth, pairs)
    paths = [
        trajectory.PoseTrajectory3D(poses_se3=[T.numpy() for T in p], timestamps=times) for p in (truth, estimated)
    ]
    for relation, error in (("translation_part", ours.translation), ("rotation_angle_deg", ours.rotation)):
        metric = metrics.RPE(metrics.PoseRelation[relation], frames, metrics.Unit.frames, all_pairs=True)
        metric.process_data(tuple(paths))
        assert error == pytest.approx(metric.get_statistic(metrics.StatisticsType.rmse), abs=1e-6)
        assert error > 0.01


def test_every_row_agrees_with_evo() -> None:
    """As an evaluation reports them: in centimetres and degrees."""
    metrics, trajectory = (pytest.importorskip(f"evo.core.{name}") for name in ("metrics", "trajectory"))
    estimated, truth = noisy_path(200)
    times = np.arange(200) / 30.0
    rows = accuracy(estimated, truth, times)
    for name, with_scale in (("ate_rmse", False), ("ate_rmse_sim3", True)):
        reference, aligned = (
            trajectory.PoseTrajectory3D(poses_se3=[T.numpy() for T in p], timestamps=times) for p in (truth, estimated)
        )
        aligned.align(reference, correct_scale=with_scale)
        metric = metrics.APE(metrics.PoseRelation.translation_part)
        metric.process_data((reference, aligned))
        expected = 100 * metric.get_statistic(metrics.StatisticsType.rmse)
        assert rows[name].value == pytest.approx(expected, abs=1e-6) and rows[name].unit == "cm"  # type: ignore[union-attr]
    assert rows["ate_rmse_sim3"].value < 0.9 * rows["ate_rmse"].value  # type: ignore[union-attr]
    over_a_second = rpe.rpe_rmse(estimated, truth, rpe.apart(times, 1.0))
    assert rows["rpe_translation_1s"].value == 100 * over_a_second.translation  # type: ignore[union-attr]
    assert rows["rpe_rotation_1s"].value == over_a_second.rotation  # type: ignore[union-attr]
    assert rows["rpe_rotation"].unit == "deg"  # type: ignore[union-attr]
    assert ate.ate_rmse_of_poses(estimated, truth) == pytest.approx(rows["ate_rmse"].value / 100)  # type: ignore[union-attr]


def test_pairs_a_second_apart() -> None:
    times = np.array([0.0, 0.5, 1.01, 1.5, 1.9, 3.0])
    assert rpe.apart(times, 1.0).tolist() == [[0, 2], [1, 3], [2, 4], [4, 5]]
    gap = np.array([0.0, 0.1, 0.2, 0.3, 2.0, 2.1])
    assert rpe.apart(gap, 1.0).tolist() == []
    assert rpe.apart(gap[:1], 1.0).tolist() == rpe.successive(1).tolist() == rpe.successive(0).tolist() == []


def test_what_cannot_be_had_is_told() -> None:
    estimated, truth = noisy_path(10)
    rows = accuracy(estimated, truth, np.arange(10) / 30.0)
    assert rows["rpe_translation_1s"] == rows["rpe_rotation_1s"] == "no two poses are a second apart"
    assert not isinstance(rows["rpe_translation"], str)
    assert set(accuracy(estimated[:2], truth[:2], np.arange(2.0)).values()) == {"only 2 frames have a true pose"}
    assert set(accuracy([], [], np.zeros(0)).values()) == {"no ground truth"}
