"""What a place is known again by."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_room import pose
from patterned_room import CAMERA, PatternedRoom

from tcgsplat.geometry import se3
from tcgsplat.loop.features import Features, features, matched, pooled
from tcgsplat.scene.frame import Frame


@pytest.fixture(scope="module")
def frame() -> Frame:
    return PatternedRoom().frame(camera=CAMERA)


def made(points: list[list[float]], first_bits: list[int]) -> Features:
    """Features at points, whose descriptors are so many ones and then zeros."""
    bits = np.arange(256) < np.array(first_bits)[:, None]
    k = len(points)
    return Features(
        np.zeros((k, 2), np.float32),
        np.ones(k, np.float32),
        np.packbits(bits, axis=1),
        np.array(points, np.float32),
        np.zeros((k, 3), np.float32),
    )


def test_they_are_the_same_every_time_and_no_more_than_asked_for(frame: Frame) -> None:
    first, again = features(frame, limit=300), features(frame, limit=300)
    assert 250 < len(first) <= 300
    for name in ("pixels", "scales", "descriptors", "points", "origins"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))


def test_a_point_is_where_the_pixel_shows_it(frame: Frame) -> None:
    found = features(frame)
    assert np.isfinite(found.points).all()
    assert np.abs(CAMERA.project(torch.from_numpy(found.points)).numpy() - found.pixels).max() < 1e-3
    columns, rows = np.rint(found.pixels).astype(int).T
    read = frame.depth.numpy()[rows, columns]
    assert np.quantile(np.abs(found.points[:, 2] / read - 1), 0.95) < 0.03


def test_a_flat_picture_has_none(frame: Frame) -> None:
    flat = features(replace(frame, color=torch.full_like(frame.color, 0.4)))
    assert len(flat) == 0
    assert matched(flat, features(frame)).shape == (0, 2)
    assert matched(features(frame), flat).shape == (0, 2)
    assert len(pooled([(flat, se3.identity())])) == 0


def test_colours_out_of_range_do_no_harm(frame: Frame) -> None:
    assert len(features(replace(frame, color=3 * frame.color - 1))) > 100


def test_only_what_saw_the_world_counts(frame: Frame) -> None:
    valid = frame.valid.clone()
    valid[:, :160] = False
    found = features(replace(frame, valid=valid))
    assert len(found) > 100
    assert found.pixels[:, 0].min() > 150  # on a coarse level a feature is not exact to the pixel


def test_without_depth_there_are_pixels_but_no_points(frame: Frame) -> None:
    found = features(replace(frame, depth=torch.zeros_like(frame.depth)))
    assert len(found) > 100
    assert np.isnan(found.points).all()
    assert len(found.measured) == 0


def test_at_an_edge_of_depth_the_nearer_surface_owns_the_corner(frame: Frame) -> None:
    rows, columns = torch.meshgrid(torch.arange(240), torch.arange(320), indexing="ij")
    near = (rows - 120).abs() + (columns - 160).abs() < 60
    found = features(
        replace(
            frame,
            color=(0.2 + 0.6 * near.float())[..., None].expand(-1, -1, 3).clone(),
            depth=torch.where(near, 1.0, 3.0),
        )
    )
    assert len(found) > 4
    assert np.mean(found.points[:, 2] == 1.0) > 0.9


def test_pooled_features_are_in_the_frame_of_the_map(frame: Frame) -> None:
    found, T = features(frame), pose(0.5, -0.2, 0.1, degrees=(5, -20, 3))
    both = pooled([(found, se3.identity()), (found, T)])
    k = len(found)
    np.testing.assert_array_equal(both.points[:k], found.points)
    np.testing.assert_allclose(both.points[k:], se3.transform(T, torch.from_numpy(found.points)).numpy(), atol=1e-5)
    np.testing.assert_allclose(both.origins[k:], np.tile(T[:3, 3].numpy(), (k, 1)), atol=1e-6)


def test_a_picture_matches_itself(frame: Frame) -> None:
    found = features(frame)
    pairs = matched(found, found)
    assert len(pairs) > 0.8 * len(found)
    assert np.mean(np.linalg.norm(found.points[pairs[:, 0]] - found.points[pairs[:, 1]], axis=1) < 0.05) > 0.99


def test_a_rival_counts_only_where_it_is_elsewhere() -> None:
    a = made([[0, 0, 1]], [100])
    assert len(matched(a, made([[0, 0, 1], [0.02, 0, 1], [0.5, 0, 1]], [101, 102, 150]))) == 1
    assert len(matched(a, made([[0, 0, 1], [0.50, 0, 1], [0.5, 0, 1]], [108, 109, 150]))) == 0
    unknown = made([[0, 0, 1], [np.nan, np.nan, np.nan]], [108, 109])
    assert len(matched(a, unknown)) == 0


def test_a_match_is_nearest_on_both_sides() -> None:
    a, b = made([[0, 0, 1], [1, 0, 1]], [100, 103]), made([[0, 0, 2], [1, 0, 2]], [104, 200])
    assert matched(a, b).tolist() == [[1, 0]]
