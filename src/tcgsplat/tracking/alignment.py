"""Gauss-Newton direct alignment of a frame against one render of the map.

The map is drawn once, near the predicted pose, with colour, planar depth and confidence; live frames are then aligned
to that view, coarse to fine, by joint photometric and point-to-plane residuals under Student-t weights, each weighted
by the tracking weight of Eq. 18. One render for a frame or several, instead of one an iteration, is what makes it fast;
`descent.py` minimises the same weighted residual through the rasterizer, as the paper does.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch

from tcgsplat.geometry import se3
from tcgsplat.scene.exposure import Exposure
from tcgsplat.scene.frame import Frame
from tcgsplat.tensors import Pose
from tcgsplat.tracking import alignment_kernels as kernels
from tcgsplat.tracking import pyramids
from tcgsplat.tracking.reference import Level, Pair, ReferenceView, pairs
from tcgsplat.tracking.settings import AlignmentConfig

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]

ENOUGH_FOR_EXPOSURE = 100.0
"""Sum of weights below which gain and offset are left alone: about as many points."""
MAX_GAIN = 2.5
"""Of a picture over its submap's first, and its inverse: two to three stops, since colours are not linear in light."""
FLAT_VARIANCE = 0.002
"""Variance of intensity, grey levels squared, that a gain of 1 is worth: an image flatter than that keeps it."""
STEP_PRIOR = 0.05
"""Spread of a step that is expected before anything is seen, metres and radians."""
SMALL = 3e-4
"""Steps, metres and radians, from which on a coarse level has done what it can."""
COLOR_SCALE, DEPTH_SCALE = 0.05, 2.0
"""Spreads of the residuals before anything is known: grey levels, and of the depth noise that is expected."""
_LOW, _HIGH = np.sort(np.indices((6, 6)), axis=0)
_HESSIAN_ENTRY = kernels.HESSIAN + 6 * _LOW - _LOW * (_LOW - 1) // 2 + _HIGH - _LOW
"""Where each entry of the symmetric H is among the sums."""


@dataclass(frozen=True)
class Equations:
    """Normal equations of one kind of residual at a pose, H x = -g, for a left perturbation of map to camera."""

    H: Doubles
    """[6, 6]; translation first."""
    g: Doubles
    """[6]"""


@dataclass(frozen=True)
class Alignment:
    """What the solver found."""

    T_map_cam: Pose
    iterations: int
    coverage: float
    """Share of the frame's valid pixels where the rendered view has something."""
    overlap: float
    """Share of the rendered view that falls into the live image."""
    agreement: float
    """Share of the overlap's depth readings that agree within the gate; 1 where there is none to ask."""
    correlation: float
    """Of live and rendered intensity where the depth does not disagree, in [-1, 1]; does not feel the exposure."""
    exposure: Exposure
    """Of the frame's intensity over the rendered view's, composited on black."""
    color: Equations
    """What colour alone asks for at the pose that was found."""
    depth: Equations
    """What depth alone asks for there."""


def normal_equations(points: Floats, live: Floats, constants: Floats) -> Doubles:
    """The sums of one pass over points [POINT, n] and a live image [h, w, CHANNELS]; see the kernel of this name."""
    sums, (h, w, _) = np.zeros(kernels.SUMS), live.shape
    kernels.normal_equations(points.reshape(-1), points.shape[1], live.reshape(-1), h, w, constants, sums)
    return sums


@dataclass
class Photometry:
    """Nuisance parameters that are re-estimated at every pass."""

    gain: float = 1.0
    offset: float = 0.0
    color_scale: float = COLOR_SCALE
    depth_scale: float = DEPTH_SCALE

    def refit(self, sums: Doubles) -> None:
        """Exposure from weighted moments (a prior of small variance keeps flat images at gain 1), spreads from rms."""
        if sums[kernels.COLOR_WEIGHT] > 0:
            self.color_scale = max(0.008, float(sums[kernels.COLOR_SQUARES] / sums[kernels.COLOR_WEIGHT]) ** 0.5)
        if sums[kernels.DEPTH_WEIGHT] > 0:
            self.depth_scale = max(0.05, float(sums[kernels.DEPTH_SQUARES] / sums[kernels.DEPTH_WEIGHT]) ** 0.5)
        total = float(sums[kernels.GAIN_W])
        if total > ENOUGH_FOR_EXPOSURE:
            reference, live = float(sums[kernels.GAIN_R]) / total, float(sums[kernels.GAIN_L]) / total
            variance = float(sums[kernels.GAIN_RR]) / total - reference**2
            covariance = float(sums[kernels.GAIN_RL]) / total - reference * live
            self.gain = min(MAX_GAIN, max(1 / MAX_GAIN, (covariance + FLAT_VARIANCE) / (variance + FLAT_VARIANCE)))
            self.offset = live - self.gain * reference


def correlation(weight: float, x: float, y: float, xx: float, xy: float, yy: float) -> float:
    """Correlation of two intensities from sums of weights, values and products; NaN if one of them is.

    A small prior, a common spread of 0.01, lets two flat images correlate and a flat one alone not.
    """
    total, prior = max(weight, 1.0), 1e-4
    mean_x, mean_y = x / total, y / total
    variance_x, variance_y = max(xx / total - mean_x**2, 0.0) + prior, max(yy / total - mean_y**2, 0.0) + prior
    return (xy / total - mean_x * mean_y + prior) / math.sqrt(variance_x * variance_y)


def _constants(level: Level[Floats], T: Doubles, photometry: Photometry, config: AlignmentConfig) -> Floats:
    """Of one pass, in the kernel's order."""
    constants = np.empty(kernels.CONSTANTS, np.float32)
    constants[kernels.ROTATION : kernels.TRANSLATION] = T[:3, :3].ravel()
    constants[kernels.TRANSLATION : kernels.INTRINSICS] = T[:3, 3]
    camera = level.camera
    constants[kernels.INTRINSICS : kernels.GAIN] = camera.fx, camera.fy, camera.cx, camera.cy
    constants[kernels.GAIN : kernels.COLOR_SCALE] = photometry.gain, photometry.offset
    constants[kernels.COLOR_SCALE : kernels.GATE] = photometry.color_scale, photometry.depth_scale
    constants[kernels.GATE : kernels.SIGMA_FLOOR] = level.gate, config.depth_weight
    constants[kernels.SIGMA_FLOOR :] = config.sigma_floor, config.sigma_slope
    return constants


def _sums(pair: Pair[Floats], T: Doubles, photometry: Photometry, config: AlignmentConfig) -> Doubles:
    """Of a pass over a level."""
    return normal_equations(pair.level.points, pair.live, _constants(pair.level, T, photometry, config))


def _equations(sums: Doubles) -> Equations:
    return Equations(sums[_HESSIAN_ENTRY], sums[kernels.GRADIENT : kernels.GRADIENT + 6])


def _step(sums: Doubles) -> Doubles:
    """The Gauss-Newton step, damped as if a step of 0 +- 5 cm and +- 0.05 radians had been measured.

    Beside thousands of residuals that is nothing, but what they leave open (a flat wall, a coarse level) stays put.
    """
    H, g = sums[_HESSIAN_ENTRY] + np.eye(6) / STEP_PRIOR**2, sums[kernels.GRADIENT : kernels.GRADIENT + 6]
    return -np.asarray(np.linalg.solve(H, g), np.float64)


def _exp(tangent: Doubles) -> Doubles:
    """`se3.exp` in numpy, which takes a sixth of torch's time for matrices of this size."""
    rho, (x, y, z) = tangent[:3], tangent[3:]
    angle = math.hypot(x, y, z)
    length = max(angle, 1e-300)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) / length
    sine, versine = np.sin(angle), 2 * np.sin(0.5 * angle) ** 2
    T = np.eye(4)
    T[:3, :3] += sine * K + versine * (K @ K)
    T[:3, 3] = rho + K @ (versine / length * rho + (1 - sine / length) * (K @ rho))
    return T


def align(frame: Frame, view: ReferenceView[Floats], guess: Pose, config: AlignmentConfig) -> Alignment:
    """Align a frame to a rendered view.

    Args:
        frame: The live frame, on the CPU, of the view's camera.
        view: Of the map, from somewhere near.
        guess: `T_map_cam` to start from.
        config: Constants.
    """
    views = pairs(pyramids, frame, view)
    finest = views[0]
    T = (se3.inverse(guess) @ view.T_map_ref).numpy()  # reference camera to live camera
    photometry, sums, passes = Photometry(), np.zeros(kernels.SUMS), 0
    for pair in reversed(views):
        photometry.color_scale, photometry.depth_scale = COLOR_SCALE, DEPTH_SCALE
        for _ in range(pair.level.passes):
            sums = _sums(pair, T, photometry, config)
            photometry.refit(sums)
            step = _step(sums)
            T = _exp(step) @ T
            passes += 1
            if np.linalg.norm(step[:3]) < SMALL and np.linalg.norm(step[3:]) < SMALL and pair is not finest:
                break
    valid = frame.valid.numpy()
    solid = replace(finest, level=replace(finest.level, points=view.solid_points))
    return concluded(
        view.T_map_ref,
        T,
        passes,
        photometry,
        coverage=int(np.count_nonzero(view.covered & valid)) / max(int(np.count_nonzero(valid)), 1),
        points=int(np.count_nonzero(finest.level.points[kernels.PZ])),
        last=sums,
        color=_sums(finest, T, photometry, replace(config, depth_weight=0.0)),
        both=_sums(finest, T, photometry, replace(config, depth_weight=1.0)),
        solid=_sums(solid, T, photometry, config),
    )


def concluded(
    T_map_ref: Pose,
    T_live_ref: Doubles,
    passes: int,
    photometry: Photometry,
    *,
    coverage: float,
    points: int,
    last: Doubles,
    color: Doubles,
    both: Doubles,
    solid: Doubles,
) -> Alignment:
    """What the solver found, from the sums of its last passes.

    Args:
        T_map_ref: Pose of the rendered view.
        T_live_ref: What was found: reference camera to live camera.
        passes: How many it took.
        photometry: As it was found.
        coverage: Of the frame by the rendered view.
        points: Of the finest level.
        last: Sums of the last pass that moved the pose.
        color: Of the finest level at the pose that was found, without depth's residuals.
        both: The same with them, at full weight.
        solid: Of the points that tell the exposure, there.
    """
    readings, exposed = float(last[kernels.READINGS]), replace(photometry)
    exposed.refit(solid)
    return Alignment(
        T_map_cam=T_map_ref @ se3.inverse(torch.from_numpy(T_live_ref)),
        iterations=passes,
        coverage=coverage,
        overlap=float(last[kernels.IN_VIEW]) / max(points, 1),
        agreement=float(last[kernels.AGREEING]) / readings if readings else 1.0,
        correlation=correlation(
            *(float(last[k]) for k in (kernels.GAIN_W, kernels.GAIN_R, kernels.GAIN_L)),
            *(float(last[k]) for k in (kernels.GAIN_RR, kernels.GAIN_RL, kernels.GAIN_LL)),
        ),
        exposure=Exposure(exposed.gain, exposed.offset),
        color=_equations(color),
        depth=_equations(both - color),
    )
