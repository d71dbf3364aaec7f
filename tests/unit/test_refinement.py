"""Refining a finished submap."""

from dataclasses import fields

import pytest
import torch
from analytic_room import CAMERA, Room, pose

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.mapping import refinement
from tcgsplat.mapping.mapper import Mapper
from tcgsplat.mapping.refinement import for_seconds, for_steps, refined
from tcgsplat.mapping.seeding import IdSource
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import render_view
from tcgsplat.scene.submap import Keyframe, Submap

CONFIG = MapperConfig(iterations=1, first_iterations=1)
CONFIDENCE = ConfidenceConfig().for_updates_of(10)
POSES = (pose(), pose(0.04, 0.01), pose(0.02, -0.03, 0.02, degrees=(3, 5, 0)))
WITHHELD = pose(0.03, -0.01, 0.01, degrees=(1, 2, 0))


@pytest.fixture(scope="module")
def submap(rasterizer: Rasterizer) -> Submap:
    mapper = Mapper(CONFIG, CONFIDENCE, rasterizer, IdSource(), torch.Generator().manual_seed(1))
    submap = Submap.anchored(se3.identity(), index=0)
    for index, T_map_cam in enumerate(POSES):
        keyframe = Keyframe(Room().frame(T_map_cam, index=index), T_map_cam)
        submap = mapper.optimized(mapper.grown(keyframe, submap)).submap
    return submap


def refined_by(steps: int, submap: Submap, rasterizer: Rasterizer, seed: int = 0) -> Submap:
    return refined(submap, CONFIG, CONFIDENCE, rasterizer, torch.Generator().manual_seed(seed), for_steps(steps))


def error(submap: Submap, rasterizer: Rasterizer) -> float:
    shown = render_view(submap, CAMERA, WITHHELD, rasterizer).color
    return float((shown - Room().frame(WITHHELD).color).square().mean())


def test_a_view_that_was_never_mapped_gets_better(submap: Submap, rasterizer: Rasterizer) -> None:
    errors = [error(refined_by(steps, submap, rasterizer), rasterizer) for steps in (0, 30, 150)]
    assert errors[0] > 1.5 * errors[1] > 1.5 * 1.1 * errors[2]


def test_what_is_not_the_picture_stays(submap: Submap, rasterizer: Rasterizer) -> None:
    after = refined_by(20, submap, rasterizer)
    kept = torch.isin(submap.gaussians.ids, after.gaussians.ids)
    assert after.keyframes is submap.keyframes
    assert after.clock == submap.clock
    for field in fields(after.confidence):
        assert torch.equal(getattr(after.confidence, field.name), getattr(submap.confidence, field.name)[kept])


def test_steps_repeat_to_the_bit(submap: Submap, rasterizer: Rasterizer) -> None:
    a, b, c = (refined_by(7, submap, rasterizer, seed) for seed in (0, 0, 1))
    assert torch.equal(a.gaussians.means, b.gaussians.means)
    assert not torch.equal(a.gaussians.means, c.gaussians.means)


def test_every_keyframe_is_seen_before_any_is_seen_again(submap: Submap, rasterizer: Rasterizer) -> None:
    """Three steps reach what only one of the three views shows, whatever the order."""
    for seed in range(3):
        after = refined_by(3, submap, rasterizer, seed)
        moved = (after.gaussians.means != submap.gaussians.means).any(dim=1)
        for T_map_cam in POSES:
            assert moved[render_view(submap, CAMERA, T_map_cam, rasterizer).visible].float().mean() > 0.99


def test_so_many_steps_are_taken_at_their_paces(
    submap: Submap, rasterizer: Rasterizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the number that is taken in one go."""
    asked: list[int] = []

    def effort(steps: int) -> float:
        asked.append(steps)
        return for_steps(20)(steps)

    found = []
    for at_once in (1, 3, 16, 50):
        monkeypatch.setattr(refinement, "AT_ONCE", at_once)
        after = refined(submap, CONFIG, CONFIDENCE, rasterizer, torch.Generator().manual_seed(0), effort)
        found.append(after.gaussians.means)
        assert asked[-1] == max(asked) == 20
    assert all(torch.equal(means, found[0]) for means in found)


def test_time_ends_it_too(submap: Submap, rasterizer: Rasterizer) -> None:
    generator = torch.Generator().manual_seed(0)
    after = refined(submap, CONFIG, CONFIDENCE, rasterizer, generator, for_seconds(0.2))
    assert not torch.equal(after.gaussians.means, submap.gaussians.means)


def test_an_empty_submap_is_left_alone(rasterizer: Rasterizer) -> None:
    empty = Submap.anchored(se3.identity(), index=0)
    assert refined_by(5, empty, rasterizer) is empty
