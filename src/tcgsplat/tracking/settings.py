"""What tracking can be told."""

from dataclasses import dataclass, field
from typing import Literal

from tcgsplat.errors import ConfigError
from tcgsplat.tracking.descent import DescentConfig


@dataclass(frozen=True)
class AlignmentConfig:
    """Constants of the solver. [ours]: measured on six sequences (design/tracking-recipe.md)."""

    iterations: tuple[int, ...] = (5, 3, 3)
    """Passes a level, finest first: full, half, quarter resolution; images more than 320 pixels wide get further
    levels with the passes of the last. [ours]"""
    stride: int = 3
    """Every how many pixels a point is taken where a level is more than 200 pixels wide; else all are. [ours]"""
    depth_weight: float = 0.7
    """Geometry over colour, after each has been divided by its own spread. [ours]"""
    min_alpha: float = 0.7
    """Rendered pixels below this coverage give no point. [ours]"""
    gate: float = 0.05
    """Metres, times (1 + z/2): depth that disagrees by more is another surface; doubled at coarse levels. [ours]"""
    sigma_floor: float = 0.0017
    """Depth noise at 0.4 m, metres: a structured-light sensor's (Nguyen et al. 2012) and some for the map. [ours]"""
    sigma_slope: float = 0.0019
    """Growth of depth noise with the square of the distance beyond 0.4 m, 1/metre. [ours]"""

    def __post_init__(self) -> None:
        if not self.iterations or min(self.iterations) < 0 or sum(self.iterations) == 0:
            raise ConfigError(
                f"tracker.alignment.iterations is {self.iterations!r}; give passes for every level, finest first, "
                "such as [3, 2, 3]"
            )
        if self.stride < 1:
            raise ConfigError(f"tracker.alignment.stride is {self.stride!r}; it must be at least 1")
        for name in ("gate", "sigma_floor"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"tracker.alignment.{name} is {getattr(self, name)!r}; it must be above 0 metres")
        for name in ("depth_weight", "sigma_slope"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"tracker.alignment.{name} is {getattr(self, name)!r}; it must be at least 0")


@dataclass(frozen=True)
class TrackerConfig:
    """Which solver, and when its answer is not believed."""

    solver: Literal["alignment", "descent"] = "alignment"
    """`alignment`: Gauss-Newton against one render; `descent`: the paper's Adam through the rasterizer. [ours]"""
    synchronization: Literal["none", "stamps", "learnt"] = "learnt"
    """What is done about the time between colour and depth: nothing; the depth image is moved to the instant of the
    colour image by the camera's velocity; so, and what the time stamps conceal is learnt from the motion. [ours]"""
    smoothing: bool = True
    """Whether depth is smoothed within its surfaces before anything else is done with it: a sensor that rounds makes
    the camera seem to move too little. [ours]"""
    exposure: bool = True
    """Whether the map keeps one brightness and every picture its exposure beside it, as `alignment` finds it; else
    pictures are mapped as they come. [ours]"""
    view_distance: float = 0.02
    """`alignment`: metres between a frame's guess and where the map was rendered, up to which it is aligned to that
    view. Half as far again changed no trajectory by a tenth; from 5 cm and degrees on, frames were lost. [ours]"""
    view_angle: float = 2.0
    """`alignment`: the same, degrees. [ours]"""
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    descent: DescentConfig = field(default_factory=DescentConfig)
    max_step: float = 0.3
    """Metres from the guess; a hand at 30 Hz misses a constant-velocity guess by centimetres. [ours]"""
    max_turn: float = 30.0
    """Degrees from the guess. [ours]"""
    min_overlap: float = 0.1
    """Share of the rendered view that must fall into the live image. [ours]"""
    min_agreement: float = 0.3
    """Share of the overlap whose depth must agree with the map within the gate: a camera at a wrong place agrees by
    chance on a few surfaces, a tracked one on most, even with something moving through the picture. [ours]"""
    min_correlation: float = 0.6
    """Between the colours of the picture and of the map, whatever the exposure: a covered lens, a flash and noise
    correlate with nothing, where the depth may still agree or be missing. Real frames: 0.92 and more. [ours]"""

    def __post_init__(self) -> None:
        if self.solver not in ("alignment", "descent"):
            raise ConfigError(f"tracker.solver is {self.solver!r}; choose alignment or descent")
        if self.synchronization not in ("none", "stamps", "learnt"):
            raise ConfigError(f"tracker.synchronization is {self.synchronization!r}; choose none, stamps or learnt")
        for name in ("max_step", "max_turn"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"tracker.{name} is {getattr(self, name)!r}; it must be above 0")
        for name in ("view_distance", "view_angle"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"tracker.{name} is {getattr(self, name)!r}; it must be at least 0")
