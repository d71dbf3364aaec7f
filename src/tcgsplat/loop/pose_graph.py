"""Where the submaps stand, from how they stand to each other: odometry holds, and a loop edge may be wrong.

What is minimised is truncated least squares: the chi2 of the odometry, plus that of each loop edge or, where that is
cheaper, the price of not believing it, the chi2 that one right edge in a hundred exceeds. So n edges that agree are
believed against a drift of up to 4.1 sqrt(n) standard deviations of the odometry between their ends, and not beyond.

gtsam finds the poses (Levenberg-Marquardt); which edges to believe is a search over sets of them, from what odometry
alone leads to expect. gtsam's graduated non-convexity lowers the same sum by weights and does not ask at the end what
belief in an edge costs: in 60 random graphs with 30 loop edges it believed 25 of the 801 false ones, and this search 2.
With four or eight loop edges the two are alike. See `solved` for what is asked of the odometry.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import scipy  # its parts when they are used: together they are a tenth of the start-up
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tcgsplat.geometry import se3
from tcgsplat.loop.edge import Edge
from tcgsplat.tensors import Pose

_ROTATION_FIRST = np.array([3, 4, 5, 0, 1, 2])
"""gtsam's order of a tangent, in places of ours."""
_ANCHOR = 1e-3
"""Standard deviation, metres and radians, of what is held. Nothing pulls at the whole, but gtsam takes a far weaker one
for none."""
_LEASH = 100.0
"""Standard deviation, metres and radians, of where a part of the map stands that nothing but loop edges joins."""
_STEPS = 100
"""Of Levenberg-Marquardt; it takes about five."""
_ROUNDS = 5
"""How often the predictions are linearised anew; they mostly agree the second time."""
_FLIPS = 4
"""How often an edge may be believed and doubted again, in the mean; mostly one in ten changes once."""
_SAME = 1e-9
"""Difference in chi2 that is rounding."""

_Table = Float[Tensor, "m m"]
"""Residuals of the n loop edges in their own standard deviations, and the covariance they should have: 6n rows, and a
last row and column for the residuals."""
_Edges = Bool[Tensor, " n"]
"""Some of the loop edges."""


@dataclass(frozen=True, eq=False)
class Solution:
    """What the edges say together."""

    T_world_map: tuple[Pose, ...]
    """One a node."""
    rejected: tuple[int, ...]
    """Places, among the edges given, of the loop edges that were not believed."""
    chi2: tuple[float, ...]
    """Of each edge at these poses, xi^T information xi; six on average for one that is right and has pulled nothing."""


def solved(T_world_map: Sequence[Pose], edges: Sequence[Edge], *, inlier_probability: float = 0.99) -> Solution:
    """Poses that fit the odometry, the loop edges believed for good, and those of the others that deserve belief.

    The lowest node of whatever edges join stays where it is given, bit by bit; so do a node without edges, and every
    node if there is no loop edge, if the poses given are already the best, or if the optimiser fails, which rejects all
    loop edges. A loop edge that alone joins two parts of the map is believed: nothing speaks against it. The order of
    the edges does not matter, and the same input gives the same bits.

    The odometry must not promise too much. Of right loop edges one in a hundred is rejected if its information is true,
    but one in ten if its errors are 1.5 times what it says, and nearly half if they are twice that.

    Args:
        T_world_map: One float64 pose a node; where the search starts.
        edges: Between nodes, which they name by their place in `T_world_map`; none that is rejected for good. The time
            grows with the cube of the number of those that are to be judged.
        inlier_probability: Share of right loop edges that pass when they are judged, in (0, 1).

    Raises:
        ValueError: An edge names a node that is not there or one node twice, holds a number that is not finite, or has
            an information matrix that is not symmetric and positive definite.
    """
    for place, edge in enumerate(edges):
        _check(place, edge, len(T_world_map))
    order = sorted(range(len(edges)), key=lambda place: _name(edges[place]))
    loops = [place for place in order if edges[place].judged]
    graph = _Graph.of(T_world_map, [edges[place] for place in order])
    limit = 2.0 * float(
        scipy.special.gammaincinv(3.0, inlier_probability)
    )  # the quantile of chi2 with six degrees of freedom

    state = graph.given(believed=frozenset())
    poses = tuple(T_world_map)
    if loops:
        try:
            found = _best(graph, limit)
        except RuntimeError:  # gtsam's word for a system without a solution, and torch's
            found = state
        state = graph.given(found.believed)
        if found.chi2 < state.chi2 - _SAME:
            state, poses = found, graph.moved(poses, found)
    chi2 = dict(zip(order, graph.chi2_of_edges(state), strict=True))
    rejected = sorted(place for k, place in enumerate(loops) if k not in state.believed)
    return Solution(poses, tuple(rejected), tuple(chi2[place] for place in range(len(edges))))


def _check(place: int, edge: Edge, nodes: int) -> None:
    what = f"edge {place} of the pose graph, from submap {edge.source} to {edge.target},"
    if edge.source == edge.target or not (0 <= edge.source < nodes and 0 <= edge.target < nodes):
        raise ValueError(f"{what} does not join two of the {nodes} submaps; name two of them by their places")
    if not (torch.isfinite(edge.T_target_source).all() and np.isfinite(edge.information).all()):
        raise ValueError(f"{what} holds numbers that are not finite; leave out an edge whose registration failed")
    asymmetry = np.abs(edge.information - edge.information.T).max()
    if asymmetry > 1e-9 * np.abs(edge.information).max() or np.linalg.eigvalsh(edge.information)[0] <= 0.0:
        raise ValueError(f"{what} needs a symmetric positive definite information matrix; give an inverse covariance")


def _name(edge: Edge) -> tuple[object, ...]:
    """Sorts edges by themselves, wherever they stood."""
    return (edge.source, edge.target, edge.loop, edge.T_target_source.numpy().tobytes(), edge.information.tobytes())


@dataclass(frozen=True, eq=False)
class _State:
    values: gtsam.Values
    believed: frozenset[int]
    """Places among the graph's loop factors."""
    chi2: float
    """Of the odometry and the edges believed."""


@dataclass(frozen=True, eq=False)
class _Graph:
    """The edges as gtsam's factors, in its tangents."""

    start: gtsam.Values
    held: frozenset[int]
    """Nodes that stay: the lowest of each part."""
    anchors: tuple[gtsam.NonlinearFactor, ...]
    """What fixes the gauge of each part, and leashes."""
    odometry: tuple[gtsam.NonlinearFactor, ...]
    loops: tuple[gtsam.NonlinearFactor, ...]
    is_loop: tuple[bool, ...]
    """Of every edge."""

    @classmethod
    def of(cls, T_world_map: Sequence[Pose], edges: Sequence[Edge]) -> "_Graph":
        given = [gtsam.Pose3(T.numpy()) for T in T_world_map]
        start = gtsam.Values()
        for node, pose in enumerate(given):
            start.insert(node, pose)
        whole = _lowest(len(given), edges)
        pieces = _lowest(len(given), [edge for edge in edges if not edge.judged])
        anchor = gtsam.noiseModel.Isotropic.Sigma(6, _ANCHOR)
        anchors: list[gtsam.NonlinearFactor] = [
            gtsam.PriorFactorPose3(node, given[node], anchor) for node in sorted(set(whole))
        ]
        leash = gtsam.noiseModel.Isotropic.Sigma(6, _LEASH)
        for piece in sorted(set(pieces) - set(whole)):
            root = whole[piece]
            anchors.append(gtsam.BetweenFactorPose3(root, piece, given[root].between(given[piece]), leash))
        factors = [(_factor(edge), edge.judged) for edge in edges]
        return cls(
            start=start,
            held=frozenset(whole),
            anchors=tuple(anchors),
            odometry=tuple(factor for factor, loop in factors if not loop),
            loops=tuple(factor for factor, loop in factors if loop),
            is_loop=tuple(loop for _, loop in factors),
        )

    def factors(self, believed: frozenset[int]) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        for factor in (*self.anchors, *self.odometry, *(self.loops[k] for k in sorted(believed))):
            graph.push_back(factor)
        return graph

    def given(self, believed: frozenset[int]) -> _State:
        return _State(self.start, believed, 2.0 * self.factors(believed).error(self.start))

    def optimum(self, believed: frozenset[int]) -> _State:
        """Least squares over what is believed. Raises RuntimeError if it does not converge."""
        graph = self.factors(believed)
        settings = gtsam.LevenbergMarquardtParams()
        settings.setMaxIterations(_STEPS)
        settings.setRelativeErrorTol(1e-12)
        settings.setAbsoluteErrorTol(0.1 * _SAME)
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, self.start, settings)
        values = optimizer.optimize()
        chi2 = 2.0 * graph.error(values)
        if optimizer.iterations() >= _STEPS or not np.isfinite(chi2):
            raise RuntimeError("the pose graph does not converge")
        return _State(values, believed, chi2)

    def predicted(self, values: gtsam.Values) -> _Table:
        """What the odometry alone leads to expect of the loop edges, linearised at some poses."""
        graph = self.factors(frozenset(range(len(self.loops))))
        row, column, entry = graph.linearize(values).sparseJacobian_()  # A, b: every factor has six rows
        shape = (6 * graph.size(), 6 * values.size() + 1)
        jacobian = scipy.sparse.csr_array((entry, (row.astype(np.int64) - 1, column.astype(np.int64) - 1)), shape=shape)
        m = 6 * len(self.loops)
        A, b = jacobian[:-m, :-1], jacobian[:-m, [-1]].toarray()
        J, r = jacobian[-m:, :-1], -jacobian[-m:, [-1]].toarray()
        P = scipy.sparse.linalg.splu((A.T @ A).tocsc())  # whose inverse is the covariance
        r, expected = r + J @ P.solve(A.T @ b), J @ P.solve(J.T.toarray())
        return torch.from_numpy(np.block([[np.eye(m) + 0.5 * (expected + expected.T), r], [r.T, np.zeros((1, 1))]]))

    def moved(self, T_world_map: Sequence[Pose], state: _State) -> tuple[Pose, ...]:
        """The poses of a state, but for those held, which come back as they were given."""
        return tuple(
            T if node in self.held else se3.orthonormalized(torch.from_numpy(state.values.atPose3(node).matrix()))
            for node, T in enumerate(T_world_map)
        )

    def chi2_of_edges(self, state: _State) -> list[float]:
        odometry, loops = iter(self.odometry), iter(self.loops)
        return [2.0 * next(loops if loop else odometry).error(state.values) for loop in self.is_loop]


def _factor(edge: Edge) -> gtsam.NonlinearFactor:
    information = edge.information[np.ix_(_ROTATION_FIRST, _ROTATION_FIRST)]
    noise = gtsam.noiseModel.Gaussian.Information(information)
    return gtsam.BetweenFactorPose3(edge.target, edge.source, gtsam.Pose3(edge.T_target_source.numpy()), noise)


def _lowest(nodes: int, edges: Sequence[Edge]) -> list[int]:
    """For each node, the lowest of those that edges join it with."""
    ends = np.array([(edge.source, edge.target) for edge in edges], dtype=np.int64).reshape(-1, 2).T
    joined = scipy.sparse.coo_array((np.ones(ends.shape[1]), (ends[0], ends[1])), shape=(nodes, nodes))
    _, parts = scipy.sparse.csgraph.connected_components(joined, directed=False)
    _, first, part = np.unique(parts, return_index=True, return_inverse=True)
    return [int(node) for node in first[part]]


def _best(graph: _Graph, limit: float) -> _State:
    """The least truncated cost that is found; edges are chosen where poses are linear, and the choice is repeated."""
    state = best = graph.optimum(frozenset())
    for _ in range(_ROUNDS):
        start = torch.tensor([k in state.believed for k in range(len(graph.loops))])
        chosen = _believable(graph.predicted(state.values), start, limit)
        believed = frozenset(chosen.nonzero()[:, 0].tolist())
        if believed == state.believed:
            break
        state = graph.optimum(believed)
        best = min(best, state, key=lambda s: s.chi2 - limit * len(s.believed))
    return best


def _believable(table: _Table, start: _Edges, limit: float) -> _Edges:
    """Which loop edges to believe for the least truncated cost.

    Where the odometry is off by more than it says, edges that agree with each other may cost less than the descent from
    the start finds: so it starts again at what an edge left out makes expect, where that promises to cost less.
    """
    alone = _surprise(table)
    best, least = _settled(table, start, limit)
    tried = best
    for founder in torch.argsort(alone, stable=True):
        if tried[founder] or alone[founder] >= least:
            continue
        itself = torch.arange(len(alone)) == founder
        surprise = _surprise(_swept(table, itself, 1.0)).clamp(max=limit)
        if alone[founder] + surprise[~itself].sum() >= least:
            continue
        chosen, cost = _settled(table, itself, limit)
        tried = tried | itself | chosen
        if cost < least:
            best, least = chosen, cost
    return best


def _settled(table: _Table, believed: _Edges, limit: float) -> tuple[_Edges, float]:
    """The descent of the truncated cost, one edge at a time, from a choice and all it leads to expect; and its end."""
    table = _swept(table, believed, 1.0)
    expected = ~believed & (_surprise(table) <= limit)
    table, believed = _swept(table, expected, 1.0), believed | expected
    for _ in range(_FLIPS * len(believed)):
        surprise = _surprise(table)
        gain = torch.where(believed, surprise - limit, limit - surprise)
        flipped = torch.arange(len(gain)) == gain.argmax()
        if gain[flipped] <= _SAME * limit:
            break
        table = _swept(table, flipped, -1.0 if believed[flipped] else 1.0)
        believed = believed ^ flipped
    return believed, limit * int((~believed).sum()) - float(table[-1, -1])


def _swept(table: _Table, edges: _Edges, sign: float) -> _Table:
    """The table once some edges are believed (1) or, after that, no longer (-1): the sweep of stepwise regression.

    Of an edge not believed, it then holds the residual and covariance that the believed lead to expect, and of one
    that is, minus the inverse covariance of what all others lead to expect, and that times the residual; in its corner,
    minus the chi2 of believing.
    """
    rows = edges.repeat_interleave(6).nonzero()[:, 0]
    pivot = sign * _inverse(sign * table[rows][:, rows])
    columns = table[:, rows] @ pivot
    table = torch.addmm(table, columns, table[rows], alpha=-1.0)
    table[:, rows] = sign * columns
    table[rows] = sign * columns.T
    table[rows[:, None], rows] = -pivot
    return table


def _surprise(table: _Table) -> Float[Tensor, " n"]:
    """Of each edge, the squared distance from what all the others that are believed lead to expect: its own chi2."""
    n = len(table) // 6
    blocks = table[:-1, :-1].reshape(n, 6, n, 6).diagonal(dim1=0, dim2=2).permute(2, 0, 1)
    residuals = table[:-1, -1].reshape(n, 6)
    whitened: Tensor = torch.linalg.solve(blocks, residuals)
    return (residuals * whitened).sum(dim=1).abs()


def _inverse(matrix: Float[Tensor, "m m"]) -> Float[Tensor, "m m"]:
    """Of a symmetric positive definite matrix.

    By torch, whose threads sleep while they wait: numpy's do not, and took 80 ms instead of 1 on two busy cores.
    """
    return torch.cholesky_inverse(torch.linalg.cholesky(matrix))
