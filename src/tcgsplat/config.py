"""All settings of a run, composed of each stage's own; text in TOML, in and out."""

from dataclasses import dataclass, field

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.mapping.mapper import MapperConfig
from tcgsplat.mapping.schedule import ScheduleConfig
from tcgsplat.tracking.tracker import TrackerConfig


@dataclass(frozen=True)
class SlamConfig:
    """Everything that a run's result depends on, besides its input."""

    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    mapper: MapperConfig = field(default_factory=MapperConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    confidence: ConfidenceConfig = field(default_factory=ConfidenceConfig)
    seed: int = 0
    """Of the one random generator."""
