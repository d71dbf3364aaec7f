"""Pixel loops of direct alignment: pyramids, reference points, and one Gauss-Newton pass, sixteen points at a time.

Depth images mark pixels that saw nothing of the world (the empty border of an undistorted image) by -1, pixels
without a reading by 0.
"""

import numpy as np
from numba import carray

from tcgsplat.render.numba_cpu.compilation import kernel
from tcgsplat.render.numba_cpu.lanes import (
    add_rows,
    even_and_odd,
    gather,
    gather_squares,
    load,
    load_first,
    load_rows,
    load_spread,
    mask_ge,
    side_by_side,
    stack_floats,
    store,
    store_first,
    store_rows,
    sum_lanes,
)
from tcgsplat.render.numba_cpu.simd import (
    LANES,
    Vector,
    Vectors,
    apart,
    floor,
    formula,
    maximum,
    minimum,
    ramp,
    spread,
    sqrt,
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
_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
TINY = np.float32(1e-9)
"""Metres; anything above it is a reading."""
THIN = np.float32(1e-3)
"""Coverage that is not divided by any more."""
_FARTHEST = np.float32(1e9)
BASE = np.float32(0.4)
"""Distance of the least depth noise, metres."""


@formula
def _merged(d00: Vector, d10: Vector, d01: Vector, d11: Vector) -> Vector:
    """One depth of four; see `halved_depth`."""
    readings, zero, one = (d00, d10, d01, d11), d00.of(_ZERO), d00.of(_ONE)
    far = d00.of(_FARTHEST)
    nearest, lowest = far, zero
    for d in readings:
        nearest, lowest = minimum(nearest, where_ge(zero, d, far, d)), minimum(lowest, d)
    reach, total, count = nearest * (_ONE + SMOOTH), zero, zero
    for d in readings:
        agrees = where_ge(zero, d, zero, where_ge(d, reach, zero, one))
        total, count = total + d * agrees, count + agrees
    return where_ge(lowest, zero, total / maximum(count, one), -one)


@kernel("f4[::1], i8, i8, f4[::1]")
def halved_depth(depth, height, width, out):
    """Mean of the readings of two by two pixels that agree with the nearest one; -1 if any saw nothing.

    Images are flat: `depth` is [height, width], `out` half of that.
    """
    half_width = width // 2
    for y in range(height // 2):
        for x in range(0, half_width, LANES):
            at = 2 * (y * width + x)
            count = 2 * (half_width - x)
            d00, d10 = even_and_odd(load_first(depth, at, count), load_first(depth, at + LANES, count - LANES))
            at += width
            d01, d11 = even_and_odd(load_first(depth, at, count), load_first(depth, at + LANES, count - LANES))
            store_first(out, y * half_width + x, _merged(d00, d10, d01, d11), half_width - x)


@formula
def _slopes(left: Vector, right: Vector, above: Vector, below: Vector) -> Vectors:
    return (right - left) * _HALF, (below - above) * _HALF


@kernel("f4[::1], f4[::1], i8, i8, f4[::1]")
def live_image(intensity, depth, height, width, out):
    """What a pass samples, [height, width, CHANNELS]; slopes are central differences. The border stays empty.

    Images are flat.
    """
    for y in range(1, height - 1):
        for x in range(1, width - 1, LANES):
            first = y * width + x
            count = width - 1 - x
            du, dv = _slopes(
                load_first(intensity, first - 1, count), load_first(intensity, first + 1, count),
                load_first(intensity, first - width, count), load_first(intensity, first + width, count),
            )  # fmt: skip
            pixels = side_by_side(load_first(intensity, first, count), du, dv, load_first(depth, first, count))
            for k in range(CHANNELS):
                store_first(out, CHANNELS * first + LANES * k, pixels[k], CHANNELS * count - LANES * k)


@formula
def _surface(
    intrinsics: Vectors, x: Vector, b: Vector, last: Vector, center: Vector, neighbours: Vectors, bounds: Vectors
) -> tuple[Vectors, Vectors]:
    """Points of sixteen pixels, 0 where there is none, and their normals, 0 where unknown; see `reference_points`.

    `neighbours` are the readings on the left, right, above and below, and `bounds` are what `reference_points` makes
    of their distance: how much a reading and a bend may differ, and one over the pixels between neighbours.
    """
    focal_x, focal_y, center_x, _ = intrinsics
    left, right, up, down = neighbours
    a = (minimum(x, last) - center_x) / focal_x
    zero, one = x.of(_ZERO), x.of(_ONE)
    d = where_ge(center, x.of(TINY), where_ge(last, x, center, zero), zero)
    jump, bend, per_pixel = bounds
    dz_du, dz_dv = (right - left) * per_pixel, (down - up) * per_pixel
    # Tangents of the back-projected surface along u and v; their product points at the camera.
    ux, uy, uz = d / focal_x + a * dz_du, b * dz_du, dz_du
    vx, vy, vz = a * dz_dv, d / focal_y + b * dz_dv, dz_dv
    nx, ny, nz = uz * vy - uy * vz, ux * vz - uz * vx, uy * vx - ux * vy
    # A neighbour without a reading, 0 or less, is a jump.
    jumps = maximum(maximum(apart(left, d), apart(right, d)), maximum(apart(up, d), apart(down, d)))
    bends = maximum(apart(left + right, d * _TWO), apart(up + down, d * _TWO))
    straight = where_ge(jumps, d * jump, zero, where_ge(bends, d * bend, zero, one))
    length = sqrt(where_ge(straight, one, nx * nx + ny * ny + nz * nz, one))
    inverse = straight / length
    return (a * d, b * d, d), (nx * inverse, ny * inverse, nz * inverse)


@kernel("f4[::1], f4[::1], f4[::1], i8, i8, f4[::1], i8, i8, i8, f4[::1]")
def reference_points(intensity, depth, weight, h, w, intrinsics, radius, stride, n, points):
    """Points [POINT, n] of a rendered view in its camera frame, every `stride` pixels; normals from depth differences.

    A normal is kept where both axes are straight: neighbours at `radius` within 4 % of the depth per pixel, and their
    mean within 0.75 %; else it is zero, and the point counts for colour only. Every row of pixels is padded to whole
    vectors, see `points_in`. The intrinsics are fx, fy, cx, cy in pixels. Images are flat.
    """
    last = np.float32(w - 3)
    bounds = np.float32(0.04 * radius), np.float32(0.015 * radius), np.float32(0.5 / radius)
    # Not in the loops, where the compiler could not know that what is stored does not change them.
    focal_y, center_y, numbers = intrinsics[1], intrinsics[3], load_spread(intrinsics, 0, 4)
    i = 0
    for y in range(2, h - 2, stride):
        row = y * w
        b = (np.float32(y) - center_y) / focal_y
        for left in range(2, w - 2, stride * LANES):
            x = ramp(left, stride)
            at = minimum(x, last)
            neighbours = (
                gather(depth, row - radius, at), gather(depth, row + radius, at),
                gather(depth, row - radius * w, at), gather(depth, row + radius * w, at),
            )  # fmt: skip
            point, normal = _surface(numbers, x, b, last, gather(depth, row, at), neighbours, bounds)
            store_rows(points, PX * n + i, n, point)
            store_rows(points, NX * n + i, n, normal)
            store(points, REFERENCE * n + i, gather(intensity, row, at))
            store(points, WEIGHT * n + i, gather(weight, row, at))
            i += LANES
    return points


@formula
def _rotated(constants: Vectors, a: Vectors) -> Vectors:
    """A vector of the reference camera in the live one's axes."""
    rows = (constants[ROTATION + 3 * k : ROTATION + 3 * k + 3] for k in range(3))
    return tuple(a[0] * r0 + a[1] * r1 + a[2] * r2 for r0, r1, r2 in rows)


@formula
def _moved(constants: Vectors, point: Vectors) -> Vectors:
    """A point of the reference camera in the live one: Y = R X + t, and 1 / Y_z, never above 1 / NEAREST."""
    translation = constants[TRANSLATION : TRANSLATION + 3]
    X, Y, Z = (turned + t for turned, t in zip(_rotated(constants, point), translation, strict=True))
    return X, Y, Z, _ONE / maximum(Z, Z.of(NEAREST))


@formula
def _pixel(constants: Vectors, point: Vectors, moved: Vectors, end_u: Vector, end_v: Vector) -> Vectors:
    """Where a point is seen, (u, v), and whether it is in view, 0 or 1."""
    focal_x, focal_y, center_x, center_y = constants[INTRINSICS : INTRINSICS + 4]
    (_, _, pz), (X, Y, Z, iz) = point, moved
    zero, one = X.of(_ZERO), X.of(_ONE)
    u, v = X * iz * focal_x + center_x, Y * iz * focal_y + center_y
    in_front = where_ge(pz, X.of(TINY), where_ge(Z, X.of(NEAREST), one, zero), zero)
    in_columns = where_ge(u, end_u, zero, where_ge(u, one, in_front, zero))
    in_view = where_ge(v, end_v, zero, where_ge(v, one, in_columns, zero))
    half = X.of(_HALF)
    return where_ge(in_view, half, u, one), where_ge(in_view, half, v, one), in_view


def _added_by(weight: Vector, r: Vector, j: Vectors) -> Vectors:
    """What one weighted residual adds to H (upper triangle) and to g."""
    weighted = [weight * slope for slope in j]
    return (*(weighted[a] * j[b] for a in range(6) for b in range(a, 6)), *(wj * r for wj in weighted))


@formula
def _added(
    constants: Vectors, precisions: Vectors, moved: Vectors, between: Vectors, squares: Vectors, normal: Vectors,
    reference: Vector, weight: Vector, in_view: Vector,
) -> tuple[Vectors, Vectors, Vectors]:  # fmt: skip
    """What sixteen points add to the sums of `normal_equations`: by depth, by colour, and to the statistics.

    `between` is where a point is between the four pixels that `squares` has the channels of.
    """
    (X, Y, Z, iz), (a, b), (color_precision, depth_precision) = moved, between, precisions
    focal_x, focal_y = constants[INTRINSICS], constants[INTRINSICS + 1]
    zero, one, half = X.of(_ZERO), X.of(_ONE), X.of(_HALF)
    w11 = a * b
    w10, w01 = a - w11, b - w11
    w00 = _ONE - a - w01

    def mixed(channel: int) -> Vector:
        c00, c10, c01, c11 = squares[channel::CHANNELS]
        return w00 * c00 + w10 * c10 + w01 * c01 + w11 * c11

    def slopes(jx: Vector, jy: Vector, jz: Vector) -> Vectors:
        return jx, jy, jz, Y * jz - Z * jy, Z * jx - X * jz, X * jy - Y * jx

    # Depth: bilinear where the four pixels lie on one surface, else the nearest one's.
    d00, d10, d01, d11 = squares[3::CHANNELS]
    low, high = minimum(minimum(d00, d10), minimum(d01, d11)), maximum(maximum(d00, d10), maximum(d01, d11))
    nearest = where_ge(b, half, where_ge(a, half, d11, d01), where_ge(a, half, d10, d00))
    d = where_ge(high - low, low * SMOOTH, nearest, mixed(3))
    in_view = where_ge(d, zero, in_view, zero)
    reading = where_ge(d, d.of(TINY), in_view, zero)
    agreeing = where_ge((d * _HALF + _ONE) * constants[GATE], apart(d, Z), reading, zero)
    behind = where_ge(agreeing, half, d - Z, zero)

    # Geometry. dr/drho = -n, dr/domega = -(Y x n); residual and slope are divided by n . ray.
    nx, ny, nz = _rotated(constants, normal)
    facing = (nx * X + ny * Y + nz * Z) * iz
    faces = where_ge(maximum(facing, zero - facing), d.of(FACING), one, zero)
    scale = where_ge(faces, half, _ONE / facing, zero)
    past = d - BASE
    sigma = past * past * constants[SIGMA_SLOPE] + constants[SIGMA_FLOOR]
    precision = _ONE / (sigma * sigma)
    depth_square = behind * behind * precision
    depth_counts = weight * agreeing * faces
    student = (STUDENT_DOF + _ONE) / (depth_square * depth_precision + STUDENT_DOF)
    depth_weight = depth_counts * student
    j = slopes(zero - nx * scale, zero - ny * scale, zero - nz * scale)
    by_depth = _added_by(depth_weight * precision * (depth_precision * constants[BALANCE]), behind, j)

    # Colour, where the depth does not disagree.
    seen = mixed(0)
    r = seen - (reference * constants[GAIN] + constants[OFFSET])
    color_counts = weight * (in_view - reading + agreeing)
    student = (STUDENT_DOF + _ONE) / (r * r * color_precision + STUDENT_DOF)
    color_weight = color_counts * student
    jx, jy = mixed(1) * iz * focal_x, mixed(2) * iz * focal_y
    by_color = _added_by(color_weight * color_precision, r, slopes(jx, jy, zero - (jx * X + jy * Y) * iz))

    by_reference, by_seen = color_weight * reference, color_weight * seen
    statistics = (
        color_weight * r * r, color_counts, depth_weight * depth_square, depth_counts,
        color_weight, by_reference, by_seen, by_reference * reference, by_reference * seen, by_seen * seen,
        in_view, reading, agreeing,
    )  # fmt: skip
    return by_depth, by_color, statistics


@kernel("f4[::1], i8, f4[::1], i8, i8, f4[::1], f8[::1]")
def normal_equations(points, n, live, h, w, constants, totals):
    """One Gauss-Newton pass over the reference points: adds to the SUMS, float64.

    A point X of the reference camera goes to Y = R X + t in the live camera; the pose is perturbed on the left,
    Y + rho + omega x Y. Residuals:
    colour     r = I_live(pi(Y)) - (gain I_ref + offset)                  in grey levels of [0, 1]
    geometry   r = (D_live(pi(Y)) - Y_z) (n . ray), over sigma_z |n . ray|  point to plane along the viewing ray
    with sigma_z(d) = sigma_floor + sigma_slope (d - 0.4)^2 metres (Nguyen et al., 3DIMPVT 2012). A point whose depth
    disagrees by more than `gate` (1 + z/2) metres is hidden or has moved, and neither of its residuals counts.

    What does not count has weight 0, looks at pixel (1, 1) if it is out of view, and never multiplies 0 by infinity.
    """
    precisions = (
        _ONE / (constants[COLOR_SCALE] * constants[COLOR_SCALE]),
        _ONE / (constants[DEPTH_SCALE] * constants[DEPTH_SCALE]),
    )
    end_u, end_v = np.float32(w - 2), np.float32(h - 2)
    numbers = load_spread(constants, 0, CONSTANTS)
    sums = carray(stack_floats(640), SUMS * LANES)
    for start in range(0, n, _CHUNK * LANES):
        for entry in range(SUMS):
            store(sums, entry * LANES, spread(_ZERO))
        for i in range(start, min(start + _CHUNK * LANES, n), LANES):
            point = load_rows(points, PX * n + i, n, 3)
            moved = _moved(numbers, point)
            u, v, in_view = _pixel(numbers, point, moved, end_u, end_v)
            if mask_ge(in_view, spread(_HALF)) == 0:
                continue
            x0, y0 = floor(u), floor(v)
            by_depth, by_color, statistics = _added(
                numbers, precisions, moved, (u - x0, v - y0), gather_squares(live, CHANNELS * w, x0, y0),
                load_rows(points, NX * n + i, n, 3), load(points, REFERENCE * n + i), load(points, WEIGHT * n + i),
                in_view,
            )  # fmt: skip
            add_rows(sums, HESSIAN * LANES, LANES, by_depth)
            add_rows(sums, HESSIAN * LANES, LANES, by_color)
            add_rows(sums, FIRST_STATISTIC * LANES, LANES, statistics)
        for entry in range(SUMS):
            totals[entry] += sum_lanes(load(sums, entry * LANES))
    return totals
