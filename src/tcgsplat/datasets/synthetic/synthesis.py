"""From a configuration to a recorded sequence on disk."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tcgsplat.datasets.synthetic import path as way
from tcgsplat.datasets.synthetic import sensor
from tcgsplat.datasets.synthetic.apartment import PERSON_AT
from tcgsplat.datasets.synthetic.places import PLACES, Name
from tcgsplat.datasets.synthetic.studio import Shot, Studio, furnished_studio
from tcgsplat.datasets.synthetic.writer import SequenceFiles, complete_or_absent, sequence_files, write_mesh
from tcgsplat.errors import ConfigError

Array = np.ndarray[Any, np.dtype[Any]]

_SHUTTER = 0.5
"""Part of the time from frame to frame in which the shutter is open, for motion blur."""


@dataclass(frozen=True)
class SynthConfig:
    """A walk through a furnished apartment of two rooms and back, as an RGB-D camera records it."""

    frames: int = 600
    """Number of frames for the whole walk: with fewer, the camera moves faster."""
    width: int = 320
    """Width of the images, pixels."""
    height: int = 240
    """Height of the images, pixels."""
    fps: float = 30.0
    """Frames per second."""
    seed: int = 0
    """Seed of colours, books and fruits, of the hand's shaking, and of every effect below."""
    place: Name = "apartment"
    """Two different rooms with a doorway between them, or `twins`: two that look the same, and a hall between them."""
    layout: Literal["tum", "replica"] = "tum"
    """Files as in the TUM RGB-D benchmark, or as NICE-SLAM distributes Replica."""
    depth_noise: bool = False
    """Depth as from a Kinect: noise and steps that grow with distance squared (m), holes, ragged edges."""
    exposure_jumps: bool = False
    """Brightness jumps now and then; `exposure.txt` gives the factor on each frame's pixel values (unitless)."""
    motion_blur: bool = False
    """Colour is the mean over an exposure of half a frame's time (s), centred on the time stamp."""
    moving_object: bool = False
    """Somebody strolls about the living room; `mask/` says where (255) in each frame. Not part of `mesh.ply`."""
    dropped_frames: bool = False
    """Runs of 2 to 7 frames are missing, about one run in 100 frames."""

    def __post_init__(self) -> None:
        if self.frames < 2:
            raise ConfigError(f"frames = {self.frames}: a walk needs at least 2 frames")
        if min(self.width, self.height) < 16:
            raise ConfigError(f"width = {self.width}, height = {self.height}: images need at least 16 by 16 pixels")
        if not 0 < self.fps < float("inf"):
            raise ConfigError(f"fps = {self.fps}: frames per second must be positive")
        if self.seed < 0:
            raise ConfigError(f"seed = {self.seed}: give a number from 0 on")
        if self.place not in PLACES:
            raise ConfigError(f"place = {self.place!r}: give 'apartment' or 'twins'")
        if self.layout not in ("tum", "replica"):
            raise ConfigError(f"layout = {self.layout!r}: give 'tum' or 'replica'")


def synthesize(out: Path, config: SynthConfig, progress: Callable[[int, int], None] | None = None) -> None:
    """Write a synthetic RGB-D sequence with exact poses, exact depth and the exact mesh.

    The same configuration gives the same bytes, whatever the number of processors, with the same libraries on the same
    kind of machine. A switch changes only what it is about. `out` appears when it is complete.

    Args:
        out: Folder to make; it may exist if it is empty.
        config: What to record.
        progress: Told the frames written so far and their number.

    Raises:
        DatasetError: if `out` holds something already.
    """
    with complete_or_absent(Path(out)) as folder, _threads() as workers:
        studio = furnished_studio(
            config.width,
            config.height,
            config.seed,
            moving_object=config.moving_object,
            workers=workers,
            place=config.place,
        )
        record(studio, folder, config, workers, progress)


def record(
    studio: Studio,
    folder: Path,
    config: SynthConfig,
    workers: Executor,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Walk through a studio, made with the same size, seed, place and moving object, and write what the camera records.

    Args:
        studio: The place and its light.
        folder: Empty, and there already; the lists that make it readable are written last.
        config: What to record.
        workers: Threads to share the work.
        progress: Told the frames written so far and their number.
    """
    lost = sensor.dropped(config.frames, config.seed) if config.dropped_frames else np.zeros(config.frames, dtype=bool)
    frames = np.flatnonzero(~lost)
    seconds = np.arange(config.frames) / config.fps
    files = sequence_files(folder, config.layout, seconds[frames], masks=config.moving_object)
    write_mesh(folder / "mesh.ply", *studio.scene.static_mesh())
    take = _director(studio, config, frames, files)
    for done, _ in enumerate(workers.map(take, range(len(frames))), start=1):
        if progress:
            progress(done, len(frames))
    if config.exposure_jumps:
        files.write_gains(sensor.exposure_gains(config.frames, config.seed)[frames])
    files.write_index(studio.view, seconds, camera_poses(config, seconds), ~lost)


@contextmanager
def _threads() -> Iterator[Executor]:
    """One thread for each processor; what waits is forgotten when something goes wrong, Ctrl-C included."""
    workers = ThreadPoolExecutor(os.cpu_count())
    try:
        yield workers
    finally:
        workers.shutdown(wait=True, cancel_futures=True)


def camera_poses(config: SynthConfig, seconds: Array) -> Array:
    """The camera's exact poses `T_world_cam` [n, 4, 4] float64 at the given times [n] (seconds)."""
    return way.camera_poses(PLACES[config.place].walk, _progress(config, seconds), seconds, config.seed)


def _progress(config: SynthConfig, seconds: Array) -> Array:
    """Part of the walk at the given times: 0 at the first frame, 1 at the last."""
    return np.asarray(seconds * config.fps / (config.frames - 1))


def _director(studio: Studio, config: SynthConfig, frames: Array, files: SequenceFiles) -> Callable[[int], None]:
    """What takes and writes the recording's picture number k, which is frame `frames[k]` of the walk."""
    instants = _instants(config, studio.view.focal)
    seconds = ((frames[:, None] + instants) / config.fps).ravel()
    shape = (len(frames), len(instants), 4, 4)
    T_world_cam = camera_poses(config, seconds).reshape(shape)
    T_world_moved = way.person_motion(_progress(config, seconds), seconds, PERSON_AT).reshape(shape)
    gains = sensor.exposure_gains(config.frames, config.seed) if config.exposure_jumps else np.ones(config.frames)

    def take(k: int) -> None:
        shot = studio.shot(T_world_cam[k], T_world_moved[k])
        color = np.round(255 * np.clip(shot.color * gains[frames[k]], 0, 1)).astype(np.uint8)
        depth = _measured(shot, studio, config, int(frames[k])) if config.depth_noise else shot.depth
        files.write_frame(k, color, depth, shot.moving if config.moving_object else None)

    return take


def _instants(config: SynthConfig, focal: float) -> Array:
    """When, in frames around the time stamp, the pictures that make up one are taken: one for each pixel of smear."""
    if not config.motion_blur:
        return np.zeros(1)
    smear = _SHUTTER * focal * np.radians(PLACES[config.place].degrees / config.frames)
    half = int(np.clip(np.ceil(0.4 * smear), 2, 12))
    return np.arange(-half, half + 1) / (2 * half + 1) * _SHUTTER


def _measured(shot: Shot, studio: Studio, config: SynthConfig, frame: int) -> Array:
    rng = sensor.generator(config.seed, sensor.Effect.DEPTH, frame)
    return sensor.noisy_depth(shot.depth, shot.incidence, shot.shine, shot.color, studio.view.focal, rng)
