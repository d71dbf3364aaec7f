"""Closing the holes of a finished submap by guesses that nobody can object to."""

from dataclasses import fields, replace

import pytest
import torch
from analytic_room import CAMERA, Room, pose

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.mapping.completion import completed
from tcgsplat.mapping.mapper import Mapper
from tcgsplat.mapping.seeding import IdSource, SeedingConfig
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import render_view
from tcgsplat.scene.exposure import Exposure
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.tensors import Mask

SEEDING, CONFIDENCE = SeedingConfig(spacing=1, footprint=0.5), ConfidenceConfig()


def patch() -> Mask:
    """Pixels in the middle of the picture that the sensor cannot measure."""
    mask = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
    mask[CAMERA.height // 3 : CAMERA.height // 2, CAMERA.width // 3 : CAMERA.width // 2] = True
    return mask


def blinded(frame: Frame) -> Frame:
    return replace(frame, depth=torch.where(patch(), 0.0, frame.depth))


@pytest.fixture(scope="module")
def holey(rasterizer: Rasterizer) -> Submap:
    """The room mapped from one view in which a patch has no reading."""
    config = MapperConfig(seeding=SEEDING, first_iterations=5)
    mapper = Mapper(config, CONFIDENCE, rasterizer, IdSource(), torch.Generator().manual_seed(0))
    start = Submap.anchored(se3.identity(), index=3)
    return mapper.optimized(mapper.grown(Keyframe(blinded(Room().frame()), se3.identity()), start)).submap


def test_a_hole_is_closed_in_the_colour_of_the_picture(holey: Submap, rasterizer: Rasterizer) -> None:
    before = render_view(holey, CAMERA, se3.identity(), rasterizer)
    whole = completed(holey, SEEDING, CONFIDENCE, rasterizer)
    after, true = render_view(whole, CAMERA, se3.identity(), rasterizer), Room().frame()
    hole = patch() & (before.alpha < SEEDING.min_alpha)
    assert hole.sum() > 0.8 * patch().sum()
    assert after.alpha[hole].min() > 0.6
    assert (after.color - true.color)[hole].abs().mean() < 0.05
    assert (after.depth / true.depth)[hole].median() == pytest.approx(1.02, abs=0.06)
    outside = ~torch.nn.functional.max_pool2d(patch()[None].float(), 9, 1, 4)[0].bool()
    assert torch.equal(after.color[outside], before.color[outside])


def test_what_was_measured_stays_and_guesses_tell_themselves(holey: Submap, rasterizer: Rasterizer) -> None:
    whole, n = completed(holey, SEEDING, CONFIDENCE, rasterizer), len(holey)
    for part in ("gaussians", "confidence"):
        for field in fields(getattr(holey, part)):
            assert torch.equal(getattr(getattr(whole, part), field.name)[:n], getattr(getattr(holey, part), field.name))
    ids = whole.gaussians.ids
    assert (ids[:n] >= 0).all() and (ids[n:] < 0).all() and len(ids.unique()) == len(ids) > n
    other = completed(replace(holey, index=4), SEEDING, CONFIDENCE, rasterizer)
    assert not torch.isin(other.gaussians.ids[n:], ids).any()
    assert (whole.confidence.value[n:] == CONFIDENCE.p_min).all()
    assert whole.keyframes is holey.keyframes


def test_twice_is_once(holey: Submap, rasterizer: Rasterizer) -> None:
    """What is closed is not closed again, but for single pixels on the rim."""
    once = completed(holey, SEEDING, CONFIDENCE, rasterizer)
    again = completed(once, SEEDING, CONFIDENCE, rasterizer)
    assert len(again) - len(once) < 0.02 * (len(once) - len(holey))


def test_a_map_without_holes_stays(corner: Submap, rasterizer: Rasterizer) -> None:
    assert len(completed(corner, SEEDING, CONFIDENCE, rasterizer)) == len(corner)


def looking(depth: float, index: int = 0, hole: bool = False) -> Keyframe:
    """A view of a flat wall."""
    frame = replace(Room().frame(), index=index, depth=torch.full((CAMERA.height, CAMERA.width), depth))
    return Keyframe(blinded(frame) if hole else frame, se3.identity())


@pytest.mark.parametrize(("measured", "kept"), [(0.99, True), (1.05, True), (1.3, False), (3.0, False), (0.3, True)])
def test_no_guess_stands_where_another_keyframe_looked_through(
    measured: float, kept: bool, rasterizer: Rasterizer
) -> None:
    """Its guess, at 1.02 m, must not lie well before a reading; behind one, or without one, nobody can tell."""
    submap = replace(
        Submap.anchored(se3.identity(), index=0), keyframes=(looking(1.0, hole=True), looking(measured, 1))
    )
    assert (len(completed(submap, SEEDING, CONFIDENCE, rasterizer)) > 0) is kept


def test_a_keyframe_that_looks_elsewhere_does_not_object(rasterizer: Rasterizer) -> None:
    away = replace(looking(3.0, 1), T_map_cam=pose(0.0, degrees=(0, 180, 0)))
    submap = replace(Submap.anchored(se3.identity(), index=0), keyframes=(looking(1.0, hole=True), away))
    assert len(completed(submap, SEEDING, CONFIDENCE, rasterizer)) > 0


def test_a_picture_without_any_reading_tells_nothing(rasterizer: Rasterizer) -> None:
    submap = replace(Submap.anchored(se3.identity(), index=0), keyframes=(looking(0.0),))
    assert completed(submap, SEEDING, CONFIDENCE, rasterizer) is submap


def test_guesses_have_the_brightness_of_the_map(rasterizer: Rasterizer) -> None:
    plain, exposure = looking(1.0, hole=True), Exposure(0.5, 0.1)
    dark = replace(plain, frame=replace(plain.frame, color=exposure.applied(plain.frame.color)), exposure=exposure)
    maps = [
        completed(replace(Submap.anchored(se3.identity(), index=0), keyframes=(k,)), SEEDING, CONFIDENCE, rasterizer)
        for k in (plain, dark)
    ]
    torch.testing.assert_close(maps[0].gaussians.sh, maps[1].gaussians.sh, atol=1e-5, rtol=0)


def test_far_from_any_reading_nothing_is_guessed(rasterizer: Rasterizer) -> None:
    keyframe = looking(1.0)
    depth = torch.zeros_like(keyframe.frame.depth)
    depth[:, :2] = 1.0
    only_left = replace(keyframe, frame=replace(keyframe.frame, depth=depth))
    submap = replace(Submap.anchored(se3.identity(), index=0), keyframes=(only_left,))
    whole = completed(submap, SEEDING, CONFIDENCE, rasterizer)
    u = CAMERA.project(whole.gaussians.means)[:, 0]
    assert u.min() == pytest.approx(2, abs=0.1) and u.max() == pytest.approx(1 + CAMERA.width // 4, abs=1.1)
