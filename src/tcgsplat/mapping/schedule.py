"""When to map, and when to begin a new submap."""

import math
from dataclasses import dataclass
from typing import Literal

from tcgsplat.errors import ConfigError
from tcgsplat.geometry import se3
from tcgsplat.scene.submap import Submap
from tcgsplat.tensors import Pose


@dataclass(frozen=True)
class ScheduleConfig:
    """Rhythm of mapping and size of submaps."""

    map_every: int = 6
    """Frames from one mapping update to the next; the first frame of a submap is always mapped. [base: Replica 5]"""
    map_lag: int = 6
    """Frames after which tracking uses what a mapping update made, while the update is worked on beside tracking; 0:
    at once, as the paper has it, with tracking waiting. No later than the next update begins. What is seeded in a
    submap that has been optimised is tracked against at once in any case, and a run's first map is waited for. [ours]
    """
    submap_by: Literal["motion", "interval"] = "motion"
    """What ends a submap: camera motion since its first frame, or a number of frames. [paper]"""
    submap_distance: float = 0.5
    """Metres from the submap's first camera that end it. [paper]"""
    submap_angle: float = 50.0
    """Degrees of rotation from the submap's first camera that end it. [paper] (the base system tests Euler angles)"""
    submap_interval: int = 50
    """Frames that end a submap, where it is ended by frames. [paper: ScanNet]"""
    withhold_every: int = 0
    """Frames whose index is a multiple of it are tracked and never mapped, so that the map can be judged by them; 0:
    none are kept back. A submap that has to begin with one is made of it all the same: the run's first. [ours]"""

    def __post_init__(self) -> None:
        for name in ("map_every", "submap_distance", "submap_angle", "submap_interval"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"schedule.{name} is {getattr(self, name)!r}; it must be above 0")
        if self.map_lag < 0:
            raise ConfigError(f"schedule.map_lag is {self.map_lag!r}; it must be at least 0")
        if self.withhold_every < 0 or self.withhold_every == 1:
            raise ConfigError(
                f"schedule.withhold_every is {self.withhold_every!r}; it must be at least 2, or 0 to withhold none"
            )
        if self.submap_by not in ("motion", "interval"):
            raise ConfigError(f"schedule.submap_by is {self.submap_by!r}; choose motion or interval")

    def withholds(self, frame_index: int) -> bool:
        """Whether a frame is kept back from mapping, for judging the map."""
        return self.withhold_every > 0 and frame_index % self.withhold_every == 0


@dataclass(frozen=True)
class Schedule:
    """Decisions on rhythm, from the submap and a count of frames."""

    config: ScheduleConfig

    def switches_submap(self, frame_index: int, T_map_cam: Pose, submap: Submap) -> bool:
        """Whether a frame tracked at `T_map_cam` begins a new submap. Before anything is mapped, none does, and a
        withheld one leaves it to the next, since a submap's first frame is mapped.
        """
        if not submap.keyframes or self.config.withholds(frame_index):
            return False
        if self.config.submap_by == "interval":
            return frame_index - submap.keyframes[0].frame.index >= self.config.submap_interval
        far = se3.translation_norm(T_map_cam) > self.config.submap_distance
        return far or math.degrees(se3.rotation_angle(T_map_cam)) > self.config.submap_angle

    def maps(self, frame_index: int, frames_since: int, submap: Submap) -> bool:
        """Whether a frame is mapped that comes so many frames after the last one that was; at once if all is gone.

        Counted are frames that were seen: where a live camera's are dropped, fewer are mapped as well. A withheld one
        is not mapped, unless there is no map at all without it.
        """
        if not submap.keyframes:
            return True
        due = len(submap) == 0 or self.due(frames_since)
        return due and not self.config.withholds(frame_index)

    def due(self, frames_since: int) -> bool:
        """Whether as many frames have come since the last one that was mapped as there are between two."""
        return frames_since >= self.config.map_every

    def adopts(self, frames_since: int) -> bool:
        """Whether tracking now uses what the mapping update made that began so many frames ago."""
        return frames_since >= self.config.map_lag
