"""The GPU backend against the oracle, its kernels emulated on the CPU; and on a GPU where there is one."""

import ctypes
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from emulated_cuda import COMPILER, EmulatedKernels
from test_numba_cpu import CAMERA, INPUTS, away_from_cuts, draw, images, random_inputs

from tcgsplat.errors import BackendUnavailableError
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.conventions import MIN_TRANSMITTANCE
from tcgsplat.render.cuda import CudaRasterizer
from tcgsplat.render.cuda.launching import Compiled, Signatures, compiled, nvrtc_library
from tcgsplat.render.cuda.rasterizer import kernel_text
from tcgsplat.render.cuda.ssim import similarity, ssim_text
from tcgsplat.render.losses import _SSIM_RADIUS, SSIM_C1, SSIM_C2, ssim_map, ssim_window
from tcgsplat.render.reference import ReferenceRasterizer

EMULATED = pytest.param(
    "emulated", marks=pytest.mark.skipif(COMPILER is None, reason="no C++ compiler to emulate with")
)
REAL = pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU"))


def exact_text(features: int) -> str:
    """Kernels that never stop early, so that all that is left is rounding."""
    stops, never = f"MIN_TRANSMITTANCE {MIN_TRANSMITTANCE!r}f", "MIN_TRANSMITTANCE 0.0f"
    assert stops in kernel_text(features)
    return kernel_text(features).replace(stops, never)


@pytest.fixture(scope="module", params=[EMULATED, REAL])
def place(request: pytest.FixtureRequest) -> Iterator[str]:
    yield request.param


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("emulated")


def opened(place: str, folder: Path, features: int = 4, exact: bool = False) -> CudaRasterizer:
    text = (exact_text if exact else kernel_text)(features)
    if place == "emulated":
        return CudaRasterizer(torch.device("cpu"), {features: EmulatedKernels(text, folder)})
    device = torch.device("cuda", 0)
    return CudaRasterizer(device, {features: Compiled(text, device)})


def leaves_of(inputs: dict[str, torch.Tensor], device: torch.device) -> dict[str, torch.Tensor]:
    return {
        k: (v if k == "T_cam_map" else v.float().to(device)).detach().clone().requires_grad_()
        for k, v in inputs.items()
    }


@pytest.mark.parametrize("seed", [0, 2])
@pytest.mark.parametrize("flat", [False, True])
def test_forward_and_backward_agree_with_the_oracle(place: str, folder: Path, seed: int, flat: bool):
    inputs = random_inputs(150, seed, flat=flat)
    strict = away_from_cuts(inputs)
    assert strict.float().mean() > 0.9
    weight = torch.randn(45, 61, 7, generator=torch.Generator().manual_seed(seed + 10), dtype=torch.float64)
    weight = torch.where(strict[..., None], weight, torch.zeros_like(weight))
    expected_leaves = {k: v.clone().requires_grad_() for k, v in inputs.items()}
    expected = draw(ReferenceRasterizer(), expected_leaves)
    (images(expected) * weight).sum().backward()

    rasterizer = opened(place, folder, exact=True)
    leaves = leaves_of(inputs, rasterizer.device)
    got = draw(rasterizer, leaves)
    (images(got).cpu() * weight.float()).sum().backward()
    assert torch.equal(got.visible.cpu(), expected.visible)
    assert (images(got).cpu().double() - images(expected))[strict].abs().max() < 2e-5
    for name in INPUTS:
        a, b = leaves[name].grad.cpu().double(), expected_leaves[name].grad
        assert (a - b).norm() < 3e-5 * b.norm(), (name, float((a - b).norm() / b.norm()))


def test_stopping_early_leaves_out_next_to_nothing(place: str, folder: Path):
    """1e-4 of at most 4 m at each pixel."""
    inputs = random_inputs(150, 2)
    rasterizer = opened(place, folder)
    got = images(draw(rasterizer, leaves_of(inputs, rasterizer.device))).cpu().double()
    strict = away_from_cuts(inputs)
    difference = (got - images(draw(ReferenceRasterizer(), inputs)))[strict].abs()
    assert 1e-5 < difference.max() < 5e-4


@pytest.mark.parametrize("features", [1, 9])
def test_any_number_of_features_in_one_pass(place: str, folder: Path, features: int):
    inputs = random_inputs(40, 4, channels=features)
    rasterizer = opened(place, folder, features, exact=True)
    leaves, expected = leaves_of(inputs, rasterizer.device), leaves_of(inputs, torch.device("cpu"))
    images(draw(rasterizer, leaves)).square().sum().backward()
    images(draw(ReferenceRasterizer(), expected)).square().sum().backward()
    for name in INPUTS:
        a, b = leaves[name].grad.cpu(), expected[name].grad
        assert (a - b).norm() < 2e-3 * b.norm(), name


def test_the_same_bits_again(place: str, folder: Path):
    rasterizer = opened(place, folder)

    def run() -> list[torch.Tensor]:
        leaves = leaves_of(random_inputs(300, 3), rasterizer.device)
        out = images(draw(rasterizer, leaves))
        out.square().sum().backward()
        return [out.detach(), *(leaves[k].grad for k in INPUTS)]

    for a, b in zip(run(), run(), strict=True):
        assert torch.equal(a, b)


def test_many_splats_over_one_tile_take_several_batches(place: str, folder: Path):
    """More than a block's threads, and no multiple of a batch."""
    inputs = random_inputs(700, 6)
    inputs["means"][:, 2] = inputs["means"][:, 2].abs() + 0.5
    inputs["opacities"] *= 0.05
    small = Camera(fx=20.0, fy=20.0, cx=7.5, cy=5.5, width=15, height=11)
    rasterizer = opened(place, folder, exact=True)
    leaves, expected = leaves_of(inputs, rasterizer.device), {k: v.clone().requires_grad_() for k, v in inputs.items()}
    strict = away_from_cuts(inputs, small)[..., None]
    (images(draw(rasterizer, leaves, small)) * strict.to(rasterizer.device)).square().sum().backward()
    (images(draw(ReferenceRasterizer(), expected, small)) * strict).square().sum().backward()
    for name in INPUTS:
        a, b = leaves[name].grad.cpu().double(), expected[name].grad
        assert (a - b).norm() < 1e-4 * b.norm(), name


def test_counting_and_listing_may_round_differently(folder: Path):
    """What was counted and is not listed is nowhere; what is listed beyond the count is left out."""
    if COMPILER is None:
        pytest.skip("no C++ compiler to emulate with")
    text = exact_text(4)
    for wrong in ("count += 2 * reaches(record, x, y)", "count += reaches(record, x, y) && (x + y) % 2"):
        assert "count += reaches(record, x, y)" in text
        changed = EmulatedKernels(text.replace("count += reaches(record, x, y)", wrong), folder)
        leaves = leaves_of(random_inputs(150, 0), torch.device("cpu"))
        drawn = images(draw(CudaRasterizer(torch.device("cpu"), {4: changed}), leaves))
        drawn.sum().backward()
        if "2 *" in wrong:
            assert torch.equal(drawn, images(draw(opened("emulated", folder, exact=True), leaves)))
        assert all(torch.isfinite(leaf.grad).all() for leaf in leaves.values())


def test_nobody_waits_for_a_gradient_that_is_not_asked_for(place: str, folder: Path):
    rasterizer = opened(place, folder)
    leaves = leaves_of(random_inputs(30, 0), rasterizer.device)
    drawn = images(draw(rasterizer, {**leaves, "T_cam_map": leaves["T_cam_map"].detach()}))
    assert drawn.grad_fn is not None
    (bridge,) = {node for node in nodes_of(drawn.grad_fn) if type(node).__name__ == "_DrawBackward"}
    given: list[Any] = []
    bridge.register_hook(lambda inputs, _outputs: given.extend(inputs))
    drawn.sum().backward()
    assert [value is None for value in given] == [*[False] * 5, True]


def nodes_of(node: Any) -> Iterator[Any]:
    yield node
    for following, _ in node.next_functions:
        if following is not None:
            yield from nodes_of(following)


def test_nothing_to_draw(place: str, folder: Path):
    rasterizer = opened(place, folder)
    leaves = leaves_of(random_inputs(0, 0), rasterizer.device)
    raster = draw(rasterizer, leaves)
    images(raster).sum().backward()
    assert raster.alpha.abs().max() == 0
    assert raster.visible.shape == (0,)
    assert not leaves["T_cam_map"].grad.any()


def test_nothing_in_view(place: str, folder: Path):
    inputs = random_inputs(20, 0)
    inputs["means"][:, 2] -= 10.0
    rasterizer = opened(place, folder)
    leaves = leaves_of(inputs, rasterizer.device)
    raster = draw(rasterizer, leaves)
    images(raster).sum().backward()
    assert not raster.visible.any()
    assert not any(leaves[name].grad.any() for name in INPUTS)


def test_similarity_and_its_derivative_are_those_of_the_cpu(place: str, folder: Path):
    """On an image that is no multiple of a block, and one smaller than the window."""
    text = ssim_text(_SSIM_RADIUS, SSIM_C1, SSIM_C2)
    device = torch.device("cpu") if place == "emulated" else torch.device("cuda", 0)
    kernels = EmulatedKernels(text, folder) if place == "emulated" else Compiled(text, device)
    generator = torch.Generator().manual_seed(0)
    for shape in ((37, 50, 3), (5, 7, 3)):
        a, b = (torch.rand(shape, generator=generator) for _ in range(2))
        b, upstream = 0.7 * a + 0.3 * b, torch.randn(shape, generator=generator)
        expected, found = a.clone().requires_grad_(), a.to(device).requires_grad_()
        similar = ssim_map(expected, b)
        (similar * upstream).sum().backward()
        got = similarity(kernels, found, b.to(device), ssim_window().to(device))
        (got * upstream.to(device)).sum().backward()
        assert (got.detach().cpu() - similar.detach()).abs().max() < 1e-5
        assert (found.grad.cpu() - expected.grad).abs().max() < 1e-4 * expected.grad.abs().max()


def test_arguments_are_those_that_the_text_declares():
    signatures = Signatures(kernel_text(4))
    assert set(signatures.arguments) == {"project", "list", "project_backward", "blend", "blend_backward"}
    camera = {"fx": 1.0, "fy": 2.0, "cx": 3.0, "cy": 4.0, "width": 5, "height": 6}
    empty, integers = torch.empty(0), torch.empty(0, dtype=torch.int32)
    values = dict.fromkeys(("means", "quats", "scales", "opacities", "pose", "records", "depths"), empty)
    values |= {"rectangles": integers, "counts": integers, "visible": torch.empty(0, dtype=torch.bool)}
    filled = signatures.filled("project", values | {"n": 7, "camera": camera})
    assert (filled.n, filled.camera.cy, filled.camera.height) == (7, 4.0, 6)
    assert ctypes.sizeof(filled) == 10 * 8 + 4 + 24 + 4  # as C++ lays it out, padded to pointers
    with pytest.raises(TypeError, match=r"means is torch\.int32"):
        signatures.filled("project", values | {"n": 7, "camera": camera, "means": integers})
    with pytest.raises(TypeError, match="camera"):
        signatures.filled("project", values | {"n": 7})


@pytest.mark.parametrize("architecture", ["sm_75", "sm_90"])
def test_nvrtc_takes_the_text(architecture: str):
    try:
        nvrtc = nvrtc_library()
    except BackendUnavailableError as error:
        pytest.skip(str(error))
    for text in (kernel_text(4), ssim_text(5, SSIM_C1, SSIM_C2)):
        assert compiled(nvrtc, text, architecture)[:4] == b"\x7fELF"
    with pytest.raises(BackendUnavailableError, match=r"for sm_\d\d: tcgsplat\.cu\(1\): error: this declaration"):
        compiled(nvrtc, "KERNEL", architecture)


def test_cameras_hang_over_the_edge_of_the_tiles():
    """Else these tests would not see what happens there."""
    assert CAMERA.width % 16
    assert CAMERA.height % 16
