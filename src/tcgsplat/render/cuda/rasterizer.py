"""The GPU rasterizer: torch values in and out, our kernels between, sorted by torch.

Drawing: `project` looks at each Gaussian; they are sorted by depth; `list` writes, in that order, a pair for each tile
that a footprint reaches; a stable sort by tile leaves each tile's by depth; `blend` composites. On the way back each
pair gets its own sums over its tile's pixels, and each Gaussian adds up its pairs, which lie side by side. Nothing is
added by atomics: the same input gives the same bits.
"""

import logging
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor

from tcgsplat.errors import BackendUnavailableError
from tcgsplat.geometry.camera import Camera
from tcgsplat.render import conventions
from tcgsplat.render.cuda import graphs
from tcgsplat.render.cuda.graphs import Recorder, Room
from tcgsplat.render.cuda.launching import THREADS, Compiled, Kernels, source
from tcgsplat.render.protocol import Raster, Splats
from tcgsplat.render.repetition import Given, Step, each
from tcgsplat.tensors import Pose

logger = logging.getLogger(__name__)

TILE, RECORD, MOMENTS = 16, 12, 10  # as in the kernels' text
_CONSTANTS = ("NEAR_PLANE", "MIN_ALPHA", "MIN_TRANSMITTANCE", "BLUR", "PLANE_SOFTENING", "JACOBIAN_MARGIN")


def kernel_text(features: int) -> str:
    """All kernels as C++, for so many feature channels."""
    constants = {name: f"{getattr(conventions, name)!r}f" for name in _CONSTANTS}
    constants |= {"LOG2_E": "1.4426950408889634f", "FEATURES": str(features), "SUMS": str(_sums(features))}
    return source(constants, *(f"render/cuda/{name}" for name in ("kernel.cuh", "projection.cu", "blending.cu")))


def _sums(features: int) -> int:
    """Of a pair, padded to what a warp adds up at a time."""
    return -(-(MOMENTS + features) // 16) * 16


class CudaRasterizer:
    """CUDA kernels; float32; up to 22 feature channels, as many as a block's shared memory holds, in one pass."""

    name = "cuda"

    def __init__(
        self,
        device: torch.device,
        kernels: Mapping[int, Kernels] | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        """A rasterizer on a GPU; kernels are compiled, or loaded, when something is drawn first.

        Args:
            device: Where the splats are, with its index.
            kernels: Compiled elsewhere, by the number of feature channels.
            recorder: Of steps that are repeated; if left out, they are done one after the other.
        """
        self.device = device
        self._kernels = dict(kernels or {})
        self._recorder, self._room = recorder, Room(device)

    def kernels(self, features: int) -> Kernels:
        """For so many feature channels.

        Raises:
            BackendUnavailableError: if they cannot be compiled or loaded.
        """
        if features not in self._kernels:
            self._kernels[features] = Compiled(kernel_text(features), self.device)
        return self._kernels[features]

    def reserved(self) -> AbstractContextManager[None]:
        """See `Rasterizer`; a GPU has no cores to keep free."""
        return nullcontext()

    def repeat(self, step: Step, given: Given, times: int, state: Sequence[Tensor]) -> None:
        """See `Repeater`."""
        recorder = self._recorder  # once: another thread may find out that nothing can be recorded
        if recorder is None or times < graphs.SHORTEST or not self._repeated(recorder, step, given, times, state):
            each(step, given, times)

    def _repeated(self, recorder: Recorder, step: Step, given: Given, times: int, state: Sequence[Tensor]) -> bool:
        """Whether that could be done by recording; if not, all is as it was."""
        before: list[Tensor] = []

        def begin_again() -> None:
            for table, values in zip(state, before, strict=True):
                table.copy_(values)

        try:
            before += [table.clone() for table in state]
            graphs.repeat(recorder, self._room, step, given, times, begin_again)
            return True
        except torch.OutOfMemoryError:
            logger.debug("too little memory for recording %d steps: they are done one by one", times)
        except (RuntimeError, BackendUnavailableError) as error:
            said = error.__context__ or error  # what ends a recording that has failed tells nothing
            logger.warning("CUDA graphs are not used, which is slower and changes nothing else: %s", said)
            self._recorder = None
        # Here, where the error no longer keeps what the step had made.
        recorder.forget()
        if before:
            begin_again()
        return False

    def __call__(self, splats: Splats, camera: Camera, T_cam_map: Pose) -> Raster:
        """Draw; see `Rasterizer`. But in recorded steps, the host waits once: for the number of pairs."""
        c = splats.features.shape[1]
        planes, visible = _Draw.apply(  # type: ignore[no-untyped-call]
            self.kernels(c), camera, self._room, splats.means, splats.quats, splats.scales, splats.opacities,
            splats.features, T_cam_map,
        )  # fmt: skip
        return Raster(planes[:c].permute(1, 2, 0), planes[c], planes[c + 1], planes[c + 2], visible)


def _blocks(n: int) -> int:
    """That give each of n things a thread."""
    return -(-n // THREADS)


def _listed(kernels: Kernels, seen: dict[str, Tensor], tiles_x: int, tiles: int, room: Room) -> dict[str, Tensor]:
    """The pairs of splat and tile, in the order of depth, and how the tiles have them.

    Returns:
        `order` [n] Gaussians by depth; `ends` [n] how many pairs those up to each have; `owners` [pairs] the Gaussian
        of each; `pairs` [pairs] those of all tiles one after the other, each tile's by depth; `starts` [tiles + 1].
    """
    n, device = len(seen["depths"]), seen["depths"].device
    order = seen["depths"].argsort(stable=True)
    ends = seen["counts"][order].cumsum(0)
    pairs = room.asked_for(ends)
    tile = torch.full((pairs,), tiles, dtype=torch.int32, device=device)
    owners = torch.empty_like(tile)
    if n and pairs:
        kernels.launch("list", _blocks(n), {
            "records": seen["records"], "rectangles": seen["rectangles"], "order": order, "ends": ends, "tiles": tile,
            "owners": owners, "room": pairs, "n": n, "tiles_x": tiles_x,
        })  # fmt: skip
    if tiles <= torch.iinfo(torch.int16).max:  # sixteen bits are sorted in half the passes
        tile = tile.to(torch.int16)
    by_tile, by_place = tile.sort(stable=True)
    starts = torch.searchsorted(by_tile, torch.arange(tiles + 1, device=device, dtype=tile.dtype))
    return {"order": order, "ends": ends, "owners": owners, "pairs": by_place, "starts": starts}


class _Draw(torch.autograd.Function):
    """The bridge to autograd."""

    @staticmethod
    def forward(
        ctx: Any, kernels: Kernels, camera: Camera, room: Room, means: Tensor, quats: Tensor, scales: Tensor,
        opacities: Tensor, features: Tensor, T_cam_map: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        (n, c), device, width, height = features.shape, means.device, camera.width, camera.height
        parameters = {
            "means": means.detach().contiguous(), "quats": quats.detach().contiguous(),
            "scales": scales.detach().contiguous(), "opacities": opacities.detach().contiguous(),
            "pose": T_cam_map.detach().to(device, torch.float32, non_blocking=True).contiguous(),
        }  # fmt: skip
        view = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy, "width": width, "height": height}
        tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
        seen = {
            "records": means.new_empty(n, RECORD), "depths": means.new_empty(n),
            "rectangles": torch.empty(n, 4, dtype=torch.int32, device=device),
            "counts": torch.empty(n, dtype=torch.int32, device=device),
            "visible": torch.empty(n, dtype=torch.bool, device=device),
        }  # fmt: skip
        if n:
            kernels.launch("project", _blocks(n), parameters | seen | {"n": n, "camera": view})
        listed = _listed(kernels, seen, tiles_x, tiles_x * tiles_y, room)

        planes, through = means.new_empty(c + 3, height, width), means.new_empty(height, width)
        blended = {
            "records": seen["records"], "features": features.detach().contiguous(), "pairs": listed["pairs"],
            "owners": listed["owners"], "starts": listed["starts"], "through": through,
            "used": torch.empty(height, width, dtype=torch.int32, device=device),
            "width": width, "height": height, "tiles_x": tiles_x,
        }  # fmt: skip
        kernels.launch("blend", tiles_x * tiles_y, blended | {"planes": planes})

        ctx.kernels, ctx.blended, ctx.pose_like = kernels, blended, T_cam_map.new_empty(0)
        ctx.projected = parameters | {"order": listed["order"], "ends": listed["ends"], "n": n, "camera": view}
        ctx.mark_non_differentiable(seen["visible"])
        return planes, seen["visible"]

    @staticmethod
    def backward(ctx: Any, d_planes: Tensor, _d_visible: Tensor) -> tuple[Tensor | None, ...]:
        kernels, blended, projected = ctx.kernels, ctx.blended, ctx.projected
        n, c = blended["features"].shape
        sums = d_planes.new_zeros(len(blended["pairs"]), _sums(c))
        if len(sums):
            tiles = len(blended["starts"]) - 1
            kernels.launch("blend_backward", tiles, blended | {"d_planes": d_planes.contiguous(), "sums": sums})
        names = ("means", "quats", "scales", "opacities")
        grads = {f"d_{name}": torch.empty_like(projected[name]) for name in names}
        grads["d_features"] = torch.empty_like(blended["features"])
        d_pose = d_planes.new_zeros(_blocks(n), 16)
        if n:
            given = projected | {"sums": sums, "features": c, "room": len(sums)}
            kernels.launch("project_backward", _blocks(n), given | grads | {"d_pose": d_pose})
        if not ctx.needs_input_grad[-1]:  # else a pose on the CPU would be waited for
            return None, None, None, *grads.values(), None
        return None, None, None, *grads.values(), d_pose.sum(dim=0, dtype=torch.float64).view(4, 4).to(ctx.pose_like)
