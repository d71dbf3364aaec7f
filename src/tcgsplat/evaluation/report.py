"""A run's figures, each with its unit, and what exactly was evaluated to get them."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from tcgsplat.datasets.sequence import Sequence
from tcgsplat.errors import EvaluationError
from tcgsplat.evaluation.accuracy import ALIGNMENT, accuracy, score_trajectory
from tcgsplat.evaluation.images import MS_SSIM_SMALLEST
from tcgsplat.evaluation.lpips import Lpips
from tcgsplat.evaluation.metrics import VIEW_FIGURES, VIEW_KINDS, Metric, Report, Row
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
    withholding,
)
from tcgsplat.mapping.merging import Merged
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import MIN_COVERAGE, SubmapView, render_view
from tcgsplat.scene import exposure
from tcgsplat.scene.atlas import Atlas
from tcgsplat.scene.exposure import Exposure
from tcgsplat.scene.trajectory import TrackedPose, Trajectory
from tcgsplat.storage.run_directory import RunDirectory
from tcgsplat.storage.world_map import world_map
from tcgsplat.tensors import Pose

__all__ = ["Metric", "Report", "evaluate", "score_trajectory", "unfinished"]


@dataclass(frozen=True)
class _Drawing:
    """Which views are drawn, and how they are judged."""

    rasterizer: Rasterizer
    lpips: Lpips | None
    stride: int
    """Of the keyframes."""
    withheld: tuple[TrackedPose, ...]


def evaluate(
    run: RunDirectory,
    sequence: Sequence | None,
    rasterizer: Rasterizer,
    *,
    stride: int = 1,
    withheld_every: int | None = None,
    lpips: Lpips | None = None,
    whole: Merged | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Report:
    """Score a run, finished or not, by its own files and the frames and ground truth of its sequence.

    Every view is drawn twice, at its estimated pose and with its estimated exposure: from the submap that it was
    tracked in, as saved by the online system; and from the one map of all submaps, as `refine` left it or as the
    submaps merge now. It is compared with the camera's image over its valid pixels, so that the border that
    undistortion leaves empty is not counted. Figures are means over the views.

    - The errors of the path, as `accuracy` has them: all tracked frames that have a true pose.
    - `psnr` (dB), `ssim`, `ms_ssim`, `lpips`, `depth_l1` (cm): the keyframes, which the map was optimised on.
    - `psnr_unexposed` (dB): the same with one exposure for all views of a submap, the mean of its keyframes', or for
      all of the one map, to compare with systems that have no exposures.
    - `psnr_mapped` (dB), `coverage` (%): the PSNR of those of their valid pixels that the map covers by more than half,
      and the share of these: the rest is what holes cost. `depth_coverage` (%): of those with a sensor reading.
    - `psnr_withheld`, `psnr_withheld_unexposed` and so on: frames of the sequence that were tracked and never mapped;
      those that the run's `schedule.withhold_every` kept back, if it did.
    - `psnr_map`, `psnr_map_withheld` and so on: both in the one map.
    - `frames_tracked` (%), `frames`, `frames_lost`, `seconds_lost` (of the recording), `submaps`, `gaussians` (of all
      submaps), `gaussians_map` (of the one map), and from the run's summary `loops`, `ms_per_frame` and `peak_rss_mb`.
    - Of a run in real time, from its summary: `frames_dropped`, and `ms_late`, the median from a frame's capture to its
      pose.

    What was evaluated begins with `part` if the run did not reach its end, as `unfinished` has it.

    Args:
        run: The run's directory.
        sequence: The data; None if it is not at hand.
        rasterizer: Backend to draw with.
        stride: Draw every so many-th keyframe.
        withheld_every: Draw one withheld frame in so many; if not given, all that were kept back on purpose, or of
            those that only happened not to be mapped `MOST_WITHHELD` at most.
        lpips: The perceptual distance; `lpips` is missing without.
        whole: The one map of the run, if it is at hand.
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
    whole = world_map(run, rasterizer) if whole is None else whole
    scored = sum(row.frame_index in truth for row in trajectory.rows)
    withheld = withheld_rows(run, trajectory)
    most = len(withheld) if withholding(run) else MOST_WITHHELD
    chosen = spread(withheld, math.ceil(len(withheld) / withheld_every) if withheld_every else most)
    drawing = _Drawing(rasterizer, lpips, stride, chosen)
    last = trajectory.rows[-1].frame_index

    def drawn_frame(frame_index: int) -> None:
        if progress is not None:
            progress(frame_index + 1, last + 1)

    lost = sum(row.lost for row in trajectory.rows)
    rows = {
        **_accuracy(trajectory, atlas, truth),
        "frames_tracked": Metric(100.0 * (1.0 - lost / len(trajectory)), "%"),
        **_quality(run, whole, sequence, drawing, drawn_frame),
        "frames": Metric(len(trajectory)),
        "frames_lost": Metric(lost),
        "seconds_lost": Metric(trajectory.seconds_lost, "s"),
        **_cost(run.summary()),
    }
    evaluated = {
        **({} if (part := unfinished(run, sequence)) is None else {"part": part}),
        "run": str(run.path),
        "sequence": sequence.name if sequence is not None else run.sequence,
        "trajectory": f"{scored} of {len(trajectory)} frames have a true pose; {ALIGNMENT}",
        "training": f"{'all keyframes' if stride == 1 else f'one keyframe in {stride}'} of the saved submaps",
        "withheld": _told_withheld(run, trajectory, len(withheld), len(chosen) if sequence is not None else 0),
        "views": "drawn each from its own submap (psnr, psnr_withheld) and from the one map (psnr_map, "
        "psnr_map_withheld)",
        "map": f"refined by {whole.steps} steps" if whole.steps else "the submaps as they merge now, not refined",
        "poses": "estimated, and so are exposures (unexposed: one for a submap, one for the map)",
        "pixels": "valid ones, without the border that undistortion leaves empty; psnr_mapped: those with alpha above "
        f"{MIN_COVERAGE:g}, whose share is coverage; depth_l1: those with a sensor reading, unmapped ones in full",
    }
    return Report.of(rows, evaluated)


def unfinished(run: RunDirectory, sequence: Sequence | None) -> str | None:
    """How far a run has come that did not reach the end of its frames, and how it goes on; None of one that did.

    Args:
        run: The run's directory.
        sequence: The part of the data that the run was asked for; None if it is not at hand.

    Raises:
        ArchiveError: if a file of the run is damaged.
    """
    summary = run.summary()
    if summary and not summary.get("interrupted"):
        return None
    rows = run.trajectory()[0].rows
    frames = rows[-1].frame_index + 1 if rows else 0
    whole = f" of {len(sequence)}" if sequence is not None else ""
    why = "was stopped before its end" if summary else "was killed, or has not ended yet"
    live = "--realtime" in str((run.request or {}).get("command"))
    goes_on = "" if live else "; `tcgsplat run` with the same arguments and --resume goes on with it"
    return f"only the first {frames}{whole} frames, since the run {why}{goes_on}"


def _told_withheld(run: RunDirectory, trajectory: Trajectory, withheld: int, drawn: int) -> str:
    if every := withholding(run):
        return (
            f"{drawn} of {withheld} frames that schedule.withhold_every kept back: those whose index is a multiple of "
            f"{every} and that are not lost; the run's first is mapped, and so is one in whose place a lost camera "
            "began a submap"
        )
    told = f"{drawn} of {withheld} frames that were tracked in a saved submap and never mapped, spread evenly"
    known = any(row.mapped for row in trajectory.rows)
    return told if known else f"{told}; an older run: former keyframes that the submap dropped are taken for withheld"


def _accuracy(trajectory: Trajectory, atlas: Atlas, truth: Mapping[int, Pose]) -> dict[str, Row]:
    posed = zip(trajectory.rows, trajectory.world(atlas), strict=True)
    known = [(T, truth[row.frame_index], row.timestamp) for row, T in posed if row.frame_index in truth]
    estimated, true, times = zip(*known, strict=True) if known else ((), (), ())
    return accuracy(estimated, true, np.array(times, dtype=np.float64))


def _quality(
    run: RunDirectory, whole: Merged, sequence: Sequence | None, drawing: _Drawing, drawn: Callable[[int], None]
) -> dict[str, Row]:
    """Submaps are read one after the other, so that memory holds one of them; `drawn` hears of every frame index."""
    scores: dict[str, list[ViewScore]] = {kind: [] for kind in VIEW_KINDS}
    map_view = SubmapView(whole.submap, drawing.rasterizer)
    trajectory, atlas = run.trajectory()
    velocities, delay = velocities_by_frame(trajectory, atlas), learnt_delay(run)
    count = run.submap_count
    mapped = [row for row in trajectory.rows if row.mapped and row.submap_index < count]
    middle_of_map = _middle(whole.exposed(row.submap_index, row.exposure) for row in mapped)
    gaussians = seen = 0
    for index in range(count):
        submap = run.load_submap(index)
        rows = [row for row in drawing.withheld if row.submap_index == index]
        unseen = withheld_views(rows, velocities, sequence, delay) if sequence is not None else iter(())
        middle = _middle(keyframe.exposure for keyframe in submap.keyframes)
        for view in in_turn(training_views(submap, slice(-seen % drawing.stride, None, drawing.stride)), unseen):
            kind, placed = "_withheld" if view.withheld else "", in_world(view, index, whole)
            rendering = render_view(submap, view.frame.camera, view.T_map_cam, drawing.rasterizer)
            scores[kind].append(ViewScore.of(rendering, view, middle, drawing.lpips))
            rendering = map_view(placed.frame.camera, placed.T_map_cam)
            scores[f"_map{kind}"].append(ViewScore.of(rendering, placed, middle_of_map, drawing.lpips))
            drawn(view.frame.index)
        gaussians += len(submap)
        seen += len(submap.keyframes)
    no_frame = "every frame of the saved submaps was mapped or lost"
    no_view = {
        "": "the saved submaps have no keyframe",
        "_withheld": "the sequence is not at hand" if sequence is None else no_frame,
    }
    means = [_means(scores[kind], kind, no_view[kind.removeprefix("_map")], drawing.lpips) for kind in VIEW_KINDS]
    return {
        **{name: row for rows in means for name, row in rows.items()},
        "submaps": Metric(run.submap_count),
        "gaussians": Metric(gaussians),
        "gaussians_map": Metric(len(whole.submap)),
    }


def _middle(exposures: Iterable[Exposure]) -> Exposure:
    return exposure.mean(list(exposures) or [exposure.UNCHANGED])


def _means(scores: list[ViewScore], kind: str, no_view: str, lpips: Lpips | None) -> dict[str, Row]:
    """Of every figure over the views of a kind."""
    rows: dict[str, Row] = {}
    for figure, (metric, unit) in VIEW_FIGURES.items():
        values = [float(getattr(score, figure)) for score in scores]
        finite = [value for value in values if math.isfinite(value)]
        nothing = "no view has a pixel that counts" if scores else no_view
        if figure == "lpips" and lpips is None:
            nothing = "not available: give the weights by --lpips"
        elif figure == "ms_ssim" and scores:
            nothing = f"views are too small for its five scales: {MS_SSIM_SMALLEST} valid pixels across and down"
        rows[metric.format(kind)] = Metric(sum(finite) / len(finite), unit) if finite else nothing
    return rows


def _cost(summary: Mapping[str, object]) -> dict[str, Row]:
    ms_per_frame, peak = (summary.get(name) for name in ("ms_per_frame", "peak_rss_mb"))
    loops = summary.get("loops")
    dropped, late = (summary.get(name) for name in ("frames_dropped", "ms_late_median"))
    absent = "summary.json does not tell" if summary else "no summary.json: the run has not ended, or was killed"
    rows: dict[str, Row] = {"loops": absent, "ms_per_frame": absent, "peak_rss_mb": absent}
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
