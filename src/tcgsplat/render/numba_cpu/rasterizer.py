"""The CPU rasterizer: torch values in and out, the kernels' two passes between."""

from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tcgsplat.geometry.camera import Camera
from tcgsplat.render.numba_cpu.layout import (
    FEATURE,
    FEATURES,
    LOG2_OPACITY,
    MEAN,
    PARAMETERS,
    QUAT,
    SCALE,
    Floats,
    aligned,
)
from tcgsplat.render.numba_cpu.passes import Passes
from tcgsplat.render.protocol import Raster, Splats
from tcgsplat.tensors import PerGaussianFlag, Pose


def _packed(splats: Splats) -> Floats:
    """Parameters as one matrix [PARAMETERS, padded]; padding is too faint to be visible."""
    n = splats.means.shape[0]
    padded = -(-max(n, 1) // 16) * 16
    P: Floats = aligned((PARAMETERS, padded))  # type: ignore[assignment]
    P[:, n:] = 1.0
    P[LOG2_OPACITY, n:] = -100.0
    P[MEAN : MEAN + 3, :n] = splats.means.detach().numpy().T
    P[QUAT : QUAT + 4, :n] = splats.quats.detach().numpy().T
    P[SCALE : SCALE + 3, :n] = splats.scales.detach().numpy().T
    P[LOG2_OPACITY, :n] = splats.opacities.detach().log2().numpy()
    channels = splats.features.shape[1]
    P[FEATURE : FEATURE + channels, :n] = splats.features.detach().numpy().T
    P[FEATURE + channels :, :n] = 0.0
    return P


class NumbaRasterizer:
    """Explicit 16-wide kernels; float32; up to four feature channels in one pass, more in several."""

    name = "numba"

    def __init__(self, threads: int | None = None) -> None:
        """A rasterizer on so many threads of the CPU, by default as many as this process may run on."""
        self.device = torch.device("cpu")
        self.passes = Passes(threads)

    def __call__(self, splats: Splats, camera: Camera, T_cam_map: Pose) -> Raster:
        """Draw; see `Rasterizer`."""
        groups = torch.split(splats.features, FEATURES, dim=1)
        planes, visible = self._draw(splats, groups[0], camera, T_cam_map)
        features = [planes[: groups[0].shape[1]]]
        for group in groups[1:]:
            more, _ = self._draw(splats, group, camera, T_cam_map)
            features.append(more[: group.shape[1]])
        return Raster(
            features=torch.cat(features).permute(1, 2, 0) if len(features) > 1 else features[0].permute(1, 2, 0),
            depth=planes[FEATURES],
            plane_depth=planes[FEATURES + 1],
            alpha=planes[FEATURES + 2],
            visible=visible,
        )

    def reserved(self) -> AbstractContextManager[None]:
        """See `Rasterizer`."""
        return self.passes.workers.reserved()

    def _draw(
        self, splats: Splats, features: Tensor, camera: Camera, T_cam_map: Pose
    ) -> tuple[Float[Tensor, "channels h w"], PerGaussianFlag]:
        result: tuple[Tensor, Tensor] = _Draw.apply(  # type: ignore[no-untyped-call]
            self, camera, splats.means, splats.quats, splats.scales, splats.opacities, features, T_cam_map
        )
        return result


class _Draw(torch.autograd.Function):
    """The bridge to autograd."""

    @staticmethod
    def forward(
        ctx: Any, rasterizer: NumbaRasterizer, camera: Camera, means: Tensor, quats: Tensor, scales: Tensor,
        opacities: Tensor, features: Tensor, T_cam_map: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        parameters = _packed(Splats(means, quats, scales, opacities, features))
        drawn = rasterizer.passes.draw(parameters, camera, T_cam_map.detach().to(torch.float64).numpy())
        visible_tensor = torch.from_numpy(drawn.visible[: len(means)])
        planes = torch.from_numpy(drawn.planes)
        ctx.rasterizer, ctx.drawn, ctx.pose_dtype, ctx.channels = rasterizer, drawn, T_cam_map.dtype, features.shape[1]
        ctx.save_for_backward(opacities, planes)  # planes only so that torch sees when they were changed in place
        ctx.mark_non_differentiable(visible_tensor)
        return planes, visible_tensor

    @staticmethod
    def backward(ctx: Any, d_planes: Tensor, _d_visible: Tensor) -> tuple[Tensor | None, ...]:
        opacities, _ = ctx.saved_tensors
        n, drawn = len(opacities), ctx.drawn
        grads = drawn.workspace.floats("grads", PARAMETERS, drawn.padded)
        _, d_T = ctx.rasterizer.passes.differentiate(drawn, d_planes.contiguous().numpy(), grads)

        def rows(start: int, count: int) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(grads[start : start + count, :n].T))

        d_log2_opacity = torch.from_numpy(grads[LOG2_OPACITY, :n])
        return (
            None, None, rows(MEAN, 3), rows(QUAT, 4), rows(SCALE, 3), d_log2_opacity / (opacities * float(np.log(2))),
            rows(FEATURE, ctx.channels), torch.from_numpy(d_T).to(ctx.pose_dtype),
        )  # fmt: skip
