"""The paper's solver: its loss by hand, and its way downhill."""

from dataclasses import replace

import pytest
import torch
from analytic_room import CAMERA, Room, errors, pose, rendering_of

from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import Rendering, render
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Submap
from tcgsplat.tracking.descent import AmsGrad, DescentConfig, descend, weighted_residual

PLAIN = DescentConfig(
    iterations=50,
    rotation_rate=2e-3,
    translation_rate=3e-3,
    color_weight=0.6,
    depth_mode="composited",
    soft_alpha=False,
    min_alpha=0.0,
    outlier_factor=0.0,
    mask_color=True,
)


def strip(alpha: list[float]) -> tuple[Rendering, Frame]:
    """Four pixels in a row: rendered 2 m and (0.2, 0.4, 0.6) times alpha; seen 2.1 m and (0.3, 0.4, 0.4)."""
    a = torch.tensor([alpha], dtype=torch.float32)
    color = torch.tensor([0.2, 0.4, 0.6]) * a[..., None]
    none = torch.zeros(0, dtype=torch.bool)
    seen = torch.tensor([0.3, 0.4, 0.4]).expand(1, 4, 3)
    frame = Frame(0, 0.0, seen, torch.full((1, 4), 2.1), torch.ones(1, 4, dtype=torch.bool), Camera(9, 9, 1.5, 0, 4, 1))
    return Rendering(color, 2.0 * a, 2.0 * a, a, a, none), frame


COLOR, DEPTH = 0.1 + 0.0 + 0.2, 0.1  # of one fully covered pixel: summed over channels; metres
ONE = 0.6 * COLOR + 0.4 * DEPTH


def loss(config: DescentConfig = PLAIN, alpha: tuple[float, ...] = (1, 1, 1, 1), weight: float = 1.0, **frame) -> float:
    rendering, seen = strip(list(alpha))
    return float(weighted_residual(rendering, torch.full((1, 4), weight), replace(seen, **frame), config))


def test_loss_by_hand() -> None:
    assert loss() == pytest.approx(4 * ONE)
    assert loss(weight=0.25) == pytest.approx(ONE)
    assert loss(replace(PLAIN, color_weight=1.0)) == pytest.approx(4 * COLOR)
    assert loss(replace(PLAIN, color_weight=0.0)) == pytest.approx(4 * DEPTH)


def test_pixels_without_a_reading_count_for_nothing_or_for_colour() -> None:
    depth = torch.tensor([[2.1, 2.1, 0.0, 0.0]])
    assert loss(depth=depth) == pytest.approx(2 * ONE)
    assert loss(replace(PLAIN, mask_color=False), depth=depth) == pytest.approx(2 * ONE + 2 * 0.6 * COLOR)


def test_pixels_that_saw_nothing_count_for_nothing() -> None:
    valid = torch.tensor([[True, False, False, False]])
    assert loss(valid=valid) == pytest.approx(ONE)
    assert loss(replace(PLAIN, mask_color=False), valid=valid) == pytest.approx(ONE)


def test_thin_coverage_is_left_out_or_weighs_by_its_cube() -> None:
    alpha = (1.0, 1.0, 0.5, 0.5)
    half = 0.6 * (abs(0.1 - 0.3) + abs(0.2 - 0.4) + abs(0.3 - 0.4)) + 0.4 * abs(1.0 - 2.1)
    assert loss(alpha=alpha) == pytest.approx(2 * ONE + 2 * half)
    assert loss(replace(PLAIN, min_alpha=0.6), alpha=alpha) == pytest.approx(2 * ONE)
    assert loss(replace(PLAIN, soft_alpha=True), alpha=alpha) == pytest.approx(2 * ONE + 2 * half / 8)
    expected = 2 * ONE + 2 * (0.6 * (0.2 + 0.2 + 0.1) + 0.4 * DEPTH)
    assert loss(replace(PLAIN, depth_mode="planar"), alpha=alpha) == pytest.approx(expected)


def test_depth_outliers_are_left_out() -> None:
    depth = torch.tensor([[2.1, 2.1, 2.1, 5.0]])
    assert loss(depth=depth) > 4 * ONE
    assert loss(replace(PLAIN, outlier_factor=10.0), depth=depth) == pytest.approx(3 * ONE)


def test_converges_to_the_pose(room: Room, corner: Submap, rasterizer: Rasterizer) -> None:
    T_true = pose(0.012, -0.008, 0.01, degrees=(0.6, 0.6, -0.5))  # 18 mm and a degree away
    config = DescentConfig(
        iterations=60,
        rotation_rate=1e-3,
        translation_rate=1e-3,
        color_weight=0.3,
        depth_mode="planar",
        soft_alpha=True,
        min_alpha=0.9,
    )
    found = descend(room.frame(T_true), corner, se3.identity(), rasterizer, config, floor=0.2)
    millimetres, degrees = errors(found.T_map_cam, T_true)
    assert millimetres < 3
    assert degrees < 0.1
    assert found.iterations == 60


@pytest.mark.parametrize("floor", [None, 0.2])
def test_gives_the_best_pose_that_it_met_and_its_loss(
    floor: float | None, room: Room, corner: Submap, rasterizer: Rasterizer
) -> None:
    frame = room.frame(pose(0.01))
    hasty = replace(PLAIN, iterations=12, translation_rate=0.05, rotation_rate=0.05)
    found = descend(frame, corner, se3.identity(), rasterizer, hasty, floor=floor)
    view = render(corner.gaussians, corner.confidence.value, CAMERA, se3.inverse(found.T_map_cam), rasterizer)
    weight = torch.ones_like(view.alpha) if floor is None else floor + (1 - floor) * view.confidence
    assert float(weighted_residual(view, weight, frame, hasty)) == pytest.approx(found.loss, rel=1e-4)
    start = descend(frame, corner, se3.identity(), rasterizer, replace(hasty, iterations=1), floor=floor)
    assert found.loss <= start.loss
    torch.testing.assert_close(start.T_map_cam, se3.identity())


def test_without_weights_confidence_does_not_matter(room: Room, corner: Submap, rasterizer: Rasterizer) -> None:
    frame, config = room.frame(pose(0.01)), replace(PLAIN, iterations=4)
    doubtful = replace(corner, confidence=replace(corner.confidence, value=torch.rand(len(corner))))
    a, b = (descend(frame, submap, se3.identity(), rasterizer, config, floor=None) for submap in (corner, doubtful))
    assert torch.equal(a.T_map_cam, b.T_map_cam)


def test_the_guess_may_be_anywhere_in_the_map(room: Room, corner: Submap, rasterizer: Rasterizer) -> None:
    """The increment turns the camera about itself: the same start gives the same way, wherever the map's origin is."""
    T_moved = pose(3.0, -1.0, 2.0, degrees=(30, -50, 80))
    elsewhere = replace(corner, gaussians=corner.gaussians.transformed(T_moved))
    frame, config = room.frame(pose(0.01)), replace(PLAIN, iterations=5)
    here = descend(frame, corner, se3.identity(), rasterizer, config, floor=None)
    there = descend(frame, elsewhere, T_moved, rasterizer, config, floor=None)
    assert errors(there.T_map_cam, T_moved @ here.T_map_cam)[0] < 0.2


def test_the_loss_of_a_perfect_view_is_zero(room: Room) -> None:
    frame = room.frame()
    assert float(weighted_residual(rendering_of(frame, alpha=1.0), torch.ones_like(frame.depth), frame, PLAIN)) == 0


def test_the_poses_adam_is_torchs() -> None:
    g = torch.Generator().manual_seed(0)
    ours = [torch.randn(n, generator=g, dtype=torch.float64) for n in (4, 3)]
    theirs = [p.clone().requires_grad_() for p in ours]
    rates = 0.002, 0.01
    adam = AmsGrad(list(zip(ours, rates, strict=True)))
    expected = torch.optim.Adam(
        [{"params": [p], "lr": rate} for p, rate in zip(theirs, rates, strict=True)], amsgrad=True
    )
    for k in range(30):
        gradients = [torch.randn(p.shape, generator=g, dtype=torch.float64) / (1 + k) for p in ours]
        adam.step(gradients)
        for p, gradient in zip(theirs, gradients, strict=True):
            p.grad = gradient
        expected.step()
    for p, q in zip(ours, theirs, strict=True):
        torch.testing.assert_close(p, q.detach(), rtol=1e-12, atol=1e-14)
