"""Pixel loops that move a depth image from one instant to another, by inverse warping.

They work on inverse depth, 0 where there is no reading: it is linear over a plane in the image, nearer is larger, and
no reading is at infinity. A row at a time, in loops that either calculate or fetch, over buffers made in the function
itself: of these loops the compiler makes wide ones, else it does not (five times the time was measured).
"""

from typing import Final

import numpy as np
import numpy.typing as npt
from numba import njit

Floats = npt.NDArray[np.float32]

NEAREST = np.float32(0.01)
"""Metres: what claims to be nearer than this is no reading, and its inverse would overflow."""
SMOOTH = np.float32(0.03)
"""Neighbouring inverse depths that differ by less than this share lie on one surface."""
SETTLED = np.float32(0.25)
"""Pixels between the places that the last two readings give: where they are farther apart, it is no one surface."""
READINGS = 3
"""Of each pixel: on one surface the first is good enough, beside an edge it leads to the second; the last confirms."""
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_FAST: Final = {"contract", "nsz", "arcp"}


@njit(error_model="numpy", nogil=True, cache=True)
def inverse(depth):  # type: ignore[no-untyped-def]
    """1 / depth, 0 where there is no reading."""
    h, w = depth.shape
    out = np.empty((h, w), np.float32)
    for y in range(h):
        for x in range(w):
            d = depth[y, x]
            out[y, x] = _ONE / d if d > NEAREST else _ZERO
    return out


@njit(inline="always")
def _row(width):  # type: ignore[no-untyped-def]
    return np.empty(width, np.float32)


@njit(inline="always")
def _clamped(value, last):  # type: ignore[no-untyped-def]
    return min(max(value, _ZERO), last)


@njit(inline="always")
def _pixel(u, v, width):  # type: ignore[no-untyped-def]
    """Index in the flat image of the pixel nearest to (u, v)."""
    return np.int32(np.int32(v + _HALF) * width + np.int32(u + _HALF))


@njit(fastmath=_FAST, error_model="numpy", nogil=True, cache=True)
def moved(image, nearest, valid, H, e):  # type: ignore[no-untyped-def]
    """Depth (m) in camera c of the scene whose inverse depth in camera d is `image` (1/m); 0 where it shows nothing.

    With p_inf = (H p)_uv / (H p)_w, where H = K R_d_c K^-1 and e = K t_d_c, a point seen at pixel p of c that has
    inverse depth q in d is seen there at
        p_d(q) = p_inf + q (e_uv - e_w p_inf)
    and its depth in c is (1/q - e_w) / (H p)_w. So q = image(p_d(q)) is solved by repeated reading, from a nearer
    guess to farther ones, since of several solutions the nearest hides the others: `nearest` is the largest inverse
    depth around each pixel. The reading is the nearest pixel's; in the end, bilinear where that mixes no surfaces.
    """
    h, w = image.shape
    width, outside = np.int32(w), np.int32(h * w)
    last_u, last_v = np.float32(w - 1), np.float32(h - 1)
    # Behind the image are the 0 that is read outside, and neighbours of the last row. (Loops, for a slice that is
    # assigned to takes numba three seconds more to compile.)
    flat = np.zeros(h * w + w + 2, np.float32)
    for y in range(h):
        for x in range(w):
            flat[y * w + x] = image[y, x]
    guesses, out = nearest.ravel(), np.empty((h, w), np.float32)
    u, v, scale, du, dv = _row(w), _row(w), _row(w), _row(w), _row(w)
    guess, q, a, b = _row(w), _row(w), _row(w), _row(w)
    q00, q10, q01, q11 = _row(w), _row(w), _row(w), _row(w)
    index = np.empty(w, np.int32)
    h00, h10, h20, e0, e1, e2 = H[0, 0], H[1, 0], H[2, 0], e[0], e[1], e[2]
    for y in range(h):
        row_u = H[0, 1] * np.float32(y) + H[0, 2]
        row_v = H[1, 1] * np.float32(y) + H[1, 2]
        row_w = H[2, 1] * np.float32(y) + H[2, 2]
        for x in range(w):
            px = np.float32(np.int32(x))
            scale[x] = _ONE / max(h20 * px + row_w, np.float32(1e-3))
            u[x], v[x] = (h00 * px + row_u) * scale[x], (h10 * px + row_v) * scale[x]
            du[x], dv[x] = e0 - e2 * u[x], e1 - e2 * v[x]
            index[x] = _pixel(_clamped(u[x], last_u), _clamped(v[x], last_v), width)
        for x in range(w):
            q[x] = guesses[np.uint64(index[x])]

        for _ in range(READINGS):
            for x in range(w):
                guess[x] = q[x]
                pu, pv = u[x] + q[x] * du[x], v[x] + q[x] * dv[x]
                cu, cv = _clamped(pu, last_u), _clamped(pv, last_v)
                inside = (abs(pu - cu) <= _HALF) & (abs(pv - cv) <= _HALF)
                index[x] = _pixel(cu, cv, width) if inside else outside
            for x in range(w):
                q[x] = flat[np.uint64(index[x])]

        for x in range(w):
            cu, cv = _clamped(u[x] + q[x] * du[x], last_u), _clamped(v[x] + q[x] * dv[x], last_v)
            column, row = np.int32(cu), np.int32(cv)
            a[x], b[x] = cu - np.float32(column), cv - np.float32(row)
            index[x] = np.int32(row * width + column)
        for x in range(w):
            at = np.uint64(index[x])
            q00[x], q10[x] = flat[at], flat[at + np.uint64(1)]
            q01[x], q11[x] = flat[at + np.uint64(w)], flat[at + np.uint64(w + 1)]
        for x in range(w):
            low, high = min(min(q00[x], q10[x]), min(q01[x], q11[x])), max(max(q00[x], q10[x]), max(q01[x], q11[x]))
            above, below = q00[x] + a[x] * (q10[x] - q00[x]), q01[x] + a[x] * (q11[x] - q01[x])
            best = above + b[x] * (below - above) if high - low < SMOOTH * low else q[x]
            step = q[x] - guess[x]
            settled = step * step * (du[x] * du[x] + dv[x] * dv[x]) <= SETTLED * SETTLED
            depth = (_ONE / best - e2) * scale[x]
            seen = settled & (q[x] > _ZERO) & (depth > _ZERO) & valid[y, x]
            out[y, x] = depth if seen else _ZERO
    return out
