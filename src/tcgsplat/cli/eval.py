"""`tcgsplat eval`: how good a run is, in figures and pictures."""

import logging
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from tcgsplat.cli.progress import counting
from tcgsplat.cli.recorder import Part
from tcgsplat.cli.usage import UsageError
from tcgsplat.datasets import Sequence
from tcgsplat.evaluation import canvas
from tcgsplat.evaluation.figures import contact_sheet_of, trajectory_plot_of
from tcgsplat.evaluation.report import Report, evaluate, score_trajectory
from tcgsplat.render.backends import open_rasterizer
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.storage.run_directory import RunDirectory

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Args:
    """Score a run, finished or not: report.json, contact_sheet.png and trajectory.png go into its directory.

    With --trajectory, score that file instead: the path of any system, in the TUM format, against the same data.
    """

    run: tyro.conf.Positional[Path | None] = None
    """The run directory; with --trajectory and --sequence it may be left out."""
    sequence: Path | None = None
    """The data with its ground truth, if it is no longer where the run found it."""
    trajectory: Path | None = None
    """A file of `timestamp tx ty tz qx qy qz qw`, camera to world; its report is report_NAME.json."""
    stride: int = 1
    """Draw every so many-th keyframe."""
    withheld_every: int | None = None
    """Draw one in so many of the frames that were never mapped; if not given, 120 of them at most."""
    backend: str = "auto"
    """Rasterizer: auto, numba or reference."""


def command(args: Args) -> int:
    """Print the report, and put it and the pictures into the run directory."""
    if args.stride < 1 or (args.withheld_every is not None and args.withheld_every < 1):
        raise UsageError("--stride and --withheld-every count from 1")
    run = RunDirectory.open(args.run) if args.run else None
    sequence = _sequence(run, args.sequence)
    if args.trajectory is not None:
        if sequence is None:
            raise UsageError("--trajectory needs something to compare with; give a run, or the data by --sequence")
        report, path = score_trajectory(args.trajectory, sequence), f"report_{args.trajectory.stem}.json"
        if run is not None:
            report.write(run.path / path)
        sys.stdout.write(f"{report.table()}\n")
        return 0
    if run is None:
        raise UsageError("give a run directory, or --trajectory and --sequence")
    rasterizer = open_rasterizer(args.backend)  # type: ignore[arg-type]  # it checks the name
    report = scored(run, sequence, rasterizer, args.stride, args.withheld_every)
    sys.stdout.write(f"{report.table()}\n\nreport.json, contact_sheet.png and trajectory.png are in {run.path}\n")
    return 0


def scored(
    run: RunDirectory,
    sequence: Sequence | None,
    rasterizer: Rasterizer,
    stride: int = 1,
    withheld_every: int | None = None,
) -> Report:
    """The report of a run; it and the pictures are in the run directory."""
    with counting("frame") as progress:
        report = evaluate(run, sequence, rasterizer, stride=stride, withheld_every=withheld_every, progress=progress)
    report.write(run.path / "report.json")
    canvas.write_png(run.path / "contact_sheet.png", contact_sheet_of(run, sequence, rasterizer))
    canvas.write_png(run.path / "trajectory.png", trajectory_plot_of(run, sequence))
    return report


def _sequence(run: RunDirectory | None, given: Path | None) -> Sequence | None:
    """The part of the data that the run used, or None if it is not at hand."""
    part = Part.of(run) if run else Part()
    if given is not None:
        return part.open(given)
    if run is None:
        return None
    if not Path(run.sequence).is_dir():
        logger.warning(
            "%s, the data of the run, is not there: nothing to compare with but keyframes; give --sequence",
            run.sequence,
        )
        return None
    return part.open(run.sequence)
