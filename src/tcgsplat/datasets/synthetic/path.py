"""The hand-held camera's way past given points, and the way of the person who walks about."""

from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

Array = np.ndarray[Any, np.dtype[Any]]

_METRES_PER_DEGREE = 0.02 / 1.5
"""What makes turning and moving comparable: how fast one may do either before pictures get hard to follow."""
_RAMP = 0.03
"""Part of the time in which the camera gets going, and in which it comes to rest."""


def camera_poses(waypoints: Array, progress: Array, seconds: Array, seed: int) -> Array:
    """Poses of the camera along its way.

    Args:
        waypoints: [k, 5] x, y, z (m) and yaw from the x axis towards y, pitch upwards (degrees) that it comes by.
        progress: [n] part of the way in time, 0 to 1; outside it the camera rests.
        seconds: [n] the same instants in seconds, which the shaking of the hand follows.
        seed: Of the shaking.

    Returns:
        `T_world_cam` [n, 4, 4] float64.
    """
    way = _way(waypoints, progress)
    shake = _shake(seconds, seed)
    yaw, pitch, roll = np.radians(way[:, 3] + shake[:, 3]), np.radians(way[:, 4] + shake[:, 4]), np.radians(shake[:, 5])
    zero = np.zeros_like(yaw)
    forward = np.stack((np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)), axis=1)
    level = np.stack((np.sin(yaw), -np.cos(yaw), zero), axis=1)
    under = np.cross(forward, level)
    right = np.cos(roll)[:, None] * level + np.sin(roll)[:, None] * under
    T = np.zeros((len(way), 4, 4))
    T[:, :3, 0], T[:, :3, 1], T[:, :3, 2] = right, np.cross(forward, right), forward
    T[:, :3, 3] = way[:, :3] + shake[:, :3]
    T[:, 3, 3] = 1
    return T


def _way(waypoints: Array, progress: Array) -> Array:
    """Smooth positions (m) and yaw, pitch (degrees) [n, 5], at an even pace of moving and turning together."""
    knots = np.concatenate(([0], np.cumsum(_effort(np.diff(waypoints, axis=0)))))
    spline = CubicSpline(knots, waypoints)
    fine = np.linspace(0, knots[-1], 4001)
    pace = _effort(spline(fine, 1))
    spent = np.concatenate(([0], np.cumsum(0.5 * (pace[1:] + pace[:-1]))))
    # Monotone and smooth, so that the pace has no steps.
    when = PchipInterpolator(spent / spent[-1], fine)
    return np.asarray(spline(when(_eased(np.clip(progress, 0, 1)))))


def _effort(change: Array) -> Array:
    """Size [n] of changes [n, 5] of position and direction: near the larger of both, so that neither gets too fast."""
    moved = np.linalg.norm(change[:, :3], axis=1)
    turned = _METRES_PER_DEGREE * np.linalg.norm(change[:, 3:], axis=1)
    return np.asarray((moved**4 + turned**4) ** 0.25)


def _eased(u: Array) -> Array:
    """Progress along the way at time u: starts and ends at rest, between them at one pace."""
    ramp = _RAMP
    before, after = np.clip(u / ramp, 0, 1), np.clip((1 - u) / ramp, 0, 1)
    # The integral of a smooth step 3 x^2 - 2 x^3 is x^3 - x^4 / 2, a half over the whole ramp.
    lost = ramp * (before - (before**3 - before**4 / 2))
    gained = ramp * (after - (after**3 - after**4 / 2))
    total = 1 - ramp
    return np.asarray((u - lost - (ramp / 2 - gained)) / total)


def _shake(seconds: Array, seed: int) -> Array:
    """Offsets [n, 6] of a hand: metres in x, y, z, degrees of yaw, pitch, roll."""
    rng = np.random.default_rng((seed, 3))
    bands = (  # Hz from, to; metres; degrees
        (0.3, 0.9, 0.0045, 0.32),
        (1.4, 2.0, 0.0012, 0.07),
        (5.0, 9.0, 0.0002, 0.02),
    )
    total = np.zeros((len(seconds), 6))
    for low, high, metres, degrees in bands:
        for _ in range(2):
            rate, phase = rng.uniform(low, high, 6), rng.uniform(0, 2 * np.pi, 6)
            size = np.array([metres] * 3 + [degrees] * 3) * rng.uniform(0.5, 1.0, 6)
            total += size * np.sin(2 * np.pi * rate * seconds[:, None] + phase)
    return total


_STROLL = np.array(
    [
        # progress; x, y in metres
        (0.00, 1.00, 3.05),
        (0.10, 0.95, 2.30),
        (0.20, 1.30, 1.68),
        (0.32, 2.10, 1.00),
        (0.42, 2.95, 0.95),
        (0.55, 3.60, 1.45),
        (0.70, 3.90, 2.30),
        (0.80, 3.55, 2.60),
        (0.88, 2.70, 1.55),
        (0.95, 1.50, 1.60),
        (1.00, 0.90, 2.10),
    ]
)


def person_motion(progress: Array, seconds: Array, rest: tuple[float, float, float]) -> Array:
    """Motion of somebody who strolls about the living room, a little up and down.

    Args:
        progress: [n] part of the way in time, 0 to 1.
        seconds: [n] the same instants in seconds, for the gait.
        rest: Where the person's mesh stands, looking towards -y, in the world, metres.

    Returns:
        [n, 4, 4] float64 from the world as the mesh stands in it to the world at that instant.
    """
    way = CubicSpline(_STROLL[:, 0], _STROLL[:, 1:])
    u = np.clip(progress, 0, 1)
    velocity = way(u, 1)
    yaw = np.arctan2(velocity[:, 1], velocity[:, 0]) + np.pi / 2
    T = np.broadcast_to(np.eye(4), (len(u), 4, 4)).copy()
    T[:, 0, 0] = T[:, 1, 1] = np.cos(yaw)
    T[:, 1, 0], T[:, 0, 1] = np.sin(yaw), -np.sin(yaw)
    T[:, :2, 3] = way(u)
    T[:, 2, 3] = 0.012 * np.abs(np.sin(2 * np.pi * 0.9 * seconds))
    T[:, :3, 3] -= T[:, :3, :3] @ np.asarray(rest)
    return T
