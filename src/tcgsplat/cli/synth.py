"""`tcgsplat synth`: the synthetic apartment as an RGB-D folder."""

import logging
import sys
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path

import tyro

from tcgsplat.cli.progress import counting
from tcgsplat.datasets.synthetic import Step, SynthConfig, greatest_step, synthesize

logger = logging.getLogger(__name__)

_METRES, _DEGREES = 0.06, 5.0
"""Most that a hand does from frame to frame at 30 Hz. Measured in the apartment, whose default walk has 2 cm and 1.4
degrees at most: with 150 frames (7.4 cm, 5.5 degrees) no frame was lost, with 100 (11 cm, 8 degrees) 77 were."""


@dataclass(frozen=True)
class Args:
    """Ray-cast a furnished apartment along a hand-held walk, with exact depth, poses and mesh."""

    out: tyro.conf.Positional[Path]
    """Folder to make."""
    config: tyro.conf.OmitArgPrefixes[SynthConfig] = field(default_factory=SynthConfig)


def command(args: Args) -> int:
    """Write the sequence, and say where it is."""
    warn_of_speed(args.config)
    with counting("frame") as progress:
        synthesize(args.out, args.config, progress)
    sys.stdout.write(f"{args.config.timetable.recorded} frames, {args.config.width}x{args.config.height}: {args.out}\n")
    return 0


def warn_of_speed(config: SynthConfig) -> None:
    """Say it, and what to do, if the camera moves too fast from frame to frame for being tracked with certainty."""
    step = greatest_step(config)
    if _too_fast(step):
        more = count(10 * (config.frames // 10 + 1), 10)
        enough = next(frames for frames in more if not _too_fast(greatest_step(replace(config, frames=frames))))
        logger.warning(
            "with %d frames for the whole walk the camera moves by up to %.0f cm and %.0f degrees a frame, faster than "
            "a hand, and tracking may get lost; give --frames %d or more, and for a short run take the first of them "
            "by `tcgsplat run --limit %d`",
            config.frames,
            100 * step.metres,
            step.degrees,
            enough,
            config.frames,
        )


def _too_fast(step: Step) -> bool:
    return step.metres > _METRES or step.degrees > _DEGREES
