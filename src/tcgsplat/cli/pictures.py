"""Pictures that a user names, as frames of the camera that made a run; and what a finished map knows them by."""

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

from tcgsplat.cli.progress import counting
from tcgsplat.config import from_toml
from tcgsplat.datasets import open_sequence
from tcgsplat.datasets.images import SUFFIXES, UnreadableImageError, image_files, read_color
from tcgsplat.datasets.opening import LAYOUTS
from tcgsplat.errors import ArchiveError, DatasetError
from tcgsplat.geometry.camera import Camera
from tcgsplat.loop.relocalization import Relocalizer
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.frame import Frame
from tcgsplat.storage.run_directory import RunDirectory
from tcgsplat.tensors import Image

logger = logging.getLogger(__name__)

_KINDS = ", ".join(sorted(SUFFIXES))


def frames_of(
    run: RunDirectory, images: Sequence[Path], start: int, stride: int, limit: int | None
) -> Iterator[tuple[str, Frame]]:
    """What to call each picture, and its frame; bare pictures are numbered from 0 in their time stamps.

    All bare pictures are looked at before the first one is given, so that nobody waits long to learn of a wrong one.

    Args:
        run: Whose camera took bare pictures.
        images: One folder of a recorded sequence; or picture files and folders of them.
        start: First frame or picture, counted from 0.
        stride: Use every so many-th one.
        limit: Use no more than so many.

    Raises:
        ArchiveError: if the run has no submap yet.
        DatasetError: if there are no pictures, or the size of one is not that of the run's; or one that was named
            cannot be read; what cannot be read of a folder is left out with a warning.
    """
    if not run.submap_count:
        raise ArchiveError(f"{run.path} has no finished submap to find anything in; let the run go on for longer")
    files = [file for path in images for file in (image_files(path) if path.is_dir() else [path])]
    alone = images[0] if len(images) == 1 and images[0].is_dir() else None
    if alone is not None and (not files or any(recognises(alone) for _, recognises, _ in LAYOUTS)):
        sequence = open_sequence(alone, start=start, stride=stride, limit=limit)
        return ((f"frame {start + stride * frame.index}", frame) for frame in sequence)
    if not files:
        raise DatasetError(f"no pictures in {' '.join(map(str, images))}; give {_KINDS} files")
    if start < 0 or stride < 1 or (limit is not None and limit < 1):
        raise DatasetError(f"--start {start}, --stride {stride}, --limit {limit} make no sense; count from 0, 1 and 1")
    chosen = files[start::stride][:limit]
    if not chosen:
        raise DatasetError(f"there are {len(files)} pictures, counted from 0, and --start is {start}; begin earlier")
    camera, whole = run.load_submap(0).keyframes[0].frame.camera, list[tuple[int, Path]]()
    for number, file in enumerate(chosen):
        try:
            _read(file, camera)
            whole.append((number, file))
        except UnreadableImageError as error:
            if file in images:
                raise
            logger.warning("a picture is skipped: %s", error)
    return ((str(file), _frame(number, file, camera)) for number, file in whole)


def relocalizer(run: RunDirectory, rasterizer: Rasterizer) -> Relocalizer:
    """All submaps of a run, ready to find pictures in.

    Raises:
        ArchiveError: if one cannot be read.
    """
    config = from_toml(run.config_toml)
    known = Relocalizer(config.loop, config.tracker, config.confidence, rasterizer, run.load_submap, config.seed)
    with counting("submap") as tell:
        for index in range(run.submap_count):
            tell(index, run.submap_count)
            known.remember(run.load_submap(index))
    return known


def _frame(number: int, file: Path, camera: Camera) -> Frame:
    color = _read(file, camera)
    size = (camera.height, camera.width)
    return Frame(
        index=number,
        timestamp=float(number),
        color=color,
        depth=torch.zeros(size),
        valid=torch.ones(size, dtype=torch.bool),
        camera=camera,
    )


def _read(file: Path, camera: Camera) -> Image:
    """Colours in [0, 1], `[h w 3]`, of a picture as large as the camera's."""
    if file.is_file() and file.suffix.lower() not in SUFFIXES:
        raise DatasetError(f"{file} is no picture that can be read; give {_KINDS} files")
    color = read_color(file)
    height, width = color.shape[:2]
    if (height, width) != (camera.height, camera.width):
        raise DatasetError(
            f"{file} is {width}x{height} and the run's pictures are {camera.width}x{camera.height}; "
            "give pictures of the same camera, undistorted and cropped as those were"
        )
    return torch.from_numpy(color).to(torch.float32) / 255.0
