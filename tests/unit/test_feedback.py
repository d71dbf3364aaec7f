"""What a mapping update teaches of each Gaussian: who was seen, how it moved, and how well it explains the picture."""

from dataclasses import replace

import pytest
import torch
from analytic_room import CAMERA, Room, pose
from torch import Tensor

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.mapping.feedback import judged, observation
from tcgsplat.mapping.mapper import Mapped
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.tensors import Pose

CONFIG = ConfidenceConfig(model="paper", color_residual_weight=1.0, depth_residual_weight=2.0, p_min=0.1, initial=0.3)
OURS = ConfidenceConfig()
T_HERE = pose(0.02, 0.01, -0.03, degrees=(1, 4, -2))


def update(submap: Submap, frame: Frame, *, T_map_cam: Pose = T_HERE) -> Mapped:
    """A mapping update of a submap that has since had one, and that left the Gaussians as they are."""
    mapped = replace(submap, keyframes=(*submap.keyframes, Keyframe(frame, T_map_cam)))
    return Mapped(
        before=submap.gaussians,
        submap=mapped,
        distance=torch.zeros(len(submap)),
        loss=0.0,
    )


def pixels_of(submap: Submap, T_map_cam: Pose = T_HERE) -> Tensor:
    return CAMERA.project(se3.transform(se3.inverse(T_map_cam), submap.gaussians.means))


def inside(pixels: Tensor, low_u: float, high_u: float, low_v: float, high_v: float) -> Tensor:
    u, v = pixels.unbind(dim=-1)
    return (u > low_u) & (u < high_u) & (v > low_v) & (v < high_v)


def test_seen_are_the_old_ones_whose_centre_is_in_the_picture(corner: Submap, rasterizer: Rasterizer) -> None:
    frame = Room().frame(T_HERE)
    valid = observation(update(corner, frame), frame, CONFIG, "planar", rasterizer).valid
    expected = inside(pixels_of(corner), -0.5, CAMERA.width - 0.5, -0.5, CAMERA.height - 0.5)
    assert 0.7 < expected.float().mean() < 0.99  # the camera has turned: some have left the picture
    assert torch.equal(valid, expected)


def test_without_residuals_the_same_are_seen(corner: Submap, rasterizer: Rasterizer) -> None:
    """Nothing is drawn for the default model, which asks for no residual."""
    frame = Room().frame(T_HERE)
    mapped = update(corner, frame)
    ours, papers = (observation(mapped, frame, config, "planar", rasterizer) for config in (OURS, CONFIG))
    assert torch.equal(ours.valid, papers.valid) and not ours.residual.any() and papers.residual.any()


def test_the_newly_born_have_no_before(corner: Submap, rasterizer: Rasterizer) -> None:
    frame = Room().frame(T_HERE)
    born = torch.where(torch.arange(len(corner)) % 2 == 0, 0, corner.clock)
    young = replace(corner, confidence=replace(corner.confidence, born=born))
    valid = observation(update(young, frame), frame, CONFIG, "planar", rasterizer).valid
    assert not valid[1::2].any()
    assert valid[::2].any()


def test_those_behind_the_camera_are_not_seen(corner: Submap, rasterizer: Rasterizer) -> None:
    T_behind = T_HERE @ pose(degrees=(0, 180, 0))
    frame = Room().frame(T_behind)
    mapped = update(corner, frame, T_map_cam=T_behind)
    assert not any(observation(mapped, frame, config, "planar", rasterizer).valid.any() for config in (CONFIG, OURS))


def test_those_that_cannot_be_drawn_are_not_seen(corner: Submap, rasterizer: Rasterizer) -> None:
    faint = corner.gaussians.logit_opacities.clone()
    faint[:100] = -12.0
    ghostly = replace(corner, gaussians=replace(corner.gaussians, logit_opacities=faint))
    frame = Room().frame(T_HERE)
    assert not observation(update(ghostly, frame), frame, CONFIG, "planar", rasterizer).valid[:100].any()


def test_those_where_the_camera_saw_nothing_are_not_judged(corner: Submap, rasterizer: Rasterizer) -> None:
    frame = Room().frame(T_HERE)
    world = frame.valid.clone()
    world[:, :20] = False
    bordered = replace(frame, valid=world, color=torch.where(world[..., None], frame.color, 0.0))
    everywhere = observation(update(corner, frame), frame, CONFIG, "planar", rasterizer).valid
    valid = observation(update(corner, bordered), bordered, CONFIG, "planar", rasterizer).valid
    assert torch.equal(valid, everywhere & (pixels_of(corner)[:, 0].round() >= 20))


@pytest.mark.parametrize("what", ["colour", "depth"])
def test_a_bad_patch_is_felt_where_it_is_and_nowhere_else(what: str, corner: Submap, rasterizer: Rasterizer) -> None:
    """The residual is read where the centre projects: not mirrored, not transposed, not a pixel off."""
    frame = Room().frame(T_HERE)
    patch = torch.zeros_like(frame.valid)
    patch[8:24, 50:62] = True
    color = torch.where(patch[..., None], (frame.color + 0.4) % 1.0, frame.color)
    bad = replace(frame, color=color) if what == "colour" else replace(frame, depth=frame.depth + 0.2 * patch)

    fine, worse = (observation(update(corner, f), f, CONFIG, "planar", rasterizer) for f in (frame, bad))
    pixels, added = pixels_of(corner), worse.residual - fine.residual
    hit = fine.valid & inside(pixels, 49.5, 61.5, 7.5, 23.5)
    assert hit.sum() > 100
    assert (added[hit] > 0.05).float().mean() > 0.95
    assert added[fine.valid & ~inside(pixels, 49.49, 61.51, 7.49, 23.51)].abs().max() == 0
    if what == "depth":
        torch.testing.assert_close(added[hit].median(), torch.tensor(2 * 0.2), atol=0.02, rtol=0)


def test_no_reading_adds_no_depth_residual(corner: Submap, rasterizer: Rasterizer) -> None:
    frame = Room().frame(T_HERE)
    blind = replace(frame, depth=torch.zeros_like(frame.depth))
    seen, unmeasured = (observation(update(corner, f), f, CONFIG, "planar", rasterizer) for f in (frame, blind))
    assert (unmeasured.residual <= seen.residual).all()
    assert torch.equal(unmeasured.valid, seen.valid)


def test_judging_ticks_the_clock_and_touches_confidence_alone(corner: Submap, rasterizer: Rasterizer) -> None:
    frame = Room().frame(T_HERE)
    mapped = update(corner, frame)
    after = judged(mapped, frame, CONFIG, "planar", rasterizer)
    assert after.clock == corner.clock + 1
    assert after.gaussians is mapped.submap.gaussians
    assert after.keyframes is mapped.submap.keyframes
    seen = observation(mapped, frame, CONFIG, "planar", rasterizer).valid
    assert torch.equal(after.confidence.updates, corner.confidence.updates + seen)
    assert (after.confidence.value[~seen] <= corner.confidence.value[~seen]).all()  # only fades
    assert torch.equal(after.confidence.born, corner.confidence.born)


def test_those_who_explain_the_picture_gain_most(corner: Submap, rasterizer: Rasterizer) -> None:
    frame = Room().frame(T_HERE)
    patch = torch.zeros_like(frame.valid)
    patch[8:24, 50:62] = True
    bad = replace(frame, color=torch.where(patch[..., None], 1 - frame.color.round(), frame.color))
    newborn = replace(corner, confidence=replace(corner.confidence, value=torch.full((len(corner),), CONFIG.initial)))
    mapped = update(newborn, bad)
    value = judged(mapped, bad, CONFIG, "planar", rasterizer).confidence.value
    hit = inside(pixels_of(corner), 50, 61, 8, 23)
    rest = observation(mapped, bad, CONFIG, "planar", rasterizer).valid & ~inside(pixels_of(corner), 48, 63, 6, 25)
    assert value[hit].mean() < value[rest].mean() - 0.05
