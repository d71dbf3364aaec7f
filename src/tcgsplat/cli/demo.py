"""`tcgsplat demo`: from nothing to a mapped apartment, without any download."""

import shutil
import sys
from dataclasses import dataclass, field
from pathlib import Path

from tcgsplat.cli.flags import Flags
from tcgsplat.errors import ArchiveError


@dataclass(frozen=True)
class Args:
    """Make a synthetic apartment, map it, score the result against the exact truth, and make pictures of it.

    Any setting is a flag, as for `tcgsplat run`.
    """

    out: Path = Path("demo")
    """Folder to make: the data goes to its sequence/, everything else to its run/."""
    preset: str = "default"
    """Where the settings start from."""
    frames: int = 600
    """Of the whole walk; with fewer of them the camera moves faster, and below 200 tracking may get lost."""
    width: int = 320
    """Pixels across; the height is three quarters of it."""
    backend: str = "auto"
    """Rasterizer: auto, numba, reference, cuda or gsplat."""
    overwrite: bool = False
    """Make the demo anew where there is one."""
    settings: Flags = field(default_factory=dict)
    """Put here from the flags with a dot."""


def command(args: Args) -> int:
    """All of it, ending with a few lines on how it went and where everything is."""
    from tcgsplat.cli.ahead import compiled_meanwhile
    from tcgsplat.cli.logs import say

    with compiled_meanwhile() as waited:
        from tcgsplat.cli.progress import counting
        from tcgsplat.cli.recorder import Part, begin, recorded
        from tcgsplat.cli.scoring import scored
        from tcgsplat.cli.settings import resolved
        from tcgsplat.cli.synth import warn_of_speed
        from tcgsplat.datasets.synthetic import SynthConfig, synthesize
        from tcgsplat.render.backends import open_rasterizer
        from tcgsplat.storage.ply import write_gaussians
        from tcgsplat.storage.world_map import world_map

        config = resolved(args.preset, None, args.settings, None)
        rasterizer = open_rasterizer(args.backend)  # type: ignore[arg-type]  # it checks the name
        make_way(args.out, overwrite=args.overwrite)
    walk = SynthConfig(args.frames, args.width, 3 * args.width // 4)
    warn_of_speed(walk)
    data = args.out / "sequence"
    say(f"making the apartment: {data}")
    with counting("frame") as progress:
        synthesize(data, walk, progress)
    sequence = Part().open(data)
    run = begin(args.out / "run", config, data, Part(), overwrite=False)
    summary = recorded(sequence, config, rasterizer, run, args.preset, waited=waited.seconds)
    if summary.interrupted:
        sys.stderr.write(f"tcgsplat: stopped; saved {summary}: {run.path}\n")
        return 130
    report = scored(run, sequence, rasterizer)
    whole = world_map(run, rasterizer).submap
    write_gaussians(run.path / "map.ply", whole.gaussians, whole.confidence.value)
    cost = f"{summary}; kernels compiled in {summary.seconds_compiling:.1f} s before"
    sys.stdout.write(_told(run.path, report.figures(), cost))
    return 0


def make_way(out: Path, *, overwrite: bool) -> None:
    """Make way for a new demo; only what a demo has made is ever deleted.

    Raises:
        ArchiveError: if there is something that is not a demo, or that may not be replaced.
    """
    from tcgsplat.storage.run_directory import RunDirectory

    inside = {path.name for path in out.iterdir()} if out.is_dir() else {out.name} if out.exists() else set()
    if not inside:
        return
    if not overwrite:
        raise ArchiveError(f"{out} exists; choose another folder by --out, or make it anew by --overwrite")
    if not inside <= {"sequence", "run"} or not (out / "sequence" / "mesh.ply").is_file():
        raise ArchiveError(f"{out} holds more than a demo; choose another folder by --out")
    if "run" in inside:
        shutil.rmtree(RunDirectory.open(out / "run").path)
    shutil.rmtree(out / "sequence")


def _told(folder: Path, figures: str, cost: str) -> str:
    files = {
        "contact_sheet.png": "what the camera saw, the map's picture, depth and confidence",
        "trajectory.png": "the estimated path beside the true one",
        "map.ply": "the Gaussians, for any viewer of 3D Gaussian splatting",
        "report.json": "the figures above, and what was evaluated",
    }
    paths = "\n".join(f"  {folder / name}  {what}" for name, what in files.items())
    return f"A synthetic apartment without sensor noise: {cost}.\n\n{figures}\n\n{paths}\n"
