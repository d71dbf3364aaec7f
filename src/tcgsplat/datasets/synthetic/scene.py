"""The apartment as flat arrays: triangles, textures with their mip maps, and light maps; what the kernels read."""

from collections.abc import Sequence
from concurrent.futures import Executor
from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np

from tcgsplat.datasets.synthetic import materials
from tcgsplat.datasets.synthetic.materials import Material
from tcgsplat.datasets.synthetic.shapes import Patch

Array = np.ndarray[Any, np.dtype[Any]]

GAMMA = 2.2
"""Displayed colour is linear light to the power of 1 / GAMMA."""


class Mesh(NamedTuple):
    """Triangles of every patch, wound anticlockwise seen from outside; the static ones come first."""

    vertices: Array
    """[v, 3] float64 metres in the world frame, each exactly a float32, so that mesh files lose nothing."""
    st: Array
    """[v, 2] float64 place in the vertex's patch."""
    triangles: Array
    """[t, 3] int32 vertices."""
    patch: Array
    """[t] int32 patch of each triangle."""
    two_sided: Array
    """[p] bool."""
    moves: Array
    """[p] int64: 1 for patches of the moving object, which live in its own frame, else 0."""
    first_vertex: Array
    """[p + 1] int64: vertices of patch p are first_vertex[p] to first_vertex[p + 1], row by row."""
    first_triangle: Array
    """[p + 1] int64: the same for its triangles."""
    sphere: Array
    """[p, 4] float64: centre and radius of a sphere around each patch, metres."""
    span: Array
    """[p, 2] float64 length of each patch along s and along t, metres."""
    columns: Array
    """[p] int64 vertices in a row of the patch's grid."""


class Paint(NamedTuple):
    """Textures with their mip maps, and how each patch wears one."""

    texels: Array
    """[n, 3] uint8 square root of linear colour, all mip levels of all materials."""
    first_texel: Array
    """[m, 12] int64 first texel of each mip level."""
    size: Array
    """[m, 3] int64 width, height and number of mip levels."""
    mean: Array
    """[m, 3] float64 mean linear colour."""
    emission: Array
    """[m] float64 radiance of white."""
    power: Array
    """[m] float64 the same as far as it lights the room."""
    material: Array
    """[p] int64 material of each patch."""
    uv: Array
    """[p, 2, 3] float64 affine map from (s, t, 1) to texture repeats (u, v)."""
    tint: Array
    """[p, 3] float64 factor on linear colour."""


class Scene(NamedTuple):
    """Geometry, paint, and what a depth sensor makes of it."""

    mesh: Mesh
    paint: Paint
    shine: Array
    """[p] float64, see `Material.shine`."""

    def static_mesh(self) -> tuple[Array, Array]:
        """Vertices [v, 3] and triangles [t, 3] of all that stands still."""
        count = int((self.mesh.moves == 0).sum())
        return self.mesh.vertices[: self.mesh.first_vertex[count]], self.mesh.triangles[
            : self.mesh.first_triangle[count]
        ]


def compiled(static: Sequence[Patch], moving: Sequence[Patch], seed: int, workers: Executor) -> Scene:
    """Patches as arrays, with every material they name painted from `seed`."""
    patches = [*static, *moving]
    names = sorted({patch.material for patch in patches})
    table = materials.make(names, seed, workers)
    worn = np.array([names.index(patch.material) for patch in patches])
    moves = np.array([0] * len(static) + [1] * len(moving), dtype=np.int64)
    return Scene(
        mesh=_mesh(patches, np.array([material.two_sided for material in table])[worn], moves),
        paint=_paint(patches, table, worn, seed),
        shine=np.array([material.shine for material in table])[worn],
    )


def _mesh(patches: Sequence[Patch], two_sided: Array, moves: Array) -> Mesh:
    """Two triangles for each cell of each patch's grid, without those that a pole has shrunk to nothing."""
    vertices, st, triangles, sphere, span = [], [], [], [], []
    first_vertex, first_triangle = [0], [0]
    for patch in patches:
        rows, columns = patch.points.shape[:2]
        places, corners = _grid(rows, columns)
        grid = patch.points.astype(np.float32).astype(np.float64)
        points = grid.reshape(-1, 3)
        if corners.size > 6:
            edges = points[corners[:, 1:]] - points[corners[:, :1]]
            corners = corners[np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) > 1e-10]
        low, high = points.min(axis=0), points.max(axis=0)
        sphere.append([*(0.5 * (low + high)), 0.5 * float(np.linalg.norm(high - low))])
        span.append([_longest(grid), _longest(grid.transpose(1, 0, 2))])
        vertices.append(points)
        st.append(places)
        triangles.append(corners + first_vertex[-1])
        first_vertex.append(first_vertex[-1] + len(points))
        first_triangle.append(first_triangle[-1] + len(corners))
    return Mesh(
        vertices=np.concatenate(vertices), st=np.concatenate(st),
        triangles=np.concatenate(triangles).astype(np.int32), 
        patch=np.repeat(np.arange(len(patches)), np.diff(first_triangle)).astype(np.int32),
        two_sided=two_sided, moves=moves,
        first_vertex=np.array(first_vertex), first_triangle=np.array(first_triangle), sphere=np.array(sphere),
        span=np.array(span),
        columns=np.array([patch.points.shape[1] for patch in patches]),
    )  # fmt: skip


@cache
def _grid(rows: int, columns: int) -> tuple[Array, Array]:
    """Places (s, t) [rows * columns, 2] of a grid's vertices, and its triangles [2 * cells, 3]."""
    t, s = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    a = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)[None]).ravel()
    b, c, d = a + columns, a + columns + 1, a + 1
    return np.stack((s.ravel(), t.ravel()), axis=1), np.concatenate(
        (np.stack((a, b, c), axis=1), np.stack((a, c, d), axis=1))
    )


def _longest(grid: Array) -> float:
    """Length of the longest row of a grid [rows, columns, 3]."""
    steps = grid[:, 1:] - grid[:, :-1]
    return float(np.sqrt((steps * steps).sum(axis=2)).sum(axis=1).max())


def _paint(patches: Sequence[Patch], table: list[Material], worn: Array, seed: int) -> Paint:
    pyramids = [_mip_maps(material.texture) for material in table]
    first = np.zeros((len(table), 12), dtype=np.int64)
    size = np.zeros((len(table), 3), dtype=np.int64)
    texels, count = [], 0
    for m, levels in enumerate(pyramids):
        size[m] = levels[0].shape[1], levels[0].shape[0], len(levels)
        for k, level in enumerate(levels):
            first[m, k] = count
            texels.append(np.round(255 * np.sqrt(level)).astype(np.uint8).reshape(-1, 3))
            count += level.shape[0] * level.shape[1]
    rng = np.random.default_rng((seed, 2))
    return Paint(
        texels=np.concatenate(texels), first_texel=first, size=size,
        mean=np.array([levels[0].mean(axis=(0, 1)) for levels in pyramids], dtype=np.float64),
        emission=np.array([material.emission for material in table]),
        power=np.array([material.power for material in table]),
        material=worn.astype(np.int64),
        uv=np.stack([_uv(patch, table[m], rng) for patch, m in zip(patches, worn, strict=True)]),
        tint=np.array([patch.tint for patch in patches], dtype=np.float64),
    )  # fmt: skip


def _mip_maps(texture: Array) -> list[Array]:
    """The texture as linear light, then each level the mean of two by two texels of the one before."""
    levels: list[Array] = [(np.clip(texture, 0, 1) ** GAMMA).astype(np.float32)]
    while min(levels[-1].shape[:2]) > 1:
        h, w = levels[-1].shape[:2]
        levels.append(cv2.resize(levels[-1], (w // 2, h // 2), interpolation=cv2.INTER_AREA))
    return levels


def _uv(patch: Patch, material: Material, rng: np.random.Generator) -> Array:
    """The affine map from (s, t, 1) to repeats of the texture."""
    if material.size is None:
        return np.array([[1.0, 0, 0], [0, 1.0, 0]])
    anywhere = rng.uniform(0, 1, 2)
    (ds, dt), (width, height) = patch.extent, material.size
    u0, v0 = (patch.origin[0] / width, patch.origin[1] / height) if patch.origin else anywhere
    if patch.turned:
        return np.array([[0, dt / width, u0], [ds / height, 0, v0]])
    return np.array([[ds / width, 0, u0], [0, dt / height, v0]])
