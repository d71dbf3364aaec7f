"""Views beside the walk: from free space, at what the walk has seen, from where it was not."""

from concurrent.futures import Executor
from typing import Any

import numpy as np
from numba import njit

from tcgsplat.datasets.synthetic import raster, sensor
from tcgsplat.datasets.synthetic.raster import View
from tcgsplat.datasets.synthetic.studio import Studio

Array = np.ndarray[Any, np.dtype[Any]]

CLEARANCE = 0.40
"""Metres to the nearest surface, at least."""
APART = 0.20
"""Metres to every place of the camera on its walk, at least."""
SEEN = 0.80
"""Part of the pixels whose points the walk has seen, at least."""

_SEARCHED = 0.86
"""The same in the small pictures that are searched with, with something to spare for their coarseness."""
_REACH, _RISE = 0.85, 0.35
"""Metres away from the walk, at most: across and up or down."""
_YAW, _PITCH = 35.0, 12.0
"""Degrees away from a view of the walk, at most."""
_WIDTH = 80
"""Of the pictures that are searched with, pixels."""
_GLANCES = 80
"""Frames of the walk, about, whose depth says what it has seen."""
_TRIES = 400
"""For one view; a quarter of them near its own part of the walk, the others anywhere."""
_HIDDEN = 1.03
"""What is farther than the surface in a glance by this factor is hidden in it."""


def free_poses(studio: Studio, walk: Array, count: int, seed: int, workers: Executor) -> Array:
    """Poses of views that the walk allows to judge a map by.

    Args:
        studio: The place; what moves is not in the way.
        walk: [n, 4, 4] poses `T_world_cam` of the camera on its walk.
        count: How many; fewer where a short walk has seen too little.
        seed: Of the choice.
        workers: Threads to share the work; the result does not depend on how many.

    Returns:
        `T_world_cam` [count, 4, 4] float64, spread over the walk.
    """
    view = _small(studio.view)
    glances = walk[:: max(1, len(walk) // _GLANCES)]
    empty = studio.emptied()
    seen = np.stack(list(workers.map(lambda T: empty.inverse_depth(T, view), glances)))
    T_cam_world = np.linalg.inv(glances)
    vertices, triangles = empty.scene.static_mesh()
    corners = vertices[triangles]
    lower, upper = corners.min(axis=1), corners.max(axis=1)

    def fits(T: Array, origin: Array) -> bool:
        place = T[:3, 3]
        if np.linalg.norm(walk[:, :3, 3] - place, axis=1).min() < APART:
            return False
        # Spheres that overlap lead from the walk to there, so no wall stands between.
        between = (origin + f * (place - origin) for f in (0.25, 0.5, 0.75))
        if _clearance(lower, upper, place) < CLEARANCE or min(_clearance(lower, upper, p) for p in between) < 0.2:
            return False
        points = _points(empty.inverse_depth(T, view), T, view)
        return bool(_share_seen(points, T_cam_world, seen, view) >= _SEARCHED)

    def find(k: int) -> Array | None:
        rng = sensor.generator(seed, sensor.Effect.FREE, k)
        for attempt in range(_TRIES):
            part = (k + rng.uniform()) / count if attempt < _TRIES // 4 else rng.uniform()
            start = walk[int(part * len(walk))]
            T = _beside(start, rng)
            if fits(T, start[:3, 3]):
                return T
        return None

    found = [T for T in workers.map(find, range(count)) if T is not None]
    return np.stack(found) if found else np.zeros((0, 4, 4))


def _small(view: View) -> View:
    """The same field of view, in few pixels."""
    scale = _WIDTH / view.width
    height = round(scale * view.height)
    return View(_WIDTH, height, scale * view.focal, (_WIDTH - 1) / 2, (height - 1) / 2)


def _beside(T_world_cam: Array, rng: np.random.Generator) -> Array:
    """A pose some way off, turned a little."""
    bearing, far, rise = rng.uniform(0, 2 * np.pi), rng.uniform(APART, _REACH), rng.uniform(-_RISE, _RISE)
    yaw, pitch = np.radians(rng.uniform(-_YAW, _YAW)), np.radians(rng.uniform(-_PITCH, _PITCH))
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    T = T_world_cam.copy()
    T[:3, :3] = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ T[:3, :3]
    T[:3, :3] = T[:3, :3] @ np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    T[:3, 3] += far * np.cos(bearing), far * np.sin(bearing), rise
    return T


def _points(inverse: Array, T_world_cam: Array, view: View) -> Array:
    """World points [k, 3] of an image of inverse depth [h, w], metres; pixels that see nothing are left out."""
    v, u = np.nonzero(inverse)
    rays = np.stack(((u - view.cx) / view.focal, (v - view.cy) / view.focal, np.ones(len(u))), axis=1)
    points: Array = rays / inverse[v, u, None] @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    return points


@njit(nogil=True, cache=True)
def _clearance(lower: Array, upper: Array, point: Array) -> float:
    """Distance from a point to the nearest of boxes [t, 3] around triangles: no more than that to a triangle."""
    best = 1e30
    for n in range(len(lower)):
        square = 0.0
        for c in range(3):
            away = max(lower[n, c] - point[c], 0.0, point[c] - upper[n, c])
            square += away * away
        best = min(best, square)
    return float(np.sqrt(best))


@njit(nogil=True, cache=True)
def _share_seen(points: Array, T_cam_world: Array, inverse: Array, view: View) -> float:
    """Part of world points [k, 3] that some of the images of inverse depth [n, h, w] with poses [n, 4, 4] show.

    Inverse depth is affine over the image of a plane, so between four pixels it is interpolated exactly there.
    """
    count = 0
    for k in range(len(points)):
        for n in range(len(inverse)):
            T = T_cam_world[n]
            z = T[2, 0] * points[k, 0] + T[2, 1] * points[k, 1] + T[2, 2] * points[k, 2] + T[2, 3]
            if z < raster.NEAR:
                continue
            x = T[0, 0] * points[k, 0] + T[0, 1] * points[k, 1] + T[0, 2] * points[k, 2] + T[0, 3]
            y = T[1, 0] * points[k, 0] + T[1, 1] * points[k, 1] + T[1, 2] * points[k, 2] + T[1, 3]
            u, v = view.focal * x / z + view.cx, view.focal * y / z + view.cy
            if u < 0 or v < 0 or u >= view.width - 1 or v >= view.height - 1:
                continue
            column, row = int(u), int(v)
            fu, fv = u - column, v - row
            upper = (1 - fu) * inverse[n, row, column] + fu * inverse[n, row, column + 1]
            below = (1 - fu) * inverse[n, row + 1, column] + fu * inverse[n, row + 1, column + 1]
            if z * ((1 - fv) * upper + fv * below) <= _HIDDEN:
                count += 1
                break
    return count / max(len(points), 1)
