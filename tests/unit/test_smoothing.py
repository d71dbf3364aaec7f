"""Depth smoothed within its surfaces, against the obvious way, and what that does to a sensor that rounds."""

from dataclasses import replace

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tcgsplat.geometry.camera import Camera
from tcgsplat.scene.frame import Frame
from tcgsplat.tracking.smoothing import smoothed
from tcgsplat.tracking.smoothing_kernels import SMOOTH

_CAMERA = Camera(52.0, 52.0, 31.5, 23.5, 64, 48)


def _frame(depth):
    depth = torch.from_numpy(np.asarray(depth, np.float32))
    height, width = depth.shape
    camera = replace(_CAMERA, width=width, height=height)
    return Frame(0, 0.0, torch.zeros(height, width, 3), depth, torch.ones(height, width, dtype=torch.bool), camera)


def _obvious(depth):
    out = depth.astype(np.float64)
    for y in range(1, depth.shape[0] - 1):
        for x in range(1, depth.shape[1] - 1):
            around = depth[y - 1 : y + 2, x - 1 : x + 2].astype(np.float64)
            if depth[y, x] > 0:
                out[y, x] = around[np.abs(around - depth[y, x]) < SMOOTH * depth[y, x]].mean()
    return out


@settings(deadline=None)  # the first call compiles
@given(
    hnp.arrays(
        np.float32,
        st.tuples(st.integers(1, 9), st.integers(1, 9)),
        elements=st.sampled_from([0.0, 0.7, 1.0, 1.02, 1.1, 3.0]).map(np.float32),
    )
)
def test_is_the_mean_over_neighbours_on_the_surface(depth):
    np.testing.assert_allclose(smoothed(_frame(depth)).depth.numpy(), _obvious(depth), rtol=1e-6)


def test_holes_stay_holes_and_edges_stay_sharp():
    depth = np.full((48, 64), 2.0)
    depth[:, 32:] = 3.0
    depth[10:20, 20:40] = 0
    frame = _frame(depth)
    torch.testing.assert_close(smoothed(frame).depth, frame.depth, rtol=0, atol=0)
    assert smoothed(frame).color is frame.color


def test_leaves_the_given_frame_alone():
    frame = _frame(np.random.default_rng(0).uniform(1, 1.02, (48, 64)))
    before = frame.depth.clone()
    assert not torch.equal(smoothed(frame).depth, before)
    assert torch.equal(frame.depth, before)


@pytest.mark.parametrize("step", [0.002, 0.005])
def test_depth_that_is_rounded_moves_with_the_camera(step):
    """A wall seen at 60 degrees by a sensor that rounds: pixel by pixel it stands still or jumps, smoothed it moves."""
    u = np.arange(64)[None] - 31.5
    distance = np.full((48, 1), 3.0) / (1 + u / 260 * np.tan(np.pi / 3))
    rng = np.random.default_rng(1)

    def rounded(depth):
        disparity = 43.5 / depth + 0.05 * rng.standard_normal(depth.shape)
        return 43.5 / (np.round(8 * disparity) / 8)

    moved = [
        (process(rounded(distance)) - process(rounded(distance - step)))[1:-1, 1:-1]
        for process in (lambda d: d, lambda d: smoothed(_frame(d)).depth.numpy())
    ]
    raw, smooth = (np.abs(change - step).mean() for change in moved)
    assert smooth < 0.5 * raw
