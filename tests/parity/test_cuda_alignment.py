"""Direct alignment by the GPU's kernels, emulated on the CPU, against alignment by the CPU's."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_room import CAMERA, Room, pose, rendering_of
from emulated_cuda import COMPILER, EmulatedKernels

from tcgsplat.errors import BackendUnavailableError
from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.cuda.launching import Compiled, Kernels, compiled, nvrtc_library
from tcgsplat.render.view import Rendering
from tcgsplat.scene.frame import Frame
from tcgsplat.tracking import cuda_alignment, pyramids
from tcgsplat.tracking.alignment import Alignment, align
from tcgsplat.tracking.reference import reference_view
from tcgsplat.tracking.settings import AlignmentConfig

EMULATED = pytest.param(
    "emulated", marks=pytest.mark.skipif(COMPILER is None, reason="no C++ compiler to emulate with")
)
REAL = pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU"))
ODD = Camera(fx=70.0, fy=71.5, cx=58.3, cy=40.7, width=117, height=83)
WIDE = Camera(fx=130.0, fy=133.0, cx=103.2, cy=59.4, width=207, height=119)  # sampled, not every pixel
T_LIVE = pose(0.03, -0.02, 0.04, degrees=(1.0, -1.5, 2.0))
GUESS = T_LIVE @ pose(0.004, -0.003, 0.002, degrees=(0.3, -0.2, 0.1))
"""Not where the view is from."""


@pytest.fixture(scope="module", params=[EMULATED, REAL])
def kernels(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Kernels, torch.device]:
    text = cuda_alignment.alignment_text()
    if request.param == "emulated":
        return EmulatedKernels(text, tmp_path_factory.mktemp("emulated")), torch.device("cpu")
    return Compiled(text, torch.device("cuda", 0)), torch.device("cuda", 0)


def spoilt(frame: Frame, seed: int) -> Frame:
    """With noise, other brightness, holes, something that stands before all, and a border that saw nothing."""
    g = torch.Generator().manual_seed(seed)
    h, w = frame.depth.shape
    color = (1.15 * frame.color - 0.05 + 0.02 * torch.randn(frame.color.shape, generator=g)).clamp(0, 1)
    depth = frame.depth * (1 + 0.004 * torch.randn(h, w, generator=g))
    depth[h // 3 : h // 2, w // 4 : w // 2] *= 0.6
    depth[torch.rand(h, w, generator=g) < 0.1] = 0.0
    valid = torch.ones(h, w, dtype=torch.bool)
    valid[:, :5], depth[:, :5] = False, 0.0
    return replace(frame, color=color, depth=depth, valid=valid)


def covered(rendering: Rendering, seed: int) -> Rendering:
    """With places that hardly anything covers, and others that are not opaque."""
    h, w = rendering.alpha.shape
    g = torch.Generator().manual_seed(seed)
    thin = torch.where(torch.rand(h, w, generator=g) < 0.3, 0.9, 0.99)
    thin[: h // 5] = 0.5
    share = thin / rendering.alpha
    return replace(
        rendering,
        color=rendering.color * share[..., None],
        composited_depth=rendering.composited_depth * share,
        composited_plane_depth=rendering.composited_plane_depth * share,
        alpha=thin,
    )


def both(
    kernels: tuple[Kernels, torch.device], live: Frame, rendering: Rendering, config: AlignmentConfig
) -> tuple[Alignment, Alignment]:
    g = torch.Generator().manual_seed(5)
    weight = 0.3 + 0.7 * torch.rand(live.depth.shape, generator=g)
    on_cpu = align(live, reference_view(pyramids, rendering, weight, live.camera, T_LIVE, config), GUESS, config)
    compiled_kernels, device = kernels
    there = rendering.to(device), weight.to(device), live.camera
    images = cuda_alignment.Images(compiled_kernels)
    view = reference_view(images, *there, T_LIVE, config)
    return on_cpu, cuda_alignment.align(images, live.to(device), view, GUESS, config)


@pytest.mark.parametrize(
    ("camera", "config"),
    [
        (WIDE, AlignmentConfig()),
        (CAMERA, AlignmentConfig()),
        (ODD, AlignmentConfig(iterations=(0, 4, 2), stride=2)),
        (ODD, AlignmentConfig(iterations=(3,))),
    ],
)
def test_a_frame_is_aligned_as_on_the_cpu(
    kernels: tuple[Kernels, torch.device], camera: Camera, config: AlignmentConfig
) -> None:
    reference, live = Room().frame(camera=camera), spoilt(Room().frame(T_LIVE, camera=camera), 1)
    expected, found = both(kernels, live, covered(rendering_of(reference), 2), config)
    moved = se3.translation_norm(expected.T_map_cam @ se3.inverse(T_LIVE))
    assert moved > 0.005, "else there is nothing to compare"
    apart = found.T_map_cam @ se3.inverse(expected.T_map_cam)
    assert se3.translation_norm(apart) < 1e-3 * moved
    assert se3.rotation_angle(apart) < 1e-4
    assert found.iterations == expected.iterations
    for name in ("coverage", "overlap", "agreement", "correlation"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), abs=2e-3), name
    assert found.exposure.gain == pytest.approx(expected.exposure.gain, abs=1e-3)
    assert found.exposure.offset == pytest.approx(expected.exposure.offset, abs=1e-3)
    for one, other in ((found.color, expected.color), (found.depth, expected.depth)):
        assert np.linalg.norm(one.H - other.H) < 5e-3 * np.linalg.norm(other.H)
        assert np.linalg.norm(one.g - other.g) < 5e-3 * np.sqrt(np.trace(other.H))


def test_nothing_in_common_leaves_the_guess(kernels: tuple[Kernels, torch.device]) -> None:
    reference, live = Room().frame(), Room().frame()
    live = replace(live, valid=torch.zeros_like(live.valid), depth=torch.zeros_like(live.depth))
    expected, found = both(kernels, live, rendering_of(reference), AlignmentConfig())
    assert found.overlap == expected.overlap == 0
    torch.testing.assert_close(found.T_map_cam, GUESS)


def test_numbers_that_are_none_are_not_hidden(kernels: tuple[Kernels, torch.device]) -> None:
    """The tracker tells a solver that diverged by its pose."""
    live, rendering = Room().frame(T_LIVE), rendering_of(Room().frame())
    color = live.color.clone()
    color[30:40, 30:40] = torch.nan
    expected, found = both(kernels, replace(live, color=color), rendering, AlignmentConfig())
    assert torch.isfinite(found.T_map_cam).all() == torch.isfinite(expected.T_map_cam).all()


def test_nvrtc_takes_the_text() -> None:
    try:
        nvrtc = nvrtc_library()
    except BackendUnavailableError as error:
        pytest.skip(str(error))
    assert compiled(nvrtc, cuda_alignment.alignment_text(), "sm_75")[:4] == b"\x7fELF"
