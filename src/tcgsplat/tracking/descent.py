"""The paper's solver: Adam on the camera pose, through the rasterizer (Section 3.3, Eqs. 17 to 19).

The map stands still. Each iteration renders colour, depth, alpha and confidence at the current pose and follows the
gradient of the confidence-weighted residual. The base system turns the camera about the world's origin; here the
increment turns it about its own centre, which keeps rotation and translation apart wherever the camera is.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from tcgsplat.confidence import equations as eq
from tcgsplat.errors import ConfigError
from tcgsplat.geometry import quaternion, se3
from tcgsplat.render.losses import color_error, depth_error
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.repetition import repeat
from tcgsplat.render.view import DepthMode, Rendering, render
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Submap
from tcgsplat.tensors import Plane, Pose

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-8
"""Of the pose's Adam. [base]"""


@dataclass(frozen=True)
class DescentConfig:
    """Constants of the solver; the defaults are the base system's for TUM RGB-D."""

    iterations: int = 200
    """Adam steps a frame. [base]"""
    rotation_rate: float = 0.002
    """Step of the increment's quaternion. [base]"""
    translation_rate: float = 0.01
    """Step of the increment's translation, metres. [base]"""
    color_weight: float = 0.6
    """lambda_c of Eq. 19, over the three channels' sum; depth gets 1 - lambda_c per metre. [base]"""
    depth_mode: DepthMode = "composited"
    """The depth that is compared with the sensor. [base]"""
    soft_alpha: bool = True
    """Weight residuals by alpha cubed: what is hardly mapped hardly counts. [base]"""
    min_alpha: float = 0.0
    """Pixels covered less are left out; the base system uses 0.98 on ScanNet. [base]"""
    outlier_factor: float = 0.0
    """Leave out pixels whose depth error exceeds this many medians (50 on Replica and ScanNet); 0 for never. [base]"""
    mask_color: bool = True
    """Let the mask of valid depth count for colour too. [base]"""

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ConfigError(f"tracker.descent.iterations is {self.iterations!r}; it must be at least 1")
        if not 0 <= self.color_weight <= 1:
            raise ConfigError(f"tracker.descent.color_weight is {self.color_weight!r}; it must be between 0 and 1")


def weighted_residual(rendering: Rendering, weight: Plane, frame: Frame, config: DescentConfig) -> torch.Tensor:
    """The loss of Eq. 19 at one pose: masked and weighted colour and depth residuals, summed over pixels."""
    depth = rendering.depth_as(config.depth_mode)
    residual_depth = depth_error(depth, frame.depth)
    mask = frame.valid & (frame.depth > 0)
    with torch.no_grad():
        if config.min_alpha > 0:
            mask = mask & (rendering.alpha > config.min_alpha)
        if config.outlier_factor > 0:
            median = residual_depth.median()
            mask = mask & ((residual_depth < config.outlier_factor * median) | ~(median > 0))
        soft = rendering.alpha**3 if config.soft_alpha else torch.ones_like(rendering.alpha)
        color_mask = mask if config.mask_color else frame.valid
    return eq.tracking_loss(
        weight * soft,
        3 * color_error(rendering.color, frame.color) * color_mask,
        residual_depth * mask,
        color_weight=config.color_weight,
        depth_weight=1.0 - config.color_weight,
    )


@dataclass(frozen=True)
class Descent:
    """What the solver found."""

    T_map_cam: Pose
    """Where the loss was smallest."""
    iterations: int
    loss: float
    """The smallest value of Eq. 19 that was met."""


def descend(
    frame: Frame, submap: Submap, guess: Pose, rasterizer: Rasterizer, config: DescentConfig, *, floor: float | None
) -> Descent:
    """Minimise the weighted residual over the pose.

    Args:
        frame: Live frame.
        submap: The map, which stays as it is.
        guess: `T_map_cam` to start from.
        rasterizer: Backend with pose gradients.
        config: Constants.
        floor: w_min of Eq. 18; None weighs every pixel by 1 (the base system).
    """
    device = rasterizer.device
    frame, submap = frame.to(device), submap.to(device)
    T_cam_map_guess = se3.inverse(guess).to(device)
    q = torch.eye(4, dtype=torch.float64, device=device)[0].clone()
    t = torch.zeros(3, dtype=torch.float64, device=device)
    adam = AmsGrad([(q, config.rotation_rate), (t, config.translation_rate)])
    # The best pose so far stays on the device with its loss: no iteration waits to know them.
    best, lowest = T_cam_map_guess.clone(), torch.full((), torch.inf, device=device)

    def step() -> None:
        leaves = q.detach().requires_grad_(), t.detach().requires_grad_()
        T_cam_map = se3.from_rotation_translation(quaternion.to_matrix(leaves[0]), leaves[1]) @ T_cam_map_guess
        rendering = render(submap.gaussians, submap.confidence.value, frame.camera, T_cam_map, rasterizer)
        weight = (
            torch.ones_like(rendering.alpha) if floor is None else eq.tracking_weight(rendering.confidence, floor=floor)
        )
        loss = weighted_residual(rendering, weight, frame, config)
        better = loss.detach() < lowest
        best.copy_(torch.where(better, T_cam_map.detach(), best))
        lowest.copy_(torch.where(better, loss.detach(), lowest))
        adam.step(torch.autograd.grad(loss, leaves))

    repeat(rasterizer, step, lambda _: (), config.iterations, [*adam.tables, best, lowest])
    return Descent(se3.inverse(best.cpu()), config.iterations, float(lowest))


class AmsGrad:
    """Adam that forgets no gradient's size (Reddi et al. 2018), in place, with all that it counts on the device."""

    def __init__(self, parameters: Sequence[tuple[torch.Tensor, float]]) -> None:
        """Of parameters with their learning rates."""
        self._parameters, self._rates = [p for p, _ in parameters], [rate for _, rate in parameters]
        self._first, self._second, self._most = ([torch.zeros_like(p) for p in self._parameters] for _ in range(3))
        self._count = torch.zeros_like(self._parameters[0][0])

    @property
    def tables(self) -> list[torch.Tensor]:
        """All that a step changes."""
        return [*self._parameters, *self._first, *self._second, *self._most, self._count]

    def step(self, gradients: Sequence[torch.Tensor]) -> None:
        """One step against these gradients."""
        self._count += 1
        young_1, young_2 = (1 - beta**self._count for beta in (BETA_1, BETA_2))
        rows = zip(self._rates, self._parameters, gradients, self._first, self._second, self._most, strict=True)
        for rate, p, g, first, second, most in rows:
            first.lerp_(g, 1 - BETA_1)
            second.mul_(BETA_2).addcmul_(g, g, value=1 - BETA_2)
            torch.maximum(most, second, out=most)
            p -= rate / young_1 * first / (most.sqrt() / young_2.sqrt() + EPSILON)
