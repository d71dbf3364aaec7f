"""Eqs. 2 and 3 for sixteen Gaussians at a time: parameters to image-plane records, and the chain rule back.

The names follow `render/reference.py`, which says the same in matrices. Row r of `J R` is the derivative of (u, v, z)
by the map frame; `N` is `J R R(q)`, `m = N S` with the scales S, and the covariance of (u, v, z) is `m m^T`. Matrices
are tuples of nine vectors. A derivative of the loss by `x` is called `d_x`.
"""

import math

import numpy as np
from numba import carray, njit

from tcgsplat.render.numba_cpu.compilation import kept
from tcgsplat.render.numba_cpu.layout import (
    CENTER,
    FEATURE,
    FOCAL,
    LAST_PIXEL,
    LOG2_OPACITY,
    MEAN,
    PARAMETERS,
    QUAT,
    RECORD,
    ROTATION,
    SCALE,
    SLOPE_LIMITS,
    SPAN_UNIT,
    TILE,
    TRANSLATION,
)
from tcgsplat.render.numba_cpu.simd import (
    INNER,
    MATH,
    dot,
    floor,
    lane_sums,
    load,
    load_first,
    load_rows,
    load_spread,
    load_transposed,
    maximum,
    minimum,
    prefetch,
    product,
    spread,
    sqrt,
    stack_floats,
    store,
    store_int32_pairs,
    store_rows,
    store_transposed,
    times_columns,
    transposed,
    where_ge,
)
from tcgsplat.render.protocol import BLUR, MIN_ALPHA, NEAR_PLANE, PLANE_SOFTENING

_BLUR, _SOFT, _NEAR = np.float32(BLUR), np.float32(PLANE_SOFTENING), np.float32(NEAR_PLANE)
_MOST_INVERSE = np.float32(1.001 / BLUR**2)
_LOG2_MIN_ALPHA = np.float32(math.log2(MIN_ALPHA))
_TWO_LN2 = np.float32(2 * math.log(2))
_HALF_LOG2E = np.float32(-0.5 / math.log(2))
_LN2 = np.float32(math.log(2))
_ZERO, _ONE, _TWO, _PER_TILE = np.float32(0), np.float32(1), np.float32(2), np.float32(1 / TILE)
_SPAN_UNIT = np.float32(SPAN_UNIT)

_AHEAD = 128  # rows asked for in advance: the processor does not, across pages
POSE_SUMS = 12
"""Numbers that `backward` sums for the pose: derivatives by the rotation (row by row) and the translation."""


@njit(fastmath=MATH, **INNER, inline="always")
def _expand(P, i, cam):
    """Centre in the camera, J R, own axes as a rotation, N = J R R(q), N S, and what they are made of."""
    point = load_rows(P, PARAMETERS * i + 16 * MEAN, 16, 3)
    row_x, row_y, row_z = load_spread(cam, ROTATION, 3), load_spread(cam, ROTATION + 3, 3), load_spread(cam, ROTATION + 6, 3)
    x, y = dot(row_x, point) + cam[TRANSLATION], dot(row_y, point) + cam[TRANSLATION + 1]
    z_true = dot(row_z, point) + cam[TRANSLATION + 2]
    z = maximum(z_true, spread(_NEAR * np.float32(0.5)))
    iz = _ONE / z
    a, b = x * iz, y * iz
    least_a, most_a, least_b, most_b = load_spread(cam, SLOPE_LIMITS, 4)
    a_c, b_c = maximum(minimum(a, most_a), least_a), maximum(minimum(b, most_b), least_b)
    ju, jv = iz * cam[FOCAL], iz * cam[FOCAL + 1]
    # J R: the slopes of u and v mix the camera's own row with its viewing axis.
    J = (
        ju * (row_x[0] - a_c * row_z[0]), ju * (row_x[1] - a_c * row_z[1]), ju * (row_x[2] - a_c * row_z[2]),
        jv * (row_y[0] - b_c * row_z[0]), jv * (row_y[1] - b_c * row_z[1]), jv * (row_y[2] - b_c * row_z[2]),
        row_z[0], row_z[1], row_z[2],
    )  # fmt: skip
    quat = load_rows(P, PARAMETERS * i + 16 * QUAT, 16, 4)
    inverse_length = _ONE / sqrt(maximum(dot(quat, quat), spread(np.float32(1e-24))))
    w, p, q, r = quat[0] * inverse_length, quat[1] * inverse_length, quat[2] * inverse_length, quat[3] * inverse_length
    w2, p2, q2 = w * _TWO, p * _TWO, q * _TWO
    wp, wq, wr, pp, pq, pr, qq, qr, rr = w2 * p, w2 * q, w2 * r, p2 * p, p2 * q, p2 * r, q2 * q, q2 * r, r * r * _TWO
    Q = _ONE - (qq + rr), pq - wr, pr + wq, pq + wr, _ONE - (pp + rr), qr - wp, pr - wq, qr + wp, _ONE - (pp + qq)
    N = product(J, Q)
    scales = load_rows(P, PARAMETERS * i + 16 * SCALE, 16, 3)
    return point, (x, y, z_true, z, iz), (a, b, a_c, b_c), (ju, jv), J, (w, p, q, r, inverse_length), Q, N, scales, times_columns(N, scales)


@njit(fastmath=MATH, **INNER, inline="always")
def _plane_and_footprint(m):
    """From scaled axes: slopes of the plane, z regressed on (u, v); cov(u, v), blurred variances and 1 / determinant."""
    uu, uv, uz, _, vv, vz, _, _, _ = product(m, transposed(m))
    au, av = uu + _SOFT, vv + _SOFT
    plane_inverse = _ONE / (au * av - uv * uv)
    slope_u, slope_v = (av * uz - uv * vz) * plane_inverse, (au * vz - uv * uz) * plane_inverse
    bu, bv = uu + _BLUR, vv + _BLUR
    return (slope_u, slope_v, au, av, plane_inverse), (bu, bv, uv, _ONE / (bu * bv - uv * uv))


@kept(njit(fastmath=MATH, **INNER))
def forward(P, start, stop, cam, tiles_x, records, depths, rectangles):
    """Records, depths (0: not visible) and rectangles of tiles (see `layout.SPAN_UNIT`) of a range."""
    zero, one = spread(_ZERO), spread(_ONE)
    last_x, last_y = load_spread(cam, LAST_PIXEL, 2)
    for i in range(start, stop, 16):
        _, (_, _, z_true, z, _), (a, b, _, _), _, _, _, _, _, _, m = _expand(P, i, cam)
        (slope_u, slope_v, _, _, _), (bu, bv, uv, inverse) = _plane_and_footprint(m)
        scaled = inverse * _HALF_LOG2E  # the footprint's quadratic form, in log2 units
        A, B, C = bv * scaled, uv * scaled * np.float32(-2), bu * scaled
        u, v = a * cam[FOCAL] + cam[CENTER], b * cam[FOCAL + 1] + cam[CENTER + 1]
        log2_opacity = load(P, PARAMETERS * i + 16 * LOG2_OPACITY)
        # The box around log2 alpha >= log2 MIN_ALPHA, rounded inwards to pixel centres of the image.
        k = (log2_opacity - _LOG2_MIN_ALPHA) * _TWO_LN2
        reach = maximum(k, zero)
        half_u, half_v = sqrt(reach * bu), sqrt(reach * bv)
        x0, y0 = maximum(zero - floor(half_u - u), zero), maximum(zero - floor(half_v - v), zero)
        x1, y1 = minimum(floor(u + half_u), last_x), minimum(floor(v + half_v), last_y)
        seen = minimum(minimum(x1 - x0, y1 - y0), minimum(k, where_ge(spread(_NEAR), z_true, zero - one, zero)))
        # Of needles thousands of pixels long rounding leaves no determinant, which is never below BLUR^2.
        seen = minimum(seen, minimum(inverse, _MOST_INVERSE - inverse))
        left, top = floor(minimum(x0, last_x) * _PER_TILE), floor(minimum(y0, last_y) * _PER_TILE)
        columns, rows = floor(maximum(x1, zero) * _PER_TILE) - left, floor(maximum(y1, zero) * _PER_TILE) - top
        first, span = top * np.float32(tiles_x) + left, rows * _SPAN_UNIT + columns
        store_int32_pairs(rectangles, 2 * i, where_ge(seen, zero, first, zero), where_ge(seen, zero, span, zero))
        store(depths, i, where_ge(seen, zero, z, zero))
        f0, f1, f2, f3 = load_rows(P, PARAMETERS * i + 16 * FEATURE, 16, 4)
        ridge_y, ridge_x = zero - B / (C * _TWO), zero - B / (A * _TWO)
        store_transposed(
            records, i * RECORD,
            (u, v, A, B, C, log2_opacity, ridge_y, ridge_x, f0, f1, f2, f3, z, slope_u, slope_v, zero),
        )  # fmt: skip


@kept(njit(fastmath=MATH, **INNER))
def backward(P, n, start, stop, cam, slot_starts, pair_sums, grads, pose):
    """From each pair's sums over its pixels to derivatives by a range's parameters and by the pose.

    Splat i's pairs have the rows `slot_starts[i]` .. `slot_starts[i + 1]` of sixteen floats (see `blending.backward`);
    `grads` is laid out like the parameters; `pose` receives POSE_SUMS numbers.
    """
    zero, sums = spread(_ZERO), carray(stack_floats(256), 256)
    p00, p01, p02, p10, p11, p12 = zero, zero, zero, zero, zero, zero
    p20, p21, p22, pt0, pt1, pt2 = zero, zero, zero, zero, zero, zero
    row_x, row_y, row_z = load_spread(cam, ROTATION, 3), load_spread(cam, ROTATION + 3, 3), load_spread(cam, ROTATION + 6, 3)
    tiny, last_slot = spread(np.float32(1e-12)), np.int64(slot_starts[n]) - 1
    for i in range(start, stop, 16):
        if slot_starts[i] == slot_starts[i + 16]:
            for row in range(PARAMETERS):
                store(grads, PARAMETERS * i + 16 * row, zero)
            continue
        for k in range(16):
            slot, end = np.int64(slot_starts[i + k]), np.int64(slot_starts[i + k + 1])
            prefetch(pair_sums, min(slot + _AHEAD, last_slot) * RECORD)
            prefetch(pair_sums, min(slot + _AHEAD + 1, last_slot) * RECORD)
            total = zero
            for _ in range(4):  # mostly enough, and loads of nothing are cheaper than guessing how many there are
                total = total + load_first(pair_sums, slot * RECORD, (end - slot) * RECORD)
                slot += 1
            while slot < end:
                total = total + load(pair_sums, slot * RECORD)
                slot += 1
            store(sums, k * RECORD, total)
        s, sx, sy, sxx, sxy, syy, d_f0, d_f1, d_f2, d_f3, d_z, d_plane, plane_x, plane_y, _, _ = load_transposed(sums, 0)
        point, (_, _, _, _, iz), (a, b, a_c, b_c), (ju, jv), J, (w, p, q, r, inverse_length), Q, N, scales, m = _expand(P, i, cam)
        (slope_u, slope_v, au, av, plane_inverse), (bu, bv, uv, inverse) = _plane_and_footprint(m)
        ca, cb, cc = bv * inverse, zero - uv * inverse, bu * inverse

        # Footprint: d ln(alpha) = -1/2 d(offset^T conic offset). The derivatives by variances are taken twice.
        e00, e01, e10, e11 = ca * sxx + cb * sxy, ca * sxy + cb * syy, cb * sxx + cc * sxy, cb * sxy + cc * syy
        d_uu, d_uv, d_vv = e00 * ca + e01 * cb, e00 * cb + e01 * cc, e10 * cb + e11 * cc
        d_u, d_v = ca * sx + cb * sy - slope_u * d_plane, cb * sx + cc * sy - slope_v * d_plane
        # Plane: slope = (cov_uv + soft)^-1 cov_z.
        d_uz, d_vz = (av * plane_x - uv * plane_y) * plane_inverse, (au * plane_y - uv * plane_x) * plane_inverse
        d_uu, d_vv = d_uu - d_uz * slope_u * _TWO, d_vv - d_vz * slope_v * _TWO
        d_uv = d_uv - d_uz * slope_v - d_vz * slope_u

        # Covariance m m^T to the scaled axes, to scales and unscaled axes.
        dm = product((d_uu, d_uv, d_uz, d_uv, d_vv, d_vz, d_uz, d_vz, zero), m)
        by_column, axes = transposed(dm), transposed(N)
        store_rows(grads, PARAMETERS * i + 16 * SCALE, 16, (dot(by_column[:3], axes[:3]), dot(by_column[3:6], axes[3:6]), dot(by_column[6:], axes[6:])))
        dN = times_columns(dm, scales)

        # N = (J R) R(q): to the quaternion ...
        h00, h01, h02, h10, h11, h12, h20, h21, h22 = product(transposed(J), dN)
        d_w = (r * (h10 - h01) + q * (h02 - h20) + p * (h21 - h12)) * _TWO
        d_p = (q * (h01 + h10) + r * (h02 + h20) + w * (h21 - h12) - p * (h11 + h22) * _TWO) * _TWO
        d_q = (p * (h01 + h10) + r * (h12 + h21) + w * (h02 - h20) - q * (h00 + h22) * _TWO) * _TWO
        d_r = (p * (h02 + h20) + q * (h12 + h21) + w * (h10 - h01) - r * (h00 + h11) * _TWO) * _TWO
        along = dot((d_w, d_p, d_q, d_r), (w, p, q, r))  # the length of a quaternion does not matter
        store_rows(grads, PARAMETERS * i + 16 * QUAT, 16, (
            (d_w - along * w) * inverse_length, (d_p - along * p) * inverse_length,
            (d_q - along * q) * inverse_length, (d_r - along * r) * inverse_length,
        ))  # fmt: skip

        # ... and to the rows of J R.
        dJ = product(dN, transposed(Q))
        along_uz, along_vz = dot(dJ[:3], row_z), dot(dJ[3:6], row_z)
        d_ju, d_jv = dot(dJ[:3], row_x) - a_c * along_uz, dot(dJ[3:6], row_y) - b_c * along_vz
        # Beyond the limits the slope a_c is constant. |a - a_c| > 0 there, so compare with a tiny number.
        away_a, away_b = maximum(a - a_c, a_c - a), maximum(b - b_c, b_c - b)
        d_a = d_u * cam[FOCAL] - where_ge(away_a, tiny, zero, ju * along_uz)
        d_b = d_v * cam[FOCAL + 1] - where_ge(away_b, tiny, zero, jv * along_vz)
        d_x, d_y = d_a * iz, d_b * iz
        d_zc = d_z + d_plane - iz * dot((d_a, d_b, d_ju, d_jv), (a, b, ju, jv))

        d_center = d_x, d_y, d_zc
        store_rows(grads, PARAMETERS * i + 16 * MEAN, 16, (
            dot(d_center, (row_x[0], row_y[0], row_z[0])), dot(d_center, (row_x[1], row_y[1], row_z[1])),
            dot(d_center, (row_x[2], row_y[2], row_z[2])),
        ))  # fmt: skip
        # d ln(alpha) = d ln(opacity): the parameter is log2 of it.
        store_rows(grads, PARAMETERS * i + 16 * LOG2_OPACITY, 16, (s * _LN2, d_f0, d_f1, d_f2, d_f3))

        X, Y, Z = point
        dj00, dj01, dj02, dj10, dj11, dj12, dj20, dj21, dj22 = dJ
        p00, p01, p02 = p00 + d_x * X + ju * dj00, p01 + d_x * Y + ju * dj01, p02 + d_x * Z + ju * dj02
        p10, p11, p12 = p10 + d_y * X + jv * dj10, p11 + d_y * Y + jv * dj11, p12 + d_y * Z + jv * dj12
        ka, kb = a_c * ju, b_c * jv
        p20 = p20 + d_zc * X + dj20 - ka * dj00 - kb * dj10
        p21 = p21 + d_zc * Y + dj21 - ka * dj01 - kb * dj11
        p22 = p22 + d_zc * Z + dj22 - ka * dj02 - kb * dj12
        pt0, pt1, pt2 = pt0 + d_x, pt1 + d_y, pt2 + d_zc
    store(sums, 0, lane_sums((p00, p01, p02, p10, p11, p12, p20, p21, p22, pt0, pt1, pt2)))
    for k in range(POSE_SUMS):
        pose[k] = sums[k]
