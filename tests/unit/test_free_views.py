"""The one map from where nobody was."""

import torch

from tcgsplat.datasets.truth import FreeView
from tcgsplat.evaluation.free import free_rows
from tcgsplat.geometry import se3
from tcgsplat.mapping.merging import merged
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.view import render_view
from tcgsplat.scene.exposure import UNCHANGED


def test_views_of_the_map_itself_are_perfect_wherever_its_world_stands(corner, rasterizer):
    """The truth's frame is another one, its brightness too: neither may matter."""
    whole = merged([corner], MapperConfig(), rasterizer)
    T_truth_world = se3.exp(torch.tensor([0.3, -0.2, 1.0, 0.4, 0.5, -0.3], dtype=torch.float64))
    steps = torch.eye(6, dtype=torch.float64)[:3] * 0.02
    poses = [se3.exp(step) for step in steps]
    true = [T_truth_world @ T for T in poses]
    camera = whole.submap.keyframes[0].frame.camera
    views = []
    for T in poses:
        seen = render_view(whole.submap, camera, T, rasterizer)
        views.append(FreeView(0.5 * seen.color + 0.1, seen.depth, T_truth_world @ T, camera))
    rows = free_rows(whole, poses, true, views, rasterizer)
    assert rows["psnr_free"].value > 50
    assert rows["depth_l1_free"].value < 0.01
    assert whole.exposures == (UNCHANGED,)
