"""What stays in memory of a finished submap: enough to know the place again without reading the submap back."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch

from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.loop import retrieval
from tcgsplat.loop.descriptor import Descriptor, Impression, Vectors
from tcgsplat.loop.features import Features, features, pooled
from tcgsplat.loop.localization import relative_pose
from tcgsplat.loop.retrieval import Candidate
from tcgsplat.loop.settings import LoopConfig
from tcgsplat.loop.viewpoints import view_confidence, viewpoints
from tcgsplat.render.conventions import NEAR_PLANE
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import SubmapView
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.tensors import Pose

NEAREST: Final = 3
"""Views of a place that a picture is compared with, the most similar ones, all at once."""
_INLIERS, _SHARE, _ERROR_METERS = 40, 0.12, 0.08
"""Gates of a guess: looser than for a pose that is believed by itself, since every pixel is asked afterwards. Of pairs
of views on real and synthetic sequences 55 % gave a guess, where the stricter ones gave 45 %."""
_SAMPLED: Final = 50
"""Features of a view, the clearest, that tell what is in the view of another place."""


@dataclass(frozen=True, eq=False)
class View:
    """A keyframe as a place remembers it."""

    T_map_cam: Pose
    camera: Camera
    features: Features
    confidence: float
    """C of Eq. 25: how reliable the part of the map is that it looks at, in [0, 1]."""


@dataclass(frozen=True, eq=False)
class Place:
    """A submap's keyframes without their pictures."""

    index: int
    """Of the submap."""
    views: tuple[View, ...]
    """One for each keyframe, in their order."""

    @staticmethod
    def of(submap: Submap, rasterizer: Rasterizer) -> "Place":
        """What to remember of a submap."""
        draw = SubmapView(submap, rasterizer)
        return Place(submap.index, tuple(_view(keyframe, draw) for keyframe in submap.keyframes))

    def overlap(self, other: "Place", T_other_this: Pose) -> float:
        """Share of what this place has measured that is in the view of another one, if they stand so."""
        if not self.views:
            return 0.0
        parts = [view.features.measured.moved(view.T_map_cam).points[:_SAMPLED] for view in self.views]
        points = se3.transform(T_other_this, torch.from_numpy(np.concatenate(parts)).to(torch.float64))
        seen = torch.zeros(len(points), dtype=torch.bool)
        for view in other.views:
            x, y, z = se3.transform(se3.inverse(view.T_map_cam), points).unbind(-1)
            pixels = view.camera.project(torch.stack((x, y, z.clamp_min(NEAR_PLANE)), dim=-1))
            seen |= view.camera.contains(pixels) & (z > NEAR_PLANE)
        return float(seen.to(torch.float64).mean()) if len(points) else 0.0

    def guess(self, seen: Features, camera: Camera, nearest: Sequence[int]) -> Pose | None:
        """Where a picture was taken in the submap's frame, `T_map_cam`, if its features tell.

        Args:
            seen: Features of the picture.
            camera: That took it.
            nearest: Which views of this place to compare with, all at once.
        """
        known = pooled([(self.views[i].features, self.views[i].T_map_cam) for i in nearest])
        found = relative_pose(
            seen, known, camera, min_inliers=_INLIERS, min_share=_SHARE, max_position_error=_ERROR_METERS
        )
        return None if found is None else found.T_b_a


def measured(submap: Submap) -> Submap:
    """A submap without guesses: nobody should be tracked against these."""
    return submap.kept(submap.gaussians.ids >= 0)


def _view(keyframe: Keyframe, draw: SubmapView) -> View:
    frame, rendering = keyframe.frame, draw(keyframe.frame.camera, keyframe.T_map_cam)
    return View(keyframe.T_map_cam, frame.camera, features(frame), view_confidence(rendering))


class Places:
    """Finished submaps in their order, and how alike what they show looks.

    What a descriptor learns of the run, it learns again whenever there are twice as many submaps: all the work that is
    for, taken together, stays in proportion to their number.
    """

    def __init__(self, descriptor: Descriptor, rasterizer: Rasterizer) -> None:
        self._descriptor = descriptor
        self._rasterizer = rasterizer
        self._places: list[Place] = []
        self._impressions: list[list[Impression]] = []
        self._vectors: list[Vectors] = []

    def __getitem__(self, index: int) -> Place:
        return self._places[index]

    def append(self, submap: Submap) -> None:
        """Remember one more."""
        place = Place.of(submap, self._rasterizer)
        pairs = zip(submap.keyframes, place.views, strict=True)
        self._places.append(place)
        self._impressions.append([self._descriptor.impression(key.frame, view.features) for key, view in pairs])
        count = len(self._places)
        learnt = self._descriptor
        if count & (count - 1) == 0:  # a power of two
            learnt = learnt.learnt([each for impressions in self._impressions for each in impressions])
        if learnt is not self._descriptor:
            self._descriptor, self._vectors = learnt, []
        self._vectors += [learnt.described(each) for each in self._impressions[len(self._vectors) :]]

    def similar(self, frame: Frame, seen: Features, limit: int) -> list[tuple[int, list[int]]]:
        """The places that a picture may show, the most alike first, and which of their views."""
        vector = self._descriptor.described([self._descriptor.impression(frame, seen)])
        found = retrieval.most_alike(vector, self._vectors, limit=limit)
        return [(one.submap, np.argsort(-one.similarity[0], kind="stable")[:NEAREST].tolist()) for one in found]

    def candidates(self, index: int, T_world_map: Sequence[Pose], config: LoopConfig) -> list[Candidate]:
        """What to compare a submap with: half of it what looks most alike, half what it overlaps with most.

        In a place where much looks alike, appearance alone would spend the time on the wrong pairs; after much drift,
        where submaps seem to stand would.
        """
        found = retrieval.candidates(
            index,
            self._vectors[: index + 1],
            min_similarity=config.min_similarity,
            min_interval=config.min_interval,
            min_score=config.min_score,
            limit=config.candidates,
        )
        chosen = list(found[: (config.candidates + 1) // 2])
        taken = {one.submap for one in chosen}
        T_map_world, overlaps = se3.inverse(T_world_map[index]), []
        for other in range(index - config.min_interval):
            share = self[other].overlap(self[index], T_map_world @ T_world_map[other])
            if share > config.min_coverage and other not in taken:
                overlaps.append((share, other))
        for share, other in sorted(overlaps, reverse=True):
            chosen.append(Candidate(other, share, self._vectors[index] @ self._vectors[other].T))
        taken = {one.submap for one in chosen}
        return [*chosen, *(one for one in found if one.submap not in taken)][: config.candidates]

    def viewpoints(self, index: int, similarity: Vectors, config: LoopConfig, floor: float | None) -> tuple[int, ...]:
        """The views that a submap is registered by.

        Args:
            index: Of the submap.
            similarity: Of its views [rows] to those of the other one [columns].
            config: How many.
            floor: Of Eq. 25; None for ranking by similarity alone.
        """
        views, vectors = self[index].views, self._vectors[index]
        return viewpoints(
            similarity,
            vectors @ vectors.T,
            preselected=config.preselected,
            kept=config.views,
            confidence=None if floor is None else lambda view: views[view].confidence,
            floor=0.0 if floor is None else floor,
        )
