"""gsplat against the oracle, forward and backward: with its kernels where a GPU is, with their arithmetic anywhere."""

import math
from collections.abc import Callable

import pytest
import torch
from test_numba_cpu import CAMERA, INPUTS, away_from_cuts, draw, images, random_inputs
from torch import Tensor

from tcgsplat.errors import BackendUnavailableError
from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.availability import extension_obstacles
from tcgsplat.render.backends import open_rasterizer
from tcgsplat.render.conventions import MIN_ALPHA, MIN_TRANSMITTANCE
from tcgsplat.render.gsplat_cuda import TILE, Footprints, GsplatRasterizer, footprints, raster
from tcgsplat.render.numba_cpu.rasterizer import NumbaRasterizer
from tcgsplat.render.protocol import Raster, Splats
from tcgsplat.render.reference import ReferenceRasterizer, project

CROWDS = (150, 150, 700)
"""How many splats there are, by seed: the last of them fill some pixels."""
Draw = Callable[[dict[str, Tensor]], Raster]


@pytest.fixture(scope="session")
def gsplat(cuda_device: torch.device) -> GsplatRasterizer:
    if obstacles := extension_obstacles():
        pytest.skip("; ".join(obstacles))
    return GsplatRasterizer(cuda_device)


# gsplat's arithmetic in a few lines of torch: what the adapter hands over, and what it makes of what comes back.


def composited(given: Footprints, width: int, height: int) -> tuple[Tensor, Tensor]:
    """As gsplat's kernels do it: tile by tile, pixel centres at +0.5, and a pixel ends before what would fill it."""
    rows, columns = torch.arange(height)[:, None], torch.arange(width)
    centre_u, centre_v = (pixels.to(given.centers) + 0.5 for pixels in (columns, rows))
    channels = given.channels.new_zeros(height, width, given.channels.shape[1])
    through, finished = given.channels.new_ones(height, width), torch.zeros(height, width, dtype=torch.bool)
    order = given.depths.argsort(stable=True)
    for i in order[(given.radii[order] > 0).all(dim=1)]:
        first = ((given.centers[i] - given.radii[i]) / TILE).floor()
        last = ((given.centers[i] + given.radii[i]) / TILE).ceil()
        near_u = (columns // TILE >= first[0]) & (columns // TILE < last[0])
        near_v = (rows // TILE >= first[1]) & (rows // TILE < last[1])
        du, dv = given.centers[i, 0] - centre_u, given.centers[i, 1] - centre_v
        uu, uv, vv = given.conics[i]
        alpha = given.opacities[i] * torch.exp(-0.5 * (uu * du * du + vv * dv * dv) - uv * du * dv)
        drawn = near_u & near_v & (alpha >= 1 / 255) & ~finished
        finished |= drawn & (through * (1 - alpha) <= 1e-4)
        alpha = torch.where(drawn & ~finished, alpha, 0.0)
        channels = channels + (through * alpha)[..., None] * given.channels[i]
        through = through * (1 - alpha)
    return channels, 1 - through


def by_hand(inputs: dict[str, Tensor]) -> Raster:
    given = footprints(Splats(*(inputs[k] for k in INPUTS[:5])), CAMERA, inputs["T_cam_map"])
    return raster(*composited(given, CAMERA.width, CAMERA.height), given.visible, CAMERA)


def left_out(inputs: dict[str, Tensor]) -> Tensor:
    """What may be missing of each channel, [h, w, 7]: all behind where at most 1e-4 is let through, and that splat."""
    projected = project(Splats(*(inputs[k] for k in INPUTS[:5])), CAMERA, inputs["T_cam_map"])
    order = projected.depths.argsort(stable=True)
    order = order[projected.depths[order] > 0.2]
    v, u = torch.meshgrid(torch.arange(CAMERA.height), torch.arange(CAMERA.width), indexing="ij")
    offset = torch.stack((u, v), dim=-1)[:, :, None, :] - projected.centers[order]
    conics = torch.linalg.inv(projected.covariances[order])
    alpha = inputs["opacities"][order] * torch.exp(-0.5 * torch.einsum("hwni,nij,hwnj->hwn", offset, conics, offset))
    alpha = torch.where(alpha >= MIN_ALPHA, alpha, 0.0)
    through = torch.cumprod(1 - alpha, dim=2)
    before = torch.cat((torch.ones_like(through[..., :1]), through[..., :-1]), dim=2)
    missing = torch.where(through <= 1.01 * MIN_TRANSMITTANCE, before * alpha, 0.0)
    depths = projected.depths[order].expand_as(alpha)
    planes = depths + torch.einsum("hwni,ni->hwn", offset, projected.slopes[order])
    values = torch.stack((*(4 * [torch.ones_like(depths)]), depths, planes.abs(), torch.ones_like(depths)), dim=-1)
    return torch.einsum("hwn,hwnc->hwc", missing, values)


def agrees_with_the_oracle(drawn: Draw, seed: int, flat: bool, dtype: torch.dtype, images_off: float, off: float):
    """Strictly where nothing is left out and no splat is at its cut; by no more than what is left out elsewhere."""
    inputs = random_inputs(CROWDS[seed], seed, flat=flat)
    missing = left_out(inputs)
    strict = away_from_cuts(inputs)
    whole = strict & (missing == 0).all(dim=-1)
    assert whole.float().mean() > 0.5
    assert CROWDS[seed] == 150 or (strict & ~whole).float().mean() > 0.01
    weight = torch.randn(45, 61, 7, generator=torch.Generator().manual_seed(seed + 10), dtype=torch.float64)
    weight = weight * whole[..., None]

    expected_leaves = {k: v.clone().requires_grad_() for k, v in inputs.items()}
    expected = draw(ReferenceRasterizer(), expected_leaves)
    (images(expected) * weight).sum().backward()
    leaves = {k: (v if k == "T_cam_map" else v.to(dtype)).clone().requires_grad_() for k, v in inputs.items()}
    got = drawn(leaves)
    found = images(got)
    (found.cpu() * weight.to(dtype)).sum().backward()

    assert torch.equal(got.visible.cpu(), expected.visible)
    difference = (found.detach().cpu().double() - images(expected).detach()).abs()
    assert difference[whole].max() < images_off
    assert (difference[strict] <= missing[strict] + images_off).all()
    for name in INPUTS:
        a, b = leaves[name].grad.double(), expected_leaves[name].grad
        assert (a - b).norm() < off * b.norm(), (name, float((a - b).norm() / b.norm()))


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize(("dtype", "images_off", "off"), [(torch.float64, 1e-10, 1e-9), (torch.float32, 2e-4, 3e-4)])
def test_the_arithmetic_agrees_with_the_oracle(
    seed: int, flat: bool, dtype: torch.dtype, images_off: float, off: float
):
    agrees_with_the_oracle(by_hand, seed, flat, dtype, images_off, off)


def test_a_box_holds_all_that_is_drawn():
    """Every pixel where alpha reaches 1/255 is within the radii, and what is not visible has none."""
    inputs = random_inputs(300, 11)
    given = footprints(Splats(*(inputs[k] for k in INPUTS[:5])), CAMERA, inputs["T_cam_map"])
    assert given.radii.dtype == torch.int32
    assert torch.equal((given.radii > 0).all(dim=1), given.visible) and 0 < given.visible.sum() < 300
    assert torch.equal((given.radii > 0).any(dim=1), given.visible)
    v, u = torch.meshgrid(torch.arange(-80, 160), torch.arange(-80, 160), indexing="ij")
    off = torch.stack((u, v), dim=-1)[:, :, None, :] + 0.5 - given.centers
    uu, uv, vv = given.conics.unbind(-1)
    power = 0.5 * (uu * off[..., 0] ** 2 + vv * off[..., 1] ** 2) + uv * off[..., 0] * off[..., 1]
    reached = (given.opacities * torch.exp(-power) >= MIN_ALPHA) & given.visible
    assert reached.any(dim=(0, 1)).sum() > 50
    assert not (reached[..., None] & (off.abs() > given.radii)).any()


def test_without_a_gpu_it_says_what_to_do():
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    with pytest.raises(BackendUnavailableError, match=r"gsplat cannot draw here: .*`"):
        GsplatRasterizer()


# With its kernels.


def on(device: torch.device, inputs: dict[str, Tensor]) -> dict[str, Tensor]:
    return {k: v if k == "T_cam_map" else v.to(device) for k, v in inputs.items()}


def in_single(inputs: dict[str, Tensor]) -> dict[str, Tensor]:
    return {k: v if k == "T_cam_map" else v.float() for k, v in inputs.items()}


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("flat", [False, True])
def test_its_kernels_agree_with_the_oracle(gsplat: GsplatRasterizer, seed: int, flat: bool):
    """Its gradients divide by what is let through as one minus alpha in float32: 6e-8 of 1e-4 where nearly all is."""
    agrees_with_the_oracle(lambda i: draw(gsplat, on(gsplat.device, i)), seed, flat, torch.float32, 2e-4, 1e-3)


@pytest.mark.parametrize("pose_there", [False, True])
def test_the_pose_may_be_on_either_side(gsplat: GsplatRasterizer, pose_there: bool):
    inputs = on(gsplat.device, in_single(random_inputs(60, 5)))
    pose = inputs["T_cam_map"].to(gsplat.device if pose_there else "cpu").requires_grad_()
    images(draw(gsplat, {**inputs, "T_cam_map": pose})).sum().backward()
    assert pose.grad.device == pose.device and pose.grad[:3].abs().min() > 0


@pytest.mark.parametrize("channels", [0, 1, 3, 6, 11])
def test_any_number_of_features(gsplat: GsplatRasterizer, channels: int):
    inputs = in_single(random_inputs(50, 4, channels=channels))
    wide = draw(gsplat, on(gsplat.device, inputs)).features.cpu()
    assert wide.shape == (45, 61, channels)
    strict = away_from_cuts(random_inputs(50, 4, channels=channels))
    expected = draw(ReferenceRasterizer(), inputs).features
    assert not channels or (wide - expected)[strict].abs().max() < 1e-2  # one percent may be left out


def test_nothing_to_draw(gsplat: GsplatRasterizer):
    for n, opacity in ((0, 1.0), (20, 1e-3)):
        inputs = in_single(random_inputs(n, 0))
        inputs["opacities"] = inputs["opacities"] * opacity
        leaves = {k: v.requires_grad_() for k, v in on(gsplat.device, inputs).items()}
        drawn = draw(gsplat, leaves)
        images(drawn).sum().backward()
        assert drawn.alpha.abs().max() == 0 and drawn.visible.shape == (n,) and not drawn.visible.any()
        assert leaves["means"].grad.isfinite().all()


def test_a_lone_splat_is_equation_3(gsplat: GsplatRasterizer):
    focal, z, sigma_px = 100.0, 2.0, 3.0
    sigma = math.sqrt(sigma_px**2 - 0.3) * z / focal
    inputs = {
        "means": torch.tensor([[0.0, 0.0, z]]),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "scales": torch.full((1, 3), sigma),
        "opacities": torch.tensor([0.8]),
        "features": torch.tensor([[0.25]]),
        "T_cam_map": se3.identity(),
    }
    drawn = draw(gsplat, on(gsplat.device, inputs), Camera(focal, focal, 20.0, 20.0, 41, 41))
    assert float(drawn.alpha[20, 20]) == pytest.approx(0.8, abs=1e-6)
    assert float(drawn.alpha[20, 23]) == pytest.approx(0.8 * math.exp(-0.5), abs=1e-5)
    assert float(drawn.features[20, 23, 0]) == pytest.approx(0.25 * 0.8 * math.exp(-0.5), abs=1e-5)
    assert float(drawn.depth[20, 20]) == pytest.approx(0.8 * z, abs=1e-5)


def test_a_whole_picture_agrees_with_the_cpu(gsplat: GsplatRasterizer):
    """Many tiles, and tiles with more splats than a block has threads."""
    camera = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
    inputs = in_single(random_inputs(20_000, 6))
    inputs["scales"] = 0.3 * inputs["scales"]
    found = images(draw(gsplat, on(gsplat.device, inputs), camera)).cpu()
    expected = images(draw(NumbaRasterizer(), inputs, camera))
    unfinished = expected[..., 6] < 0.99
    difference = (found - expected).abs()
    assert unfinished.float().mean() > 0.05
    assert (difference[unfinished] > 2e-4).float().mean() < 1e-3  # at a splat's cut
    assert (difference[~unfinished][:, :4] < 2e-2).all()


def test_it_is_opened_by_its_name(gsplat: GsplatRasterizer):
    assert open_rasterizer("gsplat").name == "gsplat"
