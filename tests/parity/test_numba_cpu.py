"""The CPU backend against the oracle, forward and backward, and its promise of equal bits."""

import math
import os
import platform
import subprocess
import sys

import pytest
import torch

from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.conventions import MAX_OPACITY
from tcgsplat.render.numba_cpu.rasterizer import NumbaRasterizer
from tcgsplat.render.protocol import Splats
from tcgsplat.render.reference import ReferenceRasterizer, project, visible_footprints

CAMERA = Camera(fx=52.0, fy=54.0, cx=30.1, cy=23.4, width=61, height=45)  # hangs over the edge of the tiles
INPUTS = ("means", "quats", "scales", "opacities", "features", "T_cam_map")


def random_inputs(n: int, seed: int, channels: int = 4, flat: bool = False) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(*shape, generator=g, dtype=torch.float64)

    z = uniform(-0.5, 4.0, n)  # some behind the camera, some beyond the image
    means = torch.stack((z * uniform(-0.8, 0.8, n), z * uniform(-0.6, 0.6, n), z), dim=-1)
    scales = uniform(0.01, 0.12, n, 3)
    if flat:
        scales[:, 2] = 1e-3
    return {
        "means": means,
        "quats": torch.randn(n, 4, generator=g, dtype=torch.float64) * uniform(0.5, 2.0, n, 1),
        "scales": scales,
        "opacities": uniform(0.002, MAX_OPACITY, n),  # some fainter than anything visible
        "features": uniform(0.0, 1.0, n, channels),
        "T_cam_map": se3.exp(torch.tensor([0.1, -0.05, 0.15, 0.1, -0.2, 0.3], dtype=torch.float64)),
    }


def draw(rasterizer, inputs, camera=CAMERA):
    return rasterizer(Splats(*(inputs[k] for k in INPUTS[:5])), camera, inputs["T_cam_map"])


def images(raster) -> torch.Tensor:
    return torch.cat((raster.features, torch.stack((raster.depth, raster.plane_depth, raster.alpha), dim=-1)), dim=-1)


def away_from_cuts(inputs, camera=CAMERA) -> torch.Tensor:
    """Pixels at which no splat is within a rounding error of its 1/255 cut, where float32 may fall on either side."""
    projected = project(Splats(*(inputs[k] for k in INPUTS[:5])), camera, inputs["T_cam_map"])
    pixels = torch.stack(torch.meshgrid(torch.arange(camera.width), torch.arange(camera.height), indexing="xy"), -1)
    offset = pixels[:, :, None, :] - projected.centers
    power = -0.5 * torch.einsum("hwni,nij,hwnj->hwn", offset, torch.linalg.inv(projected.covariances), offset)
    alpha = inputs["opacities"] * power.exp()
    return ((alpha * 255 - 1).abs() > 1e-4).all(dim=-1)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("flat", [False, True])
def test_forward_and_backward_agree_with_the_oracle(seed: int, flat: bool):
    inputs = random_inputs(150, seed, flat=flat)
    strict = away_from_cuts(inputs)
    assert strict.float().mean() > 0.9
    weight = torch.randn(45, 61, 7, generator=torch.Generator().manual_seed(seed + 10), dtype=torch.float64)
    weight = torch.where(strict[..., None], weight, torch.zeros_like(weight))

    expected_leaves = {k: v.clone().requires_grad_() for k, v in inputs.items()}
    expected = draw(ReferenceRasterizer(), expected_leaves)
    (images(expected) * weight).sum().backward()
    leaves = {k: (v if k == "T_cam_map" else v.float()).clone().requires_grad_() for k, v in inputs.items()}
    got = draw(NumbaRasterizer(threads=2), leaves)
    (images(got) * weight.float()).sum().backward()

    assert torch.equal(got.visible, expected.visible)
    difference = (images(got).double() - images(expected))[strict].abs()
    # Stopping early leaves out 1e-4 of at most 4 m; rounding is ten times less.
    assert difference.max() < 2e-4
    assert difference.mean() < 3e-6
    for name in INPUTS:
        a, b = leaves[name].grad.double(), expected_leaves[name].grad
        assert (a - b).norm() < 3e-4 * b.norm(), (name, float((a - b).norm() / b.norm()))


def test_every_drawn_channel_has_a_gradient_to_every_input():
    inputs = random_inputs(60, 5)
    for channel in range(7):
        leaves = {k: (v if k == "T_cam_map" else v.float()).clone().requires_grad_() for k, v in inputs.items()}
        images(draw(NumbaRasterizer(), leaves))[..., channel].sum().backward()
        for name in INPUTS:
            expects = not (name == "features" and channel >= 4)
            assert (float(leaves[name].grad.abs().sum()) > 0) == expects, (channel, name)


@pytest.mark.parametrize("threads", [1, 3, 7])
def test_bits_do_not_depend_on_threads(threads: int):
    inputs = {k: (v if k == "T_cam_map" else v.float()) for k, v in random_inputs(9000, 3).items()}
    camera = Camera(fx=90.0, fy=90.0, cx=60, cy=45, width=121, height=90)

    def run(count: int) -> list[torch.Tensor]:
        leaves = {k: v.clone().requires_grad_() for k, v in inputs.items()}
        out = images(draw(NumbaRasterizer(count), leaves, camera))
        out.square().sum().backward()
        return [out.detach(), *(leaves[k].grad for k in INPUTS)]

    for a, b in zip(run(2), run(threads), strict=True):
        assert torch.equal(a, b)


def test_more_than_four_features_take_more_passes():
    inputs = {k: (v if k == "T_cam_map" else v.float()) for k, v in random_inputs(50, 4, channels=6).items()}
    wide = draw(NumbaRasterizer(), inputs).features
    first = draw(NumbaRasterizer(), {**inputs, "features": inputs["features"][:, :4]}).features
    assert wide.shape == (45, 61, 6)
    assert torch.equal(wide[..., :4], first)
    assert (wide - draw(ReferenceRasterizer(), inputs).features).abs().max() < 2e-4


def test_nothing_to_draw():
    inputs = {k: (v if k == "T_cam_map" else v.float()) for k, v in random_inputs(0, 0).items()}
    raster = draw(NumbaRasterizer(), inputs)
    assert raster.alpha.abs().max() == 0
    assert raster.visible.shape == (0,)


def test_a_lone_splat_is_equation_3():
    """By hand: alpha at the centre's pixel is the opacity, one standard deviation away it is o exp(-1/2)."""
    focal, z, sigma_px = 100.0, 2.0, 3.0
    camera = Camera(focal, focal, 20.0, 20.0, 41, 41)
    sigma = math.sqrt(sigma_px**2 - 0.3) * z / focal
    splats = Splats(
        means=torch.tensor([[0.0, 0.0, z]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        scales=torch.full((1, 3), sigma),
        opacities=torch.tensor([0.8]),
        features=torch.tensor([[0.25]]),
    )
    for rasterizer in (ReferenceRasterizer(), NumbaRasterizer()):
        raster = rasterizer(splats, camera, se3.identity())
        assert float(raster.alpha[20, 20]) == pytest.approx(0.8, abs=1e-6)
        assert float(raster.alpha[20, 23]) == pytest.approx(0.8 * math.exp(-0.5), abs=1e-5)
        assert float(raster.features[20, 23, 0]) == pytest.approx(0.25 * 0.8 * math.exp(-0.5), abs=1e-5)
        assert float(raster.depth[20, 20]) == pytest.approx(0.8 * z, abs=1e-5)


def test_visible_is_a_footprint_with_a_pixel():
    inputs = random_inputs(400, 8)
    splats = Splats(*(inputs[k] for k in INPUTS[:5]))
    flags = visible_footprints(project(splats, CAMERA, inputs["T_cam_map"]), splats.opacities, CAMERA)
    drawn = draw(NumbaRasterizer(), {k: (v if k == "T_cam_map" else v.float()) for k, v in inputs.items()}).visible
    assert torch.equal(flags, drawn)
    assert 0 < int(flags.sum()) < 400


def test_images_that_were_changed_in_place_are_not_differentiated():
    inputs = {k: (v if k == "T_cam_map" else v.float()).requires_grad_() for k, v in random_inputs(50, 9).items()}
    raster = draw(NumbaRasterizer(), inputs)
    raster.alpha.mul_(2.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        raster.depth.sum().backward()


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="names instruction sets of x86")
@pytest.mark.parametrize("features", ["", "+avx,+avx2,+fma,+bmi,+bmi2,+lzcnt,+popcnt"], ids=["sse2", "avx2"])
def test_processors_without_wide_vectors_agree_with_the_oracle(features: str, tmp_path):
    """In a process of its own, because numba compiles for one processor."""
    environment = {
        **os.environ, "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": features, "NUMBA_CACHE_DIR": str(tmp_path),
    }  # fmt: skip
    tests = [f"{__file__}::{test.__name__}" for test in (test_a_lone_splat_is_equation_3, test_nothing_to_draw)]
    tests += [f"{__file__}::test_forward_and_backward_agree_with_the_oracle[True-1]"]
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("n", [1, 16, 17])
def test_gradients_belong_to_the_caller(n: int):
    """A later backward pass leaves them alone, however few splats there are."""
    rasterizer = NumbaRasterizer(1)
    inputs = {name: tensor.float() if name != "T_cam_map" else tensor for name, tensor in random_inputs(n, 5).items()}
    means = inputs["means"].detach().requires_grad_()

    def gradient(weight: float) -> torch.Tensor:
        return torch.autograd.grad(weight * images(draw(rasterizer, {**inputs, "means": means})).sum(), means)[0]

    first = gradient(1.0)
    kept = first.clone()
    gradient(7.0)
    assert torch.equal(first, kept) and first.abs().max() > 0


def test_needles_that_float32_cannot_tell_from_lines_do_no_harm():
    """Metres long and a tenth of a millimetre thick, before the camera: their determinant is lost in rounding."""
    camera = Camera(150.0, 150.0, 79.5, 59.5, 160, 120)
    for seed in range(60):
        g = torch.Generator().manual_seed(seed)
        inputs = {
            "means": torch.randn(40, 3, generator=g) * torch.tensor([0.4, 0.3, 0.2]) + torch.tensor([0.0, 0.0, 0.7]),
            "quats": torch.randn(40, 4, generator=g),
            "scales": torch.exp(torch.randn(40, 3, generator=g) * 2.5 - 1).clamp(1e-4, 100.0),
            "opacities": torch.full((40,), MAX_OPACITY),
            "features": torch.rand(40, 4, generator=g),
            "T_cam_map": se3.identity(),
        }
        leaves = {k: v.requires_grad_() for k, v in inputs.items()}
        drawn = images(draw(NumbaRasterizer(), leaves, camera))
        drawn.square().sum().backward()
        assert drawn.detach().isfinite().all() and drawn[..., -1].max() < 1.0001, seed
        assert all(leaf.grad.isfinite().all() for leaf in leaves.values()), seed
