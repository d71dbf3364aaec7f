"""Figures of how true a confidence is, and of whether it helps.

Each is a matplotlib figure of a given width in pixels: `canvas.drawn` gives its pixels, `write` puts it into a file.
Colours are those of M. Okabe and K. Ito (2008), which the colour-blind tell apart; lines differ in their dashes too.
"""

import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, PercentFormatter

from tcgsplat.errors import EvaluationError
from tcgsplat.evaluation import canvas
from tcgsplat.evaluation.canvas import Pixels
from tcgsplat.evaluation.paired import PairedDifference
from tcgsplat.evaluation.reaction import Reaction, Series
from tcgsplat.evaluation.uncertainty import Reliability, Sparsification
from tcgsplat.storage import atomic

_OURS, _WORSE, _GREY = "#0072B2", "#D55E00", "0.45"
_COLORS = (_WORSE, "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#6A3D9A", "#8C5A2B")
"""Of all but the first line."""
_DASHES: tuple[Any, ...] = ((0, (6, 2)), (0, (2, 1.5)), (0, (7, 2, 1.5, 2)), (0, (4, 1, 1, 1, 1, 1)), (0, (10, 2)))
"""Beside seven colours, so that 35 lines differ."""
_CELLS = 25
"""Of the histogram."""
_TEXT = 13
_HIGHEST = 1.5
"""Of the curves shown, times the error of all pixels: that of a bad map shoots up where few pixels are left."""
_BAND = (10, 90)
"""Percentiles over images."""
_WIDE = 20.0
"""Greatest over least error from which axes are logarithmic."""


def write(path: Path, figure: Figure) -> None:
    """Put a figure at `path`, all of it or nothing: as SVG if the name ends so, else as PNG.

    Raises:
        OSError: if the folder is not there or the disk is full.
    """
    if path.suffix.lower() != ".svg":
        canvas.write_png(path, canvas.drawn(figure))
        return
    content = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "tcgsplat"}):  # else names inside are random, and no two files are equal
        FigureCanvasSVG(figure).print_svg(content, metadata={"Date": None})  # type: ignore[no-untyped-call]
    atomic.write_bytes(path, content.getvalue())


def sparsification_plot(
    maps: Mapping[str, Sequence[Sparsification]],
    *,
    scores: Mapping[str, float] | None = None,
    what: str = "image",
    title: str = "",
    width: int = 1200,
) -> Figure:
    """Error of the pixels left, over the share removed: mean over images of each map, of random and of the oracle.

    Each curve is relative to the error of all pixels of its image, so that images count the same. The first map is
    drawn thick, with a band from the 10th to the 90th percentile over images; the oracle is that of its images. The
    legend lists maps from the best to the worst, with the mean over images of their normalised AUSE.

    Args:
        maps: Curves of one or more images by the map's name, all with the same shares removed; ours first.
        scores: AUSE over random by the map's name, where it is another mean than that over the curves.
        what: A curve is of: an image, or all images of a run.
        title: Above the panel: what the error is, and of which images.
        width: Pixels.

    Raises:
        EvaluationError: if a map has no image with an error other than 0.
    """
    scored = {name: [curve for curve in curves if curve.random > 0] for name, curves in maps.items()}
    for name in (name for name, curves in scored.items() if not curves):
        raise EvaluationError(f"no image of {name!r} has any error; there is no sparsification to draw")
    relative = {name: np.stack([curve.error / curve.random for curve in curves]) for name, curves in scored.items()}
    if scores is None:
        scores = {name: _mean(curve.normalised_ause for curve in curves) for name, curves in scored.items()}
    lines = [replace(line, value=f"{scores[line.name]:.2f}") for line in _lines(maps)]
    random = _Line("random", "1.00", _GREY, (0, (5, 4)), 1.6)
    oracle = _Line("oracle", "0.00", "black", (0, (1, 1.5)), 2.0)
    ours = scored[lines[0].name]
    removed = 100.0 * ours[0].removed

    left, top, legend, height = 82, 48, 360, 470
    figure = canvas.blank(width, top + height + 66)
    panel = _panel(figure, left, top, width - left - legend, height)
    band = np.percentile(relative[lines[0].name], _BAND, axis=0)
    panel.fill_between(removed, band[0], band[1], color=_OURS, alpha=0.15, linewidth=0)
    panel.axhline(1.0, **random.style)
    panel.plot(removed, np.stack([curve.oracle / curve.random for curve in ours]).mean(axis=0), **oracle.style)
    for line in lines:  # the thick one below, so that one that coincides with it is seen
        panel.plot(removed, relative[line.name].mean(axis=0), **line.style)
    highest = max(curves.mean(axis=0).max() for curves in relative.values())
    panel.set(xlim=(0, 100), ylim=(0, float(np.clip(1.04 * highest, 1.1, _HIGHEST))))
    _label(panel, "most uncertain pixels removed [%]", "error of the rest / error of all")
    ranked = sorted(lines, key=lambda line: (math.isnan(scores[line.name]), scores[line.name]))
    _legend(figure, width - legend + 24, top, legend - 24, [*ranked, random, oracle], "AUSE / random")
    images = f"mean of {len(ours)} {what}s" if len(ours) > 1 else f"one {what}"
    canvas.write(figure, left, top / 2, ": ".join(part for part in (title, images) if part), size=_TEXT, align="left")
    return figure


def reliability_plot(
    maps: Mapping[str, Reliability],
    *,
    unit: str = "cm",
    scale: float = 100.0,
    title: str = "",
    width: int = 1000,
) -> Figure:
    """Error found over error expected, bin by bin, with how often each error is expected below.

    On the diagonal errors are as expected, above it worse: the map is too sure. Axes are logarithmic if the bins
    differ widely. The legend tells the calibration error relative to the mean error.

    Args:
        maps: By name; ours first.
        unit: Of the error, as shown; empty for colours in [0, 1].
        scale: From the error's unit to the one shown: 100 from metres to centimetres.
        title: Above the panel: what the error is, and of which images.
        width: Pixels.

    Raises:
        EvaluationError: if no map expects or finds any error.
    """
    lines = [replace(line, value=f"{100 * maps[line.name].normalised_ece:.0f} %") for line in _lines(maps)]
    shown = scale * np.concatenate([values for one in maps.values() for values in (one.expected, one.found)])
    if not (shown > 0).any():
        raise EvaluationError("no error is expected and none is found; there is no calibration to draw")
    logarithmic = bool(shown.max() > _WIDE * shown[shown > 0].min())
    least, most = (shown[shown > 0].min() / 1.4 if logarithmic else 0.0), shown.max() * (1.4 if logarithmic else 1.06)

    left, top, legend, gap, strip = 92, 48, 360, 18, 110
    side = width - left - legend
    figure = canvas.blank(width, top + side + gap + strip + 66)
    panel = _panel(figure, left, top, side, side)
    below = _panel(figure, left, top + side + gap, side, strip)
    cells = (np.geomspace if logarithmic else np.linspace)(least, most, _CELLS + 1)
    ideal = _Line("as expected", "", _GREY, (0, (5, 4)), 1.6)
    panel.plot((least, most), (least, most), **ideal.style)
    for line in lines:
        one = maps[line.name]
        expected, found = (np.maximum(scale * values, least) for values in (one.expected, one.found))
        panel.plot(expected, found, marker="o", markersize=8 if line is lines[0] else 5.5, clip_on=False, **line.style)
        share = 100.0 * np.histogram((scale * one.quantiles).clip(least, most), cells)[0] / len(one.quantiles)
        below.stairs(share, cells, fill=line is lines[0], alpha=0.25, color=line.color)
        below.stairs(share, cells, color=line.color, linewidth=line.thickness / 1.7)
    for axes in (panel, below):
        axes.set_xscale("log" if logarithmic else "linear")
        axes.set_xlim(least, most)
    panel.set_yscale("log" if logarithmic else "linear")
    panel.set_ylim(least, most)
    if logarithmic:
        for axis in (panel.xaxis, panel.yaxis, below.xaxis):
            axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(NullFormatter())
    panel.tick_params(labelbottom=False)
    below.yaxis.set_major_formatter(PercentFormatter(decimals=0))
    of = f" [{unit}]" if unit else ""
    _label(panel, "", f"error found{of}")
    _label(below, f"error expected{of}", "pixels")
    _legend(figure, width - legend + 24, top, legend - 24, [*lines, ideal], "calibration error")
    canvas.write(figure, left, top / 2, title, size=_TEXT, align="left")
    return figure


def forest_plot(
    differences: Sequence[PairedDifference],
    *,
    measure: str,
    unit: str = "",
    scale: float = 1.0,
    better: Literal["lower", "higher"] = "lower",
    width: int = 1200,
) -> Figure:
    """Difference of each arm to the reference: mean, interval, and the sequences as small dots.

    An interval without 0 in it is drawn in blue where the arm is better and in vermilion where it is worse; others are
    grey. Of a single pair there is neither an interval nor a test, and that is what the figure says.

    Args:
        differences: One or more, of one reference and level; the p shown is that of pairs.
        measure: What was measured, with its unit if any is not in `unit`.
        unit: As shown.
        scale: From the measure's unit to the one shown.
        better: Which way is good.
        width: Pixels.

    Raises:
        EvaluationError: if there is no difference to draw.
    """
    if not differences:
        raise EvaluationError("no arm shares a run with the reference; there is no difference to draw")
    left, top, right, row = 220, 50, 430, 46
    height = row * len(differences)
    figure = canvas.blank(width, top + height + 66)
    panel = _panel(figure, left, top, width - left - right, height)
    panel.axvline(0.0, color=canvas.INK, linewidth=1.2)
    columns = (width - 344, width - 164, width - 74, width - 14)
    largest = max(
        abs(scale * value) for one in differences for value in (one.mean, one.low, one.high) if value == value
    )
    decimals = max(0, 2 - math.floor(math.log10(largest))) if largest > 0 else 0
    for i, one in enumerate(differences):
        mean, low, high = (scale * value for value in (one.mean, one.low, one.high))
        color = _verdict(one, better)
        sequences = scale * np.array(list(one.by_sequence.values()))
        panel.plot(sequences, np.full(len(sequences), i + 0.26), "o", markersize=5, color="0.68", markeredgewidth=0)
        panel.plot((low, high), (i, i), color=color, linewidth=3.2, solid_capstyle="butt")
        panel.plot(mean, i, "D", color=color, markersize=9)
        y = top + row * (i + 0.5)
        canvas.write(figure, left - 14, y, one.arm, size=_TEXT, align="right")
        ends = " … ".join(_signed(value, decimals) for value in (low, high))
        interval = "none of one pair" if one.pairs == 1 else ends
        cells = (_signed(mean, decimals), interval, _p(one.p_of_pairs) if one.pairs > 1 else "none", str(one.pairs))
        for x, text in zip(columns, cells, strict=True):
            canvas.write(figure, x, y, text, size=_TEXT, align="right")
    panel.set_ylim(len(differences) - 0.5, -0.5)
    panel.set_yticks([])
    panel.spines["left"].set_visible(False)
    panel.margins(x=0.06)
    of = f" [{unit}]" if unit else ""
    _label(panel, f"{measure}, difference to {differences[0].reference!r}{of}", "")
    if better == "lower":
        canvas.write(figure, left, top - 20, "← better", size=12, align="left")
    else:
        canvas.write(figure, width - right, top - 20, "better →", size=12, align="right")
    for x, text in zip(columns, ("mean", f"{100 * differences[0].level:g} % interval", "p", "pairs"), strict=True):
        canvas.write(figure, x, top - 20, text, size=12, align="right")
    return figure


def fault_plot(
    series: Mapping[str, Series],
    fault_begins: int,
    fault_ends: int | None = None,
    *,
    reaction: Reaction | None = None,
    title: str = "",
    width: int = 1200,
) -> Figure:
    """Mean confidence of each frame around a fault, whose frames are shaded.

    Args:
        series: Of equal length, by what they are the mean of; first the one that the reaction is of.
        fault_begins: First frame with the fault.
        fault_ends: First frame without it again; without, it lasts to the end.
        reaction: Marks the threshold, and where the first series drops below it and is back above.
        title: Above the panel.
        width: Pixels.
    """
    lines = _lines(series)
    frames = np.arange(len(series[lines[0].name]))
    ends = len(frames) if fault_ends is None else fault_ends
    left, top, right, height = 82, 72, 20, 320
    figure = canvas.blank(width, top + height + 66)
    panel = _panel(figure, left, top, width - left - right, height)
    panel.axvspan(fault_begins - 0.5, ends - 0.5, color="#F0E442", alpha=0.3, linewidth=0, label="fault")
    for i, line in enumerate(lines):
        panel.plot(frames, series[line.name], label=line.name, zorder=3.0 - i / len(lines), **line.style)
    if reaction is not None and reaction.dropped:
        panel.axhline(reaction.threshold, color=_GREY, linewidth=1.2, linestyle=(0, (5, 4)))
        for begin, time, name, above in (
            (fault_begins, reaction.time_to_drop, "drops", 9),
            (ends, reaction.time_to_recover, "recovers", -19),
        ):
            if time is not None:
                text = f"{name} after {time} frame{'s' if time != 1 else ''}"
                panel.plot(begin + time, reaction.threshold, "o", markersize=10, color="black", zorder=4)
                panel.annotate(
                    text,
                    (begin + time, reaction.threshold),
                    xytext=(11, above),
                    textcoords="offset points",
                    fontsize=12,
                    color=canvas.INK,
                )
    panel.set(xlim=(0, len(frames) - 1), ylim=(0, 1))
    _label(panel, "frame", "mean confidence")
    canvas.write(figure, left, top / 3, title, size=_TEXT, align="left")
    canvas.legend(figure, panel, width - right, top * 2 / 3)
    return figure


@dataclass(frozen=True)
class _Line:
    """How a map is drawn, and what the legend says of it."""

    name: str
    value: str
    color: str
    dashes: Any
    thickness: float

    @property
    def style(self) -> dict[str, Any]:
        return {"color": self.color, "linestyle": self.dashes, "linewidth": self.thickness}


def _lines(names: Iterable[str]) -> list[_Line]:
    """The first one thick, the others thin, no two alike."""
    return [
        _Line(name, "", _COLORS[i % len(_COLORS)], _DASHES[i % len(_DASHES)], 1.9)
        if i >= 0
        else _Line(name, "", _OURS, "-", 3.4)
        for i, name in enumerate(names, start=-1)
    ]


def _legend(figure: Figure, x: Pixels, y: Pixels, width: Pixels, lines: Sequence[_Line], heading: str) -> None:
    """A row for each line from a place in pixels downwards: sample, value, name."""
    row = 30
    box = canvas.axes(figure, x, y, width, row * (len(lines) + 1))
    box.set(xlim=(0, width), ylim=(row * (len(lines) + 1), 0))
    box.set_axis_off()
    box.text(0, row / 2, heading, ha="left", va="center", size=12, color=canvas.INK)
    for i, line in enumerate(lines, start=1):
        middle = row * (i + 0.5)
        box.plot((0, 44), (middle, middle), **line.style)
        box.text(124, middle, line.value, ha="right", va="center", size=_TEXT, color=canvas.INK)
        box.text(138, middle, line.name, ha="left", va="center", size=_TEXT, color=canvas.INK)


def _panel(figure: Figure, x: Pixels, y: Pixels, width: Pixels, height: Pixels) -> Axes:
    panel = canvas.axes(figure, x, y, width, height)
    panel.grid(color="0.92", linewidth=0.8)
    panel.set_axisbelow(True)
    panel.tick_params(labelsize=12, colors=canvas.INK, length=3)
    panel.spines[["top", "right"]].set_visible(False)
    panel.spines[["left", "bottom"]].set_color("0.6")
    return panel


def _label(panel: Axes, x: str, y: str) -> None:
    panel.set_xlabel(x, fontsize=_TEXT, color=canvas.INK)
    panel.set_ylabel(y, fontsize=_TEXT, color=canvas.INK)


def _signed(value: float, decimals: int) -> str:
    return "?" if math.isnan(value) else f"{value:+.{decimals}f}".replace("-", "\N{MINUS SIGN}")


def _p(value: float) -> str:
    if math.isnan(value):
        return "none"
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def _mean(values: Iterable[float]) -> float:
    """Of those that are defined."""
    defined = [value for value in values if not math.isnan(value)]
    return float(np.mean(defined)) if defined else math.nan


def _verdict(one: PairedDifference, better: Literal["lower", "higher"]) -> str:
    """A colour: whether the interval lies on the good side of 0, on the bad one, or has 0 in it."""
    low, high = (one.low, one.high) if better == "lower" else (-one.high, -one.low)
    if high < 0:
        return _OURS
    return _WORSE if low > 0 else _GREY
