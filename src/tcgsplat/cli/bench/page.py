"""What a bench leaves for people: results.json, and README.md with tables and figures."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tcgsplat.cli.bench import plots, tables
from tcgsplat.cli.bench.performing import MOST_LOST, Job, Outcome, State
from tcgsplat.cli.bench.suites import Suite
from tcgsplat.cli.summary import machine, versions
from tcgsplat.evaluation import published
from tcgsplat.evaluation.uncertainty_plots import write as write_figure
from tcgsplat.storage import atomic


@dataclass(frozen=True)
class Results:
    """A suite and what came of its runs, in order."""

    suite: Suite
    settings: Mapping[str, str]
    """Changed by flags, by dotted path."""
    outcomes: tuple[Outcome, ...]

    @staticmethod
    def begun(
        suite: Suite, settings: Mapping[str, str], jobs: tuple[Job, ...], missing: tuple[Outcome, ...]
    ) -> "Results":
        """Before any run: all of them are waiting, or miss their files."""
        waiting = [Outcome.without(job, "waiting", "not run yet") for job in jobs]
        order = {source.name: i for i, source in enumerate(suite.sources)}
        outcomes = sorted([*waiting, *missing], key=lambda one: (one.seed, order[one.sequence]))
        return Results(suite, settings, tuple(outcomes))

    def with_outcome(self, outcome: Outcome) -> "Results":
        """One run further."""
        return replace(self, outcomes=tuple(outcome if one.key == outcome.key else one for one in self.outcomes))

    def count(self, state: State) -> int:
        """Runs in a state."""
        return sum(one.state == state for one in self.outcomes)

    @property
    def sequences(self) -> tuple[str, ...]:
        """Whose files are there."""
        there = {one.sequence for one in self.outcomes if one.state != "missing"}
        return tuple(source.name for source in self.suite.sources if source.name in there)

    def to_json(self) -> dict[str, Any]:
        """All of it."""
        return {
            "suite": self.suite.name,
            "settings": dict(self.settings),
            "versions": versions(),
            "machine": machine(),
            "runs": [one.to_json() for one in self.outcomes],
        }

    def write(self, out: Path) -> None:
        """Put results.json into a folder."""
        atomic.write_text(out / "results.json", json.dumps(self.to_json(), indent=2, allow_nan=False) + "\n")


def write_page(results: Results, out: Path) -> None:
    """Put README.md, its figures, and results.json into a folder."""
    results.write(out)
    figures = plots.figures(results.outcomes, results.sequences, results.suite)
    for name, figure in figures.items():
        write_figure(out / name, figure)
    atomic.write_text(out / "README.md", page(results, figures))


def page(results: Results, figures: Mapping[str, object] | None = None) -> str:
    """README.md as Markdown; of the figures, those by whose names it is given are shown."""
    figures = figures or {}
    suite, outcomes, sequences = results.suite, results.outcomes, results.sequences
    sections = [
        f"# {suite.title}: what was measured",
        _about(results),
        _missing(results),
        "## Trajectory",
        tables.ate(outcomes, sequences, suite),
        _picture(figures, "ate.svg", "ATE RMSE of each run: a dot for a seed, a bar for the mean over seeds"),
        "## Rendering",
        tables.rendering(outcomes, sequences, suite),
        _picture(figures, "psnr.svg", "PSNR of each run: a dot for a seed, a bar for the mean over seeds"),
        "## Reconstruction",
        tables.reconstruction(outcomes, sequences, suite),
        "## Does confidence help",
        tables.differences(outcomes, suite),
        _picture(figures, "difference.svg", "Difference of ATE RMSE between presets, on the same data and seeds"),
        "## Runtime",
        tables.runtime(outcomes, suite),
        confidence_section(results, figures),
        "## Every run",
        tables.runs(outcomes),
        "## Configuration and versions",
        _configuration(results),
    ]
    return "\n\n".join(section for section in sections if section) + "\n"


def confidence_section(results: Results, figures: Mapping[str, object]) -> str:
    """Whether confidence tells the truth, where that is known; nothing where it is not."""
    table = tables.confidence(results.outcomes, results.suite)
    if not table:
        return ""
    parts = (
        "## Is confidence true",
        table,
        _picture(
            figures,
            "sparsification.svg",
            "Depth error left when the most doubtful pixels are removed, mean over runs; the band is from the 10th to "
            "the 90th percentile of the runs of the thick line, which the other measures are of too",
        ),
        _picture(
            figures,
            "reliability.svg",
            "Depth error found over depth error expected, which is learnt from the other sequences; above the diagonal "
            "the map is too sure",
        ),
    )
    return "\n\n".join(part for part in parts if part)


def _about(results: Results) -> str:
    seeds = sorted({one.seed for one in results.outcomes})
    counts = {state: results.count(state) for state in ("done", "lost", "failed", "missing", "waiting")}  # type: ignore[arg-type]
    told = ", ".join(f"{count} {state}" for state, count in counts.items() if count)
    return (
        f"{len(results.suite.sources)} sequences, presets {_listed(results.suite.presets)}, seeds "
        f"{', '.join(map(str, seeds))}: {told}. `a ± b` is mean and standard deviation (n - 1) over seeds; without ± "
        f"there was one. A run counts as lost, and in no mean, if tracking was lost in more than "
        f"{100 * MOST_LOST:g} % of its frames. Rows in *italics* are **published**: printed in the TCGSplat paper, not "
        "measured here; each is one seed, and `*` marks methods that its authors ran again. All figures of all runs "
        "are in [results.json](results.json)."
    )


def _missing(results: Results) -> str:
    missing = {one.sequence: one.why for one in results.outcomes if one.state == "missing"}
    if not missing:
        return ""
    lines = "\n".join(f"- {sequence}: {why}" for sequence, why in missing.items())
    return f"Left out, because files are missing; {results.suite.advice}:\n\n{lines}"


def _picture(figures: Mapping[str, object], name: str, alt: str) -> str:
    return f"![{alt}]({name})" if name in figures else ""


def _configuration(results: Results) -> str:
    done = [one for one in results.outcomes if one.summary]
    machines = sorted({str(one.summary.get("machine")) for one in done})
    used = sorted({", ".join(f"{k} {v}" for k, v in one.summary.get("versions", {}).items()) for one in done})
    backends = sorted({str(one.summary.get("backend")) for one in done})
    changed = ", ".join(f"`{path} = {value}`" for path, value in results.settings.items())
    lines = [
        f"Settings changed by flags: {changed}." if changed else "",
        "The settings of each run in full are in its config.toml, and its figures in its report.json: the table above "
        "links to both.",
        *(f"- Machine: {name}" for name in machines),
        *(f"- Versions: {text}" for text in used),
        *(f"- Rasterizer: {name}" for name in backends),
        *_made(results),
        f"- Published numbers: {published.ABLATION.source.split(',')[0]}, tables 1 to 7",
    ]
    sentences = [line for line in lines if line and not line.startswith("- ")]
    items = [line for line in lines if line.startswith("- ")]
    return "\n\n".join((*sentences, "\n".join(items)))


def _made(results: Results) -> list[str]:
    """How the synthetic sequences were made, but for what is as ever."""
    told = []
    for source in results.suite.sources:
        if source.synth:
            on = [name for name, value in vars(source.synth).items() if value is True]
            size = f"{source.synth.frames} frames, {source.synth.width}x{source.synth.height}, seed {source.synth.seed}"
            told.append(f"- Sequence {source.name}: {', '.join((size, *on))}")
    return told


def _listed(names: tuple[str, ...]) -> str:
    return ", ".join(f"`{name}`" for name in names)
