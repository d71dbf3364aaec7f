"""From a configuration to a recorded sequence on disk."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

from tcgsplat.datasets.synthetic import path as way
from tcgsplat.datasets.synthetic import sensor
from tcgsplat.datasets.synthetic.apartment import PERSON_AT
from tcgsplat.datasets.synthetic.free import free_poses
from tcgsplat.datasets.synthetic.places import PLACES, Name
from tcgsplat.datasets.synthetic.raster import View
from tcgsplat.datasets.synthetic.studio import Shot, Studio, furnished_studio
from tcgsplat.datasets.synthetic.timetable import Timetable
from tcgsplat.datasets.synthetic.writer import SequenceFiles, complete_or_absent, sequence_files, write_mesh
from tcgsplat.datasets.truth import Event, Region
from tcgsplat.errors import ConfigError

Array = np.ndarray[Any, np.dtype[Any]]

_SHUTTER = 0.5
"""Part of the time from frame to frame in which the shutter is open, for motion blur."""


@dataclass(frozen=True)
class SynthConfig:
    """A walk through a furnished apartment of two rooms and back, as an RGB-D camera records it."""

    frames: int = 600
    """Number of frames for the whole walk, but for a rest (`still`). With fewer the camera moves faster; below 200
    (`twins`: 410) tracking may get lost. For a short run keep the walk, and take its beginning: `run --limit`."""
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
    depth_noise_scale: float = 1.0
    """Factor on the spread of noisy depth (unitless); holes, edges and steps stay what they are."""
    depth_bias: float = 0.0
    """Part by which a region reads too far: 0.03 is 3 %. In the apartment the wall around the kitchen's window, which
    is in sight for 110 frames of 600 before and for 100 after; right in the first 45 % of the walk, then wrong to its
    end (`twins`: the hall's north end, from 32 % on). `truth/fault/` says where."""
    exposure_jumps: bool = False
    """Brightness jumps now and then; `exposure.txt` gives the factor on each frame's pixel values (unitless)."""
    motion_blur: bool = False
    """Colour is the mean over an exposure of half a frame's time (s), centred on the time stamp."""
    moving_object: bool = False
    """Somebody strolls about the living room; `mask/` says where (255) in each frame. Not part of `mesh.ply`."""
    dropped_frames: bool = False
    """Runs of 2 to 7 frames are missing, about one run in 100 frames."""
    still: int = 0
    """Frames that the camera stands still for in the middle of its walk, far from where it began. They come on top of
    the walk's own, as do up to 20 in which it slows and starts."""
    free_views: int = 40
    """Exact views beside the walk, in `free/`; the same ones whatever is done to the recording."""

    def __post_init__(self) -> None:
        if self.frames < 2:
            raise ConfigError(f"frames = {self.frames}: a walk needs at least 2 frames")
        if min(self.width, self.height) < 16:
            raise ConfigError(f"width = {self.width}, height = {self.height}: images need at least 16 by 16 pixels")
        if not 0 < self.fps < float("inf"):
            raise ConfigError(f"fps = {self.fps}: frames per second must be positive")
        if not 0 <= self.depth_noise_scale < float("inf"):
            raise ConfigError(f"depth_noise_scale = {self.depth_noise_scale}: give a factor from 0 on")
        if self.depth_noise_scale != 1 and not self.depth_noise:
            raise ConfigError(f"depth_noise_scale = {self.depth_noise_scale}: there is no noise without depth_noise")
        if not -0.5 <= self.depth_bias <= 0.5:
            raise ConfigError(f"depth_bias = {self.depth_bias}: give a part of the depth, from -0.5 to 0.5")
        if min(self.still, self.free_views) < 0:
            raise ConfigError(f"still = {self.still}, free_views = {self.free_views}: give numbers from 0 on")
        if self.seed < 0:
            raise ConfigError(f"seed = {self.seed}: give a number from 0 on")
        if self.place not in PLACES:
            raise ConfigError(f"place = {self.place!r}: give 'apartment' or 'twins'")
        if self.layout not in ("tum", "replica"):
            raise ConfigError(f"layout = {self.layout!r}: give 'tum' or 'replica'")

    @property
    def timetable(self) -> Timetable:
        """Which frame of the walk each recorded one is."""
        return Timetable(self.frames, self.still)

    @property
    def written(self) -> tuple[str, ...]:
        """Folders that it has besides the recording's own: what they hold is there for every frame or for none."""
        wrong = self.moving_object or self.depth_bias != 0
        folders = {
            "mask": self.moving_object,
            "truth/fault": wrong,
            "truth/depth": wrong or self.depth_noise,
            "free/color": self.free_views > 0,
            "free/depth": self.free_views > 0,
        }
        return tuple(folder for folder, needed in folders.items() if needed)


def synthesize(out: Path, config: SynthConfig, progress: Callable[[int, int], None] | None = None) -> None:
    """Write a synthetic RGB-D sequence with exact poses, exact depth and the exact mesh.

    What is true of frames that are not exact, and views beside the walk, are written for `datasets.truth` to read.
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
    shown = config.timetable.shown()
    dropped = sensor.dropped(config.frames, config.seed) & config.dropped_frames
    lost = (shown >= 0) & dropped[shown]
    frames = np.flatnonzero(~lost)
    seconds = np.arange(len(shown)) / config.fps
    gains = _gains(config)
    files = sequence_files(folder, config.layout, seconds[frames], config.written)
    write_mesh(folder / "mesh.ply", *studio.scene.static_mesh())
    take = _director(studio, config, frames, gains, files)
    takes: list[Take] = []
    for done, seen in enumerate(workers.map(take, range(len(frames))), start=1):
        takes.append(seen)
        if progress:
            progress(done, len(frames))
    if config.exposure_jumps:
        files.write_gains(gains[frames])
    if config.free_views:
        _record_free_views(studio, config, files, workers)
    files.write_events(_events(config, frames, gains[frames], takes))
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
    """The camera's exact poses `T_world_cam` [n, 4, 4] float64 at the given times [n] (seconds) of the recording."""
    walked = _walked(config, seconds)
    return way.camera_poses(PLACES[config.place].walk, _progress(config, walked), walked, config.seed)


class Step(NamedTuple):
    """How far the camera moves from one frame to the next."""

    metres: float
    degrees: float


def greatest_step(config: SynthConfig) -> Step:
    """The longest way and the widest turn between two frames, none of which got lost."""
    T = camera_poses(config, np.arange(config.timetable.recorded) / config.fps)
    moved = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    cosines = (np.einsum("nij,nij->n", T[:-1, :3, :3], T[1:, :3, :3]) - 1) / 2
    return Step(float(moved.max()), float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).max()))


def _walked(config: SynthConfig, seconds: Array) -> Array:
    """Seconds of the walk at the given times of the recording."""
    # To a billionth of a frame, so that a frame after the rest is at the very instant that it is at without one.
    moments = np.round(seconds * config.fps, 9)
    return np.asarray((moments - config.timetable.behind(moments)) / config.fps)


def _progress(config: SynthConfig, walked: Array) -> Array:
    """Part of the walk at the given seconds of it: 0 at the first frame, 1 at the last."""
    return np.asarray(walked * config.fps / (config.frames - 1))


def _gains(config: SynthConfig) -> Array:
    """Factor on the displayed colour of each frame, those that get lost included."""
    shown = config.timetable.shown()
    if not config.exposure_jumps:
        return np.ones(len(shown))
    before_rest = np.maximum.accumulate(np.where(shown < 0, 0, shown))
    return sensor.exposure_gains(config.frames, config.seed)[before_rest]


class Take(NamedTuple):
    """What is in one picture."""

    somebody: bool
    first_seen: bool
    """A hundredth of it, at least, shows what the first frame looks at, as nobody were in the way."""


def _director(
    studio: Studio, config: SynthConfig, frames: Array, gains: Array, files: SequenceFiles
) -> Callable[[int], Take]:
    """What takes and writes the recording's picture number k, which is its frame `frames[k]` before any gets lost."""
    instants = _instants(config, studio.view.focal)
    seconds = ((frames[:, None] + instants) / config.fps).ravel()
    walked = _walked(config, seconds)
    shape = (len(frames), len(instants), 4, 4)
    T_world_cam = camera_poses(config, seconds).reshape(shape)
    T_world_moved = way.person_motion(_progress(config, walked), walked, PERSON_AT).reshape(shape)
    place, view, written = PLACES[config.place], studio.view, config.written
    shown = config.timetable.shown()
    biased = (_progress(config, _walked(config, frames / config.fps)) >= place.biased_from) & (config.depth_bias != 0)

    def take(k: int) -> Take:
        shot = studio.shot(T_world_cam[k], T_world_moved[k])
        T = T_world_cam[k, len(instants) // 2]
        color = np.round(255 * np.clip(shot.color * gains[frames[k]], 0, 1)).astype(np.uint8)
        # The frames around a rest have noise of their own.
        number = int(shown[frames[k]]) if shown[frames[k]] >= 0 else config.frames + int(frames[k])
        depth = _measured(shot, studio, config, number) if config.depth_noise else shot.depth
        wrong = shot.moving
        if biased[k]:
            region = _inside(place.biased, shot.depth, T, view) & ~shot.moving
            depth, wrong = np.where(region, (1 + config.depth_bias) * depth, depth), wrong | region
        files.write_frame(k, color, depth, shot.moving if config.moving_object else None)
        somebody = bool(shot.moving.any())
        true = _depth(studio, T) if somebody else shot.depth
        files.write_truth(k, true if "truth/depth" in written else None, wrong if "truth/fault" in written else None)
        return Take(somebody, bool(_inside(place.first_seen, true, T, view, every=4).mean() >= 0.01))

    return take


def _depth(studio: Studio, T_world_cam: Array) -> Array:
    """Depth [h, w], metres, of what stands still."""
    inverse = studio.inverse_depth(T_world_cam)
    return np.divide(1.0, inverse, out=np.zeros_like(inverse), where=inverse > 0)


def _inside(region: Region, depth: Array, T_world_cam: Array, view: View, every: int = 1) -> Array:
    """Whether the point that each pixel shows is in the region, for every so many-th pixel across and down."""
    z = depth[::every, ::every]
    v, u = np.meshgrid(np.arange(0, view.height, every), np.arange(0, view.width, every), indexing="ij")
    rays = np.stack(((u - view.cx) / view.focal, (v - view.cy) / view.focal, np.ones_like(z)), axis=-1)
    points = (rays * z[..., None]) @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    return np.asarray(region.contains(torch.from_numpy(points)).numpy() & (z > 0))


def _record_free_views(studio: Studio, config: SynthConfig, files: SequenceFiles, workers: Executor) -> None:
    """Choose and write the views beside the walk, as a clean recording would have it: no rest, nobody in the way."""
    walk = camera_poses(replace(config, still=0), np.arange(config.frames) / config.fps)
    poses = free_poses(studio, walk, config.free_views, config.seed, workers)
    empty = studio.emptied()

    def take(k: int) -> None:
        shot = empty.shot(poses[k][None], np.eye(4)[None])
        files.write_free_view(k, np.round(255 * np.clip(shot.color, 0, 1)).astype(np.uint8), shot.depth)

    for _ in workers.map(take, range(len(poses))):
        pass
    files.write_free_poses(studio.view, poses)


def _events(config: SynthConfig, frames: Array, gains: Array, takes: list[Take]) -> Iterator[Event]:
    """What happens to the recorded frames, which were `frames` [n] before some got lost, and have `gains` [n]."""
    place = PLACES[config.place]
    jumps: list[int] = (np.flatnonzero(np.diff(gains)) + 1).tolist()
    for first, following in pairwise([*jumps, len(frames)]):
        yield Event("exposure jump", first, following - 1)
    gaps: list[int] = (np.flatnonzero(np.diff(frames) > 1) + 1).tolist()
    for index in gaps:
        yield Event("dropped frames", index, index)
    for first, last in _runs(np.isin(frames, config.timetable.standing)):
        yield Event("still camera", first, last)
    for first, last in _runs(np.array([seen.somebody for seen in takes])):
        yield Event("moving object", first, last)
    for first, last in _runs(~np.array([seen.first_seen for seen in takes])):
        yield Event("absence", first, last, place.first_seen)
    if config.depth_bias:
        first = int(np.argmax(_progress(config, _walked(config, frames / config.fps)) >= place.biased_from))
        yield Event("depth bias", first, len(frames) - 1, place.biased)


def _runs(flags: Array) -> Iterator[tuple[int, int]]:
    """First and last index of each run of flags [n]."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], flags.astype(int), [0]))))
    yield from zip(edges[::2].tolist(), (edges[1::2] - 1).tolist(), strict=True)


def _instants(config: SynthConfig, focal: float) -> Array:
    """When, in frames around the time stamp, the pictures that make up one are taken: one for each pixel of smear."""
    if not config.motion_blur:
        return np.zeros(1)
    smear = _SHUTTER * focal * np.radians(PLACES[config.place].degrees / config.frames)
    half = int(np.clip(np.ceil(0.4 * smear), 2, 12))
    return np.arange(-half, half + 1) / (2 * half + 1) * _SHUTTER


def _measured(shot: Shot, studio: Studio, config: SynthConfig, frame: int) -> Array:
    rng = sensor.generator(config.seed, sensor.Effect.DEPTH, frame)
    return sensor.noisy_depth(
        shot.depth, shot.incidence, shot.shine, shot.color, studio.view.focal, rng, config.depth_noise_scale
    )
