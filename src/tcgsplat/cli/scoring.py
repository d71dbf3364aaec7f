"""A run and its data to a report and pictures."""

import logging
import math
from pathlib import Path

from tcgsplat.cli.progress import counting
from tcgsplat.cli.recorder import Part
from tcgsplat.cli.usage import UsageError
from tcgsplat.datasets import Sequence
from tcgsplat.datasets.truth import Truth
from tcgsplat.errors import DatasetError
from tcgsplat.evaluation import canvas
from tcgsplat.evaluation.figures import contact_sheet_of, trajectory_plot_of
from tcgsplat.evaluation.free import free_rows
from tcgsplat.evaluation.lpips import Lpips
from tcgsplat.evaluation.metrics import Metric
from tcgsplat.evaluation.report import Report, evaluate
from tcgsplat.evaluation.surface import paired_poses, surface_of_run, true_mesh_path
from tcgsplat.mapping.merging import Merged
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.frame import Frame
from tcgsplat.storage.mesh_ply import read_mesh
from tcgsplat.storage.run_directory import RunDirectory
from tcgsplat.storage.world_map import world_map

logger = logging.getLogger(__name__)


def scored(
    run: RunDirectory,
    sequence: Sequence | None,
    rasterizer: Rasterizer,
    stride: int = 1,
    withheld_every: int | None = None,
    lpips: Path | None = None,
    true_mesh: Path | None = None,
) -> Report:
    """The report of a run; it and the pictures are in the run directory.

    With a true mesh the map is fused to one and compared with it.
    """
    whole = world_map(run, rasterizer)  # merging takes seconds, and all that follows asks for it
    distance = None if lpips is None else Lpips.read(lpips, rasterizer.device)
    with counting("frame") as progress:
        report = evaluate(
            run,
            sequence,
            rasterizer,
            stride=stride,
            withheld_every=withheld_every,
            lpips=distance,
            whole=whole,
            progress=progress,
        )
    report = _with_free_views(report, run, whole, sequence, rasterizer)
    if true_mesh is not None:
        report = _with_surface(report, run, whole, sequence, rasterizer, true_mesh)
    report.write(run.path / "report.json")
    canvas.write_png(run.path / "contact_sheet.png", contact_sheet_of(run, sequence, rasterizer))
    canvas.write_png(run.path / "trajectory.png", trajectory_plot_of(run, sequence))
    return report


def true_mesh_of(sequence: Sequence | None, run: RunDirectory, given: Path | None) -> Path:
    """The file of the true surface: the one that is given, or that lies with the data.

    Raises:
        UsageError: if there is none.
    """
    found = given or true_mesh_path(Path(run.sequence))
    if found is None or sequence is None:
        raise UsageError(f"--surface needs a true mesh and true poses, and {run.sequence} has none; give --true-mesh")
    return found


def _with_free_views(
    report: Report, run: RunDirectory, whole: Merged, sequence: Sequence | None, rasterizer: Rasterizer
) -> Report:
    """The report with rows of views from beside the path, if they lie with the data."""
    truth = Truth.of(run.sequence) if sequence is not None else None
    views = () if truth is None else truth.free_views()
    if sequence is None or not views:
        return report
    rows = free_rows(whole, *paired_poses(run, sequence.ground_truth()), views, rasterizer)
    told = f"{len(views)} exact views from beside the path (free), in the one map, aligned by poses"
    return _joined(report, Report.of(rows, {"free": told}))


def _joined(report: Report, added: Report) -> Report:
    return Report(
        {**report.metrics, **added.metrics},
        {**report.evaluated, **added.evaluated},
        {**report.missing, **added.missing},
    )


def _with_surface(
    report: Report,
    run: RunDirectory,
    whole: Merged,
    sequence: Sequence | None,
    rasterizer: Rasterizer,
    true_mesh: Path,
) -> Report:
    """The report with rows of the surface."""
    if sequence is None:
        return report
    with counting("view") as progress:
        _, score = surface_of_run(
            run,
            read_mesh(true_mesh),
            sequence.camera,
            sequence.ground_truth(),
            rasterizer,
            whole=whole,
            progress=progress,
        )
    rows = {
        name: Metric(value, unit) if math.isfinite(value) else "it cannot be measured on this surface"
        for name, (value, unit) in score.rows().items()
    }
    return _joined(report, Report.of(rows, {"surface": score.evaluated()}))


def data_of(run: RunDirectory | None, given: Path | None) -> Sequence | None:
    """The part of the data that the run used, or None if it is not at hand.

    Raises:
        DatasetError: if what is there cannot be read, or is not what the run was made of.
    """
    part = Part.of(run) if run else Part()
    if run is None:
        return None if given is None else part.open(given)
    if given is not None:
        return _checked(part.open(given), run)
    if not Path(run.sequence).is_dir():
        logger.warning(
            "%s, the data of the run, is not there: nothing to compare with but keyframes; give --sequence",
            run.sequence,
        )
        return None
    return _checked(part.open(run.sequence), run)


def _checked(sequence: Sequence, run: RunDirectory) -> Sequence:
    """The sequence, if the run's first keyframe is of it."""
    if not run.submap_count:
        return sequence
    ours = run.open_submaps()[0].keyframes[0].frame
    theirs = sequence.frame(ours.index) if ours.index < len(sequence) else None
    if theirs is None or (theirs.camera, theirs.timestamp) != (ours.camera, ours.timestamp):
        other = "there is no such frame" if theirs is None else f"there it is {_told(theirs)}"
        raise DatasetError(
            f"{sequence.name} is not what {run.path} was made of: frame {ours.index} is {_told(ours)}, and {other}; "
            "give the same recording by --sequence"
        )
    return sequence


def _told(frame: Frame) -> str:
    camera = frame.camera
    return f"{camera.width}x{camera.height}, fx {camera.fx:g}, at {frame.timestamp:.3f} s"
