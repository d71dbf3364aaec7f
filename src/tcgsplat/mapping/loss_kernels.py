"""The image losses of Eq. 21 and their derivative, in one kernel of four phases that threads share; see `phases.py`.

The window of SSIM is separable: along rows, then along columns. With means m and window averages of a a, a b, b b, S
is a function of m_a, E[aa] and E[ab] for a fixed observed image b; its three partial derivatives, spread back by the
same symmetric window, give dS/da = blur(dS/dm_a) + 2 a blur(dS/dE[aa]) + b blur(dS/dE[ab]). `ssim_kernels.py` has the
same for any upstream derivative, as torch needs it.
"""

import numpy as np

from tcgsplat.render import ssim_kernels
from tcgsplat.render.numba_cpu.compilation import inner, kernel
from tcgsplat.render.numba_cpu.lanes import load, store, store_rows, sum_lanes
from tcgsplat.render.numba_cpu.phases import BEGIN, DONE, WAITING, next_unit
from tcgsplat.render.numba_cpu.simd import Vector, Vectors, apart, fma, formula, maximum, spread, where_ge

RADIUS = ssim_kernels.RADIUS
MARGIN = 16
"""Zeros on both sides of a line, more than the window reads beyond the image's border."""
LINES = 5
"""Images that are averaged: a, b, a a, b b, a b."""
_AVERAGED, _DERIVATIVES = np.int64(LINES), np.int64(3)  # of literal numbers numba would compile each
MIN_WIDTH = 16
"""Pixels: one vector."""
ROWS = 8
"""Image rows in a unit."""
ACROSS, DOWN, ACROSS_BACK, DOWN_BACK = range(4)
PHASES = 4

COLOR_WEIGHT, DEPTH_WEIGHT, DOUBT, DEPTH_CHANNEL, DIVIDED, SSIM_SLOPE, C1, C2 = range(8)
CONSTANTS = 8
"""Weights of colour and of depth a pixel; k of Eq. 20, 0 if confidence guides nothing; the plane of depth, and 1 if it is divided by
alpha; the derivative of the loss by one pixel's S; SSIM's two constants."""

_ZERO, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)
_THIRD = np.float32(1 / 3)
_MIN_ALPHA = np.float32(1e-3)
"""As `Rendering.depth_as` has it."""


@inner
def _across(lines, maps, width, window, out, plane, at):  # type: ignore[no-untyped-def]
    """The window along a row: line m, with its margins, goes to `out[m * plane + at:]`."""
    pitch = width + 2 * MARGIN
    for m in range(maps):
        for block in range(0, width, 16):
            x = min(block, width - 16)  # the last block overlaps the one before
            middle = m * pitch + MARGIN + x
            total = load(lines, middle) * window[RADIUS]
            for k in range(1, RADIUS + 1):
                total = fma(load(lines, middle - k) + load(lines, middle + k), spread(window[RADIUS + k]), total)
            store(out, m * plane + at + x, total)


@inner
def _down(rows, y, height, width, at, window):  # type: ignore[no-untyped-def]
    """The window along columns: sixteen pixels of row y, the first of which is at `at`."""
    total = load(rows, at) * window[RADIUS]
    for k in range(1, RADIUS + 1):
        weight = spread(window[RADIUS + k])
        if y >= k:
            total = fma(load(rows, at - k * width), weight, total)
        if y + k < height:
            total = fma(load(rows, at + k * width), weight, total)
    return total


@formula
def _averaged(rendered: Vector, observed: Vector, seen: Vector) -> Vectors:
    """a, b, a a, b b, a b. Where the picture saw nothing, a is the picture's own, so that no window sees a false edge."""
    a, b = where_ge(seen, seen.of(_ONE), rendered, observed), observed
    return a, b, a * a, b * b, a * b


@inner
def _average_across(y, width, plane, planes, color, valid, window, lines, rows):  # type: ignore[no-untyped-def]
    """Phase ACROSS for one row: the five images of every channel."""
    pitch = width + 2 * MARGIN
    for c in range(3):
        for block in range(0, width, 16):
            x = min(block, width - 16)
            pixel = y * width + x
            averaged = _averaged(load(planes, c * plane + pixel), load(color, c * plane + pixel), load(valid, pixel))
            store_rows(lines, MARGIN + x, pitch, averaged)
        _across(lines, _AVERAGED, width, window, rows, 3 * plane, c * plane + y * width)


@formula
def _partials(averages: Vectors, c1: Vector, c2: Vector, slope: Vector) -> Vectors:
    """S, and `slope` times its derivatives by m_a, E[aa] and E[ab]."""
    ma, mb, aa, bb, ab = averages
    luminance, structure = fma(ma * _TWO, mb, c1), fma(ab - ma * mb, ma.of(_TWO), c2)
    luminance_inverse = _ONE / fma(ma, ma, fma(mb, mb, c1))
    structure_inverse = _ONE / (aa - ma * ma + (bb - mb * mb) + c2)
    both = luminance_inverse * structure_inverse
    s = luminance * structure * both
    by_mean = mb * (structure - luminance) * both - ma * s * (luminance_inverse - structure_inverse)
    return s, by_mean * _TWO * slope, -s * structure_inverse * slope, luminance * both * _TWO * slope


@inner
def _similarity(y, height, width, plane, rows, window, lanes, constants, partials):  # type: ignore[no-untyped-def]
    """Phase DOWN for one row: the loss's derivative by m_a, E[aa] and E[ab]; gives the sum of S."""
    total = spread(_ZERO)
    for c in range(3):
        for block in range(0, width, 16):
            x = min(block, width - 16)
            at = c * plane + y * width + x
            averages = (
                _down(rows, y, height, width, at, window), _down(rows, y, height, width, 3 * plane + at, window),
                _down(rows, y, height, width, 6 * plane + at, window),
                _down(rows, y, height, width, 9 * plane + at, window),
                _down(rows, y, height, width, 12 * plane + at, window),
            )  # fmt: skip
            s, by_mean, by_aa, by_ab = _partials(averages, constants[C1], constants[C2], constants[SSIM_SLOPE])
            total = fma(s, _fresh(load(lanes, 0), block - x), total)
            store_rows(partials, at, 3 * plane, (by_mean, by_aa, by_ab))
    return sum_lanes(total)


@formula
def _fresh(lanes: Vector, counted: Vector) -> Vector:
    """1 in the lanes that the block before did not have, 0 in the others."""
    return where_ge(lanes, counted, lanes.of(_ONE), lanes.of(_ZERO))


@inner
def _partials_across(y, width, plane, partials, window, lines, rows):  # type: ignore[no-untyped-def]
    """Phase ACROSS_BACK for one row."""
    pitch = width + 2 * MARGIN
    for c in range(3):
        for m in range(3):
            for block in range(0, width, 16):
                x = min(block, width - 16)
                store(lines, m * pitch + MARGIN + x, load(partials, (3 * m + c) * plane + y * width + x))
        _across(lines, _DERIVATIVES, width, window, rows, 3 * plane, c * plane + y * width)


def _sign(a: Vector) -> Vector:
    zero, one = a.of(_ZERO), a.of(_ONE)
    return where_ge(zero, a, where_ge(a, zero, zero, -one), one)


@formula
def _color_error(rendered: Vector, observed: Vector, spread_back: Vectors, by_color: Vector, seen: Vector) -> Vectors:
    """Of one channel |difference|, and the derivative by what is rendered: of it and of SSIM, whose partials are spread back."""
    difference = rendered - observed
    by_mean, by_aa, by_ab = spread_back
    similarity = fma(rendered * by_aa, rendered.of(_TWO), fma(observed, by_ab, by_mean))
    return apart(rendered, observed), fma(
        by_color, _sign(difference), where_ge(seen, seen.of(_ONE), similarity, seen.of(_ZERO))
    )


@formula
def _depth_error(composited: Vector, alpha: Vector, reading: Vector, weight: Vector, divided: Vector) -> Vectors:
    """Weighted |difference|, and its derivatives by the composited depth and by alpha, which it is divided by or not."""
    zero, one, thin = alpha.of(_ZERO), alpha.of(_ONE), alpha.of(_MIN_ALPHA)
    inverse = where_ge(zero, divided, one, one / maximum(alpha, thin))
    shown = composited * inverse
    by_depth = weight * _sign(shown - reading) * inverse
    by_alpha = where_ge(zero, divided, zero, where_ge(thin, alpha, zero, -by_depth * shown))
    return weight * apart(shown, reading), by_depth, by_alpha


@formula
def _trusted(seen: Vector, reading: Vector, confidence: Vector, doubt: Vector) -> Vector:
    """Weight of a pixel (Eq. 20); 0 where nothing was measured."""
    zero, one = seen.of(_ZERO), seen.of(_ONE)
    return where_ge(zero, reading, zero, seen) * fma(doubt, one - confidence, one)


@inner
def _pixels(
    y, height, width, plane, planes, color, depth, valid, rows, window, lanes, constants, d_planes
):  # type: ignore[no-untyped-def]  # fmt: skip
    """Phase DOWN_BACK for one row: all of `d_planes`; gives the sum of the colour and depth terms.

    A pixel without a reading counts for neither term.
    """
    zero, total = spread(_ZERO), spread(_ZERO)
    depth_plane = np.int64(constants[DEPTH_CHANNEL])
    for block in range(0, width, 16):
        x = min(block, width - 16)
        pixel = y * width + x
        reading, seen = load(depth, pixel), load(valid, pixel)
        weight = _trusted(seen, reading, load(planes, 3 * plane + pixel), constants[DOUBT])
        by_color, error = weight * (constants[COLOR_WEIGHT] * _THIRD), zero
        for c in range(3):
            at = c * plane + pixel
            spread_back = (
                _down(rows, y, height, width, at, window), _down(rows, y, height, width, 3 * plane + at, window),
                _down(rows, y, height, width, 6 * plane + at, window),
            )  # fmt: skip
            difference, derivative = _color_error(load(planes, at), load(color, at), spread_back, by_color, seen)
            error = error + difference
            store(d_planes, at, derivative)
        difference, by_depth, by_alpha = _depth_error(
            load(planes, depth_plane * plane + pixel), load(planes, 6 * plane + pixel), reading,
            weight * constants[DEPTH_WEIGHT], constants[DIVIDED],
        )  # fmt: skip
        total = fma(fma(by_color, error, difference), _fresh(load(lanes, 0), block - x), total)
        at_depth = by_depth if depth_plane == 4 else zero
        at_plane = by_depth if depth_plane == 5 else zero
        store_rows(d_planes, 3 * plane + pixel, plane, (zero, at_depth, at_plane, by_alpha))
    return sum_lanes(total)


@kernel(
    "i8[::1], i8, i8, f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[:, ::1]"
)
def differentiate_losses(
    progress, width, height, planes, color, depth, valid, window, lanes, constants, lines, rows, partials, d_planes,
    sums,
):  # type: ignore[no-untyped-def]  # fmt: skip
    """From a rendering to the loss's derivative by its seven planes. False: has waited for long.

    Images are flat: `planes` and `d_planes` [7 h w], `color` [3 h w], `depth` (m) and `valid` (0 or 1) [h w]. `lines`
    is scratch of the calling thread, its margins zero; `rows` [15 h w] and `partials` [9 h w] are scratch of all.
    `sums` [2, h] gets each row's sum of S and of the colour and depth terms.
    """
    plane = height * width
    units = -(-height // ROWS)
    for phase in range(PHASES):
        k = next_unit(progress, phase, units, BEGIN)
        while k >= 0:
            for y in range(k * ROWS, min((k + 1) * ROWS, height)):
                if phase == ACROSS:
                    _average_across(y, width, plane, planes, color, valid, window, lines, rows)
                elif phase == DOWN:
                    sums[0, y] = _similarity(y, height, width, plane, rows, window, lanes, constants, partials)
                elif phase == ACROSS_BACK:
                    _partials_across(y, width, plane, partials, window, lines, rows)
                else:
                    sums[1, y] = _pixels(
                        y, height, width, plane, planes, color, depth, valid, rows, window, lanes, constants, d_planes
                    )
            k = next_unit(progress, phase, units, DONE)
        if k == WAITING:
            return False
    return True
