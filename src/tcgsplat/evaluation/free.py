"""The one map seen from where no camera of the recording was, where the truth of such views is known."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from tcgsplat.datasets.truth import FreeView
from tcgsplat.evaluation import images
from tcgsplat.evaluation.metrics import Metric, Row
from tcgsplat.evaluation.surface import aligned_by_poses
from tcgsplat.geometry import se3
from tcgsplat.mapping.merging import Merged
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import SubmapView
from tcgsplat.tensors import Pose


def free_rows(
    whole: Merged,
    T_world_cam: Sequence[Pose],
    T_truth_cam: Sequence[Pose],
    views: Sequence[FreeView],
    rasterizer: Rasterizer,
) -> Mapping[str, Row]:
    """`psnr_free` (dB), `ssim_free`, `depth_l1_free` (cm), `coverage_free` (%): means over free views of the one map.

    The map has the brightness of the recording, and the free views that of its first frame: one gain and offset, of all
    views together by least squares, stands between them. Depth is compared at every pixel with a truth; where nothing
    is mapped it counts in full.

    Args:
        whole: The map.
        T_world_cam: Estimated poses in its frame.
        T_truth_cam: The true ones of the same frames, in the frame of the views.
        views: What is truly seen.
        rasterizer: Backend.

    Raises:
        EvaluationError: if there are fewer than three poses.
    """
    fit, T_truth_world = aligned_by_poses(T_world_cam, T_truth_cam), se3.identity()
    T_truth_world[:3, :3], T_truth_world[:3, 3] = torch.from_numpy(fit.rotation), torch.from_numpy(fit.translation)
    draw = SubmapView(whole.submap, rasterizer)
    drawn = [draw(view.camera, se3.inverse(T_truth_world) @ view.T_world_cam) for view in views]
    covered = [rendering.depth > 0 for rendering in drawn]
    ours, true = (
        torch.cat([picture[mask].flatten() for picture, mask in zip(pictures, covered, strict=True)]).double().numpy()
        for pictures in ([rendering.color for rendering in drawn], [view.color for view in views])
    )
    gain, offset = np.polyfit(ours, true, 1) if len(ours) else (1.0, 0.0)
    scores = [
        (
            images.psnr(shown, view.color, everywhere),
            images.ssim(shown, view.color, everywhere),
            100.0 * images.depth_l1(rendering.depth, view.depth, view.depth > 0),
            100.0 * float(mask.float().mean()),
        )
        for view, rendering, mask in zip(views, drawn, covered, strict=True)
        for shown in [(rendering.color * gain + offset).clamp(0.0, 1.0)]
        for everywhere in [torch.ones_like(mask)]
    ]
    names = (("psnr_free", "dB"), ("ssim_free", ""), ("depth_l1_free", "cm"), ("coverage_free", "%"))
    return {
        name: Metric(float(np.mean(values)), unit)
        for (name, unit), values in zip(names, zip(*scores, strict=True), strict=True)
    }
