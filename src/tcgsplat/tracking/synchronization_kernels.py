"""A pixel loop that moves a depth image from one instant to another, by inverse warping, sixteen pixels at a time.

It works on inverse depth, 0 where there is no reading: it is linear over a plane in the image, nearer is larger, and
no reading is at infinity.
"""

import numpy as np

from tcgsplat.render.numba_cpu.compilation import kernel
from tcgsplat.render.numba_cpu.lanes import gather, load_spread, store_first
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
    where_ge,
)

SMOOTH = np.float32(0.03)
"""Neighbouring inverse depths that differ by less than this share lie on one surface."""
SETTLED = np.float32(0.25)
"""Pixels between the places that the last two readings give: where they are farther apart, it is no one surface."""
READINGS = 3
"""Of each pixel: on one surface the first is good enough, beside an edge it leads to the second; the last confirms."""
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)


def _clamped(value: Vector, last: Vector) -> Vector:
    return minimum(maximum(value, value.of(_ZERO)), last)


@formula
def _line(H: Vectors, e: Vectors, x: Vector, y: Vector) -> Vectors:
    """Where a pixel's points are seen in camera d: p_inf (u, v), what a reading q moves that by, and 1 / (H p)_w."""
    u, v, w = (H[3 * row] * x + (H[3 * row + 1] * y + H[3 * row + 2]) for row in range(3))
    scale = _ONE / maximum(w, w.of(1e-3))
    u, v = u * scale, v * scale
    return u, v, e[0] - e[2] * u, e[1] - e[2] * v, scale


@formula
def _nearest(u: Vector, v: Vector, last: Vectors, width: Vector) -> Vector:
    """Number of the pixel of the image that is nearest to (u, v)."""
    return floor(_clamped(v, last[1]) + _HALF) * width + floor(_clamped(u, last[0]) + _HALF)


@formula
def _read_at(line: Vectors, q: Vector, last: Vectors, width: Vector, outside: Vector) -> Vector:
    """Number of the pixel that shows the point at inverse depth q; `outside` if none does."""
    u, v = line[0] + q * line[2], line[1] + q * line[3]
    away = maximum(apart(u, _clamped(u, last[0])), apart(v, _clamped(v, last[1])))
    return where_ge(away.of(_HALF), away, _nearest(u, v, last, width), outside)


@formula
def _between(line: Vectors, q: Vector, last: Vectors, width: Vector) -> Vectors:
    """Number of the pixel above and to the left of the point at inverse depth q, and how far it is from there."""
    u, v = _clamped(line[0] + q * line[2], last[0]), _clamped(line[1] + q * line[3], last[1])
    column, row = floor(u), floor(v)
    return row * width + column, u - column, v - row


@formula
def _depth(line: Vectors, e: Vectors, guess: Vector, q: Vector, between: Vectors, corners: Vectors) -> Vector:
    """Depth in camera c, 0 where it shows nothing."""
    _, _, du, dv, scale = line
    (_, a, b), (q00, q10, q01, q11), zero = between, corners, q.of(_ZERO)
    low, high = minimum(minimum(q00, q10), minimum(q01, q11)), maximum(maximum(q00, q10), maximum(q01, q11))
    above, below = q00 + a * (q10 - q00), q01 + a * (q11 - q01)
    best = where_ge(high - low, low * SMOOTH, q, above + b * (below - above))
    step = q - guess
    unsettled = step * step * (du * du + dv * dv)
    depth = where_ge(zero, q, zero, (_ONE / best - e[2]) * scale)
    return where_ge(q.of(SETTLED * SETTLED), unsettled, maximum(depth, zero), zero)


@kernel("f4[::1], f4[::1], f4[::1], f4[::1], i8, i8, f4[::1]")
def moved(image, nearest, H, e, height, width, out):  # type: ignore[no-untyped-def]
    """Depth (m) in camera c of the scene whose inverse depth in camera d is `image` (1/m); 0 where it shows nothing.

    With p_inf = (H p)_uv / (H p)_w, where H = K R_d_c K^-1 and e = K t_d_c, a point seen at pixel p of c that has
    inverse depth q in d is seen there at
        p_d(q) = p_inf + q (e_uv - e_w p_inf)
    and its depth in c is (1/q - e_w) / (H p)_w. So q = image(p_d(q)) is solved by repeated reading, from a nearer
    guess to farther ones, since of several solutions the nearest hides the others: `nearest` is the largest inverse
    depth around each pixel. The reading is the nearest pixel's; in the end, bilinear where that mixes no surfaces.

    Images are flat. Behind `image` are `width` + 2 zeros: what is read outside, and below and beside the last pixel.
    """
    H_rows, e_rows = load_spread(H, 0, 9), load_spread(e, 0, 3)
    last, outside = (np.float32(width - 1), np.float32(height - 1)), np.float32(height * width)
    for y in range(height):
        for x in range(0, width, LANES):
            line = _line(H_rows, e_rows, ramp(x, 1), np.float32(y))
            q = gather(nearest, 0, _nearest(line[0], line[1], last, np.float32(width)))
            guess = q
            for _ in range(READINGS):
                guess = q
                q = gather(image, 0, _read_at(line, q, last, np.float32(width), outside))
            between = _between(line, q, last, np.float32(width))
            corners = (
                gather(image, 0, between[0]), gather(image, 1, between[0]),
                gather(image, width, between[0]), gather(image, width + 1, between[0]),
            )  # fmt: skip
            store_first(out, y * width + x, _depth(line, e_rows, guess, q, between, corners), width - x)
