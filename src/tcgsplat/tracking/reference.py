"""The rendered view that frames are aligned to, at every resolution, wherever its images are.

What is done with an image is the device's affair: `pyramids` on the CPU, `cuda_alignment.Images` on a GPU. Which image
is made of which stands here.
"""

import math
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

from tcgsplat.geometry.camera import Camera
from tcgsplat.render.view import Rendering
from tcgsplat.scene.frame import Frame
from tcgsplat.tensors import Plane, Pose
from tcgsplat.tracking.settings import AlignmentConfig

Array = TypeVar("Array")
"""numpy's on the CPU, torch's on a GPU."""

_SPARSE = 200
"""Pixels across from which on a level is sampled by `stride`: above it, neighbours say nearly the same."""
_COARSEST = 80
"""Pixels across the coarsest level, at most: a pixel there is most of a degree, what a fast hand turns in a frame."""


@runtime_checkable
class Images(Protocol[Array]):
    """What alignment does with images [h, w] of one device. Depth images mark what saw nothing, as in `pyramids`."""

    def rendered(self, rendering: Rendering, min_alpha: float) -> tuple[Array, Array, Array, Array]:
        """Intensity and depth, divided by alpha; intensity as it was drawn; depth where the map is all but opaque."""

    def live(self, frame: Frame) -> tuple[Array, Array]:
        """Intensity and depth of a frame."""

    def weights(self, weight: Plane) -> Array:
        """Of a rendered view's pixels."""

    def halved(self, image: Array) -> Array:
        """Means over two by two pixels."""

    def halved_depth(self, depth: Array) -> Array:
        """Means of the readings of two by two pixels that agree."""

    def points(self, intensity: Array, depth: Array, weight: Array, camera: Camera, radius: int, stride: int) -> Array:
        """Points of a rendered view [POINT, n]; see the kernel `reference_points`."""

    def sampled(self, intensity: Array, depth: Array) -> Array:
        """What a pass samples of a frame [h, w, CHANNELS]."""


@dataclass(frozen=True)
class Level(Generic[Array]):
    """A rendered view at one resolution."""

    halvings: int
    """Of width and height."""
    passes: int
    """At least one."""
    points: Array
    """[POINT, n]"""
    camera: Camera
    gate: float
    """Metres, times (1 + z/2)."""


@dataclass(frozen=True)
class ReferenceView(Generic[Array]):
    """A rendered view as frames are aligned to it: made once, used while the camera stays near."""

    T_map_ref: Pose
    """Where it was rendered; on the CPU."""
    camera: Camera
    covered: Any
    """Where it gives points, [h, w]."""
    levels: tuple[Level[Array], ...]
    """Finest first."""
    solid_points: Array
    """Of the finest level, that tell the exposure."""


@dataclass(frozen=True)
class Pair(Generic[Array]):
    """Both views at one resolution."""

    level: Level[Array]
    live: Array
    """Of the frame, [h, w, CHANNELS]."""


def reference_view(
    images: Images[Array],
    rendering: Rendering,
    weight: Plane,
    camera: Camera,
    T_map_ref: Pose,
    config: AlignmentConfig,
) -> ReferenceView[Array]:
    """A rendered view made ready.

    The solver compares with colours that are divided by alpha. Through thin places the background of the map's frame
    shows, which optimisation closes in time: dividing makes them too bright, not dividing leaves them too dark. So
    exposure is told by colours that are not divided, where the map is all but opaque.

    Args:
        images: Of the device where the rendering is.
        rendering: The map seen from `T_map_ref`.
        weight: W_tr of Eq. 18 at every rendered pixel.
        camera: That it was rendered with.
        T_map_ref: Where; on the CPU.
        config: Constants.
    """
    intensity, depth, composited, solid = images.rendered(rendering, config.min_alpha)
    covered, weights, scaled, levels = depth >= 0, images.weights(weight), camera, list[Level[Array]]()  # type: ignore[operator]
    for halvings, passes in enumerate(_passes_of_levels(config, camera)):
        if halvings:
            intensity, weights, depth = images.halved(intensity), images.halved(weights), images.halved_depth(depth)
            if not levels:
                composited, solid = images.halved(composited), images.halved_depth(solid)
            scaled = scaled.scaled(0.5)
        if not passes:
            continue
        sampling = (2, config.stride) if scaled.width > _SPARSE else (1, 1)
        if not levels:
            solid_points = images.points(composited, solid, weights, scaled, *sampling)
        points = images.points(intensity, depth, weights, scaled, *sampling)
        levels.append(Level(halvings, passes, points, scaled, 2 * config.gate if halvings else config.gate))
    return ReferenceView(T_map_ref, camera, covered, tuple(levels), solid_points)


def pairs(images: Images[Array], frame: Frame, view: ReferenceView[Array]) -> list[Pair[Array]]:
    """The view's levels with a frame at the same resolutions; finest first."""
    found, halvings, (intensity, depth) = list[Pair[Array]](), 0, images.live(frame)
    for level in view.levels:
        while halvings < level.halvings:
            intensity, depth, halvings = images.halved(intensity), images.halved_depth(depth), halvings + 1
        found.append(Pair(level, images.sampled(intensity, depth)))
    return found


def _passes_of_levels(config: AlignmentConfig, camera: Camera) -> tuple[int, ...]:
    """Passes a level, finest first; large images get more coarse levels, so that a step spans as much of any image."""
    more = max(math.ceil(math.log2(camera.width / _COARSEST)) + 1 - len(config.iterations), 0)
    return (*config.iterations, *[config.iterations[-1]] * more)
