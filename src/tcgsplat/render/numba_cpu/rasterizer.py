"""The CPU rasterizer: torch values in and out, numba kernels between, work shared over threads.

Results do not depend on the number of threads: a tile is drawn by one thread, pairs are summed splat by splat in a
fixed order, and pose sums over fixed chunks of splats.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float
from torch import Tensor

from tcgsplat.geometry.camera import Camera
from tcgsplat.render.numba_cpu import blending, projection, tiling
from tcgsplat.render.numba_cpu.layout import (
    CAMERA,
    CHANNELS,
    FEATURE,
    FEATURES,
    LANE_GRID,
    LOG2_OPACITY,
    MEAN,
    PARAMETERS,
    QUAT,
    RECORD,
    SCALE,
    TILE,
    TILE_FLOATS,
    Floats,
    Ints,
    aligned,
)
from tcgsplat.render.protocol import JACOBIAN_MARGIN, Raster, Splats
from tcgsplat.tensors import PerGaussianFlag, Pose

_CHUNK = 4096
"""Splats per unit of streaming work. Fixed, because pose sums are made chunk by chunk."""


def available_cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Workers:
    """A few threads that run nogil kernels over ranges."""

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="splat")

    def run(self, work: Callable[[int, int], object], cuts: list[int]) -> None:
        """Call `work(from, to)` for consecutive cuts, side by side; the first exception is raised."""
        # Even a lone range runs on a worker: kernels that spill registers are faster on a thread's fresh stack.
        futures = [self._pool.submit(work, a, b) for a, b in zip(cuts, cuts[1:], strict=False) if b > a]
        for future in futures:
            future.result()

    def cuts(self, count: int, unit: int = 1) -> list[int]:
        """Equal shares of `count`, at multiples of `unit`."""
        units = -(-count // unit)
        return [min(count, units * k // self.threads * unit) for k in range(self.threads)] + [count]

    def weighted_cuts(self, ends: Ints) -> list[int]:
        """Ranges of tiles with equal shares of pairs; `ends` are running totals, one more than tiles."""
        targets = [int(ends[-1]) * k // self.threads for k in range(1, self.threads)]
        inner = [int(np.searchsorted(ends, target)) for target in targets]
        return [0, *(min(cut, len(ends) - 1) for cut in inner), len(ends) - 1]


@dataclass(frozen=True)
class _Drawn:
    """What backward needs of a forward pass."""

    n: int
    padded: int
    parameters: Floats
    camera_vector: Floats
    tiles_x: int
    tile_ends: Ints
    pair_splats: Ints
    slot_starts: Ints
    slot_pairs: Ints
    records: Floats
    masks: Ints
    image: Floats
    width: int
    height: int


def _camera_vector(camera: Camera, T_cam_map: Tensor) -> Floats:
    """The camera's numbers in the order of `layout`; the pose in float32."""
    margin_x = JACOBIAN_MARGIN * 0.5 * camera.width / camera.fx
    margin_y = JACOBIAN_MARGIN * 0.5 * camera.height / camera.fy
    T = T_cam_map.detach().to(torch.float64).numpy()
    values = [
        *T[:3, :3].ravel(), *T[:3, 3], camera.fx, camera.fy, camera.cx, camera.cy,
        (-0.5 - camera.cx) / camera.fx - margin_x, (camera.width - 0.5 - camera.cx) / camera.fx + margin_x,
        (-0.5 - camera.cy) / camera.fy - margin_y, (camera.height - 0.5 - camera.cy) / camera.fy + margin_y,
        camera.width - 1, camera.height - 1,
    ]  # fmt: skip
    vector = np.array(values, np.float32)
    assert vector.size == CAMERA
    return vector


def _packed(splats: Splats) -> tuple[Floats, int]:
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
    return P, padded


class NumbaRasterizer:
    """Explicit 16-wide kernels; float32; up to four feature channels in one pass, more in several."""

    name = "numba"

    def __init__(self, threads: int | None = None, lap: Callable[[str], object] = lambda _: None) -> None:
        """A rasterizer on the CPU.

        Args:
            threads: Workers, by default as many as this process may run on.
            lap: Called with its name at the end of every stage: pack, project, sort, bin, forward; backward, chain.
                What comes before each pass, which is torch's, ends as `autograd`. For benchmarks.
        """
        self.device = torch.device("cpu")
        self._lap = lap
        self._workers = Workers(threads or available_cores())
        self._grid: Floats = aligned(LANE_GRID.shape)  # type: ignore[assignment]
        self._grid[:] = LANE_GRID

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

    def _draw(
        self, splats: Splats, features: Tensor, camera: Camera, T_cam_map: Pose
    ) -> tuple[Float[Tensor, "channels h w"], PerGaussianFlag]:
        result: tuple[Tensor, Tensor] = _Draw.apply(  # type: ignore[no-untyped-call]
            self, camera, splats.means, splats.quats, splats.scales, splats.opacities, features, T_cam_map
        )
        return result

    def forward(self, splats: Splats, camera: Camera, T_cam_map: Tensor) -> tuple[_Drawn, Floats, Any]:
        """Project, sort, bin and composite: the state for backward, the planes, and which splats are visible."""
        self._lap("autograd")
        P, padded = _packed(splats)
        self._lap("pack")
        n = splats.means.shape[0]
        cam = _camera_vector(camera, T_cam_map)
        workers, flat = self._workers, P.reshape(-1)
        records: Floats = aligned(padded * RECORD)  # type: ignore[assignment]
        depths: Floats = aligned(padded)  # type: ignore[assignment]
        tiles: Ints = aligned(4 * padded, np.int32)  # type: ignore[assignment]
        workers.run(
            lambda a, b: projection.forward(flat, padded, a, b, cam, records, depths, tiles), workers.cuts(padded, 16)
        )
        self._lap("project")

        tiles_x, tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
        order = np.empty(padded, np.int32)
        visible_count = tiling.depth_order(depths.view(np.uint32), tiles, padded, order)
        self._lap("sort")
        tile_ends = np.empty(tiles_x * tiles_y + 1, np.int32)
        slot_starts = np.empty(padded + 1, np.int32)
        pairs = tiling.count_pairs(tiles, padded, tiles_x, tile_ends, slot_starts)
        pair_splats, slot_pairs = np.zeros(pairs + 1, np.int32), np.empty(pairs, np.int32)
        tiling.fill_pairs(order, visible_count, tiles, padded, tiles_x, tile_ends, slot_starts, pair_splats, slot_pairs)
        self._lap("bin")

        masks = np.empty(pairs, np.int32)
        image: Floats = aligned(tiles_x * tiles_y * TILE_FLOATS)  # type: ignore[assignment]
        planes = np.empty((CHANNELS, camera.height, camera.width), np.float32)

        def composite(a: int, b: int) -> None:
            blending.forward(a, b, tile_ends, pair_splats, records, tiles_x, self._grid, masks, image)
            blending.to_planes(a, b, tiles_x, camera.width, camera.height, image, planes)

        workers.run(composite, workers.weighted_cuts(tile_ends))
        drawn = _Drawn(
            n, padded, flat, cam, tiles_x, tile_ends, pair_splats, slot_starts, slot_pairs, records, masks, image,
            camera.width, camera.height,
        )  # fmt: skip
        self._lap("forward")
        return drawn, planes, np.diff(slot_starts[: n + 1]) > 0

    def backward(self, drawn: _Drawn, d_planes: Floats) -> tuple[Floats, npt.NDArray[np.float64]]:
        """Derivatives by the parameters [PARAMETERS, padded] and by the pose [4, 4]."""
        self._lap("autograd")
        workers, padded = self._workers, drawn.padded
        d_image: Floats = aligned(drawn.image.size)  # type: ignore[assignment]
        pair_sums: Floats = aligned(max(drawn.masks.size, 1) * RECORD)  # type: ignore[assignment]

        def composite(a: int, b: int) -> None:
            blending.to_tiles(a, b, drawn.tiles_x, drawn.width, drawn.height, d_planes, d_image)
            blending.backward(
                a, b, drawn.tile_ends, drawn.pair_splats, drawn.records, drawn.tiles_x, self._grid, drawn.masks,
                drawn.image, d_image, pair_sums,
            )  # fmt: skip

        workers.run(composite, workers.weighted_cuts(drawn.tile_ends))
        self._lap("backward")

        grads: Floats = aligned((PARAMETERS, padded))  # type: ignore[assignment]
        flat = grads.reshape(-1)
        chunks = -(-padded // _CHUNK)
        pose_sums = np.empty((chunks, projection.POSE_SUMS), np.float32)

        def chain(a: int, b: int) -> None:
            sums: Floats = aligned(_CHUNK * RECORD)  # type: ignore[assignment]
            for chunk in range(a, b):
                start, stop = chunk * _CHUNK, min((chunk + 1) * _CHUNK, padded)
                blending.gather_sums(
                    start, stop, start, drawn.slot_starts, drawn.slot_pairs, drawn.masks, pair_sums, sums
                )
                projection.backward(
                    drawn.parameters, padded, start, stop, drawn.camera_vector, sums, start, flat, pose_sums[chunk]
                )

        workers.run(chain, workers.cuts(chunks))
        pose = pose_sums.astype(np.float64).sum(axis=0)
        d_T = np.zeros((4, 4))
        d_T[:3, :3], d_T[:3, 3] = pose[:9].reshape(3, 3), pose[9:]
        self._lap("chain")
        return grads, d_T


class _Draw(torch.autograd.Function):
    """The bridge to autograd."""

    @staticmethod
    def forward(
        ctx: Any, rasterizer: NumbaRasterizer, camera: Camera, means: Tensor, quats: Tensor, scales: Tensor,
        opacities: Tensor, features: Tensor, T_cam_map: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        splats = Splats(means, quats, scales, opacities, features)
        drawn, planes, visible = rasterizer.forward(splats, camera, T_cam_map)
        visible_tensor = torch.from_numpy(visible)
        ctx.rasterizer, ctx.drawn, ctx.pose_dtype, ctx.channels = rasterizer, drawn, T_cam_map.dtype, features.shape[1]
        ctx.save_for_backward(opacities)
        ctx.mark_non_differentiable(visible_tensor)
        return torch.from_numpy(planes), visible_tensor

    @staticmethod
    def backward(ctx: Any, d_planes: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        (opacities,) = ctx.saved_tensors
        grads, d_T = ctx.rasterizer.backward(ctx.drawn, d_planes.contiguous().numpy())
        n = ctx.drawn.n

        def rows(start: int, count: int) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(grads[start : start + count, :n].T))

        d_log2_opacity = torch.from_numpy(grads[LOG2_OPACITY, :n])
        return (
            None, None, rows(MEAN, 3), rows(QUAT, 4), rows(SCALE, 3), d_log2_opacity / (opacities * float(np.log(2))),
            rows(FEATURE, ctx.channels), torch.from_numpy(d_T).to(ctx.pose_dtype),
        )  # fmt: skip
