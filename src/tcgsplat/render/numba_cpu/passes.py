"""The two passes over arrays: parameters to images, and the images' derivatives back to parameters and pose.

Results do not depend on the number of threads: a tile is drawn by one thread, pairs are summed splat by splat in a
fixed order, and pose sums over fixed chunks of splats.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tcgsplat.geometry.camera import Camera
from tcgsplat.render.numba_cpu import blending, projection, tiling
from tcgsplat.render.numba_cpu.layout import (
    CAMERA,
    CHANNELS,
    LANE_GRID,
    PARAMETERS,
    RECORD,
    TILE,
    TILE_FLOATS,
    Floats,
    Ints,
    aligned,
)
from tcgsplat.render.numba_cpu.workers import Workers, available_cores
from tcgsplat.render.protocol import JACOBIAN_MARGIN

_CHUNK = 4096
"""Splats per unit of streaming work. Fixed, because pose sums are made chunk by chunk."""


@dataclass(frozen=True)
class Drawn:
    """A forward pass: what it shows, and what the backward pass needs."""

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
    planes: Floats
    """[CHANNELS, h, w]: the features, centre depth, plane depth, alpha."""

    @property
    def visible(self) -> npt.NDArray[np.bool_]:
        """Whether each splat touches a tile, [padded]."""
        return np.diff(self.slot_starts) > 0


def camera_vector(camera: Camera, T_cam_map: npt.NDArray[np.float64]) -> Floats:
    """The camera's numbers in the order of `layout`; the pose in float32."""
    margin_x = JACOBIAN_MARGIN * 0.5 * camera.width / camera.fx
    margin_y = JACOBIAN_MARGIN * 0.5 * camera.height / camera.fy
    T = T_cam_map
    values = [
        *T[:3, :3].ravel(), *T[:3, 3], camera.fx, camera.fy, camera.cx, camera.cy,
        (-0.5 - camera.cx) / camera.fx - margin_x, (camera.width - 0.5 - camera.cx) / camera.fx + margin_x,
        (-0.5 - camera.cy) / camera.fy - margin_y, (camera.height - 0.5 - camera.cy) / camera.fy + margin_y,
        camera.width - 1, camera.height - 1,
    ]  # fmt: skip
    vector = np.array(values, np.float32)
    assert vector.size == CAMERA
    return vector


class Passes:
    """Forward and backward on some threads."""

    def __init__(self, threads: int | None = None, lap: Callable[[str], object] = lambda _: None) -> None:
        """Passes on `threads` workers, by default as many as this process may run on.

        `lap` is called with its name at the end of every stage: project, sort, bin, forward; backward, chain.
        """
        self._workers = Workers(threads or available_cores())
        self._lap = lap
        self._grid: Floats = aligned(LANE_GRID.shape)  # type: ignore[assignment]
        self._grid[:] = LANE_GRID

    def draw(self, parameters: Floats, camera: Camera, T_cam_map: npt.NDArray[np.float64]) -> Drawn:
        """Project, sort, bin and composite.

        Args:
            parameters: [PARAMETERS, padded], padded to a multiple of sixteen by splats too faint to be visible.
            camera: Intrinsics.
            T_cam_map: Map frame to camera frame, [4, 4]; used in float32.
        """
        padded = parameters.shape[1]
        cam = camera_vector(camera, T_cam_map)
        workers, flat = self._workers, parameters.reshape(-1)
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
        self._lap("forward")
        return Drawn(
            padded, flat, cam, tiles_x, tile_ends, pair_splats, slot_starts, slot_pairs, records, masks, image, planes
        )

    def differentiate(self, drawn: Drawn, d_planes: Floats) -> tuple[Floats, npt.NDArray[np.float64]]:
        """From the loss's derivative by the planes to those by the parameters [PARAMETERS, padded] and the pose [4, 4]."""
        workers, padded = self._workers, drawn.padded
        _, height, width = d_planes.shape
        d_image: Floats = aligned(drawn.image.size)  # type: ignore[assignment]
        pair_sums: Floats = aligned(max(drawn.masks.size, 1) * RECORD)  # type: ignore[assignment]

        def composite(a: int, b: int) -> None:
            blending.to_tiles(a, b, drawn.tiles_x, width, height, d_planes, d_image)
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
