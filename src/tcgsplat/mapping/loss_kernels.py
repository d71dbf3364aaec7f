"""The image losses of Eq. 21 and their derivative, in one kernel of four phases that threads share; see `phases.py`.

The window of SSIM is separable: along rows, then along columns. With means m and window averages of a a, a b, b b, S
is a function of m_a, E[aa] and E[ab] for a fixed observed image b; its three partial derivatives, spread back by the
same symmetric window, give dS/da = blur(dS/dm_a) + 2 a blur(dS/dE[aa]) + b blur(dS/dE[ab]). `ssim_kernels.py` has the
same for any upstream derivative, as torch needs it.
"""

import numpy as np
from numba import njit

from tcgsplat.render import ssim_kernels
from tcgsplat.render.numba_cpu.compilation import kept
from tcgsplat.render.numba_cpu.phases import WAITING, next_unit
from tcgsplat.render.numba_cpu.simd import INNER, KERNEL, fma, load, maximum, spread, store, sum_lanes, where_ge

RADIUS = ssim_kernels.RADIUS
MARGIN = 16
"""Zeros on both sides of a line, more than the window reads beyond the image's border."""
LINES = 5
"""Images that are averaged: a, b, a a, b b, a b."""
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


@kept(njit(**INNER))
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


@kept(njit(**INNER))
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


@kept(njit(**INNER))
def _shown(planes, color, valid, plane, pixel, channel):  # type: ignore[no-untyped-def]
    """Rendered colour; where the picture saw nothing, the picture's own, so that no window sees a false edge."""
    at = channel * plane + pixel
    return where_ge(load(valid, pixel), spread(_ONE), load(planes, at), load(color, at))


@kept(njit(**INNER))
def _average_across(y, width, plane, planes, color, valid, window, lines, rows):  # type: ignore[no-untyped-def]
    """Phase ACROSS for one row: the five images of every channel."""
    pitch = width + 2 * MARGIN
    for c in range(3):
        for block in range(0, width, 16):
            x = min(block, width - 16)
            a, b = _shown(planes, color, valid, plane, y * width + x, c), load(color, c * plane + y * width + x)
            at = MARGIN + x
            store(lines, at, a)
            store(lines, pitch + at, b)
            store(lines, 2 * pitch + at, a * a)
            store(lines, 3 * pitch + at, b * b)
            store(lines, 4 * pitch + at, a * b)
        _across(lines, 5, width, window, rows, 3 * plane, c * plane + y * width)


@kept(njit(**INNER))
def _similarity(y, height, width, plane, rows, window, lanes, constants, partials):  # type: ignore[no-untyped-def]
    """Phase DOWN for one row: the loss's derivative by m_a, E[aa] and E[ab]; gives the sum of S."""
    total = spread(_ZERO)
    c1, c2, slope = spread(constants[C1]), spread(constants[C2]), spread(constants[SSIM_SLOPE])
    for c in range(3):
        for block in range(0, width, 16):
            x = min(block, width - 16)
            at = c * plane + y * width + x
            ma, mb = _down(rows, y, height, width, at, window), _down(rows, y, height, width, 3 * plane + at, window)
            aa = _down(rows, y, height, width, 6 * plane + at, window)
            bb = _down(rows, y, height, width, 9 * plane + at, window)
            ab = _down(rows, y, height, width, 12 * plane + at, window)
            luminance, structure = fma(ma * _TWO, mb, c1), fma(ab - ma * mb, spread(_TWO), c2)
            luminance_inverse = _ONE / fma(ma, ma, fma(mb, mb, c1))
            structure_inverse = _ONE / (aa - ma * ma + (bb - mb * mb) + c2)
            both = luminance_inverse * structure_inverse
            s = luminance * structure * both
            fresh = where_ge(load(lanes, 0), spread(np.float32(block - x)), spread(_ONE), spread(_ZERO))
            total = fma(s, fresh, total)
            by_mean = mb * (structure - luminance) * both - ma * s * (luminance_inverse - structure_inverse)
            store(partials, at, by_mean * _TWO * slope)
            store(partials, 3 * plane + at, (spread(_ZERO) - s) * structure_inverse * slope)
            store(partials, 6 * plane + at, luminance * both * _TWO * slope)
    return sum_lanes(total)


@kept(njit(**INNER))
def _partials_across(y, width, plane, partials, window, lines, rows):  # type: ignore[no-untyped-def]
    """Phase ACROSS_BACK for one row."""
    pitch = width + 2 * MARGIN
    for c in range(3):
        for m in range(3):
            for block in range(0, width, 16):
                x = min(block, width - 16)
                store(lines, m * pitch + MARGIN + x, load(partials, (3 * m + c) * plane + y * width + x))
        _across(lines, 3, width, window, rows, 3 * plane, c * plane + y * width)


@kept(njit(**INNER))
def _pixels(
    y, height, width, plane, planes, color, depth, valid, rows, window, lanes, constants, d_planes
):  # type: ignore[no-untyped-def]  # fmt: skip
    """Phase DOWN_BACK for one row: all of `d_planes`; gives the sum of the colour and depth terms.

    A pixel without a reading counts for neither term.
    """
    zero, one, total = spread(_ZERO), spread(_ONE), spread(_ZERO)
    depth_plane = np.int64(constants[DEPTH_CHANNEL])
    for block in range(0, width, 16):
        x = min(block, width - 16)
        pixel = y * width + x
        alpha, reading, seen = load(planes, 6 * plane + pixel), load(depth, pixel), load(valid, pixel)
        measured = where_ge(zero, reading, zero, seen)
        weight = measured * fma(spread(constants[DOUBT]), one - load(planes, 3 * plane + pixel), one)
        by_color, error = weight * (constants[COLOR_WEIGHT] * _THIRD), zero
        for c in range(3):
            at = c * plane + pixel
            rendered, observed = load(planes, at), load(color, at)
            difference = rendered - observed
            error = error + maximum(difference, zero - difference)
            sign = where_ge(zero, difference, where_ge(difference, zero, zero, zero - one), one)
            spreading = _down(rows, y, height, width, at, window)
            by_aa = _down(rows, y, height, width, 3 * plane + at, window)
            by_ab = _down(rows, y, height, width, 6 * plane + at, window)
            similarity = fma(rendered * by_aa, spread(_TWO), fma(observed, by_ab, spreading))
            store(d_planes, at, fma(by_color, sign, where_ge(seen, one, similarity, zero)))
        divided = constants[DIVIDED] > 0
        inverse = one / maximum(alpha, spread(_MIN_ALPHA)) if divided else one
        shown = load(planes, depth_plane * plane + pixel) * inverse
        difference = shown - reading
        sign = where_ge(zero, difference, where_ge(difference, zero, zero, zero - one), one)
        by_depth = weight * constants[DEPTH_WEIGHT]
        fresh = where_ge(load(lanes, 0), spread(np.float32(block - x)), one, zero)
        total = fma(fma(by_depth, maximum(difference, zero - difference), by_color * error), fresh, total)
        by_depth = by_depth * sign * inverse
        store(d_planes, 3 * plane + pixel, zero)
        store(d_planes, 4 * plane + pixel, by_depth if depth_plane == 4 else zero)
        store(d_planes, 5 * plane + pixel, by_depth if depth_plane == 5 else zero)
        thick = where_ge(spread(_MIN_ALPHA), alpha, zero, (zero - by_depth) * shown) if divided else zero
        store(d_planes, 6 * plane + pixel, thick)
    return sum_lanes(total)


@kept(njit(**KERNEL))
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
        k = next_unit(progress, phase, units, 0)
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
            k = next_unit(progress, phase, units, 1)
        if k == WAITING:
            return False
    return True
