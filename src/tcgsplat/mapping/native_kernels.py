"""Adam on rows of Gaussians, without autograd; the losses are in `loss_kernels.py`.

Parameters are in blocks [blocks, ROWS, 16] like the rasterizer's own, and in the same order; what
`optimizer.RowAdam` and `optimization.AutogradOptimization` say in torch is said here sixteen Gaussians at a time.
"""

import math

import numpy as np
from numba import njit

from tcgsplat.mapping.optimizer import BETA_1, BETA_2, EPSILON
from tcgsplat.render.numba_cpu.compilation import kept
from tcgsplat.render.numba_cpu.layout import FEATURE, LOG2_OPACITY, MEAN, PARAMETERS, QUAT, SCALE
from tcgsplat.render.numba_cpu.phases import WAITING, next_unit
from tcgsplat.render.numba_cpu.simd import (
    INNER,
    KERNEL,
    exp2,
    fma,
    load,
    log2,
    mask_ge,
    maximum,
    minimum,
    spread,
    sqrt,
    store,
    where_ge,
)
from tcgsplat.render.protocol import MAX_OPACITY
from tcgsplat.scene.gaussians import SH_C0

# Rows of the raw parameters; the same places as their activations have in the rasterizer's blocks.
LOG_SCALE, LOGIT, SH = SCALE, LOG2_OPACITY, FEATURE
ROWS = SH + 3

# Constants of `adam_step`, after the learning rate of every row.
SCALE_WEIGHT, ROTATION_WEIGHT, STABILITY_WEIGHT = ROWS, ROWS + 1, ROWS + 2
CONSTANTS = ROWS + 3

UNIT = 2048
"""Gaussians that a thread takes at a time."""

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


@kept(njit(**KERNEL))
def activate(raw, P, start, stop):
    """The rasterizer's parameters from raw ones, for a range: what `Gaussians` calls scales, opacities and colors."""
    for i in range(start, stop, 16):
        for row in range(MEAN, QUAT + 4):
            store(P, PARAMETERS * i + 16 * row, load(raw, ROWS * i + 16 * row))
        for row in range(LOG_SCALE, LOG_SCALE + 3):
            store(P, PARAMETERS * i + 16 * row, exp2(load(raw, ROWS * i + 16 * row) * _LOG2E))
        logit = maximum(minimum(load(raw, ROWS * i + 16 * LOGIT), spread(_STEEPEST)), spread(-_STEEPEST))
        opacity = spread(_ZERO) - log2(exp2(logit * (-_LOG2E)) + _ONE)
        store(P, PARAMETERS * i + 16 * LOGIT, minimum(opacity, spread(_LOG2_MAX_OPACITY)))
        for row in range(SH, SH + 3):
            store(P, PARAMETERS * i + 16 * row, maximum(fma(load(raw, ROWS * i + 16 * row), spread(_C0), spread(_HALF)), spread(_ZERO)))


@kept(njit(**INNER))
def _changes(raw, before, i):
    """Of sixteen Gaussians: d_mu (Eq. 5), d_s (Eq. 6), the cosine between quaternions, and their inverse lengths."""
    one, moved, stretched = spread(_ONE), spread(_ZERO), spread(_ZERO)
    for k in range(3):
        d = load(raw, ROWS * i + 16 * (MEAN + k)) - load(before, ROWS * i + 16 * (MEAN + k))
        moved = fma(d, d, moved)
        d = load(raw, ROWS * i + 16 * (LOG_SCALE + k)) - load(before, ROWS * i + 16 * (LOG_SCALE + k))
        stretched = fma(d, d, stretched)
    product, length, length_before = spread(_ZERO), spread(_TINY), spread(_TINY)
    for k in range(4):
        q, q0 = load(raw, ROWS * i + 16 * (QUAT + k)), load(before, ROWS * i + 16 * (QUAT + k))
        product, length, length_before = fma(q, q0, product), fma(q, q, length), fma(q0, q0, length_before)
    inverse, inverse_before = one / sqrt(length), one / sqrt(length_before)
    return sqrt(moved), sqrt(stretched), product * inverse * inverse_before, inverse, inverse_before


@kept(njit(**INNER))
def _distance(moved, stretched, cosine, constants):
    """Eq. 8."""
    turned = maximum(spread(_ONE) - cosine * cosine, spread(_ZERO))
    return fma(turned, spread(constants[ROTATION_WEIGHT]), fma(stretched, spread(constants[SCALE_WEIGHT]), moved))


@kept(njit(**KERNEL))
def self_distances(raw, before, n, constants, out):
    """How far each Gaussian is from where it was before the update (Eq. 8), metres."""
    for i in range(0, n, 16):
        moved, stretched, cosine, _, _ = _changes(raw, before, i)
        store(out, i, _distance(moved, stretched, cosine, constants))


@kept(njit(**INNER))
def _adam_step(start, stop, raw, P, before, first, second, clocks, grads, depths, allowed, scale, constants, excess):
    """One Adam step of the visible Gaussians of a range, on the losses of the pixels and of Eq. 23.

    Visible are those whose depth is not 0. `grads` holds the derivatives by `P`; they are led on to the raw parameters.
    `clocks` are two rows a block: what is left of beta^t of either moment, for each Gaussian's own count t of steps.
    `allowed` is the self-distance up to which Eq. 23 costs nothing (infinite where it does not apply), `scale` the
    factor of Eq. 24 on the geometry's steps; `excess` receives what Eq. 23 sums for each Gaussian, in metres.
    Eq. 6 is differentiated without its epsilon, which only matters to splats of a nanometre.
    """
    zero, one = spread(_ZERO), spread(_ONE)
    for i in range(start, stop, 16):
        seen = where_ge(load(depths, i), spread(_TINY), one, zero)
        if mask_ge(seen, one) == 0:
            store(excess, i, zero)
            continue
        power_1, power_2 = load(clocks, 2 * i) * _BETA_1, load(clocks, 2 * i + 16) * _BETA_2
        store(clocks, 2 * i, where_ge(seen, one, power_1, load(clocks, 2 * i)))
        store(clocks, 2 * i + 16, where_ge(seen, one, power_2, load(clocks, 2 * i + 16)))
        young_1, young_2 = one / (one - power_1), one / (one - power_2)
        geometry = load(scale, i)

        # Eq. 8 between now and before the update, and where it exceeds what is allowed, its derivative.
        moved, stretched, cosine, inverse, inverse_before = _changes(raw, before, i)
        distance = _distance(moved, stretched, cosine, constants)
        limit = load(allowed, i)
        store(excess, i, where_ge(limit, distance, zero, distance - limit) * seen)
        pull = where_ge(limit, distance, zero, spread(constants[STABILITY_WEIGHT]))
        by_mean = where_ge(zero, moved, zero, pull / maximum(moved, spread(_TINY)))
        by_scale = where_ge(zero, stretched, zero, pull * constants[SCALE_WEIGHT] / maximum(stretched, spread(_TINY)))
        by_turn = pull * constants[ROTATION_WEIGHT] * cosine * inverse * _TWO

        for row in range(ROWS):
            at, at_P = ROWS * i + 16 * row, PARAMETERS * i + 16 * row
            value, g = load(raw, at), load(grads, at_P)
            if row < QUAT:
                g = fma(by_mean, value - load(before, at), g)
            elif row < LOG_SCALE:
                g = fma(by_turn, cosine * inverse * value - load(before, at) * inverse_before, g)
            elif row < LOGIT:
                g = fma(by_scale, value - load(before, at), g * load(P, at_P))
            elif row == LOGIT:
                # d log2 sigmoid(x) = (1 - sigmoid(x)) log2(e) dx; where opacity is clipped, nothing.
                g = where_ge(value, spread(_MAX_LOGIT), zero, g * (one - exp2(load(P, at_P))) * _LOG2E)
            else:
                g = where_ge(zero, load(P, at_P), zero, g * _C0)
            g = where_ge(spread(_HUGE), maximum(g, zero - g), g, zero)  # NaN compares as false
            m = fma(load(first, at), spread(_BETA_1), g * _REST_1)
            v = fma(load(second, at), spread(_BETA_2), g * g * _REST_2)
            step = m * young_1 / (sqrt(v * young_2) + _EPSILON) * constants[row]
            if row < LOGIT:
                step = step * geometry
            store(first, at, where_ge(seen, one, m, load(first, at)))
            store(second, at, where_ge(seen, one, v, load(second, at)))
            store(raw, at, where_ge(seen, one, value - step, value))
        activate(raw, P, i, i + 16)


@kept(njit(**KERNEL))
def adam_step(
    progress, n, raw, P, before, first, second, clocks, grads, depths, allowed, scale, constants, excess
):
    """`_adam_step` for all Gaussians, shared by threads in units. False: has waited for long."""
    units = -(-n // UNIT)
    k = next_unit(progress, 0, units, 0)
    while k >= 0:
        _adam_step(
            k * UNIT, min((k + 1) * UNIT, n), raw, P, before, first, second, clocks, grads, depths, allowed, scale,
            constants, excess,
        )
        k = next_unit(progress, 0, units, 1)
    return k != WAITING
