"""From Gaussians and a camera to images that mean something."""

import weakref
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

import pytest
import torch
from analytic_room import CAMERA, Room, pose

from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.conventions import MAX_OPACITY
from tcgsplat.render.numba_cpu.rasterizer import NumbaRasterizer
from tcgsplat.render.protocol import Raster, Rasterizer, Splats
from tcgsplat.render.reference import ReferenceRasterizer
from tcgsplat.render.view import MIN_COVERAGE, Rendering, SubmapView, render, render_view
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.submap import Submap


def test_the_mapped_room_looks_like_the_room(room: Room, corner: Submap, rasterizer: Rasterizer) -> None:
    frame, view = room.frame(), render_view(corner, CAMERA, se3.identity(), rasterizer)
    assert view.alpha.min() > 0.8
    assert (view.color - frame.color).abs().mean() < 0.03
    assert (view.depth - frame.depth).abs().median() < 0.003
    assert view.visible.float().mean() > 0.99


def test_confidence_has_the_weights_of_the_picture(corner: Submap, rasterizer: Rasterizer) -> None:
    """Eq. 17: all certain gives alpha, a constant gives its share, and mixtures are linear."""
    n = len(corner)
    certain, third = torch.ones(n), torch.full((n,), 1 / 3)
    mixed = torch.rand(n, generator=torch.Generator().manual_seed(0))
    T = se3.inverse(pose(0.05, degrees=(0, 5, 0)))
    views = [render(corner.gaussians, p, CAMERA, T, rasterizer) for p in (certain, third, mixed, 1 - mixed)]
    torch.testing.assert_close(views[0].confidence, views[0].alpha, atol=1e-6, rtol=0)
    torch.testing.assert_close(views[1].confidence, views[1].alpha / 3, atol=1e-6, rtol=0)
    torch.testing.assert_close(views[2].confidence + views[3].confidence, views[0].alpha, atol=1e-5, rtol=0)
    assert all(torch.equal(view.color, views[0].color) for view in views)


def test_confidence_carries_no_gradient_and_the_rest_does(corner: Submap, rasterizer: Rasterizer) -> None:
    T = se3.identity().requires_grad_()
    value = torch.full((len(corner),), 0.5, requires_grad=True)
    view = render(corner.gaussians, value, CAMERA, T, rasterizer)
    assert not view.confidence.requires_grad
    view.color.sum().backward()
    assert T.grad is not None and T.grad[:3].abs().sum() > 0
    assert value.grad is None


def test_a_view_for_looking_at_carries_no_gradient(corner: Submap, rasterizer: Rasterizer) -> None:
    gaussians = replace(corner.gaussians, means=corner.gaussians.means.clone().requires_grad_())
    view = render_view(replace(corner, gaussians=gaussians), CAMERA, se3.identity(), rasterizer)
    assert not view.color.requires_grad


def test_the_camera_is_where_the_pose_says(room: Room, corner: Submap, rasterizer: Rasterizer) -> None:
    T_map_cam = pose(0.04, -0.03, 0.05, degrees=(2, -3, 4))
    frame, view = room.frame(T_map_cam), render_view(corner, CAMERA, T_map_cam, rasterizer)
    seen = view.alpha > 0.9
    assert seen.float().mean() > 0.8
    assert (view.depth - frame.depth).abs()[seen].median() < 0.004
    assert (view.color / view.alpha[..., None] - frame.color).abs()[seen].mean() < 0.03


def rendering(alpha: torch.Tensor, depth: float) -> Rendering:
    return Rendering(
        color=torch.zeros(*alpha.shape, 3),
        composited_depth=alpha * depth * 1.1,
        composited_plane_depth=alpha * depth,
        alpha=alpha,
        confidence=alpha,
        visible=torch.zeros(0, dtype=torch.bool),
    )


def test_depth_is_given_only_where_enough_is_covered() -> None:
    view = rendering(torch.tensor([[0.0, 0.9 * MIN_COVERAGE, 1.1 * MIN_COVERAGE, 0.99]]), depth=2.0)
    torch.testing.assert_close(view.depth, torch.tensor([[0.0, 0.0, 2.0, 2.0]]))


def test_depth_modes() -> None:
    view = rendering(torch.tensor([[0.0, 0.25, 0.99]]), depth=2.0)
    torch.testing.assert_close(view.depth_as("composited"), torch.tensor([[0.0, 0.55, 2.178]]))
    torch.testing.assert_close(view.depth_as("expected"), torch.tensor([[0.0, 2.2, 2.2]]))
    torch.testing.assert_close(view.depth_as("planar"), torch.tensor([[0.0, 2.0, 2.0]]))


class Recorder:
    """A backend that only notes what it is given."""

    name = "recorder"
    device = torch.device("cpu")

    def __init__(self) -> None:
        self.splats: list[Splats] = []

    def __call__(self, splats: Splats, camera: Camera, T_cam_map: torch.Tensor) -> Raster:
        self.splats.append(splats)
        return ReferenceRasterizer()(splats, camera, T_cam_map)

    def reserved(self) -> AbstractContextManager[None]:
        return nullcontext()


def one(sh_degree: int = 0) -> Gaussians:
    sh = torch.zeros(1, (sh_degree + 1) ** 2, 3)
    if sh_degree:
        sh[0, 3, 0] = -0.5  # red from the one side, dark from the other
    return replace(
        Gaussians.empty(),
        ids=torch.tensor([7]),
        means=torch.tensor([[0.0, 0.0, 2.0]]),
        log_scales=torch.full((1, 3), -3.0),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        logit_opacities=torch.tensor([20.0]),
        sh=sh,
    )


def test_no_splat_is_opaque() -> None:
    recorder = Recorder()
    view = render(one(), torch.ones(1), CAMERA, se3.identity(), recorder)
    assert recorder.splats[0].opacities.item() == pytest.approx(MAX_OPACITY)
    assert view.alpha.max() <= MAX_OPACITY
    assert recorder.splats[0].features.shape == (1, 4)


def test_colour_is_seen_from_the_cameras_own_place() -> None:
    """Harmonics are looked up along the way from the camera to the Gaussian, in the map frame."""
    colors = []
    for x in (-1.0, 1.0):
        recorder = Recorder()
        T_map_cam = pose(x, 0.3, 0.2, degrees=(5, -20 * x, 3))
        render(one(sh_degree=1), torch.ones(1), CAMERA, se3.inverse(T_map_cam), recorder)
        colors.append(recorder.splats[0].features[0, 0].item())
        torch.testing.assert_close(recorder.splats[0].features[:, :3], one(1).colors(T_map_cam[:3, 3].float()))
    assert colors[0] > 0.5 > colors[1]


@pytest.mark.parametrize("sh_degree", [0, 1])
def test_a_submap_drawn_again_looks_as_if_drawn_anew(sh_degree: int, corner: Submap, rasterizer: Rasterizer) -> None:
    """From elsewhere, where colours that depend on the view are others; and another submap is not mistaken for it."""
    sh = torch.zeros(len(corner), (sh_degree + 1) ** 2, 3)
    sh[:, 0] = corner.gaussians.sh[:, 0]
    sh[:, 1:] = 0.1
    corner = replace(corner, gaussians=replace(corner.gaussians, sh=sh))
    moved = replace(corner, gaussians=replace(corner.gaussians, means=corner.gaussians.means + 0.05))
    views = {"corner": SubmapView(corner, rasterizer), "moved": SubmapView(moved, rasterizer)}
    for name, T in (("corner", pose(0)), ("moved", pose(0)), ("corner", pose(0.1)), ("moved", pose(0.1))):
        again, anew = views[name](CAMERA, T), render_view(corner if name == "corner" else moved, CAMERA, T, rasterizer)
        assert torch.equal(again.color, anew.color) and torch.equal(again.confidence, anew.confidence)
        assert torch.equal(again.composited_plane_depth, anew.composited_plane_depth)
        assert torch.equal(again.visible, anew.visible)
    assert not torch.equal(views["corner"](CAMERA, pose(0)).color, views["moved"](CAMERA, pose(0)).color)


def test_what_is_no_longer_drawn_is_forgotten(corner: Submap) -> None:
    rasterizer, means = NumbaRasterizer(1), corner.gaussians.means.clone()
    view = SubmapView(replace(corner, gaussians=replace(corner.gaussians, means=means)), rasterizer)
    view(CAMERA, se3.identity())
    gone = weakref.ref(means)
    del view, means
    assert gone() is None


def test_splats_that_were_written_to_are_drawn_as_they_are_now(corner: Submap) -> None:
    rasterizer, confidence = NumbaRasterizer(1), corner.confidence.value.clone()
    view = SubmapView(replace(corner, confidence=replace(corner.confidence, value=confidence)), rasterizer)
    before = view(CAMERA, se3.identity())
    assert view._splats is not None
    with torch.no_grad():
        view._splats.features.mul_(0.5)
    torch.testing.assert_close(view(CAMERA, se3.identity()).color, 0.5 * before.color)
