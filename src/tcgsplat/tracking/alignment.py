"""Gauss-Newton direct alignment of a frame against one render of the map.

The map is drawn once, at the predicted pose, with colour, planar depth and confidence; the live frame is then aligned
to that view, coarse to fine, by joint photometric and point-to-plane residuals under Student-t weights, each weighted
by the tracking weight of Eq. 18. One render a frame instead of one an iteration is what makes it fast; `descent.py`
minimises the same weighted residual through the rasterizer, as the paper does.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from tcgsplat.errors import ConfigError
from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.view import Rendering
from tcgsplat.scene.frame import Frame
from tcgsplat.tensors import Plane, Pose
from tcgsplat.tracking import alignment_kernels as kernels

Floats = npt.NDArray[np.float32]

_ENOUGH_FOR_EXPOSURE = 100.0
"""Sum of weights below which gain and offset are left alone: about as many points."""
_FLAT_VARIANCE = 0.002
"""Variance of intensity, grey levels squared, that a gain of 1 is worth: an image flatter than that keeps it."""
_STEP_PRIOR = 0.05
"""Spread of a step that is expected before anything is seen, metres and radians."""


@dataclass(frozen=True)
class AlignmentConfig:
    """Constants of the solver. [ours]: measured on six sequences (design/tracking-recipe.md)."""

    iterations: tuple[int, ...] = (3, 2, 3)
    """Passes a level, finest first: full, half, quarter resolution. [ours]"""
    stride: int = 3
    """Every how many pixels a point is taken at full resolution; all are taken at the coarse levels. [ours]"""
    depth_weight: float = 1.0
    """Geometry over colour, after each has been divided by its own spread. [ours]"""
    min_alpha: float = 0.7
    """Rendered pixels below this coverage give no point. [ours]"""
    gate: float = 0.05
    """Metres, times (1 + z/2): depth that disagrees by more is another surface; doubled at coarse levels. [ours]"""
    sigma_floor: float = 0.0017
    """Depth noise at 0.4 m, metres: a structured-light sensor's (Nguyen et al. 2012) and some for the map. [ours]"""
    sigma_slope: float = 0.0019
    """Growth of depth noise with the square of the distance beyond 0.4 m, 1/metre. [ours]"""

    def __post_init__(self) -> None:
        if not self.iterations or min(self.iterations) < 0 or sum(self.iterations) == 0:
            raise ConfigError(
                f"tracker.alignment.iterations is {self.iterations!r}; give passes for every level, finest first, "
                "such as [3, 2, 3]"
            )
        if self.stride < 1:
            raise ConfigError(f"tracker.alignment.stride is {self.stride!r}; it must be at least 1")
        for name in ("gate", "sigma_floor"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"tracker.alignment.{name} is {getattr(self, name)!r}; it must be above 0 metres")
        for name in ("depth_weight", "sigma_slope"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"tracker.alignment.{name} is {getattr(self, name)!r}; it must be at least 0")


@dataclass(frozen=True)
class Alignment:
    """What the solver found."""

    T_map_cam: Pose
    iterations: int
    color_residual: float
    """Robust spread of the intensity residual, grey levels of [0, 1]."""
    depth_residual: float
    """Robust spread of the point-to-plane residual, in units of the depth noise."""
    overlap: float
    """Share of the rendered view that falls into the live image."""
    agreement: float
    """Share of the overlap's depth readings that agree within the gate; 1 where there is none to ask."""
    correlation: float
    """Of live and rendered intensity where the depth does not disagree, in [-1, 1]; does not feel the exposure."""


@dataclass(frozen=True)
class _Level:
    intensity: Floats
    depth: Floats
    camera: Camera


def luma(color: torch.Tensor) -> Floats:
    """Intensity of an RGB image [h, w], on the CPU."""
    weights = torch.tensor([0.299, 0.587, 0.114], dtype=color.dtype)
    return (color @ weights).numpy()  # type: ignore[no-any-return]


def _pyramid(intensity: Floats, depth: Floats, camera: Camera, levels: int) -> list[_Level]:
    pyramid = [_Level(np.ascontiguousarray(intensity), np.ascontiguousarray(depth), camera)]
    for _ in range(levels - 1):
        finer = pyramid[-1]
        pyramid.append(
            _Level(
                kernels.halved_intensity(finer.intensity),
                kernels.halved_depth(finer.depth),
                finer.camera.scaled(0.5),
            )
        )
    return pyramid


def _intrinsics(camera: Camera) -> tuple[Floats, Floats]:
    return np.array([camera.fx, camera.fy], np.float32), np.array([camera.cx, camera.cy], np.float32)


def _reference(rendering: Rendering, weight: Plane, camera: Camera, config: AlignmentConfig) -> list[Floats]:
    """Points of each level of the rendered view, finest first."""
    alpha = rendering.alpha
    # What is hardly covered saw nothing, so that its black does not bleed into the coarse levels' points.
    depth = torch.where(alpha > config.min_alpha, rendering.depth, -1.0).numpy()
    intensity = luma(rendering.color / alpha.clamp_min(1e-3)[..., None])
    points = []
    levels = _pyramid(intensity, depth, camera, len(config.iterations))
    weights = np.ascontiguousarray(weight.numpy())
    for number, level in enumerate(levels):
        stride, radius = (config.stride, 2) if number == 0 else (1, 1)
        focal, center = _intrinsics(level.camera)
        points.append(kernels.reference_points(level.intensity, level.depth, weights, focal, center, radius, stride))
        weights = kernels.halved_intensity(weights)
    return points


@dataclass
class _Photometry:
    """Nuisance parameters that are re-estimated at every pass."""

    gain: float = 1.0
    offset: float = 0.0
    color_scale: float = 0.05
    depth_scale: float = 2.0

    def refit(self, stats: npt.NDArray[np.float64]) -> None:
        """Exposure from weighted moments (a prior of small variance keeps flat images at gain 1), spreads from rms."""
        if stats[kernels.COLOR_WEIGHT] > 0:
            self.color_scale = max(0.008, float(stats[kernels.COLOR_SQUARES] / stats[kernels.COLOR_WEIGHT]) ** 0.5)
        if stats[kernels.DEPTH_WEIGHT] > 0:
            self.depth_scale = max(0.3, float(stats[kernels.DEPTH_SQUARES] / stats[kernels.DEPTH_WEIGHT]) ** 0.5)
        total = float(stats[kernels.GAIN_W])
        if total > _ENOUGH_FOR_EXPOSURE:
            reference, live = float(stats[kernels.GAIN_R]) / total, float(stats[kernels.GAIN_L]) / total
            variance = float(stats[kernels.GAIN_RR]) / total - reference**2
            covariance = float(stats[kernels.GAIN_RL]) / total - reference * live
            self.gain = min(1.5, max(0.67, (covariance + _FLAT_VARIANCE) / (variance + _FLAT_VARIANCE)))
            self.offset = live - self.gain * reference


def correlation(weight: float, x: float, y: float, xx: float, xy: float, yy: float) -> float:
    """Correlation of two intensities from sums of weights, values and products; NaN if one of them is.

    A small prior, a common spread of 0.01, lets two flat images correlate and a flat one alone not.
    """
    total, prior = max(weight, 1.0), 1e-4
    mean_x, mean_y = x / total, y / total
    variance_x, variance_y = max(xx / total - mean_x**2, 0.0) + prior, max(yy / total - mean_y**2, 0.0) + prior
    return (xy / total - mean_x * mean_y + prior) / math.sqrt(variance_x * variance_y)


def _step(H: npt.NDArray[np.float64], g: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The Gauss-Newton step, damped as if a step of 0 +- 5 cm and +- 0.05 radians had been measured.

    Beside thousands of residuals that is nothing, but what they leave open (a flat wall, a coarse level) stays put.
    """
    full = np.zeros((6, 6))
    full[np.triu_indices(6)] = H
    full += np.triu(full, 1).T
    return -np.asarray(np.linalg.solve(full + np.eye(6) / _STEP_PRIOR**2, g), np.float64)


def align(frame: Frame, rendering: Rendering, weight: Plane, T_map_ref: Pose, config: AlignmentConfig) -> Alignment:
    """Align a frame to a rendered view.

    Args:
        frame: The live frame, on the CPU.
        rendering: The map seen from `T_map_ref` with the frame's camera.
        weight: W_tr of Eq. 18 at every rendered pixel.
        T_map_ref: Pose of the rendered view, and the guess to start from.
        config: Constants.
    """
    points = _reference(rendering, weight, frame.camera, config)
    depth = torch.where(frame.valid, frame.depth, -1.0).numpy()
    live = _pyramid(luma(frame.color), depth, frame.camera, len(config.iterations))

    T = np.eye(4)  # reference camera to live camera
    photometry, stats, passes = _Photometry(), np.zeros(kernels.STATISTICS), 0
    for number in reversed(range(len(live))):
        level = live[number]
        focal, center = _intrinsics(level.camera)
        photometry.color_scale, photometry.depth_scale = 0.05, 2.0
        gate = config.gate if number == 0 else 2 * config.gate
        for _ in range(config.iterations[number]):
            H, g, stats = kernels.normal_equations(
                points[number], level.intensity, level.depth, focal, center,
                T[:3, :3].astype(np.float32), T[:3, 3].astype(np.float32),
                np.float32(photometry.gain), np.float32(photometry.offset), np.float32(photometry.color_scale),
                np.float32(photometry.depth_scale), np.float32(gate), np.float32(1.0), np.float32(config.depth_weight),
                np.float32(config.sigma_floor), np.float32(config.sigma_slope),
            )  # fmt: skip
            photometry.refit(stats)
            step = _step(H, g)
            T = se3.exp(torch.from_numpy(step)).numpy() @ T
            passes += 1
            if np.linalg.norm(step[:3]) < 3e-4 and np.linalg.norm(step[3:]) < 3e-4 and number > 0:
                break
    finest = next(number for number, passes_there in enumerate(config.iterations) if passes_there)
    readings = float(stats[kernels.READINGS])
    return Alignment(
        T_map_cam=T_map_ref @ se3.inverse(torch.from_numpy(T)),
        iterations=passes,
        color_residual=photometry.color_scale,
        depth_residual=photometry.depth_scale,
        overlap=float(stats[kernels.IN_VIEW]) / max(len(points[finest]), 1),
        agreement=float(stats[kernels.AGREEING]) / readings if readings else 1.0,
        correlation=correlation(
            *(float(stats[k]) for k in (kernels.GAIN_W, kernels.GAIN_R, kernels.GAIN_L)),
            *(float(stats[k]) for k in (kernels.GAIN_RR, kernels.GAIN_RL, kernels.GAIN_LL)),
        ),
    )
