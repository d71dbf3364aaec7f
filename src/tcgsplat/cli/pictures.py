"""Pictures that a user names, as frames of the camera that made a run."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

from tcgsplat.datasets import open_sequence
from tcgsplat.datasets.images import SUFFIXES, image_files, read_color
from tcgsplat.errors import DatasetError
from tcgsplat.geometry.camera import Camera
from tcgsplat.scene.frame import Frame
from tcgsplat.storage.run_directory import RunDirectory


def frames_of(
    run: RunDirectory, images: Sequence[Path], start: int, stride: int, limit: int | None
) -> Iterator[tuple[str, Frame]]:
    """What to call each picture, and its frame.

    Args:
        run: Whose camera took bare pictures.
        images: One folder of a recorded sequence or of pictures, or picture files.
        start: First frame of a sequence.
        stride: Use every so many-th frame of it.
        limit: Use no more than so many.

    Raises:
        DatasetError: if there are none, one cannot be read, or its size is not that of the run's pictures.
    """
    files = [file for path in images for file in (image_files(path) if path.is_dir() else [path])]
    if len(images) == 1 and images[0].is_dir() and not files:
        sequence = open_sequence(images[0], start=start, stride=stride, limit=limit)
        return ((f"frame {start + stride * frame.index}", frame) for frame in sequence)
    if not files:
        raise DatasetError(f"no pictures in {' '.join(map(str, images))}; give {', '.join(sorted(SUFFIXES))} files")
    camera = run.load_submap(0).keyframes[0].frame.camera
    return ((str(file), _frame(number, file, camera)) for number, file in enumerate(files[:limit]))


def _frame(number: int, file: Path, camera: Camera) -> Frame:
    color = read_color(file)
    height, width = color.shape[:2]
    if (height, width) != (camera.height, camera.width):
        raise DatasetError(
            f"{file} is {width}x{height} and the run's pictures are {camera.width}x{camera.height}; "
            "give pictures of the same camera, undistorted and cropped as those were"
        )
    return Frame(
        index=number,
        timestamp=float(number),
        color=torch.from_numpy(color).to(torch.float32) / 255.0,
        depth=torch.zeros(height, width),
        valid=torch.ones(height, width, dtype=torch.bool),
        camera=camera,
    )
