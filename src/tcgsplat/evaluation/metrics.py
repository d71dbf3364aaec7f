"""What an evaluation gives: metrics with their units, as JSON and as tables for people."""

import json
import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from tcgsplat.storage import atomic

VIEW_FIGURES: Final[Mapping[str, tuple[str, str]]] = {
    "psnr": ("psnr{}", "dB"),
    "psnr_unexposed": ("psnr{}_unexposed", "dB"),
    "psnr_mapped": ("psnr{}_mapped", "dB"),
    "ssim": ("ssim{}", ""),
    "ms_ssim": ("ms_ssim{}", ""),
    "lpips": ("lpips{}", ""),
    "depth_l1": ("depth_l1{}", "cm"),
    "coverage": ("coverage{}", "%"),
    "depth_coverage": ("depth_coverage{}", "%"),
}
"""Figures of a view, the metrics that are their means, with the kind of view to be filled in, and their unit."""
VIEW_KINDS: Final = ("", "_withheld", "_map", "_map_withheld")
"""Training and withheld views, drawn from their own submap, and from the one map."""

_OF_VIEWS: Final = frozenset(metric.format(kind) for metric, _ in VIEW_FIGURES.values() for kind in VIEW_KINDS)
_HEADINGS: Final = (("submaps, as mapped online", "all in one map"), ("training", "withheld") * 2)
_COLUMN: Final = 14
_LINE: Final = 120
"""Characters."""


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


Row = Metric | str
"""A metric, or in words why there is none."""


@dataclass(frozen=True)
class Report:
    """Metrics by name, and a description of what they were measured on."""

    metrics: Mapping[str, Metric]
    evaluated: Mapping[str, str] = field(default_factory=dict)
    """Which frames, poses and pixels."""
    missing: Mapping[str, str] = field(default_factory=dict)
    """Why a metric is not there, by its name."""

    @staticmethod
    def of(rows: Mapping[str, Row], evaluated: Mapping[str, str]) -> "Report":
        """A report of what there is, and why the rest is not."""
        return Report(
            metrics={name: row for name, row in rows.items() if isinstance(row, Metric)},
            evaluated=evaluated,
            missing={name: row for name, row in rows.items() if isinstance(row, str)},
        )

    def to_json(self) -> str:
        """An object from metric name to `{"value", "unit"}`; `evaluated` has the rest, `missing` among it."""
        rows = {name: {"value": metric.value, "unit": metric.unit} for name, metric in self.metrics.items()}
        evaluated = {**self.evaluated, "missing": dict(self.missing)}
        return json.dumps({**rows, "evaluated": evaluated}, indent=2, allow_nan=False) + "\n"

    def figures(self) -> str:
        """For a terminal: a metric a line, but those of views as a table, each kind of view in a column."""
        rows: dict[str, Row] = {**self.metrics, **self.missing}
        first = next((i for i, name in enumerate(rows) if name in _OF_VIEWS), len(rows))
        plain = [(i, name) for i, name in enumerate(rows) if name not in _OF_VIEWS]
        before, after = ([name for i, name in plain if (i < first) is early] for early in (True, False))
        width = max(map(len, (*before, *after, *VIEW_FIGURES)))
        parts = (_listed(rows, before, width), _of_views(rows, width), _listed(rows, after, width))
        return "\n\n".join("\n".join(part) for part in parts if part)

    def table(self) -> str:
        """For a terminal: the figures, then what was evaluated."""
        width = max(map(len, self.evaluated), default=0)
        told = [_wrapped(f"{name:<{width}}  ", text) for name, text in self.evaluated.items()]
        return "\n\n".join(part for part in (self.figures(), "\n".join(told)) if part)

    def write(self, path: Path) -> None:
        """Put the JSON at `path`."""
        atomic.write_text(path, self.to_json())


def _listed(rows: Mapping[str, Row], names: Iterable[str], width: int) -> list[str]:
    """A metric a line."""
    told = {name: f"- ({row})" if isinstance(row, str) else str(row) for name, row in rows.items()}
    return [f"{name:<{width}}  {told[name]}" for name in names]


def _of_views(rows: Mapping[str, Row], width: int) -> list[str]:
    """A figure a line, a kind of view a column; why there is none is told once below."""
    grid = {
        figure: [rows.get(metric.format(kind)) for kind in VIEW_KINDS] for figure, (metric, _) in VIEW_FIGURES.items()
    }
    reasons = list(dict.fromkeys(row for line in grid.values() for row in line if isinstance(row, str)))

    def told(row: Row | None) -> str:
        return f"- ({reasons.index(row) + 1})" if isinstance(row, str) else str(row or "")

    def line(label: str, cells: Sequence[str]) -> str:
        column = _COLUMN * len(VIEW_KINDS) // len(cells)
        return (f"{label:<{width}}  " + "".join(f"{cell:<{column}}" for cell in cells)).rstrip()

    shown = [line(figure, [told(cell) for cell in cells]) for figure, cells in grid.items() if any(cells)]
    notes = [_wrapped(f"({i})  ", reason) for i, reason in enumerate(reasons, start=1)]
    return [*(line("", heading) for heading in _HEADINGS), *shown, *notes] if shown else []


def _wrapped(label: str, text: str) -> str:
    """Text beside a label, in lines that are not too long."""
    return textwrap.fill(
        text,
        _LINE,
        initial_indent=label,
        subsequent_indent=" " * len(label),
        break_long_words=False,
        break_on_hyphens=False,
    )
