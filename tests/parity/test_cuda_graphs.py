"""Steps recorded as CUDA graphs on a GPU: the bits of steps done one by one. Without one: test_recorded_steps.py.

The pool of memory, the streams and what may be recorded at all are torch's and the driver's, so only a GPU can tell.
"""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from analytic_room import Room, pose
from twice_mapped import assert_same, twice_mapped

from tcgsplat.config import SlamConfig
from tcgsplat.mapping.optimization import AutogradOptimization
from tcgsplat.render.cuda import CudaRasterizer, Graphs
from tcgsplat.scene.submap import Submap
from tcgsplat.tracking.descent import Descent, DescentConfig, descend

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU")
CONFIG = SlamConfig()
VIEWS = [1, 0, 1, 1, 0, 0, 1, 0]


def device() -> torch.device:
    return torch.device("cuda", torch.cuda.current_device())


def mapped() -> Submap:
    return twice_mapped(CONFIG.mapper, CONFIG.confidence, CudaRasterizer(device()))


def optimized(submap: Submap, rasterizer: CudaRasterizer) -> tuple[Submap, float]:
    update = AutogradOptimization(submap, CONFIG.mapper, CONFIG.confidence, rasterizer)
    for _ in range(3):  # a graph takes the memory of the one before
        update.steps(VIEWS)
        update.prune()
    return update.submap().cpu(), update.loss


def found(submap: Submap, rasterizer: CudaRasterizer) -> Descent:
    config = DescentConfig(iterations=20, rotation_rate=1e-3)
    return descend(Room().frame(pose()), submap, pose(0.01, 0.0, 0.005), rasterizer, config, floor=0.3)


def test_recorded_steps_have_the_same_bits(caplog: pytest.LogCaptureFixture) -> None:
    submap, plain, recording = mapped(), CudaRasterizer(device()), CudaRasterizer(device(), recorder=Graphs(device()))
    (expected, loss), (ours, recorded_loss) = (optimized(submap, one) for one in (plain, recording))
    assert_same(ours, expected)
    assert recorded_loss == loss
    a, b = (found(submap, one) for one in (plain, recording))
    assert torch.equal(a.T_map_cam, b.T_map_cam)
    assert a.loss == b.loss
    assert not caplog.records  # that they could not be recorded


def test_two_threads_record_side_by_side(caplog: pytest.LogCaptureFixture) -> None:
    """As tracking and mapping do."""
    submap, rasterizer = mapped(), CudaRasterizer(device(), recorder=Graphs(device()))
    (expected, _), pose_alone = optimized(submap, rasterizer), found(submap, rasterizer)
    with ThreadPoolExecutor(1) as other:
        for _ in range(5):
            update = other.submit(optimized, submap, rasterizer)
            assert torch.equal(found(submap, rasterizer).T_map_cam, pose_alone.T_map_cam)
            assert_same(update.result()[0], expected)
    assert not caplog.records
