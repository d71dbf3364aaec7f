"""Eqs. 2 and 3 for sixteen Gaussians at a time: parameters to image-plane records, and the chain rule back.

The names follow `render/reference.py`, which says the same in matrices. Row r of `J R` is the derivative of (u, v, z)
by the map frame; `n_rk` is that row times own axis k, `m_rk = n_rk s_k`, and the covariance of (u, v, z) is `m m^T`.
A derivative of the loss by `x` is called `d_x`.
"""

import math

import numpy as np
from numba import carray, njit

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
    floor,
    load,
    load_transposed,
    maximum,
    minimum,
    spread,
    sqrt,
    stack_floats,
    store,
    store_int32_pairs,
    store_transposed,
    sum_lanes,
    where_ge,
)
from tcgsplat.render.protocol import BLUR, MIN_ALPHA, NEAR_PLANE, PLANE_SOFTENING

_BLUR, _SOFT, _NEAR = np.float32(BLUR), np.float32(PLANE_SOFTENING), np.float32(NEAR_PLANE)
_LOG2_MIN_ALPHA = np.float32(math.log2(MIN_ALPHA))
_TWO_LN2 = np.float32(2 * math.log(2))
_HALF_LOG2E = np.float32(-0.5 / math.log(2))
_LN2 = np.float32(math.log(2))
_ZERO, _ONE, _TWO, _PER_TILE = np.float32(0), np.float32(1), np.float32(2), np.float32(1 / TILE)
_SPAN_UNIT = np.float32(SPAN_UNIT)

POSE_SUMS = 12
"""Numbers that `backward` sums for the pose: derivatives by the rotation (row by row) and the translation."""


@njit(fastmath=MATH, **INNER, inline="always")
def _expand(P, n, i, cam):
    """Centre in the camera, rows of J R, own axes as a rotation, and what they are made of."""
    R, t = ROTATION, TRANSLATION
    X, Y, Z = load(P, MEAN * n + i), load(P, (MEAN + 1) * n + i), load(P, (MEAN + 2) * n + i)
    x = X * cam[R] + Y * cam[R + 1] + Z * cam[R + 2] + cam[t]
    y = X * cam[R + 3] + Y * cam[R + 4] + Z * cam[R + 5] + cam[t + 1]
    z_true = X * cam[R + 6] + Y * cam[R + 7] + Z * cam[R + 8] + cam[t + 2]
    z = maximum(z_true, spread(_NEAR * np.float32(0.5)))
    iz = _ONE / z
    a, b = x * iz, y * iz
    lim = SLOPE_LIMITS
    a_c = maximum(minimum(a, spread(cam[lim + 1])), spread(cam[lim]))
    b_c = maximum(minimum(b, spread(cam[lim + 3])), spread(cam[lim + 2]))
    ju, jv = iz * cam[FOCAL], iz * cam[FOCAL + 1]
    # J R: the slopes of u and v mix the camera's own row with its viewing axis.
    j00, j01, j02 = ju * (cam[R] - a_c * cam[R + 6]), ju * (cam[R + 1] - a_c * cam[R + 7]), ju * (cam[R + 2] - a_c * cam[R + 8])
    j10, j11, j12 = jv * (cam[R + 3] - b_c * cam[R + 6]), jv * (cam[R + 4] - b_c * cam[R + 7]), jv * (cam[R + 5] - b_c * cam[R + 8])
    qw, qx, qy, qz = load(P, QUAT * n + i), load(P, (QUAT + 1) * n + i), load(P, (QUAT + 2) * n + i), load(P, (QUAT + 3) * n + i)
    inverse_length = _ONE / sqrt(maximum(qw * qw + qx * qx + qy * qy + qz * qz, spread(np.float32(1e-24))))
    w, p, q, r = qw * inverse_length, qx * inverse_length, qy * inverse_length, qz * inverse_length
    r00, r01, r02 = _ONE - (q * q + r * r) * _TWO, (p * q - w * r) * _TWO, (p * r + w * q) * _TWO
    r10, r11, r12 = (p * q + w * r) * _TWO, _ONE - (p * p + r * r) * _TWO, (q * r - w * p) * _TWO
    r20, r21, r22 = (p * r - w * q) * _TWO, (q * r + w * p) * _TWO, _ONE - (p * p + q * q) * _TWO
    return (
        (X, Y, Z), (x, y, z_true, z, iz), (a, b, a_c, b_c), (ju, jv),
        (j00, j01, j02, j10, j11, j12), (w, p, q, r, inverse_length),
        (r00, r01, r02, r10, r11, r12, r20, r21, r22),
    )  # fmt: skip


@njit(fastmath=MATH, **INNER, inline="always")
def _axes(J, Q, cam):
    """N = J R R(q): image-space rows of the own axes, before scaling."""
    j00, j01, j02, j10, j11, j12 = J
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = Q
    c0, c1, c2 = cam[ROTATION + 6], cam[ROTATION + 7], cam[ROTATION + 8]
    return (
        j00 * r00 + j01 * r10 + j02 * r20, j00 * r01 + j01 * r11 + j02 * r21, j00 * r02 + j01 * r12 + j02 * r22,
        j10 * r00 + j11 * r10 + j12 * r20, j10 * r01 + j11 * r11 + j12 * r21, j10 * r02 + j11 * r12 + j12 * r22,
        r00 * c0 + r10 * c1 + r20 * c2, r01 * c0 + r11 * c1 + r21 * c2, r02 * c0 + r12 * c1 + r22 * c2,
    )  # fmt: skip


@njit(fastmath=MATH, **INNER, inline="always")
def _plane_and_footprint(m):
    """From scaled axes: cov(u, v); slopes of the plane, z regressed on (u, v); blurred variances and 1 / determinant."""
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = m
    uu, uv, vv = m00 * m00 + m01 * m01 + m02 * m02, m00 * m10 + m01 * m11 + m02 * m12, m10 * m10 + m11 * m11 + m12 * m12
    uz, vz = m00 * m20 + m01 * m21 + m02 * m22, m10 * m20 + m11 * m21 + m12 * m22
    au, av = uu + _SOFT, vv + _SOFT
    plane_inverse = _ONE / (au * av - uv * uv)
    slope_u, slope_v = (av * uz - uv * vz) * plane_inverse, (au * vz - uv * uz) * plane_inverse
    bu, bv = uu + _BLUR, vv + _BLUR
    return uv, (slope_u, slope_v, au, av, plane_inverse), (bu, bv, uv, _ONE / (bu * bv - uv * uv))


@njit(fastmath=MATH, **INNER)
def forward(P, n, start, stop, cam, tiles_x, records, depths, rectangles):
    """Records, depths (0: not visible) and rectangles of tiles (see `layout.SPAN_UNIT`) of a range."""
    zero = spread(_ZERO)
    last_x, last_y = spread(cam[LAST_PIXEL]), spread(cam[LAST_PIXEL + 1])
    for i in range(start, stop, 16):
        _, (x, y, z_true, z, iz), (a, b, a_c, b_c), _, J, _, Q = _expand(P, n, i, cam)
        n00, n01, n02, n10, n11, n12, n20, n21, n22 = _axes(J, Q, cam)
        s0, s1, s2 = load(P, SCALE * n + i), load(P, (SCALE + 1) * n + i), load(P, (SCALE + 2) * n + i)
        m = n00 * s0, n01 * s1, n02 * s2, n10 * s0, n11 * s1, n12 * s2, n20 * s0, n21 * s1, n22 * s2
        _, (slope_u, slope_v, _, _, _), (bu, bv, uv, inverse) = _plane_and_footprint(m)
        scaled = inverse * _HALF_LOG2E  # the footprint's quadratic form, in log2 units
        A, B, C = bv * scaled, uv * scaled * np.float32(-2), bu * scaled
        u, v = a * cam[FOCAL] + cam[CENTER], b * cam[FOCAL + 1] + cam[CENTER + 1]
        log2_opacity = load(P, LOG2_OPACITY * n + i)
        # The box around log2 alpha >= log2 MIN_ALPHA, rounded inwards to pixel centres of the image.
        k = (log2_opacity - _LOG2_MIN_ALPHA) * _TWO_LN2
        reach = maximum(k, zero)
        half_u, half_v = sqrt(reach * bu), sqrt(reach * bv)
        x0, y0 = maximum(zero - floor(half_u - u), zero), maximum(zero - floor(half_v - v), zero)
        x1, y1 = minimum(floor(u + half_u), last_x), minimum(floor(v + half_v), last_y)
        seen = minimum(minimum(x1 - x0, y1 - y0), minimum(k, where_ge(spread(_NEAR), z_true, zero - _ONE, zero)))
        left, top = floor(minimum(x0, last_x) * _PER_TILE), floor(minimum(y0, last_y) * _PER_TILE)
        columns, rows = floor(maximum(x1, zero) * _PER_TILE) - left, floor(maximum(y1, zero) * _PER_TILE) - top
        first, span = top * np.float32(tiles_x) + left, rows * _SPAN_UNIT + columns
        store_int32_pairs(rectangles, 2 * i, where_ge(seen, zero, first, zero), where_ge(seen, zero, span, zero))
        store(depths, i, where_ge(seen, zero, z, zero))
        f = FEATURE
        store_transposed(records, i * RECORD, (
            u, v, A, B, C, log2_opacity, zero - B / (C * _TWO), zero - B / (A * _TWO),
            load(P, f * n + i), load(P, (f + 1) * n + i), load(P, (f + 2) * n + i), load(P, (f + 3) * n + i),
            z, slope_u, slope_v, zero,
        ))  # fmt: skip


@njit(fastmath=MATH, **INNER)
def backward(P, n, start, stop, cam, slot_starts, pair_sums, grads, pose):
    """From each pair's sums over its pixels to derivatives by a range's parameters and by the pose.

    Splat i's pairs have the rows `slot_starts[i]` .. `slot_starts[i + 1]` of sixteen floats (see `blending.backward`);
    `grads` is laid out like the parameters; `pose` receives POSE_SUMS numbers.
    """
    zero, sums = spread(_ZERO), carray(stack_floats(256), 256)
    p00, p01, p02, p10, p11, p12 = zero, zero, zero, zero, zero, zero
    p20, p21, p22, pt0, pt1, pt2 = zero, zero, zero, zero, zero, zero
    R = ROTATION
    for i in range(start, stop, 16):
        if slot_starts[i] == slot_starts[i + 16]:
            for row in range(PARAMETERS):
                store(grads, row * n + i, zero)
            continue
        for k in range(16):
            total = zero
            for slot in range(np.int64(slot_starts[i + k]), np.int64(slot_starts[i + k + 1])):
                total = total + load(pair_sums, slot * RECORD)
            store(sums, k * RECORD, total)
        S = load_transposed(sums, 0)
        s, sx, sy, sxx, sxy, syy = S[0], S[1], S[2], S[3], S[4], S[5]
        d_z, d_plane, plane_x, plane_y = S[10], S[11], S[12], S[13]
        (X, Y, Z), (x, y, z_true, z, iz), (a, b, a_c, b_c), (ju, jv), J, (w, p, q, r, inverse_length), Q = _expand(P, n, i, cam)
        n00, n01, n02, n10, n11, n12, n20, n21, n22 = _axes(J, Q, cam)
        s0, s1, s2 = load(P, SCALE * n + i), load(P, (SCALE + 1) * n + i), load(P, (SCALE + 2) * n + i)
        m = n00 * s0, n01 * s1, n02 * s2, n10 * s0, n11 * s1, n12 * s2, n20 * s0, n21 * s1, n22 * s2
        uv, (slope_u, slope_v, au, av, plane_inverse), (bu, bv, _, inverse) = _plane_and_footprint(m)
        m00, m01, m02, m10, m11, m12, m20, m21, m22 = m
        ca, cb, cc = bv * inverse, zero - uv * inverse, bu * inverse

        # Footprint: d ln(alpha) = -1/2 d(offset^T conic offset).
        e00, e01, e10, e11 = ca * sxx + cb * sxy, ca * sxy + cb * syy, cb * sxx + cc * sxy, cb * sxy + cc * syy
        d_uu, d_vv = (e00 * ca + e01 * cb) * np.float32(0.5), (e10 * cb + e11 * cc) * np.float32(0.5)
        d_uv = e00 * cb + e01 * cc
        d_u, d_v = ca * sx + cb * sy - slope_u * d_plane, cb * sx + cc * sy - slope_v * d_plane
        # Plane: slope = (cov_uv + soft)^-1 cov_z.
        d_uz, d_vz = (av * plane_x - uv * plane_y) * plane_inverse, (au * plane_y - uv * plane_x) * plane_inverse
        d_uu, d_vv = d_uu - d_uz * slope_u, d_vv - d_vz * slope_v
        d_uv = d_uv - d_uz * slope_v - d_vz * slope_u

        # Covariance m m^T to the scaled axes, to scales and unscaled axes.
        dm00, dm01, dm02 = d_uu * m00 * _TWO + d_uv * m10 + d_uz * m20, d_uu * m01 * _TWO + d_uv * m11 + d_uz * m21, d_uu * m02 * _TWO + d_uv * m12 + d_uz * m22
        dm10, dm11, dm12 = d_vv * m10 * _TWO + d_uv * m00 + d_vz * m20, d_vv * m11 * _TWO + d_uv * m01 + d_vz * m21, d_vv * m12 * _TWO + d_uv * m02 + d_vz * m22
        dm20, dm21, dm22 = d_uz * m00 + d_vz * m10, d_uz * m01 + d_vz * m11, d_uz * m02 + d_vz * m12
        store(grads, SCALE * n + i, dm00 * n00 + dm10 * n10 + dm20 * n20)
        store(grads, (SCALE + 1) * n + i, dm01 * n01 + dm11 * n11 + dm21 * n21)
        store(grads, (SCALE + 2) * n + i, dm02 * n02 + dm12 * n12 + dm22 * n22)
        dn00, dn01, dn02 = dm00 * s0, dm01 * s1, dm02 * s2
        dn10, dn11, dn12 = dm10 * s0, dm11 * s1, dm12 * s2
        dn20, dn21, dn22 = dm20 * s0, dm21 * s1, dm22 * s2

        # n = (J R) R(q): to the quaternion ...
        j00, j01, j02, j10, j11, j12 = J
        j20, j21, j22 = cam[R + 6], cam[R + 7], cam[R + 8]
        h00, h01, h02 = j00 * dn00 + j10 * dn10 + j20 * dn20, j00 * dn01 + j10 * dn11 + j20 * dn21, j00 * dn02 + j10 * dn12 + j20 * dn22
        h10, h11, h12 = j01 * dn00 + j11 * dn10 + j21 * dn20, j01 * dn01 + j11 * dn11 + j21 * dn21, j01 * dn02 + j11 * dn12 + j21 * dn22
        h20, h21, h22 = j02 * dn00 + j12 * dn10 + j22 * dn20, j02 * dn01 + j12 * dn11 + j22 * dn21, j02 * dn02 + j12 * dn12 + j22 * dn22
        d_w = (r * (h10 - h01) + q * (h02 - h20) + p * (h21 - h12)) * _TWO
        d_p = (q * (h01 + h10) + r * (h02 + h20) + w * (h21 - h12) - p * (h11 + h22) * _TWO) * _TWO
        d_q = (p * (h01 + h10) + r * (h12 + h21) + w * (h02 - h20) - q * (h00 + h22) * _TWO) * _TWO
        d_r = (p * (h02 + h20) + q * (h12 + h21) + w * (h10 - h01) - r * (h00 + h11) * _TWO) * _TWO
        along = d_w * w + d_p * p + d_q * q + d_r * r  # the length of a quaternion does not matter
        store(grads, QUAT * n + i, (d_w - along * w) * inverse_length)
        store(grads, (QUAT + 1) * n + i, (d_p - along * p) * inverse_length)
        store(grads, (QUAT + 2) * n + i, (d_q - along * q) * inverse_length)
        store(grads, (QUAT + 3) * n + i, (d_r - along * r) * inverse_length)

        # ... and to the rows of J R.
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = Q
        dj00, dj01, dj02 = dn00 * r00 + dn01 * r01 + dn02 * r02, dn00 * r10 + dn01 * r11 + dn02 * r12, dn00 * r20 + dn01 * r21 + dn02 * r22
        dj10, dj11, dj12 = dn10 * r00 + dn11 * r01 + dn12 * r02, dn10 * r10 + dn11 * r11 + dn12 * r12, dn10 * r20 + dn11 * r21 + dn12 * r22
        dj20, dj21, dj22 = dn20 * r00 + dn21 * r01 + dn22 * r02, dn20 * r10 + dn21 * r11 + dn22 * r12, dn20 * r20 + dn21 * r21 + dn22 * r22
        along_u0 = dj00 * cam[R] + dj01 * cam[R + 1] + dj02 * cam[R + 2]
        along_uz = dj00 * j20 + dj01 * j21 + dj02 * j22
        along_v1 = dj10 * cam[R + 3] + dj11 * cam[R + 4] + dj12 * cam[R + 5]
        along_vz = dj10 * j20 + dj11 * j21 + dj12 * j22
        d_ju, d_jv = along_u0 - a_c * along_uz, along_v1 - b_c * along_vz
        # Beyond the limits the slope a_c is constant. |a - a_c| > 0 there, so compare with a tiny number.
        away_a, away_b = maximum(a - a_c, a_c - a), maximum(b - b_c, b_c - b)
        tiny = spread(np.float32(1e-12))
        d_a = d_u * cam[FOCAL] - where_ge(away_a, tiny, zero, ju * along_uz)
        d_b = d_v * cam[FOCAL + 1] - where_ge(away_b, tiny, zero, jv * along_vz)
        d_x, d_y = d_a * iz, d_b * iz
        d_zc = d_z + d_plane - iz * (d_a * a + d_b * b + d_ju * ju + d_jv * jv)

        store(grads, MEAN * n + i, d_x * cam[R] + d_y * cam[R + 3] + d_zc * cam[R + 6])
        store(grads, (MEAN + 1) * n + i, d_x * cam[R + 1] + d_y * cam[R + 4] + d_zc * cam[R + 7])
        store(grads, (MEAN + 2) * n + i, d_x * cam[R + 2] + d_y * cam[R + 5] + d_zc * cam[R + 8])
        # d ln(alpha) = d ln(opacity): the parameter is log2 of it.
        store(grads, LOG2_OPACITY * n + i, s * _LN2)
        store(grads, FEATURE * n + i, S[6])
        store(grads, (FEATURE + 1) * n + i, S[7])
        store(grads, (FEATURE + 2) * n + i, S[8])
        store(grads, (FEATURE + 3) * n + i, S[9])

        p00, p01, p02 = p00 + d_x * X + ju * dj00, p01 + d_x * Y + ju * dj01, p02 + d_x * Z + ju * dj02
        p10, p11, p12 = p10 + d_y * X + jv * dj10, p11 + d_y * Y + jv * dj11, p12 + d_y * Z + jv * dj12
        ka, kb = a_c * ju, b_c * jv
        p20 = p20 + d_zc * X + dj20 - ka * dj00 - kb * dj10
        p21 = p21 + d_zc * Y + dj21 - ka * dj01 - kb * dj11
        p22 = p22 + d_zc * Z + dj22 - ka * dj02 - kb * dj12
        pt0, pt1, pt2 = pt0 + d_x, pt1 + d_y, pt2 + d_zc
    for k, value in enumerate((p00, p01, p02, p10, p11, p12, p20, p21, p22, pt0, pt1, pt2)):
        pose[k] = sum_lanes(value)
