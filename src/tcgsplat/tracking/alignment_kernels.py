"""Pixel loops of direct alignment: pyramids, reference points, and one Gauss-Newton pass.

Depth images mark pixels that saw nothing of the world (the empty border of an undistorted image) by -1, pixels
without a reading by 0.
"""

import numpy as np
from numba import njit

# Columns of a reference point: position (m), normal (0 if unknown), intensity, weight (Eq. 18).
PX, PY, PZ, NX, NY, NZ, INTENSITY, WEIGHT = range(8)
POINT = 8

# Entries of the statistics that one pass leaves.
(
    COLOR_SQUARES, COLOR_WEIGHT, DEPTH_SQUARES, DEPTH_WEIGHT,
    GAIN_W, GAIN_R, GAIN_L, GAIN_RR, GAIN_RL, GAIN_LL, IN_VIEW, READINGS, AGREEING,
) = range(13)  # fmt: skip
STATISTICS = 13

STUDENT_DOF = np.float32(5)
"""Student-t degrees of freedom: the weight (dof + 1) / (dof + (r/s)^2) of Kerl et al., ICRA 2013."""
_HALF, _ONE, _QUARTER = np.float32(0.5), np.float32(1), np.float32(0.25)
_NEAREST = np.float32(0.1)
"""Points nearer to the live camera than this are left out, metres."""
SMOOTH = np.float32(0.03)
"""Neighbouring depths that differ by less than this share lie on one surface."""


@njit(error_model="numpy", nogil=True, cache=True)
def halved_intensity(image):  # type: ignore[no-untyped-def]
    """Mean over two by two pixels."""
    h, w = image.shape[0] // 2, image.shape[1] // 2
    out = np.empty((h, w), np.float32)
    for y in range(h):
        for x in range(w):
            out[y, x] = _QUARTER * (
                image[2 * y, 2 * x] + image[2 * y, 2 * x + 1] + image[2 * y + 1, 2 * x] + image[2 * y + 1, 2 * x + 1]
            )
    return out


@njit(error_model="numpy", nogil=True, cache=True)
def halved_depth(depth):  # type: ignore[no-untyped-def]
    """Mean of the readings of two by two pixels that agree with the nearest one; -1 if any saw nothing."""
    h, w = depth.shape[0] // 2, depth.shape[1] // 2
    out = np.zeros((h, w), np.float32)
    for y in range(h):
        for x in range(w):
            nearest, lowest = np.float32(1e9), np.float32(0)
            for k in range(4):
                d = depth[2 * y + k // 2, 2 * x + k % 2]
                lowest = min(lowest, d)
                if d > 0:
                    nearest = min(nearest, d)
            if lowest < 0:
                out[y, x] = -1
            elif nearest < np.float32(1e9):
                total, count = np.float32(0), np.float32(0)
                for k in range(4):
                    d = depth[2 * y + k // 2, 2 * x + k % 2]
                    if 0 < d < nearest * (_ONE + SMOOTH):
                        total += d
                        count += _ONE
                out[y, x] = total / count
    return out


@njit(error_model="numpy", nogil=True, cache=True)
def reference_points(intensity, depth, weight, focal, center, radius, stride):  # type: ignore[no-untyped-def]
    """Points of a rendered view [n, POINT] in its camera frame, every `stride` pixels; normals from depth differences.

    A normal is kept where both axes are straight: neighbours at `radius` within 4 % of the depth per pixel, and their
    mean within 0.75 %; else it is zero, and the point counts for colour only.
    """
    h, w = depth.shape
    points = np.zeros((h * w // (stride * stride) + h + w + 1, POINT), np.float32)
    n = 0
    for y in range(2, h - 2, stride):
        for x in range(2, w - 2, stride):
            d = depth[y, x]
            if d <= 0:
                continue
            a, b = (x - center[0]) / focal[0], (y - center[1]) / focal[1]
            p = points[n]
            p[PX], p[PY], p[PZ] = a * d, b * d, d
            p[INTENSITY], p[WEIGHT] = intensity[y, x], weight[y, x]
            left, right, up, down = (
                depth[y, x - radius],
                depth[y, x + radius],
                depth[y - radius, x],
                depth[y + radius, x],
            )
            jump, bend = np.float32(0.04) * d * radius, np.float32(0.015) * d * radius
            straight = (
                min(min(left, right), min(up, down)) > 0
                and abs(left - d) < jump and abs(right - d) < jump and abs(up - d) < jump and abs(down - d) < jump
                and abs(left + right - 2 * d) < bend and abs(up + down - 2 * d) < bend
            )  # fmt: skip
            if straight:
                dz_du, dz_dv = (right - left) / (2 * radius), (down - up) / (2 * radius)
                # Tangents of the back-projected surface along u and v; their product points at the camera.
                ux, uy, uz = d / focal[0] + a * dz_du, b * dz_du, dz_du
                vx, vy, vz = a * dz_dv, d / focal[1] + b * dz_dv, dz_dv
                nx, ny, nz = uz * vy - uy * vz, ux * vz - uz * vx, uy * vx - ux * vy
                inverse = _ONE / np.sqrt(nx * nx + ny * ny + nz * nz)
                p[NX], p[NY], p[NZ] = nx * inverse, ny * inverse, nz * inverse
            n += 1
    return points[:n].copy()


@njit(error_model="numpy", nogil=True, cache=True, inline="always")
def _live_depth(depth, u, v):  # type: ignore[no-untyped-def]
    """Depth at (u, v): bilinear where the four neighbours lie on one surface, else the nearest pixel's."""
    x0, y0 = int(u), int(v)
    d00, d10, d01, d11 = depth[y0, x0], depth[y0, x0 + 1], depth[y0 + 1, x0], depth[y0 + 1, x0 + 1]
    low, high = min(min(d00, d10), min(d01, d11)), max(max(d00, d10), max(d01, d11))
    if low > 0 and high - low < SMOOTH * low:
        a, b = u - np.float32(x0), v - np.float32(y0)
        return (d00 * (_ONE - a) + d10 * a) * (_ONE - b) + (d01 * (_ONE - a) + d11 * a) * b
    return depth[int(v + _HALF), int(u + _HALF)]


@njit(error_model="numpy", nogil=True, cache=True, inline="always")
def _add(H, g, w, r, j):  # type: ignore[no-untyped-def]
    """One weighted residual into the upper triangle of the normal equations."""
    k = 0
    for i in range(6):
        wj = w * j[i]
        g[i] += wj * r
        for m in range(i, 6):
            H[k] += wj * j[m]
            k += 1


@njit(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", nogil=True, cache=True)
def normal_equations(
    points, intensity, depth, focal, center, R, t, gain, offset, color_scale, depth_scale, gate, color_weight,
    depth_weight, sigma_floor, sigma_slope,
):  # type: ignore[no-untyped-def]  # fmt: skip
    """One Gauss-Newton pass over the reference points: H (upper triangle, 21), g (6) and STATISTICS.

    A point X of the reference camera goes to Y = R X + t in the live camera; the pose is perturbed on the left,
    Y + rho + omega x Y. Residuals:
    colour     r = I_live(pi(Y)) - (gain I_ref + offset)                  in grey levels of [0, 1]
    geometry   r = (D_live(pi(Y)) - Y_z) (n . ray), over sigma_z |n . ray|  point to plane along the viewing ray
    with sigma_z(d) = sigma_floor + sigma_slope (d - 0.4)^2 metres (Nguyen et al., 3DIMPVT 2012). A point whose depth
    disagrees by more than `gate` (1 + z/2) metres is hidden or has moved, and neither of its residuals counts.
    """
    h, w = intensity.shape
    H, g, stats = np.zeros(21, np.float64), np.zeros(6, np.float64), np.zeros(STATISTICS, np.float64)
    j = np.zeros(6, np.float32)
    last_u, last_v = np.float32(w - 2), np.float32(h - 2)
    for q in range(points.shape[0]):
        p = points[q]
        X = R[0, 0] * p[PX] + R[0, 1] * p[PY] + R[0, 2] * p[PZ] + t[0]
        Y = R[1, 0] * p[PX] + R[1, 1] * p[PY] + R[1, 2] * p[PZ] + t[1]
        Z = R[2, 0] * p[PX] + R[2, 1] * p[PY] + R[2, 2] * p[PZ] + t[2]
        if Z < _NEAREST:
            continue
        iz = _ONE / Z
        u, v = focal[0] * X * iz + center[0], focal[1] * Y * iz + center[1]
        if not (u >= _ONE and v >= _ONE and u < last_u and v < last_v):
            continue
        d = _live_depth(depth, u, v)
        if d < 0:
            continue
        stats[IN_VIEW] += 1
        weight = p[WEIGHT]
        if d > 0:
            stats[READINGS] += 1
            behind = d - Z
            if abs(behind) > gate * (_ONE + _HALF * d):
                continue
            stats[AGREEING] += 1
            nx = R[0, 0] * p[NX] + R[0, 1] * p[NY] + R[0, 2] * p[NZ]
            ny = R[1, 0] * p[NX] + R[1, 1] * p[NY] + R[1, 2] * p[NZ]
            nz = R[2, 0] * p[NX] + R[2, 1] * p[NY] + R[2, 2] * p[NZ]
            facing = (nx * X + ny * Y + nz * Z) * iz
            if abs(facing) > np.float32(0.2):
                sigma = (sigma_floor + sigma_slope * (d - np.float32(0.4)) * (d - np.float32(0.4))) * abs(facing)
                r = behind * facing
                scaled = r / (sigma * depth_scale)
                student = (STUDENT_DOF + _ONE) / (STUDENT_DOF + scaled * scaled)
                stats[DEPTH_SQUARES] += weight * student * (r / sigma) * (r / sigma)
                stats[DEPTH_WEIGHT] += weight
                # r = n . (surface point - Y) to first order, so dr/drho = -n, dr/domega = -(Y x n).
                j[0], j[1], j[2] = -nx, -ny, -nz
                j[3], j[4], j[5] = Z * ny - Y * nz, X * nz - Z * nx, Y * nx - X * ny
                _add(H, g, weight * student * depth_weight / (sigma * sigma * depth_scale * depth_scale), r, j)
        x0, y0 = int(u), int(v)
        a, b = u - np.float32(x0), v - np.float32(y0)
        w00, w10, w01, w11 = (_ONE - a) * (_ONE - b), a * (_ONE - b), (_ONE - a) * b, a * b
        i00, i10, i01, i11 = intensity[y0, x0], intensity[y0, x0 + 1], intensity[y0 + 1, x0], intensity[y0 + 1, x0 + 1]
        live = w00 * i00 + w10 * i10 + w01 * i01 + w11 * i11
        du = _HALF * (
            w00 * (i10 - intensity[y0, x0 - 1]) + w10 * (intensity[y0, x0 + 2] - i00)
            + w01 * (i11 - intensity[y0 + 1, x0 - 1]) + w11 * (intensity[y0 + 1, x0 + 2] - i01)
        )  # fmt: skip
        dv = _HALF * (
            w00 * (i01 - intensity[y0 - 1, x0]) + w10 * (i11 - intensity[y0 - 1, x0 + 1])
            + w01 * (intensity[y0 + 2, x0] - i00) + w11 * (intensity[y0 + 2, x0 + 1] - i10)
        )  # fmt: skip
        reference = p[INTENSITY]
        r = live - (gain * reference + offset)
        scaled = r / color_scale
        student = (STUDENT_DOF + _ONE) / (STUDENT_DOF + scaled * scaled)
        counts = weight * student
        stats[COLOR_SQUARES] += counts * r * r
        stats[COLOR_WEIGHT] += weight
        stats[GAIN_W] += counts
        stats[GAIN_R] += counts * reference
        stats[GAIN_L] += counts * live
        stats[GAIN_RR] += counts * reference * reference
        stats[GAIN_RL] += counts * reference * live
        stats[GAIN_LL] += counts * live * live
        dX, dY = du * focal[0] * iz, dv * focal[1] * iz
        dZ = -(dX * X + dY * Y) * iz
        j[0], j[1], j[2] = dX, dY, dZ
        j[3], j[4], j[5] = Y * dZ - Z * dY, Z * dX - X * dZ, X * dY - Y * dX
        _add(H, g, counts * color_weight / (color_scale * color_scale), r, j)
    return H, g, stats
