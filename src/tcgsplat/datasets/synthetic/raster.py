"""Exact images of the apartment: for every ray the nearest triangle, then its texture and light.

Ray and triangle are intersected in closed form: with corners p0, p1, p2 in the camera frame, the ray r = (x, y, 1)
meets the plane where [p0 p1 p2] w = r, so the three weights w are affine in the pixel (u, v), the ray is inside where
none is negative, and the depth along the optical axis is 1 / (w0 + w1 + w2). What is nearest is settled in a buffer of
inverse depths, triangle by triangle, which gives the same as a ray caster without a search tree.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from tcgsplat.datasets.synthetic.scene import Mesh, Paint

Array = np.ndarray[Any, np.dtype[Any]]

NEAR = 0.02
"""Nothing nearer to the camera's plane is drawn, metres."""


class LightMap(NamedTuple):
    """Irradiance over each patch, on a grid whose outermost samples lie on the patch's border."""

    first: Array
    """[p] int64 first sample of each patch."""
    size: Array
    """[p, 2] int64 samples along s and t."""
    irradiance: Array
    """[n, 3] float32, divided by pi: radiance of a white surface."""


class View(NamedTuple):
    """Pinhole intrinsics in pixels, with pixel centres at integer coordinates."""

    width: int
    height: int
    focal: float
    cx: float
    cy: float


OFFSETS = np.array([[0.0, 0.0], [-0.125, -0.375], [0.375, -0.125], [-0.375, 0.125], [0.125, 0.375]])
"""Rays of a pixel, pixels from its centre: the centre, for depth, then four on a turned grid, for colour."""


@njit(nogil=True, cache=True)
def visible(mesh: Mesh, T_cam_mesh: Array, view: View, offsets: Array) -> tuple[Array, Array, Array]:
    """Find the nearest triangle on each ray.

    Args:
        mesh: Triangles of v vertices.
        T_cam_mesh: [2, 4, 4] from the world, and from the moving object's frame, to the camera.
        view: The camera.
        offsets: [k, 2] the rays of each pixel, pixels from its centre.

    Returns:
        Inverse depth [k, h, w] in 1/m, 0 where there is nothing; triangle [k, h, w] int32, -1 where there is none;
        and for each triangle [t, 3, 3] the coefficients of 1/z, s/z and t/z as affine functions of (u, v, 1), set
        only for triangles that may be seen.
    """
    affine = np.empty((len(mesh.triangles), 3, 3))
    nearest = np.zeros((len(offsets), view.height, view.width))
    triangle = np.full((len(offsets), view.height, view.width), -1, dtype=np.int32)
    points = np.empty_like(mesh.vertices)
    w = np.empty((3, 3))
    for patch in range(len(mesh.moves)):
        T = T_cam_mesh[mesh.moves[patch]]
        if _out_of_sight(mesh.sphere[patch], T, view):
            continue
        for n in range(mesh.first_vertex[patch], mesh.first_vertex[patch + 1]):
            x, y, z = mesh.vertices[n]
            for a in range(3):
                points[n, a] = T[a, 0] * x + T[a, 1] * y + T[a, 2] * z + T[a, 3]
        for index in range(mesh.first_triangle[patch], mesh.first_triangle[patch + 1]):
            i, j, k = mesh.triangles[index]
            cross(points[j], points[k], w[0])
            cross(points[k], points[i], w[1])
            cross(points[i], points[j], w[2])
            volume = points[i, 0] * w[0, 0] + points[i, 1] * w[0, 1] + points[i, 2] * w[0, 2]
            if abs(volume) < 1e-13 or (volume > 0 and not mesh.two_sided[patch]):
                continue
            bounds = _bounds(points[i], points[j], points[k], view)
            if bounds[0] > bounds[1] or bounds[2] > bounds[3]:
                continue
            for a in range(3):
                x, y = w[a, 0] / (volume * view.focal), w[a, 1] / (volume * view.focal)
                w[a, 2] = w[a, 2] / volume - x * view.cx - y * view.cy
                w[a, 0], w[a, 1] = x, y
            for c in range(3):
                affine[index, 0, c] = w[0, c] + w[1, c] + w[2, c]
                for b in range(2):
                    st = w[0, c] * mesh.st[i, b] + w[1, c] * mesh.st[j, b] + w[2, c] * mesh.st[k, b]
                    affine[index, 1 + b, c] = st
            _fill(index, w, affine[index, 0], bounds, offsets, nearest, triangle)
    return nearest, triangle, affine


@njit(nogil=True, cache=True)
def _out_of_sight(sphere: Array, T: Array, view: View) -> bool:
    """Whether a sphere lies wholly behind the camera or beside what it sees."""
    x = T[0, 0] * sphere[0] + T[0, 1] * sphere[1] + T[0, 2] * sphere[2] + T[0, 3]
    y = T[1, 0] * sphere[0] + T[1, 1] * sphere[1] + T[1, 2] * sphere[2] + T[1, 3]
    z = T[2, 0] * sphere[0] + T[2, 1] * sphere[1] + T[2, 2] * sphere[2] + T[2, 3]
    # Half a field of view with a pixel to spare, as a slope; the distance from its plane is measured at a right angle.
    across, down = (0.5 * view.width + 1) / view.focal, (0.5 * view.height + 1) / view.focal
    return bool(
        z < -sphere[3]
        or abs(x) - across * z > sphere[3] * np.sqrt(1 + across * across)
        or abs(y) - down * z > sphere[3] * np.sqrt(1 + down * down)
    )


@njit(nogil=True, cache=True)
def cross(a: Array, b: Array, out: Array) -> None:
    """Cross product of two [3], without allocating."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(nogil=True, cache=True)
def _bounds(p0: Array, p1: Array, p2: Array, view: View) -> tuple[int, int, int, int]:
    """Columns and rows that the part of a triangle in front of the camera may touch."""
    u0, u1, v0, v1 = 1e9, -1e9, 1e9, -1e9
    for a, b in ((p0, p1), (p1, p2), (p2, p0)):
        # Each edge gives its start, if that is in front, and the point where it crosses the near plane.
        for crossing in (False, True):
            if crossing:
                if (a[2] < NEAR) == (b[2] < NEAR):
                    continue
                f = (NEAR - a[2]) / (b[2] - a[2])
                x, y, z = a[0] + f * (b[0] - a[0]), a[1] + f * (b[1] - a[1]), NEAR
            else:
                if a[2] < NEAR:
                    continue
                x, y, z = a[0], a[1], a[2]
            u, v = view.focal * x / z + view.cx, view.focal * y / z + view.cy
            u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
    # One pixel of margin for the rays beside the centre; clipped before the cast, as numbers near the plane are huge.
    left, right = max(u0 - 1, 0.0), min(u1 + 1, view.width - 1.0)
    top, bottom = max(v0 - 1, 0.0), min(v1 + 1, view.height - 1.0)
    return int(np.ceil(left)), int(np.floor(right)), int(np.ceil(top)), int(np.floor(bottom))


@njit(nogil=True, cache=True)
def _fill(
    index: int,
    w: Array,
    inverse: Array,
    bounds: tuple[int, int, int, int],
    offsets: Array,
    nearest: Array,
    triangle: Array,
) -> None:
    """Enter one triangle where it is nearer than what is there; each row's span follows from the three edges."""
    slack = 1e-7  # pixels, so that neighbours that share an edge leave no ray between them
    slope = np.empty(3)
    for a in range(3):
        slope[a] = -1 / w[a, 0] if abs(w[a, 0]) > 1e-12 else 0.0
    for row in range(bounds[2], bounds[3] + 1):
        for k in range(len(offsets)):
            v = row + offsets[k, 1]
            low, high = bounds[0] - 1.0, bounds[1] + 1.0
            for a in range(3):
                rest = w[a, 1] * v + w[a, 2]
                if slope[a] < 0:
                    low = max(low, rest * slope[a] - slack)
                elif slope[a] > 0:
                    high = min(high, rest * slope[a] + slack)
                elif rest < 0:
                    high = low - 1
            start = max(bounds[0], int(np.ceil(low - offsets[k, 0])))
            stop = min(bounds[1], int(np.floor(high - offsets[k, 0])))
            base = inverse[1] * v + inverse[2] + inverse[0] * offsets[k, 0]
            for column in range(start, stop + 1):
                z = base + inverse[0] * column
                if z > nearest[k, row, column]:
                    nearest[k, row, column] = z
                    triangle[k, row, column] = index


@njit(nogil=True, cache=True)
def shaded(
    triangle: Array, affine: Array, mesh: Mesh, paint: Paint, direct: LightMap, indirect: LightMap, offsets: Array
) -> Array:
    """Linear colour [h, w, 3] float32: each pixel's mean over its rays, the first one (the centre) left out."""
    rays, height, width = triangle.shape
    image = np.empty((height, width, 3), dtype=np.float32)
    color, light, total = np.empty(3), np.empty(3), np.empty(3)
    for row in range(height):
        for column in range(width):
            last, level = -1, 0.0
            total[0] = total[1] = total[2] = 0.0
            for k in range(1, rays):
                index = triangle[k, row, column]
                if index < 0:
                    continue
                a, p = affine[index], mesh.patch[index]
                u, v = column + offsets[k, 0], row + offsets[k, 1]
                depth = 1 / (a[0, 0] * u + a[0, 1] * v + a[0, 2])
                s = min(max((a[1, 0] * u + a[1, 1] * v + a[1, 2]) * depth, 0.0), 1.0)
                t = min(max((a[2, 0] * u + a[2, 1] * v + a[2, 2]) * depth, 0.0), 1.0)
                if index != last:
                    last, level = index, _mip_level(a, depth, s, t, p, paint)
                _albedo(paint, p, s, t, level, color)
                light[0] = light[1] = light[2] = paint.emission[paint.material[p]]
                add_light(direct, p, s, t, light)
                add_light(indirect, p, s, t, light)
                for c in range(3):
                    total[c] += color[c] * light[c]
            for c in range(3):
                image[row, column, c] = total[c] / (rays - 1)
    return image


@njit(nogil=True, cache=True)
def _mip_level(a: Array, depth: float, s: float, t: float, patch: int, paint: Paint) -> float:
    """The mip level whose texels match the distance between the rays of a pixel.

    Along a surface seen at a flat angle the two axes of the footprint differ: the geometric mean of both, but no finer
    than a third of the longer one, keeps floors both sharp and free of flicker.
    """
    m, uv = paint.material[patch], paint.uv[patch]
    width, height, levels = paint.size[m]
    product, longer = 1.0, 0.0
    for axis in range(2):
        ds, dt = (a[1, axis] - s * a[0, axis]) * depth, (a[2, axis] - t * a[0, axis]) * depth
        du, dv = (uv[0, 0] * ds + uv[0, 1] * dt) * width, (uv[1, 0] * ds + uv[1, 1] * dt) * height
        square = du * du + dv * dv
        product, longer = product * square, max(longer, square)
    # Half a logarithm of squares, so without their roots; rays are half a pixel apart, 0.36 is 0.6 squared.
    footprint = 0.36 * max(np.sqrt(product), longer / 9, 1e-12)
    return float(min(max(0.5 * np.log2(footprint), 0.0), levels - 1.0))


@njit(nogil=True, cache=True)
def _albedo(paint: Paint, patch: int, s: float, t: float, level: float, color: Array) -> None:
    """Linear albedo at (s, t), between the two mip levels around `level`."""
    m, uv = paint.material[patch], paint.uv[patch]
    x, y = uv[0, 0] * s + uv[0, 1] * t + uv[0, 2], uv[1, 0] * s + uv[1, 1] * t + uv[1, 2]
    fine = int(level)
    blend = level - fine
    color[0] = color[1] = color[2] = 0.0
    _texture(paint, m, fine, x, y, 1 - blend, color)
    if blend > 0:
        _texture(paint, m, fine + 1, x, y, blend, color)
    for c in range(3):
        color[c] = color[c] * color[c] * paint.tint[patch, c]


@njit(nogil=True, cache=True)
def _texture(paint: Paint, material: int, level: int, u: float, v: float, weight: float, color: Array) -> None:
    """Add one mip level, bilinear and repeating, as the square root of linear colour."""
    width, height = max(paint.size[material, 0] >> level, 1), max(paint.size[material, 1] >> level, 1)
    x, y = (u - np.floor(u)) * width - 0.5, (v - np.floor(v)) * height - 0.5
    column, row = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - column, y - row
    left, right = column & (width - 1), (column + 1) & (width - 1)
    first = paint.first_texel[material, level]
    upper, lower = first + (row & (height - 1)) * width, first + ((row + 1) & (height - 1)) * width
    scale = weight / 255.0
    a, b, c, d = (1 - fx) * (1 - fy) * scale, fx * (1 - fy) * scale, (1 - fx) * fy * scale, fx * fy * scale
    for channel in range(3):
        color[channel] += (
            a * paint.texels[upper + left, channel] + b * paint.texels[upper + right, channel]
            + c * paint.texels[lower + left, channel] + d * paint.texels[lower + right, channel]
        )  # fmt: skip


@njit(nogil=True, cache=True)
def add_light(light: LightMap, patch: int, s: float, t: float, out: Array) -> None:
    """Add a light map's irradiance at (s, t), bilinear, to three channels."""
    width, height = light.size[patch]
    x, y = s * (width - 1), t * (height - 1)
    column, row = min(int(x), width - 2), min(int(y), height - 2)
    fx, fy = x - column, y - row
    at = light.first[patch] + row * width + column
    a, b, c, d = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
    e = light.irradiance
    for k in range(3):
        out[k] += a * e[at, k] + b * e[at + 1, k] + c * e[at + width, k] + d * e[at + width + 1, k]


@njit(nogil=True, cache=True)
def incidence(triangle: Array, affine: Array, view: View) -> Array:
    """Cosine [h, w] float32 between each pixel's central ray and the surface's normal; 0 where there is nothing."""
    cosine = np.zeros((view.height, view.width), dtype=np.float32)
    for row in range(view.height):
        for column in range(view.width):
            index = triangle[row, column]
            if index < 0:
                continue
            a = affine[index, 0]
            normal = (a[0] * view.focal, a[1] * view.focal, a[0] * view.cx + a[1] * view.cy + a[2])
            x, y = (column - view.cx) / view.focal, (row - view.cy) / view.focal
            q = abs(normal[0] * x + normal[1] * y + normal[2])
            length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2) * np.sqrt(x * x + y * y + 1)
            cosine[row, column] = q / length
    return cosine
