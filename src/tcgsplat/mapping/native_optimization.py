"""A mapping update's optimisation by CPU kernels, without autograd; see `optimization.py` for what is optimised."""

from collections.abc import Callable, Sequence
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
from tcgsplat.mapping.optimization import Enough, never
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.losses import SSIM_C1, SSIM_C2, ssim_window
from tcgsplat.render.numba_cpu.layout import (
    CHANNELS,
    FEATURE,
    PARAMETERS,
    QUAT,
    Floats,
    aligned,
    from_blocks,
    to_blocks,
)
from tcgsplat.render.numba_cpu.passes import Drawn, Passes, Workspace
from tcgsplat.render.numba_cpu.projection import POSE_SUMS
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.tensors import PerGaussian, PerGaussianFlag

_FAINT = -60.0
"""Logit of an opacity that no rasterizer draws."""
_LANES: Floats = np.arange(16, dtype=np.float32)
_MOST_HELD = 1 << 30
"""Bytes of keyframes held ready; beyond that they are made ready each time, so that memory does not grow with a run."""


def covers(submap: Submap, config: MapperConfig, confidence: ConfidenceConfig) -> bool:
    """Whether the kernels know what these settings and pictures ask for."""
    literal = confidence.guide_mapping and confidence.step_scale_mode == "gradient"
    plain = config.sh_degree == 0 and config.isotropy_weight == 0 and config.frozen_color_share == 0
    cameras = [keyframe.frame.camera for keyframe in submap.keyframes[:1]]  # a run has one camera
    wide = all(camera.width >= loss_kernels.MIN_WIDTH for camera in cameras)
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

    @property
    def size(self) -> int:
        """Bytes."""
        return self.color.nbytes + self.valid.nbytes + self.depth.nbytes


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
        self._parameters = filled(0.0, self._padded // 16, PARAMETERS, 16)
        to_blocks(self._parameters[:, FEATURE + 3 :], submap.confidence.value.numpy()[:, None])
        kernels.activate(_flat(self._raw), _flat(self._parameters), 0, self._padded)
        self._first, self._second = (filled(0.0, *self._raw.shape) for _ in range(2))
        self._clocks = filled(1.0, self._padded // 16, 2, 16)
        self._counted = self._row(0.0, self._has_history())
        self._allowed = self._row(np.inf, self._allowed_distance())
        self._scale = self._row(1.0, self._step_scale())
        self._excess = filled(0.0, self._padded)
        self._rates = _rates(config)
        self._window = ssim_window().numpy()
        self._space = Workspace()

    def steps(
        self,
        views: Sequence[int],
        frozen: tuple[str, ...] = (),
        paces: Sequence[float] | None = None,
        enough: Enough = never,
    ) -> None:
        """See `Optimization`."""
        assert not frozen  # `covers` keeps such settings away
        for made, (view, pace) in enumerate(zip(views, paces or [1.0] * len(views), strict=True), start=1):
            self._step(self._view(view), pace)
            if enough(made):
                break

    def _step(self, target: _View, pace: float) -> None:
        drawn = self._passes.draw(self._parameters, target.camera, target.T_cam_map)
        d_planes = self._differentiated_losses(target, drawn.planes)
        self._stability_weight = self._confidence.stability_weight / self._count(drawn)
        stepped(
            self._passes, self._space, drawn, d_planes, self._raw, self._before, self._first, self._second,
            self._clocks, self._allowed, self._scale, self._constants(pace), self._excess,
        )  # fmt: skip

    def prune(self) -> None:
        """See `Optimization`. Rows stay where they are until the end; a faint one is simply never drawn again."""
        logits = self._raw[:, kernels.LOGIT]
        logits[~(1.0 / (1.0 + np.exp(-logits)) >= self._config.min_opacity)] = _FAINT  # what is not a number goes too
        kernels.activate(_flat(self._raw), _flat(self._parameters), 0, self._padded)

    @property
    def loss(self) -> float:
        """See `Optimization`."""
        return self._reconstruction + self._stability_weight * float(self._excess.sum(dtype=np.float64))

    def submap(self) -> Submap:
        """See `Optimization`."""
        submap, rows = self._submap, self._survivors()
        if len(rows) < len(submap):
            submap = submap.kept(torch.from_numpy(self._survives()))
        return replace(submap, gaussians=_gaussians(self._raw, rows, submap.gaussians))

    def self_distance(self) -> PerGaussian:
        """See `Optimization`."""
        distances: Floats = aligned(self._padded)  # type: ignore[assignment]
        kernels.self_distances(_flat(self._raw), _flat(self._before), self._padded, self._constants(1.0), distances)
        return torch.from_numpy(distances[self._survivors()])

    def _survivors(self) -> npt.NDArray[np.int64]:
        return np.flatnonzero(self._survives())

    def _survives(self) -> npt.NDArray[np.bool_]:
        return self._raw[:, kernels.LOGIT].reshape(-1)[: len(self._submap)] > _FAINT

    def _view(self, index: int) -> _View:
        if index in self._views:
            return self._views[index]
        view = _View(self._submap.keyframes[index])
        if (len(self._views) + 1) * view.size <= _MOST_HELD:
            self._views[index] = view
        return view

    def _differentiated_losses(self, view: _View, planes: Floats) -> Floats:
        """The derivative of Eq. 21 by the images; keeps its value."""
        config, space = self._config, self._space
        _, height, width = planes.shape
        constants = np.array(
            [
                config.color_weight / view.measured, config.depth_weight / view.measured,
                self._confidence.doubt_weight if self._confidence.guide_mapping else 0.0,
                5 if config.depth_mode == "planar" else 4,
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

    def _count(self, drawn: Drawn) -> float:
        """What Eq. 23 divides by."""
        mean = self._confidence.stability_reduction == "mean"
        return max(float(self._counted[drawn.visible].sum(dtype=np.float64)), 1.0) if mean else 1.0

    def _constants(self, pace: float) -> Floats:
        config = self._confidence
        weights = [config.scale_change_weight, config.rotation_change_weight, self._stability_weight]
        return np.concatenate((np.float32(pace) * self._rates, np.array(weights, np.float32)))


def stepped(passes: Passes, space: Workspace, drawn: Drawn, d_planes: Floats, raw: Floats, *adam: Floats) -> None:
    """Differentiate a drawing, and a step of `raw` and of the parameters that were drawn; see `native_kernels.step`.

    `adam` is what the kernel takes from `before` on, but for the depths, which the drawing has.
    """
    pair_sums, threads = passes.pair_sums(drawn, d_planes), passes.workers.threads
    grads, pose = space.floats("grads", threads, kernels.UNIT * PARAMETERS), space.floats("pose", threads, POSE_SUMS)
    before, first, second, clocks, *rows = (_flat(array) for array in adam)
    shared = (
        drawn.padded, _flat(raw), drawn.parameters, before, first, second, clocks, drawn.depths, *rows
    )  # fmt: skip
    passes.stage(
        "step",
        kernels.step,
        lambda worker: (pair_sums, drawn.slot_starts, drawn.camera_vector, grads[worker], pose[worker], *shared),
        drawn.workspace,
    )


def _flat(array: Floats) -> Floats:
    return array.reshape(-1)


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
    """Raw parameters in blocks [blocks, ROWS, 16], from means, quats, log scales, logits and harmonics; what fills the
    last block up is too faint to be drawn.
    """
    blocks, row = filled(1.0, padded // 16, kernels.ROWS, 16), 0
    blocks[-1, kernels.LOGIT] = _FAINT
    for table in tables:
        columns = table.detach().reshape(len(table), -1).numpy()
        to_blocks(blocks[:, row : row + columns.shape[1]], columns)
        row += columns.shape[1]
    return blocks


def _gaussians(blocks: Floats, rows: npt.NDArray[np.int64], template: Gaussians) -> Gaussians:
    """Some of the lanes as Gaussians with the template's ids."""
    table = from_blocks(blocks)
    none_missing = len(rows) == 0 or rows[-1] == len(rows) - 1
    table = table[: len(rows)] if none_missing else table[rows]
    means, quats, log_scales, logits, sh = np.split(table, (QUAT, kernels.LOG_SCALE, kernels.LOGIT, kernels.SH), axis=1)
    return replace(
        template,
        means=torch.from_numpy(means.copy()),
        quats=torch.from_numpy(quats.copy()),
        log_scales=torch.from_numpy(log_scales.copy()),
        logit_opacities=torch.from_numpy(logits[:, 0].copy()),
        sh=torch.from_numpy(sh[:, None].copy()),
    )
