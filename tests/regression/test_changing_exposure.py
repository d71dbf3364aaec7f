"""A camera with automatic exposure, through the whole online system and its evaluation."""

import math
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from analytic_room import RoomSequence, errors, walk

from tcgsplat.config import SlamConfig, with_settings
from tcgsplat.datasets import Sequence, open_sequence
from tcgsplat.datasets.synthetic import SynthConfig
from tcgsplat.datasets.synthetic.studio import Studio
from tcgsplat.datasets.synthetic.synthesis import record
from tcgsplat.evaluation.report import evaluate
from tcgsplat.mapping.schedule import ScheduleConfig
from tcgsplat.mapping.seeding import SeedingConfig
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.exposure import UNCHANGED, Exposure
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Submap
from tcgsplat.scene.trajectory import TrackedPose
from tcgsplat.slam import EXPOSURE_LEAK, Slam, StepReport
from tcgsplat.storage.run_directory import RunDirectory
from tcgsplat.tensors import Pose

ROOM = SlamConfig(
    mapper=MapperConfig(
        seeding=SeedingConfig(recipe="surface", spacing=1, footprint=0.5, opacity=0.9),
        iterations=6,
        first_iterations=20,
    ),
    schedule=ScheduleConfig(map_every=4, map_lag=4, submap_distance=0.15),
    seed=3,
)
OFF = {"tracker.exposure": False}


@dataclass(frozen=True)
class Run:
    """What came out of a run, and how its evaluation scores it."""

    reports: list[StepReport]
    rows: tuple[TrackedPose, ...]
    submaps: list[Submap]
    T_world_cam: list[Pose]
    psnr: float
    """Of withheld views as exposed, dB."""
    psnr_unexposed: float

    @property
    def withheld(self) -> list[TrackedPose]:
        """Rows of the withheld frames."""
        return [row for row in self.rows if not row.mapped and not row.lost]


def run(out: Path, sequence: Sequence, rasterizer: Rasterizer, config: SlamConfig, **settings: object) -> Run:
    slam = Slam(with_settings(config, settings), rasterizer)
    reports = [slam.step(frame) for frame in sequence]
    last = slam.finish()
    assert last is not None
    submaps = [*(report.sealed for report in reports if report.sealed is not None), last]
    directory = RunDirectory.create(out, config_toml="", sequence="")
    for submap in submaps:
        directory.write_submap(submap)
    directory.write_trajectory(slam.trajectory, slam.atlas)
    directory.write_summary({"depth_delay_ms": 1e3 * slam.delay.seconds})
    scores = evaluate(directory, sequence, rasterizer, stride=9, withheld_every=3).metrics
    return Run(
        reports, slam.trajectory.rows, submaps, slam.trajectory.world(slam.atlas),
        scores["psnr_withheld"].value, scores["psnr_withheld_unexposed"].value,
    )  # fmt: skip


def grey(exposure: Exposure) -> float:
    """What it makes of a middle grey, in times: gain and offset stand in for each other, their sum is well known."""
    return (0.5 * exposure.gain + exposure.offset) / 0.5


def spread_within_submaps(result: Run, true: Callable[[int], float]) -> float:
    """Standard deviation of log(found factor / true factor) over the withheld frames of each submap.

    In one map a factor means one thing, whenever it was found; another map may be brighter or darker as a whole.
    """
    off: list[float] = []
    for index in range(len(result.submaps)):
        rows = [row for row in result.withheld if row.submap_index == index]
        logs = [math.log(grey(row.exposure) / true(row.frame_index)) for row in rows]
        off += list(np.array(logs) - np.mean(logs)) if logs else []
    return float(np.std(off))


def steps(result: Run, true: Callable[[int], float]) -> Iterator[tuple[float, float]]:
    """log of the true and of the found factor from one frame to the next, both tracked against the same map."""
    for before, after in zip(result.reports, result.reports[1:], strict=False):
        if not before.mapped and not before.sealed and not after.update and not after.sealed and not after.tracked.lost:
            factor = true(after.frame_index) / true(before.frame_index)
            yield math.log(factor), math.log(grey(after.tracked.exposure) / grey(before.tracked.exposure))


# The analytic room, exposed by hand.

FRAMES = 36


@dataclass(frozen=True)
class Exposed(RoomSequence):
    """The room as a camera of changing exposure records it."""

    T_world_cam: tuple[Pose, ...] = field(default_factory=lambda: tuple(walk(FRAMES)))
    exposure: Callable[[int], Exposure] = lambda _: UNCHANGED

    def frame(self, index: int) -> Frame:
        frame = super().frame(index)
        return replace(frame, color=self.exposure(index).applied(frame.color).clamp(0, 1))

    def ground_truth(self) -> dict[int, Pose]:
        return {}


CHANGING: dict[str, Callable[[int], Exposure]] = {
    "constant": lambda _: UNCHANGED,
    "waving": lambda index: Exposure(1 - 0.25 * math.sin(index / 6)),
    "jumping": lambda index: Exposure(0.7, 0.05) if index // 9 % 2 else UNCHANGED,
}


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory, rasterizer: Rasterizer) -> Callable[..., Run]:
    done: dict[tuple[str, tuple[str, ...]], Run] = {}

    def walked(name: str, **settings: object) -> Run:
        key = (name, tuple(settings))
        if key not in done:
            out = tmp_path_factory.mktemp("run") / "room"
            done[key] = run(out, Exposed(exposure=CHANGING[name]), rasterizer, ROOM, **settings)
        return done[key]

    return walked


def test_a_constant_exposure_stays_one(walked: Callable[..., Run]) -> None:
    result = walked("constant")
    assert len(result.submaps) >= 3
    assert all(row.exposure.gain == pytest.approx(1.0, abs=0.04) for row in result.rows)
    assert all(grey(row.exposure) == pytest.approx(1.0, abs=0.04) for row in result.rows)
    assert result.psnr == pytest.approx(result.psnr_unexposed, abs=0.5)


@pytest.mark.parametrize("name", ["waving", "jumping"])
def test_each_frame_is_as_much_brighter_as_it_is(name: str, walked: Callable[..., Run]) -> None:
    result, way = walked(name), walk(FRAMES)
    pairs = np.array(list(steps(result, lambda index: grey(CHANGING[name](index)))))
    assert len(pairs) > 12 and np.abs(pairs[:, 0]).max() > 0.03
    np.testing.assert_allclose(pairs[:, 1], pairs[:, 0], atol=0.04)
    assert max(errors(T, true)[0] for T, true in zip(result.T_world_cam, way, strict=True)) < 15  # mm, of 50 cm


def test_a_keyframe_has_the_exposure_that_it_was_tracked_with(walked: Callable[..., Run]) -> None:
    """But for the leak; a submap begins with the brightness of its first picture."""
    result = walked("jumping")
    keyframes = [keyframe for submap in result.submaps for keyframe in submap.keyframes]
    mapped = [row for row in result.rows if row.mapped]
    assert [k.exposure for k in keyframes] == [row.exposure.relaxed(EXPOSURE_LEAK) for row in mapped]
    assert np.ptp([grey(keyframe.exposure) for keyframe in keyframes]) > 0.15
    for submap in result.submaps:
        assert next(row for row in mapped if row.submap_index == submap.index).exposure == UNCHANGED


@pytest.mark.parametrize(("name", "decibels"), [("waving", 1), ("jumping", 5)])
def test_views_are_better_as_exposed(name: str, decibels: float, walked: Callable[..., Run]) -> None:
    result = walked(name)
    assert result.psnr > result.psnr_unexposed + decibels
    assert result.psnr > walked(name, **OFF).psnr + decibels


@pytest.mark.parametrize("name", ["waving", "jumping"])
def test_in_one_map_exposures_found_at_different_times_compare(name: str, walked: Callable[..., Run]) -> None:
    assert spread_within_submaps(walked(name), lambda index: grey(CHANGING[name](index))) < 0.02


@pytest.mark.parametrize("name", ["waving", "jumping"])
def test_changing_exposure_costs_little(name: str, walked: Callable[..., Run]) -> None:
    assert walked(name).psnr > walked("constant").psnr - 3


# The synthetic apartment, whose pixels are rounded and clipped, and whose gains are told by exposure.txt.

APARTMENT = SynthConfig(frames=300, width=64, height=48, exposure_jumps=True, free_views=0)
CONSTANT, JUMPING = slice(0, 42), slice(58, 148)
"""Frames of a gain of 1, and of four gains between 0.8 and 0.91 and six submaps."""


@dataclass(frozen=True)
class Apartment:
    """What became of two parts of the recording."""

    gain: list[float]
    """Of the jumping part."""
    jumping: Run
    jumping_off: Run
    constant: Run


@pytest.fixture(scope="module")
def apartment(
    studio: Studio, workers: Executor, tmp_path_factory: pytest.TempPathFactory, rasterizer: Rasterizer
) -> Apartment:
    root = tmp_path_factory.mktemp("apartment")
    data = root / "data"
    data.mkdir()
    record(studio, data, APARTMENT, workers)
    gain = np.loadtxt(data / "exposure.txt")[:, 1]
    assert (gain[CONSTANT] == 1).all()
    constant, jumping = (
        open_sequence(data, start=part.start, limit=part.stop - part.start) for part in (CONSTANT, JUMPING)
    )
    return Apartment(
        gain=gain[JUMPING].tolist(),
        jumping=run(root / "a", jumping, rasterizer, SlamConfig()),
        jumping_off=run(root / "b", jumping, rasterizer, SlamConfig(), **OFF),
        constant=run(root / "c", constant, rasterizer, SlamConfig()),
    )


def test_the_apartments_jumps_are_found(apartment: Apartment) -> None:
    assert not any(row.lost for row in apartment.jumping.rows + apartment.constant.rows)
    pairs = np.array(list(steps(apartment.jumping, lambda index: apartment.gain[index])))
    assert (np.abs(pairs[:, 0]) > 0.05).sum() == 3
    np.testing.assert_allclose(pairs[:, 1], pairs[:, 0], atol=0.03)


def test_in_a_constant_light_the_apartments_exposure_does_not_drift(apartment: Apartment) -> None:
    rows = apartment.constant.rows
    assert all(row.exposure.gain == pytest.approx(1.0, abs=0.08) for row in rows)
    assert all(grey(row.exposure) == pytest.approx(1.0, abs=0.03) for row in rows)
    assert np.mean([grey(row.exposure) for row in rows[-20:]]) == pytest.approx(1.0, abs=0.01)
    assert apartment.constant.psnr == pytest.approx(apartment.constant.psnr_unexposed, abs=0.4)


def test_the_apartments_exposure_follows_the_true_one(apartment: Apartment) -> None:
    assert spread_within_submaps(apartment.jumping, lambda index: apartment.gain[index]) < 0.012


def test_the_apartments_withheld_views_are_better_as_exposed(apartment: Apartment) -> None:
    assert apartment.jumping.psnr > apartment.jumping.psnr_unexposed + 0.1
    assert apartment.jumping.psnr > apartment.jumping_off.psnr + 0.5


def test_without_exposures_all_pictures_are_as_they_came(apartment: Apartment) -> None:
    result = apartment.jumping_off
    assert {row.exposure for row in result.rows} == {UNCHANGED}
    assert {keyframe.exposure for submap in result.submaps for keyframe in submap.keyframes} == {UNCHANGED}
    assert {report.tracked.exposure for report in result.reports} == {UNCHANGED}
    assert result.psnr == result.psnr_unexposed
