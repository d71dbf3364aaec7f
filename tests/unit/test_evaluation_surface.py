"""Scores of meshes whose distances are known."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic_room import Room, pose, walk
from hypothesis import given, settings
from hypothesis import strategies as st
from mapped_room import CAMERA, mapped
from meshes import box, joined, needs_open3d, rectangle

from tcgsplat.config import SlamConfig, to_toml
from tcgsplat.errors import EvaluationError
from tcgsplat.evaluation.surface import (
    SurfaceConfig,
    SurfaceScore,
    Views,
    aligned_by_poses,
    surface_metrics,
    surface_of_run,
    true_mesh_path,
)
from tcgsplat.geometry import se3
from tcgsplat.mapping.fusion import FusionConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.atlas import Atlas
from tcgsplat.scene.mesh import Mesh
from tcgsplat.scene.trajectory import TrackedPose, Trajectory
from tcgsplat.storage.run_directory import RunDirectory
from tcgsplat.tensors import Pose

pytestmark = needs_open3d
FEW = SurfaceConfig(points=4000, virtual_views=10)
WALL = rectangle((-1, -1), (1, 1), z=2.0)
ALL_AROUND = [pose(degrees=(0.0, 45.0 * i, 0.0)) for i in range(8)]
ALL_AROUND += [pose(degrees=(d, 0.0, 0.0)) for d in (-90, -45, 45, 90)]
IN_ROOM = Views(CAMERA, ALL_AROUND)
BEFORE_IT = Views(CAMERA, [pose(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)])


def behind(mesh: Mesh, distance: float) -> Mesh:
    return mesh.moved(pose(z=distance))


def test_of_two_parallel_walls() -> None:
    for distance, near in ((0.008, 1.0), (0.012, 0.0)):
        for way in (1, -1):
            score = surface_metrics(behind(WALL, way * distance), WALL, BEFORE_IT, FEW)
            assert score.accuracy == pytest.approx(distance, abs=1e-5)
            assert score.completion == pytest.approx(distance, abs=1e-5)
            assert (score.precision, score.recall, score.f1) == (near, near, near)
            assert score.completion_ratio == 1.0 and score.seen == 1.0


def test_half_of_a_wall() -> None:
    score = surface_metrics(rectangle((-1, -1), (0, 1), z=2.0), WALL, BEFORE_IT, FEW)
    assert score.precision == 1.0 and score.accuracy < 1e-5
    assert score.recall == pytest.approx(0.5, abs=0.03)
    assert score.completion_ratio == pytest.approx(0.525, abs=0.03)
    assert score.completion == pytest.approx(0.25, abs=0.02)  # the mean of what goes from 0 to 1 m over one half
    assert score.f1 == pytest.approx(2 / 3, abs=0.03)
    assert score.depth_coverage == pytest.approx(0.5, abs=0.2)


def test_what_floats_about_costs_accuracy_but_not_completion() -> None:
    floating = rectangle((-1, -1), (1, 1), z=1.5)
    score = surface_metrics(joined(WALL, floating), WALL, BEFORE_IT, FEW)
    assert score.completion < 1e-5 and score.recall == 1.0
    assert score.precision < 0.6 and score.depth_l1 > 0.05


def test_depth_l1_of_a_room_that_is_too_large() -> None:
    """In a cube whose walls are 2 cm farther away, a ray is longer by at least that in depth, and more aslant."""
    room, larger = box((-1, -1, -1), (1, 1, 1)), box((-1.02, -1.02, -1.02), (1.02, 1.02, 1.02))
    score = surface_metrics(larger, room, IN_ROOM, FEW)
    assert score.virtual_views == FEW.virtual_views and score.depth_coverage == 1.0
    assert 0.02 < score.depth_l1 < 0.05
    assert score.accuracy == pytest.approx(0.02, abs=0.002)


def test_nothing_is_asked_about_what_no_camera_saw() -> None:
    hidden = rectangle((-0.5, -0.5), (0.5, 0.5), z=3.0)
    aside = rectangle((20, 20), (22, 22), z=2.0)
    score = surface_metrics(WALL, joined(WALL, hidden, aside), BEFORE_IT, FEW)
    assert score.recall == 1.0 and score.completion < 1e-5
    assert score.seen == pytest.approx(4 / 9, abs=0.03)
    reverse = surface_metrics(joined(WALL, hidden, aside), WALL, BEFORE_IT, FEW)
    assert reverse.precision == 1.0
    bare = surface_metrics(WALL, joined(WALL, rectangle((-0.5, -0.5), (0.5, 0.5), z=1.8)), BEFORE_IT, FEW)
    assert bare.recall < 0.9  # what hides a part of the wall was seen itself


def test_a_surface_in_the_wrong_place_is_asked_about_even_behind_the_true_one() -> None:
    score = surface_metrics(behind(WALL, 0.3), WALL, BEFORE_IT, FEW)
    assert score.accuracy == pytest.approx(0.3, abs=0.03) and score.precision == 0.0


def test_virtual_views_stand_in_free_space_only() -> None:
    """Most of the bounding box is outside the small room, and no view is from there: it would see the hut's outside."""
    room, hut = box((-1, -1, -1), (1, 1, 1)), box((5, -1, -1), (6, 1, 1))
    score = surface_metrics(room, joined(room, hut), IN_ROOM, FEW)
    assert score.virtual_views == FEW.virtual_views
    assert score.depth_coverage == 1.0 and score.depth_l1 < 1e-5


@settings(max_examples=10, deadline=None)
@given(
    size=st.tuples(*[st.floats(0.5, 3.0)] * 3),
    place=st.tuples(*[st.floats(-5.0, 5.0)] * 3),
    angles=st.tuples(*[st.floats(-180.0, 180.0)] * 3),
    icp=st.booleans(),
    seed=st.integers(0, 2**32),
)
def test_a_mesh_agrees_with_itself(
    size: tuple[float, float, float],
    place: tuple[float, float, float],
    angles: tuple[float, float, float],
    icp: bool,
    seed: int,
) -> None:
    a, b, c = size
    T = pose(*place, degrees=angles)
    mesh = box((-a, -b, -c), (a, b, c)).moved(T)
    config = replace(FEW, points=1000, virtual_views=8, icp=icp, seed=seed)
    score = surface_metrics(mesh, mesh, Views(CAMERA, [T @ T_box_cam for T_box_cam in ALL_AROUND]), config)
    assert max(score.accuracy, score.completion, score.depth_l1) < 1e-5
    assert score.precision == score.recall == score.f1 == score.completion_ratio == score.depth_coverage == 1.0
    assert 1 <= score.virtual_views <= 8 and 0.4 < score.seen <= 1.0


def test_the_same_seed_gives_the_same_score_and_another_nearly() -> None:
    half = rectangle((-1, -1), (0, 1), z=2.01)
    a, b, c = (surface_metrics(half, WALL, BEFORE_IT, replace(FEW, seed=seed)) for seed in (0, 0, 1))
    assert a == b != c
    assert a.recall == pytest.approx(c.recall, abs=0.05)


def test_icp_takes_a_shift_away_and_says_so() -> None:
    room = box((-1, -1, -1), (1, 1, 1))
    off = room.moved(pose(0.02, -0.015, 0.01, degrees=(0.3, 0.0, -0.4)))
    plain = surface_metrics(off, room, IN_ROOM, FEW)
    fitted = surface_metrics(off, room, IN_ROOM, replace(FEW, icp=True))
    assert plain.icp is None and plain.f1 < 0.5 and "ICP" not in plain.evaluated()
    assert fitted.icp is not None and 0.02 < fitted.icp < 0.04 and fitted.f1 == 1.0 and fitted.accuracy < 0.001
    assert "by poses, then ICP (moved it by 2" in fitted.evaluated() or "moved it by 3" in fitted.evaluated()


def test_what_cannot_be_compared() -> None:
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    with pytest.raises(EvaluationError, match="estimated mesh has no surface"):
        surface_metrics(empty, WALL, BEFORE_IT, FEW)
    with pytest.raises(EvaluationError, match="true mesh has no surface"):
        surface_metrics(WALL, empty, BEFORE_IT, FEW)
    with pytest.raises(EvaluationError, match="no training camera saw any"):
        surface_metrics(WALL, behind(WALL, -9.0), BEFORE_IT, FEW)
    with pytest.raises(EvaluationError, match="at least 3"):
        aligned_by_poses([pose()] * 2, [pose()] * 2)
    nowhere = surface_metrics(behind(WALL, -9.0), WALL, BEFORE_IT, FEW)
    assert math.isnan(nowhere.accuracy) and nowhere.precision == nowhere.f1 == 0.0


def test_rows_have_units() -> None:
    score = SurfaceScore(0.01, 0.02, 0.9, 0.6, 0.95, 0.03, 0.8, 10, 0.5)
    assert score.rows()["mesh_accuracy"] == (1.0, "cm")
    assert score.rows()["mesh_f1_1cm"] == (pytest.approx(72.0), "%")


def test_alignment_is_by_where_cameras_look_too() -> None:
    """On a straight path centres leave a turn about it open."""
    straight = [pose(0.1 * i, degrees=(0.0, 0.2 * i, 0.0)) for i in range(10)]
    T = pose(1.0, 2.0, -0.5, degrees=(20, -50, 70))
    fit = aligned_by_poses(straight, [T @ pose_ for pose_ in straight])
    np.testing.assert_allclose(fit.rotation, T[:3, :3].numpy(), atol=1e-12)
    np.testing.assert_allclose(fit.translation, T[:3, 3].numpy(), atol=1e-12)


def test_the_true_mesh_is_found_in_the_folder_or_beside_it(tmp_path: Path) -> None:
    folder = tmp_path / "room0"
    folder.mkdir()
    assert true_mesh_path(folder) is None
    (tmp_path / "room0_mesh.ply").touch()
    assert true_mesh_path(folder) == tmp_path / "room0_mesh.ply"
    (folder / "mesh.ply").touch()
    assert true_mesh_path(folder) == folder / "mesh.ply"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, rasterizer: Rasterizer) -> RunDirectory:
    """Of the analytic room, mapped from where its cameras truly were."""
    poses = walk(3)
    submap = mapped(poses, rasterizer, room=Room())
    run = RunDirectory.create(
        tmp_path_factory.mktemp("runs") / "room", config_toml=to_toml(SlamConfig()), sequence="nowhere"
    )
    run.write_submap(submap)
    rows = tuple(TrackedPose(i, i / 30, 0, T, mapped=True) for i, T in enumerate(poses))
    run.write_trajectory(Trajectory(rows), Atlas((se3.identity(),)))
    return run


def true_room(T_truth_world: Pose) -> Mesh:
    room = Room()
    return box(room.low, room.high).moved(T_truth_world @ se3.inverse(room.T_room_world))


def test_a_run_is_fused_aligned_and_scored(run: RunDirectory, rasterizer: Rasterizer) -> None:
    T = pose(3.0, 1.0, -2.0, degrees=(10, 130, -40))
    truth = dict(enumerate(T @ T_world_cam for T_world_cam in walk(3)))
    told: list[tuple[int, int]] = []
    mesh, score = surface_of_run(
        run,
        true_room(T),
        CAMERA,
        truth,
        rasterizer,
        fusion=FusionConfig(voxel_size=0.02),
        config=FEW,
        progress=lambda done, total: told.append((done, total)),
    )
    assert told == [(i, 6) for i in range(1, 7)] and mesh.confidence is not None
    assert score.accuracy < 0.004 and score.precision > 0.95
    assert score.recall > 0.85 and score.completion < 0.01 and score.depth_l1 < 0.02
    away = torch.from_numpy(mesh.vertices) - T[:3, 3]
    assert away.norm(dim=1).max() < 3.0


def test_a_run_without_true_poses_cannot_be_scored(run: RunDirectory, rasterizer: Rasterizer) -> None:
    with pytest.raises(EvaluationError, match="only 1 poses have a true counterpart"):
        surface_of_run(run, true_room(se3.identity()), CAMERA, {1: pose()}, rasterizer)
