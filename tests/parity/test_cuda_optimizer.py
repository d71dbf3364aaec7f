"""Adam by the GPU's kernel, emulated on the CPU, against Adam by torch."""

import pytest
import torch
from emulated_cuda import COMPILER, EmulatedKernels

from tcgsplat.errors import BackendUnavailableError
from tcgsplat.mapping.cuda_optimizer import CudaRowAdam, adam_text
from tcgsplat.mapping.optimizer import PARAMETERS, LearningRates, RowAdam
from tcgsplat.render.cuda.launching import Compiled, Kernels, compiled, nvrtc_library
from tcgsplat.scene.gaussians import Gaussians

EMULATED = pytest.param(
    "emulated", marks=pytest.mark.skipif(COMPILER is None, reason="no C++ compiler to emulate with")
)
REAL = pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU"))
N = 300  # more than a block's threads


def gaussians(sh_degree: int) -> Gaussians:
    g = torch.Generator().manual_seed(1)
    return Gaussians(
        ids=torch.arange(N),
        means=torch.randn(N, 3, generator=g),
        log_scales=torch.randn(N, 3, generator=g) - 3,
        quats=torch.randn(N, 4, generator=g),
        logit_opacities=torch.randn(N, generator=g),
        sh=torch.randn(N, (sh_degree + 1) ** 2, 3, generator=g),
    )


def loss_of(current: Gaussians, step: int) -> torch.Tensor:
    """Different at every step, and not a number for one row."""
    tables = [getattr(current, name).flatten(1) if name != "logit_opacities" else current.logit_opacities[:, None]
              for name in PARAMETERS]  # fmt: skip
    each = sum((table * (1 + 0.1 * step) - 0.3 * k).pow(2).sum(dim=1) for k, table in enumerate(tables))
    return each.sum() + (torch.sqrt(current.means[7, 0] * 0.0) * 0.0 if step == 2 else 0.0)


@pytest.fixture(scope="module", params=[EMULATED, REAL])
def place(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Kernels, torch.device]:
    if request.param == "emulated":
        return EmulatedKernels(adam_text(), tmp_path_factory.mktemp("emulated")), torch.device("cpu")
    return Compiled(adam_text(), torch.device("cuda", 0)), torch.device("cuda", 0)


@pytest.mark.parametrize("sh_degree", [0, 1])
@pytest.mark.parametrize("literal", [False, True])
def test_steps_are_those_of_torch(place: tuple[Kernels, torch.device], sh_degree: int, literal: bool) -> None:
    rates, (kernels, device) = LearningRates(), place
    start = gaussians(sh_degree)
    adams = [RowAdam(start, rates), CudaRowAdam(start.to(device), rates, kernels)]
    g = torch.Generator().manual_seed(2)
    scale = 0.5 + torch.rand(N, generator=g)
    for step in range(8):
        visible = None if step == 5 else torch.rand(N, generator=g) < 0.7
        for adam, there in zip(adams, (torch.device("cpu"), device), strict=True):
            options = {"gradient_scale": scale.to(there)} if literal else {"step_scale": scale.to(there)}
            frozen, seen = ("sh",) if step < 3 else (), None if visible is None else visible.to(there)
            adam.step(
                loss_of(adam.gaussians, step),
                visible=seen,
                frozen=frozen,
                pace=torch.tensor(1.0 - 0.05 * step).to(there),
                **options,
            )
    keep = torch.rand(N, generator=g) < 0.9
    adams = [adams[0].kept(keep), adams[1].kept(keep.to(device))]
    for step in range(3):
        for adam, there in zip(adams, (torch.device("cpu"), device), strict=True):
            adam.step(loss_of(adam.gaussians, step), step_scale=None if literal else scale[keep].to(there))
    theirs, ours = (adam.detached().cpu() for adam in adams)
    first = start.kept(keep)
    for name in PARAMETERS:
        a, b, before = (getattr(x, name) for x in (theirs, ours, first))
        assert (a - before).abs().max() > 1e-4
        rounding = 11 * 2**-24 * a.abs().max()  # half a last place a step
        assert (a - b).abs().max() < 2e-5 * (a - before).abs().max() + rounding, name


def test_nothing_to_step(place: tuple[Kernels, torch.device]) -> None:
    kernels, device = place
    adam = CudaRowAdam(Gaussians.empty(device=device), LearningRates(), kernels)
    adam.step(sum(getattr(adam.gaussians, name).sum() for name in PARAMETERS))  # type: ignore[arg-type]
    assert len(adam.detached()) == 0


def test_nvrtc_takes_the_text() -> None:
    try:
        nvrtc = nvrtc_library()
    except BackendUnavailableError as error:
        pytest.skip(str(error))
    assert compiled(nvrtc, adam_text(), "sm_75")[:4] == b"\x7fELF"
