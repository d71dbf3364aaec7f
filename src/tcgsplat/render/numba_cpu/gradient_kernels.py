"""The backward pass as a kernel of two phases; see `phases.py`. Mapping has one of its own, which goes on to the step."""

import numpy as np

from tcgsplat.render.numba_cpu import blending, projection
from tcgsplat.render.numba_cpu.compilation import kernel
from tcgsplat.render.numba_cpu.pass_kernels import TILES, UNIT
from tcgsplat.render.numba_cpu.phases import BEGIN, DONE, WAITING, next_unit

BACKWARD, CHAIN = 0, 1
"""Phases of `differentiate`."""
_WHOLE = np.int64(0)  # `grads` begin with the first splat


@kernel(
    "i8[::1], i8, i4[::1], i8[::1], f4[::1], i8, i8, i8, f4[::1], i4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], i8, f4[::1], u4[::1], f4[::1], f4[:, ::1]"
)
def differentiate(
    progress, last_phase, tile_ends, pairs, records, tiles_x, width, height, grid, masks, planes, d_planes, local,
    pair_sums, P, n, cam, slot_starts, grads, pose_sums,
):  # type: ignore[no-untyped-def]  # fmt: skip
    """From `d_planes` to the sums of all pairs, to `grads` and to each unit's `pose_sums`. False: has waited for long."""
    tiles = tile_ends.size - 1
    for phase in range(last_phase + 1):
        count = -(-tiles // TILES) if phase == BACKWARD else pose_sums.shape[0]
        k = next_unit(progress, phase, count, BEGIN)
        while k >= 0:
            if phase == BACKWARD:
                blending.backward(
                    k * TILES, min((k + 1) * TILES, tiles), tile_ends, pairs, records, tiles_x, width, height, grid,
                    masks, planes, d_planes, local, pair_sums,
                )  # fmt: skip
            else:
                projection.backward(
                    P, n, k * UNIT, min((k + 1) * UNIT, n), cam, slot_starts, pair_sums, grads, _WHOLE, pose_sums[k]
                )
            k = next_unit(progress, phase, count, DONE)
        if k == WAITING:
            return False
    return True
