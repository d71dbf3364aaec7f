"""Mapping: grow the submap where a frame shows something new, then optimise it over its keyframes (Eqs. 20 to 24)."""

from dataclasses import dataclass, field, replace

import torch

from tcgsplat.confidence import equations as eq
from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.errors import ConfigError
from tcgsplat.geometry import se3
from tcgsplat.mapping.keyframes import thinned
from tcgsplat.mapping.optimizer import LearningRates, RowAdam
from tcgsplat.mapping.seeding import IdSource, SeedingConfig, seed
from tcgsplat.render.losses import color_error, depth_error, isotropy_error, ssim_map
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import DepthMode, Rendering, render, render_view
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.tensors import PerGaussian, PerGaussianFlag, Pose


@dataclass(frozen=True)
class MapperConfig:
    """Losses and effort of mapping."""

    seeding: SeedingConfig = field(default_factory=SeedingConfig)
    rates: LearningRates = field(default_factory=LearningRates)
    iterations: int = 10
    """Adam steps a mapping update. [ours] (base: 100)"""
    first_iterations: int = 20
    """Adam steps of a submap's first mapping update. [ours] (base: 100 on TUM, 1000 on Replica)"""
    current_share: float = 0.4
    """Share of the steps that look at the current frame; the others draw evenly from the older keyframes. [base]"""
    color_weight: float = 0.8
    """lambda_c of Eq. 21, on the mean over valid pixels. [base]"""
    depth_weight: float = 1.0
    """lambda_d of Eq. 21, per metre, on the mean over valid pixels. [base]"""
    ssim_weight: float = 0.2
    """lambda_s of Eq. 21. [base]"""
    isotropy_weight: float = 0.0
    """lambda_r of Eq. 21, per metre. [ours]: discs are meant to be flat (base: 1)"""
    depth_mode: DepthMode = "planar"
    """The depth that is compared with the sensor. [ours] (base: composited)"""
    min_opacity: float = 0.1
    """Gaussians that become fainter are dropped. [base: Replica] (base: 0.5 on TUM and ScanNet)"""
    frozen_color_share: float = 0.0
    """Share of the steps, from the first one, that leave colour alone. [ours] (base: 0.5)"""
    max_keyframes: int = 40
    """Keyframes that a submap keeps; redundant ones go first; 0 for all. Bounds memory and the share of old views
    while the camera stays within one submap. [ours] (base: all)"""
    sh_degree: int = 0
    """Degree of the colour's spherical harmonics, 0 to 3. [base]"""

    def __post_init__(self) -> None:
        if not 0 <= self.sh_degree <= 3:
            raise ConfigError(f"mapper.sh_degree is {self.sh_degree!r}; it must be 0, 1, 2 or 3")
        if self.iterations < 1 or self.first_iterations < 1:
            raise ConfigError("mapper.iterations and mapper.first_iterations must be at least 1")
        for name in ("current_share", "min_opacity", "frozen_color_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"mapper.{name} is {getattr(self, name)!r}; it must be between 0 and 1")
        for name in ("color_weight", "depth_weight", "ssim_weight", "isotropy_weight", "max_keyframes"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"mapper.{name} is {getattr(self, name)!r}; it must be at least 0")


@dataclass(frozen=True)
class Mapped:
    """What one mapping update did."""

    before: Gaussians
    """The Gaussians after seeding, before the first step."""
    submap: Submap
    """Optimised and pruned, with the frame as its newest keyframe; confidence not yet judged."""
    rendering: Rendering
    """The frame's view of the optimised submap."""
    seeded: int
    pruned: int
    loss: float
    """Eq. 21 at the last step."""


class Mapper:
    """Grows and optimises the active submap. Keeps nothing between updates but its source of ids and randomness."""

    def __init__(
        self,
        config: MapperConfig,
        confidence: ConfidenceConfig,
        rasterizer: Rasterizer,
        ids: IdSource,
        generator: torch.Generator,
    ) -> None:
        self._config = config
        self._confidence = confidence
        self._rasterizer = rasterizer
        self._ids = ids
        self._generator = generator

    def map(self, frame: Frame, T_map_cam: Pose, submap: Submap) -> Mapped:
        """One mapping update with `frame` at `T_map_cam`."""
        config = self._config
        first = not submap.keyframes
        rendering = None if first else render_view(submap, frame.camera, T_map_cam, self._rasterizer)
        seeds = seed(frame, T_map_cam, rendering, submap.gaussians, self._ids, self._generator, config.seeding)
        keyframes = thinned((*submap.keyframes, Keyframe(frame, T_map_cam)), config.max_keyframes)
        grown = replace(submap.grown(seeds, self._confidence), keyframes=keyframes)

        iterations = config.first_iterations if first else config.iterations
        optimized, loss = self._optimized(grown, iterations)
        return Mapped(
            before=grown.gaussians,
            submap=optimized,
            rendering=render_view(optimized, frame.camera, T_map_cam, self._rasterizer),
            seeded=len(seeds),
            pruned=len(grown) - len(optimized),
            loss=loss,
        )

    def _optimized(self, submap: Submap, iterations: int) -> tuple[Submap, float]:
        """Adam over drawn keyframes; faint Gaussians are dropped halfway and at the end."""
        before, loss = submap.gaussians, torch.zeros(())
        adam, scale = RowAdam(submap.gaussians, self._config.rates), self._step_scale(submap)
        literal = self._confidence.step_scale_mode == "gradient"
        T_cam_map = [se3.inverse(keyframe.T_map_cam) for keyframe in submap.keyframes]
        for iteration in range(iterations):
            if iteration == iterations // 2 and iteration > 0:
                keep = adam.detached().opacities >= self._config.min_opacity
                submap, before, adam = submap.kept(keep), before.kept(keep), adam.kept(keep)
                scale = self._step_scale(submap)
            view = self._drawn_view(len(submap.keyframes))
            frame, gaussians = submap.keyframes[view].frame, adam.gaussians
            rendering = render(gaussians, submap.confidence.value, frame.camera, T_cam_map[view], self._rasterizer)
            loss = self._loss(rendering, frame, gaussians, before, submap)
            adam.step(
                loss,
                frozen=("sh",) if iteration < self._config.frozen_color_share * iterations else (),
                gradient_scale=scale if literal else None,
                step_scale=None if literal else scale,
            )
        optimized = adam.detached()
        keep = optimized.opacities >= self._config.min_opacity
        return replace(submap, gaussians=optimized).kept(keep), float(loss.detach())

    def _drawn_view(self, count: int) -> int:
        """The newest keyframe with probability `current_share`, else any older one."""
        if count == 1 or float(torch.rand((), generator=self._generator)) < self._config.current_share:
            return count - 1
        return int(torch.randint(count - 1, (), generator=self._generator))

    def _loss(
        self, rendering: Rendering, frame: Frame, gaussians: Gaussians, before: Gaussians, submap: Submap
    ) -> torch.Tensor:
        """Eq. 21; means over valid pixels, as the base system takes them."""
        config, guided = self._config, self._confidence.guide_mapping
        measured = frame.valid & (frame.depth > 0)
        pixels = max(int(measured.sum()), 1)
        weight = eq.mapping_weight(rendering.confidence) if guided else torch.ones_like(rendering.alpha)
        # Where the picture saw nothing, the rendering is compared with itself, so that no window sees a false edge.
        seen = torch.where(frame.valid[..., None], rendering.color, frame.color)
        return eq.mapping_loss(
            weight,
            color_error(rendering.color, frame.color) * measured,
            depth_error(rendering.depth_as(config.depth_mode), frame.depth) * measured,
            1.0 - ssim_map(seen, frame.color).mean(),
            isotropy_error(gaussians.scales) if config.isotropy_weight > 0 else torch.zeros(()),
            self._stability(gaussians, before, submap, rendering.visible) if guided else torch.zeros(()),
            color_weight=config.color_weight / pixels,
            depth_weight=config.depth_weight / pixels,
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
            rows = (counted & (change > allowed)).nonzero().flatten()
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


def self_distance(after: Gaussians, before: Gaussians, config: ConfidenceConfig) -> PerGaussian:
    """How far each Gaussian has moved since `before` (equations 5 to 8); rows must be the same Gaussians, metres."""
    return eq.self_distance(
        eq.mean_change(after.means, before.means),
        eq.scale_change(after.log_scales, before.log_scales),
        eq.rotation_change(after.quats, before.quats),
        scale_weight=config.scale_change_weight,
        rotation_weight=config.rotation_change_weight,
    )
