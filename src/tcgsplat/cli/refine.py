"""`tcgsplat refine`: all submaps of a run as one map, optimised over all keyframes."""

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import tyro


@dataclass(frozen=True)
class Args:
    """Merge a run's submaps into one map, and optimise it over the keyframes of all of them.

    The keyframes hold their pictures: the recording is not needed. Poses and confidence stay; the map gets sharper. It
    is written to map.npz in the run directory, which `eval` scores and `export` writes; the submaps stay as they are,
    and another `refine` begins with them again and replaces it. How far --seconds gets depends on the machine; --steps
    gives the same bits every time. Ctrl-C ends it early and keeps what is refined so far; a second one leaves the run
    as it was.
    """

    run: tyro.conf.Positional[Path]
    """The run directory."""
    seconds: float = 60.0
    """Of optimising; merging, which takes about a second for every ten keyframes, comes on top."""
    steps: int | None = None
    """So many optimisation steps a keyframe, instead of a time."""
    backend: str = "auto"
    """Rasterizer: auto, numba, reference, cuda or gsplat."""


def command(args: Args) -> int:
    """Merge, refine, write, and say so."""
    import torch

    from tcgsplat.cli.interrupt import stopping_on_interrupt
    from tcgsplat.cli.kernels import compile_kernels
    from tcgsplat.cli.logs import say
    from tcgsplat.cli.progress import counting
    from tcgsplat.cli.usage import UsageError
    from tcgsplat.config import from_toml
    from tcgsplat.mapping.refinement import for_seconds, for_steps, refined
    from tcgsplat.render.backends import open_rasterizer
    from tcgsplat.storage.run_directory import RunDirectory
    from tcgsplat.storage.world_map import newly_merged

    if not args.seconds > 0 or (args.steps is not None and args.steps < 1):
        raise UsageError("--seconds must be above 0, and --steps at least 1")
    run = RunDirectory.open(args.run)
    config = from_toml(run.config_toml)
    rasterizer = open_rasterizer(args.backend)  # type: ignore[arg-type]  # it checks the name
    torch.set_num_threads(1)  # as in a run: the kernels have threads of their own
    compile_kernels(config, rasterizer)
    say(f"merging {run.submap_count} submaps")
    merged = newly_merged(run, rasterizer)
    sys.stdout.write(f"{len(merged.T_world_map)} submaps merged: {len(merged.submap)} Gaussians\n")
    sys.stdout.flush()
    keyframes = len(merged.submap.keyframes)
    done = for_seconds(args.seconds) if args.steps is None else for_steps(args.steps * keyframes)
    with (
        counting("refined, %:") as tell,
        stopping_on_interrupt("stopping; Ctrl-C again to leave the run as it was") as stop,
    ):
        effort = _Effort(done, stop.is_set, tell)
        generator = torch.Generator().manual_seed(config.seed)
        submap = refined(merged.submap, config.mapper, config.confidence, rasterizer, generator, effort)
    run.write_map(replace(merged, submap=submap, steps=effort.steps))
    sys.stdout.write(
        f"{len(submap)} Gaussians refined by {effort.steps} steps over {keyframes} keyframes: {run.path / 'map.npz'}\n"
    )
    return 130 if stop.is_set() else 0


class _Effort:
    """Progress of `refined` that can be stopped, is shown in percent, and counts the steps."""

    def __init__(
        self, done: Callable[[int], float], stopped: Callable[[], bool], tell: Callable[[int, int], None]
    ) -> None:
        self._done, self._stopped, self._tell = done, stopped, tell
        self.steps = 0

    def __call__(self, steps: int) -> float:
        self.steps = steps
        share = 1.0 if self._stopped() else self._done(steps)
        self._tell(min(round(100 * share), 100), 100)
        return share
