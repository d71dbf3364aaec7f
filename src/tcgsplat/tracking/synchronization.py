"""Depth at the instant of colour: the two images of a hand-held sensor are some milliseconds apart."""

import math
from dataclasses import replace
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float
from torch import Tensor

from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.scene.frame import Frame
from tcgsplat.tensors import Pose
from tcgsplat.tracking import synchronization_kernels as kernels

Floats = npt.NDArray[np.float32]

NEAREST: Final = np.float32(0.01)
"""Metres: what claims to be nearer than this is no reading, and its inverse would overflow."""
MIN_SHIFT: Final = 0.1
"""Pixels below which nothing is moved: less than the sensor's own registration of depth to colour is good for."""
MAX_STEP: Final = 0.3
"""Metres, and radians, of motion between two images of one frame that no hand makes: then the velocity is wrong."""
MAX_REACH: Final = 8
"""Pixels around the guess in which a nearer surface is looked for; wider parallax than that blurs the image as well."""


def synchronized(frame: Frame, velocity: Float[Tensor, "6"]) -> Frame:
    """The frame with its depth image moved to the instant of its colour image.

    The scene is taken to stand still: its depth, as the camera saw it at `frame.depth_timestamp`, is drawn into the
    camera of `frame.timestamp`. Pixels whose surface the depth image does not show, since it was hidden, outside or
    without a reading, get 0; so do those outside `frame.valid`. No reading is a mean over two surfaces.

    Args:
        frame: A frame whose two time stamps may differ.
        velocity: Tangent per second in the camera's own frame, metres and radians: T(t + dt) = T(t) exp(velocity dt),
            as in `ConstantVelocity`.

    Returns:
        A frame of one instant; the frame itself where no pixel would move by `MIN_SHIFT`, or where the velocity is
        not finite or moves the camera by more than `MAX_STEP`.
    """
    if frame.depth_delay == 0:
        return frame
    step = velocity.detach().cpu() * frame.depth_delay
    length, angle = float(step[:3].norm()), float(step[3:].norm())
    if not (length < MAX_STEP and angle < MAX_STEP):  # neither holds for NaN
        return frame
    inverse_depth = _inverse(frame.depth.cpu().numpy())
    ray = _longest_ray(frame.camera)
    focal = max(frame.camera.fx, frame.camera.fy)
    # The ray r of a point at z moves by t / z + omega x r, less its part along r: by |t| |r| / z and |omega| |r|^2.
    parallax = focal * length * ray * float(inverse_depth.max(initial=0.0))
    if parallax + focal * angle * ray**2 < MIN_SHIFT:
        return frame
    reach = min(math.ceil(parallax), MAX_REACH)
    nearest = cv2.dilate(inverse_depth, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    H, e = _projection(frame.camera, se3.exp(-step))
    height, width = inverse_depth.shape
    depth: Floats = np.empty((height, width), np.float32)
    behind = np.zeros(width + 2, np.float32)
    flat = np.concatenate((inverse_depth.reshape(-1), behind))
    kernels.moved(flat, nearest.reshape(-1), H.reshape(-1), e, height, width, depth.reshape(-1))
    depth[~frame.valid.cpu().numpy()] = 0
    return replace(frame, depth=torch.from_numpy(depth).to(frame.depth.device), depth_timestamp=None)


def _inverse(depth: Floats) -> Floats:
    """1 / depth, 0 where there is no reading."""
    return np.divide(np.float32(1), depth, out=np.zeros(depth.shape, np.float32), where=depth > NEAREST)


def _longest_ray(camera: Camera) -> float:
    """Length of the ray through the corner farthest from the optical axis, scaled to z = 1."""
    x = max(camera.cx, camera.width - 1 - camera.cx) / camera.fx
    y = max(camera.cy, camera.height - 1 - camera.cy) / camera.fy
    return math.hypot(x, y, 1.0)


def _projection(camera: Camera, T_depth_color: Pose) -> tuple[Floats, Floats]:
    """K R K^-1 and K t: where a pixel of the colour instant is at the depth instant, at infinity and per 1/z."""
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    T = T_depth_color.numpy()
    return (K @ T[:3, :3] @ np.linalg.inv(K)).astype(np.float32), (K @ T[:3, 3]).astype(np.float32)
