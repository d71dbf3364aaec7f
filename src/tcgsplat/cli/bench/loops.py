"""`tcgsplat bench loops`: what comparing a finished submap with those before it costs, by how many there are."""

import json
import statistics
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from tcgsplat.cli.bench import Loops
from tcgsplat.cli.logs import say
from tcgsplat.cli.progress import counting
from tcgsplat.cli.recorder import Part, begin, recorded
from tcgsplat.cli.summary import machine, versions
from tcgsplat.config import SlamConfig, from_toml
from tcgsplat.datasets import open_sequence
from tcgsplat.datasets.synthetic import SynthConfig, synthesize
from tcgsplat.errors import ArchiveError
from tcgsplat.loop.closer import Closure, LoopCloser
from tcgsplat.render.backends import open_rasterizer
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.storage import atomic
from tcgsplat.storage.run_directory import RunDirectory

AVERAGED = 5
"""Closures that a line of the table is the mean of, the last one included: they differ by how many candidates fail."""


@dataclass(frozen=True)
class Line:
    """One line of the table."""

    submaps: int
    """When the last of the closures ended."""
    ms: float
    """Mean of a closure."""
    registered: float
    """Mean number of pairs that were compared."""

    @staticmethod
    def at(submaps: int, closures: Sequence[Closure]) -> "Line":
        """Of the last closures up to a number of submaps."""
        last = closures[max(submaps - AVERAGED, 0) : submaps]
        return Line(
            submaps,
            1e3 * statistics.fmean(closure.seconds for closure in last),
            statistics.fmean(len(closure.registrations) for closure in last),
        )


def command(args: Loops) -> int:
    """Print the table, and write the file that was asked for."""
    rasterizer = open_rasterizer(args.backend)  # type: ignore[arg-type]  # it checks the name
    torch.set_num_threads(1)  # as in a run
    if args.run is None:
        with tempfile.TemporaryDirectory() as folder:
            closures = replayed(walked(Path(folder), rasterizer), rasterizer)
    else:
        closures = replayed(RunDirectory.open(args.run), rasterizer)
    counts = [count for count in (10, 20, 40, 80, 160) if count < len(closures)] + [len(closures)]
    lines = [Line.at(count, closures) for count in counts]
    sys.stdout.write(table(lines) + f"\n{machine()}\n")
    if args.json is not None:
        content = {"lines": [asdict(line) for line in lines], "machine": machine(), "versions": versions()}
        atomic.write_text(args.json, json.dumps(content, indent=2) + "\n")
    return 0


def walked(folder: Path, rasterizer: Rasterizer) -> RunDirectory:
    """A run through two rooms that look alike, which tempt to compare more than any others: some forty submaps."""
    say("making the rooms")
    with counting("frame") as progress:
        synthesize(folder / "sequence", SynthConfig(place="twins", depth_noise=True), progress)
    config = SlamConfig()
    run = begin(folder / "run", config, folder / "sequence", Part(), overwrite=False)
    recorded(open_sequence(folder / "sequence"), config, rasterizer, run, "default")
    return run


def replayed(run: RunDirectory, rasterizer: Rasterizer) -> list[Closure]:
    """Every submap of a run compared with those before it, again, and with nothing else going on.

    Raises:
        ArchiveError: if the run has fewer than two submaps.
    """
    checkpoint = run.checkpoint()
    if checkpoint is None:
        raise ArchiveError(f"{run.path} has fewer than two submaps and no loops; give a longer run")
    config = from_toml(run.config_toml)
    closer = LoopCloser(
        replace(config.loop, enabled=True), config.tracker, config.confidence, rasterizer, run.load_submap, config.seed
    )
    following = {edge.source: edge for edge in checkpoint.edges if not edge.loop}
    closures = []
    with counting("submap") as tell:
        for index in range(run.submap_count):
            tell(index, run.submap_count)
            closures.append(closer.closed(index, following.get(index + 1)))
    return closures


def table(lines: Sequence[Line]) -> str:
    """For a person."""
    head = f"{'submaps':>8}{'closure ms':>12}{'pairs compared':>16}\n"
    return head + "\n".join(f"{line.submaps:>8}{line.ms:>12.0f}{line.registered:>16.1f}" for line in lines)
