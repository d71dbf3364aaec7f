"""The guess that tracking starts from: the camera keeps the velocity it had, in its own frame."""

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from tcgsplat.geometry import se3
from tcgsplat.tensors import Pose

MAX_GAP = 0.5
"""Seconds of velocity that a guess may use: after a longer gap the old velocity says nothing any more."""


@dataclass(frozen=True)
class ConstantVelocity:
    """Pose and velocity after the last frame."""

    T_map_cam: Pose = field(default_factory=se3.identity)
    timestamp: float | None = None
    """Seconds; None before the first frame."""
    velocity: Float[Tensor, "6"] = field(default_factory=lambda: torch.zeros(6, dtype=torch.float64))
    """Tangent per second, in the camera's own frame, so that it survives a change of map."""
    before: Float[Tensor, "6"] = field(default_factory=lambda: torch.zeros(6, dtype=torch.float64))
    """The velocity one frame earlier."""
    lost: bool = False
    """The pose is a guess: the way from it to the next tracked pose is no motion."""

    @property
    def steady(self) -> Float[Tensor, "6"]:
        """Velocity over the last two frames: half as noisy, where noise would feed back into the next pose."""
        return 0.5 * (self.velocity + self.before)

    def predict(self, timestamp: float) -> Pose:
        """Where the camera should be at `timestamp`, `T_map_cam`."""
        if self.timestamp is None:
            return self.T_map_cam
        elapsed = min(max(timestamp - self.timestamp, 0.0), MAX_GAP)
        return self.T_map_cam @ se3.exp(self.velocity * elapsed)

    def advanced(self, T_map_cam: Pose, timestamp: float) -> "ConstantVelocity":
        """After a frame that was tracked."""
        if self.timestamp is None or timestamp <= self.timestamp or self.lost:
            return ConstantVelocity(T_map_cam, timestamp, self.velocity, self.before)
        step = se3.log(se3.inverse(self.T_map_cam) @ T_map_cam)
        return ConstantVelocity(T_map_cam, timestamp, step / (timestamp - self.timestamp), self.velocity)

    def coasted(self, T_map_cam: Pose, timestamp: float) -> "ConstantVelocity":
        """After a frame that was lost: the guess is kept as the pose, and half of the velocity.

        A blind camera that drifts on at full speed leaves the room; one that slows down stays where it can be found.
        """
        return ConstantVelocity(T_map_cam, timestamp, 0.5 * self.velocity, 0.5 * self.before, lost=True)

    def rebased(self) -> "ConstantVelocity":
        """In a new map whose frame is this camera."""
        return replace(self, T_map_cam=se3.identity())
