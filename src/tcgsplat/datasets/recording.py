"""A sequence of image files: the one implementation behind every layout, which differ in what they list."""

import logging
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tcgsplat.datasets.association import ImagePair
from tcgsplat.datasets.calibration import Calibration
from tcgsplat.datasets.images import Rectification, UnreadableImageError, read_color, read_depth
from tcgsplat.errors import DatasetError
from tcgsplat.geometry.camera import Camera
from tcgsplat.scene.frame import Frame
from tcgsplat.tensors import Pose

logger = logging.getLogger(__name__)

READ_AHEAD = 2
"""Frames that are decoded while the current one is in use."""
SAMPLED = 5
"""Frames that are read on opening, spread over the sequence."""
DEPTH_RANGE = (0.1, 50.0)
"""Metres between which the median depth of a room or a street lies."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Image files on disk as a `Sequence`."""

    root: Path
    pairs: tuple[ImagePair, ...]
    calibration: Calibration
    read_poses: Callable[[Sequence[ImagePair]], dict[int, Pose]]
    """`T_world_cam` by place in the pairs, as far as known; called by `ground_truth` only."""
    resize_color: bool = False
    """Colour comes larger than depth and is brought to its size."""

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.root.resolve().name

    @property
    def camera(self) -> Camera:
        """Intrinsics of every frame, after the crop."""
        return self.calibration.camera.cropped(self.calibration.crop)

    @cached_property
    def rectification(self) -> Rectification | None:
        """How to remove the lens distortion, if there is any."""
        distortion = self.calibration.distortion
        return Rectification.of(self.calibration.camera, distortion) if distortion else None

    @cached_property
    def _inside(self) -> tuple[slice, slice]:
        """Rows and columns that the crop leaves."""
        camera, border = self.calibration.camera, self.calibration.crop
        return slice(border, camera.height - border), slice(border, camera.width - border)

    @cached_property
    def _valid(self) -> NDArray[np.bool_]:
        """Pixels that saw the world, after the crop; the same in every frame, which share it."""
        camera, rectification = self.calibration.camera, self.rectification
        valid = rectification.valid if rectification else np.ones((camera.height, camera.width), np.bool_)
        return valid[self._inside].copy()

    def __len__(self) -> int:
        return len(self.pairs)

    def __iter__(self) -> Iterator[Frame]:
        """All frames in order."""
        return self.frames_from(0)

    def frames_from(self, first: int) -> Iterator[Frame]:
        """Frames in order, decoded ahead in one thread; those that cannot be read are skipped with a warning."""
        with ThreadPoolExecutor(max_workers=1, thread_name_prefix="read-ahead") as reader:
            indices = iter(range(first, len(self)))
            ahead = deque(reader.submit(self.frame, i) for i in islice(indices, READ_AHEAD))
            while ahead:
                reading = ahead.popleft()
                try:
                    frame = reading.result()
                except DatasetError as error:
                    logger.warning("a frame is skipped: %s", error)
                    frame = None
                ahead.extend(reader.submit(self.frame, i) for i in islice(indices, 1))
                if frame is not None:
                    yield frame

    def frame(self, index: int) -> Frame:
        """The undistorted, cropped frame of one index.

        Raises:
            DatasetError: if there is no such frame, its images cannot be read, or their sizes are wrong.
        """
        if not 0 <= index < len(self):
            raise DatasetError(f"{self.root} has no frame {index}; it has {len(self)}, counted from 0")
        pair = self.pairs[index]
        color, depth = self._rectified(*self._read(pair))
        return Frame(
            index=index,
            timestamp=pair.timestamp,
            color=torch.from_numpy(np.divide(color[self._inside], np.float32(255), dtype=np.float32)),
            depth=torch.from_numpy(depth[self._inside] * self._valid),
            valid=torch.from_numpy(self._valid),
            camera=self.camera,
            depth_timestamp=pair.depth_timestamp,
        )

    def ground_truth(self) -> dict[int, Pose]:
        """`T_world_cam` by frame index, in the world frame of the file, as far as known.

        Raises:
            DatasetError: if the file of the poses is there but cannot be read.
        """
        return self.read_poses(self.pairs)

    def part(self, start: int, stride: int, limit: int | None) -> "Recording":
        """Every `stride`-th frame from `start` on, `limit` of them at most; indices begin at 0 again.

        Raises:
            DatasetError: if nothing would be left, or a number makes no sense.
        """
        if stride < 1 or start < 0 or (limit is not None and limit < 1):
            raise DatasetError(
                f"start = {start}, stride = {stride}, limit = {limit} select no frames of {self.root}; "
                "start counts from 0, stride and limit from 1"
            )
        if start >= len(self):
            raise DatasetError(f"start = {start} is behind the end of {self.root}, which has {len(self)} frames")
        return replace(self, pairs=self.pairs[start::stride][:limit])

    def checked(self) -> "Recording":
        """Itself, once a few frames have been read and make sense.

        Raises:
            DatasetError: if no frame can be read, sizes are wrong, or the depth scale cannot be right.
        """
        sample = sorted(set(np.linspace(0, len(self) - 1, SAMPLED).round().astype(int).tolist()))
        others = [i for i in range(len(self)) if i not in sample]
        depths: list[NDArray[np.float32]] = []
        problem: UnreadableImageError | None = None
        for tried, index in enumerate([*sample, *others]):
            if tried >= len(sample) and depths:
                break
            try:
                depth = self.frame(index).depth.numpy()
                depths.append(depth[depth > 0])
            except UnreadableImageError as error:
                problem = problem or error
        if not depths:
            raise DatasetError(f"none of the {len(self)} frames of {self.root} can be read; the first: {problem}")
        self._check_depth(np.concatenate(depths))
        return self

    def _check_depth(self, readings: NDArray[np.float32]) -> None:
        scale = self.calibration.depth_scale
        if not readings.size:
            raise DatasetError(f"the depth images of {self.root} hold no reading; check {self.pairs[0].depth}")
        middle = readings.size // 2
        median = float(np.partition(readings, middle)[middle])  # `np.median` would import masked arrays first
        if not DEPTH_RANGE[0] <= median <= DEPTH_RANGE[1]:
            raise DatasetError(
                f"the median depth in {self.root} is {median:.3g} m with depth_scale = {scale:g} units per metre, "
                f"which cannot be right; set depth_scale in {self.root / 'camera.toml'} (1000 for millimetres)"
            )

    def _read(self, pair: ImagePair) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        color, depth = read_color(pair.color), read_depth(pair.depth, self.calibration.depth_scale)
        if self.resize_color and color.shape[:2] != depth.shape:
            color = cv2.resize(color, depth.shape[::-1], interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
        if color.shape[:2] != depth.shape:
            raise DatasetError(
                f"colour and depth differ in size: {pair.color} is {_size(color)}, {pair.depth} is {_size(depth)}; "
                "give depth that is registered to the colour image"
            )
        camera = self.calibration.camera
        if depth.shape != (camera.height, camera.width):
            raise DatasetError(
                f"{pair.depth} is {_size(depth)} but its camera is {camera.width}x{camera.height}; "
                f"write the camera of these images into {self.root / 'camera.toml'}"
            )
        return color, depth

    def _rectified(
        self, color: NDArray[np.uint8], depth: NDArray[np.float32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        rectification = self.rectification
        if rectification is None:
            return color, depth
        # Registered depth was sampled on the distorted grid of the colour camera, so it moves with the colour.
        depth = rectification.depth(depth) if self.calibration.depth_distorted else depth
        return rectification.color(color), depth


def _size(image: NDArray[np.generic]) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"
