"""Drawing turned round: both rasterizers, and the weights written out."""

from dataclasses import replace

import pytest
import torch
from analytic_room import CAMERA as ROOM_CAMERA
from analytic_room import Room, pose
from test_numba_cpu import CAMERA, away_from_cuts, random_inputs
from torch import Tensor

from tcgsplat.confidence.state import ConfidenceConfig, ConfidenceState
from tcgsplat.geometry import se3
from tcgsplat.render.conventions import MAX_OPACITY, MIN_ALPHA
from tcgsplat.render.numba_cpu.rasterizer import NumbaRasterizer
from tcgsplat.render.protocol import Rasterizer, Splats
from tcgsplat.render.reference import ReferenceRasterizer, project
from tcgsplat.render.view import blend, render_view
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.submap import Submap


def submap_of(inputs: dict[str, Tensor]) -> Submap:
    n = len(inputs["means"])
    gaussians = Gaussians(
        ids=torch.arange(n),
        means=inputs["means"].float(),
        log_scales=inputs["scales"].log().float(),
        quats=inputs["quats"].float(),
        logit_opacities=torch.logit(inputs["opacities"]).float(),
        sh=torch.zeros(n, 1, 3),
    )
    state = ConfidenceState.born_at(0, n, ConfidenceConfig())
    return replace(Submap.anchored(se3.identity(), index=0), gaussians=gaussians, confidence=state)


def weights(submap: Submap, T_map_cam: Tensor) -> Tensor:
    """T alpha of every Gaussian in every pixel, [h, w, n]: the formula, in float64, pixel by pixel."""
    g = submap.gaussians
    opacities = g.opacities.clamp_max(MAX_OPACITY).double()
    none = torch.zeros(len(g), 0, dtype=torch.float64)
    splats = Splats(g.means.double(), g.quats.double(), g.scales.double(), opacities, none)
    T_cam_map = se3.inverse(T_map_cam)
    projected = project(splats, CAMERA, T_cam_map)
    depth = se3.transform(T_cam_map, splats.means)[:, 2]
    front_to_back = [int(i) for i in depth.argsort() if depth[i] > 0.2]
    out = torch.zeros(CAMERA.height, CAMERA.width, len(g), dtype=torch.float64)
    v, u = torch.meshgrid(torch.arange(CAMERA.height), torch.arange(CAMERA.width), indexing="ij")
    pixels = torch.stack((u, v), dim=-1).double()
    through = torch.ones(CAMERA.height, CAMERA.width, dtype=torch.float64)
    for i in front_to_back:
        offset = pixels - projected.centers[i]
        power = torch.einsum("hwi,ij,hwj->hw", offset, torch.linalg.inv(projected.covariances[i]), offset)
        alpha = opacities[i] * torch.exp(-0.5 * power)
        alpha = torch.where(alpha >= MIN_ALPHA, alpha, 0.0)
        out[..., i] = through * alpha
        through = through * (1 - alpha)
    return out


def cameras() -> list[Tensor]:
    return [se3.identity(), pose(0.1, -0.05, 0.15, degrees=(4, -8, 12))]


@pytest.mark.parametrize("T_map_cam", cameras(), ids=["at rest", "moved"])
@pytest.mark.parametrize("rasterizer", [ReferenceRasterizer(), NumbaRasterizer(threads=2)], ids=lambda r: r.name)
def test_it_is_the_sum_of_weights_written_out(rasterizer: Rasterizer, T_map_cam: Tensor) -> None:
    inputs = random_inputs(40, 7)
    submap = submap_of(inputs)
    T_cam_map = se3.inverse(T_map_cam)
    images = torch.rand(CAMERA.height, CAMERA.width, 3, generator=torch.Generator().manual_seed(1))
    images = images * away_from_cuts(inputs | {"T_cam_map": T_cam_map})[..., None]
    expected = torch.einsum("hwn,hwc->nc", weights(submap, T_map_cam), images.double())
    found = blend(submap, CAMERA, T_map_cam, rasterizer).shared_out(images)
    assert found.shape == (40, 3) and (expected > 1).any(dim=1).sum() > 10 and (expected == 0).any()
    torch.testing.assert_close(found.double(), expected, atol=2e-3, rtol=3e-4)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_both_rasterizers_agree(seed: int) -> None:
    inputs = random_inputs(150, seed)
    submap, T_map_cam = submap_of(inputs), se3.inverse(inputs["T_cam_map"])
    images = torch.randn(CAMERA.height, CAMERA.width, 2, generator=torch.Generator().manual_seed(seed))
    images = images * away_from_cuts(inputs)[..., None]
    rasterizers = NumbaRasterizer(), ReferenceRasterizer()
    a, b = (blend(submap, CAMERA, T_map_cam, each).shared_out(images) for each in rasterizers)
    assert (a - b).norm() < 3e-4 * b.norm()


def test_a_picture_of_ones_hands_out_all_coverage(corner: Submap, rasterizer: Rasterizer) -> None:
    """What all Gaussians get together is what the picture holds: its opacity, and its confidence by their own."""
    T_map_cam = pose(0.03, 0.01, -0.02, degrees=(1, 4, -2))
    view = render_view(corner, ROOM_CAMERA, T_map_cam, rasterizer)
    shares = blend(corner, ROOM_CAMERA, T_map_cam, rasterizer).shared_out(torch.ones(60, 80, 1))[:, 0]
    assert (shares >= 0).all() and not shares.requires_grad
    torch.testing.assert_close(shares.sum(), view.alpha.sum(), rtol=1e-4, atol=0)
    torch.testing.assert_close((shares * corner.confidence.value).sum(), view.confidence.sum(), rtol=1e-4, atol=0)
    assert not shares[~view.visible].any()


def test_it_looks_as_it_does_otherwise_and_can_be_asked_again(corner: Submap, rasterizer: Rasterizer) -> None:
    T_map_cam = pose(0.03, 0.01, -0.02, degrees=(1, 4, -2))
    asked, images = blend(corner, ROOM_CAMERA, T_map_cam, rasterizer), torch.ones(60, 80, 1)
    plain = render_view(corner, ROOM_CAMERA, T_map_cam, rasterizer)
    for name in ("color", "composited_depth", "composited_plane_depth", "alpha", "confidence", "visible"):
        assert torch.equal(getattr(asked.rendering, name), getattr(plain, name))
        assert not getattr(asked.rendering, name).requires_grad
    once, both = asked.shared_out(images), asked.shared_out(torch.cat((images, 2 * images), dim=-1))
    assert torch.equal(both[:, :1], once) and torch.equal(both[:, 1:], 2 * once)


def test_those_who_are_hidden_get_nearly_nothing(rasterizer: Rasterizer) -> None:
    """Three opaque discs behind each other: the last one is let through a ten-thousandth at its middle."""
    inputs = random_inputs(3, 0) | {
        "means": torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.5], [0.0, 0.0, 2.0]]),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 3),
        "scales": torch.tensor([[0.3, 0.3, 0.001], [0.3, 0.3, 0.001], [0.05, 0.05, 0.001]]),
        "opacities": torch.full((3,), 0.99),
    }
    shares = blend(submap_of(inputs), CAMERA, se3.identity(), rasterizer).shared_out(torch.ones(45, 61, 1))[:, 0]
    assert shares[0] > 4 * shares[1] > 0
    assert shares[2] < 1e-2


def test_nothing_is_handed_to_an_empty_map(rasterizer: Rasterizer) -> None:
    empty = Submap.anchored(se3.identity(), index=0)
    assert blend(empty, CAMERA, se3.identity(), rasterizer).shared_out(torch.ones(45, 61, 2)).shape == (0, 2)


def test_room_and_camera_are_left_alone(room: Room, corner: Submap, rasterizer: Rasterizer) -> None:
    """No tensor of the map begins to ask for gradients, within `no_grad` and without."""
    images = room.frame().depth[..., None]
    outside = blend(corner, ROOM_CAMERA, se3.identity(), rasterizer).shared_out(images)
    with torch.no_grad():
        inside = blend(corner, ROOM_CAMERA, se3.identity(), rasterizer).shared_out(images)
    assert torch.equal(inside, outside)
    assert not any(t.requires_grad for t in (corner.gaussians.means, corner.gaussians.sh, images))
