"""A furnished place, lit, with a camera in it: pose in, exact picture out."""

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tcgsplat.datasets.synthetic import apartment, lighting, raster
from tcgsplat.datasets.synthetic.places import PLACES, Name
from tcgsplat.datasets.synthetic.raster import LightMap, View
from tcgsplat.datasets.synthetic.scene import GAMMA, Scene, compiled

Array = np.ndarray[Any, np.dtype[Any]]

_FIELD_OF_VIEW = 70.0
"""From left to right, degrees."""
_EXPOSURE = 1.0
"""Factor on radiance before the film's shoulder."""


@dataclass(frozen=True)
class Shot:
    """What a perfect camera sees, and what a model of a worse one needs to know."""

    color: Array
    """[h, w, 3] float32 displayed colour in [0, 1]."""
    depth: Array
    """[h, w] float64 metres along the optical axis at pixel centres, 0 where there is nothing."""
    incidence: Array
    """[h, w] float32 cosine between ray and surface normal."""
    shine: Array
    """[h, w] float64, see `Material.shine`."""
    moving: Array
    """[h, w] bool: the moving object."""


@dataclass(frozen=True)
class Studio:
    """Scene, light and intrinsics; pictures of it do not depend on each other."""

    scene: Scene
    direct: LightMap
    indirect: LightMap
    view: View

    def shot(self, T_world_cam: Array, T_world_moved: Array) -> Shot:
        """Take one picture.

        Args:
            T_world_cam: [k, 4, 4] camera poses while the shutter is open, k odd; the middle one gives the depth.
            T_world_moved: [k, 4, 4] motion of the moving object from where the scene has it, at the same instants.
        """
        middle = len(T_world_cam) // 2
        light = np.zeros((self.view.height, self.view.width, 3), dtype=np.float32)
        mesh, paint = self.scene.mesh, self.scene.paint
        for k, (T, M) in enumerate(zip(T_world_cam, T_world_moved, strict=True)):
            T_cam_world = np.linalg.inv(T)
            T_cam_mesh = np.stack((T_cam_world, T_cam_world @ M))
            nearest, triangle, affine = raster.visible(mesh, T_cam_mesh, self.view, raster.OFFSETS)
            light += raster.shaded(triangle, affine, mesh, paint, self.direct, self.indirect, raster.OFFSETS)
            if k == middle:
                seen = triangle[0] >= 0
                depth = np.divide(1.0, nearest[0], out=np.zeros_like(nearest[0]), where=seen)
                patch = mesh.patch[triangle[0]]
                incidence = raster.incidence(triangle[0], affine, self.view)
        film = (1 - np.exp(-_EXPOSURE / len(T_world_cam) * light)) ** np.float32(1 / GAMMA)
        return Shot(film, depth, incidence, np.where(seen, self.scene.shine[patch], 0), seen & (mesh.moves[patch] > 0))

    def emptied(self) -> "Studio":
        """The same place and light without the moving object, which throws no shadow."""
        mesh = self.scene.mesh
        static = mesh._replace(moves=mesh.moves[mesh.moves == 0])  # patches that stand still come first
        return replace(self, scene=self.scene._replace(mesh=static))

    def inverse_depth(self, T_world_cam: Array, view: View | None = None) -> Array:
        """Inverse depth [h, w] in 1/m of what stands still, 0 where there is nothing, by a camera of any size."""
        T_cam_world = np.linalg.inv(T_world_cam)
        T_cam_mesh = np.stack((T_cam_world, T_cam_world))
        nearest, _, _ = raster.visible(self.emptied().scene.mesh, T_cam_mesh, view or self.view, raster.OFFSETS[:1])
        return np.asarray(nearest[0])


def furnished_studio(
    width: int, height: int, seed: int, *, moving_object: bool, workers: Executor, place: Name = "apartment"
) -> Studio:
    """Build a place and its light: a few seconds.

    Args:
        width: Of the pictures, pixels.
        height: Of the pictures, pixels.
        seed: Of colours, books and what lies about.
        moving_object: Whether there is somebody in it.
        workers: Threads to share the work.
        place: What to build.
    """
    scene = compiled(PLACES[place].furnished(seed), apartment.person() if moving_object else [], seed, workers)
    # Light need not be finer than what a pixel sees from some three metres away.
    direct, indirect = lighting.lit(scene, float(np.clip(16 / width, 0.04, 0.25)), workers)
    focal = 0.5 * width / np.tan(np.radians(_FIELD_OF_VIEW / 2))
    return Studio(scene, direct, indirect, View(width, height, float(focal), (width - 1) / 2, (height - 1) / 2))
