"""One step of mapping without autograd: the pixel losses and their derivative, and Adam on rows of Gaussians.

Parameters are rows of one float32 matrix [ROWS, n padded to 16], in the order of the rasterizer's own matrix; what
`optimizer.RowAdam` and `optimization.AutogradOptimization` say in torch is said here sixteen Gaussians at a time.
"""

import math

import numpy as np
from numba import njit

from tcgsplat.mapping.optimizer import BETA_1, BETA_2, EPSILON
from tcgsplat.render.numba_cpu.layout import FEATURE, LOG2_OPACITY, MEAN, QUAT, SCALE
from tcgsplat.render.numba_cpu.simd import (
    MATH,
    exp2,
    fma,
    load,
    log2,
    maximum,
    minimum,
    spread,
    sqrt,
    store,
    where_ge,
)
from tcgsplat.render.protocol import MAX_OPACITY
from tcgsplat.scene.gaussians import SH_C0

# Rows of the raw parameters; the same places as their activations have in the rasterizer's matrix.
LOG_SCALE, LOGIT, SH = SCALE, LOG2_OPACITY, FEATURE
ROWS = SH + 3

# Constants of `pixel_losses`.
COLOR_WEIGHT, DEPTH_WEIGHT, GUIDED, DEPTH_CHANNEL, DIVIDED = range(5)
# Constants of `adam_step`, after the learning rate of every row.
SCALE_WEIGHT, ROTATION_WEIGHT, STABILITY_WEIGHT = ROWS, ROWS + 1, ROWS + 2
CONSTANTS = ROWS + 3

_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_LOG2E = np.float32(1 / math.log(2))
_C0 = np.float32(SH_C0)
_MAX_LOGIT = np.float32(math.log(MAX_OPACITY / (1 - MAX_OPACITY)))
_LOG2_MAX_OPACITY = np.float32(math.log2(MAX_OPACITY))
_STEEPEST = np.float32(60)
"""Logits beyond this are as good as infinite, and their exponential still is a number."""
_HUGE = np.float32(1e30)
_BETA_1, _BETA_2, _EPSILON = np.float32(BETA_1), np.float32(BETA_2), np.float32(EPSILON)
_REST_1, _REST_2 = np.float32(1 - BETA_1), np.float32(1 - BETA_2)
_TINY = np.float32(1e-24)
_MIN_ALPHA = np.float32(1e-3)
"""As `Rendering.depth_as` has it."""


@njit(error_model="numpy", nogil=True, cache=True)
def seen_by_both(first, last, planes, color, valid, out):  # type: ignore[no-untyped-def]
    """Rendered colour of a range of rows; where the picture saw nothing, the picture's own."""
    for c in range(3):
        for y in range(first, last):
            for x in range(out.shape[2]):
                out[c, y, x] = planes[c, y, x] if valid[y, x] > 0 else color[c, y, x]


@njit(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", nogil=True, cache=True)
def pixel_losses(first, last, planes, color, depth, valid, constants, d_planes, sums):  # type: ignore[no-untyped-def]
    """Colour and depth terms of Eq. 21 for a range of rows: the derivative by the planes, and the loss of each row.

    `d_planes` comes with the derivative of the SSIM term in its first three planes; all seven are complete
    afterwards. A pixel without a reading counts for neither term.
    """
    width = planes.shape[2]
    third = _ONE / np.float32(3)
    channel = int(constants[DEPTH_CHANNEL])
    for y in range(first, last):
        total = np.float32(0)
        for x in range(width):
            alpha, reading, seen = planes[6, y, x], depth[y, x], valid[y, x]
            inside = seen if reading > 0 else _ZERO
            weight = inside * (_ONE + constants[GUIDED] * (_ONE - planes[3, y, x]))
            by_color = weight * constants[COLOR_WEIGHT] * third
            error = _ZERO
            for c in range(3):
                difference = planes[c, y, x] - color[c, y, x]
                error += abs(difference)
                sign = _ONE if difference > 0 else (-_ONE if difference < 0 else _ZERO)
                d_planes[c, y, x] = seen * d_planes[c, y, x] + by_color * sign
            divisor = max(alpha, _MIN_ALPHA) if constants[DIVIDED] > 0 else _ONE
            inverse = _ONE / divisor
            shown = planes[channel, y, x] * inverse
            difference = shown - reading
            sign = _ONE if difference > 0 else (-_ONE if difference < 0 else _ZERO)
            by_depth = weight * constants[DEPTH_WEIGHT] * sign * inverse
            total += by_color * error + weight * constants[DEPTH_WEIGHT] * abs(difference)
            d_planes[3, y, x] = _ZERO
            d_planes[4, y, x] = by_depth if channel == 4 else _ZERO
            d_planes[5, y, x] = by_depth if channel == 5 else _ZERO
            thick = constants[DIVIDED] > 0 and alpha > _MIN_ALPHA
            d_planes[6, y, x] = -by_depth * shown if thick else _ZERO
        sums[y] = total


@njit(fastmath=MATH, error_model="numpy", nogil=True, cache=True)
def activate(raw, P, n, start, stop):
    """The rasterizer's parameters from raw ones, for a range: what `Gaussians` calls scales, opacities and colors."""
    for i in range(start, stop, 16):
        for row in range(MEAN, QUAT + 4):
            store(P, row * n + i, load(raw, row * n + i))
        for row in range(LOG_SCALE, LOG_SCALE + 3):
            store(P, row * n + i, exp2(load(raw, row * n + i) * _LOG2E))
        logit = maximum(minimum(load(raw, LOGIT * n + i), spread(_STEEPEST)), spread(-_STEEPEST))
        opacity = spread(_ZERO) - log2(exp2(logit * (-_LOG2E)) + _ONE)
        store(P, LOGIT * n + i, minimum(opacity, spread(_LOG2_MAX_OPACITY)))
        for row in range(SH, SH + 3):
            store(P, row * n + i, maximum(fma(load(raw, row * n + i), spread(_C0), spread(_HALF)), spread(_ZERO)))


@njit(fastmath=MATH, error_model="numpy", nogil=True, cache=True)
def adam_step(n, start, stop, raw, P, before, first, second, clocks, grads, visible, allowed, scale, constants, excess):
    """One Adam step of the visible Gaussians of a range, on the losses of the pixels and of Eq. 23.

    `grads` holds the derivatives by `P`; they are led on to the raw parameters. `clocks` are two rows: what is left of
    beta^t of either moment, for each Gaussian's own count t of steps. `allowed` is the self-distance up to which
    Eq. 23 costs nothing (infinite where it does not apply), `scale` the factor of Eq. 24 on the geometry's steps;
    `excess` receives what Eq. 23 sums for each Gaussian, in metres.
    Eq. 6 is differentiated without its epsilon, which only matters to splats of a nanometre.
    """
    zero, one = spread(_ZERO), spread(_ONE)
    for i in range(start, stop, 16):
        seen = load(visible, i)
        power_1, power_2 = load(clocks, i) * _BETA_1, load(clocks, n + i) * _BETA_2
        store(clocks, i, where_ge(seen, one, power_1, load(clocks, i)))
        store(clocks, n + i, where_ge(seen, one, power_2, load(clocks, n + i)))
        young_1, young_2 = one / (one - power_1), one / (one - power_2)
        geometry = load(scale, i)

        # Eq. 8 between now and before the update, and where it exceeds what is allowed, its derivative.
        moved, stretched = zero, zero
        for k in range(3):
            d = load(raw, (MEAN + k) * n + i) - load(before, (MEAN + k) * n + i)
            moved = fma(d, d, moved)
            d = load(raw, (LOG_SCALE + k) * n + i) - load(before, (LOG_SCALE + k) * n + i)
            stretched = fma(d, d, stretched)
        moved, stretched = sqrt(moved), sqrt(stretched)
        product, length, length_before = zero, spread(_TINY), spread(_TINY)
        for k in range(4):
            q, q0 = load(raw, (QUAT + k) * n + i), load(before, (QUAT + k) * n + i)
            product, length, length_before = fma(q, q0, product), fma(q, q, length), fma(q0, q0, length_before)
        inverse, inverse_before = one / sqrt(length), one / sqrt(length_before)
        cosine = product * inverse * inverse_before
        turned = maximum(one - cosine * cosine, zero)
        distance = fma(turned, spread(constants[ROTATION_WEIGHT]), fma(stretched, spread(constants[SCALE_WEIGHT]), moved))
        limit = load(allowed, i)
        store(excess, i, where_ge(limit, distance, zero, distance - limit) * seen)
        pull = where_ge(limit, distance, zero, spread(constants[STABILITY_WEIGHT]))
        by_mean = where_ge(zero, moved, zero, pull / maximum(moved, spread(_TINY)))
        by_scale = where_ge(zero, stretched, zero, pull * constants[SCALE_WEIGHT] / maximum(stretched, spread(_TINY)))
        by_turn = pull * constants[ROTATION_WEIGHT] * cosine * inverse * _TWO

        for row in range(ROWS):
            at = row * n + i
            value, g = load(raw, at), load(grads, at)
            if row < QUAT:
                g = fma(by_mean, value - load(before, at), g)
            elif row < LOG_SCALE:
                g = fma(by_turn, cosine * inverse * value - load(before, at) * inverse_before, g)
            elif row < LOGIT:
                g = fma(by_scale, value - load(before, at), g * load(P, at))
            elif row == LOGIT:
                # d log2 sigmoid(x) = (1 - sigmoid(x)) log2(e) dx; where opacity is clipped, nothing.
                g = where_ge(value, spread(_MAX_LOGIT), zero, g * (one - exp2(load(P, at))) * _LOG2E)
            else:
                g = where_ge(zero, load(P, at), zero, g * _C0)
            g = where_ge(spread(_HUGE), maximum(g, zero - g), g, zero)  # NaN compares as false
            m = fma(load(first, at), spread(_BETA_1), g * _REST_1)
            v = fma(load(second, at), spread(_BETA_2), g * g * _REST_2)
            step = m * young_1 / (sqrt(v * young_2) + _EPSILON) * constants[row]
            if row < LOGIT:
                step = step * geometry
            store(first, at, where_ge(seen, one, m, load(first, at)))
            store(second, at, where_ge(seen, one, v, load(second, at)))
            store(raw, at, where_ge(seen, one, value - step, value))
    activate(raw, P, n, start, stop)
