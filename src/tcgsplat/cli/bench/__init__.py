"""`tcgsplat bench`: how long the stages take on this machine."""

from dataclasses import dataclass, field
from typing import Annotated

import tyro

from tcgsplat.cli.bench.render import Args as Render
from tcgsplat.cli.bench.render import command as time_rendering
from tcgsplat.cli.bench.track import Args as Track
from tcgsplat.cli.bench.track import command as time_tracking
from tcgsplat.cli.settings import Flags
from tcgsplat.cli.usage import UsageError


@dataclass(frozen=True)
class Args:
    """Time the rasterizer on random scenes, or the whole system on a recorded sequence."""

    what: tyro.conf.OmitSubcommandPrefixes[
        tyro.conf.OmitArgPrefixes[
            Annotated[Render, tyro.conf.subcommand("render")] | Annotated[Track, tyro.conf.subcommand("track")]
        ]
    ]
    settings: Flags = field(default_factory=dict)
    """Put here from the flags with a dot."""


def command(args: Args) -> int:
    """Print tables, and write the file that was asked for."""
    if isinstance(args.what, Track):
        return time_tracking(args.what, args.settings)
    if args.settings:
        raise UsageError(f"bench render has no settings, but --{next(iter(args.settings))} was given; leave it out")
    return time_rendering(args.what)
