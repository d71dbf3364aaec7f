"""Eqs. 2 and 3 for sixteen Gaussians at a time: parameters to image-plane records, and the chain rule back.

The names follow `render/reference.py`, which says the same in matrices. Row r of `J R` is the derivative of (u, v, z)
by the map frame; `N` is `J R R(q)`, `m = N S` with the scales S, and the covariance of (u, v, z) is `m m^T`. Matrices
are tuples of nine vectors. A derivative of the loss by `x` is called `d_x`.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import carray

from tcgsplat.render.conventions import BLUR, MIN_ALPHA, NEAR_PLANE, PLANE_SOFTENING
from tcgsplat.render.numba_cpu.compilation import inner
from tcgsplat.render.numba_cpu.lanes import (
    add_rows,
    columns_of,
    lane_sums,
    load,
    load_first,
    load_rows,
    load_spread,
    prefetch,
    stack_floats,
    store,
    store_int32_pairs,
    store_rows,
)
from tcgsplat.render.numba_cpu.layout import (
    CAMERA,
    CENTER,
    FEATURE,
    FEATURES,
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
    Vector,
    Vectors,
    apart,
    dot,
    floor,
    formula,
    maximum,
    minimum,
    product,
    spread,
    sqrt,
    times_columns,
    transposed,
    where_ge,
)

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


@dataclass(frozen=True)
class _View:
    """The camera vector's numbers, each in all lanes; see `layout`."""

    row_x: Vectors
    row_y: Vectors
    row_z: Vectors
    translation: Vectors
    focal: Vectors
    center: Vectors
    slope_limits: Vectors
    last_pixel: Vectors

    @staticmethod
    def of(cam: Vectors) -> "_View":
        rows = (cam[ROTATION + 3 * k : ROTATION + 3 * k + 3] for k in range(3))
        return _View(
            *rows, cam[TRANSLATION:FOCAL], cam[FOCAL:CENTER], cam[CENTER:SLOPE_LIMITS], cam[SLOPE_LIMITS:LAST_PIXEL],
            cam[LAST_PIXEL:],
        )  # fmt: skip


@dataclass(frozen=True)
class _Expanded:
    """A splat before a camera, and what the chain rule needs of the way there."""

    center: Vectors
    """In the camera: x, y, z (m), the last at least half the near plane's."""
    z_true: Vector
    iz: Vector
    slopes: Vectors
    """x / z and y / z, and the same within the limits."""
    j: Vectors
    """Pixels a metre across, by x and by y."""
    J: Vectors
    unit_quat: Vectors
    inverse_length: Vector
    Q: Vectors
    N: Vectors
    m: Vectors

    @staticmethod
    def of(view: _View, point: Vectors, quat: Vectors, scales: Vectors) -> "_Expanded":
        row_x, row_y, row_z = view.row_x, view.row_y, view.row_z
        x, y = dot(row_x, point) + view.translation[0], dot(row_y, point) + view.translation[1]
        z_true = dot(row_z, point) + view.translation[2]
        z = maximum(z_true, z_true.of(_NEAR * np.float32(0.5)))
        iz = _ONE / z
        a, b = x * iz, y * iz
        least_a, most_a, least_b, most_b = view.slope_limits
        a_c, b_c = maximum(minimum(a, most_a), least_a), maximum(minimum(b, most_b), least_b)
        ju, jv = iz * view.focal[0], iz * view.focal[1]
        # J R: the slopes of u and v mix the camera's own row with its viewing axis.
        by_u = tuple(ju * (own - a_c * axis) for own, axis in zip(row_x, row_z, strict=True))
        by_v = tuple(jv * (own - b_c * axis) for own, axis in zip(row_y, row_z, strict=True))
        J = (*by_u, *by_v, *row_z)
        inverse_length = _ONE / sqrt(maximum(dot(quat, quat), z.of(1e-24)))
        w, p, q, r = unit_quat = tuple(part * inverse_length for part in quat)
        w2, p2, q2 = w * _TWO, p * _TWO, q * _TWO
        wp, wq, wr, pp, pq, pr, qq, qr, rr = w2 * p, w2 * q, w2 * r, p2 * p, p2 * q, p2 * r, q2 * q, q2 * r, r * r * _TWO
        Q = _ONE - (qq + rr), pq - wr, pr + wq, pq + wr, _ONE - (pp + rr), qr - wp, pr - wq, qr + wp, _ONE - (pp + qq)
        N = product(J, Q)
        m = times_columns(N, scales)
        return _Expanded((x, y, z), z_true, iz, (a, b, a_c, b_c), (ju, jv), J, unit_quat, inverse_length, Q, N, m)


def _plane_and_footprint(m: Vectors) -> tuple[Vectors, Vectors]:
    """From scaled axes: slopes of the plane, z regressed on (u, v); cov(u, v), blurred variances and 1 / determinant."""
    uu, uv, uz, _, vv, vz, _, _, _ = product(m, transposed(m))
    au, av = uu + _SOFT, vv + _SOFT
    plane_inverse = _ONE / (au * av - uv * uv)
    slope_u, slope_v = (av * uz - uv * vz) * plane_inverse, (au * vz - uv * uz) * plane_inverse
    bu, bv = uu + _BLUR, vv + _BLUR
    return (slope_u, slope_v, au, av, plane_inverse), (bu, bv, uv, _ONE / (bu * bv - uv * uv))


@formula
def _projected(
    cam: Vectors, tiles_x: Vector, point: Vectors, quat: Vectors, scales: Vectors, log2_opacity: Vector, features: Vectors
) -> tuple[Vectors, Vector, Vector, Vector]:
    """Of sixteen splats the record, the depth (0: not visible), the first tile and the span of tiles."""
    view, zero = _View.of(cam), tiles_x.of(0)
    splat = _Expanded.of(view, point, quat, scales)
    (a, b, _, _), z = splat.slopes, splat.center[2]
    (slope_u, slope_v, _, _, _), (bu, bv, uv, inverse) = _plane_and_footprint(splat.m)
    scaled = inverse * _HALF_LOG2E  # the footprint's quadratic form, in log2 units
    A, B, C = bv * scaled, uv * scaled * np.float32(-2), bu * scaled
    u, v = a * view.focal[0] + view.center[0], b * view.focal[1] + view.center[1]
    # The box around log2 alpha >= log2 MIN_ALPHA, rounded inwards to pixel centres of the image.
    k = (log2_opacity - _LOG2_MIN_ALPHA) * _TWO_LN2
    reach = maximum(k, zero)
    half_u, half_v = sqrt(reach * bu), sqrt(reach * bv)
    last_x, last_y = view.last_pixel
    x0, y0 = maximum(zero - floor(half_u - u), zero), maximum(zero - floor(half_v - v), zero)
    x1, y1 = minimum(floor(u + half_u), last_x), minimum(floor(v + half_v), last_y)
    in_front = where_ge(zero.of(_NEAR), splat.z_true, zero - _ONE, zero)
    seen = minimum(minimum(x1 - x0, y1 - y0), minimum(k, in_front))
    # Of needles thousands of pixels long rounding leaves no determinant, which is never below BLUR^2.
    seen = minimum(seen, minimum(inverse, _MOST_INVERSE - inverse))
    left, top = floor(minimum(x0, last_x) * _PER_TILE), floor(minimum(y0, last_y) * _PER_TILE)
    columns, rows = floor(maximum(x1, zero) * _PER_TILE) - left, floor(maximum(y1, zero) * _PER_TILE) - top
    first, span = top * tiles_x + left, rows * _SPAN_UNIT + columns
    ridge_y, ridge_x = zero - B / (C * _TWO), zero - B / (A * _TWO)
    record = (u, v, A, B, C, log2_opacity, ridge_y, ridge_x, *features, z, slope_u, slope_v, zero)
    return record, *(where_ge(seen, zero, value, zero) for value in (z, first, span))  # type: ignore[return-value]


@inner
def forward(P, start, stop, cam, tiles_x, records, depths, rectangles):
    """Records, depths (0: not visible) and rectangles of tiles (see `layout.SPAN_UNIT`) of a range."""
    for i in range(start, stop, 16):
        at = PARAMETERS * i
        record, depth, first, span = _projected(
            load_spread(cam, 0, CAMERA), np.float32(tiles_x), load_rows(P, at + 16 * MEAN, 16, 3),
            load_rows(P, at + 16 * QUAT, 16, 4), load_rows(P, at + 16 * SCALE, 16, 3), load(P, at + 16 * LOG2_OPACITY),
            load_rows(P, at + 16 * FEATURE, 16, FEATURES),
        )  # fmt: skip
        store_int32_pairs(rectangles, 2 * i, first, span)
        store(depths, i, depth)
        store_rows(records, i * RECORD, RECORD, columns_of(record))


@formula
def _chained(cam: Vectors, point: Vectors, quat: Vectors, scales: Vectors, sums: Vectors) -> tuple[Vectors, Vectors]:
    """Of sixteen splats the loss's derivative by the parameters, and what each adds to POSE_SUMS."""
    s, sx, sy, sxx, sxy, syy, d_f0, d_f1, d_f2, d_f3, d_z, d_plane, plane_x, plane_y, _, _ = sums
    view, zero = _View.of(cam), s.of(0)
    row_x, row_y, row_z = view.row_x, view.row_y, view.row_z
    splat = _Expanded.of(view, point, quat, scales)
    (a, b, a_c, b_c), (ju, jv), iz, m = splat.slopes, splat.j, splat.iz, splat.m
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
    d_scales = tuple(dot(dm[k::3], splat.N[k::3]) for k in range(3))
    dN = times_columns(dm, scales)

    # N = (J R) R(q): to the quaternion ...
    w, p, q, r = splat.unit_quat
    h00, h01, h02, h10, h11, h12, h20, h21, h22 = product(transposed(splat.J), dN)
    d_w = (r * (h10 - h01) + q * (h02 - h20) + p * (h21 - h12)) * _TWO
    d_p = (q * (h01 + h10) + r * (h02 + h20) + w * (h21 - h12) - p * (h11 + h22) * _TWO) * _TWO
    d_q = (p * (h01 + h10) + r * (h12 + h21) + w * (h02 - h20) - q * (h00 + h22) * _TWO) * _TWO
    d_r = (p * (h02 + h20) + q * (h12 + h21) + w * (h10 - h01) - r * (h00 + h11) * _TWO) * _TWO
    along = dot((d_w, d_p, d_q, d_r), (w, p, q, r))  # the length of a quaternion does not matter
    d_quat = tuple(
        (d - along * part) * splat.inverse_length for d, part in zip((d_w, d_p, d_q, d_r), (w, p, q, r), strict=True)
    )

    # ... and to the rows of J R.
    dJ = product(dN, transposed(splat.Q))
    along_uz, along_vz = dot(dJ[:3], row_z), dot(dJ[3:6], row_z)
    d_ju, d_jv = dot(dJ[:3], row_x) - a_c * along_uz, dot(dJ[3:6], row_y) - b_c * along_vz
    # Beyond the limits the slope a_c is constant. |a - a_c| > 0 there, so compare with a tiny number.
    tiny = s.of(1e-12)
    d_a = d_u * view.focal[0] - where_ge(apart(a, a_c), tiny, zero, ju * along_uz)
    d_b = d_v * view.focal[1] - where_ge(apart(b, b_c), tiny, zero, jv * along_vz)
    d_zc = d_z + d_plane - iz * dot((d_a, d_b, d_ju, d_jv), (a, b, ju, jv))
    d_x, d_y, _ = d_center = d_a * iz, d_b * iz, d_zc
    d_point = tuple(dot(d_center, column) for column in zip(row_x, row_y, row_z, strict=True))

    ka, kb = a_c * ju, b_c * jv
    by_rotation = (
        *(d_x * along + ju * entry for along, entry in zip(point, dJ[:3], strict=True)),
        *(d_y * along + jv * entry for along, entry in zip(point, dJ[3:6], strict=True)),
        *(
            d_zc * along + by_z - ka * by_u - kb * by_v
            for along, by_u, by_v, by_z in zip(point, dJ[:3], dJ[3:6], dJ[6:], strict=True)
        ),
    )
    # d ln(alpha) = d ln(opacity): the parameter is log2 of it.
    return (*d_point, *d_quat, *d_scales, s * _LN2, d_f0, d_f1, d_f2, d_f3), (*by_rotation, *d_center)


@inner
def backward(P, n, start, stop, cam, slot_starts, pair_sums, grads, first, pose):
    """From each pair's sums over its pixels to derivatives by a range's parameters and by the pose.

    Splat i's pairs have the rows `slot_starts[i]` .. `slot_starts[i + 1]` of sixteen floats (see `blending.backward`);
    `grads` is laid out like the parameters from splat `first` on; `pose` receives POSE_SUMS numbers.
    """
    zero, sums, totals = spread(_ZERO), carray(stack_floats(256), 256), carray(stack_floats(192), 192)
    last_slot = np.int64(slot_starts[n]) - 1
    for k in range(POSE_SUMS):
        store(totals, 16 * k, zero)
    for i in range(start, stop, 16):
        at = PARAMETERS * i
        if slot_starts[i] == slot_starts[i + 16]:
            for row in range(PARAMETERS):
                store(grads, at - PARAMETERS * first + 16 * row, zero)
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
        by_parameters, by_pose = _chained(
            load_spread(cam, 0, CAMERA), load_rows(P, at + 16 * MEAN, 16, 3), load_rows(P, at + 16 * QUAT, 16, 4),
            load_rows(P, at + 16 * SCALE, 16, 3), columns_of(load_rows(sums, 0, RECORD, 16)),
        )  # fmt: skip
        store_rows(grads, at - PARAMETERS * first, 16, by_parameters)
        add_rows(totals, 0, 16, by_pose)
    store(sums, 0, lane_sums(load_rows(totals, 0, 16, POSE_SUMS)))
    for k in range(POSE_SUMS):
        pose[k] = sums[k]
