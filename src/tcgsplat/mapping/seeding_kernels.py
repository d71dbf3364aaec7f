"""From pixels with a depth to discs on the surface that they show."""

import numpy as np

from tcgsplat.render.numba_cpu.compilation import inner, kernel
from tcgsplat.scene.harmonics import SH_C0

WINDOW = 5
"""Pixels across, within which points are averaged for a normal: noise is an order larger than the slope between two."""
STRETCH = np.float32(3)
"""Of a disc, at most: what is seen nearly edge-on is not known so well."""
PUSH_BACK, LOG_SIZE, LOG_FLATNESS, CONSTANTS = range(4)
"""Of `constants`: 1 + the share of the depth; log of the standard deviation at 1 m, metres; log of thickness over it."""
_SAME_SURFACE, _LEAST_FACING, _UPRIGHT = np.float32(0.03), np.float32(0.15), np.float32(1e-4)
_ZERO, _ONE, _HALF, _TINY = np.float32(0), np.float32(1), np.float32(0.5), np.float32(1e-12)
_INVERSE_SH_C0 = np.float32(1 / SH_C0)


@inner
def _cross(ax, ay, az, bx, by, bz):  # type: ignore[no-untyped-def]
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@inner
def _unit(x, y, z):  # type: ignore[no-untyped-def]
    inverse = _ONE / max(np.sqrt(x * x + y * y + z * z), _TINY)
    return x * inverse, y * inverse, z * inverse


@inner
def _averaged(depth, sums, x, y, rays_x, rays_y):  # type: ignore[no-untyped-def]
    """Mean point of the readings around a pixel; its own point where that is on another surface."""
    z, inverse = depth[y, x], _ONE / sums[y, x, 3]
    if abs(sums[y, x, 2] * inverse - z) < _SAME_SURFACE * z:
        return sums[y, x, 0] * inverse, sums[y, x, 1] * inverse, sums[y, x, 2] * inverse
    return rays_x[x] * z, rays_y[y] * z, z


@inner
def _normal(depth, sums, x, y, rays_x, rays_y):  # type: ignore[no-untyped-def]
    """Unit normal towards the camera; the viewing ray's where it is unknown."""
    h, w = depth.shape
    tx, ty, tz = _unit(-rays_x[x], -rays_y[y], -_ONE)
    if x < 1 or y < 1 or x > w - 2 or y > h - 2:
        return tx, ty, tz
    for v in range(y - 1, y + 2):
        for u in range(x - 1, x + 2):
            if not depth[v, u] > 0:
                return tx, ty, tz
    lx, ly, lz = _averaged(depth, sums, x - 1, y, rays_x, rays_y)
    rx, ry, rz = _averaged(depth, sums, x + 1, y, rays_x, rays_y)
    ux, uy, uz = _averaged(depth, sums, x, y - 1, rays_x, rays_y)
    dx, dy, dz = _averaged(depth, sums, x, y + 1, rays_x, rays_y)
    nx, ny, nz = _cross(dx - ux, dy - uy, dz - uz, rx - lx, ry - ly, rz - lz)
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    if nx * tx + ny * ty + nz * tz > _LEAST_FACING * length:
        return nx / length, ny / length, nz / length
    return tx, ty, tz


@inner
def _quaternion(xx, yx, zx, xy, yy, zy, xz, yz, zz):  # type: ignore[no-untyped-def]
    """Of a rotation matrix, column by column, w x y z with w >= 0; see `geometry.quaternion.from_matrix`."""
    w, x, y, z = _ONE + xx + yy + zz, _ONE + xx - yy - zz, _ONE - xx + yy - zz, _ONE - xx - yy + zz
    if w >= max(x, y, z):
        x, y, z = zy - yz, xz - zx, yx - xy
    elif x >= max(y, z):
        w, y, z = zy - yz, yx + xy, xz + zx
    elif y >= z:
        w, x, z = xz - zx, yx + xy, zy + yz
    else:
        w, x, y = yx - xy, xz + zx, zy + yz
    inverse = _ONE / np.sqrt(w * w + x * x + y * y + z * z)
    inverse = -inverse if w < 0 else inverse
    return w * inverse, x * inverse, y * inverse, z * inverse


@kernel(
    "f4[:, ::1], f4[:, :, ::1], b1[:, ::1], f4[:, :, ::1], f4[::1], f4[::1], f4[:, ::1], f4[::1], "
    "f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1]"
)
def discs(depth, color, chosen, sums, rays_x, rays_y, T_map_cam, constants, means, log_scales, quats, sh):  # type: ignore[no-untyped-def]
    """A disc at each chosen pixel, row by row, flat along the normal and round from where it was seen.

    Its own axes are: along the tilt, across it, along the normal. Seen at an angle it is shortened along the tilt, and
    is stretched by as much, so that a lattice of discs stays closed.

    A normal is that of the points beside, above and below, each the mean over a window where that moves it by less than
    3 % of its depth. Points are averaged, not depths: where a window hangs over a border or a hole, its mean still lies
    on the plane of its points. A normal needs readings at all of the eight neighbours, and a surface that is not edge-on.

    Args: `depth` [h, w], above 0 where `chosen` is; `color` [h, w, 3]; `sums` [h, w, 4] over the window of points in the
    camera frame and of readings; `rays_x[u]` and `rays_y[v]` are the slopes (u - cx) / fx and (v - cy) / fy; `T_map_cam`
    [4, 4]; `constants`, see PUSH_BACK. Written are `means` [n, 3] in the map frame, `log_scales` [n, 3], `quats` [n, 4]
    and `sh` [n, 3].
    """
    h, w = depth.shape
    T, i = T_map_cam, 0
    for v in range(h):
        for u in range(w):
            if not chosen[v, u]:
                continue
            nx, ny, nz = _normal(depth, sums, u, v, rays_x, rays_y)
            rx, ry, rz = _unit(rays_x[u], rays_y[v], _ONE)
            facing = max(-(nx * rx + ny * ry + nz * rz), _ONE / STRETCH)
            bx, by, bz = _cross(nx, ny, nz, rx, ry, rz)
            if bx * bx + by * by + bz * bz < _UPRIGHT * _UPRIGHT:
                bx, by, bz = _cross(nx, ny, nz, _ZERO, _ONE, _ZERO)
            bx, by, bz = _unit(bx, by, bz)
            ax, ay, az = _cross(bx, by, bz, nx, ny, nz)
            quat = _quaternion(
                T[0, 0] * ax + T[0, 1] * ay + T[0, 2] * az,
                T[1, 0] * ax + T[1, 1] * ay + T[1, 2] * az,
                T[2, 0] * ax + T[2, 1] * ay + T[2, 2] * az,
                T[0, 0] * bx + T[0, 1] * by + T[0, 2] * bz,
                T[1, 0] * bx + T[1, 1] * by + T[1, 2] * bz,
                T[2, 0] * bx + T[2, 1] * by + T[2, 2] * bz,
                T[0, 0] * nx + T[0, 1] * ny + T[0, 2] * nz,
                T[1, 0] * nx + T[1, 1] * ny + T[1, 2] * nz,
                T[2, 0] * nx + T[2, 1] * ny + T[2, 2] * nz,
            )
            quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3] = quat
            z = depth[v, u] * constants[PUSH_BACK]
            x, y = rays_x[u] * z, rays_y[v] * z
            size = constants[LOG_SIZE] + np.log(depth[v, u])
            log_scales[i, 0], log_scales[i, 1], log_scales[i, 2] = (
                size - np.log(facing),
                size,
                size + constants[LOG_FLATNESS],
            )
            for k in range(3):
                means[i, k] = T[k, 0] * x + T[k, 1] * y + T[k, 2] * z + T[k, 3]
                sh[i, k] = (color[v, u, k] - _HALF) * _INVERSE_SH_C0
            i += 1
