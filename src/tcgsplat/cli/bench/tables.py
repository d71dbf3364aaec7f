"""Tables of a bench as Markdown: means and spreads over seeds, and the published rows beside them."""

import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final

from tcgsplat.cli.bench.performing import WATCHED_EVERY, Outcome
from tcgsplat.cli.bench.suites import Suite
from tcgsplat.cli.bench.watching import Watched
from tcgsplat.evaluation import published
from tcgsplat.evaluation.paired import paired_differences, relative_differences
from tcgsplat.evaluation.prediction import BAD_METERS, BAD_SHARE
from tcgsplat.evaluation.published import Table

Outcomes = Sequence[Outcome]
NONE = "–"


def ate(outcomes: Outcomes, sequences: Sequence[str], suite: Suite) -> str:
    """Error of the path, sequence by sequence."""
    printed = published.ATE.get(suite.name)
    caption = (
        "ATE RMSE in cm, lower is better: all frames whose true pose is known, lost ones included, after rigid "
        "alignment."
    )
    table = _by_sequence(outcomes, sequences, suite, "ate_rmse", 2 if printed else 3, printed)
    return f"{caption} {_source(printed)}\n\n{table}"


def rendering(outcomes: Outcomes, sequences: Sequence[str], suite: Suite) -> str:
    """Pictures: means over the sequences, of every kind of view; and PSNR sequence by sequence."""
    kinds = {
        "": "training, own submap",
        "_withheld": "never mapped, own submap",
        "_map": "training, one map",
        "_map_withheld": "never mapped, one map",
        "_free": "beside the path, one map",
    }
    figures = {"psnr": 2, "ssim": 3, "ms_ssim": 3, "lpips": 3, "depth_l1": 2}
    names = ("PSNR [dB] ↑", "SSIM ↑", "MS-SSIM ↑", "LPIPS ↓", "depth L1 [cm] ↓")
    rows = [
        [f"`{preset}`", told, *(_mean_over(outcomes, sequences, preset, f"{figure}{kind}", decimals)
                                for figure, decimals in figures.items())]
        for preset in suite.presets
        for kind, told in kinds.items()
    ]  # fmt: skip
    printed = published.RENDERING.get(suite.name)
    if printed:
        for method, (psnr, ssim, lpips) in printed.rows.items():
            rows.append(
                [*_published(method), "training, one map, refined", f"{psnr}", NONE, f"{ssim}", f"{lpips}", NONE]
            )
    reasons = dict.fromkeys(
        reason for one in outcomes if one.state == "done" for name, reason in one.absent.items() if "lpips" in name
    )
    notes = "".join(f" LPIPS: {reason}." for reason in reasons)
    caption = (
        "Means over the sequences, of views drawn at their estimated poses (those beside the path at their true ones): "
        f"from the submap that they were tracked in, and from the one map of all submaps ({_map(outcomes)}).{notes} "
        f"{_source(printed)}"
    )
    per_sequence = _by_sequence(outcomes, sequences, suite, "psnr_withheld", 2, None)
    return (
        f"{caption}\n\n{markdown(('method', 'views', *names), rows, left=2)}\n\n"
        f"PSNR in dB of views that were never mapped, from their own submap:\n\n{per_sequence}"
    )


def reconstruction(outcomes: Outcomes, sequences: Sequence[str], suite: Suite) -> str:
    """The surface, where there is a true one."""
    metrics = {
        "mesh_depth_l1": ("Depth L1, cm, lower is better", 2, published.DEPTH_L1),
        "mesh_f1_1cm": ("F1 at 1 cm, %, higher is better", 1, published.F1),
        "mesh_accuracy": ("Accuracy, cm, lower is better", 2, None),
        "mesh_completion": ("Completion, cm, lower is better", 2, None),
    }
    there = {name for one in outcomes for name in one.metrics}
    parts = []
    for metric, (what, decimals, printed) in metrics.items():
        beside = printed if suite.name == "replica" else None
        if metric in there or beside:
            table = _by_sequence(outcomes, sequences, suite, metric, decimals, beside)
            parts.append(f"{what}. {_source(beside)}\n\n{table}")
    return "\n\n".join(parts) or "The reports of these runs have no figures of the surface."


def differences(outcomes: Outcomes, suite: Suite) -> str:
    """Every other preset beside the last one, on the same sequences with the same seeds; and the published ablation."""
    parts = []
    if len(suite.presets) > 1:
        reference = suite.presets[-1]
        rows = []
        for metric, (what, decimals) in COMPARED.items():
            for one in paired(outcomes, metric, reference):
                interval = f"{one.low:+.{decimals}f} … {one.high:+.{decimals}f}" if one.low == one.low else NONE
                p = f"{one.p_of_pairs:.3f}" if one.p_of_pairs == one.p_of_pairs else NONE
                cells = (f"{one.mean:+.{decimals}f}", interval, p, str(one.pairs), str(one.left_out))
                rows.append([f"`{one.arm}`", what, *cells])
        caption = (
            f"Difference to `{reference}` on the same sequences with the same seeds: mean, 95 % interval of a "
            "bootstrap over sequences and seeds, which is too narrow where sequences are few, and p of the signed-rank "
            "test over pairs."
        )
        head = ("preset", "measure", "difference", "95 % interval", "p", "pairs", "left out")
        parts.append(f"{caption}\n\n{markdown(head, rows, left=2)}" if rows else f"{caption} There is no pair yet.")
    if suite.name == "scannet":
        table = published.ABLATION
        printed = [
            [*_published(method), *("yes" if on else NONE for on in cells[:3]), f"{cells[3]}"]
            for method, cells in table.rows.items()
        ]
        names = ("row", "mapping", "tracking", "loop", "ATE [cm]")
        parts.append(f"{table.measures}, row by row. {_source(table)}\n\n{markdown(names, printed)}")
    return "\n\n".join(parts) or "There is only one preset."


COMPARED: Final = {
    "ate_rmse": ("ATE RMSE [%] ↓", 1),
    "psnr_withheld": ("PSNR of views never mapped [dB] ↑", 3),
    "ms_per_frame": ("time of a frame [ms] ↓", 1),
}  # fmt: skip


def paired(outcomes: Outcomes, metric: str, reference: str) -> tuple:  # type: ignore[type-arg]
    """Differences of a metric, that of the path's error in percent; none if the reference has no run with it."""
    values = {one.key: one.value(metric) for one in outcomes if one.state not in ("missing", "waiting")}
    results = {key: math.nan if value is None else value for key, value in values.items()}
    if not any(arm == reference for arm, _, _ in results):
        return ()
    return (relative_differences if metric == "ate_rmse" else paired_differences)(results, reference)


def confidence(outcomes: Outcomes, suite: Suite) -> str:
    """How well confidence told where the map was wrong, where the truth is known; empty if no run was watched."""
    rows = []
    for source in suite.sources:
        for preset in suite.presets:
            tried = [one for one in outcomes if one.state not in ("missing", "waiting")]
            runs = [one for one in tried if (one.sequence, one.preset) == (source.name, preset)]
            if any(one.watched for one in runs):
                cells = (_spread((_watched(one, of) for one in runs), 2) for of in OF_CONFIDENCE.values())
                rows.append([source.name, f"`{preset}`", *cells])
    if not rows:
        return ""
    caption = (
        f"Every {WATCHED_EVERY}th frame is drawn from the map as it was before it used the frame, at the pose that "
        "tracking found, and doubt (1 - rendered confidence) is held against the true error of depth, pixel by pixel. "
        "**AUSE**: error left when the most doubtful pixels are removed first, as an area above that of an oracle, "
        "over the same for a random order: 0 is the oracle, 1 knows nothing; beside it that of two measures that are "
        "to be had for less. **Spearman**: rank correlation of doubt and error, median and 10th percentile over "
        "frames; **partial**: of what depth, opacity, observations and the slope of colour leave unexplained, "
        "median. **AUROC bad**: chance that a pixel that is off by more than "
        f"{100 * BAD_METERS:g} cm and {100 * BAD_SHARE:g} % is more doubtful than another; **AUROC fault**: the same "
        "where the recording was wrong, as somebody was in the way, once the map has used the frame; **in map**: of "
        "those places where the map is wrong for it, from all where it is right. Colour, and "
        "frames that are never mapped, are not part of this: see `tcgsplat bench confidence`."
    )
    table = markdown(("sequence", "preset", *OF_CONFIDENCE), rows, left=2)
    return f"{caption}\n\n{table}\n\n{_beaten(outcomes, suite)}"


OF_CONFIDENCE: Final[Mapping[str, Callable[[Watched], float | None]]] = {
    "AUSE ↓": lambda run: run.score("ause"),
    "AUSE of opacity": lambda run: run.score("ause", "opacity"),
    "AUSE of observations": lambda run: run.score("ause", "observations"),
    "Spearman ↑": lambda run: run.score("spearman"),
    "Spearman p10 ↑": lambda run: run.score("spearman_p10"),
    "partial ↑": lambda run: run.score("partial_spearman"),
    "AUROC bad ↑": lambda run: run.score("auroc"),
    "AUROC fault ↑": lambda run: run.fault_auroc,
    "in map ↑": lambda run: run.fault_auroc_in_map,
}


def _watched(one: Outcome, of: Callable[[Watched], float | None]) -> float | None:
    """A figure of a run that counts."""
    return of(one.watched) if one.watched and one.state == "done" else None


def _beaten(outcomes: Outcomes, suite: Suite) -> str:
    """In how many runs confidence has the lower AUSE."""
    told, frames = [], 0
    for preset in suite.presets:
        done = [one.watched for one in outcomes if one.preset == preset and one.watched and one.state == "done"]
        counts = []
        for measure in ("opacity", "observations"):
            both = [(run.score("ause"), run.score("ause", measure)) for run in done]
            known = [(ours, other) for ours, other in both if ours is not None and other is not None]
            counts.append(f"than {measure} in {sum(ours < other for ours, other in known)} of {len(known)}")
        if done:
            frames += sum(run.frames for run in done)
            told.append(f"with `{preset}`, {' and '.join(counts)} runs")
    if not told:
        return "None of these runs counts."
    return f"{frames} frames were predicted. The AUSE of confidence is lower {'; '.join(told)}."


def runtime(outcomes: Outcomes, suite: Suite) -> str:
    """Times of a frame and of its stages, and size of the map: means over all runs.

    No memory: `peak_rss_mb` is of the process, which has made the runs before in it too.
    """
    columns: dict[str, Callable[[Outcome], float | None]] = {
        "frame [ms]": lambda one: one.value("ms_per_frame"),
        "tracking [ms]": lambda one: _stage(one, "track"),
        "mapping update [ms]": lambda one: _summary(one, "ms_update"),
        "closing a loop [ms]": lambda one: _summary(one, "ms_closure"),
        "Gaussians": lambda one: one.value("gaussians"),
        "run [s]": lambda one: _summary(one, "seconds"),
    }
    rows = []
    for preset in suite.presets:
        done = [one for one in outcomes if one.preset == preset and one.state == "done"]
        rows.append([f"`{preset}`", *(_spread((of(one) for one in done), 0) for of in columns.values())])
    for method, (mapping, _, tracking, _) in published.RUNTIME.rows.items():
        cells = [NONE, _ms(tracking), _ms(mapping), *[NONE] * (len(columns) - 3)]
        rows.append([*_published(method), *cells])
    machines = sorted({str(one.summary.get("machine")) for one in outcomes if one.summary})
    watched = (
        f"Predicting every {WATCHED_EVERY}th frame to judge confidence is in none of these times, but mapping went on "
        "beside it. "
    )
    caption = (
        f"Mean ± standard deviation over all runs, on {'; '.join(machines) or 'no machine yet'}. Mapping and loop "
        "closure have threads of their own beside tracking: the published times of a frame add up, ours do not. "
        f"{watched * any(one.watched is not None for one in outcomes)}"
        f"Published rows: mapping and tracking of a frame, on other data and another machine. "
        f"{_source(published.RUNTIME)}"
    )
    return f"{caption}\n\n{markdown(('method', *columns), rows)}"


def runs(outcomes: Outcomes) -> str:
    """A run a row, with what became of it."""
    rows = []
    for one in outcomes:
        lost = one.metrics.get("frames_lost")
        path = one.metrics.get("ate_rmse")
        links = f"[settings]({one.place}/config.toml), [report]({one.place}/report.json)" if one.metrics else NONE
        state = one.state if not one.why else f"{one.state}: {one.why}".replace("|", "/")
        cells = (NONE if path is None else f"{path.value:.3f}", NONE if lost is None else str(lost.value))
        rows.append([one.sequence, f"`{one.preset}`", str(one.seed), state, *cells, links])
    return markdown(("sequence", "preset", "seed", "state", "ATE [cm]", "frames lost", "files"), rows, left=2)


def _map(outcomes: Outcomes) -> str:
    """What it was when it was scored."""
    return "; ".join(sorted({one.evaluated["map"] for one in outcomes if "map" in one.evaluated})) or "no run yet"


def _by_sequence(
    outcomes: Outcomes, sequences: Sequence[str], suite: Suite, metric: str, decimals: int, printed: Table | None
) -> str:
    """A preset a row, a sequence a column; the mean over sequences is that of those that have a figure."""
    shown = suite.sources if printed else [source for source in suite.sources if source.name in sequences]
    rows = []
    for preset in suite.presets:
        cells = [_spread(_values(outcomes, preset, source.name, metric), decimals) for source in shown]
        rows.append([f"`{preset}`", *cells, _mean_over(outcomes, [s.name for s in shown], preset, metric, decimals)])
    for method in printed.rows if printed else ():
        values = [printed.value(method, source.column or "") for source in shown] if printed else []
        average = printed.value(method, "Avg.") if printed else None
        whole = len(shown) == len(printed.columns) - 1 if printed else False
        rows.append([*_published(method), *map(_plain, (*values, average if whole else None))])
    return markdown(("method", *(source.name for source in shown), "mean"), rows)


def _values(outcomes: Outcomes, preset: str, sequence: str, metric: str) -> list[float | None]:
    """Over the seeds; None for a run that failed or lacks it."""
    chosen = [one for one in outcomes if one.preset == preset and one.sequence == sequence]
    return [one.value(metric) for one in chosen if one.state not in ("missing", "waiting")]


def _mean_over(outcomes: Outcomes, sequences: Sequence[str], preset: str, metric: str, decimals: int) -> str:
    """Mean over the sequences, its spread over seeds; a seed counts if it has a figure for every such sequence."""
    by_sequence = {name: _values(outcomes, preset, name, metric) for name in sequences}
    there = {name: values for name, values in by_sequence.items() if any(value is not None for value in values)}
    if not there:
        return NONE
    seeds = zip(*there.values(), strict=False)
    means = [statistics.fmean(row) for row in seeds if None not in row]  # type: ignore[type-var,arg-type]
    of = f" ({len(there)} of {len(sequences)})" if len(there) < len(sequences) else ""
    return _spread(means, decimals) + of


def _spread(values: Iterable[float | None], decimals: int) -> str:
    """Mean ± standard deviation; how many are missing, if some are."""
    every = list(values)
    known = [value for value in every if value is not None]
    if not known:
        return NONE
    told = f"{statistics.fmean(known):.{decimals}f}"
    if len(known) > 1:
        told += f" ± {statistics.stdev(known):.{decimals}f}"
    return told if len(known) == len(every) else f"{told} ({len(known)} of {len(every)} runs)"


def _stage(one: Outcome, stage: str) -> float | None:
    stages = one.summary.get("stage_ms")
    return float(stages[stage]) if one.state == "done" and isinstance(stages, dict) and stage in stages else None


def _summary(one: Outcome, name: str) -> float | None:
    value = one.summary.get(name)
    return float(value) if one.state == "done" and isinstance(value, int | float) else None


def _ms(seconds: float | None) -> str:
    return NONE if seconds is None else f"{1000 * seconds:.0f}"


def _plain(value: float | None) -> str:
    return NONE if value is None else f"{value:g}"


def _published(method: str) -> tuple[str]:
    """The first cell of a row that nobody measured here."""
    name = method.replace("*", "\\*")
    return (f"*{name} (published)*",)


def _source(printed: Table | None) -> str:
    return f"Published: {printed.source}; {printed.protocol}." if printed else ""


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> str:
    """So many columns to the left, numbers to the right."""
    rule = ("---",) * left + ("---:",) * (len(head) - left)
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, rule, *rows))
