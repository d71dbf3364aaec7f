"""`tcgsplat bench ablation`: what it is worth that confidence guides the system, beside controls that know nothing."""

import json
import math
import statistics
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from tcgsplat import datasets
from tcgsplat.cli.bench import Ablation, tables
from tcgsplat.cli.bench.arms import ARMS, Arm, faulty, walked
from tcgsplat.cli.kernels import compile_kernels
from tcgsplat.cli.logs import say
from tcgsplat.cli.recorder import Part
from tcgsplat.cli.settings import resolved
from tcgsplat.cli.summary import machine, versions
from tcgsplat.cli.usage import UsageError
from tcgsplat.config import SlamConfig, settings, value_text
from tcgsplat.datasets.truth import Truth
from tcgsplat.errors import ArchiveError, EvaluationError
from tcgsplat.evaluation.paired import PairedDifference, paired_differences, relative_differences
from tcgsplat.evaluation.uncertainty_plots import forest_plot
from tcgsplat.evaluation.uncertainty_plots import write as write_figure
from tcgsplat.render.backends import open_rasterizer
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.storage import atomic
from tcgsplat.tensors import Pose

PER_SEQUENCE = 2
"""Seeds from which on a difference on one sequence has an interval."""


@dataclass(frozen=True)
class Run:
    """An arm's way through a sequence."""

    arm: str
    sequence: str
    """Its folder."""
    seed: int
    ate_rmse_cm: float
    psnr: float | None
    """dB, of views that were never mapped."""
    frames: int
    frames_lost: int
    seconds: float


@dataclass(frozen=True)
class Results:
    """The runs that are finished, and what they have in common."""

    common: Mapping[str, str]
    """Part of the sequences, backend, versions and settings, but for what arms differ in: by name, as text."""
    runs: tuple[Run, ...] = ()

    def find(self, arm: Arm, sequence: str, seed: int) -> Run | None:
        """One of them."""
        return next((run for run in self.runs if (run.arm, run.sequence, run.seed) == (arm.name, sequence, seed)), None)

    def of(self, arms: Sequence[Arm], sequences: Sequence[str], seeds: Sequence[int]) -> tuple[Run, ...]:
        """Those that were asked for, in order."""
        found = (self.find(arm, name, seed) for name in sequences for seed in seeds for arm in arms)
        return tuple(run for run in found if run is not None)

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
            ArchiveError: if it cannot be read, or its runs are of other settings.
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


@dataclass(frozen=True)
class Material:
    """A sequence to run the arms on."""

    sequence: datasets.Sequence
    folder: str
    poses: Mapping[int, Pose]
    """The true ones, by frame index."""
    truth: Truth | None
    """What else is known of it."""


def command(args: Ablation, flags: Mapping[str, str]) -> int:
    """Do the runs that are missing, print the tables, and write them down."""
    config, arms = _config(args, flags), _arms(args)
    part = Part(args.start, args.stride, args.limit)
    if not args.folders:
        raise UsageError("give the folders of the sequences, such as `tcgsplat synth FOLDER` makes")
    materials = [_opened(folder, part) for folder in args.folders]
    rasterizer = open_rasterizer(args.backend)  # type: ignore[arg-type]  # it checks the name
    out = args.out or Path("runs") / f"ablation-{'-'.join(one.sequence.name for one in materials)}"
    seeds = range(config.seed, config.seed + args.seeds)
    results = Results.begun(out / "ablation.json", _common(part, rasterizer, config))
    out.mkdir(parents=True, exist_ok=True)
    results = completed(results, materials, arms, config, seeds, rasterizer, out)
    names = {one.folder: one.sequence.name for one in materials}
    runs = [replace(run, sequence=names[run.sequence]) for run in results.of(arms, tuple(names), seeds)]
    groups = _groups(materials)
    changed = "".join(f", {path} = {value}" for path, value in flags.items())
    about = (
        f"{', '.join(names.values())}; {rasterizer.name}, preset {args.preset}{changed}, seeds "
        f"{', '.join(map(str, seeds))}; {machine()}"
    )
    figure = difference_plot(runs, tuple(names.values()))
    if figure is not None:
        write_figure(out / "difference.svg", figure)
    page = written(runs, arms, groups, about, drawn=figure is not None)
    atomic.write_text(out / "README.md", page)
    sys.stdout.write(f"{page}\n{out / 'README.md'}, {out / 'ablation.json'}\n")
    return 0


def _opened(folder: Path, part: Part) -> Material:
    """A sequence with what is known of it.

    Raises:
        EvaluationError: if there are fewer than three true poses.
    """
    sequence = part.open(folder)
    poses = sequence.ground_truth()
    if len(poses) < 3:
        raise EvaluationError(
            f"{folder} has true poses for {len(poses)} of {len(sequence)} frames: the error of a path needs at "
            "least 3; choose a sequence with ground truth"
        )
    truth = Truth.of(folder, start=part.start, stride=part.stride, limit=part.limit)
    return Material(sequence, str(folder.expanduser().resolve()), poses, truth)


def _arms(args: Ablation) -> tuple[Arm, ...]:
    """Those that were asked for, and the first one, which all others are compared with.

    Raises:
        UsageError: if there is none of such a name.
    """
    known = {arm.name: arm for arm in ARMS}
    for name in args.arms:
        if name not in known:
            raise UsageError(f"--arms: there is no {name}; choose from {', '.join(known)}")
    return tuple(arm for arm in ARMS if arm.name in args.arms or arm is ARMS[0]) if args.arms else ARMS


def _config(args: Ablation, flags: Mapping[str, str]) -> SlamConfig:
    """The settings that all arms share.

    Raises:
        UsageError: if there is to be no run, or a flag sets what the arms differ in.
    """
    if args.seeds < 1:
        raise UsageError(f"--seeds is {args.seeds}; give at least 1")
    for path in ARMS[0].switches:
        if path in flags:
            raise UsageError(f"--{path} is what the arms differ in; leave it out")
    return resolved(args.preset, args.config, flags, args.seed)


def _common(part: Part, rasterizer: Rasterizer, config: SlamConfig) -> dict[str, str]:
    """See `Results.common`."""
    about = {name: str(value) for name, value in asdict(part).items()}
    own = {"seed", *ARMS[0].switches}
    shared = {path: value_text(value) for path, value in settings(config).items() if path not in own}
    return {**about, "backend": rasterizer.name, **versions(), **shared}


def completed(
    results: Results,
    materials: Sequence[Material],
    arms: Sequence[Arm],
    config: SlamConfig,
    seeds: Sequence[int],
    rasterizer: Rasterizer,
    out: Path,
) -> Results:
    """The results with the runs that were missing; each is on disk as soon as it is done.

    An arm that knows the truth is left out where nobody does.

    Raises:
        EvaluationError: if fewer than three frames that could be read have a true pose.
        KeyboardInterrupt: at Ctrl-C, saying what is kept.
    """
    compile_kernels(config, rasterizer)
    wanted = [
        (one, arm, seed)  # seed by seed: whole tables as soon as possible
        for seed in seeds
        for one in materials
        for arm in arms
        if one.truth is not None or not arm.knows
    ]
    for number, (one, arm, seed) in enumerate(wanted, start=1):
        if results.find(arm, one.folder, seed):
            continue
        say(f"run {number} of {len(wanted)}: {one.sequence.name}, arm {arm.name}, seed {seed}")
        truth = one.truth if arm.knows else None
        try:
            found = walked(one.sequence, one.poses, arm.config(config, seed), rasterizer, truth)
        except KeyboardInterrupt as interrupt:
            kept = f"{number - 1} of {len(wanted)} runs are kept in {out / 'ablation.json'}"
            raise KeyboardInterrupt(f"interrupted; {kept}: the same command goes on") from interrupt
        results = results.with_run(Run(arm.name, one.folder, seed, **asdict(found)))
        results.write(out / "ablation.json")
    return results


def _groups(materials: Sequence[Material]) -> dict[str, tuple[str, ...]]:
    """Names of sequences that are looked at together."""
    kinds = {one.sequence.name: faulty(one.truth) for one in materials}
    groups = {
        "nothing wrong": tuple(name for name, kind in kinds.items() if kind is False),
        "with faults": tuple(name for name, kind in kinds.items() if kind),
    }
    return {"all": tuple(kinds), **groups} if all(groups.values()) else {"all": tuple(kinds)}


def differences(
    runs: Iterable[Run], sequences: Sequence[str], measure: str = "ate_rmse_cm"
) -> tuple[PairedDifference, ...]:
    """Every arm beside the first on the same sequences with the same seeds: ATE in percent of it, PSNR in dB."""
    values = {
        (run.arm, run.sequence, run.seed): value
        for run in runs
        if run.sequence in sequences and (value := getattr(run, measure)) is not None
    }
    if not any(arm == ARMS[0].name for arm, _, _ in values):
        return ()
    return (paired_differences if measure == "psnr" else relative_differences)(values, ARMS[0].name)


def difference_plot(runs: Sequence[Run], sequences: Sequence[str]):  # type: ignore[no-untyped-def]
    """Of the path's error, all sequences together; None without a pair."""
    found = differences(runs, sequences)
    told = {arm.name: f"{arm.name}, {arm.told}" if arm.published_cm else arm.name for arm in ARMS}
    named = [replace(one, arm=told[one.arm], reference=told[one.reference]) for one in found]
    return forest_plot(named, measure="ATE RMSE", unit="%") if named else None


NOTE = (
    "ATE RMSE in cm after rigid alignment: mean ± standard deviation (n - 1) over the seeds. Lost: frames, in all runs "
    "of the row. PSNR: views that were never mapped, drawn from the submap that they were tracked in. Paper: Table 6, "
    "ScanNet scene 0181, row I its base system, no spread given. `constant`, `shuffled` and `oracle` guide all three "
    "places by something else than the map's own confidence: the same for all, that of Gaussians elsewhere, and one "
    "made of the true depth, which no run has."
)
PAIRED = (
    "Each arm beside arm I on the same sequences with the same seeds. ATE: percent of that of I (mean of logarithms), "
    "less is better; PSNR: dB, more is better. Intervals are 95 % of a bootstrap over sequences and seeds, too narrow "
    "where sequences are few; p of the signed-rank test over pairs."
)


def written(
    runs: Sequence[Run], arms: Sequence[Arm], groups: Mapping[str, Sequence[str]], about: str, *, drawn: bool = False
) -> str:
    """The page."""
    parts = [f"# Ablation: {about}", _errors(runs, arms, groups["all"]), NOTE, "## Does it help", PAIRED]
    parts += [_paired(runs, arms, groups)]
    parts += ["![difference of the path's error](difference.svg)"] if drawn else []
    if len(groups["all"]) > 1:
        parts += ["## Sequence by sequence: ATE, percent of that of I", _by_sequence(runs, arms, groups["all"])]
    return "\n\n".join(parts) + "\n"


def _errors(runs: Sequence[Run], arms: Sequence[Arm], sequences: Sequence[str]) -> str:
    head = ("arm", "mapping", "tracking", "loop", *sequences, "mean", "PSNR", "lost", "paper")
    rows = []
    for arm in arms:
        own = [run for run in runs if run.arm == arm.name]
        if not own:
            continue
        by_sequence = [[run.ate_rmse_cm for run in own if run.sequence == name] for name in sequences]
        means = [statistics.fmean(values) for values in by_sequence if values]
        places = ("yes" if on else "-" for on in arm.switches.values())
        psnr = [run.psnr for run in own if run.psnr is not None]
        cells = (f"{statistics.fmean(means):.3f}", f"{statistics.fmean(psnr):.2f}" if psnr else "-")
        published = f"{arm.published_cm}" if arm.published_cm else ""
        lost = str(sum(run.frames_lost for run in own))
        rows.append((arm.name, *places, *map(_spread, by_sequence), *cells, lost, published))
    return tables.markdown(head, rows, left=4)


def _spread(values: Sequence[float]) -> str:
    if not values:
        return "-"
    mean = f"{statistics.fmean(values):.3f}"
    return f"{mean} ± {statistics.stdev(values):.3f}" if len(values) > 1 else mean


def _paired(runs: Sequence[Run], arms: Sequence[Arm], groups: Mapping[str, Sequence[str]]) -> str:
    rows = []
    told = {arm.name: arm.told for arm in arms}
    for group, sequences in groups.items():
        colors = {one.arm: one for one in differences(runs, sequences, "psnr")}
        for one in differences(runs, sequences):
            psnr = _interval(colors[one.arm], 2) if one.arm in colors else ("-", "-")
            p = "-" if math.isnan(one.p_of_pairs) else f"{one.p_of_pairs:.3f}" if one.p_of_pairs >= 5e-4 else "< 0.001"
            rows.append((group, one.arm, told[one.arm], *_interval(one, 1), p, *psnr, str(one.pairs)))
    head = ("sequences", "arm", "guides", "ATE %", "95 % interval", "p", "PSNR dB", "95 % interval", "pairs")
    return tables.markdown(head, rows, left=3) if rows else "There is no pair yet."


def _by_sequence(runs: Sequence[Run], arms: Sequence[Arm], sequences: Sequence[str]) -> str:
    found = {name: {one.arm: one for one in differences(runs, [name])} for name in sequences}
    rows = []
    for arm in arms:
        if any(arm.name in by_arm for by_arm in found.values()):
            rows.append((arm.name, *(_told(found[name].get(arm.name)) for name in sequences)))
    return tables.markdown(("arm", *sequences), rows)


def _told(one: PairedDifference | None) -> str:
    if one is None:
        return "-"
    mean, interval = _interval(one, 1)
    return f"{mean} ({interval})" if one.pairs >= PER_SEQUENCE else mean


def _interval(one: PairedDifference, decimals: int) -> tuple[str, str]:
    """Mean, and the interval around it."""
    interval = "-" if math.isnan(one.low) else f"{one.low:+.{decimals}f} … {one.high:+.{decimals}f}"
    return f"{one.mean:+.{decimals}f}", interval
