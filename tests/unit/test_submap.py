"""A submap grows, shrinks and is sealed as a value; its Gaussians and their confidence stay together."""

import math
from dataclasses import FrozenInstanceError, fields, replace

import pytest
import torch
from analytic_room import Room, pose

from tcgsplat.confidence.state import ConfidenceConfig, ConfidenceState
from tcgsplat.geometry import se3
from tcgsplat.scene.atlas import Atlas
from tcgsplat.scene.exposure import UNCHANGED, Exposure
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.scene.trajectory import TrackedPose, Trajectory

CONFIG = ConfidenceConfig(model="paper", p_min=0.1, initial=0.3, decay_time=20.0)


def some(count: int, first_id: int) -> Gaussians:
    g = torch.Generator().manual_seed(first_id)
    return replace(
        Gaussians.empty(),
        ids=torch.arange(first_id, first_id + count),
        means=torch.randn(count, 3, generator=g),
        log_scales=torch.randn(count, 3, generator=g),
        quats=torch.randn(count, 4, generator=g),
        logit_opacities=torch.randn(count, generator=g),
        sh=torch.randn(count, 1, 3, generator=g),
    )


def grown_twice() -> Submap:
    submap = Submap.anchored(pose(1, 2, 3), index=4).grown(some(3, 10), CONFIG)
    return replace(submap, clock=5).grown(some(2, 20), CONFIG)


def test_an_anchored_submap_is_empty_and_stands_where_its_camera_was() -> None:
    T = pose(1, 2, 3, degrees=(10, 20, 30))
    submap = Submap.anchored(T, index=4)
    assert len(submap) == 0 and submap.keyframes == () and submap.clock == 0 and submap.index == 4
    torch.testing.assert_close(submap.T_world_map, T, atol=1e-12, rtol=0)


def test_rounding_in_an_anchor_does_not_add_up() -> None:
    bent = pose(1, 2, 3, degrees=(10, 20, 30)) + 1e-6
    bent[3] = torch.tensor([0.0, 0, 0, 1])
    R = Submap.anchored(bent, index=0).T_world_map[:3, :3]
    torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=torch.float64), atol=1e-14, rtol=0)


def test_new_gaussians_are_born_at_the_submaps_clock() -> None:
    submap = grown_twice()
    assert submap.gaussians.ids.tolist() == [10, 11, 12, 20, 21]
    assert submap.confidence.born.tolist() == [0, 0, 0, 5, 5]
    assert submap.confidence.updates.tolist() == [0] * 5
    assert submap.confidence.value.tolist() == pytest.approx([0.3] * 5)


def test_rows_are_dropped_from_both_tables() -> None:
    submap = grown_twice()
    submap = replace(submap, confidence=replace(submap.confidence, value=submap.gaussians.ids / 100))
    kept = submap.kept(torch.tensor([True, False, True, False, True]))
    assert kept.gaussians.ids.tolist() == [10, 12, 21]
    assert kept.confidence.value.tolist() == pytest.approx([0.10, 0.12, 0.21])
    assert kept.confidence.born.tolist() == [0, 0, 5]
    for name in ("means", "log_scales", "quats", "logit_opacities", "sh"):
        assert torch.equal(getattr(kept.gaussians, name), getattr(submap.gaussians, name)[[0, 2, 4]])


def test_growing_by_nothing_and_keeping_everything_change_nothing() -> None:
    submap = grown_twice()
    same = submap.grown(Gaussians.empty(), CONFIG).kept(torch.ones(5, dtype=torch.bool))
    for table in ("gaussians", "confidence"):
        a, b = getattr(submap, table), getattr(same, table)
        assert all(torch.equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))


def test_sealing_makes_up_for_the_decay_before_birth_and_changes_nothing_else() -> None:
    submap = grown_twice()
    sealed = submap.sealed(CONFIG)
    late = 0.1 + 0.2 * math.exp(-5 / 20)
    assert sealed.confidence.value.tolist() == pytest.approx([0.3, 0.3, 0.3, late, late])
    assert sealed.gaussians is submap.gaussians
    assert sealed.confidence.born is submap.confidence.born
    assert sealed.clock == submap.clock


def test_a_submap_is_a_value() -> None:
    submap = grown_twice()
    submap.kept(torch.zeros(5, dtype=torch.bool))
    submap.sealed(CONFIG)
    assert len(submap) == 5
    with pytest.raises(FrozenInstanceError):
        submap.clock = 9  # type: ignore[misc]


def test_tables_of_different_length_do_not_append() -> None:
    assert len(ConfidenceState.empty()) == 0
    with pytest.raises(RuntimeError):
        some(2, 0).appended(replace(some(2, 5), sh=torch.zeros(2, 4, 3)))  # another degree of colour


@pytest.mark.parametrize("exposure", [UNCHANGED, Exposure(0.64, 0.02), Exposure(1.2, -0.1)])
def test_one_wall_is_one_colour_however_it_was_exposed(exposure: Exposure) -> None:
    wall = Room().frame()
    keyframe = Keyframe(replace(wall, color=exposure.applied(wall.color)), se3.identity(), exposure)
    torch.testing.assert_close(keyframe.balanced.color, wall.color, atol=2e-6, rtol=0)
    assert keyframe.balanced.index == wall.index and keyframe.balanced.depth is wall.depth


def test_moving_a_submap_moves_every_frame_that_was_tracked_in_it() -> None:
    atlas = Atlas().with_submap(pose(0)).with_submap(pose(1))
    trajectory = Trajectory()
    for index, submap in enumerate([0, 0, 1, 1]):
        trajectory = trajectory.with_row(TrackedPose(index, index / 30, submap, pose(0, 0, 0.1 * index)))
    moved = atlas.corrected((pose(0), pose(1, 5)))
    before, after = trajectory.world(atlas), trajectory.world(moved)
    assert len(trajectory) == 4
    assert all(torch.equal(a, b) for a, b in zip(before[:2], after[:2], strict=True))
    for a, b in zip(before[2:], after[2:], strict=True):
        torch.testing.assert_close(se3.inverse(a) @ b, pose(0, 5))


def test_submaps_that_have_begun_since_move_with_the_last_that_was_corrected() -> None:
    atlas = Atlas().with_submap(pose(0)).with_submap(pose(1)).with_submap(pose(3))
    moved = atlas.corrected((pose(0), pose(1, 5)))
    between = [se3.inverse(one.T_world_map[1]) @ one.T_world_map[2] for one in (atlas, moved)]
    torch.testing.assert_close(between[1], between[0])
    torch.testing.assert_close(moved.T_world_map[2], pose(3, 5))
    assert atlas.corrected(()) == atlas


def test_velocity_is_the_cameras_own_and_goes_on_across_submaps() -> None:
    velocity = torch.tensor([0.3, -0.1, 0.5, 0.2, 0.1, -0.4], dtype=torch.float64)
    stamps = [0.0, 0.03, 0.1, 0.13]
    world = [pose(2, 1) @ se3.exp(velocity * stamp) for stamp in stamps]
    atlas = Atlas().with_submap(pose(1)).with_submap(world[2])
    rows = [
        TrackedPose(i, stamp, submap, se3.inverse(atlas.T_world_map[submap]) @ T)
        for i, (stamp, submap, T) in enumerate(zip(stamps, [0, 0, 1, 1], world, strict=True))
    ]
    for found in Trajectory(tuple(rows)).velocities(atlas):
        torch.testing.assert_close(found, velocity)
    assert Trajectory(tuple(rows[:1])).velocities(atlas)[0].tolist() == [0.0] * 6
    assert Trajectory().velocities(atlas) == []
