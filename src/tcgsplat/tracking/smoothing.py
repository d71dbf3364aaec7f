"""Depth that a sensor has rounded, with the steps taken out as far as neighbouring pixels tell."""

from dataclasses import replace

import numpy as np
import torch

from tcgsplat.render.numba_cpu.simd import LANES
from tcgsplat.scene.frame import Frame
from tcgsplat.tracking import smoothing_kernels as kernels


def smoothed(frame: Frame) -> Frame:
    """The frame whose every depth reading is the mean of it and its neighbours on the same surface.

    A sensor that rounds disparity (a Kinect to an eighth of a pixel: 2.6 cm at 3 m) reports the same depth until the
    camera has come a step nearer, so that depth alone would have the camera stand still, and the jump that follows
    looks like an outlier. Neighbours are rounded at different places, and their mean moves with the camera.

    Returns:
        A frame with the same readings and holes. No reading is a mean over two surfaces.
    """
    depth = frame.depth.cpu().numpy()
    out = depth.copy()
    kernels.smoothed(np.pad(depth.ravel(), (0, LANES)), *depth.shape, out.reshape(-1))
    return replace(frame, depth=torch.from_numpy(out).to(frame.depth.device))
