"""`tcgsplat bench ablation`: what it is worth that confidence guides mapping, tracking and loop closure (Table 6)."""

import json
import statistics
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from tcgsplat import datasets
from tcgsplat.cli.bench import Ablation, tables
from tcgsplat.cli.bench.track import measured
from tcgsplat.cli.progress import say
from tcgsplat.cli.recorder import Part
from tcgsplat.cli.settings import resolved
from tcgsplat.cli.summary import machine, versions
from tcgsplat.cli.usage import UsageError
from tcgsplat.config import SlamConfig, settings, value_text, with_settings
from tcgsplat.errors import ArchiveError, EvaluationError
from tcgsplat.render.backends import open_rasterizer
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.storage import atomic
from tcgsplat.tensors import Pose


@dataclass(frozen=True)
class Row:
    """A row of Table 6."""

    method: str
    mapping: bool
    tracking: bool
    loop: bool
    published_cm: float
    """ATE RMSE on ScanNet scene 0181 (base system in row I), published without a spread."""

    @property
    def switches(self) -> dict[str, bool]:
        """The settings that the rows differ in."""
        return {
            "confidence.guide_mapping": self.mapping,
            "confidence.guide_tracking": self.tracking,
            "confidence.rerank_views": self.loop,
        }


ROWS = (
    Row("I", False, False, False, 14.1),
    Row("II", True, False, False, 12.8),
    Row("III", True, True, False, 12.1),
    Row("IV", True, True, True, 10.4),
)


@dataclass(frozen=True)
class Run:
    """One way through the sequence."""

    method: str
    """Of the row."""
    seed: int
    ate_rmse_cm: float
    """After rigid alignment, over all frames whose true pose is known, lost ones included."""
    frames: int
    frames_lost: int
    seconds: float


@dataclass(frozen=True)
class Results:
    """The runs that are finished, and what they have in common."""

    common: Mapping[str, str]
    """Data, backend, versions and settings, but for the seed and the switches of the rows: by name, as text."""
    runs: tuple[Run, ...] = ()

    def of(self, row: Row, seeds: Sequence[int]) -> list[Run]:
        """Those of a row with some seeds."""
        return [run for run in self.runs if run.method == row.method and run.seed in seeds]

    def with_run(self, run: Run) -> "Results":
        """One more."""
        return Results(self.common, (*self.runs, run))

    def write(self, path: Path) -> None:
        """As JSON."""
        written = {"common": dict(self.common), "runs": [asdict(run) for run in self.runs]}
        atomic.write_text(path, json.dumps(written, indent=2, allow_nan=False) + "\n")

    @staticmethod
    def begun(path: Path, common: Mapping[str, str]) -> "Results":
        """Those of a file, to go on from; none if there is no file.

        Raises:
            ArchiveError: if it cannot be read, or its runs are of other data or settings.
        """
        if not path.exists():
            return Results(common)
        try:
            written = json.loads(path.read_text(encoding="utf-8"))
            there, runs = dict(written["common"]), tuple(Run(**run) for run in written["runs"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ArchiveError(f"cannot read {path} ({error}); remove it, or give another folder by --out") from error
        names = [name for name in {**there, **common} if there.get(name) != common.get(name)]
        if names:
            shown = "; ".join(
                f"{name} {there.get(name, 'unset')}, now {common.get(name, 'unset')}" for name in names[:5]
            )
            more = f"; and {len(names) - 5} more" * (len(names) > 5)
            raise ArchiveError(
                f"{path} holds runs with {shown}{more}; give another folder by --out, or remove the file"
            )
        return Results(common, runs)


def command(args: Ablation, flags: Mapping[str, str]) -> int:
    """Do the runs that are missing, print the table, and write it down."""
    config = _config(args, flags)
    part = Part(args.start, args.stride, args.limit)
    sequence = part.open(args.folder)
    truth = sequence.ground_truth()
    if len(truth) < 3:
        raise EvaluationError(
            f"{args.folder} has true poses for {len(truth)} of {len(sequence)} frames: the error of a path needs at "
            "least 3; choose a sequence with ground truth"
        )
    rasterizer = open_rasterizer(args.backend)  # type: ignore[arg-type]  # it checks the name
    out = args.out or Path("runs") / f"ablation-{sequence.name}"
    seeds = range(config.seed, config.seed + args.seeds)
    results = Results.begun(out / "ablation.json", _common(args.folder, part, rasterizer, config))
    out.mkdir(parents=True, exist_ok=True)
    results = completed(results, sequence, truth, config, seeds, rasterizer, out)
    changed = "".join(f", {path} = {value}" for path, value in flags.items())
    about = (
        f"{sequence.name}, {results.runs[0].frames} frames; {rasterizer.name}, preset {args.preset}{changed}, seeds "
        f"{', '.join(map(str, seeds))}; {machine()}"
    )
    atomic.write_text(out / "ablation.md", f"# Ablation: {about}\n\n{markdown(results, seeds)}\n\n{NOTE}\n")
    sys.stdout.write(f"{about}\n{table(results, seeds)}\n{NOTE}\n{out / 'ablation.md'}, {out / 'ablation.json'}\n")
    return 0


def _config(args: Ablation, flags: Mapping[str, str]) -> SlamConfig:
    """The settings that all rows share.

    Raises:
        UsageError: if there is to be no run, or a flag sets what the rows differ in.
    """
    if args.seeds < 1:
        raise UsageError(f"--seeds is {args.seeds}; give at least 1")
    for path in ROWS[0].switches:
        if path in flags:
            raise UsageError(f"--{path} is what the rows differ in; leave it out")
    return resolved(args.preset, args.config, flags, args.seed)


def _common(folder: Path, part: Part, rasterizer: Rasterizer, config: SlamConfig) -> dict[str, str]:
    """See `Results.common`."""
    about = {"sequence": str(folder.expanduser().resolve())} | {
        name: str(value) for name, value in asdict(part).items()
    }
    own = {"seed", *ROWS[0].switches}
    shared = {path: value_text(value) for path, value in settings(config).items() if path not in own}
    return {**about, "backend": rasterizer.name, **versions(), **shared}


def completed(
    results: Results,
    sequence: datasets.Sequence,
    truth: Mapping[int, Pose],
    config: SlamConfig,
    seeds: Sequence[int],
    rasterizer: Rasterizer,
    out: Path,
) -> Results:
    """The results with the runs that were missing; each is on disk as soon as it is done.

    Raises:
        EvaluationError: if fewer than three frames that could be read have a true pose.
        KeyboardInterrupt: at Ctrl-C, saying what is kept.
    """
    wanted = [(row, seed) for seed in seeds for row in ROWS]  # seed by seed: a whole table as soon as possible
    for number, (row, seed) in enumerate(wanted, start=1):
        if any(run.seed == seed for run in results.of(row, seeds)):
            continue
        say(f"run {number} of {len(wanted)}: row {row.method}, seed {seed}")
        try:
            timed = measured(sequence, with_settings(config, {**row.switches, "seed": seed}), rasterizer)
        except KeyboardInterrupt as interrupt:
            kept = f"{number - 1} of {len(wanted)} runs are kept in {out / 'ablation.json'}"
            raise KeyboardInterrupt(f"interrupted; {kept}: the same command goes on") from interrupt
        error = timed.ate_cm(truth)
        if error is None:
            raise EvaluationError(f"fewer than 3 frames of {sequence.name} that could be read have a true pose")
        seconds = sum(row["frame"] for row in timed.seconds) + timed.finish
        results = results.with_run(Run(row.method, seed, error, len(timed.T_world_cam), timed.lost, seconds))
        results.write(out / "ablation.json")
    return results


NOTE = (
    "ATE RMSE in cm after rigid alignment: mean and standard deviation (n - 1) over the seeds, least and greatest. "
    "Lost: frames, in all runs of the row. Paper: Table 6, ScanNet scene 0181, row I its base system, no spread given."
)
_HEAD = ("method", "mapping", "tracking", "loop", "ATE RMSE", "std", "min", "max", "lost", "paper")


def _cells(results: Results, seeds: Sequence[int]) -> list[tuple[str, ...]]:
    """The table's rows without its head."""
    rows = []
    for row in ROWS:
        runs = results.of(row, seeds)
        errors = [run.ate_rmse_cm for run in runs]
        spread = f"{statistics.stdev(errors):.3f}" if len(errors) > 1 else "-"
        means = f"{statistics.fmean(errors):.3f}", spread, f"{min(errors):.3f}", f"{max(errors):.3f}"
        switches = ("yes" if on else "-" for on in row.switches.values())
        rows.append((row.method, *switches, *means, str(sum(run.frames_lost for run in runs)), f"{row.published_cm}"))
    return rows


def table(results: Results, seeds: Sequence[int]) -> str:
    """For a terminal."""
    lines = [_HEAD, *_cells(results, seeds)]
    return "\n".join(
        "".join(f"{cell:<10}" for cell in line[:4]) + "".join(f"{cell:>10}" for cell in line[4:]) for line in lines
    )


def markdown(results: Results, seeds: Sequence[int]) -> str:
    """For a page."""
    return tables.markdown(_HEAD, _cells(results, seeds), left=4)
