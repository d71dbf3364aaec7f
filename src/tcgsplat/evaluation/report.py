"""A run's figures, each with its unit, and what exactly was evaluated to get them."""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from tcgsplat.datasets.association import MAX_GAP, nearest
from tcgsplat.datasets.sequence import Sequence
from tcgsplat.errors import EvaluationError
from tcgsplat.evaluation import ate
from tcgsplat.evaluation.views import (
    MOST_WITHHELD,
    ViewScore,
    in_turn,
    in_world,
    learnt_delay,
    spread,
    training_views,
    velocities_by_frame,
    withheld_rows,
    withheld_views,
)
from tcgsplat.mapping.merging import Merged
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import MIN_COVERAGE, SubmapView, render_view
from tcgsplat.scene import exposure
from tcgsplat.scene.atlas import Atlas
from tcgsplat.scene.trajectory import TrackedPose, Trajectory, parse_tum
from tcgsplat.storage import atomic
from tcgsplat.storage.run_directory import RunDirectory
from tcgsplat.storage.world_map import world_map
from tcgsplat.tensors import Pose

_WITHHELD = (
    ("psnr_withheld", "psnr", "dB"),
    ("psnr_withheld_unexposed", "psnr_unexposed", "dB"),
    ("ssim_withheld", "ssim", ""),
    ("depth_l1_withheld", "depth_l1", "cm"),
    ("psnr_withheld_mapped", "psnr_mapped", "dB"),
    ("coverage_withheld", "coverage", "%"),
)
_MAP = (
    ("psnr_map_withheld", "psnr", "dB"),
    ("ssim_map_withheld", "ssim", ""),
    ("depth_l1_map_withheld", "depth_l1", "cm"),
    ("coverage_map_withheld", "coverage", "%"),
)
_TRAINING = (
    ("psnr", "psnr", "dB"),
    ("ssim", "ssim", ""),
    ("depth_l1", "depth_l1", "cm"),
    ("depth_coverage", "depth_coverage", "%"),
)
"""Metric, the figure of `ViewScore` that it is the mean of, and its unit."""

Times = Float[np.ndarray, " n"]
"""Time stamps, seconds."""


@dataclass(frozen=True)
class Metric:
    """A number with its unit; the unit of a count or a ratio is empty."""

    value: int | float
    unit: str = ""

    def __str__(self) -> str:
        """Four significant digits of a measure, all of a count."""
        if isinstance(self.value, int) or self.value == 0:
            return f"{self.value} {self.unit}".rstrip()
        decimals = max(0, 3 - math.floor(math.log10(abs(self.value))))
        return f"{self.value:.{decimals}f} {self.unit}".rstrip()


@dataclass(frozen=True)
class Report:
    """Metrics by name, and a description of what they were measured on."""

    metrics: Mapping[str, Metric]
    evaluated: Mapping[str, str] = field(default_factory=dict)
    """Which frames, poses and pixels."""
    missing: Mapping[str, str] = field(default_factory=dict)
    """Why a metric is not there, by its name."""

    def to_json(self) -> str:
        """An object from metric name to `{"value", "unit"}`; `evaluated` has the rest, `missing` among it."""
        rows = {name: {"value": metric.value, "unit": metric.unit} for name, metric in self.metrics.items()}
        evaluated = {**self.evaluated, "missing": dict(self.missing)}
        return json.dumps({**rows, "evaluated": evaluated}, indent=2, allow_nan=False) + "\n"

    def table(self) -> str:
        """For a terminal: a metric a line, then those that are missing, then what was evaluated."""
        rows = {name: str(metric) for name, metric in self.metrics.items()}
        rows |= {name: f"- ({reason})" for name, reason in self.missing.items()}
        width = max(map(len, (*rows, *self.evaluated)), default=0)
        groups = (rows, self.evaluated)
        return "\n\n".join("\n".join(f"{name:<{width}}  {what}" for name, what in group.items()) for group in groups)

    def write(self, path: Path) -> None:
        """Put the JSON at `path`."""
        atomic.write_text(path, self.to_json())


def evaluate(
    run: RunDirectory,
    sequence: Sequence | None,
    rasterizer: Rasterizer,
    *,
    stride: int = 1,
    withheld_every: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Report:
    """Score a run, finished or not, by its own files and the frames and ground truth of its sequence.

    Every view is drawn from the submap that it was tracked in, as saved, at its estimated pose, and compared with the
    camera's image over its valid pixels, so that the border that undistortion leaves empty is not counted. Withheld
    ones are drawn from the one map of all submaps as well: the one that `refine` left, or as the submaps merge now.
    Figures are means over the views.

    - `ate_rmse`, cm: camera centres of all tracked frames that have a true pose, after rigid alignment.
    - `psnr_withheld` (dB), `ssim_withheld`, `depth_l1_withheld` (cm): frames of the sequence that were tracked and
      never mapped, drawn at the pose and with the exposure that tracking found for them.
    - `psnr_withheld_unexposed` (dB): the same with one exposure for all views of a submap, the mean of its keyframes',
      to compare with systems that have no exposures.
    - `psnr_withheld_mapped` (dB), `coverage_withheld` (%): the PSNR of those of their valid pixels that the map covers
      by more than half, and the share of these: the rest is what holes cost.
    - `psnr_map_withheld` (dB), `ssim_map_withheld`, `depth_l1_map_withheld` (cm), `coverage_map_withheld` (%): the same
      frames in the one map.
    - `psnr` (dB), `ssim`, `depth_l1` (cm), `depth_coverage` (%): the keyframes, which the map was optimised on.
    - `frames`, `frames_lost`, `seconds_lost` (of the recording), `submaps`, `gaussians` (of all submaps),
      `gaussians_map` (of the one map), and from the run's summary `loops`, `ms_per_frame` and `peak_rss_mb`.
    - Of a run in real time, from its summary: `frames_dropped`, and `ms_late`, the median from a frame's capture to its
      pose.

    Args:
        run: The run's directory.
        sequence: The data; None if it is not at hand.
        rasterizer: Backend to draw with.
        stride: Draw every so many-th keyframe.
        withheld_every: Draw one withheld frame in so many; `MOST_WITHHELD` of them at most if not given.
        progress: Told how many frames of how many are done.

    Returns:
        The report; a metric that cannot be had is absent, with the reason in `missing`.

    Raises:
        ArchiveError: if a file of the run is damaged.
        DatasetError: if the ground truth is there but cannot be read, or a withheld frame cannot.
        EvaluationError: if the run has no sealed submap.
    """
    trajectory, atlas = run.trajectory()
    if run.submap_count == 0 or len(trajectory) == 0:
        raise EvaluationError(f"{run.path} has no sealed submap yet; let the run go on for longer, or run again")
    truth = sequence.ground_truth() if sequence is not None else {}
    whole = world_map(run, rasterizer)
    scored = sum(row.frame_index in truth for row in trajectory.rows)
    withheld = withheld_rows(run, trajectory)
    drawn = spread(withheld, math.ceil(len(withheld) / withheld_every) if withheld_every else MOST_WITHHELD)
    last = trajectory.rows[-1].frame_index

    def drawn_frame(frame_index: int) -> None:
        if progress is not None:
            progress(frame_index + 1, last + 1)

    rows = {
        "ate_rmse": _accuracy(trajectory, atlas, truth),
        **_quality(run, whole, sequence, rasterizer, stride, drawn, drawn_frame),
        "frames": Metric(len(trajectory)),
        "frames_lost": Metric(sum(row.lost for row in trajectory.rows)),
        "seconds_lost": Metric(trajectory.seconds_lost, "s"),
        **_cost(run.summary()),
    }
    return Report(
        metrics={name: row for name, row in rows.items() if isinstance(row, Metric)},
        evaluated={
            "run": str(run.path),
            "sequence": sequence.name if sequence is not None else run.sequence,
            "trajectory": f"{scored} of {len(trajectory)} frames have a true pose; rigid alignment without scale",
            "withheld": _told_withheld(trajectory, len(withheld), len(drawn) if sequence is not None else 0),
            "views": f"{'all keyframes' if stride == 1 else f'one keyframe in {stride}'} of the saved submaps: "
            "training views; these and the withheld ones are each drawn from their own submap",
            "map": f"refined by {whole.steps} steps" if whole.steps else "the submaps as they merge now, not refined",
            "poses": "estimated, and so are exposures (psnr_withheld_unexposed: one for a submap)",
            "pixels": "psnr and ssim: valid pixels, without the border that undistortion leaves empty; "
            f"psnr_withheld_mapped: those with alpha above {MIN_COVERAGE:g}; "
            "depth_l1: those with a sensor reading, unmapped ones in full",
        },
        missing={name: row for name, row in rows.items() if isinstance(row, str)},
    )


def score_trajectory(estimated: Path, sequence: Sequence) -> Report:
    """Score a trajectory of any system, given as text in the TUM format, against a sequence's ground truth.

    A pose belongs to the frame whose time stamp is nearest, within 20 ms; of several, the nearest one. Decodes the
    sequence once, for its time stamps.

    Args:
        estimated: File of `timestamp tx ty tz qx qy qz qw`, camera to world.
        sequence: The data with its ground truth.

    Returns:
        `ate_rmse` and `ate_max` (cm, rigid alignment), and `frames`, those compared.

    Raises:
        EvaluationError: if the file cannot be read, there is no ground truth, or fewer than three poses match.
    """
    try:
        stamps, poses = parse_tum(estimated.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise EvaluationError(f"cannot read {estimated} ({error}); give a trajectory in the TUM format") from error
    truth = sequence.ground_truth()
    if not truth:
        raise EvaluationError(f"the sequence {sequence.name} has no ground truth to compare {estimated} with")
    frames = [(frame.timestamp, truth[frame.index]) for frame in sequence if frame.index in truth]
    pairs = associate(np.array(stamps), np.array([stamp for stamp, _ in frames]))
    if len(pairs) < 3:
        raise EvaluationError(
            f"only {len(pairs)} of {len(poses)} poses in {estimated} are within {1000 * MAX_GAP:.0f} ms of a frame of "
            f"{sequence.name} with a true pose; check that its time stamps are seconds of the same clock"
        )
    errors = ate.errors(ate.positions([poses[i] for i, _ in pairs]), ate.positions([frames[j][1] for _, j in pairs]))
    return Report(
        metrics={
            "ate_rmse": Metric(100.0 * float(np.sqrt(np.square(errors).mean())), "cm"),
            "ate_max": Metric(100.0 * float(errors.max()), "cm"),
            "frames": Metric(len(pairs)),
        },
        evaluated={
            "sequence": sequence.name,
            "trajectory": f"{estimated}: {len(pairs)} of its {len(poses)} poses, against {len(frames)} frames with a "
            "true pose; rigid alignment without scale",
        },
    )


def associate(times: Times, others: Float[np.ndarray, " m"], *, max_gap: float = MAX_GAP) -> list[tuple[int, int]]:
    """Pairs (i, j) such that j is the other time nearest to time i, at most `max_gap` seconds away.

    Each j is given once, to the nearest i; pairs come in the order of j. Neither list need be sorted.
    """
    if len(times) == 0 or len(others) == 0:
        return []
    order = np.argsort(others, kind="stable")
    places, gaps = nearest(times, others[order])
    best: dict[int, int] = {}
    for i in np.argsort(gaps, kind="stable")[: int((gaps <= max_gap).sum())].tolist():
        best.setdefault(int(order[places[i]]), i)
    return [(best[j], j) for j in sorted(best)]


def _told_withheld(trajectory: Trajectory, withheld: int, drawn: int) -> str:
    told = f"{drawn} of {withheld} frames that were tracked in a saved submap and never mapped, spread evenly"
    known = any(row.mapped for row in trajectory.rows)
    return told if known else f"{told}; an older run: former keyframes that the submap dropped are taken for withheld"


# Each of these gives a metric or, in words, why there is none.


def _accuracy(trajectory: Trajectory, atlas: Atlas, truth: Mapping[int, Pose]) -> Metric | str:
    estimated = {row.frame_index: T for row, T in zip(trajectory.rows, trajectory.world(atlas), strict=True)}
    common = [index for index in estimated if index in truth]
    if len(common) < 3:
        return f"only {len(common)} frames have a true pose" if truth else "no ground truth"
    rmse = ate.ate_rmse_of_poses([estimated[index] for index in common], [truth[index] for index in common])
    return Metric(100.0 * rmse, "cm")


def _quality(
    run: RunDirectory,
    whole: Merged,
    sequence: Sequence | None,
    rasterizer: Rasterizer,
    stride: int,
    withheld: tuple[TrackedPose, ...],
    drawn: Callable[[int], None],
) -> dict[str, Metric | str]:
    """Submaps are read one after the other, so that memory holds one of them; `drawn` hears of every frame index."""
    scores: dict[bool, list[ViewScore]] = {True: [], False: []}
    in_map: list[ViewScore] = []
    map_view = SubmapView(whole.submap, rasterizer)
    velocities = velocities_by_frame(*run.trajectory())
    gaussians = seen = 0
    delay = learnt_delay(run)
    for index in range(run.submap_count):
        submap = run.load_submap(index)
        rows = [row for row in withheld if row.submap_index == index]
        unseen = withheld_views(rows, velocities, sequence, delay) if sequence is not None else iter(())
        middle = exposure.mean([keyframe.exposure for keyframe in submap.keyframes] or [exposure.UNCHANGED])
        for view in in_turn(training_views(submap, slice(-seen % stride, None, stride)), unseen):
            rendering = render_view(submap, view.frame.camera, view.T_map_cam, rasterizer)
            scores[view.withheld].append(ViewScore.of(rendering, view, middle))
            if view.withheld:
                placed = in_world(view, index, whole)
                rendering = map_view(placed.frame.camera, placed.T_map_cam)
                in_map.append(ViewScore.of(rendering, placed, middle))
            drawn(view.frame.index)
        gaussians += len(submap)
        seen += len(submap.keyframes)
    none_left = "every frame of the saved submaps was mapped or lost"
    return {
        **_means(scores[True], _WITHHELD, "the sequence is not at hand" if sequence is None else none_left),
        **_means(in_map, _MAP, "the sequence is not at hand" if sequence is None else none_left),
        **_means(scores[False], _TRAINING, "the saved submaps have no keyframe"),
        "submaps": Metric(run.submap_count),
        "gaussians": Metric(gaussians),
        "gaussians_map": Metric(len(whole.submap)),
    }


def _means(scores: list[ViewScore], metrics: tuple[tuple[str, str, str], ...], no_view: str) -> dict[str, Metric | str]:
    rows: dict[str, Metric | str] = {}
    for name, figure, unit in metrics:
        values = [float(getattr(score, figure)) for score in scores]
        finite = [value for value in values if math.isfinite(value)]
        nothing = "no view has a pixel that counts" if scores else no_view
        rows[name] = Metric(sum(finite) / len(finite), unit) if finite else nothing
    return rows


def _cost(summary: Mapping[str, object]) -> dict[str, Metric | str]:
    ms_per_frame, peak = (summary.get(name) for name in ("ms_per_frame", "peak_rss_mb"))
    loops = summary.get("loops")
    dropped, late = (summary.get(name) for name in ("frames_dropped", "ms_late_median"))
    absent = "summary.json does not tell" if summary else "no summary.json: the run has not ended, or was killed"
    rows: dict[str, Metric | str] = {"loops": absent, "ms_per_frame": absent, "peak_rss_mb": absent}
    if isinstance(loops, int):
        rows["loops"] = Metric(loops)
    if isinstance(ms_per_frame, int | float):
        rows["ms_per_frame"] = Metric(ms_per_frame, "ms")
    if isinstance(peak, int | float):
        rows["peak_rss_mb"] = Metric(peak, "MB")
    if summary.get("realtime") is True:
        rows["frames_dropped"] = Metric(dropped) if isinstance(dropped, int) else absent
        rows["ms_late"] = Metric(late, "ms") if isinstance(late, int | float) else absent
    return rows
