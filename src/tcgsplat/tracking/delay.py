"""How long after its time stamp a depth image was really taken: learnt from the motion itself.

The stamps of a depth camera's two images come from drivers, not from shutters, and are off by a constant of several
milliseconds: at hand speed that is millimetres, more than the noise of either image. While the camera moves, the pose
that depth alone asks for then runs ahead of the pose that colour alone asks for, by the velocity times the delay.
"""

from dataclasses import dataclass, field

import numpy as np

from tcgsplat.tracking.alignment import Doubles, Equations

_PRIOR = 0.01
"""Spread of the delay before anything is seen, seconds: a third of a frame at 30 Hz."""
_LARGEST = 0.025
"""Seconds; what seems to be a longer delay is something else. Also, what is moved by the velocity of noisy poses feeds
their noise into the next pose, by the delay over the time between two frames: well below one."""
_LOOSE = 0.05
"""Spread that is assumed of each part of a pose beforehand, metres and radians: keeps what one image leaves open."""
_FORGETTING = 0.1
"""Of the averages, a frame: what is usual is what the map's last two updates saw."""
_ALIKE = 10
"""Frames over which disagreements that the delay does not explain stay alike, as their average does: so many count as
one against the prior."""


@dataclass(frozen=True)
class DepthDelay:
    """What is known of the delay: the sums of a linear regression of disagreement on velocity, with a prior at zero.

    With d the difference of the two poses, the camera moving by T exp(xi dt), and left perturbations of map to camera,
    d = -xi times the delay. A frame's weight is the information that both poses have, S = (H_color^-1 + H_depth^-1)^-1:
    what one of the images leaves open says nothing.
    """

    information: float = 0.0
    """Sum of xi^T S xi."""
    evidence: float = 0.0
    """Sum of -xi^T S d."""
    squares: float = 0.0
    """Sum of d^T S d."""
    frames: int = 0
    usual_velocity: Doubles = field(default_factory=lambda: np.zeros(6))
    """Moving average of xi, which is subtracted from it above."""
    usual_disagreement: Doubles = field(default_factory=lambda: np.zeros(6))
    """Moving average of d, likewise: the map was made while the camera moved, too, and is off by its own delay."""

    @property
    def seconds(self) -> float:
        """The most probable delay.

        How much a disagreement weighs against the prior follows from how large the disagreements are that velocity
        does not explain.
        """
        if self.information <= 0:
            return 0.0
        unexplained = max(self.squares - self.evidence**2 / self.information, 0.0) / (6 * self.frames)
        delay = self.evidence / (self.information + _ALIKE * unexplained / _PRIOR**2)
        return float(np.clip(delay, -_LARGEST, _LARGEST))

    def observed(self, velocity: Doubles, applied: Doubles, color: Equations, depth: Equations) -> "DepthDelay":
        """After one more frame.

        Args:
            velocity: xi, tangent per second in the camera's own frame, [6].
            applied: What the frame's depth was moved by already: velocity times the learnt delay, [6].
            color: Of the colour residuals, at the frame's pose.
            depth: Of the depth residuals, there too.
        """
        prior = np.eye(6) / _LOOSE**2
        H_color, H_depth = color.H + prior, depth.H + prior
        S = H_color @ np.linalg.solve(H_color + H_depth, H_depth)
        disagreement = np.linalg.solve(H_color, color.g) - np.linalg.solve(H_depth, depth.g) - applied
        xi, d = velocity - self.usual_velocity, disagreement - self.usual_disagreement
        if not np.isfinite(S @ d).all():
            return self
        rate = max(_FORGETTING, 1 / (self.frames + 1))
        return DepthDelay(
            self.information + (float(xi @ S @ xi) if self.frames else 0.0),
            self.evidence - (float(xi @ S @ d) if self.frames else 0.0),
            self.squares + (float(d @ S @ d) if self.frames else 0.0),
            self.frames + 1,
            self.usual_velocity + rate * xi,
            self.usual_disagreement + rate * d,
        )
