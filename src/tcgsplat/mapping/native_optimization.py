"""A mapping update's optimisation by CPU kernels, without autograd; see `optimization.py` for what is optimised."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt
import torch

from tcgsplat.confidence import equations as eq
from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.mapping import loss_kernels
from tcgsplat.mapping import native_kernels as kernels
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.losses import SSIM_C1, SSIM_C2, ssim_window
from tcgsplat.render.numba_cpu.layout import CHANNELS, FEATURE, PARAMETERS, Floats, aligned
from tcgsplat.render.numba_cpu.passes import Passes, Workspace
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.tensors import PerGaussian, PerGaussianFlag

_FAINT = -60.0
"""Logit of an opacity that no rasterizer draws."""
_LANES: Floats = np.arange(16, dtype=np.float32)


def covers(submap: Submap, config: MapperConfig, confidence: ConfidenceConfig) -> bool:
    """Whether the kernels know what these settings and pictures ask for."""
    literal = confidence.guide_mapping and confidence.step_scale_mode == "gradient"
    plain = config.sh_degree == 0 and config.isotropy_weight == 0 and config.frozen_color_share == 0
    wide = all(keyframe.frame.camera.width >= loss_kernels.MIN_WIDTH for keyframe in submap.keyframes)
    return plain and wide and not literal


class _View:
    """A keyframe as the kernels read it."""

    def __init__(self, keyframe: Keyframe) -> None:
        frame = keyframe.balanced
        self.camera = frame.camera
        self.T_cam_map = se3.inverse(keyframe.T_map_cam).numpy()
        self.color: Floats = np.ascontiguousarray(frame.color.permute(2, 0, 1).numpy())
        self.valid: Floats = frame.valid.numpy().astype(np.float32)
        self.depth: Floats = frame.depth.numpy() * self.valid
        self.measured = max(int((self.depth > 0).sum()), 1)


class NativeOptimization:
    """By kernels, on the CPU."""

    def __init__(self, submap: Submap, config: MapperConfig, confidence: ConfidenceConfig, passes: Passes) -> None:
        self._submap, self._config, self._confidence, self._passes = submap, config, confidence, passes
        self._views: dict[int, _View] = {}
        self._reconstruction = self._stability_weight = 0.0
        n = len(submap)
        self._padded = -(-max(n, 1) // 16) * 16
        g = submap.gaussians
        self._raw = packed(self._padded, g.means, g.quats, g.log_scales, g.logit_opacities, g.sh)
        self._before = filled(0.0, *self._raw.shape)
        self._before[:] = self._raw
        self._parameters: Floats = aligned((PARAMETERS, self._padded))  # type: ignore[assignment]
        self._parameters[FEATURE + 3] = 0.0
        self._parameters[FEATURE + 3, :n] = submap.confidence.value.numpy()
        kernels.activate(_flat(self._raw), _flat(self._parameters), self._padded, 0, self._padded)
        self._first, self._second = (filled(0.0, *self._raw.shape) for _ in range(2))
        self._clocks = filled(1.0, 2, self._padded)
        self._counted = self._row(0.0, self._has_history())
        self._allowed = self._row(np.inf, self._allowed_distance())
        self._scale = self._row(1.0, self._step_scale())
        self._excess = filled(0.0, self._padded)
        self._visible = filled(0.0, self._padded)
        self._rates = _rates(config)
        self._window = ssim_window().numpy()
        self._space = Workspace()

    def step(self, view: int, frozen: tuple[str, ...] = (), pace: float = 1.0) -> None:
        """See `Optimization`."""
        assert not frozen  # `covers` keeps such settings away
        target = self._view(view)
        drawn = self._passes.draw(self._parameters, target.camera, target.T_cam_map)
        d_planes = self._differentiated_losses(target, drawn.planes)
        grads, _ = self._passes.differentiate(drawn, d_planes, self._space.floats("grads", PARAMETERS, self._padded))
        self._visible[:] = drawn.visible
        self._stability_weight = self._confidence.stability_weight / self._count()
        arrays = (
            self._padded, _flat(self._raw), _flat(self._parameters), _flat(self._before), _flat(self._first),
            _flat(self._second), _flat(self._clocks), _flat(grads), self._visible, self._allowed, self._scale,
            self._constants(pace), self._excess,
        )  # fmt: skip
        self._share(kernels.adam_step, 1, lambda _: arrays)

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
        submap, rows = self._submap, self._survivors()
        if len(rows) < len(submap):
            submap = submap.kept(torch.from_numpy(self._raw[kernels.LOGIT, : len(submap)] > _FAINT))
        return replace(submap, gaussians=_gaussians(self._raw, rows, submap.gaussians))

    def self_distance(self) -> PerGaussian:
        """See `Optimization`."""
        distances: Floats = aligned(self._padded)  # type: ignore[assignment]
        kernels.self_distances(_flat(self._raw), _flat(self._before), self._padded, self._constants(1.0), distances)
        return torch.from_numpy(distances[self._survivors()])

    def _survivors(self) -> npt.NDArray[np.int64]:
        return np.flatnonzero(self._raw[kernels.LOGIT, : len(self._submap)] > _FAINT)

    def _kept(self) -> npt.NDArray[np.bool_]:
        opacity = 1.0 / (1.0 + np.exp(-self._raw[kernels.LOGIT]))
        return np.asarray(opacity >= self._config.min_opacity, np.bool_)

    def _view(self, index: int) -> _View:
        if index not in self._views:
            self._views[index] = _View(self._submap.keyframes[index])
        return self._views[index]

    def _differentiated_losses(self, view: _View, planes: Floats) -> Floats:
        """The derivative of Eq. 21 by the images; keeps its value."""
        config, space = self._config, self._space
        _, height, width = planes.shape
        constants = np.array(
            [
                config.color_weight / view.measured, config.depth_weight / view.measured,
                self._confidence.guide_mapping, 5 if config.depth_mode == "planar" else 4,
                config.depth_mode != "composited", -config.ssim_weight / (3 * height * width), SSIM_C1, SSIM_C2,
            ],
            np.float32,
        )  # fmt: skip
        threads, pixels = self._passes.workers.threads, height * width
        d_planes, sums = space.floats("d_planes", CHANNELS, height, width), space.floats("sums", 2, height)
        lines = space.floats("lines", threads, loss_kernels.LINES * (width + 2 * loss_kernels.MARGIN))
        lines[:] = 0.0
        rows, partials = space.floats("rows", 3 * loss_kernels.LINES * pixels), space.floats("partials", 9 * pixels)
        images = (_flat(planes), _flat(view.color), _flat(view.depth), _flat(view.valid))
        self._share(
            loss_kernels.differentiate_losses,
            loss_kernels.PHASES,
            lambda worker: (
                width, height, *images, self._window, _LANES, constants, lines[worker], rows, partials,
                _flat(d_planes), sums,
            ),
        )  # fmt: skip
        similarity, reconstruction = (float(total) for total in sums.sum(axis=1, dtype=np.float64))
        self._reconstruction = reconstruction + config.ssim_weight * (1.0 - similarity / (3 * pixels))
        return d_planes

    def _share(self, kernel: Callable[..., bool], phases: int, arguments: Callable[[int], tuple[object, ...]]) -> None:
        """A kernel on all threads; `arguments` are those of each worker."""
        self._passes.workers.share(partial(kernel, self._space.progress(phases)), arguments)

    def _row(self, padding: float, values: torch.Tensor | None) -> Floats:
        """A value for each Gaussian, padded; all padding where there are none."""
        row = filled(padding, self._padded)
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

    def _count(self) -> float:
        """What Eq. 23 divides by."""
        mean = self._confidence.stability_reduction == "mean"
        return max(float(self._visible @ self._counted), 1.0) if mean else 1.0

    def _constants(self, pace: float) -> Floats:
        config = self._confidence
        weights = [config.scale_change_weight, config.rotation_change_weight, self._stability_weight]
        return np.concatenate((np.float32(pace) * self._rates, np.array(weights, np.float32)))


def _flat(matrix: Floats) -> Floats:
    return matrix.reshape(-1)


def filled(value: float, *shape: int) -> Floats:
    """An array whose vectors do not straddle cache lines: an unaligned one takes Adam half as long again."""
    array: Floats = aligned(shape)  # type: ignore[assignment]
    array[...] = value
    return array


def _rates(config: MapperConfig) -> Floats:
    """Learning rate of every row."""
    rates = config.rates
    per_row = [rates.means] * 3 + [rates.quats] * 4 + [rates.log_scales] * 3 + [rates.logit_opacities] + [rates.sh] * 3
    return np.array(per_row, np.float32)


def packed(padded: int, *tables: torch.Tensor) -> Floats:
    """Raw parameters as rows [ROWS, padded], from means, quats, log scales, logits and harmonics; padding is too faint
    to be drawn.
    """
    matrix = filled(1.0, kernels.ROWS, padded)
    matrix[kernels.LOGIT] = _FAINT
    kernels.pack(*(np.ascontiguousarray(table.detach().numpy()) for table in tables), matrix)
    return matrix


def _gaussians(matrix: Floats, rows: npt.NDArray[np.int64], template: Gaussians) -> Gaussians:
    """Some of the columns as Gaussians with the template's ids."""
    n = len(rows)
    means, quats, log_scales = (np.empty((n, width), np.float32) for width in (3, 4, 3))
    logits, sh = np.empty(n, np.float32), np.empty((n, 1, 3), np.float32)
    kernels.unpack(matrix, rows, means, quats, log_scales, logits, sh)
    return replace(
        template,
        means=torch.from_numpy(means),
        quats=torch.from_numpy(quats),
        log_scales=torch.from_numpy(log_scales),
        logit_opacities=torch.from_numpy(logits),
        sh=torch.from_numpy(sh),
    )
