"""`tcgsplat eval`: how good a run is, in figures and pictures."""

import logging
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from tcgsplat.cli.usage import UsageError

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Args:
    """Score a run: report.json, contact_sheet.png and trajectory.png go into its directory.

    A run that was stopped or killed is scored as far as it came, and the report says how far that is.

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
    """Draw one in so many of the frames that were never mapped. If not given: all that --schedule.withhold-every kept
    back from the run's map, or 120 at most of those that only happened not to be mapped."""
    lpips: Path | None = None
    """Weights for LPIPS: a state dict with AlexNet's `features.N.weight` and `.bias` (torchvision's names) and the
    linear heads `lin0.model.1.weight` to `lin4.model.1.weight`. Without them LPIPS is reported as not available."""
    surface: bool = False
    """Also fuse the map to a mesh and compare it with the true one, `mesh.ply` with the data or --true-mesh. Takes a
    minute or more, and the extra `mesh`."""
    true_mesh: Path | None = None
    """The true surface, a PLY in the frame of the true poses."""
    backend: str = "auto"
    """Rasterizer: auto, numba, reference, cuda or gsplat."""


def command(args: Args) -> int:
    """Print the report, and put it and the pictures into the run directory."""
    from tcgsplat.cli.scoring import data_of, scored, true_mesh_of
    from tcgsplat.evaluation.report import score_trajectory, unfinished
    from tcgsplat.render.backends import open_rasterizer
    from tcgsplat.storage.run_directory import RunDirectory

    if args.stride < 1 or (args.withheld_every is not None and args.withheld_every < 1):
        raise UsageError("--stride and --withheld-every count from 1")
    run = RunDirectory.open(args.run) if args.run else None
    sequence = data_of(run, args.sequence)
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
    if (part := unfinished(run, sequence)) is not None:
        logger.warning("%s holds %s", run.path, part)
    rasterizer = open_rasterizer(args.backend)  # type: ignore[arg-type]  # it checks the name
    true_mesh = true_mesh_of(sequence, run, args.true_mesh) if args.surface or args.true_mesh else None
    report = scored(run, sequence, rasterizer, args.stride, args.withheld_every, args.lpips, true_mesh)
    sys.stdout.write(f"{report.table()}\n\nreport.json, contact_sheet.png and trajectory.png are in {run.path}\n")
    return 0
