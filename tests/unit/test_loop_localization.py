"""Where a camera stands, from features alone."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from analytic_room import pose
from patterned_room import CAMERA, PatternedRoom

from tcgsplat.geometry import se3
from tcgsplat.loop.features import Features, features, pooled
from tcgsplat.loop.localization import relative_pose
from tcgsplat.scene.frame import Frame
from tcgsplat.tensors import Pose

T_WORLD_A = pose(0.2, -0.1, 0.15, degrees=(4, -12, 6))
T_WORLD_B = pose(-0.1, 0.05, 0.0, degrees=(-3, 10, 0))
T_B_A = se3.inverse(T_WORLD_B) @ T_WORLD_A


def frame(T: Pose, noise: float = 0.002, seed: int = 0) -> Frame:
    perfect = PatternedRoom(seed=seed).frame(T, camera=CAMERA)
    generator = torch.Generator().manual_seed(1)
    depth = perfect.depth + noise * perfect.depth**2 * torch.randn(perfect.depth.shape, generator=generator)
    return replace(perfect, depth=depth)


@pytest.fixture(scope="module")
def a() -> Features:
    return features(frame(T_WORLD_A))


@pytest.fixture(scope="module")
def b() -> Features:
    return features(frame(T_WORLD_B))


def apart(T: Pose, truth: Pose) -> tuple[float, float]:
    """Metres and degrees."""
    error = se3.inverse(T) @ truth
    return se3.translation_norm(error), math.degrees(se3.rotation_angle(error))


def test_a_view_is_located_in_another(a: Features, b: Features) -> None:
    found = relative_pose(a, b, CAMERA)
    assert found is not None
    metres, degrees = apart(found.T_b_a, T_B_A)
    assert metres < 0.01
    assert degrees < 0.3
    assert metres < 3 * found.position_error < 0.1
    assert math.radians(degrees) < 3 * found.rotation_error < 0.05
    assert found.inliers > 100
    assert 0.2 < found.share <= 1


def test_colours_alone_locate_less_precisely(a: Features, b: Features) -> None:
    blind = replace(a, points=np.full_like(a.points, np.nan))
    found, sharper = relative_pose(blind, b, CAMERA), relative_pose(a, b, CAMERA)
    assert found is not None
    assert sharper is not None
    assert apart(found.T_b_a, T_B_A)[0] < 0.02
    assert found.position_error > sharper.position_error


def test_a_map_of_several_pictures_tells_more_than_one(a: Features, b: Features) -> None:
    T_map_b, T_WORLD_C = pose(1.0, 2.0, 3.0, degrees=(10, 50, -30)), pose(0.1, 0.1, -0.1, degrees=(0, -20, 0))
    T_map_c = T_map_b @ se3.inverse(T_WORLD_B) @ T_WORLD_C
    one = relative_pose(a, pooled([(b, T_map_b)]), CAMERA)
    both = relative_pose(a, pooled([(b, T_map_b), (features(frame(T_WORLD_C)), T_map_c)]), CAMERA)
    assert one is not None
    assert both is not None
    assert apart(both.T_b_a, T_map_b @ T_B_A)[0] < 0.01
    assert both.inliers > one.inliers


def test_chance_has_no_part_in_it(a: Features, b: Features) -> None:
    np.random.seed(1)
    cv2.setRNGSeed(1)
    first = relative_pose(a, b, CAMERA)
    drawn = np.random.random(), cv2.randu(np.zeros(4), 0, 1).tolist()
    np.random.seed(1)
    cv2.setRNGSeed(1)
    assert (np.random.random(), cv2.randu(np.zeros(4), 0, 1).tolist()) == drawn  # nothing was drawn from these
    again = relative_pose(a, b, CAMERA)
    assert first is not None
    assert again is not None
    assert torch.equal(first.T_b_a, again.T_b_a)
    assert np.array_equal(first.information, again.information)


def test_another_room_is_not_this_one(a: Features) -> None:
    assert relative_pose(a, features(frame(T_WORLD_B, seed=7)), CAMERA) is None


def test_nothing_can_be_said_without_points_or_features(a: Features, b: Features) -> None:
    assert relative_pose(a, replace(b, points=np.full_like(b.points, np.nan)), CAMERA) is None
    assert relative_pose(pooled(()), b, CAMERA) is None
    assert relative_pose(a, pooled(()), CAMERA) is None


def test_what_is_uncertain_is_not_said(a: Features, b: Features) -> None:
    found = relative_pose(a, b, CAMERA)
    assert found is not None
    assert relative_pose(a, b, CAMERA, min_inliers=found.inliers) is not None
    assert relative_pose(a, b, CAMERA, min_inliers=found.inliers + 1) is None
    assert relative_pose(a, b, CAMERA, min_share=found.share + 1e-6) is None
    assert relative_pose(a, b, CAMERA, max_position_error=0.99 * found.position_error) is None


def test_random_descriptors_are_never_located(a: Features, b: Features) -> None:
    generator = np.random.default_rng(3)
    noise = replace(a, descriptors=generator.integers(0, 256, a.descriptors.shape, dtype=np.uint8))
    assert relative_pose(noise, b, CAMERA, max_position_error=math.inf) is None


def test_errors_are_what_is_expected_of_them() -> None:
    """Over many small scenes the errors keep to the stated covariance, which is meant to be on the safe side."""
    generator = np.random.default_rng(0)
    squared = []
    for _ in range(20):
        k = 150
        pixels = np.stack((generator.uniform(0, 320, k), generator.uniform(0, 240, k)), axis=1)
        depth = generator.uniform(0.8, 3.0, k)
        rays = np.stack(((pixels[:, 0] - CAMERA.cx) / CAMERA.fx, (pixels[:, 1] - CAMERA.cy) / CAMERA.fy, np.ones(k)), 1)
        truth, descriptors = rays * depth[:, None], generator.integers(0, 256, (k, 32), dtype=np.uint8)
        in_b = (T_B_A[:3, :3].numpy() @ truth.T).T + T_B_A[:3, 3].numpy()
        seen_b = in_b * (1 + 0.003 * in_b[:, 2:] * generator.standard_normal((k, 1)))
        seen_b[:, :2] += in_b[:, 2:] / CAMERA.fx * generator.standard_normal((k, 2))
        read = depth * (1 + 0.003 * depth * generator.standard_normal(k))
        pixels = (pixels + generator.standard_normal((k, 2))).astype(np.float32)
        ones, zeros = np.ones(k, np.float32), np.zeros((k, 3), np.float32)
        a = Features(pixels, ones, descriptors, (rays * read[:, None]).astype(np.float32), zeros)
        found = relative_pose(a, Features(pixels, ones, descriptors, seen_b.astype(np.float32), zeros), CAMERA)
        assert found is not None
        error = se3.log(se3.inverse(found.T_b_a) @ T_B_A).numpy()
        squared.append(error @ found.information @ error)
    assert 0.2 < np.mean(squared) < 6.0  # 6 if errors were as large as is said: here all are independent
