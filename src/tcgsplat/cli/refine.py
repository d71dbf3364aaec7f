"""`tcgsplat refine`: optimise the map of a finished run further."""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class Args:
    """Optimise a run's map further over its keyframes, which hold their pictures: the recording is not needed.

    Poses and confidence stay; the map gets sharper. Every submap's file is replaced by the refined one when that is
    complete, so that Ctrl-C leaves a whole run. Every submap gets the same share of the time. How far --seconds
    gets depends on the machine; --steps gives the same bits every time. Score and export the run again afterwards.
    """

    run: tyro.conf.Positional[Path]
    """The run directory; its submaps are replaced."""
    seconds: float = 60.0
    """Of optimising, for all submaps together; reading and writing their files comes on top."""
    steps: int | None = None
    """So many optimisation steps a keyframe, instead of a time."""
    backend: str = "auto"
    """Rasterizer: auto, numba or reference."""


def command(args: Args) -> int:
    """Refine submap by submap, and say so."""
    import torch

    from tcgsplat.cli.kernels import compile_kernels
    from tcgsplat.cli.progress import counting, say
    from tcgsplat.cli.usage import UsageError
    from tcgsplat.config import from_toml
    from tcgsplat.mapping.refinement import for_seconds, for_steps, refined
    from tcgsplat.render.backends import open_rasterizer
    from tcgsplat.storage.run_directory import RunDirectory

    if not args.seconds > 0 or (args.steps is not None and args.steps < 1):
        raise UsageError("--seconds must be above 0, and --steps at least 1")
    run = RunDirectory.open(args.run)
    config = from_toml(run.config_toml)
    rasterizer = open_rasterizer(args.backend)  # type: ignore[arg-type]  # it checks the name
    torch.set_num_threads(1)  # as in a run: the kernels have threads of their own
    compile_kernels(config, rasterizer, lambda: say("compiling kernels, once per machine: some twenty seconds"))
    generator, submaps = torch.Generator().manual_seed(config.seed), run.submap_count
    with counting("submap") as tell:
        for index in range(submaps):
            tell(index, submaps)
            submap = run.load_submap(index)
            steps = None if args.steps is None else args.steps * len(submap.keyframes)
            progress = for_seconds(args.seconds / submaps) if steps is None else for_steps(steps)
            run.write_submap(refined(submap, config.mapper, config.confidence, rasterizer, generator, progress))
    effort = f"{args.seconds:g} s" if args.steps is None else f"{args.steps} steps a keyframe"
    sys.stdout.write(f"{submaps} submaps refined by {effort}: {run.path}\n")
    return 0
