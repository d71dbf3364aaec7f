"""Light that does not depend on the camera, computed once: from windows and lamps, and after one reflection.

Whatever glows is a light: a few points on it send rays to each sample of the light maps, which gives soft shadows.
Then each sample gathers what the surfaces around it reflect, which darkens corners and lets colours bleed. Radiance
is relative; irradiance is stored divided by pi, so that a white surface has the radiance that its light map says.
"""

from collections.abc import Iterator
from concurrent.futures import Executor
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from tcgsplat.datasets.synthetic.raster import LightMap, add_light, cross
from tcgsplat.datasets.synthetic.raycast import Tree, cast, tree
from tcgsplat.datasets.synthetic.scene import Mesh, Paint, Scene

Array = np.ndarray[Any, np.dtype[Any]]

_LIFT = 0.004
"""Samples stand off their surface by this much, metres, more than a polygon cuts off a circle here."""
_INSET = 0.015
"""Samples at a patch's border move inwards by this much, metres, out of the neighbour that stands on it."""
_AMBIENT = 0.06
"""Radiance that stands for light reflected twice and more."""
_FAINT = 2e-4
"""A lamp's point that adds less than this is taken for seen."""
_GATHER = 8
"""Squared, the rays that gather reflected light."""


class Lights(NamedTuple):
    """Points on everything that glows."""

    point: Array
    """[l, k, 3] metres, world frame; neighbours in k lie far apart."""
    normal: Array
    """[l, k, 3] unit, or zero for what shines to both sides."""
    power: Array
    """[l, k, 3] radiance times area of each point, divided by pi."""


class Workspace(NamedTuple):
    """Memory that a kernel reuses from sample to sample, since allocating costs more than the arithmetic."""

    sample: Array
    """[2, 3] the sample's position, metres, and its unit normal."""
    rows: Array
    """[7, 3] vectors."""
    stack: Array
    """[64] int32 nodes of the tree."""


def lit(scene: Scene, spacing: float, workers: Executor) -> tuple[LightMap, LightMap]:
    """Direct and reflected light.

    Args:
        scene: Geometry and paint.
        spacing: Between samples of direct light, metres; reflected light, which is smoother, has them four times
            as far apart.
        workers: Threads to share the work; the result does not depend on how many.
    """
    mesh, paint = scene.mesh, scene.paint
    dark = paint.power[paint.material[mesh.patch]] == 0
    casts = np.flatnonzero(dark & (mesh.moves[mesh.patch] == 0))
    shadows = tree(mesh.vertices, mesh.triangles[casts], casts)
    lights = _lights(mesh, paint)
    direct, indirect = _empty(mesh, spacing), _empty(mesh, 4 * spacing)
    for _ in workers.map(lambda span: _shine(span[0], span[1], mesh, direct, shadows, lights), _spans(mesh)):
        pass
    for _ in workers.map(lambda span: _gather(span[0], span[1], mesh, paint, direct, indirect, shadows), _spans(mesh)):
        pass
    return direct, indirect


def _spans(mesh: Mesh, size: int = 64) -> Iterator[tuple[int, int]]:
    """Ranges of patches."""
    count = len(mesh.moves)
    return ((first, min(first + size, count)) for first in range(0, count, size))


def _empty(mesh: Mesh, spacing: float) -> LightMap:
    """Dark maps whose samples are about `spacing` metres apart."""
    size = np.maximum(2, np.ceil(mesh.span / spacing).astype(np.int64) + 1)
    first = np.concatenate(([0], np.cumsum(size.prod(axis=1))))
    return LightMap(first[:-1], size, np.zeros((first[-1], 3), dtype=np.float32))


def _lights(mesh: Mesh, paint: Paint) -> Lights:
    """Four by four points on each glowing patch, each for the part of the surface around it."""
    glowing = np.flatnonzero((paint.power[paint.material] > 0) & (mesh.moves == 0))
    # Four points that are spread over the whole patch, then their neighbours.
    cells = [(2 * (b % 2) + a % 2, 2 * (b // 2) + a // 2) for a in range(4) for b in range(4)]
    point, normal, power = (np.zeros((len(glowing), 16, 3)) for _ in range(3))
    at = np.empty((3, 3))
    for n, p in enumerate(glowing.tolist()):
        color = paint.mean[paint.material[p]] * paint.tint[p] * paint.power[paint.material[p]] / np.pi
        for k, (i, j) in enumerate(cells):
            _surface(mesh, p, (i + 0.5) / 4, (j + 0.5) / 4, at)
            point[n, k] = at[0]
            outward = np.cross(at[2], at[1])
            area = float(np.linalg.norm(outward))
            normal[n, k] = 0.0 if mesh.two_sided[p] else outward / area
            # Something that shines to both sides has no cosine at its end: a half, which is the mean.
            power[n, k] = color * area / 16 * (0.5 if mesh.two_sided[p] else 1.0)
    return Lights(point, normal, power)


@njit(nogil=True, cache=True)
def _surface(mesh: Mesh, patch: int, s: float, t: float, out: Array) -> None:
    """Write point (s, t) of a patch and its derivatives by s and by t, metres, into three rows."""
    columns = mesh.columns[patch]
    rows = (mesh.first_vertex[patch + 1] - mesh.first_vertex[patch]) // columns
    x, y = s * (columns - 1), t * (rows - 1)
    column, row = min(int(x), columns - 2), min(int(y), rows - 2)
    fx, fy = x - column, y - row
    at = mesh.first_vertex[patch] + row * columns + column
    for k in range(3):
        a, b = mesh.vertices[at, k], mesh.vertices[at + 1, k]
        c, d = mesh.vertices[at + columns, k], mesh.vertices[at + columns + 1, k]
        out[0, k] = (1 - fy) * ((1 - fx) * a + fx * b) + fy * ((1 - fx) * c + fx * d)
        out[1, k] = ((1 - fy) * (b - a) + fy * (d - c)) * (columns - 1)
        out[2, k] = ((1 - fx) * (c - a) + fx * (d - b)) * (rows - 1)


@njit(nogil=True, cache=True)
def _stand(mesh: Mesh, patch: int, s: float, t: float, space: Workspace) -> None:
    """Write the position and the normal of a light map's sample."""
    at, scratch = space.sample, space.rows
    _surface(mesh, patch, s, t, scratch)
    inset_s, inset_t = min(0.25, _INSET / _norm(scratch[1])), min(0.25, _INSET / _norm(scratch[2]))
    s, t = min(max(s, inset_s), 1 - inset_s), min(max(t, inset_t), 1 - inset_t)
    # A normal from differences across a cell is smooth where the mesh has an edge.
    rows = (mesh.first_vertex[patch + 1] - mesh.first_vertex[patch]) // mesh.columns[patch]
    h, g = 0.5 / (mesh.columns[patch] - 1), 0.5 / (rows - 1)
    for k, (x, y) in enumerate(
        ((min(s + h, 1.0), t), (max(s - h, 0.0), t), (s, min(t + g, 1.0)), (s, max(t - g, 0.0)))
    ):
        _surface(mesh, patch, x, y, scratch)
        for c in range(3):
            scratch[3 + k, c] = scratch[0, c]
    for k in range(3):
        scratch[1, k] = scratch[3, k] - scratch[4, k]
        scratch[2, k] = scratch[5, k] - scratch[6, k]
    cross(scratch[2], scratch[1], at[1])
    length = _norm(at[1])
    _surface(mesh, patch, s, t, scratch)
    for k in range(3):
        at[1, k] /= length
        at[0, k] = scratch[0, k] + _LIFT * at[1, k]


@njit(nogil=True, cache=True)
def _norm(x: Array) -> float:
    return float(max(np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]), 1e-9))


@njit(nogil=True, cache=True)
def _shine(first: int, last: int, mesh: Mesh, light: LightMap, shadows: Tree, lights: Lights) -> None:
    """Light of all lamps and windows on the patches `first` to `last`."""
    space = Workspace(np.empty((2, 3)), np.empty((7, 3)), np.empty(64, dtype=np.int32))
    for patch in range(first, last):
        width, height = light.size[patch]
        for row in range(height):
            for column in range(width):
                _stand(mesh, patch, column / (width - 1), row / (height - 1), space)
                out = light.irradiance[light.first[patch] + row * width + column]
                for lamp in range(len(lights.point)):
                    _add_lamp(lamp, mesh.two_sided[patch], shadows, lights, space, out)


@njit(nogil=True, cache=True)
def _add_lamp(lamp: int, two_sided: bool, shadows: Tree, lights: Lights, space: Workspace, out: Array) -> None:
    """Light of one lamp; where its first four points agree on being seen or hidden, the others are not asked."""
    at, normal, origin, toward = space.sample[0], space.sample[1], space.rows[0], space.rows[1]
    weight, seen, asked, tried = 0.0, 0, 0, 0
    for k in range(lights.point.shape[1]):
        if asked == 4 and (seen == 0 or seen == 4):
            break
        tried += 1
        for c in range(3):
            toward[c] = lights.point[lamp, k, c] - at[c]
        square = toward[0] ** 2 + toward[1] ** 2 + toward[2] ** 2
        cosine = toward[0] * normal[0] + toward[1] * normal[1] + toward[2] * normal[2]
        back = two_sided and cosine < 0
        if back:
            cosine = -cosine
        away = lights.normal[lamp, k]
        emitted = -(toward[0] * away[0] + toward[1] * away[1] + toward[2] * away[2])
        if away[0] == 0 and away[1] == 0 and away[2] == 0:
            emitted = np.sqrt(square)
        if cosine <= 0 or emitted <= 0:
            continue
        # A lamp next to its own wall would burn a hole into the map: nothing is nearer than 15 cm.
        form = cosine * emitted / max(square, 0.0225) ** 2
        weight += form
        asked += 1
        for c in range(3):
            origin[c] = at[c] - (2 * _LIFT * normal[c] if back else 0.0)
            toward[c] = lights.point[lamp, k, c] - origin[c]
        faint = form * lights.power[lamp, k, 0] < _FAINT
        if faint or cast(shadows, origin, toward, 0.999, True, space.stack)[1] < 0:
            seen += 1
    if seen > 0:
        scale = weight * (seen / asked) * (lights.point.shape[1] / tried)
        for c in range(3):
            out[c] += scale * lights.power[lamp, 0, c]


@njit(nogil=True, cache=True)
def _gather(
    first: int, last: int, mesh: Mesh, paint: Paint, direct: LightMap, indirect: LightMap, shadows: Tree
) -> None:
    """Light that the surroundings reflect on the patches `first` to `last`."""
    space = Workspace(np.empty((2, 3)), np.empty((7, 3)), np.empty(64, dtype=np.int32))
    for patch in range(first, last):
        width, height = indirect.size[patch]
        covered = np.zeros((height, width), dtype=np.int64)
        for row in range(height):
            for column in range(width):
                _stand(mesh, patch, column / (width - 1), row / (height - 1), space)
                n = indirect.first[patch] + row * width + column
                out = indirect.irradiance[n]
                covered[row, column] = _gather_at(n, mesh, paint, direct, shadows, space, out)
        _fill_covered(covered, indirect, patch)


@njit(nogil=True, cache=True)
def _gather_at(
    salt: int, mesh: Mesh, paint: Paint, direct: LightMap, shadows: Tree, space: Workspace, out: Array
) -> bool:
    """Sum over rays spread by the cosine law, turned by `salt`; True if something covers or holds the sample."""
    at, normal = space.sample[0], space.sample[1]
    tangent, other, direction, across, light = space.rows[0], space.rows[1], space.rows[2], space.rows[3], space.rows[4]
    steep = abs(normal[2]) > 0.9
    tangent[0], tangent[1], tangent[2] = 0.0, normal[2], -normal[1]  # normal x (1, 0, 0)
    if not steep:
        tangent[0], tangent[1], tangent[2] = normal[1], -normal[0], 0.0  # normal x (0, 0, 1)
    length = _norm(tangent)
    for c in range(3):
        tangent[c] /= length
    cross(normal, tangent, other)
    turn = ((salt * 2654435761) & 0xFFFFFFFF) / 4294967296.0
    covered = 0
    for i in range(_GATHER):
        radius = np.sqrt((i + 0.5) / _GATHER)
        rise = np.sqrt(1 - radius * radius)
        for j in range(_GATHER):
            angle = 2 * np.pi * ((j + turn + 0.618 * i) / _GATHER)
            x, y = radius * np.cos(angle), radius * np.sin(angle)
            for c in range(3):
                direction[c] = x * tangent[c] + y * other[c] + rise * normal[c]
            distance, hit, b, c2 = cast(shadows, at, direction, 20.0, False, space.stack)
            if hit < 0:
                for c in range(3):
                    out[c] += _AMBIENT / _GATHER**2
                continue
            triangle = shadows.source[hit]
            p = mesh.patch[triangle]
            cross(shadows.corner[hit, 1], shadows.corner[hit, 2], across)
            facing = across[0] * direction[0] + across[1] * direction[1] + across[2] * direction[2]
            if (facing > 0 and not mesh.two_sided[p]) or distance < 0.03:
                covered += 1
                continue
            i0, i1, i2 = mesh.triangles[triangle]
            s = (1 - b - c2) * mesh.st[i0, 0] + b * mesh.st[i1, 0] + c2 * mesh.st[i2, 0]
            t = (1 - b - c2) * mesh.st[i0, 1] + b * mesh.st[i1, 1] + c2 * mesh.st[i2, 1]
            light[0] = light[1] = light[2] = _AMBIENT
            add_light(direct, p, s, t, light)
            for c in range(3):
                out[c] += paint.mean[paint.material[p], c] * paint.tint[p, c] * light[c] / _GATHER**2
    return 2 * covered > _GATHER**2


@njit(nogil=True, cache=True)
def _fill_covered(covered: Array, light: LightMap, patch: int) -> None:
    """Samples that something covers take the mean of their open neighbours, ring after ring."""
    height, width = covered.shape
    for ring in range(1, 5):
        for row in range(height):
            for column in range(width):
                if covered[row, column] != 1:
                    continue
                out = light.irradiance[light.first[patch] + row * width + column]
                red, green, blue, count = 0.0, 0.0, 0.0, 0
                for y in range(max(row - 1, 0), min(row + 2, height)):
                    for x in range(max(column - 1, 0), min(column + 2, width)):
                        # Open from the start, or filled in an earlier ring, which its negative number tells.
                        if covered[y, x] == 0 or -ring < covered[y, x] < 0:
                            value = light.irradiance[light.first[patch] + y * width + x]
                            red, green, blue, count = red + value[0], green + value[1], blue + value[2], count + 1
                if count > 0:
                    out[0], out[1], out[2] = red / count, green / count, blue / count
                    covered[row, column] = -ring
