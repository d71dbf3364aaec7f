"""Where a camera is that nobody has followed: the place is looked up, and the picture aligned to the map there."""

from collections.abc import Callable
from dataclasses import dataclass

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.loop.descriptor import open_descriptor
from tcgsplat.loop.features import features
from tcgsplat.loop.localizer import Localizer
from tcgsplat.loop.places import Place, Places, measured
from tcgsplat.loop.settings import LoopConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Submap
from tcgsplat.tensors import Pose
from tcgsplat.tracking.tracker import Tracked, TrackerConfig


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
        self._rasterizer = rasterizer
        self._limit = config.candidates

    def remember(self, submap: Submap) -> None:
        """Know a finished submap's place from now on; in the order of the submaps."""
        self.places.append(submap)

    def relocalized(self, frame: Frame, active: Submap | None = None) -> Relocalized | None:
        """Look a picture up in finished submaps, the most similar first, and before them in the active one.

        Two things must agree, features in pixel and depth, and then every pixel with the map; else it is not found.

        Args:
            frame: The picture; depth helps, and is not needed.
            active: A submap that is still growing, if there is one.
        """
        seen = features(frame)
        if active is not None and active.keyframes:
            place = Place.of(active, self._rasterizer)
            found = self._within(active, place.guess(seen, frame.camera, range(len(place.views))), frame)
            if found is not None:
                return found
        for index, views in self.places.similar(frame, seen, self._limit):
            guess = self.places[index].guess(seen, frame.camera, views)
            found = None if guess is None else self._within(measured(self._load(index)), guess, frame)
            if found is not None:
                return found
        return None

    def _within(self, submap: Submap, guess: Pose | None, frame: Frame) -> Relocalized | None:
        if guess is None:
            return None
        found = self.localizer.localized(frame, submap, (guess,))
        return None if found.failed else Relocalized(submap, found.tracked)
