"""A map's surface: where it lies, how it is painted, and what is left out."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_room import Room, pose, rendering_of
from mapped_room import mapped
from meshes import needs_open3d

from tcgsplat.errors import BackendUnavailableError, ConfigError
from tcgsplat.geometry import se3
from tcgsplat.mapping.fusion import FusionConfig, fused, surface_depth
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.mesh import Mesh
from tcgsplat.scene.submap import Submap

COARSE = FusionConfig(voxel_size=0.02)
POSES = (pose(), pose(0.03, 0.01), pose(0.05, -0.03, 0.02, degrees=(2, 4, 0)))


@pytest.fixture(scope="module")
def submap(rasterizer: Rasterizer) -> Submap:
    """Three views of a corner."""
    return mapped(POSES, rasterizer, room=Room())


@pytest.fixture(scope="module")
def mesh(submap: Submap, rasterizer: Rasterizer) -> Mesh:
    return fused(submap, rasterizer, COARSE)


def in_room(mesh: Mesh, room: Room) -> np.ndarray:
    return se3.transform(room.T_room_world, torch.from_numpy(mesh.vertices).double()).numpy()


@needs_open3d
def test_the_surface_of_a_room_lies_on_its_walls(mesh: Mesh) -> None:
    room, points = Room(), in_room(mesh, Room())
    offsets = np.concatenate((points - room.low, points - room.high), axis=1)
    off = np.abs(offsets).min(axis=1)
    assert off.mean() < 0.003 and np.quantile(off, 0.99) < 0.02
    wall = np.abs(offsets).argmin(axis=1)
    for k in np.unique(wall):  # half a pixel or half a voxel would shift whole walls
        assert abs(np.median(offsets[wall == k, k])) < 0.001


@needs_open3d
def test_vertices_have_the_colour_of_the_wall(mesh: Mesh) -> None:
    true = Room().texture(torch.from_numpy(in_room(mesh, Room()))).numpy()
    assert mesh.colors is not None
    assert np.abs(mesh.colors / 255.0 - true).mean() < 0.02


@needs_open3d
def test_vertices_have_the_confidence_of_what_is_there(submap: Submap, rasterizer: Rasterizer) -> None:
    """Half of the Gaussians are believed, the other half are not: so is the surface."""
    left = submap.gaussians.means[:, 0] < 0.0
    value = torch.where(left, 0.9, 0.2)
    submap = replace(submap, confidence=replace(submap.confidence, value=value))
    mesh = fused(submap, rasterizer, COARSE)
    assert mesh.confidence is not None
    x = mesh.vertices[:, 0]
    np.testing.assert_allclose(mesh.confidence[x < -0.08], 0.9, atol=0.01)
    np.testing.assert_allclose(mesh.confidence[x > 0.08], 0.2, atol=0.01)
    trusted = fused(submap, rasterizer, replace(COARSE, min_confidence=0.5))
    assert trusted.vertices[:, 0].max() < 0.1
    assert trusted.areas.sum() > 0.9 * mesh.areas[x[mesh.triangles[:, 0]] < 0].sum()


@needs_open3d
def test_the_same_map_gives_the_same_mesh(mesh: Mesh, submap: Submap, rasterizer: Rasterizer) -> None:
    again = fused(submap, rasterizer, replace(COARSE, truncation=4))  # and a whole number will do
    for name in ("vertices", "triangles", "colors", "confidence"):
        np.testing.assert_array_equal(getattr(again, name), getattr(mesh, name))


@needs_open3d
def test_every_view_is_told(submap: Submap, rasterizer: Rasterizer) -> None:
    told: list[tuple[int, int]] = []
    fused(submap, rasterizer, COARSE, lambda done, total: told.append((done, total)))
    assert told == [(i, 6) for i in range(1, 7)]


@needs_open3d
def test_what_too_few_have_seen_is_no_surface(submap: Submap, rasterizer: Rasterizer) -> None:
    empty = fused(submap, rasterizer, replace(COARSE, min_views=4))
    assert len(empty) == len(empty.vertices) == 0
    assert len(fused(replace(submap, keyframes=()), rasterizer, COARSE)) == 0
    assert len(fused(submap, rasterizer, replace(COARSE, max_depth=0.3, truncation=3))) == 0


@needs_open3d
def test_small_pieces_go(submap: Submap, mesh: Mesh, rasterizer: Rasterizer) -> None:
    assert len(fused(submap, rasterizer, replace(COARSE, min_piece=len(mesh.vertices) + 1))) == 0


def test_depth_between_two_surfaces_is_cut_and_a_slanted_wall_is_not() -> None:
    frame = Room().frame()  # a corner: three inclined planes
    whole = surface_depth(rendering_of(frame), FusionConfig())
    torch.testing.assert_close(whole, frame.depth, atol=1e-6, rtol=0)
    stepped = frame.depth.clone()
    stepped[20:40, 30:50] *= 0.5
    blended = stepped.clone()
    blended[20:40, 30] *= 1.4
    blended[40, 32:50] *= 0.7
    whole, cut = (
        surface_depth(rendering_of(replace(frame, depth=depth)), FusionConfig()) == 0 for depth in (stepped, blended)
    )
    assert whole.sum() <= 8  # where a corner of the room meets the edge
    assert cut[blended != stepped].all() and cut[blended == stepped].sum() <= 12


def test_thin_coverage_and_low_confidence_are_cut() -> None:
    frame = Room().frame()
    alpha = torch.full_like(frame.depth, 0.9)
    alpha[:, :10] = 0.4
    shown = surface_depth(rendering_of(frame, alpha=alpha, confidence=0.3), FusionConfig(edge=9.0)) > 0
    assert not shown[:, :10].any() and shown[:, 11:].all()
    config = FusionConfig(edge=9.0, min_confidence=0.31)
    assert not (surface_depth(rendering_of(frame, alpha=alpha, confidence=0.3), config) > 0).any()


def test_settings_that_cannot_be_right() -> None:
    with pytest.raises(ConfigError, match="above 0"):
        FusionConfig(voxel_size=0.0)


def test_without_open3d_it_says_what_to_install(
    submap: Submap, rasterizer: Rasterizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(BackendUnavailableError, match=r"pip install 'tcgsplat\[mesh\]'"):
        fused(submap, rasterizer)
