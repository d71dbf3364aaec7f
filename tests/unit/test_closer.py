"""A long walk's pose graph: what is judged stays little, and what was said of old edges stays."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.loop.closer import JUDGED, LoopCloser
from tcgsplat.loop.edge import Edge, odometry
from tcgsplat.loop.settings import LoopConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.submap import Submap
from tcgsplat.tensors import Pose
from tcgsplat.tracking.settings import TrackerConfig

ROUND = 25
"""Submaps until the camera is back."""
STEP = se3.exp(torch.tensor([0.4, 0.0, 0.3, 0.0, 2 * math.pi / ROUND, 0.0], dtype=torch.float64))
SURE = 0.002
"""Spread of a loop edge, metres and radians."""


def closer(rasterizer: Rasterizer) -> LoopCloser:
    def load(index: int) -> Submap:
        raise AssertionError(f"submap {index} was read")

    return LoopCloser(LoopConfig(), TrackerConfig(), ConfidenceConfig(), rasterizer, load, seed=0)


@pytest.fixture(scope="module")
def walked(rasterizer: Rasterizer) -> tuple[LoopCloser, list[Pose]]:
    """Three rounds, each submap compared with the one before the last and with the place a round ago; some wrongly."""
    g = torch.Generator().manual_seed(1)

    def measured(a: int, b: int, spread: Tensor | float) -> Pose:
        wrong = torch.randn(6, generator=g, dtype=torch.float64) * spread
        return se3.inverse(truth[a]) @ truth[b] @ se3.exp(wrong)

    truth = [se3.identity()]
    for _ in range(3 * ROUND):
        truth.append(truth[-1] @ STEP)
    tracked = torch.tensor([0.004] * 3 + [0.002] * 3, dtype=torch.float64)
    known = closer(rasterizer)
    for i in range(1, len(truth)):
        T = measured(i - 1, i, tracked)
        loops = [Edge(i, j, measured(j, i, SURE), np.eye(6) / SURE**2, loop=True) for j in (i - 2, i - ROUND) if j >= 0]
        if i % 9 == 8:
            loops.append(Edge(i, i // 2, measured(i // 2, i, 0.3), np.eye(6) / SURE**2, loop=True))
        known.edges = (*known.edges, odometry(i, i - 1, T), *loops)
        known.T_world_map = (*known.T_world_map, known.T_world_map[-1] @ T)
        known._solve(move=True)
    return known, truth


def test_only_the_newest_loops_are_judged_anew(walked: tuple[LoopCloser, list[Pose]]) -> None:
    known, _ = walked
    loops = [edge for edge in known.edges if edge.loop]
    assert len(loops) > 2 * JUDGED
    assert [edge.judged for edge in loops] == [False] * (len(loops) - JUDGED) + [True] * JUDGED


def test_wrong_loops_are_rejected_and_the_submaps_stand_right(walked: tuple[LoopCloser, list[Pose]]) -> None:
    known, truth = walked
    wrong = [edge for edge in known.edges if edge.loop and edge.source // 2 == edge.target and edge.source % 9 == 8]
    assert len(wrong) == 8 and set(wrong) <= set(known.rejected)
    assert len(known.rejected) - len(wrong) < 0.03 * len([edge for edge in known.edges if edge.loop])
    off = [float((se3.inverse(T) @ found)[:3, 3].norm()) for T, found in zip(truth, known.T_world_map, strict=True)]
    assert max(off) < 0.03


def test_what_was_said_is_said_again_from_the_edges_alone(
    walked: tuple[LoopCloser, list[Pose]], rasterizer: Rasterizer
) -> None:
    known, _ = walked
    again = closer(rasterizer)
    again.T_world_map, again.edges = known.T_world_map, known.edges
    again._solve(move=False)
    assert again.rejected == known.rejected
    assert again.edges == known.edges
