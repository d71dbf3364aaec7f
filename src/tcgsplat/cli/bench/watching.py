"""Watching a run: what its map claims of frames that it has not used yet, held against what is true of them."""

import json
import math
import statistics
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from tcgsplat.config import SlamConfig
from tcgsplat.datasets.truth import Event, Truth
from tcgsplat.evaluation.crossing import Look
from tcgsplat.evaluation.prediction import OURS, FaultTold, Judged, Seen, claim, of_color, of_depth, of_fault, seen
from tcgsplat.evaluation.uncertainty import Reliability, Scores, Sparsification, Values, calibrated, reliability
from tcgsplat.geometry import se3
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import Rendering, render_view
from tcgsplat.scene.frame import Frame
from tcgsplat.slam import Reference, StepReport
from tcgsplat.storage import atomic
from tcgsplat.tensors import Mask, Plane, Pose

ENOUGH: Final = 50
"""Pixels that a fault must have in a picture to be looked for."""
_PAIRS: Final = 2000
"""Of doubt and error, at most, that are kept of a run."""
_STEPS: Final = 4
"""Decimals of a curve that is kept, which is relative to the error of all pixels."""
_DIGITS: Final = 6
"""Significant ones of a pair that is kept."""


@dataclass
class Predictions:
    """What was claimed of the frames of one way through a sequence, and how it turned out."""

    depth: list[Judged] = field(default_factory=list)
    color: list[Judged] = field(default_factory=list)
    mean: dict[int, float] = field(default_factory=dict)
    """Rendered confidence over opacity, by frame index: mean over what is mapped, once the frame has been used."""
    regional: dict[Event, dict[int, float]] = field(default_factory=dict)
    """The same over the region that an event is about."""
    faults: list[FaultTold] = field(default_factory=list)
    """How well doubt tells a known fault, once the frame has been used."""
    looks: list[Look] = field(default_factory=list)
    """Where somebody walks about."""

    @property
    def fault_auroc(self) -> float | None:
        """Mean over the frames of `FaultTold.in_picture`; None where no fault is known."""
        return _mean(one.in_picture for one in self.faults)

    @property
    def fault_auroc_in_map(self) -> float | None:
        """The same of `FaultTold.in_map`."""
        return _mean(one.in_map for one in self.faults)


def _mean(values: Iterable[float]) -> float | None:
    finite = [value for value in values if math.isfinite(value)]
    return statistics.fmean(finite) if finite else None


class Observer:
    """Predicts every so many-th frame of a run from what the system knew before the frame came.

    It only reads: a run that is watched goes the same way, and leaves the same map, as one that is not.
    """

    def __init__(
        self,
        truth: Truth,
        config: SlamConfig,
        rasterizer: Rasterizer,
        every: int,
        *,
        color: bool = True,
        measures: Collection[str] | None = None,
    ) -> None:
        """An observer that has seen nothing yet.

        Args:
            truth: Of the sequence.
            config: Of the run.
            rasterizer: Backend of the predictions.
            every: Predict every so many-th frame.
            color: Whether colour is held against the picture too.
            measures: Of doubt, those that are scored; without, all. Scoring a measure costs as much as drawing a view.
        """
        self.found = Predictions()
        self._truth, self._config, self._rasterizer, self._every = truth, config, rasterizer, every
        self._color, self._measures = color, measures
        self._rng = np.random.default_rng(config.seed)
        self._previous: Seen | None = None
        self._used: tuple[Frame, Plane | None, Mask | None, Pose, int] | None = None
        self._poses = truth.sequence.ground_truth()
        self._regional = [event for event in truth.events if event.region]
        self._crossed = any(event.name == "moving object" for event in truth.events)

    def observe(self, frame: Frame, before: Reference, after: Reference, report: StepReport) -> None:
        """After a step: `before` is what the frame was tracked against, `after` what the next one will be."""
        due = frame.index % self._every == 0 and report.tracked.converged and report.sealed is None
        if not due or not len(before.submap):
            return
        T_map_cam = se3.inverse(before.T_map_reference) @ report.tracked.T_map_cam
        here = before.submap.to(frame.color.device)
        claimed = claim(
            here, frame.camera, T_map_cam, self._rasterizer, self._config.confidence, self._rng, self._previous
        )
        self._previous = seen(claimed, frame.depth, T_map_cam, before.submap.index)
        if self._measures is not None:
            doubt = {name: plane for name, plane in claimed.doubt.items() if name in self._measures}
            claimed = replace(claimed, doubt=doubt)
        true_depth, fault = self._truth.depth(frame.index), self._truth.fault(frame.index)
        right = frame.valid if fault is None else frame.valid & ~fault
        if true_depth is not None:
            self.found.depth.append(of_depth(claimed, true_depth, frame.valid, self._rng))
        if self._crossed and true_depth is not None and fault is not None and frame.index in self._poses:
            trust = torch.where(claimed.rendering.depth > 0, _trust(claimed.rendering), torch.nan)
            look = Look(frame.index, trust, fault, true_depth, frame.camera, self._poses[frame.index])
            self.found.looks.append(look)
        if self._color:
            shown = report.tracked.exposure.applied(before.exposure.applied(claimed.rendering.color))
            self.found.color.append(of_color(claimed, shown.clamp(0, 1), frame.color, right, self._rng))
        if self._used is not None and self._used[-1] == after.submap.index:
            self._follow(after, *self._used[:-1])
        T_after_cam = se3.inverse(after.T_map_reference) @ report.tracked.T_map_cam
        self._used = frame, true_depth, fault, T_after_cam, after.submap.index

    def _follow(
        self, after: Reference, frame: Frame, true_depth: Plane | None, fault: Mask | None, T_map_cam: Pose
    ) -> None:
        """What the map says of an earlier view, whose frame it has used by now."""
        submap = after.submap.to(frame.color.device)
        rendering = render_view(submap, frame.camera, T_map_cam, self._rasterizer)
        mapped, trust = rendering.depth > 0, _trust(rendering)
        if not bool(mapped.any()):
            return
        self.found.mean[frame.index] = float(trust[mapped].mean())
        if true_depth is None:
            return
        if fault is not None and int((fault & mapped).sum()) >= ENOUGH:
            self.found.faults.append(of_fault(rendering, true_depth, fault))
        if self._regional and frame.index in self._poses:
            points = (frame.camera.rays() * true_depth[..., None]).reshape(-1, 3)
            points = se3.transform(self._poses[frame.index], points).reshape(*true_depth.shape, 3)
            for event in self._regional:
                inside = mapped & (true_depth > 0) & event.region.contains(points)  # type: ignore[union-attr]
                if int(inside.sum()) >= ENOUGH:
                    self.found.regional.setdefault(event, {})[frame.index] = float(trust[inside].mean())


def _trust(rendering: Rendering) -> Plane:
    """Rendered confidence over opacity."""
    return rendering.confidence / rendering.alpha.clamp_min(1e-3)


def summary(judged: Iterable[Judged]) -> dict[str, dict[str, float | None]]:
    """Scores of all frames: means, and of the rank correlation the median and the tenth percentile."""
    by_measure: dict[str, list[Scores]] = {}
    for one in judged:
        for name, scores in one.scores.items():
            by_measure.setdefault(name, []).append(scores)

    def over(values: Iterable[float], reduce: Callable[[list[float]], float]) -> float | None:
        finite = [value for value in values if math.isfinite(value)]
        return float(reduce(finite)) if finite else None

    return {
        name: {
            "ause": over((one.normalised_ause for one in scores), statistics.fmean),
            "spearman": over((one.spearman for one in scores), statistics.median),
            "spearman_p10": over((one.spearman for one in scores), lambda x: float(np.quantile(x, 0.1))),
            "partial_spearman": over((one.partial_spearman for one in scores), statistics.median),
            "auroc": over((one.auroc for one in scores), statistics.fmean),
        }
        for name, scores in by_measure.items()
    }


def leave_one_out(pairs: Mapping[str, tuple[Values, Values]]) -> dict[str, Reliability]:
    """By sequence: expected against found errors, the expectation fitted to all the other sequences.

    Args:
        pairs: Doubt and error of the same pixels, by sequence; there may be none.
    """
    known = {name: pair for name, pair in pairs.items() if len(pair[0])}
    found = {}
    for name, (doubt, error) in known.items():
        others = [pair for other, pair in known.items() if other != name]
        if others:
            fitted = calibrated(*(np.concatenate(column) for column in zip(*others, strict=True)))
            found[name] = reliability(fitted.expected_error(doubt), error)
    return found


def pairs_of(judged: Sequence[Judged]) -> tuple[Values, Values]:
    """Doubt and error at some pixels of all frames."""
    none = np.empty(0)
    return (
        np.concatenate([none, *(one.doubt for one in judged)]),
        np.concatenate([none, *(one.error for one in judged)]),
    )


@dataclass(frozen=True, eq=False)
class Watched:
    """What watching a run has shown of its depth; small enough to lie beside the report."""

    frames: int
    """That were predicted."""
    depth: Mapping[str, Mapping[str, float | None]]
    """By measure, as `summary` gives it."""
    fault_auroc: float | None
    """As `Predictions.fault_auroc`."""
    fault_auroc_in_map: float | None
    """As `Predictions.fault_auroc_in_map`."""
    curves: Mapping[str, Sparsification]
    """By measure: mean over the frames, each relative to the error of all its pixels; none if no frame has an error."""
    doubt: Values
    """Of the confidence, at some pixels of all frames."""
    error: Values
    """There; metres."""

    @staticmethod
    def of(found: Predictions) -> "Watched":
        """Of the depth of what was predicted."""
        doubt, error = pairs_of(found.depth)
        evenly = np.unique(np.linspace(0, len(doubt) - 1, min(_PAIRS, len(doubt))).round().astype(int))
        by_measure: dict[str, list[Sparsification]] = {}
        for name, curve in (pair for one in found.depth for pair in one.curves.items()):
            if curve.random > 0:
                by_measure.setdefault(name, []).append(curve)
        curves = {name: _mean_curve(curves) for name, curves in by_measure.items()}
        faults = found.fault_auroc, found.fault_auroc_in_map
        return Watched(len(found.depth), summary(found.depth), *faults, curves, doubt[evenly], error[evenly])

    def score(self, name: str, measure: str = OURS) -> float | None:
        """One of `depth`; None if it is not defined."""
        return self.depth.get(measure, {}).get(name)

    @property
    def figures(self) -> dict[str, Any]:
        """All but curves and pairs; for JSON."""
        faults = {"fault_auroc": self.fault_auroc, "fault_auroc_in_map": self.fault_auroc_in_map}
        return {"frames": self.frames, "depth": self.depth, **faults}

    def write(self, path: Path) -> None:
        """Put it at `path` as JSON, all of it or nothing."""
        some = next(iter(self.curves.values()), None)
        content = self.figures | {
            "removed": [] if some is None else _rounded(some.removed),
            "oracle": [] if some is None else _rounded(some.oracle),
            "curves": {name: _rounded(curve.error) for name, curve in self.curves.items()},
            "doubt": _significant(self.doubt),
            "error": _significant(self.error),
        }
        atomic.write_text(path, json.dumps(content, allow_nan=False) + "\n")

    @staticmethod
    def read(path: Path) -> "Watched | None":
        """What `write` has put there; None if there is nothing that can be read."""
        try:
            told = json.loads(path.read_text(encoding="utf-8"))
            removed, oracle = np.array(told["removed"], float), np.array(told["oracle"], float)
            curves = {
                str(name): Sparsification(removed, np.array(error, float), oracle, 1.0)
                for name, error in told["curves"].items()
            }
            depth = {str(name): dict(scores) for name, scores in told["depth"].items()}
            pairs = np.array(told["doubt"], float), np.array(told["error"], float)
            faults = told["fault_auroc"], told["fault_auroc_in_map"]
            return Watched(int(told["frames"]), depth, *faults, curves, *pairs)
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None


def _mean_curve(curves: Sequence[Sparsification]) -> Sparsification:
    """Of frames that count the same, whatever their error."""
    error, oracle = (
        np.mean([values / one.random for one, values in rows], axis=0)
        for rows in ([(one, one.error) for one in curves], [(one, one.oracle) for one in curves])
    )
    return Sparsification(curves[0].removed, error, oracle, 1.0)


def _rounded(values: Values) -> list[float]:
    return [round(float(value), _STEPS) for value in values]


def _significant(values: Values) -> list[float]:
    return [float(f"{value:.{_DIGITS}g}") for value in values]
