"""Steps of mapping and of the paper's solver recorded as a graph: the same bits as one by one, and nothing to wait for.

The device is the pretended one of `elsewhere.py`, whose recordings are as strict as CUDA's; drawn by the GPU's kernels,
which a CPU runs.
"""

import logging
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import pytest
import torch
from analytic_room import CAMERA, Room, pose
from emulated_cuda import COMPILER, EmulatedKernels

if torch.cuda.is_available():
    pytest.skip("torch has room for one device beside the CPU, and a GPU is here", allow_module_level=True)
if COMPILER is None:
    pytest.skip("no C++ compiler to emulate with", allow_module_level=True)

from elsewhere import DEVICE, DistantKernels, Recording, counted_waits
from twice_mapped import assert_same, twice_mapped

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.mapping import optimization
from tcgsplat.mapping.cuda_optimizer import CudaRowAdam, adam_text
from tcgsplat.mapping.optimization import AutogradOptimization
from tcgsplat.mapping.seeding import SeedingConfig
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.cuda import graphs
from tcgsplat.render.cuda.graphs import Recorder
from tcgsplat.render.cuda.rasterizer import CudaRasterizer, kernel_text
from tcgsplat.render.cuda.ssim import similarity, ssim_text
from tcgsplat.render.losses import SSIM_C1, SSIM_C2, ssim_window
from tcgsplat.render.ssim_kernels import RADIUS
from tcgsplat.scene.submap import Submap
from tcgsplat.tracking.descent import DescentConfig, descend

SMALL = CAMERA.scaled(0.25)
SURFACE = MapperConfig(
    seeding=SeedingConfig(recipe="surface", spacing=1, footprint=0.5, opacity=0.9), iterations=4, first_iterations=4
)
POINTS = MapperConfig(
    seeding=SeedingConfig(recipe="points", first_points=800, first_gradient_points=200, points=200),
    iterations=4, first_iterations=4, isotropy_weight=1.0,
)  # fmt: skip
PAPER = ConfidenceConfig(model="paper", guide_mapping=True, stability_weight=10.0, slack_min=0.0, slack_max=1e-4)
MODELS = pytest.mark.parametrize(
    ("config", "confidence"), [(SURFACE, ConfidenceConfig()), (POINTS, PAPER)], ids=["ours", "paper"]
)
VIEWS = [1, 0, 1, 1, 0, 0, 1]


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Recorder | None], CudaRasterizer]:
    folder: Path = tmp_path_factory.mktemp("emulated")
    kernels = {c: DistantKernels(EmulatedKernels(kernel_text(c), folder)) for c in (2, 4)}
    return lambda recorder: CudaRasterizer(DEVICE, kernels, recorder)


@pytest.fixture(autouse=True)
def all_kernels(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Adam and SSIM by the GPU's kernels too."""
    folder = tmp_path_factory.getbasetemp()
    adam = DistantKernels(EmulatedKernels(adam_text(), folder))
    ssim = DistantKernels(EmulatedKernels(ssim_text(RADIUS, SSIM_C1, SSIM_C2), folder))
    window = ssim_window().to(DEVICE)
    monkeypatch.setattr(optimization, "_row_adam", lambda gaussians, rates: CudaRowAdam(gaussians, rates, adam))
    monkeypatch.setattr(optimization, "ssim_map", lambda a, b: similarity(ssim, a, b, window))


def optimized(
    submap: Submap, config: MapperConfig, confidence: ConfidenceConfig, rasterizer: CudaRasterizer
) -> tuple[Submap, float]:
    update = AutogradOptimization(submap, config, confidence, rasterizer)
    update.steps(VIEWS[:5], frozen=("sh",))
    update.prune()
    update.steps(VIEWS, paces=[0.9**k for k in range(len(VIEWS))])
    return update.submap().cpu(), update.loss


@MODELS
def test_an_update_has_the_same_bits(
    opened: Callable[[Recorder | None], CudaRasterizer], config: MapperConfig, confidence: ConfidenceConfig
) -> None:
    plain, recording = opened(None), Recording()
    submap = twice_mapped(config, confidence, plain, SMALL)
    expected, loss = optimized(submap, config, confidence, plain)
    ours, recorded_loss = optimized(submap, config, confidence, opened(recording))
    assert recording.count == 2
    assert_same(ours, expected)
    assert recorded_loss == loss
    moved = (expected.gaussians.means - submap.cpu().gaussians.means[: len(expected)]).abs().max()
    assert moved > 1e-4  # or all would be the same for nothing


@pytest.mark.parametrize("floor", [None, 0.3])
def test_the_papers_solver_finds_the_same_bits(
    opened: Callable[[Recorder | None], CudaRasterizer], floor: float | None
) -> None:
    plain, recording, guess = opened(None), Recording(), pose(0.01, 0.0, 0.005)
    submap = twice_mapped(SURFACE, ConfidenceConfig(), plain, SMALL)
    frame, config = Room().frame(pose(), camera=SMALL), DescentConfig(iterations=9, rotation_rate=1e-3)
    expected, ours = (
        descend(frame, submap, guess, rasterizer, config, floor=floor) for rasterizer in (plain, opened(recording))
    )
    assert recording.count == 1
    assert torch.equal(ours.T_map_cam, expected.T_map_cam)
    assert ours.loss == expected.loss
    assert not torch.equal(expected.T_map_cam, guess)


def test_steps_that_had_too_little_room_are_done_again(
    opened: Callable[[Recorder | None], CudaRasterizer], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With no room to spare, one view has too little after the other has been drawn."""
    monkeypatch.setattr(graphs, "SPARE", 1.0)
    config, confidence, plain, recordings = SURFACE, ConfidenceConfig(), opened(None), []
    submap = twice_mapped(config, confidence, plain, SMALL)
    for views in ([0, 1, 1, 1, 1], [1, 0, 0, 0, 0]):
        updates, recording = [], Recording()
        for rasterizer in (plain, opened(recording)):
            updates.append(AutogradOptimization(submap, config, confidence, rasterizer))
            updates[-1].steps(views)
        assert_same(updates[1].submap().cpu(), updates[0].submap().cpu())
        recordings.append(recording.count)
    assert max(recordings) > 1


def test_the_host_waits_twice_however_many_steps_there_are(
    opened: Callable[[Recorder | None], CudaRasterizer],
) -> None:
    rasterizer, config, confidence = opened(Recording()), SURFACE, ConfidenceConfig()
    submap = twice_mapped(config, confidence, rasterizer, SMALL)
    for times in (4, 12):
        update = AutogradOptimization(submap, config, confidence, rasterizer)
        with counted_waits() as waits:
            update.steps([1] * times)
        assert waits == {"a number was read": 2}, times


class Refusing:
    """A recorder that fails in the middle of a step."""

    def __init__(self, error: Exception) -> None:
        self._error, self.forgot = error, 0

    def aside(self) -> AbstractContextManager[None]:
        return nullcontext()

    def recorded(self, step: Callable[[], None]) -> Callable[[], None]:
        step()
        try:
            raise self._error
        finally:
            if not isinstance(self._error, torch.OutOfMemoryError):
                raise RuntimeError("operation failed due to a previous error during capture")

    def forget(self) -> None:
        self.forgot += 1


def test_what_cannot_be_recorded_is_done_step_by_step(
    opened: Callable[[Recorder | None], CudaRasterizer], caplog: pytest.LogCaptureFixture
) -> None:
    """Said once, with what went wrong first, where it will go wrong again; tried again where memory was too little."""
    config, confidence, plain = SURFACE, ConfidenceConfig(), opened(None)
    submap = twice_mapped(config, confidence, plain, SMALL)
    expected, loss = optimized(submap, config, confidence, plain)
    said = [
        "CUDA graphs are not used, which is slower and changes nothing else: operation not permitted when stream is "
        "capturing"
    ]
    forbidden = RuntimeError("operation not permitted when stream is capturing")
    for error, lines, forgot in ((forbidden, said, 1), (torch.OutOfMemoryError(), [], 2)):
        refusing = Refusing(error)
        with caplog.at_level(logging.WARNING):
            ours, refused_loss = optimized(submap, config, confidence, opened(refusing))
        assert [record.getMessage() for record in caplog.records] == lines
        assert refusing.forgot == forgot
        assert_same(ours, expected)
        assert refused_loss == loss
        caplog.clear()
