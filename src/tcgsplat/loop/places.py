"""What stays in memory of a finished submap: enough to know the place again without reading the submap back."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from tcgsplat.geometry.camera import Camera
from tcgsplat.loop.features import Features, features, pooled
from tcgsplat.loop.localization import relative_pose
from tcgsplat.loop.settings import LoopConfig
from tcgsplat.render.view import Rendering
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.tensors import Pose

Similarity = npt.NDArray[np.float32]

NEAREST: Final = 3
"""Views of a place that a picture is compared with, the most similar ones, all at once."""
_COVERED: Final = 0.95
"""Alpha from which on a pixel counts as well covered."""


@dataclass(frozen=True, eq=False)
class View:
    """A keyframe as a place remembers it."""

    T_map_cam: Pose
    camera: Camera
    features: Features


@dataclass(frozen=True, eq=False)
class Place:
    """A submap's keyframes without their pictures."""

    index: int
    """Of the submap."""
    views: tuple[View, ...]
    """One for each keyframe, in their order."""

    @staticmethod
    def of(submap: Submap) -> "Place":
        """What to remember of a submap."""
        return Place(submap.index, tuple(map(_view, submap.keyframes)))

    def guess(self, seen: Features, camera: Camera, nearest: Sequence[int]) -> Pose | None:
        """Where a picture was taken in the submap's frame, `T_map_cam`, if its features tell.

        Args:
            seen: Features of the picture.
            camera: That took it.
            nearest: Which views of this place to compare with, all at once.
        """
        known = pooled([(self.views[i].features, self.views[i].T_map_cam) for i in nearest])
        found = relative_pose(seen, known, camera)
        return None if found is None else found.T_b_a


def measured(submap: Submap) -> Submap:
    """A submap without guesses: nobody should be tracked against these."""
    return submap.kept(submap.gaussians.ids >= 0)


def _view(keyframe: Keyframe) -> View:
    frame: Frame = keyframe.frame
    return View(keyframe.T_map_cam, frame.camera, features(frame))


def view_confidence(rendering: Rendering) -> float:
    """C of Eq. 25: mean of P over the well covered pixels; 0 where there are none."""
    covered = rendering.alpha > _COVERED
    return float(rendering.confidence[covered].mean()) if bool(covered.any()) else 0.0


@dataclass(frozen=True, eq=False)
class Candidate:
    """A submap that may show the same place as another one."""

    index: int
    score: float
    """Of the most similar pair of views."""
    similarity: Similarity
    """Of the other one's views [rows] to this one's [columns]."""


class Places:
    """Finished submaps, and how similar what they show is."""

    def __init__(self) -> None:
        self._places: list[Place] = []
        self._vectors: list[Similarity] = []

    def __getitem__(self, index: int) -> Place:
        return self._places[index]

    def append(self, submap: Submap) -> None:
        """Remember one more."""
        place = Place.of(submap)
        self._places.append(place)
        self._vectors.append(np.array([_described(view.features) for view in place.views], np.float32))

    def similar(self, seen: Features, limit: int) -> list[tuple[int, list[int]]]:
        """The places that a picture may show, the most similar first, and which of their views."""
        scores = [vectors @ _described(seen) for vectors in self._vectors]
        best = sorted(range(len(scores)), key=lambda i: -scores[i].max())[:limit]
        return [(i, np.argsort(-scores[i], kind="stable")[:NEAREST].tolist()) for i in best]

    def candidates(self, index: int, config: LoopConfig) -> list[Candidate]:
        """What to compare a submap with, the most similar first."""
        own = self._vectors[index]
        pairs = [(i, own @ self._vectors[i].T) for i in range(index) if index - i > config.min_interval]
        found = [Candidate(i, float(similarity.max()), similarity) for i, similarity in pairs]
        return sorted(found, key=lambda candidate: -candidate.score)[: config.candidates]


def _described(seen: Features) -> Similarity:
    bits = np.unpackbits(seen.descriptors, axis=1).mean(axis=0) - 0.5 if len(seen) else np.ones(256)
    return (bits / np.linalg.norm(bits)).astype(np.float32)
