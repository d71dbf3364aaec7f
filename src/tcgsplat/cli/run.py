"""`tcgsplat run`: a recorded sequence in, a run directory out."""

import sys
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from tcgsplat.cli.flags import Flags
from tcgsplat.cli.usage import UsageError


@dataclass(frozen=True)
class Args:
    """Map a recorded RGB-D sequence; TUM RGB-D, Replica, ScanNet and plain folders are recognised by themselves.

    Every setting is a flag too, e.g. --mapper.iterations 20 --tracker.solver descent --confidence.guide-mapping false;
    all are listed by `tcgsplat presets default`. A flag counts more than the file, the file more than the preset.
    Ctrl-C ends the run after the current frame and saves what there is.

    With --realtime you see whether this machine keeps up with the camera. While a frame is worked on, newer ones
    replace older ones; those replaced are counted, and missing in the trajectory. How many that are depends on how fast
    the machine is at the moment, so the results of two such runs differ.
    """

    folder: tyro.conf.Positional[Path]
    """The sequence."""
    out: Path | None = None
    """The run directory; runs/NAME if left out, with the name of the folder."""
    preset: str = "default"
    """Where the settings start from: see `tcgsplat presets`."""
    config: Path | None = None
    """A TOML file of settings, such as the config.toml of another run."""
    start: int = 0
    """First frame, counted from 0."""
    stride: int = 1
    """Use every so many-th frame."""
    limit: int | None = None
    """Use no more than so many frames."""
    backend: str = "auto"
    """Rasterizer: auto, numba, reference, cuda or gsplat."""
    max_gpu_memory: float | None = None
    """GB that may be taken of the GPU, as far as it can be planned: older pictures wait in the CPU's memory, then the
    least useful Gaussians go. The same as --mapper.max-gpu-memory."""
    seed: int | None = None
    """Of all randomness; that of the preset if left out."""
    realtime: bool = False
    """Play it by its time stamps, as a live camera: frames that come while the system is busy are dropped."""
    resume: bool = False
    """Go on with a run that was interrupted or killed, after its last complete submap, with the same command but for
    this flag; what comes out is the same as without the interruption. Where there is no run yet, one begins."""
    overwrite: bool = False
    """Replace the run directory if there is a run in it."""
    settings: Flags = field(default_factory=dict)
    """Put here from the flags with a dot."""


def command(args: Args) -> int:
    """Run, and say in one line what came of it."""
    if args.resume and (args.overwrite or args.realtime):
        raise UsageError("--resume goes with neither --overwrite nor --realtime, which repeats nothing; leave one out")
    if args.max_gpu_memory is not None and not args.max_gpu_memory > 0:
        raise UsageError(f"--max-gpu-memory is {args.max_gpu_memory:g}; give the GB that may be taken, above 0")
    from tcgsplat.cli.ahead import compiled_meanwhile
    from tcgsplat.cli.logs import say

    with compiled_meanwhile() as waited:
        from tcgsplat.cli.recorder import Part, begin, recorded, resume
        from tcgsplat.cli.settings import resolved
        from tcgsplat.render.backends import open_rasterizer

        limit = {} if args.max_gpu_memory is None else {"mapper.max_gpu_memory": repr(args.max_gpu_memory)}
        config = resolved(args.preset, args.config, {**args.settings, **limit}, args.seed)
        part = Part(args.start, args.stride, args.limit)
        sequence = part.open(args.folder)
        rasterizer = open_rasterizer(args.backend)  # type: ignore[arg-type]  # it checks the name
        say(f"drawing with {rasterizer.name} on {rasterizer.device}")
        out = args.out or Path("runs") / sequence.name
        if args.resume and (out / "run.json").exists():
            run = resume(out, config, args.folder, part, backend=rasterizer.name)
        else:
            about = (out, config, args.folder, part)
            run = begin(*about, overwrite=args.overwrite, backend=rasterizer.name, realtime=args.realtime)
    summary = recorded(sequence, config, rasterizer, run, args.preset, realtime=args.realtime, waited=waited.seconds)
    if summary.interrupted:
        sys.stderr.write(f"tcgsplat: stopped; saved {summary}: {run.path}\n")
        return 130
    sys.stdout.write(f"{summary}: {run.path}\n")
    return 0
