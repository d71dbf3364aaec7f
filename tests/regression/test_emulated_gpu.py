"""The whole system, drawn by the GPU's kernels, which a CPU runs thread by thread."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from analytic_room import CAMERA, Room, walk
from emulated_cuda import COMPILER, EmulatedKernels

from tcgsplat.config import SlamConfig
from tcgsplat.render.cuda.rasterizer import CudaRasterizer, kernel_text
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.submap import Submap
from tcgsplat.scene.trajectory import TrackedPose
from tcgsplat.slam import Slam

SMALL = CAMERA.scaled(0.5)
DEFAULT = SlamConfig()
QUICK = replace(
    DEFAULT,
    mapper=replace(DEFAULT.mapper, first_iterations=3, iterations=2),
    schedule=replace(DEFAULT.schedule, map_lag=0),
)


def mapped(rasterizer: Rasterizer) -> tuple[tuple[TrackedPose, ...], Submap]:
    slam = Slam(QUICK, rasterizer)
    for index, T_world_cam in enumerate(walk(7)):
        slam.step(Room().frame(T_world_cam, index=index, camera=SMALL))
    last = slam.finish()
    assert last is not None
    return slam.trajectory.rows, last


@pytest.mark.skipif(COMPILER is None, reason="no C++ compiler to emulate with")
def test_a_run_goes_as_on_the_cpu(tmp_path: Path, rasterizer: Rasterizer) -> None:
    """Tracked, seeded, optimised, judged, completed: two sets of kernels, which round differently, and one map."""
    kernels = {features: EmulatedKernels(kernel_text(features), tmp_path) for features in (2, 4)}
    rows, submap = mapped(rasterizer)
    rows_there, submap_there = mapped(CudaRasterizer(torch.device("cpu"), kernels))
    assert not any(row.lost for row in rows_there)
    for row, row_there in zip(rows, rows_there, strict=True):
        assert (row.T_map_cam - row_there.T_map_cam).abs().max() < 1e-5, row.frame_index
    assert len(submap) == len(submap_there) > 400
    assert (submap.gaussians.means - submap_there.gaussians.means).abs().max() < 1e-5
    assert (submap.confidence.value - submap_there.confidence.value).abs().max() < 1e-4
