"""Pixel loops of direct alignment: pyramids, reference points, and one Gauss-Newton pass, sixteen points at a time.

Depth images mark pixels that saw nothing of the world (the empty border of an undistorted image) by -1, pixels
without a reading by 0.
"""

import numpy as np
from numba import njit

from tcgsplat.render.numba_cpu.compilation import kept
from tcgsplat.render.numba_cpu.simd import (
    LANES,
    MATH,
    floor,
    gather,
    gather_squares,
    load,
    mask_ge,
    maximum,
    minimum,
    spread,
    sqrt,
    store,
    sum_lanes,
    where_ge,
)

# Rows of the reference points [POINT, n padded to 16]: position (m; PZ is 0 where there is no point), normal (0 where
# it is unknown), intensity, weight (Eq. 18).
PX, PY, PZ, NX, NY, NZ, REFERENCE, WEIGHT = range(8)
POINT = 8

# Channels of a live image: intensity, its slopes (grey levels a pixel), depth.
CHANNELS = 4

# Entries of the constants of a pass: the pose of the reference camera in the live one (row by row), fx, fy, cx, cy in
# pixels, exposure, the residuals' spreads, and settings of `AlignmentConfig`.
ROTATION, TRANSLATION, INTRINSICS = 0, 9, 12
GAIN, OFFSET, COLOR_SCALE, DEPTH_SCALE, GATE, BALANCE, SIGMA_FLOOR, SIGMA_SLOPE = range(16, 24)
CONSTANTS = 24

# Entries of the sums of a pass: H (upper triangle, row by row), g, and statistics.
HESSIAN, GRADIENT, FIRST_STATISTIC = 0, 21, 27
(
    COLOR_SQUARES, COLOR_WEIGHT, DEPTH_SQUARES, DEPTH_WEIGHT,
    GAIN_W, GAIN_R, GAIN_L, GAIN_RR, GAIN_RL, GAIN_LL, IN_VIEW, READINGS, AGREEING,
) = range(27, 40)  # fmt: skip
STATISTICS, SUMS = 13, 40

STUDENT_DOF = np.float32(5)
"""Student-t degrees of freedom: the weight (dof + 1) / (dof + (r/s)^2) of Kerl et al., ICRA 2013."""
SMOOTH = np.float32(0.03)
"""Neighbouring depths that differ by less than this share lie on one surface.

The same at every level: it tells a step between two surfaces from noise and slant, and steps do not grow with the
pixels. At the coarse levels more of the slanted surfaces pass for steps, where the nearest reading will do: with 3, 6
and 12 % the trajectories' errors stay the same to 0.02 mm.
"""
NEAREST = np.float32(0.1)
"""Points nearer to the live camera than this are left out, metres."""
FACING = np.float32(0.2)
"""Cosine between normal and viewing ray (scaled to z = 1) below which a surface is too slanted to measure depth on."""
_CHUNK = 64
"""Vectors of points that are summed in float32 before the sums go to float64."""
_ZERO, _QUARTER, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.25), np.float32(0.5), np.float32(1), np.float32(2)
TINY = np.float32(1e-9)
"""Metres; anything above it is a reading."""
THIN = np.float32(1e-3)
"""Coverage that is not divided by any more."""
BASE = np.float32(0.4)
"""Distance of the least depth noise, metres."""
_RED, _GREEN, _BLUE = np.float32(0.299), np.float32(0.587), np.float32(0.114)


@kept(njit(fastmath=MATH, error_model="numpy", nogil=True, cache=True))
def luma(color):
    """Intensity [h, w] of an RGB image [h, w, 3]."""
    h, w = color.shape[:2]
    intensity = np.empty((h, w), np.float32)
    for y in range(h):
        for x in range(w):
            intensity[y, x] = _RED * color[y, x, 0] + _GREEN * color[y, x, 1] + _BLUE * color[y, x, 2]
    return intensity


@kept(njit(error_model="numpy", nogil=True, cache=True))
def live_view(color, depth, valid):
    """Intensity and marked depth of a frame: what is not valid saw nothing."""
    h, w = depth.shape
    intensity, marked = luma(color), np.empty((h, w), np.float32)
    for y in range(h):
        for x in range(w):
            marked[y, x] = depth[y, x] if valid[y, x] else -_ONE
    return intensity, marked


@kept(njit(fastmath=MATH, error_model="numpy", nogil=True, cache=True))
def rendered_view(color, depth, alpha, min_alpha):
    """Intensity and marked depth of images that are multiplied by alpha: what is hardly covered saw nothing.

    So its black does not bleed into the coarse levels' points.
    """
    h, w = depth.shape
    intensity, marked = luma(color), np.empty((h, w), np.float32)
    for y in range(h):
        for x in range(w):
            inverse = _ONE / max(alpha[y, x], THIN)
            intensity[y, x] *= inverse
            marked[y, x] = depth[y, x] * inverse if alpha[y, x] > min_alpha else -_ONE
    return intensity, marked


@kept(njit(error_model="numpy", nogil=True, cache=True))
def halved_intensity(image):
    """Mean over two by two pixels."""
    h, w = image.shape[0] // 2, image.shape[1] // 2
    out = np.empty((h, w), np.float32)
    for y in range(h):
        for x in range(w):
            out[y, x] = _QUARTER * (
                image[2 * y, 2 * x] + image[2 * y, 2 * x + 1] + image[2 * y + 1, 2 * x] + image[2 * y + 1, 2 * x + 1]
            )
    return out


@kept(njit(error_model="numpy", nogil=True, cache=True))
def halved_depth(depth):
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


@kept(njit(error_model="numpy", nogil=True, cache=True))
def live_image(intensity, depth):
    """What a pass samples, [h, w, CHANNELS]; slopes are central differences. The border stays empty: no pass asks."""
    h, w = intensity.shape
    out = np.empty((h, w, CHANNELS), np.float32)
    for y in range(1, h - 1):
        for x in range(1, w - 1):
            out[y, x, 0] = intensity[y, x]
            out[y, x, 1] = _HALF * (intensity[y, x + 1] - intensity[y, x - 1])
            out[y, x, 2] = _HALF * (intensity[y + 1, x] - intensity[y - 1, x])
            out[y, x, 3] = depth[y, x]
    return out


@kept(njit(fastmath=MATH, error_model="numpy", nogil=True, cache=True, inline="always"))
def _apart(a, b):
    return maximum(a - b, b - a)


@kept(njit(fastmath=MATH, error_model="numpy", nogil=True, cache=True))
def reference_points(intensity, depth, weight, intrinsics, radius, stride):
    """Points of a rendered view [POINT, n] in its camera frame, every `stride` pixels; normals from depth differences.

    A normal is kept where both axes are straight: neighbours at `radius` within 4 % of the depth per pixel, and their
    mean within 0.75 %; else it is zero, and the point counts for colour only. Every row of pixels is padded to whole
    vectors. The intrinsics are fx, fy, cx, cy in pixels.
    """
    h, w = depth.shape
    vectors = (len(range(2, w - 2, stride)) + LANES - 1) // LANES
    n = len(range(2, h - 2, stride)) * vectors * LANES
    points = np.empty((POINT, n), np.float32)
    columns = np.empty(LANES, np.float32)
    for k in range(LANES):
        columns[k] = 2 + stride * k
    zero, one, last = spread(_ZERO), spread(_ONE), spread(np.float32(w - 3))
    focal_x, focal_y, center_x, center_y = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    jump, bend = np.float32(0.04 * radius), np.float32(0.015 * radius)
    per_pixel = np.float32(0.5 / radius)
    i = 0
    for y in range(2, h - 2, stride):
        row = y * w
        b = spread((np.float32(y) - center_y) / focal_y)
        for k in range(vectors):
            x = load(columns, 0) + np.float32(k * LANES * stride)
            at = minimum(x, last)
            d = gather(depth, row, at)
            d = where_ge(d, spread(TINY), where_ge(last, x, d, zero), zero)
            left, right = gather(depth, row - radius, at), gather(depth, row + radius, at)
            up, down = gather(depth, row - radius * w, at), gather(depth, row + radius * w, at)
            a = (at - center_x) / focal_x
            dz_du, dz_dv = (right - left) * per_pixel, (down - up) * per_pixel
            # Tangents of the back-projected surface along u and v; their product points at the camera.
            ux, uy, uz = d / focal_x + a * dz_du, b * dz_du, dz_du
            vx, vy, vz = a * dz_dv, d / focal_y + b * dz_dv, dz_dv
            nx, ny, nz = uz * vy - uy * vz, ux * vz - uz * vx, uy * vx - ux * vy
            # A neighbour without a reading, 0 or less, is a jump.
            jumps = maximum(maximum(_apart(left, d), _apart(right, d)), maximum(_apart(up, d), _apart(down, d)))
            bends = maximum(_apart(left + right, d * _TWO), _apart(up + down, d * _TWO))
            straight = where_ge(jumps, d * jump, zero, where_ge(bends, d * bend, zero, one))
            length = sqrt(where_ge(straight, one, nx * nx + ny * ny + nz * nz, one))
            inverse = straight / length
            store(points, PX * n + i, a * d)
            store(points, PY * n + i, b * d)
            store(points, PZ * n + i, d)
            store(points, NX * n + i, nx * inverse)
            store(points, NY * n + i, ny * inverse)
            store(points, NZ * n + i, nz * inverse)
            store(points, REFERENCE * n + i, gather(intensity, row, at))
            store(points, WEIGHT * n + i, gather(weight, row, at))
            i += LANES
    return points


@kept(njit(fastmath=MATH, error_model="numpy", nogil=True, cache=True, inline="always"))
def _mixed(squares, channel, w00, w10, w01, w11):
    """One channel of four pixels, interpolated."""
    return (
        w00 * squares[channel] + w10 * squares[CHANNELS + channel]
        + w01 * squares[2 * CHANNELS + channel] + w11 * squares[3 * CHANNELS + channel]
    )  # fmt: skip


@kept(njit(fastmath=MATH, error_model="numpy", nogil=True, cache=True, inline="always"))
def _add(sums, entry, value):
    store(sums, entry * LANES, load(sums, entry * LANES) + value)


@kept(njit(fastmath=MATH, error_model="numpy", nogil=True, cache=True, inline="always"))
def _add_residual(sums, weight, r, j):
    """One weighted residual of every lane into the normal equations."""
    entry = HESSIAN
    for a in range(6):
        wj = weight * j[a]
        _add(sums, GRADIENT + a, wj * r)
        for b in range(a, 6):
            _add(sums, entry, wj * j[b])
            entry += 1


@kept(njit(fastmath=MATH, error_model="numpy", nogil=True, cache=True))
def normal_equations(points, live, constants):
    """One Gauss-Newton pass over the reference points: the SUMS, float64.

    A point X of the reference camera goes to Y = R X + t in the live camera; the pose is perturbed on the left,
    Y + rho + omega x Y. Residuals:
    colour     r = I_live(pi(Y)) - (gain I_ref + offset)                  in grey levels of [0, 1]
    geometry   r = (D_live(pi(Y)) - Y_z) (n . ray), over sigma_z |n . ray|  point to plane along the viewing ray
    with sigma_z(d) = sigma_floor + sigma_slope (d - 0.4)^2 metres (Nguyen et al., 3DIMPVT 2012). A point whose depth
    disagrees by more than `gate` (1 + z/2) metres is hidden or has moved, and neither of its residuals counts.

    What does not count has weight 0, looks at pixel (1, 1) if it is out of view, and never multiplies 0 by infinity.
    """
    h, w = live.shape[:2]
    n, pitch = points.shape[1], CHANNELS * w
    R, t = ROTATION, TRANSLATION
    r00, r01, r02, t0 = constants[R], constants[R + 1], constants[R + 2], constants[t]
    r10, r11, r12, t1 = constants[R + 3], constants[R + 4], constants[R + 5], constants[t + 1]
    r20, r21, r22, t2 = constants[R + 6], constants[R + 7], constants[R + 8], constants[t + 2]
    focal_x, focal_y = constants[INTRINSICS], constants[INTRINSICS + 1]
    center_x, center_y = constants[INTRINSICS + 2], constants[INTRINSICS + 3]
    gain, offset, gate = constants[GAIN], constants[OFFSET], constants[GATE]
    sigma_floor, sigma_slope = constants[SIGMA_FLOOR], constants[SIGMA_SLOPE]
    color_precision = _ONE / (constants[COLOR_SCALE] * constants[COLOR_SCALE])
    depth_precision = _ONE / (constants[DEPTH_SCALE] * constants[DEPTH_SCALE])
    balance = constants[BALANCE]
    zero, one, half, tiny, near = spread(_ZERO), spread(_ONE), spread(_HALF), spread(TINY), spread(NEAREST)
    end_u, end_v = spread(np.float32(w - 2)), spread(np.float32(h - 2))
    totals, sums = np.zeros(SUMS), np.empty(SUMS * LANES, np.float32)
    for start in range(0, n, _CHUNK * LANES):
        for entry in range(SUMS):
            store(sums, entry * LANES, zero)
        stop = start + _CHUNK * LANES
        for i in range(start, stop if stop < n else n, LANES):
            px, py, pz = load(points, PX * n + i), load(points, PY * n + i), load(points, PZ * n + i)
            X, Y, Z = (
                px * r00 + py * r01 + pz * r02 + t0,
                px * r10 + py * r11 + pz * r12 + t1,
                px * r20 + py * r21 + pz * r22 + t2,
            )
            iz = _ONE / maximum(Z, near)
            u, v = X * iz * focal_x + center_x, Y * iz * focal_y + center_y
            in_front = where_ge(pz, tiny, where_ge(Z, near, one, zero), zero)
            in_columns = where_ge(u, end_u, zero, where_ge(u, one, in_front, zero))
            in_view = where_ge(v, end_v, zero, where_ge(v, one, in_columns, zero))
            if mask_ge(in_view, half) == 0:
                continue
            u, v = where_ge(in_view, half, u, one), where_ge(in_view, half, v, one)
            x0, y0 = floor(u), floor(v)
            squares = gather_squares(live, pitch, x0, y0)
            a, b = u - x0, v - y0
            w11 = a * b
            w10, w01 = a - w11, b - w11
            w00 = _ONE - a - w01

            # Depth: bilinear where the four pixels lie on one surface, else the nearest one's.
            d00, d10, d01, d11 = squares[3], squares[7], squares[11], squares[15]
            low, high = minimum(minimum(d00, d10), minimum(d01, d11)), maximum(maximum(d00, d10), maximum(d01, d11))
            nearest = where_ge(b, half, where_ge(a, half, d11, d01), where_ge(a, half, d10, d00))
            d = where_ge(high - low, low * SMOOTH, nearest, _mixed(squares, 3, w00, w10, w01, w11))
            in_view = where_ge(d, zero, in_view, zero)
            reading = where_ge(d, tiny, in_view, zero)
            agreeing = where_ge((d * _HALF + _ONE) * gate, _apart(d, Z), reading, zero)
            behind = where_ge(agreeing, half, d - Z, zero)
            weight = load(points, WEIGHT * n + i)

            # Geometry. dr/drho = -n, dr/domega = -(Y x n); residual and slope are divided by n . ray.
            n0, n1, n2 = load(points, NX * n + i), load(points, NY * n + i), load(points, NZ * n + i)
            nx, ny, nz = (
                n0 * r00 + n1 * r01 + n2 * r02,
                n0 * r10 + n1 * r11 + n2 * r12,
                n0 * r20 + n1 * r21 + n2 * r22,
            )
            facing = (nx * X + ny * Y + nz * Z) * iz
            faces = where_ge(maximum(facing, zero - facing), spread(FACING), one, zero)
            scale = where_ge(faces, half, _ONE / facing, zero)
            past = d - BASE
            sigma = past * past * sigma_slope + sigma_floor
            precision = _ONE / (sigma * sigma)
            depth_square = behind * behind * precision
            depth_counts = weight * agreeing * faces
            student = (STUDENT_DOF + _ONE) / (depth_square * depth_precision + STUDENT_DOF)
            depth_weight = depth_counts * student
            jx, jy, jz = zero - nx * scale, zero - ny * scale, zero - nz * scale
            j = (jx, jy, jz, Y * jz - Z * jy, Z * jx - X * jz, X * jy - Y * jx)
            _add_residual(sums, depth_weight * precision * (depth_precision * balance), behind, j)

            # Colour, where the depth does not disagree.
            reference = load(points, REFERENCE * n + i)
            seen = _mixed(squares, 0, w00, w10, w01, w11)
            r = seen - (reference * gain + offset)
            color_counts = weight * (in_view - reading + agreeing)
            student = (STUDENT_DOF + _ONE) / (r * r * color_precision + STUDENT_DOF)
            color_weight = color_counts * student
            jx, jy = (
                _mixed(squares, 1, w00, w10, w01, w11) * iz * focal_x,
                _mixed(squares, 2, w00, w10, w01, w11) * iz * focal_y,
            )
            jz = zero - (jx * X + jy * Y) * iz
            j = (jx, jy, jz, Y * jz - Z * jy, Z * jx - X * jz, X * jy - Y * jx)
            _add_residual(sums, color_weight * color_precision, r, j)

            by_reference, by_seen = color_weight * reference, color_weight * seen
            statistics = (
                color_weight * r * r, color_counts, depth_weight * depth_square, depth_counts,
                color_weight, by_reference, by_seen, by_reference * reference, by_reference * seen, by_seen * seen,
                in_view, reading, agreeing,
            )  # fmt: skip
            for k in range(STATISTICS):
                _add(sums, FIRST_STATISTIC + k, statistics[k])
        for entry in range(SUMS):
            totals[entry] += sum_lanes(load(sums, entry * LANES))
    return totals
