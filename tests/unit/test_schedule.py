"""When frames are mapped and submaps end."""

from dataclasses import replace

import pytest
import torch
from analytic_room import Room, pose

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.errors import ConfigError
from tcgsplat.geometry import se3
from tcgsplat.mapping.schedule import Schedule, ScheduleConfig
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.submap import Keyframe, Submap

MOTION = ScheduleConfig(map_every=4, submap_by="motion", submap_distance=0.5, submap_angle=50.0)
INTERVAL = ScheduleConfig(map_every=4, submap_by="interval", submap_interval=30)
EMPTY = Submap.anchored(se3.identity(), index=0)
HERE = se3.identity()
ONE = Gaussians(
    ids=torch.zeros(1, dtype=torch.int64),
    means=torch.zeros(1, 3),
    log_scales=torch.zeros(1, 3),
    quats=torch.ones(1, 4),
    logit_opacities=torch.zeros(1),
    sh=torch.zeros(1, 1, 3),
)


def submap(*mapped: int) -> Submap:
    frames = [Room().frame(index=index) for index in mapped]
    keyframes = tuple(Keyframe(frame, se3.identity()) for frame in frames)
    return replace(EMPTY.grown(ONE, ConfidenceConfig()), keyframes=keyframes)


def test_a_submap_that_lost_all_its_gaussians_is_mapped_at_once() -> None:
    assert not Schedule(MOTION).maps(1, 1, submap(0))
    assert Schedule(MOTION).maps(1, 1, replace(submap(0), gaussians=Gaussians.empty()))


@pytest.mark.parametrize("config", [MOTION, INTERVAL])
def test_the_first_frame_is_mapped_and_begins_no_second_submap(config: ScheduleConfig) -> None:
    schedule = Schedule(config)
    assert schedule.maps(0, 0, EMPTY)
    assert schedule.maps(77, 77, EMPTY)
    assert not schedule.switches_submap(77, pose(9.0), EMPTY)


def test_mapping_comes_round_after_the_last_mapped_frame() -> None:
    schedule = Schedule(MOTION)
    assert [i for i in range(1, 7) if schedule.maps(10 + i, i, submap(3, 10))] == [4, 5, 6]


def test_an_update_is_adopted_after_its_lag() -> None:
    assert [i for i in range(1, 6) if Schedule(replace(MOTION, map_lag=3)).adopts(i)] == [3, 4, 5]


@pytest.mark.parametrize(
    ("T_map_cam", "ends"),
    [
        (pose(0.49), False),
        (pose(0.51), True),
        (pose(0.3, 0.3, 0.3), True),
        (pose(-0.2, -0.2, -0.2), False),
        (pose(degrees=(0, 49.5, 0)), False),
        (pose(degrees=(0, 50.5, 0)), True),
        (pose(degrees=(30, -30, 30)), True),  # each axis is within, the rotation is not
        (pose(degrees=(0, 0, 179)), True),
    ],
)
def test_motion_ends_a_submap_by_distance_or_by_angle(T_map_cam: torch.Tensor, ends: bool) -> None:
    assert Schedule(MOTION).switches_submap(1, T_map_cam, submap(0)) is ends
    assert not Schedule(INTERVAL).switches_submap(1, T_map_cam, submap(0))


def test_frames_end_a_submap_by_their_number() -> None:
    schedule = Schedule(INTERVAL)
    assert [i for i in range(35, 45) if schedule.switches_submap(i, HERE, submap(10, 20, 34))] == [40, 41, 42, 43, 44]
    assert not Schedule(MOTION).switches_submap(1000, HERE, submap(10))


@pytest.mark.parametrize("name", ["map_every", "submap_distance", "submap_angle", "submap_interval"])
@pytest.mark.parametrize("value", [0, -1])
def test_rhythm_that_cannot_be_is_refused_by_name(name: str, value: int) -> None:
    with pytest.raises(ConfigError, match=rf"schedule\.{name} is {value}; it must be above 0"):
        replace(MOTION, **{name: value})  # type: ignore[arg-type]


def test_an_unknown_rule_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match=r"schedule\.submap_by is 'mood'; choose motion or interval"):
        ScheduleConfig(submap_by="mood")  # type: ignore[arg-type]


@pytest.mark.parametrize("config", [MOTION, INTERVAL])
def test_withheld_frames_are_neither_mapped_nor_begin_a_submap(config: ScheduleConfig) -> None:
    schedule = Schedule(replace(config, withhold_every=8))
    assert [i for i in range(20, 30) if schedule.maps(i, i - 16, submap(16))] == [20, 21, 22, 23, 25, 26, 27, 28, 29]
    gone = replace(submap(16), gaussians=Gaussians.empty())
    assert [i for i in range(22, 27) if schedule.maps(i, 1, gone)] == [22, 23, 25, 26]
    assert [i for i in range(46, 51) if schedule.switches_submap(i, pose(9.0), submap(16))] == [46, 47, 49, 50]
    assert not Schedule(config).config.withholds(0)


def test_without_a_withheld_frame_there_would_be_no_map() -> None:
    schedule = Schedule(replace(MOTION, withhold_every=8))
    assert schedule.maps(0, 0, EMPTY)
    assert schedule.maps(16, 1, EMPTY)


@pytest.mark.parametrize("value", [1, -8])
def test_not_every_frame_can_be_withheld(value: int) -> None:
    with pytest.raises(ConfigError, match=rf"schedule\.withhold_every is {value}; it must be at least 2, or 0"):
        replace(MOTION, withhold_every=value)
