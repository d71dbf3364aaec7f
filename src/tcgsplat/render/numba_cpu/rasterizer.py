"""The CPU rasterizer: torch values in and out, the kernels' two passes between."""

from contextlib import AbstractContextManager
from dataclasses import fields, replace
from typing import Any
from weakref import WeakKeyDictionary

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
    from_blocks,
    to_blocks,
)
from tcgsplat.render.numba_cpu.passes import Passes
from tcgsplat.render.protocol import Raster, Splats
from tcgsplat.tensors import PerGaussianFlag, Pose


def _packed(splats: Splats) -> Floats:
    """Parameters in blocks [blocks, PARAMETERS, 16]; what fills the last one up is too faint to be visible."""
    P: Floats = aligned((-(-max(len(splats.means), 1) // 16), PARAMETERS, 16))  # type: ignore[assignment]
    P[-1] = 1.0
    P[-1, LOG2_OPACITY] = -100.0
    P[:, FEATURE:] = 0.0
    for row, table in (
        (MEAN, splats.means),
        (QUAT, splats.quats),
        (SCALE, splats.scales),
        (LOG2_OPACITY, splats.opacities.log2()[:, None]),
        (FEATURE, splats.features),
    ):
        to_blocks(P[:, row : row + table.shape[1]], table.detach().numpy())
    return P


class NumbaRasterizer:
    """Explicit 16-wide kernels; float32; up to four feature channels in one pass, more in several."""

    name = "numba"

    def __init__(self, threads: int | None = None) -> None:
        """A rasterizer on so many threads of the CPU, by default as many as this process may run on."""
        self.device = torch.device("cpu")
        self.passes = Passes(threads)
        self._parameters: WeakKeyDictionary[Splats, tuple[list[int], Floats]] = WeakKeyDictionary()

    def __call__(self, splats: Splats, camera: Camera, T_cam_map: Pose) -> Raster:
        """Draw; see `Rasterizer`. The same splats, drawn again without gradients, are not packed again."""
        whole = splats.features.shape[1] <= FEATURES
        groups = (splats.features,) if whole else torch.split(splats.features, FEATURES, dim=1)
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

    def _packed(self, splats: Splats, features: Tensor) -> Floats:
        """The splats' parameters with some of their features; kept while the splats live and are not written to."""
        if features is not splats.features:
            return _packed(replace(splats, features=features))
        versions = [getattr(splats, field.name)._version for field in fields(splats)]
        kept = self._parameters.get(splats)
        if kept is None or kept[0] != versions:
            kept = self._parameters[splats] = versions, _packed(splats)
        return kept[1]

    def reserved(self) -> AbstractContextManager[None]:
        """See `Rasterizer`."""
        return self.passes.workers.reserved()

    def _draw(
        self, splats: Splats, features: Tensor, camera: Camera, T_cam_map: Pose
    ) -> tuple[Float[Tensor, "channels h w"], PerGaussianFlag]:
        tensors = (splats.means, splats.quats, splats.scales, splats.opacities, features, T_cam_map)
        if not (torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)):
            drawn = self.passes.draw(self._packed(splats, features), camera, T_cam_map.to(torch.float64).numpy())
            return torch.from_numpy(drawn.planes), torch.from_numpy(drawn.visible[: len(splats.means)])
        result: tuple[Tensor, Tensor] = _Draw.apply(  # type: ignore[no-untyped-call]
            self, camera, *tensors
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
        grads = drawn.workspace.floats("grads", drawn.padded // 16, PARAMETERS, 16)
        _, d_T = ctx.rasterizer.passes.differentiate(drawn, d_planes.contiguous().numpy(), grads)

        def rows(start: int, count: int) -> Tensor:
            return torch.from_numpy(from_blocks(grads[:, start : start + count])[:n])

        asked = ctx.needs_input_grad[2:]
        d_log2_opacity = rows(LOG2_OPACITY, 1)[:, 0] if asked[3] else None
        return (
            None,
            None,
            rows(MEAN, 3) if asked[0] else None,
            rows(QUAT, 4) if asked[1] else None,
            rows(SCALE, 3) if asked[2] else None,
            None if d_log2_opacity is None else d_log2_opacity / (opacities * float(np.log(2))),
            rows(FEATURE, ctx.channels) if asked[4] else None,
            torch.from_numpy(d_T).to(ctx.pose_dtype) if asked[5] else None,
        )
