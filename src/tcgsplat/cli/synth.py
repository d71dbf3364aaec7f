"""`tcgsplat synth`: the synthetic apartment as an RGB-D folder."""

import sys
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from tcgsplat.cli.progress import counting
from tcgsplat.datasets.synthetic import SynthConfig, synthesize


@dataclass(frozen=True)
class Args:
    """Ray-cast a furnished apartment along a hand-held walk, with exact depth, poses and mesh."""

    out: tyro.conf.Positional[Path]
    """Folder to make."""
    config: tyro.conf.OmitArgPrefixes[SynthConfig] = field(default_factory=SynthConfig)


def command(args: Args) -> int:
    """Write the sequence, and say where it is."""
    with counting("frame") as progress:
        synthesize(args.out, args.config, progress)
    sys.stdout.write(f"{args.config.timetable.recorded} frames, {args.config.width}x{args.config.height}: {args.out}\n")
    return 0
