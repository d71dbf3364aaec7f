"""Learning how late the depth images are."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_room import RoomSequence

from tcgsplat.config import SlamConfig, with_settings
from tcgsplat.geometry import se3
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.slam import Slam
from tcgsplat.tensors import Pose
from tcgsplat.tracking.alignment import Equations
from tcgsplat.tracking.delay import DepthDelay


def information(rng: np.random.Generator) -> np.ndarray:
    J = rng.normal(size=(40, 6))
    return 1e5 * J.T @ J


def observed(
    delay: float, noise: float, frames: int, *, applied: float = 0.0, start: DepthDelay | None = None
) -> DepthDelay:
    """From frames whose two solutions differ by the delay and by noise."""
    rng, known = np.random.default_rng(5), start or DepthDelay()
    for _ in range(frames):
        velocity = rng.normal(size=6) * 0.3
        x_color = 1e-3 * rng.normal(size=6)
        x_depth = x_color - velocity * (delay - applied) + noise * rng.normal(size=6)
        H_color, H_depth = information(rng), information(rng)
        known = known.observed(
            velocity, velocity * applied, Equations(H_color, -H_color @ x_color), Equations(H_depth, -H_depth @ x_depth)
        )
    return known


@pytest.mark.parametrize("delay", [-0.015, 0.0, 0.02])
def test_the_delay_is_found(delay: float) -> None:
    assert observed(delay, 1e-4, 50).seconds == pytest.approx(delay, abs=1e-3)


def test_what_was_applied_already_counts() -> None:
    assert observed(0.02, 1e-4, 50, applied=0.015).seconds == pytest.approx(0.02, abs=1e-3)


def test_few_noisy_frames_move_it_little() -> None:
    """A disagreement of 1 cm that velocity does not explain: what little it seems to say is not believed."""
    known = observed(0.02, 1e-2, 5)
    assert abs(known.seconds) < 0.5 * abs(known.evidence / known.information)
    assert observed(0.02, 1e-2, 2000).seconds == pytest.approx(0.02, abs=2e-3)


def test_before_anything_is_seen_there_is_none() -> None:
    assert DepthDelay().seconds == 0.0
    still = DepthDelay().observed(
        np.zeros(6), np.zeros(6), Equations(np.eye(6), np.ones(6)), Equations(np.eye(6), np.zeros(6))
    )
    assert still.seconds == 0.0


def test_what_one_image_leaves_open_says_nothing() -> None:
    """Depth that sees a flat wall knows one translation and two rotations; its wild answer for the rest is ignored."""
    H_wall = np.diag([0.0, 0.0, 1e6, 1e6, 1e6, 0.0])
    H_color = 1e6 * np.eye(6)
    known = DepthDelay()
    for k in range(60):
        velocity = (-1) ** k * np.array([1.0, 0.0, 0.5, 0.0, 0.0, 0.0])
        g_depth = H_wall @ (velocity * 0.02)  # along the wall: zero, whatever the delay
        known = known.observed(velocity, np.zeros(6), Equations(H_color, np.zeros(6)), Equations(H_wall, g_depth))
    assert known.seconds == pytest.approx(0.02, abs=1e-3)


def test_not_a_number_is_not_learnt_from() -> None:
    once = observed(0.01, 1e-4, 5)
    nothing = Equations(np.eye(6), np.full(6, np.nan))
    assert once.observed(np.ones(6), np.zeros(6), nothing, nothing) is once


def test_a_late_sensor_is_found_out_by_slam(rasterizer: Rasterizer) -> None:
    """The room, its depth images 15 ms behind their stamps, seen by a camera that swings to and fro."""
    seconds = np.arange(60) / 30

    def T_world_cam(t: float) -> Pose:
        swing = np.array([0.06 * np.sin(5 * t), 0.03 * np.sin(7 * t), 0, 0.05 * np.sin(6 * t), 0.08 * np.sin(4 * t), 0])
        return se3.exp(torch.from_numpy(swing))

    late = 0.015
    sequence = RoomSequence(tuple(T_world_cam(t) for t in seconds))
    behind = RoomSequence(tuple(T_world_cam(t + late) for t in seconds))
    settings = {"mapper.iterations": 2, "mapper.first_iterations": 4, "mapper.seeding.spacing": 1}
    found = {}
    for synchronization in ("learnt", "stamps"):
        slam = Slam(with_settings(SlamConfig(), {**settings, "tracker.synchronization": synchronization}), rasterizer)
        for index in range(len(sequence)):
            frame = replace(sequence.frame(index), depth=behind.frame(index).depth)
            assert not slam.step(frame).tracked.lost
        found[synchronization] = slam.delay.seconds
    assert found["stamps"] == 0.0
    assert 0.01 < found["learnt"] < 0.02
