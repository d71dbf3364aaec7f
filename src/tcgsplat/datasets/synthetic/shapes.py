"""Pieces of surface, and the solids made of them: boxes, things turned on a lathe, cushions, tubes, sheets, leaves.

A patch is a grid of points with texture coordinates (s, t) in [0, 1]: seen from outside, s runs right and t runs
down, as in an image, so its outward normal is dP/dt x dP/ds. Metres; z is up.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

Array = np.ndarray[Any, np.dtype[Any]]

Vector = tuple[float, float, float]
WHITE: Vector = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Patch:
    """A flat or curved piece of surface with one material."""

    points: Array
    """Grid [rows + 1, columns + 1, 3] in metres; columns run along s, rows along t."""
    material: str
    """Name of its material, see `materials.py`."""
    extent: tuple[float, float] = (1.0, 1.0)
    """Length along s and t that the texture sees, metres."""
    origin: tuple[float, float] | None = None
    """Texture coordinate of (s, t) = (0, 0) in metres; None lets the texture start anywhere."""
    tint: Vector = WHITE
    """Factor on the texture's linear colour."""
    turned: bool = False
    """The texture's u axis runs along t: grain along the other side."""


def panel(
    corner: Vector, right: Vector, down: Vector, material: str, *, tint: Vector = WHITE, turned: bool = False
) -> Patch:
    """The parallelogram that spans `right` and `down` from its upper left corner, seen from outside."""
    a, r, d = np.asarray(corner), np.asarray(right), np.asarray(down)
    points = np.array([[a, a + r], [a + d, a + r + d]], dtype=np.float64)
    extent = (float(np.linalg.norm(r)), float(np.linalg.norm(d)))
    return Patch(points, material, extent, tint=tint, turned=turned)


def box(
    size: Vector, material: str, *, at: Vector = (0, 0, 0), tint: Vector = WHITE, top: str = "", front: str = ""
) -> list[Patch]:
    """A cuboid whose base is centred at `at`; grain runs along its longest side, the front faces -y.

    Args:
        size: Extent along x, y, z in metres.
        material: Material of all faces but those named.
        at: Centre of the base.
        tint: Factor on the colour of the faces of `material`.
        top: Another material for the top face.
        front: Another material for the face towards -y, upright.
    """
    sx, sy, sz = size
    x0, y0, z0 = at[0] - sx / 2, at[1] - sy / 2, at[2]
    x1, y1, z1 = x0 + sx, y0 + sy, z0 + sz
    faces = (
        ((x0, y0, z1), (sx, 0, 0), (0, 0, -sz), front),
        ((x1, y0, z1), (0, sy, 0), (0, 0, -sz), ""),
        ((x1, y1, z1), (-sx, 0, 0), (0, 0, -sz), ""),
        ((x0, y1, z1), (0, -sy, 0), (0, 0, -sz), ""),
        ((x0, y1, z1), (sx, 0, 0), (0, -sy, 0), top),
        ((x0, y0, z0), (sx, 0, 0), (0, sy, 0), ""),
    )
    patches = []
    for corner, right, down, own in faces:
        turned = not own and float(np.linalg.norm(down)) > float(np.linalg.norm(right))
        patches.append(panel(corner, right, down, own or material, tint=WHITE if own else tint, turned=turned))
    return patches


def lathe(
    profile: Sequence[tuple[float, float]],
    material: str,
    *,
    at: Vector = (0, 0, 0),
    segments: int = 24,
    tint: Vector = WHITE,
    turned: bool = False,
) -> list[Patch]:
    """The surface that a profile sweeps around the vertical axis through `at`.

    Args:
        profile: (radius, height) in metres, from the top down the outside; radius 0 closes it.
        material: Material of the whole surface.
        at: Point of the axis that heights count from.
        segments: Sides of the polygon that stands for a circle.
        tint: Factor on the colour.
        turned: Grain along the profile instead of around the axis.
    """
    radius, height = np.array(profile, dtype=np.float64).T
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    angle[-1] = 0.0  # the seam closes exactly
    grid = np.stack(np.broadcast_arrays(radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)), axis=-1)
    points = np.concatenate((grid, np.broadcast_to(height[:, None, None], (*grid.shape[:2], 1))), axis=-1)
    along = float(np.hypot(np.diff(radius), np.diff(height)).sum())
    extent = (2 * np.pi * float(radius.max()), along)
    return [Patch(points + np.asarray(at), material, extent, tint=tint, turned=turned)]


def cylinder(
    radius: float, height: float, material: str, *, at: Vector = (0, 0, 0), segments: int = 16, tint: Vector = WHITE
) -> list[Patch]:
    """An upright closed cylinder whose base is centred at `at`."""
    side = lathe(
        [(radius, height), (radius, 0)], material, at=at, segments=segments, tint=tint, turned=height > 4 * radius
    )
    top = lathe([(0, height), (radius, height)], material, at=at, segments=segments, tint=tint)
    bottom = lathe([(radius, 0), (0, 0)], material, at=at, segments=segments, tint=tint)
    return side + top + bottom


def ball(radius: float, material: str, *, at: Vector = (0, 0, 0), rings: int = 14, tint: Vector = WHITE) -> list[Patch]:
    """A sphere around `at`."""
    polar = np.linspace(0, np.pi, rings + 1)
    profile = list(zip(np.abs(radius * np.sin(polar)).round(12), radius * np.cos(polar), strict=True))
    return lathe(profile, material, at=at, segments=2 * rings, tint=tint)


def cushion(
    size: Vector, material: str, *, at: Vector = (0, 0, 0), tint: Vector = WHITE, edge: float = 0.35, cells: int = 7
) -> list[Patch]:
    """A superellipsoid, that is a box with soft edges: a cube's six grids pushed onto |x|^n + |y|^n + |z|^n = 1.

    Args:
        size: Extent along x, y, z in metres.
        material: Material of all of it.
        at: Centre of the base.
        tint: Factor on the colour.
        edge: 2 / n: near 0 is a box, 1 an ellipsoid.
        cells: Cells along each side of the six grids.
    """
    knots = np.tan(np.linspace(-1, 1, cells + 1) * np.pi / 4)
    faces = []
    for face in box((2, 2, 2), material, at=(0, 0, -1), tint=tint):
        a, b, c = face.points[0, 0], face.points[0, 1], face.points[1, 0]
        cube = (b + c) / 2 + knots[None, :, None] * (b - a) / 2 + knots[:, None, None] * (c - a) / 2
        power = 2 / edge
        points = cube / (np.abs(cube) ** power).sum(axis=-1, keepdims=True) ** (1 / power)
        half = np.asarray(size) / 2
        extent = (float(np.linalg.norm((b - a) * half)), float(np.linalg.norm((c - a) * half)))
        faces.append(Patch(points * half + np.asarray(at) + (0, 0, half[2]), material, extent, tint=tint))
    return faces


def tube(path: Sequence[Vector], radius: float, material: str, *, tint: Vector = WHITE, sides: int = 8) -> list[Patch]:
    """A pipe along a polyline: taps, handles, stems, chair legs that lean."""
    line = np.array(path, dtype=np.float64)
    forward = np.gradient(line, axis=0)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    aside = np.cross(forward, (0.31, 0.87, 0.39))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    circle = np.cos(angle)[:, None] * aside[:, None] - np.sin(angle)[:, None] * np.cross(forward, aside)[:, None]
    length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    return [Patch(line[:, None] + radius * circle, material, (2 * np.pi * radius, length), tint=tint, turned=True)]


def sheet(points: Array, material: str, extent: tuple[float, float], *, tint: Vector = WHITE) -> list[Patch]:
    """A free surface given by its grid [rows + 1, columns + 1, 3]: curtains, leaves, pages."""
    return [Patch(np.asarray(points, dtype=np.float64), material, extent, tint=tint)]


def placed(patches: Iterable[Patch], at: Vector, *, yaw: float = 0.0, tilt: float = 0.0) -> list[Patch]:
    """Patches turned by `tilt` about x, then by `yaw` about z (degrees), and moved to `at`."""
    c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    ct, st = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, ct, -st], [0, st, ct]])
    return [replace(patch, points=patch.points @ R.T + np.asarray(at)) for patch in patches]
