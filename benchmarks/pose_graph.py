"""How long closing a loop takes in the pose graph alone, as a walk goes round and round: `pose_graph.py SUBMAPS`.

Made up: a round of 50 submaps, each with an edge to the one before the last and to the same place a round before; one
in twenty has a false edge too. Prints submaps, loop edges, the seconds of the last solution, and edges rejected; then
how many of the false ones were, and how far the submaps are off.
"""

import math
import sys
import time

import numpy as np
import torch

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.loop.closer import LoopCloser
from tcgsplat.loop.edge import Edge, odometry
from tcgsplat.loop.settings import LoopConfig
from tcgsplat.render.backends import open_rasterizer
from tcgsplat.scene.submap import Submap
from tcgsplat.tensors import Pose
from tcgsplat.tracking.settings import TrackerConfig

ROUND, SURE = 50, 0.002


def main(submaps: int) -> None:
    """Walk, and tell."""
    torch.set_num_threads(1)
    g = torch.Generator().manual_seed(0)
    step = se3.exp(torch.tensor([0.4, 0.0, 0.3, 0.0, 2 * math.pi / ROUND, 0.0], dtype=torch.float64))
    truth = [se3.identity()]
    for _ in range(submaps - 1):
        truth.append(truth[-1] @ step)

    def measured(a: int, b: int, spread: torch.Tensor | float) -> Pose:
        wrong = torch.randn(6, generator=g, dtype=torch.float64) * spread
        return se3.inverse(truth[a]) @ truth[b] @ se3.exp(wrong)

    def loop(i: int, j: int, spread: float) -> Edge:
        return Edge(i, j, measured(j, i, spread), np.eye(6) / SURE**2, loop=True)

    closer = LoopCloser(LoopConfig(), TrackerConfig(), ConfidenceConfig(), open_rasterizer("numba"), unread, seed=0)
    tracked, false = torch.tensor([0.004] * 3 + [0.002] * 3, dtype=torch.float64), set()
    for i in range(1, submaps):
        T = measured(i - 1, i, tracked)
        closer.T_world_map = (*closer.T_world_map, closer.T_world_map[-1] @ T)
        loops = [loop(i, j, SURE) for j in (i - 2, i - ROUND) if j >= 0]
        if i % 20 == 19:
            loops.append(loop(i, i // 2, 0.3))
            false.add((i, i // 2))
        closer.edges = (*closer.edges, odometry(i, i - 1, T), *loops)
        started = time.perf_counter()
        closer._solve(move=True)
        seconds = time.perf_counter() - started
        if i % 100 == 0 or i == submaps - 1:
            closed = sum(edge.loop for edge in closer.edges)
            print(f"{i + 1:>5} {closed:>6} {seconds:>8.3f} s {len(closer.rejected):>5}", flush=True)
    rejected = {(edge.source, edge.target) for edge in closer.rejected}
    off = max(float((se3.inverse(T) @ U)[:3, 3].norm()) for T, U in zip(truth, closer.T_world_map, strict=True))
    told = f"{len(rejected & false)} of {len(false)} false edges rejected, and {len(rejected - false)} right ones"
    print(f"{told}; {100 * off:.1f} cm off at most")


def unread(index: int) -> Submap:
    """No submap is needed."""
    raise AssertionError(f"submap {index} was read")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 240)
