"""A mapping update's optimisation by CPU kernels, without autograd; see `optimization.py` for what is optimised."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch

from tcgsplat.confidence import equations as eq
from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.mapping import native_kernels as kernels
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render import ssim_kernels
from tcgsplat.render.losses import SSIM_C1, SSIM_C2, ssim_window
from tcgsplat.render.numba_cpu.layout import CHANNELS, FEATURE, PARAMETERS, Floats, aligned
from tcgsplat.render.numba_cpu.passes import Passes
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.tensors import PerGaussianFlag

_FAINT = -60.0
"""Logit of an opacity that no rasterizer draws."""


def covers(config: MapperConfig, confidence: ConfidenceConfig) -> bool:
    """Whether the kernels know what these settings ask for."""
    literal = confidence.guide_mapping and confidence.step_scale_mode == "gradient"
    return config.sh_degree == 0 and config.isotropy_weight == 0 and config.frozen_color_share == 0 and not literal


class _View:
    """A keyframe as the kernels read it."""

    def __init__(self, keyframe: Keyframe) -> None:
        frame = keyframe.frame
        self.camera = frame.camera
        self.T_cam_map = se3.inverse(keyframe.T_map_cam).numpy()
        self.color: Floats = np.ascontiguousarray(frame.color.permute(2, 0, 1).numpy())
        self.valid: Floats = frame.valid.numpy().astype(np.float32)
        self.depth: Floats = frame.depth.numpy() * self.valid
        self.measured = max(int((self.depth > 0).sum()), 1)
        self.all_valid = bool(frame.valid.all())


class NativeOptimization:
    """By kernels, on the CPU."""

    def __init__(self, submap: Submap, config: MapperConfig, confidence: ConfidenceConfig, passes: Passes) -> None:
        self._submap, self._config, self._confidence, self._passes = submap, config, confidence, passes
        self._views: dict[int, _View] = {}
        self._reconstruction = self._stability_weight = 0.0
        n = len(submap)
        self._padded = -(-max(n, 1) // 16) * 16
        self._raw = _matrix(submap.gaussians, self._padded)
        self._before = self._raw.copy()
        self._parameters: Floats = aligned((PARAMETERS, self._padded))  # type: ignore[assignment]
        self._parameters[FEATURE + 3] = 0.0
        self._parameters[FEATURE + 3, :n] = submap.confidence.value.numpy()
        kernels.activate(_flat(self._raw), _flat(self._parameters), self._padded, 0, self._padded)
        self._first, self._second = np.zeros_like(self._raw), np.zeros_like(self._raw)
        self._clocks: Floats = np.ones((2, self._padded), np.float32)
        self._counted = self._row(0.0, self._has_history())
        self._allowed = self._row(np.inf, self._allowed_distance())
        self._scale = self._row(1.0, self._step_scale())
        self._excess: Floats = np.zeros(self._padded, np.float32)
        self._rates = _rates(config)

    def step(self, view: int, frozen: tuple[str, ...] = (), pace: float = 1.0) -> None:
        """See `Optimization`."""
        assert not frozen  # `covers` keeps such settings away
        target = self._view(view)
        drawn = self._passes.draw(self._parameters, target.camera, target.T_cam_map)
        d_planes = self._differentiated_losses(target, drawn.planes)
        grads, _ = self._passes.differentiate(drawn, d_planes)
        visible = drawn.visible.astype(np.float32)
        constants = self._constants(visible, pace)
        self._passes._workers.run(
            lambda a, b: kernels.adam_step(
                self._padded, a, b, _flat(self._raw), _flat(self._parameters), _flat(self._before), _flat(self._first),
                _flat(self._second), _flat(self._clocks), _flat(grads), visible, self._allowed, self._scale, constants,
                self._excess,
            ),
            self._passes._workers.cuts(self._padded, 16),
        )  # fmt: skip

    def prune(self) -> None:
        """See `Optimization`. Rows stay where they are until the end; a faint one is simply never drawn again."""
        self._raw[kernels.LOGIT, ~self._kept()] = _FAINT
        kernels.activate(_flat(self._raw), _flat(self._parameters), self._padded, 0, self._padded)

    @property
    def loss(self) -> float:
        """See `Optimization`."""
        return self._reconstruction + self._stability_weight * float(self._excess.sum(dtype=np.float64))

    def submap(self) -> Submap:
        """See `Optimization`."""
        n = len(self._submap)
        alive = torch.from_numpy(self._raw[kernels.LOGIT, :n] > _FAINT)
        return replace(self._submap, gaussians=_gaussians(self._raw[:, :n], self._submap.gaussians)).kept(alive)

    def _kept(self) -> npt.NDArray[np.bool_]:
        opacity = 1.0 / (1.0 + np.exp(-self._raw[kernels.LOGIT]))
        return np.asarray(opacity >= self._config.min_opacity, np.bool_)

    def _view(self, index: int) -> _View:
        if index not in self._views:
            self._views[index] = _View(self._submap.keyframes[index])
        return self._views[index]

    def _differentiated_losses(self, view: _View, planes: Floats) -> Floats:
        """The derivative of Eq. 21 by the images; keeps its value."""
        config, workers = self._config, self._passes._workers
        _, height, width = planes.shape
        window, c1, c2 = ssim_window().numpy(), np.float32(SSIM_C1), np.float32(SSIM_C2)
        shown = planes[:3] if view.all_valid else np.empty((3, height, width), np.float32)
        similarity, by_mean, by_aa, by_ab = np.empty((4, 3, height, width), np.float32)
        upstream = np.full((3, height, width), -config.ssim_weight / (3 * height * width), np.float32)
        d_planes, sums = np.empty((CHANNELS, height, width), np.float32), np.empty(height, np.float32)
        channel = 5 if config.depth_mode == "planar" else 4
        constants = np.array(
            [
                config.color_weight / view.measured, config.depth_weight / view.measured,
                self._confidence.guide_mapping, channel, config.depth_mode != "composited",
            ],
            np.float32,
        )  # fmt: skip
        cuts = workers.cuts(height)
        if not view.all_valid:
            kernels.seen_by_both(0, height, planes, view.color, view.valid, shown)
        workers.run(
            lambda a, b: ssim_kernels.forward(
                shown, view.color, window, c1, c2, a, b, similarity, by_mean, by_aa, by_ab
            ),
            cuts,
        )

        def differentiate(a: int, b: int) -> None:
            ssim_kernels.backward(upstream, shown, view.color, by_mean, by_aa, by_ab, window, a, b, d_planes[:3])  # type: ignore[call-arg]
            kernels.pixel_losses(a, b, planes, view.color, view.depth, view.valid, constants, d_planes, sums)

        workers.run(differentiate, cuts)
        self._reconstruction = float(sums.sum(dtype=np.float64)) + config.ssim_weight * (1.0 - float(similarity.mean()))
        return d_planes

    def _row(self, padding: float, values: torch.Tensor | None) -> Floats:
        """A value for each Gaussian, padded; all padding where there are none."""
        row: Floats = np.full(self._padded, padding, np.float32)
        if values is not None:
            row[: len(values)] = values.numpy()
        return row

    def _has_history(self) -> PerGaussianFlag:
        """What Eq. 23 counts, where it is in view."""
        state = self._submap.confidence
        return (state.born < self._submap.clock) & state.has_baseline

    def _allowed_distance(self) -> torch.Tensor | None:
        """Self-distance up to which Eq. 23 costs nothing: the baseline and the slack."""
        config, state = self._confidence, self._submap.confidence
        if not config.guide_mapping:
            return None
        maturity = eq.maturity(state.value, self._submap.clock - state.born, maturity_time=config.maturity_time)
        slack = eq.allowed_change(maturity, slack_min=config.slack_min, slack_max=config.slack_max)
        return torch.where(self._has_history(), state.baseline + slack, torch.inf)

    def _step_scale(self) -> torch.Tensor | None:
        """Eq. 24."""
        config = self._confidence
        if not config.guide_mapping:
            return None
        return eq.step_scale(
            self._submap.confidence.value,
            smallest=config.step_scale_min,
            largest=config.step_scale_max,
            p_min=config.p_min,
        )

    def _constants(self, visible: Floats, pace: float) -> Floats:
        config = self._confidence
        counted = max(float(visible @ self._counted), 1.0) if config.stability_reduction == "mean" else 1.0
        self._stability_weight = config.stability_weight / counted
        weights = [config.scale_change_weight, config.rotation_change_weight, self._stability_weight]
        return np.concatenate((np.float32(pace) * self._rates, np.array(weights, np.float32)))


def _flat(matrix: Floats) -> Floats:
    return matrix.reshape(-1)


def _rates(config: MapperConfig) -> Floats:
    """Learning rate of every row."""
    rates = config.rates
    per_row = [rates.means] * 3 + [rates.quats] * 4 + [rates.log_scales] * 3 + [rates.logit_opacities] + [rates.sh] * 3
    return np.array(per_row, np.float32)


def _matrix(gaussians: Gaussians, padded: int) -> Floats:
    """Raw parameters as rows; padding is too faint to be drawn."""
    n = len(gaussians)
    matrix: Floats = aligned((kernels.ROWS, padded))  # type: ignore[assignment]
    matrix[:, n:] = 1.0
    matrix[kernels.LOGIT, n:] = _FAINT
    columns = (
        gaussians.means,
        gaussians.quats,
        gaussians.log_scales,
        gaussians.logit_opacities[:, None],
        gaussians.sh[:, 0],
    )
    matrix[:, :n] = torch.cat([column.detach() for column in columns], dim=1).T.numpy()
    return matrix


def _gaussians(matrix: Floats, template: Gaussians) -> Gaussians:
    """Back from rows."""
    table = torch.from_numpy(np.ascontiguousarray(matrix.T))
    means, quats, log_scales, logits, sh = (part.contiguous() for part in torch.split(table, [3, 4, 3, 1, 3], dim=1))
    return replace(
        template, means=means, quats=quats, log_scales=log_scales, logit_opacities=logits[:, 0], sh=sh[:, None]
    )
