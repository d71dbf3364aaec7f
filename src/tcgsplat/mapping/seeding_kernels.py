"""Surface normals at chosen pixels of a depth image."""

import numpy as np

from tcgsplat.render.numba_cpu.compilation import inner, kernel

_WINDOW = 2
_SAME_SURFACE, _LEAST_FACING = np.float32(0.03), np.float32(0.15)


@inner
def _smoothed(depth, x, y, rays_x, rays_y):  # type: ignore[no-untyped-def]
    """Mean point of the readings around a pixel; its own point where that is on another surface."""
    h, w = depth.shape
    z = depth[y, x]
    px, py, pz, count = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
    for v in range(max(y - _WINDOW, 0), min(y + _WINDOW + 1, h)):
        for u in range(max(x - _WINDOW, 0), min(x + _WINDOW + 1, w)):
            d = depth[v, u]
            if d > 0:
                px += rays_x[u] * d
                py += rays_y[v] * d
                pz += d
                count += np.float32(1)
    inverse = np.float32(1) / max(count, np.float32(1))
    if abs(pz * inverse - z) < _SAME_SURFACE * z:
        return px * inverse, py * inverse, pz * inverse
    return rays_x[x] * z, rays_y[y] * z, z


@kernel("f4[:, ::1], i8[::1], i8[::1], f4[::1], f4[::1], f4[:, ::1]")
def normals_at(depth, rows, columns, rays_x, rays_y, normals):  # type: ignore[no-untyped-def]
    """Unit `normals` [n, 3] in the camera frame, towards the camera; the viewing ray's where unknown.

    `rays_x[u]` and `rays_y[v]` are the slopes (u - cx) / fx and (v - cy) / fy. Points are averaged over 5 x 5 readings
    first, where that moves them by less than 3 % of the depth: noise is an order larger than the slope between two
    pixels. Points, not depths: where a window hangs over a border or a hole, its average still lies on the plane of
    its points. A normal needs readings at all of its eight neighbours, and a surface that is not edge-on.
    """
    h, w = depth.shape
    for i in range(rows.size):
        y, x = rows[i], columns[i]
        rx, ry = rays_x[x], rays_y[y]
        inverse = np.float32(1) / np.sqrt(rx * rx + ry * ry + np.float32(1))
        normals[i, 0], normals[i, 1], normals[i, 2] = -rx * inverse, -ry * inverse, -inverse
        if x < 1 or y < 1 or x > w - 2 or y > h - 2:
            continue
        known = True
        for v in range(y - 1, y + 2):
            for u in range(x - 1, x + 2):
                known = known and depth[v, u] > 0
        if not known:
            continue
        lx, ly, lz = _smoothed(depth, x - 1, y, rays_x, rays_y)
        rx, ry, rz = _smoothed(depth, x + 1, y, rays_x, rays_y)
        ux, uy, uz = _smoothed(depth, x, y - 1, rays_x, rays_y)
        dx, dy, dz = _smoothed(depth, x, y + 1, rays_x, rays_y)
        ax, ay, az = dx - ux, dy - uy, dz - uz
        bx, by, bz = rx - lx, ry - ly, rz - lz
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        facing = nx * normals[i, 0] + ny * normals[i, 1] + nz * normals[i, 2]
        if facing > _LEAST_FACING * length:
            normals[i, 0], normals[i, 1], normals[i, 2] = nx / length, ny / length, nz / length
