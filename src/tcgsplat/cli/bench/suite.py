"""`tcgsplat bench synthetic|tum|replica|scannet`: sequences x seeds x presets, and the page that tells of them."""

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from tcgsplat.cli.bench import Recorded, SuiteArgs, Synthetic
from tcgsplat.cli.bench.page import Results, write_page
from tcgsplat.cli.bench.performing import Job, Outcome, attempted, finished, made
from tcgsplat.cli.bench.suites import SUITES, Source, Suite
from tcgsplat.cli.logs import say
from tcgsplat.cli.recorder import Part
from tcgsplat.cli.settings import resolved
from tcgsplat.cli.usage import UsageError
from tcgsplat.config import to_toml
from tcgsplat.errors import ArchiveError
from tcgsplat.render.backends import open_rasterizer


def command(args: SuiteArgs, flags: Mapping[str, str]) -> int:
    """Do the runs that are missing, and write results.json and the page."""
    suite = chosen(args)
    out = args.out or Path("runs") / f"bench-{suite.name}"
    data = args.data if isinstance(args, Recorded) else out / "data"
    jobs, missing = planned(suite, args, flags, data)
    for sequence, why in {one.sequence: one.why for one in missing}.items():
        sys.stderr.write(f"tcgsplat: {sequence} is left out: {why}\n")
    if not jobs:
        raise UsageError(f"none of the sequences of {suite.title} is in {data}: {suite.advice}")
    _make_way(out, suite)
    results = Results.begun(suite, flags, jobs, missing)
    results.write(out)
    try:
        for outcome in _outcomes(jobs, out, args.cluster):
            results = results.with_outcome(outcome)
            results.write(out)
            if outcome.why:
                sys.stderr.write(f"tcgsplat: {_named(outcome)} {outcome.state}: {outcome.why}\n")
    except KeyboardInterrupt as interrupt:
        for outcome in filter(None, (finished(job, out) for job in jobs)):  # one may have been finished just now
            results = results.with_outcome(outcome)
        write_page(results, out)
        kept = f"{results.count('done')} of {len(jobs)} runs are kept in {out}"
        raise KeyboardInterrupt(f"interrupted; {kept}: the same command goes on") from interrupt
    write_page(results, out)
    failed = len(jobs) - results.count("done")
    told = f", {failed} failed or lost" if failed else ""
    sys.stdout.write(
        f"{results.count('done')} of {len(jobs)} runs{told}: {out / 'README.md'}, {out / 'results.json'}\n"
    )
    return 0


def _named(outcome: Outcome) -> str:
    return f"{outcome.sequence}, {outcome.preset}, seed {outcome.seed}:"


def chosen(args: SuiteArgs) -> Suite:
    """The suite with what the arguments change about it.

    Raises:
        UsageError: if a sequence is not in it, or there is to be no run.
    """
    suite = SUITES[type(args).__name__.lower()]
    if isinstance(args, Synthetic):
        suite = suite.made(args.frames, args.width)
    known = {source.name: source for source in suite.sources}
    for name in args.sequences:
        if name not in known:
            raise UsageError(f"--sequences: there is no {name} in {suite.title}; choose from {', '.join(known)}")
    if args.seeds < 1 or not args.presets:
        raise UsageError("--seeds counts from 1, and --presets needs at least one")
    if args.refine < 0:
        raise UsageError(f"--refine is {args.refine}; give steps from 0 on")
    sources = tuple(known[name] for name in args.sequences) or suite.sources
    return replace(suite, sources=sources, presets=tuple(dict.fromkeys(args.presets)), seeds=args.seeds)


def planned(
    suite: Suite, args: SuiteArgs, flags: Mapping[str, str], data: Path
) -> tuple[tuple[Job, ...], tuple[Outcome, ...]]:
    """The jobs whose data is there or can be made, seed by seed; and for all others, what is missing.

    Raises:
        UsageError: if a preset or a flag makes no sense.
        BackendUnavailableError: if the backend cannot run here.
    """
    backend = open_rasterizer(args.backend).name  # type: ignore[arg-type]  # it checks the name
    configs = {preset: resolved(preset, args.config, flags, None) for preset in suite.presets}
    jobs: list[Job] = []
    missing: list[Outcome] = []
    for number in range(suite.seeds):
        for source in suite.sources:
            folder = data / source.slug if source.synth else source.found(data)
            for preset in suite.presets:
                seed = (configs[preset].seed if args.seed is None else args.seed) + number
                toml = to_toml(replace(configs[preset], seed=seed))
                part = Part(limit=args.limit)
                if folder is None:
                    why = f"no files in {' or '.join(map(str, source.expected(data)))}"
                    missing.append(Outcome(source.name, preset, seed, "missing", why))
                else:
                    views = (suite.stride, suite.withheld_every)
                    jobs.append(Job(source, folder, preset, seed, toml, part, backend, args.lpips, args.refine, *views))
    return tuple(jobs), tuple(missing)


def _outcomes(jobs: Sequence[Job], out: Path, cluster: tuple[str, ...] | None) -> Iterator[Outcome]:
    """Of every job, those first that were done before."""
    waiting: list[Job] = []
    for job in jobs:
        before = finished(job, out)
        if before is None:
            waiting.append(job)
        else:
            yield before
    _make_data(waiting)
    if cluster is not None:
        from tcgsplat.cli.bench.cluster import spread

        yield from spread(waiting, out, cluster)
        return
    for number, job in enumerate(waiting, start=1):
        say(f"run {number} of {len(waiting)}: {job}")
        yield attempted(job, out)


def _make_data(jobs: Sequence[Job]) -> None:
    by_source: dict[Source, Job] = {job.source: job for job in jobs}
    for job in by_source.values():
        made(job)


def _make_way(out: Path, suite: Suite) -> None:
    """Only what a bench of this suite has made is written into.

    Raises:
        ArchiveError: if there is something else.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        out.mkdir(parents=True, exist_ok=True)
        return
    try:
        there = json.loads((out / "results.json").read_text(encoding="utf-8"))["suite"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ArchiveError(f"{out} holds something else than a bench ({error}); choose another --out") from error
    if there != suite.name:
        raise ArchiveError(f"{out} holds the suite {there}, not {suite.name}; choose another folder by --out")
