"""Figures of a bench: every run a dot."""

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from tcgsplat.cli.bench.performing import RIVALS, Outcome
from tcgsplat.cli.bench.suites import Suite
from tcgsplat.cli.bench.tables import paired
from tcgsplat.cli.bench.watching import Watched, leave_one_out
from tcgsplat.evaluation import canvas, published
from tcgsplat.evaluation.prediction import OURS
from tcgsplat.evaluation.published import OURS_IN_PRINT
from tcgsplat.evaluation.uncertainty_plots import forest_plot, reliability_plot, sparsification_plot

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Of M. Okabe and K. Ito (2008): the colour-blind tell them apart."""
MARKS = ("o", "s", "^", "D", "v", "P")
WIDE = 20.0
"""Greatest over least value from which an axis is logarithmic."""


def figures(outcomes: Sequence[Outcome], sequences: Sequence[str], suite: Suite) -> Mapping[str, Figure]:
    """By the name of their file; only those for which there is something to draw."""
    drawn: dict[str, Figure] = {}
    printed = published.ATE.get(suite.name)
    columns = {source.name: source.column or "" for source in suite.sources}
    known = {name: printed.value(OURS_IN_PRINT, columns[name]) if printed else None for name in sequences}
    for name, metric, label, beside in (
        ("ate.svg", "ate_rmse", "ATE RMSE [cm]", known),
        ("psnr.svg", "psnr_withheld", "PSNR of views never mapped [dB]", {}),
    ):
        if any(one.value(metric) is not None for one in outcomes):
            drawn[name] = dots(outcomes, sequences, suite.presets, metric, label, beside)
    if len(suite.presets) > 1:
        differences = [one for one in paired(outcomes, "ate_rmse", suite.presets[-1]) if not math.isnan(one.mean)]
        if differences:
            drawn["difference.svg"] = forest_plot(differences, measure="ATE RMSE", unit="%")
    return drawn | _of_confidence(outcomes, sequences, suite)


def _of_confidence(outcomes: Sequence[Outcome], sequences: Sequence[str], suite: Suite) -> dict[str, Figure]:
    """Of the runs that were watched: the confidence of every preset beside other measures of the first one's runs, and
    how well the first one's lets depth errors be expected.
    """
    runs: dict[str, list[tuple[str, Watched]]] = {}
    for one in outcomes:
        if one.watched is not None and one.state == "done" and one.watched.curves:
            runs.setdefault(one.preset, []).append((one.sequence, one.watched))
    presets = [preset for preset in suite.presets if preset in runs]
    if not presets:
        return {}
    first = [run for _, run in runs[presets[0]]]
    lines = {f"{OURS}, {preset}": (OURS, [run for _, run in runs[preset]]) for preset in presets}
    lines |= {rival: (rival, first) for rival in RIVALS}
    drawn = {
        "sparsification.svg": sparsification_plot(
            {name: [run.curves[measure] for run in of] for name, (measure, of) in lines.items()},
            scores={name: _mean(run.score("ause", measure) for run in of) for name, (measure, of) in lines.items()},
            what="run",
            title="Depth error left after the most doubtful pixels are removed; predicted before seen",
        )
    }
    pairs = {}
    for name in sequences:
        of = [run for sequence, run in runs[presets[0]] if sequence == name]
        if of:
            pairs[name] = np.concatenate([run.doubt for run in of]), np.concatenate([run.error for run in of])
    reliabilities = leave_one_out(pairs)
    if reliabilities:
        title = f"Depth error, preset {presets[0]}, expectation fitted to the other sequences"
        drawn["reliability.svg"] = reliability_plot(reliabilities, title=title)
    return drawn


def _mean(values: Iterable[float | None]) -> float:
    """Of those that are defined."""
    defined = [value for value in values if value is not None]
    return float(np.mean(defined)) if defined else math.nan


def dots(
    outcomes: Sequence[Outcome],
    sequences: Sequence[str],
    presets: Sequence[str],
    metric: str,
    label: str,
    beside: Mapping[str, float | None],
    *,
    width: int = 1200,
) -> Figure:
    """A column for each sequence: a dot for each seed and a bar for their mean, preset beside preset.

    Args:
        outcomes: The runs; those that are not done are left out.
        sequences: In order.
        presets: In order.
        metric: What is drawn.
        label: Of the axis, with the unit.
        beside: The paper's own published figure by sequence, drawn as a grey line.
        width: Pixels.
    """
    left, top, height = 82, 56, 340
    figure = canvas.blank(width, top + height + 50)
    panel = canvas.axes(figure, left, top, width - left - 20, height)
    panel.grid(axis="y", color="0.92", linewidth=0.8)
    panel.set_axisbelow(True)
    panel.tick_params(labelsize=12, colors=canvas.INK, length=3)
    panel.spines[["top", "right"]].set_visible(False)
    panel.spines[["left", "bottom"]].set_color("0.6")
    every: list[float] = []
    for k, preset in enumerate(presets):
        color, mark = COLORS[k % len(COLORS)], MARKS[k % len(MARKS)]
        labelled = False
        for i, sequence in enumerate(sequences):
            found = [one.value(metric) for one in outcomes if (one.preset, one.sequence) == (preset, sequence)]
            values = [value for value in found if value is not None]
            if not values:
                continue
            middle = i + 0.24 * (k - (len(presets) - 1) / 2)
            across = middle + 0.03 * (np.arange(len(values)) - (len(values) - 1) / 2)
            told = None if labelled else f"{preset}, a dot for a seed"
            panel.plot(across, values, mark, color=color, markersize=8, markeredgewidth=0, alpha=0.75, label=told)
            panel.plot((middle - 0.1, middle + 0.1), [float(np.mean(values))] * 2, color=color, linewidth=2.6)
            labelled, every = True, every + values
    published_shown = False
    for i, sequence in enumerate(sequences):
        value = beside.get(sequence)
        if value is not None:
            told = None if published_shown else "TCGSplat, published"
            panel.plot((i - 0.4, i + 0.4), (value, value), color="0.45", linewidth=1.6, dashes=(5, 3), label=told)
            published_shown, every = True, [*every, value]
    positive = [value for value in every if value > 0]
    if positive and len(positive) == len(every) and max(positive) > WIDE * min(positive):
        panel.set_yscale("log")
    elif metric.startswith("ate"):
        panel.set_ylim(0, 1.08 * max(every))
    panel.set_xlim(-0.5, len(sequences) - 0.5)
    panel.set_xticks(range(len(sequences)), list(sequences))
    panel.set_ylabel(label, fontsize=13, color=canvas.INK)
    canvas.legend(figure, panel, width - 20, top / 2)
    return figure
