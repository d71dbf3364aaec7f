"""Comparing each finished submap with those before it, and what follows for where all of them stand.

Work is incremental: a submap's places are remembered once, two submaps are registered once, and a submap is read back
only when it is to be registered.
"""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Final

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.loop.descriptor import Vectors
from tcgsplat.loop.edge import Edge
from tcgsplat.loop.places import measured
from tcgsplat.loop.registration import Registration, Side, registered
from tcgsplat.loop.relocalization import Relocalized, Relocalizer
from tcgsplat.loop.retrieval import Candidate
from tcgsplat.loop.settings import LoopConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Submap
from tcgsplat.tensors import Pose
from tcgsplat.tracking.settings import TrackerConfig

logger = logging.getLogger(__name__)

LATE: Final = (
    "tcgsplat.loop.pose_graph",  # and with it gtsam
    "scipy.sparse.csgraph",
    "scipy.sparse.linalg",
    "scipy.spatial.transform",
    "scipy.special",
)
"""What is imported only when a submap is first compared or a loop closed, so that a run begins sooner."""

JUDGED: Final = 60
"""Loop edges, the newest, that are judged anew whenever a loop is closed; what was said of older ones stays. A wrong
one contradicts those of its own place, which come in the minutes around it, and judging takes the cube of the time."""


def import_late_modules() -> None:
    """Import it now: later it would hold up all threads for 0.1 and 0.2 s, and a camera does not wait."""
    for module in LATE:
        import_module(module)


@dataclass(frozen=True, eq=False)
class Closure:
    """What comparing one submap with those before it has shown."""

    submap: int
    """The one that was compared."""
    T_world_map: tuple[Pose, ...] = ()
    """Where all submaps stand by now, also those that had only begun; empty if they stand where they stood."""
    registrations: tuple[Registration, ...] = ()
    """With each candidate; those that failed say why."""
    edges: tuple[Edge, ...] = ()
    """All of the pose graph by now."""
    rejected: tuple[Edge, ...] = ()
    """Those of them that contradict the rest."""
    seconds: float = 0.0
    """Wall time."""

    def brief(self) -> "Closure":
        """Without what grows with the run."""
        return replace(self, T_world_map=(), edges=(), rejected=())


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
        self.T_world_map: tuple[Pose, ...] = (se3.identity(),)
        self.edges: tuple[Edge, ...] = ()
        self.rejected: tuple[Edge, ...] = ()
        self._config = config
        self._confidence = confidence
        self._load = load
        self._relocalizer = Relocalizer(config, tracker, confidence, rasterizer, load, seed)

    def restore(self, T_world_map: Sequence[Pose], edges: Sequence[Edge]) -> None:
        """Know again what was known when the last of these submaps began."""
        self.T_world_map, self.edges = tuple(T_world_map), tuple(edges)
        self._solve(move=False)
        for index in range(len(T_world_map) - 1):
            self._relocalizer.remember(self._load(index))

    def closed(self, index: int, following: Edge | None, *, compare: bool = True) -> Closure:
        """Compare a finished submap, which can be read back by now, with those before it; once each, in their order.

        Args:
            index: Of the submap.
            following: From the submap that has begun since to the one where its first frame was tracked.
            compare: If not, the submap is remembered, so that later ones are compared with it, and no more.
        """
        started = time.perf_counter()
        if following is not None:
            self.edges = (*self.edges, following)
            T_world_map = self.T_world_map[following.target] @ following.T_target_source
            self.T_world_map = (*self.T_world_map, se3.orthonormalized(T_world_map))
        submap = self._load(index)
        self._relocalizer.remember(submap)
        places, known = self._relocalizer.places, measured(submap)
        candidates = places.candidates(index, self.T_world_map, self._config) if compare else []
        registrations = tuple(self._registered(known, candidate) for candidate in candidates)
        loops = tuple(
            Edge(pair.source, pair.target, pair.T_target_source, pair.information, loop=True)
            for pair in registrations
            if not pair.failed
        )
        if not loops:
            return Closure(index, (), registrations, self.edges, self.rejected, time.perf_counter() - started)
        self.edges = (*self.edges, *loops)
        self._solve(move=True)
        seconds = time.perf_counter() - started
        return Closure(index, self.T_world_map, registrations, self.edges, self.rejected, seconds)

    def _solve(self, *, move: bool) -> None:
        """Which edges are rejected by now, and, if the submaps are to move, where they stand."""
        from tcgsplat.loop.pose_graph import solved  # noqa: PLC0415 (gtsam takes a twentieth of the start-up)

        considered = [edge for edge in self.edges if edge.verdict != "rejected"]
        solution = solved(self.T_world_map, considered)
        doubted = {considered[place] for place in solution.rejected}
        settled = {*[edge for edge in self.edges if edge.judged][:-JUDGED]}
        self.edges = tuple(
            replace(edge, verdict="rejected" if edge in doubted else "believed") if edge in settled else edge
            for edge in self.edges
        )
        self.rejected = tuple(edge for edge in self.edges if edge.verdict == "rejected" or edge in doubted)
        if move:
            self.T_world_map = solution.T_world_map

    def _registered(self, submap: Submap, candidate: Candidate) -> Registration:
        T_other_this = se3.inverse(self.T_world_map[candidate.submap]) @ self.T_world_map[submap.index]
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
        """Where a lost camera is, if the place is known: in the active submap or in another one."""
        return self._relocalizer.relocalized(frame, self.T_world_map, active)
