"""What holds for every pose graph: no frame and no order is special, and closing a circle spreads its error."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tcgsplat.geometry import se3
from tcgsplat.loop.edge import Edge
from tcgsplat.loop.pose_graph import solved
from tcgsplat.tensors import Pose

repeatable = settings(deadline=None, derandomize=True, max_examples=30)
seeds = st.integers(0, 2**31)


def information(metres: float, radians: float) -> np.ndarray:
    return np.diag([metres**-2.0] * 3 + [radians**-2.0] * 3)


def random_pose(rng: np.random.Generator, metres: float, radians: float) -> Pose:
    return se3.exp(torch.from_numpy(np.concatenate((rng.normal(0, metres, 3), rng.normal(0, radians, 3)))))


def circle(nodes: int) -> list[Pose]:
    """Submaps on a circle two metres wide, the last where the first is."""
    turn = (torch.tensor([0, 0, 0, 0, 0, a], dtype=torch.float64) for a in np.linspace(0.0, 2 * np.pi, nodes))
    ahead = se3.exp(torch.tensor([2.0, 0, 0, 0, 0, 0], dtype=torch.float64))
    return [se3.exp(tangent) @ ahead for tangent in turn]


def drifting(
    rng: np.random.Generator, truth: list[Pose], metres: float, radians: float
) -> tuple[list[Pose], list[Edge]]:
    poses, edges = [truth[0]], []
    for k in range(len(truth) - 1):
        T = se3.inverse(truth[k]) @ truth[k + 1] @ random_pose(rng, metres, radians)
        poses.append(poses[-1] @ T)
        edges.append(Edge(k + 1, k, T, information(metres, radians), loop=False))
    return poses, edges


def graph(seed: int) -> tuple[list[Pose], list[Edge]]:
    rng = np.random.default_rng(seed)
    truth = circle(12)
    poses, edges = drifting(rng, truth, 0.02, 0.01)
    for _ in range(8):
        target, source = sorted(rng.choice(12, 2, replace=False).tolist())
        noise = random_pose(rng, 1.0, 0.5) if rng.random() < 0.3 else random_pose(rng, 0.01, 0.005)
        T = se3.inverse(truth[target]) @ truth[source] @ noise
        edges.append(Edge(source, target, T, information(0.01, 0.005), loop=True))
    return poses, edges


def assert_same_poses(a: tuple[Pose, ...], b: tuple[Pose, ...], tolerance: float) -> None:
    for one, other in zip(a, b, strict=True):
        torch.testing.assert_close(one, other, atol=tolerance, rtol=0)


@repeatable
@given(seed=seeds)
def test_moving_all_poses_moves_the_answer_alike(seed: int) -> None:
    poses, edges = graph(seed)
    T_new_world = random_pose(np.random.default_rng(seed), 3.0, 1.0)
    here = solved(poses, edges)
    there = solved([T_new_world @ T for T in poses], edges)
    assert there.rejected == here.rejected
    assert_same_poses(there.T_world_map, tuple(T_new_world @ T for T in here.T_world_map), 1e-6)


@repeatable
@given(seed=seeds)
def test_the_order_of_the_edges_does_not_matter(seed: int) -> None:
    poses, edges = graph(seed)
    order = np.random.default_rng(seed).permutation(len(edges)).tolist()
    straight, shuffled = solved(poses, edges), solved(poses, [edges[k] for k in order])
    assert_same_poses(shuffled.T_world_map, straight.T_world_map, 1e-9)
    assert sorted(order[place] for place in shuffled.rejected) == list(straight.rejected)
    assert [straight.chi2[k] for k in order] == list(shuffled.chi2)


@repeatable
@given(seed=seeds)
def test_where_the_search_starts_does_not_matter(seed: int) -> None:
    poses, edges = graph(seed)
    rng = np.random.default_rng(seed)
    elsewhere = [poses[0], *[T @ random_pose(rng, 0.2, 0.1) for T in poses[1:]]]
    a, b = solved(poses, edges), solved(elsewhere, edges)
    assert a.rejected == b.rejected
    assert_same_poses(a.T_world_map, b.T_world_map, 1e-6)


def test_closing_a_circle_leaves_of_the_error_what_a_bridge_leaves_of_a_walk() -> None:
    # A random walk that must return has variance t (1 - t) instead of t: a third in the mean, and less everywhere.
    before, after = [], []
    truth = circle(25)
    closing = Edge(24, 0, se3.inverse(truth[0]) @ truth[24], information(1e-3, 1e-3), loop=True)
    for seed in range(60):
        poses, edges = drifting(np.random.default_rng(seed), truth, 0.02, 1e-4)
        closed = solved(poses, [*edges, closing], inlier_probability=1 - 1e-9)
        assert closed.rejected == ()
        before.append([se3.translation_norm(se3.inverse(a) @ b) ** 2 for a, b in zip(truth, poses, strict=True)])
        after.append(
            [se3.translation_norm(se3.inverse(a) @ b) ** 2 for a, b in zip(truth, closed.T_world_map, strict=True)]
        )
    walk, bridge = np.mean(before, axis=0), np.mean(after, axis=0)
    assert bridge[0] == walk[0] == 0.0
    assert np.all(bridge[1:] < walk[1:])
    assert 0.27 < bridge.mean() / walk.mean() < 0.40
