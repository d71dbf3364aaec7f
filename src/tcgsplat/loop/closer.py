"""Comparing each finished submap with those before it, and what follows for where all of them stand.

Work is incremental: a submap's places are remembered once, two submaps are registered once, and a submap is read back
only when it is to be registered.
"""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.loop.descriptor import Vectors
from tcgsplat.loop.places import measured
from tcgsplat.loop.pose_graph import Edge, solved
from tcgsplat.loop.registration import Registration, Side, registered
from tcgsplat.loop.relocalization import Relocalized, Relocalizer
from tcgsplat.loop.retrieval import Candidate
from tcgsplat.loop.settings import LoopConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Submap
from tcgsplat.tensors import Pose
from tcgsplat.tracking.tracker import TrackerConfig

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Closure:
    """What comparing one submap with those before it has shown."""

    submap: int
    """The one that was compared."""
    corrections: Mapping[int, Pose] = field(default_factory=dict)
    """`T_world_map` of every submap that is to stand elsewhere; empty if nothing new was learnt."""
    registrations: tuple[Registration, ...] = ()
    """With each candidate; those that failed say why."""
    edges: tuple[Edge, ...] = ()
    """All of the pose graph by now."""
    rejected: tuple[Edge, ...] = ()
    """Those of them that contradict the rest."""
    seconds: float = 0.0
    """Wall time."""


def odometry(source: int, target: int, T_target_source: Pose) -> Edge:
    """The edge from a submap to the one where its first frame was tracked.

    Its spread grows with the way between the two: 3 mm and 1 % of it, 1.5 mrad and 0.5 % of the turn. Errors of
    tracking on synthetic data with a Kinect's noise are below that, by a half as a rule.
    """
    way, turn = se3.translation_norm(T_target_source), se3.rotation_angle(T_target_source)
    spread = np.array([0.003 + 0.01 * way] * 3 + [0.0015 + 0.005 * turn] * 3)
    return Edge(source, target, T_target_source, np.diag(1 / spread**2), loop=False)


class LoopCloser:
    """Keeps what is known of finished submaps: their places, and the edges between them."""

    def __init__(
        self,
        config: LoopConfig,
        tracker: TrackerConfig,
        confidence: ConfidenceConfig,
        rasterizer: Rasterizer,
        load: Callable[[int], Submap],
        seed: int,
    ) -> None:
        self.edges: tuple[Edge, ...] = ()
        self._config = config
        self._confidence = confidence
        self._load = load
        self._relocalizer = Relocalizer(config, tracker, confidence, rasterizer, load, seed)

    def follow(self, edge: Edge) -> None:
        """Take in that a submap has begun where one of its frames was tracked in another."""
        self.edges = (*self.edges, edge)

    def restore(self, count: int, edges: Sequence[Edge]) -> None:
        """Know the first so many submaps again, and the edges that there were."""
        self.edges = tuple(edges)
        for index in range(count):
            self._relocalizer.remember(self._load(index))

    def closed(self, index: int, T_world_map: Sequence[Pose]) -> Closure:
        """Compare a finished submap with those before it; call it once for each, in their order.

        Args:
            index: Of the submap, which can be read back by now.
            T_world_map: Where all submaps stand, those included that have begun since.
        """
        started = time.perf_counter()
        submap = self._load(index)
        self._relocalizer.remember(submap)
        submap = measured(submap)
        registrations = []
        for candidate in self._relocalizer.places.candidates(index, T_world_map, self._config):
            T_other_this = se3.inverse(T_world_map[candidate.submap]) @ T_world_map[index]
            registrations.append(self._registered(submap, candidate, T_other_this))
        loops = [
            Edge(pair.source, pair.target, pair.T_target_source, pair.information, loop=True)
            for pair in registrations
            if not pair.failed
        ]
        if not loops:
            return Closure(index, registrations=tuple(registrations), edges=self.edges, seconds=_since(started))
        self.edges = (*self.edges, *loops)
        solution = solved(T_world_map, self.edges)
        return Closure(
            index,
            {i: T for i, (T, was) in enumerate(zip(solution.T_world_map, T_world_map, strict=True)) if T is not was},
            tuple(registrations),
            self.edges,
            tuple(self.edges[i] for i in solution.rejected),
            _since(started),
        )

    def _registered(self, submap: Submap, candidate: Candidate, T_other_this: Pose) -> Registration:
        other, similarity = measured(self._load(candidate.submap)), candidate.similarity
        source, target = self._side(submap, similarity), self._side(other, similarity.T)
        pair = registered(source, target, similarity, T_other_this, self._relocalizer.localizer)
        log = logger.debug if pair.failed else logger.info
        log("submap %d to %d: %s", pair.source, pair.target, pair.failed or "registered")
        return pair

    def _side(self, submap: Submap, similarity: Vectors) -> Side:
        places, confidence = self._relocalizer.places, self._confidence
        floor = confidence.view_floor if confidence.rerank_views else None
        return Side(submap, places[submap.index], places.viewpoints(submap.index, similarity, self._config, floor))

    def relocalized(self, frame: Frame, active: Submap) -> Relocalized | None:
        """Where a lost camera is, if the place is known: in the active submap rather than in another one."""
        return self._relocalizer.relocalized(frame, active)


def _since(started: float) -> float:
    return time.perf_counter() - started
