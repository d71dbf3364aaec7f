"""Images as alignment compares them, on the CPU: intensity, and depth that tells what saw nothing, whole and halved.

Depth images mark pixels that saw nothing of the world (the empty border of an undistorted image) by NOTHING, pixels
without a reading by 0. This module is the CPU's `reference.Images`.
"""

from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from tcgsplat.geometry.camera import Camera
from tcgsplat.render.numba_cpu.simd import LANES
from tcgsplat.render.view import Rendering
from tcgsplat.scene.frame import Frame
from tcgsplat.tensors import Image, Plane
from tcgsplat.tracking import alignment_kernels as kernels

Floats = npt.NDArray[np.float32]

NOTHING: Final = np.float32(-1)
SOLID: Final = 0.95
"""Alpha from which on a pixel tells the exposure."""
_RED, _GREEN, _BLUE = np.float32(0.299), np.float32(0.587), np.float32(0.114)


def luma(color: Image) -> Floats:
    """Intensity of an RGB image [h, w], on the CPU."""
    values: Floats = color.numpy()
    if values.flags.c_contiguous:
        return cv2.cvtColor(values, cv2.COLOR_RGB2GRAY)  # type: ignore[return-value]
    red, green, blue = (values[..., k] for k in range(3))  # a rendering's planes, which OpenCV would copy first
    return _RED * red + _GREEN * green + _BLUE * blue  # type: ignore[no-any-return]


def halved(image: Floats) -> Floats:
    """Mean over two by two pixels; an odd row or column at the end is left out."""
    h, w = image.shape[0] // 2, image.shape[1] // 2
    return cv2.resize(image[: 2 * h, : 2 * w], (w, h), interpolation=cv2.INTER_AREA)  # type: ignore[return-value]


def live(frame: Frame) -> tuple[Floats, Floats]:
    """Intensity and marked depth of a frame: what is not valid saw nothing."""
    return luma(frame.color), np.where(frame.valid.numpy(), frame.depth.numpy(), NOTHING)


def rendered(rendering: Rendering, min_alpha: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Intensity and marked depth without the background: what is hardly covered saw nothing.

    So its black does not bleed into the coarse levels' points. Then intensity with it, and depth of what is solid.
    """
    composited = luma(rendering.color)
    alpha: Floats = rendering.alpha.numpy()
    inverse = np.maximum(alpha, kernels.THIN)
    np.divide(np.float32(1), inverse, out=inverse)
    intensity, depth = composited * inverse, rendering.composited_plane_depth.numpy() * inverse
    depth[alpha <= min_alpha] = NOTHING
    return intensity, depth, composited, np.where(alpha > SOLID, depth, NOTHING)


def weights(weight: Plane) -> Floats:
    """As the kernels read them."""
    return np.ascontiguousarray(weight.numpy())


def halved_depth(depth: Floats) -> Floats:
    """Mean of the readings of two by two pixels that agree with the nearest one; NOTHING if any saw nothing."""
    h, w = depth.shape
    out: Floats = np.empty((h // 2, w // 2), np.float32)
    kernels.halved_depth(depth.reshape(-1), h, w, out.reshape(-1))
    return out


def points(intensity: Floats, depth: Floats, weight: Floats, camera: Camera, radius: int, stride: int) -> Floats:
    """Points of a rendered view [POINT, n], with normals from neighbours at `radius`, every `stride` pixels."""
    h, w = depth.shape
    n = LANES * len(range(2, h - 2, stride)) * len(range(2, w - 2, stride * LANES))
    out: Floats = np.empty((kernels.POINT, n), np.float32)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
    images = (image.reshape(-1) for image in (intensity, depth, weight))
    kernels.reference_points(*images, h, w, intrinsics, radius, stride, n, out.reshape(-1))
    return out


def sampled(intensity: Floats, depth: Floats) -> Floats:
    """What a pass samples, [h, w, CHANNELS]: intensity, its slopes along u and v, depth. The border stays empty."""
    h, w = depth.shape
    out: Floats = np.empty((h, w, kernels.CHANNELS), np.float32)
    kernels.live_image(intensity.reshape(-1), depth.reshape(-1), h, w, out.reshape(-1))
    return out
