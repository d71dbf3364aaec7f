"""How submaps stand to each other: the edges of the pose graph."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from tcgsplat.geometry import se3
from tcgsplat.tensors import Pose


@dataclass(frozen=True, eq=False)
class Edge:
    """How one submap stands to another."""

    source: int
    target: int
    T_target_source: Pose
    information: Float64[np.ndarray, "6 6"]
    """Inverse covariance of xi, translation first (metres, radians), where T_target_source exp(xi) is the truth."""
    loop: bool
    """It may be wrong, as an edge of the odometry may not."""


def odometry(source: int, target: int, T_target_source: Pose) -> Edge:
    """The edge from a submap to the one where its first frame was tracked.

    Its spread grows with the way between the two: 3 mm and 1 % of it, 1.5 mrad and 0.5 % of the turn. Errors of
    tracking on synthetic data with a Kinect's noise are below that, by a half as a rule.
    """
    way, turn = se3.translation_norm(T_target_source), se3.rotation_angle(T_target_source)
    spread = np.array([0.003 + 0.01 * way] * 3 + [0.0015 + 0.005 * turn] * 3)
    return Edge(source, target, T_target_source, np.diag(1 / spread**2), loop=False)
