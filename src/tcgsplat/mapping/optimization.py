"""The optimisation of one mapping update: Adam on Eq. 21, over the views of a submap's keyframes.

`AutogradOptimization` works with every rasterizer and setting and is the plain statement of what is done;
`native_optimization.py` does the same by CPU kernels, without autograd, and is held to it by tests.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol, runtime_checkable

import torch

from tcgsplat.confidence import equations as eq
from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.mapping.optimizer import LearningRates, RowAdam
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.losses import color_error, depth_error, isotropy_error, ssim_map
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.repetition import repeat
from tcgsplat.render.view import Rendering, render
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.submap import Submap
from tcgsplat.tensors import PerGaussian, PerGaussianFlag, Pose

Enough = Callable[[int], bool]
"""Whether an optimisation is to end after so many steps, though it could go on."""


def never(_made: int) -> bool:
    """Each step is made."""
    return False


@runtime_checkable
class Optimization(Protocol):
    """A submap while it is optimised: mutable, made for one mapping update, dropped after it."""

    def steps(
        self,
        views: Sequence[int],
        frozen: tuple[str, ...] = (),
        paces: Sequence[float] | None = None,
        enough: Enough = never,
    ) -> None:
        """At one keyframe after the other follow the gradient of Eq. 21 by one Adam step of every Gaussian in view.

        Parameters named in `frozen` stay; `paces` are factors on the learning rates, one for each step. After each
        step `enough` is told how many these were, and if it says so no other is made; where they are launched as a
        whole, all are.
        """
        ...

    def prune(self) -> None:
        """Drop the Gaussians that have become fainter than `min_opacity`."""
        ...

    @property
    def loss(self) -> float:
        """Eq. 21 before the last step."""
        ...

    def submap(self) -> Submap:
        """The submap as it is now, a value that later steps leave alone."""
        ...

    def self_distance(self) -> PerGaussian:
        """How far each Gaussian of the submap has moved since the beginning (Eq. 8), metres."""
        ...


def begin(submap: Submap, config: MapperConfig, confidence: ConfidenceConfig, rasterizer: Rasterizer) -> Optimization:
    """The fastest optimisation that the rasterizer and the settings allow."""
    if rasterizer.name == "numba":  # what knows numba takes its time to import
        from tcgsplat.mapping.native_optimization import NativeOptimization, covers  # noqa: PLC0415
        from tcgsplat.render.numba_cpu.rasterizer import NumbaRasterizer  # noqa: PLC0415

        if isinstance(rasterizer, NumbaRasterizer) and covers(submap, config, confidence):
            return NativeOptimization(submap, config, confidence, rasterizer.passes)
    return AutogradOptimization(submap, config, confidence, rasterizer)


class AutogradOptimization:
    """By torch, through any rasterizer."""

    def __init__(
        self, submap: Submap, config: MapperConfig, confidence: ConfidenceConfig, rasterizer: Rasterizer
    ) -> None:
        self._config, self._confidence, self._rasterizer = config, confidence, rasterizer
        self._submap = submap.to(rasterizer.device)
        self._before = self._submap.gaussians
        self._adam = _row_adam(self._before, config.rates)
        self._loss_value = torch.zeros((), dtype=torch.float64, device=rasterizer.device)

    def steps(
        self,
        views: Sequence[int],
        frozen: tuple[str, ...] = (),
        paces: Sequence[float] | None = None,
        enough: Enough = never,  # noqa: ARG002  all are launched as a whole
    ) -> None:
        """See `Optimization`; all keyframes have the first one's camera."""
        keyframes, device = self._submap.keyframes, self._rasterizer.device
        poses = torch.stack([se3.inverse(keyframes[view].T_map_cam) for view in views])
        pace = torch.ones(len(views)) if paces is None else torch.tensor(paces, dtype=torch.float32)
        poses, pace = (table.to(device, non_blocking=True) for table in (poses, pace))

        def given(k: int) -> tuple[torch.Tensor, ...]:
            frame = keyframes[views[k]].to(device).balanced
            return frame.color, frame.depth, frame.valid, poses[k], pace[k]

        def step(
            color: torch.Tensor, depth: torch.Tensor, valid: torch.Tensor, T_cam_map: Pose, pace: torch.Tensor
        ) -> None:
            frame = Frame(0, 0.0, color, depth, valid, keyframes[0].frame.camera)
            self._step(frame, T_cam_map, frozen, pace)

        repeat(self._rasterizer, step, given, len(views), [*self._adam.tables, self._loss_value])

    def _step(self, frame: Frame, T_cam_map: Pose, frozen: tuple[str, ...], pace: torch.Tensor) -> None:
        gaussians = self._adam.gaussians
        rendering = render(gaussians, self._submap.confidence.value, frame.camera, T_cam_map, self._rasterizer)
        loss = self._loss(rendering, frame, gaussians, self._before, self._submap)
        scale, literal = self._step_scale(self._submap), self._confidence.step_scale_mode == "gradient"
        self._adam.step(
            loss,
            visible=rendering.visible,
            frozen=frozen,
            pace=pace,
            gradient_scale=scale if literal else None,
            step_scale=None if literal else scale,
        )
        self._loss_value.copy_(loss.detach())

    def prune(self) -> None:
        """See `Optimization`."""
        keep = self._adam.detached().opacities >= self._config.min_opacity
        self._submap, self._before = self._submap.kept(keep), self._before.kept(keep)
        self._adam = self._adam.kept(keep)

    @property
    def loss(self) -> float:
        """See `Optimization`."""
        return float(self._loss_value)

    def submap(self) -> Submap:
        """See `Optimization`."""
        return replace(self._submap, gaussians=self._adam.detached())

    def self_distance(self) -> PerGaussian:
        """See `Optimization`."""
        return self_distance(self._adam.detached(), self._before, self._confidence)

    def _loss(
        self, rendering: Rendering, frame: Frame, gaussians: Gaussians, before: Gaussians, submap: Submap
    ) -> torch.Tensor:
        """Eq. 21; means over valid pixels, as the base system takes them."""
        config, guided = self._config, self._confidence.guide_mapping
        measured = frame.valid & (frame.depth > 0)
        pixels = measured.sum().clamp_min(1).double()  # of the loss's device, which is not asked for it
        weight = eq.mapping_weight(rendering.confidence, doubt=self._confidence.doubt_weight if guided else 0.0)
        # Where the picture saw nothing, the rendering is compared with itself, so that no window sees a false edge.
        seen = torch.where(frame.valid[..., None], rendering.color, frame.color)
        return eq.mapping_loss(
            weight,
            color_error(rendering.color, frame.color) * measured,
            depth_error(rendering.depth_as(config.depth_mode), frame.depth) * measured,
            1.0 - ssim_map(seen, frame.color).mean(),
            isotropy_error(gaussians.scales) if config.isotropy_weight > 0 else torch.zeros(()),
            self._stability(gaussians, before, submap, rendering.visible) if guided else torch.zeros(()),
            color_weight=torch.full_like(pixels, config.color_weight) / pixels,
            depth_weight=torch.full_like(pixels, config.depth_weight) / pixels,
            ssim_weight=config.ssim_weight,
            regularization_weight=config.isotropy_weight,
        )

    def _stability(
        self, gaussians: Gaussians, before: Gaussians, submap: Submap, visible: PerGaussianFlag
    ) -> torch.Tensor:
        """Eq. 23 over the visible Gaussians that existed before this update and have a baseline."""
        config, state = self._confidence, submap.confidence
        counted = visible & (state.born < submap.clock) & state.has_baseline
        maturity = eq.maturity(state.value, submap.clock - state.born, maturity_time=config.maturity_time)
        # A Gaussian that has not used up its slack adds nothing, neither loss nor gradient, and most have not: only
        # the others are differentiated.
        with torch.no_grad():
            change = self_distance(gaussians, before, config) - state.baseline
            allowed = eq.allowed_change(maturity, slack_min=config.slack_min, slack_max=config.slack_max)
            over = counted & (change > allowed)
        # A device would be waited for until it had counted them: there all are differentiated.
        rows = over.nonzero().flatten() if over.is_cpu else slice(None)
        loss = eq.stability_loss(
            eq.abnormal_change(
                self_distance(gaussians.picked(rows), before.picked(rows), config), state.baseline[rows]
            ),
            maturity[rows],
            counted[rows],
            weight=config.stability_weight,
            slack_min=config.slack_min,
            slack_max=config.slack_max,
            reduction="sum",
        )
        return loss / counted.sum().clamp_min(1) if config.stability_reduction == "mean" else loss

    def _step_scale(self, submap: Submap) -> PerGaussian | None:
        """Eq. 24, or nothing where confidence does not guide mapping."""
        config = self._confidence
        if not config.guide_mapping:
            return None
        return eq.step_scale(
            submap.confidence.value,
            smallest=config.step_scale_min,
            largest=config.step_scale_max,
            p_min=config.p_min,
        )


def _row_adam(gaussians: Gaussians, rates: LearningRates) -> RowAdam:
    """The fastest one where these Gaussians are."""
    if not gaussians.means.is_cuda:
        return RowAdam(gaussians, rates)
    from tcgsplat.mapping.cuda_optimizer import CudaRowAdam, adam_kernels  # noqa: PLC0415  a CPU needs none of it

    return CudaRowAdam(gaussians, rates, adam_kernels(gaussians.means.device))


def self_distance(after: Gaussians, before: Gaussians, config: ConfidenceConfig) -> PerGaussian:
    """How far each Gaussian has moved since `before` (equations 5 to 8); rows must be the same Gaussians, metres."""
    return eq.self_distance(
        eq.mean_change(after.means, before.means),
        eq.scale_change(after.log_scales, before.log_scales),
        eq.rotation_change(after.quats, before.quats),
        scale_weight=config.scale_change_weight,
        rotation_weight=config.rotation_change_weight,
    )
