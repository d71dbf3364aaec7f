"""One run of a suite, from its data to its report, and what is kept of it."""

import io
import json
import logging
import shutil
from collections.abc import Mapping
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, Literal

from tcgsplat.cli import refine
from tcgsplat.cli.bench.suites import Source
from tcgsplat.cli.bench.watching import Observer, Watched
from tcgsplat.cli.progress import counting
from tcgsplat.cli.recorder import Part, begin, recorded, resume
from tcgsplat.cli.scoring import scored
from tcgsplat.cli.summary import versions
from tcgsplat.config import SlamConfig, from_toml
from tcgsplat.datasets.synthetic import synthesize
from tcgsplat.datasets.truth import Truth
from tcgsplat.errors import ArchiveError, DatasetError, EvaluationError, TCGSplatError
from tcgsplat.evaluation.metrics import Metric, Report
from tcgsplat.evaluation.prediction import OURS
from tcgsplat.evaluation.surface import true_mesh_path
from tcgsplat.render.backends import open_rasterizer
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.storage import atomic
from tcgsplat.storage.run_directory import RunDirectory

logger = logging.getLogger(__name__)

State = Literal["done", "lost", "failed", "missing", "waiting"]
MOST_LOST = 0.5
"""Share of lost frames above which a run counts as lost: the error of what is left of its path says nothing."""
WATCHED = "confidence.json"
"""In a run directory: what watching the run has shown of its confidence."""
WATCHED_EVERY: Final = 10
"""Frames; predicting one and scoring that takes as long as three or four steps of SLAM."""
RIVALS: Final = ("opacity", "observations", "previous residual", "depth edge")
"""Other measures of doubt, which cost little and confidence has to beat."""
KEPT = (
    *("config.toml", "request.json", "summary.json", "report.json", "bench.json", "trajectory.txt", "run.json"),
    WATCHED,
)
"""Small files of a run, which a worker on another machine gives back."""


@dataclass(frozen=True)
class Job:
    """A run to be made."""

    source: Source
    folder: Path
    """Of the frames; of a synthetic sequence it need not be there yet."""
    preset: str
    seed: int
    config_toml: str
    """All settings, the seed among them."""
    part: Part = field(default_factory=Part)
    backend: str = "auto"
    lpips: Path | None = None
    """Weights, as for `tcgsplat eval`."""
    refine: int = 0
    """Steps for each keyframe that the one map is refined by before it is scored."""
    stride: int = 1
    """Of the keyframes that are drawn, as `Suite.stride`."""
    withheld_every: int | None = None
    """As `Suite.withheld_every`."""

    @property
    def key(self) -> tuple[str, str, int]:
        """Preset, sequence, seed: arm, sequence and seed of `evaluation.paired`."""
        return self.preset, self.source.name, self.seed

    @property
    def place(self) -> Path:
        """Of its run directory, below that of the suite."""
        return Path("runs") / self.source.slug / self.preset / str(self.seed)

    @property
    def identity(self) -> dict[str, Any]:
        """All that its figures hang on, but for the machine; as JSON has it."""
        data = asdict(self.source.synth) if self.source.synth else str(self.folder.expanduser().resolve())
        return {
            "data": data,
            "part": asdict(self.part),
            "backend": self.backend,
            "lpips": None if self.lpips is None else str(self.lpips),
            "refine": self.refine,
            "views": [self.stride, self.withheld_every],
            "watched": [WATCHED_EVERY, *RIVALS],
            "surface": find_spec("open3d") is not None,
            "versions": versions(),
            "config": self.config_toml,
        }

    def __str__(self) -> str:
        """For a person."""
        return f"{self.source.name}, {self.preset}, seed {self.seed}"


@dataclass(frozen=True)
class Outcome:
    """What came of a run."""

    sequence: str
    preset: str
    seed: int
    state: State
    why: str = ""
    """In words, where it is not done."""
    metrics: Mapping[str, Metric] = field(default_factory=dict)
    absent: Mapping[str, str] = field(default_factory=dict)
    """Why a metric is not there, by its name."""
    evaluated: Mapping[str, str] = field(default_factory=dict)
    """Which frames, poses and pixels."""
    summary: Mapping[str, Any] = field(default_factory=dict)
    """Of the run: times by stage, versions, machine."""
    place: str = ""
    """Of its run directory, below that of the suite; config.toml in it has its settings in full."""
    watched: Watched | None = None
    """What its confidence told, where the truth is known."""

    @property
    def key(self) -> tuple[str, str, int]:
        """As `Job.key`."""
        return self.preset, self.sequence, self.seed

    def value(self, metric: str) -> float | None:
        """Of one that counts; None if the run is not done or does not have it."""
        found = self.metrics.get(metric)
        return None if found is None or self.state != "done" else float(found.value)

    def to_json(self) -> dict[str, Any]:
        """For `results.json`."""
        metrics = {name: {"value": metric.value, "unit": metric.unit} for name, metric in self.metrics.items()}
        config = f"{self.place}/config.toml" if self.place else None
        confidence = None if self.watched is None else self.watched.figures
        plain = asdict(replace(self, watched=None))
        del plain["watched"]
        return {**plain, "metrics": metrics, "config": config, "confidence": confidence}

    @staticmethod
    def without(job: Job, state: State, why: str) -> "Outcome":
        """Of a run that gave no report."""
        return Outcome(job.source.name, job.preset, job.seed, state, why, place=job.place.as_posix())


def performed(job: Job, path: Path) -> Report:
    """Run and score a job; what it was resumed from is used where it is of the same job.

    This is `tcgsplat run --resume`, `refine` and `eval`, in one process; where the truth is known, the run is watched.

    Args:
        job: Its data must be there.
        path: Its run directory.

    Raises:
        TCGSplatError: if it cannot be run, or there is nothing to score.
        KeyboardInterrupt: at Ctrl-C; the frames that were mapped are kept.
    """
    config, rasterizer = from_toml(job.config_toml), open_rasterizer(job.backend)  # type: ignore[arg-type]
    sequence, truth = job.part.open(job.folder), Truth.of(job.folder, **asdict(job.part))
    run = _begun(job, path, watched=truth is not None)
    if not run.summary() or run.summary().get("interrupted"):
        observer = None if truth is None else _observer(truth, config, rasterizer)
        summary = recorded(
            sequence, config, rasterizer, run, job.preset, watch=None if observer is None else observer.observe
        )
        if summary.interrupted:
            raise KeyboardInterrupt(f"stopped; saved {summary}: {run.path}")
        if observer is not None:
            Watched.of(observer.found).write(path / WATCHED)
    if job.refine and not (path / "map.npz").exists():
        with redirect_stdout(io.StringIO()):  # the report tells the same
            stopped = refine.command(refine.Args(path, steps=job.refine, backend=job.backend))
        if stopped:
            (path / "map.npz").unlink(missing_ok=True)  # refined by fewer steps than asked for
            raise KeyboardInterrupt(f"stopped while the map was refined: {run.path}")
    true_mesh = true_mesh_path(job.folder) if find_spec("open3d") else None
    try:
        return scored(run, sequence, rasterizer, job.stride, job.withheld_every, job.lpips, true_mesh)
    except EvaluationError as error:
        if true_mesh is None:
            raise
        logger.warning("%s: there are no figures of the surface: %s", job, error)
        return scored(run, sequence, rasterizer, job.stride, job.withheld_every, job.lpips)


def _observer(truth: Truth, config: SlamConfig, rasterizer: Rasterizer) -> Observer:
    return Observer(truth, config, rasterizer, WATCHED_EVERY, color=False, measures=(OURS, *RIVALS))


def _begun(job: Job, path: Path, *, watched: bool) -> RunDirectory:
    """The run directory of the same job, finished or not; or a new one in the place of what is there.

    A run that is watched is not gone on with: what its observer saw is written at its end only, and a run takes
    seconds.
    """
    config = from_toml(job.config_toml)
    usable = not watched or Watched.read(path / WATCHED) is not None
    if usable and _told(path / "bench.json") == job.identity:
        try:
            run = RunDirectory.open(path)
            unfinished = not run.summary() or run.summary().get("interrupted")
            return resume(path, config, job.folder, job.part) if unfinished else run
        except ArchiveError as error:
            logger.warning("%s; it begins anew", error)
    if path.exists():
        shutil.rmtree(path)
    run = begin(path, config, job.folder, job.part, overwrite=False)
    atomic.write_text(path / "bench.json", json.dumps(job.identity, indent=2) + "\n")
    return run


def attempted(job: Job, out: Path) -> Outcome:
    """What comes of a job; a failure of our own is an outcome too.

    Raises:
        KeyboardInterrupt: at Ctrl-C.
    """
    path = out / job.place
    try:
        performed(job, path)
    except TCGSplatError as error:
        return Outcome.without(job, "failed", str(error))
    outcome = finished(job, out)
    return outcome or Outcome.without(job, "failed", f"{path} has no complete report.json; look there")


def finished(job: Job, out: Path) -> Outcome | None:
    """What came of a job before, with the same settings, data and versions; None if it has to be run."""
    path = out / job.place
    if _told(path / "bench.json") != job.identity:
        return None
    report, summary = _told(path / "report.json"), _told(path / "summary.json")
    if not report or not summary or summary.get("interrupted"):
        return None
    try:
        evaluated = report.pop("evaluated")
        metrics = {name: Metric(one["value"], one["unit"]) for name, one in report.items()}
        absent = dict(evaluated.pop("missing"))
        frames, lost = int(summary["frames"]), int(summary["frames_lost"])
    except (KeyError, TypeError, ValueError):
        return None
    too_lost = lost > MOST_LOST * frames
    return Outcome(
        *(job.source.name, job.preset, job.seed),
        state="lost" if too_lost else "done",
        why=f"tracking was lost in {lost} of {frames} frames" if too_lost else "",
        metrics=metrics,
        absent=absent,
        evaluated=evaluated,
        summary=summary,
        place=job.place.as_posix(),
        watched=Watched.read(path / WATCHED),
    )


def made(job: Job) -> None:
    """Make a synthetic sequence where it is not there, or is another one.

    Raises:
        DatasetError: if something else is in its place.
    """
    folder, synth = job.folder, job.source.synth
    if synth is None:
        return
    told = folder.with_name(f"{folder.name}.json")
    before = _told(told)
    if folder.exists():
        if before == asdict(synth):
            return
        if not before:
            raise DatasetError(f"{folder} was made by no bench; move it away, or choose another --out")
        shutil.rmtree(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    atomic.write_text(told, json.dumps(asdict(synth), indent=2) + "\n")  # first, as the folder comes complete
    with counting(f"{job.source.name}: frame") as progress:
        synthesize(folder, synth, progress)


def _told(path: Path) -> dict[str, Any]:
    """The object in a JSON file; empty if there is none that can be read."""
    try:
        written = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return written if isinstance(written, dict) else {}
