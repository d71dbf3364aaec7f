"""The pose graph against sums by hand: what is believed, what moves, and what stays bit by bit."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tcgsplat.geometry import se3
from tcgsplat.loop import pose_graph
from tcgsplat.loop.edge import Edge
from tcgsplat.loop.pose_graph import solved
from tcgsplat.tensors import Pose

NODES = 9
STEP = 0.04 / np.sqrt(NODES - 1)
"""Of each step of the chain, metres: 4 cm from end to end."""
FIRM = 0.005
"""Of a loop edge, metres."""


def information(metres: float, radians: float) -> np.ndarray:
    return np.diag([metres**-2.0] * 3 + [radians**-2.0] * 3)


def shift(x: float, y: float = 0.0) -> Pose:
    return se3.exp(torch.tensor([x, y, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))


def chain(nodes: int = NODES) -> tuple[list[Pose], list[Edge]]:
    """Submaps a metre apart on a line, 4 cm sure of where the last is and hardly turning."""
    poses = [shift(float(k)) for k in range(nodes)]
    return poses, [Edge(k + 1, k, shift(1.0), information(STEP, 1e-4), loop=False) for k in range(nodes - 1)]


def loop(off: Tensor | None = None, source: int = NODES - 1, target: int = 0) -> Edge:
    """An edge that is off by a tangent from where the line has its ends."""
    off = torch.zeros(6, dtype=torch.float64) if off is None else off
    truth = shift(float(source - target))
    return Edge(source, target, truth @ se3.exp(off), information(FIRM, 0.002), loop=True)


def off(x: float = 0.0, y: float = 0.0) -> Tensor:
    return torch.tensor([x, y, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)


def random_pose(rng: np.random.Generator, metres: float, radians: float) -> Pose:
    return se3.exp(torch.from_numpy(np.concatenate((rng.normal(0, metres, 3), rng.normal(0, radians, 3)))))


def random_graph(seed: int, nodes: int, loops: int, false: int) -> tuple[list[Pose], list[Edge]]:
    """Noisy odometry round a room, and loop edges of which the first few are anything."""
    rng = np.random.default_rng(seed)
    truth = [
        se3.exp(torch.tensor([0, 0, 0, 0, 0, a], dtype=torch.float64)) @ shift(2.0) for a in np.linspace(0, 12, nodes)
    ]
    poses, edges = [truth[0]], []
    for k in range(nodes - 1):
        T = se3.inverse(truth[k]) @ truth[k + 1] @ random_pose(rng, 0.01, 0.004)
        edges.append(Edge(k + 1, k, T, information(0.01, 0.004), loop=False))
        poses.append(se3.orthonormalized(poses[-1] @ T))
    for k in range(loops):
        target, source = sorted(rng.choice(nodes, 2, replace=False).tolist())
        noise = random_pose(rng, 1.0, 0.5) if k < false else random_pose(rng, 0.006, 0.003)
        T = se3.inverse(truth[target]) @ truth[source] @ noise
        edges.append(Edge(source, target, T, information(0.006, 0.003), loop=True))
    return poses, edges


def chi2(poses: list[Pose] | tuple[Pose, ...], edge: Edge) -> float:
    """By our own logarithm."""
    T = se3.inverse(poses[edge.target]) @ poses[edge.source]
    xi = se3.log(se3.inverse(edge.T_target_source) @ T).numpy()
    return float(xi @ edge.information @ xi)


def same_bits(a: Pose, b: Pose) -> bool:
    return a.numpy().tobytes() == b.numpy().tobytes()


def test_chi2_is_that_of_our_tangents_in_our_order() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6)) * np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0])
    poses = [random_pose(rng, 1.0, 1.0), random_pose(rng, 1.0, 1.0)]
    measured = se3.inverse(poses[0]) @ poses[1] @ random_pose(rng, 0.1, 0.2)
    edge = Edge(1, 0, measured, root.T @ root + np.eye(6), loop=False)

    assert solved(poses, [edge]).chi2[0] == pytest.approx(chi2(poses, edge), rel=1e-9)


def test_the_poses_are_the_best_by_our_own_sum() -> None:
    poses, edges = random_graph(0, nodes=8, loops=6, false=0)
    solution = solved(poses, edges, inlier_probability=1 - 1e-9)
    assert solution.rejected == ()
    least = sum(chi2(solution.T_world_map, edge) for edge in edges)
    assert least == pytest.approx(sum(solution.chi2), rel=1e-9)
    assert least < 0.5 * sum(chi2(poses, edge) for edge in edges)
    for node in range(1, len(poses)):
        for direction in torch.eye(6, dtype=torch.float64):
            for sign in (-1e-5, 1e-5):
                moved = list(solution.T_world_map)
                moved[node] = moved[node] @ se3.exp(sign * direction)
                assert sum(chi2(moved, edge) for edge in edges) > least


def test_a_false_loop_stiffer_than_its_chain_is_rejected() -> None:
    poses, edges = chain()
    solution = solved(poses, [*edges, loop(off(y=0.4))])
    assert solution.rejected == (len(edges),)
    assert all(same_bits(a, b) for a, b in zip(solution.T_world_map, poses, strict=True))
    assert solution.chi2[-1] == pytest.approx((0.4 / FIRM) ** 2)


def test_a_true_loop_moves_the_chain_by_its_share() -> None:
    poses, edges = chain()
    solution = solved(poses, [*edges, loop(off(x=0.08))])
    assert solution.rejected == ()
    # The residual is shared by variances: the chain's takes nearly all, and each step as much as every other.
    moved = [float(after[0, 3] - before[0, 3]) for after, before in zip(solution.T_world_map, poses, strict=True)]
    share = 0.08 * 0.04**2 / (0.04**2 + FIRM**2)
    np.testing.assert_allclose(moved, np.linspace(0.0, share, NODES), atol=1e-9)
    assert sum(solution.chi2) == pytest.approx(0.08**2 / (0.04**2 + FIRM**2))


@pytest.mark.parametrize(("count", "believed"), [(1, False), (3, False), (4, True), (6, True)])
def test_loops_that_agree_outweigh_a_drift_larger_than_the_odometry_says(count: int, believed: bool) -> None:
    # Eight standard deviations: chi2 64, against 16.8 for each loop that is not believed.
    poses, edges = chain()
    solution = solved(poses, [*edges, *[loop(off(y=0.32)) for _ in range(count)]])
    assert (solution.rejected == ()) is believed


def test_loops_of_a_room_that_looks_alike_are_rejected_and_true_ones_kept() -> None:
    poses, edges = chain()
    alike = [loop(off(y=4.0), source, target) for source in (7, 8) for target in (0, 1, 2)]
    true = [loop(off(y=0.03), source=6, target=0), loop(off(y=0.03), source=7, target=1)]
    solution = solved(poses, [*edges, *alike[:3], *true, *alike[3:]])
    assert set(solution.rejected) == set(range(len(edges), len(edges) + 8)) - {len(edges) + 3, len(edges) + 4}


def test_true_loops_against_a_large_drift_are_told_from_a_room_that_looks_alike() -> None:
    poses, edges = chain()
    edges += [loop(off(y=0.32)) for _ in range(5)] + [loop(off(y=-4.0), source=5) for _ in range(4)]
    assert solved(poses, edges).rejected == tuple(range(len(edges) - 4, len(edges)))


def test_a_false_loop_that_fits_best_at_first_gives_way_to_many() -> None:
    poses, edges = chain()
    edges += [loop(off(y=0.01)), *[loop(off(y=0.14)) for _ in range(3)]]
    assert solved(poses, edges).rejected == (len(edges) - 4,)


def test_scattered_false_loops_are_rejected() -> None:
    poses, edges = random_graph(1, nodes=30, loops=30, false=12)
    assert solved(poses, edges).rejected == tuple(range(29, 29 + 12))


@pytest.mark.parametrize("seed", range(8))
def test_hardly_any_choice_costs_less(seed: int) -> None:
    poses, edges = random_graph(seed, nodes=8, loops=6, false=3)
    limit = 16.811893829770927
    graph = pose_graph._Graph.of(poses, edges)
    choices = [frozenset(k for k in range(6) if n >> k & 1) for n in range(64)]
    cost = {choice: graph.optimum(choice).chi2 + limit * (6 - len(choice)) for choice in choices}
    rejected = solved(poses, edges).rejected
    believed = frozenset(k for k in range(6) if 7 + k not in rejected)
    assert cost[believed] <= min(cost.values()) + 1e-6


def test_without_loop_edges_the_poses_come_back_though_they_do_not_fit() -> None:
    poses, edges = chain()
    poses[3] = shift(3.5, 0.5)
    solution = solved(poses, edges)
    assert all(a is b for a, b in zip(solution.T_world_map, poses, strict=True))
    assert solution.rejected == ()
    assert max(solution.chi2) > 100.0


def test_no_edges_and_no_nodes() -> None:
    assert solved([], []).T_world_map == ()
    lonely = solved([shift(3.0)], [])
    assert same_bits(lonely.T_world_map[0], shift(3.0))


def test_what_is_held_is_held_bit_by_bit() -> None:
    rng = np.random.default_rng(3)
    somewhere = random_pose(rng, 3.0, 2.0)
    poses, edges = chain()
    poses = [somewhere @ T for T in poses]
    # An island, and behind it another chain of its own.
    apart = [random_pose(rng, 3.0, 2.0), *[somewhere @ shift(float(k), 5.0) for k in range(4)]]
    first = NODES + 1
    more = [Edge(first + k + 1, first + k, shift(1.0), information(STEP, 1e-4), loop=False) for k in range(3)]
    closing = Edge(first, first + 3, shift(-3.01), information(FIRM, 0.002), loop=True)
    solution = solved([*poses, *apart], [*edges, loop(off(x=0.05)), *more, closing])
    assert solution.rejected == ()
    for node, T in enumerate((*poses, *apart)):
        assert same_bits(solution.T_world_map[node], T) is (node in (0, NODES, first))


def test_a_loop_that_alone_joins_two_parts_is_believed_and_a_minority_is_not() -> None:
    poses, edges = chain()
    cut = [edge for edge in edges if edge.target != 4]
    given = [*poses[:5], *[shift(2.0, 3.0) @ T for T in poses[5:]]]
    alone = solved(given, [*cut, loop()])
    assert alone.rejected == ()
    for after, truth in zip(alone.T_world_map, poses, strict=True):
        torch.testing.assert_close(after, truth, atol=1e-4, rtol=0)
    three = solved(given, [*cut, loop(), loop(off(y=1.0), target=1), loop(source=7, target=2)])
    assert three.rejected == (len(cut) + 1,)


@pytest.mark.parametrize("metres", [1e-2, 1e-4, 1e-6])
def test_an_edge_may_be_far_firmer_than_the_rest(metres: float) -> None:
    poses, edges = chain()
    firm = Edge(NODES - 1, 0, shift(8.5), information(metres, metres), loop=True)
    weak = [Edge(edge.source, edge.target, edge.T_target_source, information(1.0, 1.0), loop=False) for edge in edges]
    for odometry in (weak, [edge for edge in edges if edge.target != 4]):
        solution = solved(poses, [*odometry, firm])
        assert solution.rejected == ()
        torch.testing.assert_close(solution.T_world_map[-1], shift(8.5), atol=1e-4, rtol=0)


def test_poses_that_are_the_best_already_keep_their_bits() -> None:
    poses, edges = random_graph(2, nodes=20, loops=15, false=3)
    once = solved(poses, edges)
    twice = solved(once.T_world_map, edges)
    assert twice.rejected == once.rejected
    assert all(same_bits(a, b) for a, b in zip(once.T_world_map, twice.T_world_map, strict=True))


def test_poses_stay_rigid_and_double() -> None:
    poses, edges = random_graph(4, nodes=20, loops=20, false=2)
    for T in solved(poses, edges).T_world_map:
        assert T.dtype == torch.float64
        torch.testing.assert_close(T[:3, :3] @ T[:3, :3].T, torch.eye(3, dtype=torch.float64), atol=1e-14, rtol=0)
        assert same_bits(T[3], torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64))


PROGRAM = """
import sys
sys.path.insert(0, sys.argv[1])
import torch
torch.set_num_threads(int(sys.argv[2]))
import test_pose_graph
sys.stdout.write(test_pose_graph.fingerprint())
"""


def fingerprint() -> str:
    solution = solved(*random_graph(5, nodes=60, loops=80, false=10))
    return torch.stack(solution.T_world_map).numpy().tobytes().hex() + str(solution.rejected) + str(solution.chi2)


def test_the_same_graph_gives_the_same_bits_whatever_the_process_and_its_threads() -> None:
    here = fingerprint()
    assert all(fingerprint() == here for _ in range(3))
    for threads in ("1", "2"):
        command = [sys.executable, "-c", PROGRAM, str(Path(__file__).parent), threads]
        assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == here


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda omega: omega - 2.0 * omega[0, 0] * np.eye(6), "positive definite"),
        (lambda omega: np.where(np.eye(6) > 0, omega, np.triu(np.ones((6, 6)), 1)), "symmetric"),
        (lambda omega: 0.0 * omega, "positive definite"),
        (lambda omega: np.nan * omega, "not finite"),
        (lambda omega: omega + np.inf, "not finite"),
    ],
)
def test_information_that_is_none_is_refused(change: object, reason: str) -> None:
    poses, edges = chain()
    bad = Edge(8, 0, shift(8.0), change(information(FIRM, FIRM)), loop=True)  # type: ignore[operator]
    with pytest.raises(ValueError, match=reason):
        solved(poses, [*edges, bad])


@pytest.mark.parametrize(("source", "target"), [(9, 0), (0, 9), (-1, 0), (3, 3)])
def test_an_edge_joins_two_nodes_that_are_there(source: int, target: int) -> None:
    poses, edges = chain()
    with pytest.raises(ValueError, match=f"edge 8 .* from submap {source} to {target}, does not join"):
        solved(poses, [*edges, Edge(source, target, shift(1.0), information(FIRM, FIRM), loop=True)])


def test_a_pose_that_is_not_finite_is_refused() -> None:
    poses, edges = chain()
    with pytest.raises(ValueError, match="leave out an edge whose registration failed"):
        solved(poses, [*edges, Edge(8, 0, shift(float("nan")), information(FIRM, FIRM), loop=True)])


@pytest.mark.parametrize("metres", [1e-150, 1e-12, 1e12])
def test_an_optimiser_that_fails_moves_nothing_and_says_nothing(
    metres: float, capfd: pytest.CaptureFixture[str]
) -> None:
    poses, edges = chain()
    absurd = [Edge(e.source, e.target, shift(1.0, 1e6), information(metres, 1e-9), loop=False) for e in edges]
    solution = solved(poses, [*absurd, loop()])
    assert solution.rejected == (len(edges),)
    assert capfd.readouterr() == ("", "")
