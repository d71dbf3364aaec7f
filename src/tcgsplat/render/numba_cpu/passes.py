"""The two passes over arrays: parameters to images, and the images' derivatives back to parameters and pose.

Results do not depend on the number of threads: a tile is drawn by one thread, pairs are summed splat by splat in a
fixed order, and pose sums over fixed units of splats.
"""

import math
import weakref
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from tcgsplat.geometry.camera import Camera
from tcgsplat.render.conventions import JACOBIAN_MARGIN
from tcgsplat.render.numba_cpu import pass_kernels as kernels
from tcgsplat.render.numba_cpu import projection, tiling
from tcgsplat.render.numba_cpu.blending import BACKWARD_FLOATS
from tcgsplat.render.numba_cpu.layout import (
    CAMERA,
    CHANNELS,
    LANE_GRID,
    PARAMETERS,
    RECORD,
    SPLAT,
    TILE,
    Counts,
    Floats,
    Ints,
    aligned,
)
from tcgsplat.render.numba_cpu.phases import COUNTERS
from tcgsplat.render.numba_cpu.workers import Arguments, Workers, available_cores

_KEPT = 2
"""Workspaces kept for later: one for mapping, one for tracking at the same time."""


class Workspace:
    """Arrays by name that are made once and used again; one pass at a time may hold it."""

    def __init__(self) -> None:
        self._arrays: dict[str, npt.NDArray[np.generic]] = {}

    def floats(self, name: str, *shape: int) -> Floats:
        """Uninitialised float32 of this shape, aligned to cache lines."""
        return self._array(name, shape, np.float32)  # type: ignore[return-value]

    def ints(self, name: str, *shape: int) -> Ints:
        """The same in int32."""
        return self._array(name, shape, np.int32)  # type: ignore[return-value]

    def counts(self, name: str, *shape: int) -> Counts:
        """The same in uint32."""
        return self._array(name, shape, np.uint32)  # type: ignore[return-value]

    def longs(self, name: str, *shape: int) -> npt.NDArray[np.int64]:
        """The same in int64."""
        return self._array(name, shape, np.int64)  # type: ignore[return-value]

    def progress(self, phases: int) -> npt.NDArray[np.int64]:
        """Of a kernel of so many phases (see `phases.py`), none of them begun."""
        progress = self.longs("progress", phases * COUNTERS)
        progress[:] = 0
        return progress

    def _array(self, name: str, shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[np.generic]:
        size = math.prod(shape)
        if name not in self._arrays or self._arrays[name].size < size:
            self._arrays[name] = aligned(size + size // 4, dtype)  # room to grow
        return self._arrays[name][:size].reshape(shape)


@dataclass(frozen=True)
class Drawn:
    """A forward pass: what it shows, and what the backward pass needs.

    Its arrays, except for `planes`, are used again by another pass once it is no longer referred to.
    """

    padded: int
    parameters: Floats
    camera_vector: Floats
    tiles_x: int
    tile_ends: Ints
    pairs: npt.NDArray[np.int64]
    """A slot over a splat, for each (splat, tile) pair, tile by tile and by depth."""
    slot_starts: Counts
    records: Floats
    depths: Floats
    masks: Ints
    workspace: Workspace
    planes: Floats
    """[CHANNELS, h, w]: the features, centre depth, plane depth, alpha. The backward pass reads them again."""

    @property
    def visible(self) -> npt.NDArray[np.bool_]:
        """Whether each splat touches a tile, [padded]."""
        return self.depths > 0

    @property
    def pair_splats(self) -> Ints:
        """Which splat each pair is of."""
        return (self.pairs[: self.tile_ends[-1]] & SPLAT).astype(np.int32)


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
    """Forward and backward on some threads. Several callers may use them at the same time."""

    def __init__(self, threads: int | None = None, lap: Callable[[str], object] | None = None) -> None:
        """Passes on `threads` workers, by default as many as this process may run on.

        `lap` is called with its name at the end of every stage: project, sort, bin, forward; backward, chain. Between
        stages all threads then meet, which they do not otherwise.
        """
        self.workers = Workers(threads or available_cores())
        self._lap = lap
        self._idle: deque[Workspace] = deque(maxlen=_KEPT)
        self._grid: Floats = aligned(LANE_GRID.shape)  # type: ignore[assignment]
        self._grid[:] = LANE_GRID

    def draw(self, parameters: Floats, camera: Camera, T_cam_map: npt.NDArray[np.float64]) -> Drawn:
        """Project, sort, bin and composite.

        Args:
            parameters: [blocks, PARAMETERS, 16], filled up by splats too faint to be visible.
            camera: Intrinsics.
            T_cam_map: Map frame to camera frame, [4, 4]; used in float32.
        """
        space = self._workspace()
        padded, width, height = 16 * len(parameters), camera.width, camera.height
        cam, flat = camera_vector(camera, T_cam_map), parameters.reshape(-1)
        tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
        tiles, strips, units = tiles_x * tiles_y, self.workers.threads, -(-padded // kernels.UNIT)
        records, depths = space.floats("records", padded * RECORD), space.floats("depths", padded)
        rectangles, slot_starts = space.counts("rectangles", 2 * padded), space.counts("slot_starts", padded + 1)
        entries, unit_sums = space.longs("entries", padded + tiling.LINE), space.longs("unit_sums", units, 3)
        tile_counts, tile_ends = space.counts("tile_counts", strips, tiles + 1), space.ints("tile_ends", tiles + 1)
        arranging = (
            flat, padded, cam, tiles_x, records, depths, depths.view(np.int32), rectangles, unit_sums, slot_starts,
            entries, space.longs("swapped", padded + tiling.LINE), space.counts("digit_counts", strips, tiling.DIGIT_VALUES),
            space.ints("digit_ends", tiling.DIGIT_VALUES + 1), tile_counts, tile_ends,
        )  # fmt: skip
        self._run(
            kernels.arrange,
            {"project": kernels.PROJECT, "sort": kernels.COUNT_TILES - 1, "": kernels.PLACE_TILES},
            lambda _: arranging,
            space,
        )

        visible, pair_count, _ = (int(total) for total in unit_sums.sum(axis=0))
        longest = int(np.diff(tile_ends).max())
        pairs = space.longs("pairs", pair_count + tiling.LINE * (strips + 1))
        masks = space.ints("masks", pair_count)
        local = space.floats("local", strips, max((longest + 1) * RECORD, BACKWARD_FLOATS))
        lists = space.ints("lists", strips, 3, -(-(longest + 16) // 16) * 16)
        planes = np.empty((CHANNELS, height, width), np.float32)
        compositing = (
            entries, visible, rectangles, slot_starts, tiles_x, tile_counts, tile_ends, pairs, records, width, height,
            self._grid,
        )  # fmt: skip
        drawing = planes.reshape(-1)
        self._run(
            kernels.composite,
            {"bin": kernels.FILL, "forward": kernels.FORWARD},
            lambda worker: (*compositing, local[worker], lists[worker], masks, drawing),
            space,
        )
        drawn = Drawn(padded, flat, cam, tiles_x, tile_ends, pairs, slot_starts, records, depths, masks, space, planes)
        weakref.finalize(drawn, self._idle.append, space).atexit = False
        return drawn

    def differentiate(
        self, drawn: Drawn, d_planes: Floats, grads: Floats | None = None
    ) -> tuple[Floats, npt.NDArray[np.float64]]:
        """From the loss's derivative by the planes to those by the parameters [blocks, PARAMETERS, 16] and the pose [4, 4].

        `grads` is where to write the former; a new array if left out.
        """
        space, padded = drawn.workspace, drawn.padded
        pair_sums = self.pair_sums(drawn, d_planes)
        pose_sums = space.floats("pose_sums", -(-padded // kernels.UNIT), projection.POSE_SUMS)
        out: Floats = aligned((padded // 16, PARAMETERS, 16)) if grads is None else grads  # type: ignore[assignment]
        chaining = (
            pair_sums, drawn.parameters, padded, drawn.camera_vector, drawn.slot_starts, out.reshape(-1), pose_sums,
        )  # fmt: skip
        self.stage("chain", kernels.chain, lambda _: chaining, space)
        pose = pose_sums.sum(axis=0, dtype=np.float64)
        d_T = np.zeros((4, 4))
        d_T[:3, :3], d_T[:3, 3] = pose[:9].reshape(3, 3), pose[9:]
        return out, d_T

    def pair_sums(self, drawn: Drawn, d_planes: Floats) -> Floats:
        """What `blending.backward` leaves of the loss's derivative by the planes: a row for each pair's slot."""
        space, (_, height, width) = drawn.workspace, d_planes.shape
        pair_sums = space.floats("pair_sums", max(drawn.masks.size, 1) * RECORD)
        local = space.floats("local", self.workers.threads, BACKWARD_FLOATS)
        blending = (
            drawn.tile_ends, drawn.pairs, drawn.records, drawn.tiles_x, width, height, self._grid, drawn.masks,
            drawn.planes.reshape(-1), d_planes.reshape(-1),
        )  # fmt: skip
        self.stage("backward", kernels.differentiate, lambda worker: (*blending, local[worker], pair_sums), space)
        return pair_sums

    def stage(
        self, name: str, kernel: Callable[..., bool], arguments: Callable[[int], Arguments], space: Workspace
    ) -> None:
        """A kernel of one phase on all threads, each with its own arguments; one stage for `lap`."""
        self.workers.share(partial(kernel, space.progress(1)), arguments)
        if self._lap:
            self._lap(name)

    def _workspace(self) -> Workspace:
        try:
            return self._idle.pop()
        except IndexError:
            return Workspace()

    def _run(
        self,
        kernel: Callable[..., bool],
        stages: dict[str, int],
        arguments: Callable[[int], Arguments],
        space: Workspace,
    ) -> None:
        """A kernel on all threads, in one go; for `lap` stage by stage, which are given with their last phases."""
        progress = space.progress(max(stages.values()) + 1)
        for stage, last_phase in stages.items() if self._lap else [("", max(stages.values()))]:
            self.workers.share(partial(kernel, progress, last_phase), arguments)
            if self._lap and stage:
                self._lap(stage)
