"""Arms of the experiment whether confidence helps: Table 6 of the paper, ours at one place only, and controls."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Final

import torch

from tcgsplat import datasets
from tcgsplat.cli.bench.track import through
from tcgsplat.config import SlamConfig, Value, with_settings
from tcgsplat.datasets.truth import Truth
from tcgsplat.errors import EvaluationError
from tcgsplat.evaluation import images
from tcgsplat.evaluation.views import spread, velocities_by_frame, withheld_views
from tcgsplat.mapping.mapper import Mapper
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import Rendering, render_view
from tcgsplat.scene.frame import Frame
from tcgsplat.slam import Slam
from tcgsplat.storage.store import InMemory
from tcgsplat.tensors import Plane, Pose

DRAWN: Final = 40
"""Views that were never mapped, of which the PSNR is taken."""
AVERAGE: Final = 0.85
"""Of the confidence that a picture of the default's map has, about: what the arm `constant` gives to all."""
FAULTS: Final = frozenset({"exposure jump", "dropped frames", "moving object", "depth bias"})
"""Events that are something wrong; the others are only something to look at."""


@dataclass(frozen=True)
class Arm:
    """One way to use confidence."""

    name: str
    told: str
    """What of it, in words."""
    mapping: bool = True
    tracking: bool = True
    loop: bool = True
    changes: Mapping[str, Value] = field(default_factory=dict)
    """Settings besides the three places where it guides."""
    knows: bool = False
    """Whether its confidence is made of the truth."""
    published_cm: float | None = None
    """ATE RMSE on ScanNet scene 0181 (base system in row I), published without a spread."""

    @property
    def switches(self) -> dict[str, bool]:
        """The settings that say where confidence guides."""
        return {
            "confidence.guide_mapping": self.mapping,
            "confidence.guide_tracking": self.tracking,
            "confidence.rerank_views": self.loop,
        }

    def config(self, shared: SlamConfig, seed: int) -> SlamConfig:
        """Its settings with a seed."""
        return with_settings(shared, {**self.switches, **self.changes, "seed": seed})


ARMS: Final = (
    Arm("I", "off", False, False, False, published_cm=14.1),
    Arm("II", "mapping only", True, False, False, published_cm=12.8),
    Arm("III", "mapping, tracking", True, True, False, published_cm=12.1),
    Arm("IV", "all of it", published_cm=10.4),
    Arm("tracking", "tracking only", False, True, False),
    Arm("loop", "loop closure only", False, False, True),
    Arm("constant", "the same for all", changes={"confidence.model": "constant", "confidence.initial": AVERAGE}),
    Arm("shuffled", "as much, in wrong places", changes={"confidence.model": "shuffled"}),
    Arm(
        "oracle",
        "made of the truth",
        changes={"confidence.model": "expectation", "confidence.error_memory": 1e-6, "confidence.error_prior": 0.0},
        knows=True,
    ),
)
"""The first four are the rows of Table 6; all are compared with the first."""


class OracleMapper(Mapper):
    """Judges the map by the true depth in the place of the readings: for an experiment, and never part of a run."""

    def __init__(self, *args, truth: Truth, largest: float) -> None:  # type: ignore[no-untyped-def]
        super().__init__(*args)
        self._truth, self._largest = truth, largest

    def birth_error(self, frame: Frame, rendering: Rendering | None) -> Plane:
        """How far the reading is off; the largest where nobody knows."""
        del rendering
        true_depth = self._true_depth(frame)
        known = (frame.depth > 0) & (true_depth > 0)
        return torch.where(known, (frame.depth - true_depth).abs(), self._largest).clamp_max(self._largest)

    def disagreement(self, frame: Frame, rendering: Rendering) -> Plane:
        """How far the map is off."""
        true_depth = self._true_depth(frame)
        known = (rendering.depth > 0) & (true_depth > 0)
        return torch.where(known, (rendering.depth - true_depth).abs(), torch.nan)

    def _true_depth(self, frame: Frame) -> Plane:
        depth = self._truth.depth(frame.index)
        return torch.zeros_like(frame.depth) if depth is None else depth.to(frame.depth)


@dataclass(frozen=True)
class Walked:
    """What came of an arm's way through a sequence."""

    ate_rmse_cm: float
    """After rigid alignment, over all frames whose true pose is known, lost ones included."""
    psnr: float | None
    """dB, mean over views that were never mapped, drawn from the submap that they were tracked in; None if all were."""
    frames: int
    frames_lost: int
    seconds: float


def walked(
    sequence: datasets.Sequence,
    poses: Mapping[int, Pose],
    config: SlamConfig,
    rasterizer: Rasterizer,
    truth: Truth | None = None,
) -> Walked:
    """The whole system through a sequence.

    Args:
        sequence: The frames.
        poses: The true ones, by frame index.
        config: All settings, those of the arm among them.
        rasterizer: Backend.
        truth: For an arm that knows it.

    Raises:
        EvaluationError: if fewer than three frames that could be read have a true pose.
    """
    store, largest = InMemory(), config.confidence.error_max
    mapper = Mapper if truth is None else partial(OracleMapper, truth=truth, largest=largest)
    slam = Slam(config, rasterizer, store=store, mapper=mapper)
    timed = through(slam, sequence)
    error = timed.ate_cm(poses)
    if error is None:
        raise EvaluationError(f"fewer than 3 frames of {sequence.name} that could be read have a true pose")
    never = spread(tuple(row for row in slam.trajectory.rows if not (row.mapped or row.lost)), DRAWN)
    views = withheld_views(never, velocities_by_frame(slam.trajectory, slam.atlas), sequence, slam.delay.seconds)
    psnr = []
    for row, view in zip(never, views, strict=True):
        rendering = render_view(store.load_submap(row.submap_index), view.frame.camera, view.T_map_cam, rasterizer)
        color = view.exposure.applied(rendering.color).clamp(0.0, 1.0)
        psnr.append(images.psnr(color, view.frame.color, view.frame.valid))
    seconds = sum(row["frame"] for row in timed.seconds) + timed.finish
    mean = sum(psnr) / len(psnr) if psnr else None
    return Walked(error, mean, len(timed.T_world_cam), timed.lost, seconds)


def faulty(truth: Truth | None) -> bool | None:
    """Whether something is wrong with a sequence: noise, or an event that is a fault; None where nobody knows."""
    if truth is None:
        return None
    return not truth.exact or any(event.name in FAULTS for event in truth.events)
