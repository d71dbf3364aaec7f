"""Where a camera is that nobody has followed: the place is looked up, and the picture aligned to the map there."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.loop.descriptor import open_descriptor
from tcgsplat.loop.features import Features, features
from tcgsplat.loop.localizer import Localizer
from tcgsplat.loop.places import Place, Places, View, measured
from tcgsplat.loop.settings import LoopConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Submap
from tcgsplat.tensors import Pose
from tcgsplat.tracking.settings import TrackerConfig
from tcgsplat.tracking.tracker import Tracked

_CLEARLY: Final = 0.01
"""Correlation of colours by which one place must be better than another one. In two synthetic rooms that differ by a
poster and a row of books, the right one was better by less than that as a rule."""
_APART_METERS, _APART_RADIANS = 0.5, 0.35
"""Poses in the world that far apart are not one place seen from two submaps, however much these have drifted."""


@dataclass(frozen=True, eq=False)
class Relocalized:
    """Where a camera is that was lost, or has just been switched on."""

    reference: Submap
    """The submap that shows the place, without guesses."""
    tracked: Tracked
    """The frame in it."""


class Relocalizer:
    """Knows the places of finished submaps, and finds pictures in them."""

    def __init__(
        self,
        config: LoopConfig,
        tracker: TrackerConfig,
        confidence: ConfidenceConfig,
        rasterizer: Rasterizer,
        load: Callable[[int], Submap],
        seed: int,
    ) -> None:
        self.places = Places(open_descriptor(config.descriptor, seed=seed), rasterizer)
        self.localizer = Localizer(config, tracker, confidence, rasterizer)
        self._load = load
        self._limit = config.candidates
        self._features: dict[int, Features] = {}

    def remember(self, submap: Submap) -> None:
        """Know a finished submap's place from now on; in the order of the submaps."""
        self.places.append(submap)

    def relocalized(
        self, frame: Frame, T_world_map: Sequence[Pose], active: Submap | None = None
    ) -> Relocalized | None:
        """Look a picture up in the most similar finished submaps, and in the active one.

        Two things must agree, features in pixel and depth, and then every pixel with the map. Where two submaps pass
        that stand in different places, rooms that look alike for instance, the colours must tell clearly which it is;
        else the picture is not found.

        Args:
            frame: The picture; depth helps, and is not needed.
            T_world_map: Where all submaps stand.
            active: A submap that is still growing, if there is one.
        """
        seen = features(frame)
        passed = [one for one in self._each(frame, seen, active) if one is not None]
        if not passed:
            return None
        best = max(passed, key=lambda one: one.tracked.correlation)
        growing = [one for one in passed if one.reference is active and _together(one, best, T_world_map)]
        best = growing[0] if growing else best  # rather than begin a new submap where another one looks a little better
        clear = best.tracked.correlation - _CLEARLY
        rivals = [one for one in passed if one.tracked.correlation > clear]
        return best if all(_together(best, rival, T_world_map) for rival in rivals) else None

    def _each(self, frame: Frame, seen: Features, active: Submap | None) -> Iterator[Relocalized | None]:
        if active is not None and active.keyframes:
            place = self._growing(active)
            yield self._within(active, place.guess(seen, frame.camera, range(len(place.views))), frame)
        for index, views in self.places.similar(frame, seen, self._limit):
            guess = self.places[index].guess(seen, frame.camera, views)
            yield None if guess is None else self._within(measured(self._load(index)), guess, frame)

    def _growing(self, active: Submap) -> Place:
        """As far as a guess needs it: nothing is drawn, and a picture's features are looked for once while it grows."""
        before, self._features = self._features, {}  # which keeps those of this submap only
        views = []
        for keyframe in active.keyframes:
            frame = keyframe.frame
            found = before[frame.index] if frame.index in before else features(frame)
            self._features[frame.index] = found
            views.append(View(keyframe.T_map_cam, frame.camera, found, confidence=0.0))
        return Place(active.index, tuple(views))

    def _within(self, submap: Submap, guess: Pose | None, frame: Frame) -> Relocalized | None:
        if guess is None:
            return None
        found = self.localizer.localized(frame, submap, (guess,))
        return None if found.failed else Relocalized(submap, found.tracked)


def _together(a: Relocalized, b: Relocalized, T_world_map: Sequence[Pose]) -> bool:
    """Whether two submaps put the camera in one place of the world."""
    T_world_a, T_world_b = (T_world_map[one.reference.index] @ one.tracked.T_map_cam for one in (a, b))
    apart = se3.inverse(T_world_a) @ T_world_b
    return se3.translation_norm(apart) < _APART_METERS and se3.rotation_angle(apart) < _APART_RADIANS
