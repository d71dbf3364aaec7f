"""How submaps stand to each other: the edges of the pose graph."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64

from tcgsplat.geometry import se3
from tcgsplat.tensors import Pose

Verdict = Literal["", "believed", "rejected"]


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
    verdict: Verdict = ""
    """Of a loop edge: whether it is believed for good; empty as long as each solution judges it anew."""

    @property
    def judged(self) -> bool:
        """Whether a solution of the pose graph says if it is believed."""
        return self.loop and not self.verdict


def odometry(source: int, target: int, T_target_source: Pose) -> Edge:
    """The edge from a submap to the one where its first frame was tracked.

    Its spread grows with the way between the two: 3 mm and 1 % of it, 1.5 mrad and 0.5 % of the turn. For 50 cm that is
    8 mm an axis; measured were 1 mm with a Kinect's noise, and 4 to 6 on real data (motion capture's errors in it).
    """
    way, turn = se3.translation_norm(T_target_source), se3.rotation_angle(T_target_source)
    spread = np.array([0.003 + 0.01 * way] * 3 + [0.0015 + 0.005 * turn] * 3)
    return Edge(source, target, T_target_source, np.diag(1 / spread**2), loop=False)
