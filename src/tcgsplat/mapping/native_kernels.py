"""Adam on rows of Gaussians, without autograd; the losses are in `loss_kernels.py`.

Parameters are in blocks [blocks, ROWS, 16] like the rasterizer's own, and in the same order; what
`optimizer.RowAdam` and `optimization.AutogradOptimization` say in torch is said here sixteen Gaussians at a time.
"""

import math
from collections.abc import Sequence

import numpy as np

from tcgsplat.mapping.adam import BETA_1, BETA_2, EPSILON
from tcgsplat.render.conventions import MAX_OPACITY
from tcgsplat.render.numba_cpu import projection
from tcgsplat.render.numba_cpu.compilation import inner, kernel
from tcgsplat.render.numba_cpu.lanes import load, load_rows, mask_ge, store, store_rows
from tcgsplat.render.numba_cpu.layout import FEATURE, LOG2_OPACITY, MEAN, PARAMETERS, QUAT, SCALE
from tcgsplat.render.numba_cpu.pass_kernels import ONLY_PHASE
from tcgsplat.render.numba_cpu.phases import BEGIN, DONE, WAITING, next_unit
from tcgsplat.render.numba_cpu.simd import (
    Vector,
    Vectors,
    apart,
    dot,
    exp2,
    fma,
    formula,
    log2,
    maximum,
    minimum,
    spread,
    sqrt,
    where_ge,
)
from tcgsplat.scene.harmonics import SH_C0

# Rows of the raw parameters; the same places as their activations have in the rasterizer's blocks.
LOG_SCALE, LOGIT, SH = SCALE, LOG2_OPACITY, FEATURE
ROWS = SH + 3

# Constants of a step, after the learning rate of every row.
SCALE_WEIGHT, ROTATION_WEIGHT, STABILITY_WEIGHT = ROWS, ROWS + 1, ROWS + 2
CONSTANTS = ROWS + 3

UNIT = 512
"""Gaussians that a thread takes at a time: their derivatives stay in the nearest cache."""

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


@formula
def _opacity(logit: Vector) -> Vector:
    """log2 of the clipped sigmoid."""
    logit = maximum(minimum(logit, logit.of(_STEEPEST)), logit.of(-_STEEPEST))
    return minimum(0 - log2(exp2(logit * -_LOG2E) + _ONE), logit.of(_LOG2_MAX_OPACITY))


@formula
def _scale(log_scale: Vector) -> Vector:
    return exp2(log_scale * _LOG2E)


@formula
def _color(sh: Vector) -> Vector:
    return maximum(fma(sh, sh.of(_C0), sh.of(_HALF)), sh.of(_ZERO))


@kernel("f4[::1], f4[::1], i8, i8")
def activate(raw, P, start, stop):
    """The rasterizer's parameters from raw ones, for a range: what `Gaussians` calls scales, opacities and colors."""
    for i in range(start, stop, 16):
        for row in range(MEAN, QUAT + 4):
            store(P, PARAMETERS * i + 16 * row, load(raw, ROWS * i + 16 * row))
        for row in range(LOG_SCALE, LOG_SCALE + 3):
            store(P, PARAMETERS * i + 16 * row, _scale(load(raw, ROWS * i + 16 * row)))
        store(P, PARAMETERS * i + 16 * LOGIT, _opacity(load(raw, ROWS * i + 16 * LOGIT)))
        for row in range(SH, SH + 3):
            store(P, PARAMETERS * i + 16 * row, _color(load(raw, ROWS * i + 16 * row)))


@formula
def _changes(raw: Vectors, before: Vectors) -> Vectors:
    """Of rows up to the scales: d_mu (Eq. 5), d_s (Eq. 6), the cosine between quaternions, and their inverse lengths."""

    def length(rows: slice) -> Vector:
        return _norm([now - then for now, then in zip(raw[rows], before[rows], strict=True)], 0)

    q, q_before = raw[QUAT:LOG_SCALE], before[QUAT:LOG_SCALE]
    inverse, inverse_before = _ONE / _norm(q, _TINY), _ONE / _norm(q_before, _TINY)
    cosine = dot(q, q_before) * inverse * inverse_before
    return length(slice(MEAN, QUAT)), length(slice(LOG_SCALE, LOGIT)), cosine, inverse, inverse_before


def _norm(a: Sequence[Vector], least_square: float) -> Vector:
    total = a[0].of(least_square)
    for entry in a:
        total = fma(entry, entry, total)
    return sqrt(total)


@formula
def _distance(changes: Vectors, scale_weight: Vector, rotation_weight: Vector) -> Vector:
    """Eq. 8."""
    moved, stretched, cosine, _, _ = changes
    turned = maximum(_ONE - cosine * cosine, cosine.of(_ZERO))
    return fma(turned, rotation_weight, fma(stretched, scale_weight, moved))


@kernel("f4[::1], f4[::1], i8, f4[::1], f4[::1]")
def self_distances(raw, before, n, constants, out):
    """How far each Gaussian is from where it was before the update (Eq. 8), metres."""
    for i in range(0, n, 16):
        changes = _changes(load_rows(raw, ROWS * i, 16, LOGIT), load_rows(before, ROWS * i, 16, LOGIT))
        store(out, i, _distance(changes, constants[SCALE_WEIGHT], constants[ROTATION_WEIGHT]))


@formula
def _pull(
    changes: Vectors, limit: Vector, seen: Vector, scale_weight: Vector, rotation_weight: Vector, weight: Vector
) -> Vectors:
    """What exceeds the limit of Eq. 23, and factors of its derivative by means, quaternions and scales."""
    moved, stretched, cosine, inverse, _ = changes
    distance, zero, tiny = _distance(changes, scale_weight, rotation_weight), seen.of(_ZERO), seen.of(_TINY)
    pull = where_ge(limit, distance, zero, weight)
    by_mean = where_ge(zero, moved, zero, pull / maximum(moved, tiny))
    by_scale = where_ge(zero, stretched, zero, pull * scale_weight / maximum(stretched, tiny))
    by_turn = pull * rotation_weight * cosine * inverse * _TWO
    return where_ge(limit, distance, zero, distance - limit) * seen, by_mean, by_turn, by_scale


@formula
def _aged(clocks: Vectors, seen: Vector) -> tuple[Vectors, Vectors]:
    """The clocks after this step, and what the moments of a young Gaussian are multiplied by."""
    power_1, power_2 = powers = clocks[0] * _BETA_1, clocks[1] * _BETA_2
    after = tuple(where_ge(seen, seen.of(_ONE), now, then) for now, then in zip(powers, clocks, strict=True))
    return after, (_ONE / (_ONE - power_1), _ONE / (_ONE - power_2))


@formula
def _by_logit(value: Vector, g: Vector, log2_opacity: Vector) -> Vector:
    """D log2 sigmoid(x) = (1 - sigmoid(x)) log2(e) dx; where opacity is clipped, nothing."""
    return where_ge(value, value.of(_MAX_LOGIT), value.of(_ZERO), g * (_ONE - exp2(log2_opacity)) * _LOG2E)


@formula
def _by_color(g: Vector, color: Vector) -> Vector:
    """Nothing where colour is clipped."""
    return where_ge(g.of(_ZERO), color, g.of(_ZERO), g * _C0)


@formula
def _stepped(
    value: Vector, g: Vector, first: Vector, second: Vector, young: Vectors, rate: Vector, seen: Vector
) -> Vectors:
    """Adam for one row: the value and its two moments after a step, or as they are if not seen."""
    g = where_ge(g.of(_HUGE), apart(g, g.of(0)), g, g.of(0))  # NaN compares as false
    m = fma(first, g.of(_BETA_1), g * _REST_1)
    v = fma(second, g.of(_BETA_2), g * g * _REST_2)
    after = value - m * young[0] / (sqrt(v * young[1]) + _EPSILON) * rate, m, v
    return tuple(where_ge(seen, g.of(_ONE), new, old) for new, old in zip(after, (value, first, second), strict=True))


@inner
def _adam_step(start, stop, raw, P, before, first, second, clocks, grads, depths, allowed, scale, constants, excess):
    """One Adam step of the visible Gaussians of a range, on the losses of the pixels and of Eq. 23.

    Visible are those whose depth is not 0. `grads` holds the derivatives by the range's `P`; they are led on to the raw parameters.
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
        after, young = _aged(load_rows(clocks, 2 * i, 16, 2), seen)
        store_rows(clocks, 2 * i, 16, after)
        # Eq. 8 between now and before the update, and where it exceeds what is allowed, its derivative.
        changes = _changes(load_rows(raw, ROWS * i, 16, LOGIT), load_rows(before, ROWS * i, 16, LOGIT))
        exceeds, by_mean, by_turn, by_scale = _pull(
            changes, load(allowed, i), seen, constants[SCALE_WEIGHT], constants[ROTATION_WEIGHT],
            constants[STABILITY_WEIGHT],
        )  # fmt: skip
        store(excess, i, exceeds)
        _, _, cosine, inverse, inverse_before = changes
        for row in range(ROWS):
            at, at_P = ROWS * i + 16 * row, PARAMETERS * i + 16 * row
            value, g, rate = load(raw, at), load(grads, at_P - PARAMETERS * start), spread(constants[row])
            if row < QUAT:
                g = fma(by_mean, value - load(before, at), g)
            elif row < LOG_SCALE:
                g = fma(by_turn, cosine * inverse * value - load(before, at) * inverse_before, g)
            elif row < LOGIT:
                g = fma(by_scale, value - load(before, at), g * load(P, at_P))
            elif row == LOGIT:
                g = _by_logit(value, g, load(P, at_P))
            else:
                g = _by_color(g, load(P, at_P))
            if row < LOGIT:
                rate = rate * load(scale, i)
            value, m, v = _stepped(value, g, load(first, at), load(second, at), young, rate, seen)
            store(first, at, m)
            store(second, at, v)
            store(raw, at, value)
        activate(raw, P, i, i + 16)


@kernel("i8[::1], f4[::1], u4[::1], f4[::1], f4[::1], f4[::1], i8, f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[::1]")
def step(
    progress, pair_sums, slot_starts, cam, grads, pose, n, raw, P, before, first, second, clocks, depths, allowed, scale,
    constants, excess,
):
    """From the sums of all pairs to the next parameters of all Gaussians. False: has waited for long.

    The arguments up to `pose` are those of `projection.backward`, the others of `_adam_step`. Derivatives by
    parameters live from the one to the other in `grads`, a worker's own for one unit: to write them all to memory and
    to read them again would take longer than either. The pose stays.
    """
    units = -(-n // UNIT)
    k = next_unit(progress, ONLY_PHASE, units, BEGIN)
    while k >= 0:
        start, stop = k * UNIT, min((k + 1) * UNIT, n)
        projection.backward(P, n, start, stop, cam, slot_starts, pair_sums, grads, start, pose)
        _adam_step(
            start, stop, raw, P, before, first, second, clocks, grads, depths, allowed, scale, constants, excess
        )
        k = next_unit(progress, ONLY_PHASE, units, DONE)
    return k != WAITING
