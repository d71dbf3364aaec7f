"""Settings under a name, and where each of their values comes from: the paper, the base system, or us.

`default` is what we found good on a CPU. `base` is the same program with all guidance by confidence off: the base
system's weighting. The three `paper-...` presets hold what the paper and the base system it builds on (LoopSplat)
publish for a data set. They follow the paper to the letter where our default does not: equation 23 divides by the
number of Gaussians in view, and equation 24 multiplies gradients, although Adam cancels such a factor. What neither
publication states (most constants of confidence, when a frame counts as lost) is ours and marked so.
"""

import difflib
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Literal, cast

from tcgsplat.config import SlamConfig, Value, described, settings, with_settings
from tcgsplat.errors import ConfigError

Origin = Literal["paper", "base", "ours"]


@dataclass(frozen=True)
class Setting:
    """One value of a preset, and where it is from."""

    path: str
    """Dotted, as in `mapper.seeding.opacity`."""
    value: Value
    origin: Origin
    """`paper`: stated in the paper. `base`: LoopSplat's, which the paper builds on. `ours`: stated in neither."""
    reason: str
    """What the value does, or why it is this one; for a published one of the base system, its name there."""


def preset(name: str) -> SlamConfig:
    """The settings of a preset.

    Raises:
        ConfigError: if there is no preset of that name.
    """
    if name not in PRESETS:
        near = difflib.get_close_matches(name, PRESETS, n=1)
        advice = f"did you mean {near[0]}?" if near else f"choose one of {', '.join(PRESETS)}"
        raise ConfigError(f"there is no preset {name}; {advice}")
    return PRESETS[name]()


def origins(name: str) -> tuple[Setting, ...]:
    """Every value of a preset with its origin, in the order of the settings.

    Raises:
        ConfigError: if there is no preset of that name, or a setting's docstring has no mark of its origin.
    """
    config = preset(name)
    own = {setting.path: setting for setting in _CHANGES.get(name, ())}
    texts = described(config)
    return tuple(own.get(path) or _marked(path, value, texts[path]) for path, value in settings(config).items())


def _marked(path: str, value: Value, text: str) -> Setting:
    """A setting at its default; the first `[paper]`, `[base]` or `[ours]` in its docstring is the default's origin."""
    mark = re.search(r"\s*\[(paper|base|ours)(?:: [^\]]*)?\]", text)
    if mark is None:
        raise ConfigError(f"the docstring of {path} does not say where its default is from; mark it [ours]")
    reason = text[: mark.start()] + text[mark.end() :]
    return Setting(path, value, cast(Origin, mark[1]), reason.strip(" ."))


def _changed(changes: Iterable[Setting]) -> SlamConfig:
    return with_settings(SlamConfig(), {setting.path: setting.value for setting in changes})


_UNGUIDED = tuple(
    Setting(f"confidence.{switch}", False, "base", "the base system knows no confidence")
    for switch in ("guide_mapping", "guide_tracking", "rerank_views")
)

_Three = tuple[Value, Value, Value]
"""For Replica, TUM RGB-D, ScanNet."""


def _same(value: Value) -> _Three:
    return value, value, value


_STEPS = "for mapping updates of 100 steps: "
_PUBLISHED: tuple[tuple[str, _Three, Origin, str], ...] = (
    ("tracker.solver", _same("descent"), "paper", "Section 3.3 moves the camera by gradients through the rasterizer"),
    ("tracker.synchronization", _same("none"), "base", "the base system takes both images for one instant"),
    ("tracker.smoothing", _same(False), "base", "the base system takes depth as it comes"),
    ("tracker.exposure", _same(False), "ours", "the paper maps pictures as they come"),
    ("tracker.view_distance", _same(0.0), "base", "of no use to descent, which renders in every iteration"),
    ("tracker.view_angle", _same(0.0), "base", "as view_distance"),
    ("tracker.descent.iterations", (60, 200, 200), "base", "the base system doubles them for a bad start; we do not"),
    ("tracker.descent.rotation_rate", (0.0002, 0.002, 0.002), "base", "cam_rot_lr"),
    ("tracker.descent.translation_rate", (0.002, 0.01, 0.01), "base", "cam_trans_lr"),
    ("tracker.descent.color_weight", (0.95, 0.6, 0.6), "base", "w_color_loss: lambda_c of equation 19"),
    ("tracker.descent.depth_mode", _same("composited"), "paper", "depth as equation 17 composites it, not divided"),
    ("tracker.descent.soft_alpha", _same(True), "base", "soft_alpha"),
    ("tracker.descent.min_alpha", (0.0, 0.0, 0.98), "base", "alpha_thre where filter_alpha is on"),
    ("tracker.descent.outlier_factor", (50.0, 0.0, 50.0), "base", "filter_outlier_depth: 50 medians"),
    ("tracker.descent.mask_color", (False, True, True), "base", "mask_invalid_depth"),
    ("mapper.seeding.recipe", _same("points"), "base", "random pixels, round blobs"),
    ("mapper.seeding.min_alpha", _same(0.6), "base", "alpha_thre of mapping"),
    ("mapper.seeding.opacity", _same(0.5), "base", "of a seed"),
    ("mapper.seeding.push_back", _same(0.005), "base", "seeds lie half a percent behind the reading"),
    ("mapper.seeding.behind_medians", _same(40.0), "base", "of the depth error: something new in front"),
    ("mapper.seeding.first_points", (600_000, 100_000, 100_000), "base", "new_submap_points_num"),
    ("mapper.seeding.first_gradient_points", _same(50_000), "base", "new_submap_gradient_points_num"),
    ("mapper.seeding.points", (0, 30_000, 30_000), "base", "new_frame_sample_size; 0 for all"),
    ("mapper.rates.means", _same(1e-4), "base", "metres a step"),
    ("mapper.rates.log_scales", _same(5e-3), "base", "a step"),
    ("mapper.rates.quats", _same(1e-3), "base", "a step"),
    ("mapper.rates.logit_opacities", _same(0.05), "base", "a step"),
    ("mapper.rates.sh", _same(2.5e-3), "base", "a step of the constant harmonic"),
    ("mapper.iterations", _same(100), "base", "iterations of mapping"),
    ("mapper.first_iterations", (1000, 100, 100), "base", "new_submap_iterations"),
    ("mapper.current_share", _same(0.4), "base", "current_view_opt_iterations"),
    ("mapper.color_weight", _same(0.8), "base", "lambda_c of equation 21"),
    ("mapper.depth_weight", _same(1.0), "base", "lambda_d of equation 21, per metre"),
    ("mapper.ssim_weight", _same(0.2), "base", "lambda_s of equation 21"),
    ("mapper.isotropy_weight", _same(1.0), "base", "lambda_r of equation 21, per metre"),
    ("mapper.depth_mode", _same("composited"), "paper", "depth as equation 17 composites it, not divided"),
    ("mapper.min_opacity", (0.1, 0.5, 0.5), "base", "pruning_thre"),
    ("mapper.frozen_color_share", _same(0.5), "base", "colour stands still until the pruning halfway"),
    ("mapper.max_keyframes", _same(0), "base", "every mapped frame of a submap stays"),
    ("mapper.max_gpu_memory", _same(0.0), "base", "no limit"),
    ("mapper.complete", _same(False), "base", "what was not measured stays open"),
    ("mapper.sh_degree", _same(0), "base", "colour does not depend on the view"),
    ("schedule.map_every", (5, 1, 1), "base", "map_every"),
    ("schedule.map_lag", _same(0), "paper", "tracking waits for mapping"),
    ("schedule.submap_by", ("motion", "motion", "interval"), "paper", "Section 4.1"),
    ("schedule.submap_distance", _same(0.5), "paper", "metres; Section 4.1"),
    ("schedule.submap_angle", _same(50.0), "paper", "degrees; Section 4.1"),
    ("schedule.submap_interval", _same(50), "paper", "frames, on ScanNet; Section 4.1"),
    ("schedule.withhold_every", _same(0), "paper", "every frame may be mapped"),
    ("confidence.model", _same("paper"), "paper", "equations 4 to 16"),
    ("confidence.p_min", _same(0.1), "ours", "no tracking weight below 0.28, and p spans ten to one"),
    ("confidence.initial", _same(0.3), "ours", "new surface counts half of mature surface in tracking"),
    ("confidence.decay_time", (40.0, 100.0, 100.0), "ours", "updates: about twice those of a submap, 20 on Replica"),
    ("confidence.scale_change_weight", _same(0.02), "ours", "metres: noise of scales weighs as much as of centres"),
    ("confidence.rotation_change_weight", _same(1.0), "ours", "metres: 0.25 mm at rest, 6 mm while turning into place"),
    ("confidence.color_residual_weight", _same(1.0), "ours", "about the balance of the mapping loss"),
    ("confidence.depth_residual_weight", _same(1.0), "ours", "per metre; about the balance of the mapping loss"),
    ("confidence.residual_ref", _same(0.1), "ours", "quality 0.85 on clean data, about half on real data"),
    ("confidence.distance_ref", _same(0.01), "ours", _STEPS + "rest begins with 0.7 of the full excitation"),
    ("confidence.stability_scale", _same(2e-3), "ours", _STEPS + "two standard deviations at rest, metres"),
    ("confidence.excitation_gain", _same(1.0), "ours", "the natural unit, as quality is at most 1"),
    ("confidence.penalty_gain", _same(0.3), "ours", "below the gain, or a Gaussian at rest would sink"),
    ("confidence.update_rate", _same(0.3), "ours", "ten good updates take 0.3 to 0.9"),
    ("confidence.baseline_rate", _same(0.1), "ours", "remembers ten observations"),
    ("confidence.maturity_time", (4.0, 10.0, 10.0), "ours", "updates: two thirds mature after a fifth of a submap"),
    ("confidence.slack_min", _same(2e-3), "ours", _STEPS + "jitter at rest, metres"),
    ("confidence.slack_max", _same(1e-2), "ours", _STEPS + "three times the noise at rest, metres"),
    ("confidence.stability_weight", _same(0.01), "paper", "Section 4.1"),
    ("confidence.stability_reduction", _same("mean"), "paper", "equation 23 to the letter; next to inert"),
    ("confidence.tracking_floor", _same(0.2), "paper", "Section 4.1"),
    ("confidence.view_floor", _same(0.5), "ours", "changes scores by at most a quarter, about their spread"),
    ("confidence.doubt_weight", _same(1.0), "paper", "equation 20: what is doubted weighs twice as much in mapping"),
    ("confidence.step_scale_min", _same(0.8), "paper", "Section 4.1"),
    ("confidence.step_scale_max", _same(1.2), "paper", "Section 4.1"),
    ("confidence.step_scale_mode", _same("gradient"), "paper", "equation 24 to the letter; Adam cancels it"),
    ("confidence.guide_mapping", _same(True), "paper", "equations 20 to 24"),
    ("confidence.guide_tracking", _same(True), "paper", "equation 18"),
    ("confidence.rerank_views", _same(True), "paper", "equation 25"),
    ("loop.enabled", _same(True), "paper", "Section 3.3"),
    ("loop.descriptor", _same("vlad"), "ours", "the base system's NetVLAD needs weights: netvlad:PATH"),
    ("loop.min_similarity", _same(0.5), "base", "min_similarity"),
    ("loop.min_score", _same(1.0), "base", "the rule as it is published"),
    ("loop.min_interval", (2, 3, 4), "base", "min_interval"),
    ("loop.candidates", _same(1000), "base", "all that are similar enough"),
    ("loop.preselected", _same(6), "paper", "Section 4.1"),
    ("loop.views", _same(2), "paper", "Section 4.1"),
    ("seed", (1, 0, 0), "base", "seed"),
)


def _published(dataset: int) -> tuple[Setting, ...]:
    return tuple(Setting(path, values[dataset], origin, reason) for path, values, origin, reason in _PUBLISHED)


_CHANGES: Mapping[str, tuple[Setting, ...]] = MappingProxyType(
    {
        "base": _UNGUIDED,
        "paper-replica": _published(0),
        "paper-tum": _published(1),
        "paper-scannet": _published(2),
    }
)

PRESETS: Mapping[str, Callable[[], SlamConfig]] = MappingProxyType(
    {"default": SlamConfig} | {name: partial(_changed, changes) for name, changes in _CHANGES.items()}
)
"""How to make the settings of each preset, by its name."""

SUMMARIES: Mapping[str, str] = MappingProxyType(
    {
        "default": "good on a CPU: Gauss-Newton tracking, surface discs, few steps a frame",
        "base": "the default without guidance by confidence: the base system's weighting",
        "paper-replica": "the settings published for Replica; hours on a CPU",
        "paper-tum": "the settings published for TUM RGB-D; hours on a CPU",
        "paper-scannet": "the settings published for ScanNet; hours on a CPU",
    }
)
"""Each preset in a line."""
