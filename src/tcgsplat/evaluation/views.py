"""The views of a run that its map is judged by: those that it was made of, and those that it has never seen."""

import heapq
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from tcgsplat.config import from_toml
from tcgsplat.datasets.sequence import Sequence
from tcgsplat.evaluation import images
from tcgsplat.evaluation.lpips import Lpips
from tcgsplat.mapping.merging import Merged
from tcgsplat.render.view import MIN_COVERAGE, Rendering
from tcgsplat.scene.atlas import Atlas
from tcgsplat.scene.exposure import Exposure
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Submap
from tcgsplat.scene.trajectory import TrackedPose, Trajectory
from tcgsplat.storage.run_directory import RunDirectory
from tcgsplat.tensors import Pose
from tcgsplat.tracking.synchronization import synchronized

MOST_WITHHELD = 120
"""Withheld views that are drawn unless told otherwise: their mean PSNR, which varies by some 3 dB from view to view, is
then known to about 0.3 dB, and an evaluation takes seconds."""


@dataclass(frozen=True)
class PosedFrame:
    """What the camera saw, and, as estimated, from where in a submap and how exposed it saw it."""

    frame: Frame
    T_map_cam: Pose
    exposure: Exposure
    withheld: bool
    """The map was never optimised on this frame."""


@dataclass(frozen=True)
class ViewScore:
    """How near a rendering is to what the camera saw; NaN where no pixel counts."""

    psnr: float
    """dB, over the valid pixels."""
    psnr_unexposed: float
    """dB, as if no picture's exposure were known: with the one in the middle of the map's keyframes for all."""
    ssim: float
    """Over the windows of valid pixels."""
    ms_ssim: float
    """The same at five scales; NaN too where the image is too small for them."""
    lpips: float
    """Over the valid pixels; NaN too where nobody has given its weights."""
    depth_l1: float
    """Centimetres, over the valid pixels with a sensor reading; where nothing is mapped, the reading in full."""
    depth_coverage: float
    """Percent of these that have a rendered depth."""
    psnr_mapped: float
    """dB, over the valid pixels that the map covers by more than `MIN_COVERAGE`."""
    coverage: float
    """Percent of the valid pixels that are covered so."""

    @staticmethod
    def of(rendering: Rendering, view: PosedFrame, middle: Exposure, lpips: Lpips | None = None) -> "ViewScore":
        """The score of a rendering from where the view's frame was taken; `middle` is the map's mean exposure."""
        frame, depth = view.frame, rendering.depth
        color = view.exposure.applied(rendering.color).clamp(0.0, 1.0)
        mapped, read = rendering.alpha > MIN_COVERAGE, frame.valid & (frame.depth > 0)
        return ViewScore(
            psnr=images.psnr(color, frame.color, frame.valid),
            psnr_unexposed=images.psnr(middle.applied(rendering.color).clamp(0.0, 1.0), frame.color, frame.valid),
            ssim=images.ssim(color, frame.color, frame.valid),
            ms_ssim=images.ms_ssim(color, frame.color, frame.valid),
            lpips=lpips(color, frame.color, frame.valid) if lpips is not None else math.nan,
            depth_l1=100.0 * images.depth_l1(depth, frame.depth, read),
            depth_coverage=100.0 * float((depth[read] > 0).to(depth.dtype).mean()),
            psnr_mapped=images.psnr(color, frame.color, frame.valid & mapped),
            coverage=100.0 * float(mapped[frame.valid].to(depth.dtype).mean()),
        )


def withholding(run: RunDirectory) -> int:
    """Every so many-th frame the run has kept back from mapping, so that its map can be judged; 0: none on purpose."""
    return from_toml(run.config_toml).schedule.withhold_every


def withheld_rows(run: RunDirectory, trajectory: Trajectory) -> tuple[TrackedPose, ...]:
    """Frames that were tracked but never mapped, in submaps that are saved; lost ones do not count.

    Where the run has kept frames back on purpose, these alone. A run of an older tcgsplat does not tell which frames it
    mapped. There all frames count that are not keyframes of a saved submap, those among them that were keyframes once.

    Raises:
        ArchiveError: if a file of the run is damaged.
    """
    mapped, count = {row.frame_index for row in trajectory.rows if row.mapped}, run.submap_count
    if not mapped:
        for index in range(count):
            mapped |= {keyframe.frame.index for keyframe in run.load_submap(index).keyframes}
    every = withholding(run) or 1
    saved = [row for row in trajectory.rows if row.submap_index < count and row.frame_index % every == 0]
    return tuple(row for row in saved if not row.lost and row.frame_index not in mapped)


def spread(rows: tuple[TrackedPose, ...], number: int) -> tuple[TrackedPose, ...]:
    """About so many of the rows (never more), evenly over all of them: one from each of as many equal stretches.

    Its place within the stretch goes round by the golden ratio. A fixed step could fall in with the rhythm of mapping,
    and then meet only frames that come right after a mapped one.
    """
    stretches = np.arange(min(number, len(rows)))
    places = (stretches + stretches * ((math.sqrt(5.0) - 1.0) / 2.0) % 1.0) * (len(rows) / max(len(stretches), 1))
    return tuple(rows[place] for place in np.unique(places.astype(int)).tolist())


def training_views(submap: Submap, places: slice) -> Iterator[PosedFrame]:
    """Keyframes of a submap, those at some places of their order."""
    return (
        PosedFrame(keyframe.frame, keyframe.T_map_cam, keyframe.exposure, withheld=False)
        for keyframe in submap.keyframes[places]
    )


def withheld_views(
    rows: Iterable[TrackedPose], velocities: Mapping[int, Float[Tensor, "6"]], sequence: Sequence, delay: float = 0.0
) -> Iterator[PosedFrame]:
    """Withheld frames, each decoded when its turn comes, with depth brought to the instant of colour as in the run.

    Args:
        rows: Which frames.
        velocities: Of `Trajectory.velocities`, by frame index.
        sequence: What they are read from.
        delay: Of the depth images behind their stamps, as the run has learnt it; seconds.

    Raises:
        DatasetError: if one cannot be read.
    """
    for row in rows:
        frame = sequence.frame(row.frame_index).with_depth_later(delay)
        frame = synchronized(frame, velocities[row.frame_index])
        yield PosedFrame(frame, row.T_map_cam, row.exposure, withheld=True)


def in_world(view: PosedFrame, submap: int, whole: Merged) -> PosedFrame:
    """A view of one of the submaps as a view of the one map."""
    T_world_cam, exposure = whole.posed(submap, view.T_map_cam), whole.exposed(submap, view.exposure)
    return PosedFrame(view.frame, T_world_cam, exposure, view.withheld)


def velocities_by_frame(trajectory: Trajectory, atlas: Atlas) -> dict[int, Float[Tensor, "6"]]:
    """Velocity of the camera by frame index, as `Trajectory.velocities` has it."""
    return dict(zip((row.frame_index for row in trajectory.rows), trajectory.velocities(atlas), strict=True))


def in_turn(*views: Iterator[PosedFrame]) -> Iterator[PosedFrame]:
    """Views of several kinds, each in the order of time, merged into one such order."""
    return heapq.merge(*views, key=lambda view: view.frame.index)


def learnt_delay(run: RunDirectory) -> float:
    """How late the run found its depth images to be, seconds; 0 where it does not say."""
    delay = run.summary().get("depth_delay_ms", 0.0)
    return 1e-3 * delay if isinstance(delay, int | float) else 0.0
