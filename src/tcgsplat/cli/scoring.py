"""A run and its data to a report and pictures."""

import logging
from pathlib import Path

from tcgsplat.cli.progress import counting
from tcgsplat.cli.recorder import Part
from tcgsplat.datasets import Sequence
from tcgsplat.evaluation import canvas
from tcgsplat.evaluation.figures import contact_sheet_of, trajectory_plot_of
from tcgsplat.evaluation.lpips import Lpips
from tcgsplat.evaluation.report import Report, evaluate
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.storage.run_directory import RunDirectory

logger = logging.getLogger(__name__)


def scored(
    run: RunDirectory,
    sequence: Sequence | None,
    rasterizer: Rasterizer,
    stride: int = 1,
    withheld_every: int | None = None,
    lpips: Path | None = None,
) -> Report:
    """The report of a run; it and the pictures are in the run directory."""
    distance = None if lpips is None else Lpips.read(lpips, rasterizer.device)
    with counting("frame") as progress:
        report = evaluate(
            run,
            sequence,
            rasterizer,
            stride=stride,
            withheld_every=withheld_every,
            lpips=distance,
            progress=progress,
        )
    report.write(run.path / "report.json")
    canvas.write_png(run.path / "contact_sheet.png", contact_sheet_of(run, sequence, rasterizer))
    canvas.write_png(run.path / "trajectory.png", trajectory_plot_of(run, sequence))
    return report


def data_of(run: RunDirectory | None, given: Path | None) -> Sequence | None:
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
