"""`tcgsplat localize`: where in a finished map pictures were taken."""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from tcgsplat.cli.usage import UsageError


@dataclass(frozen=True)
class Args:
    """Find where in the map of a finished run pictures were taken, each by itself.

    IMAGES is a recorded RGB-D sequence, or pictures of the camera that made the run: files, or a folder of them. These
    must be as large as the run's pictures and without lens distortion. Depth makes it more certain, but is not needed.
    A picture is looked up by its features and then aligned to the map; where the two do not agree it counts as not
    found, rather than a pose being made up: so do pictures of what the run did not see.

    One line for each picture says where its camera was, in metres from where the run's first frame was taken. The
    poses go to localized.txt in the run directory: camera to world in the TUM format, in the same world as
    trajectory.txt, under the time stamps of a sequence, or 0, 1, 2, ... in the order of pictures. Pictures that were
    not found are missing in it. Ctrl-C ends it after the current picture and saves the poses found so far.
    """

    run: tyro.conf.Positional[Path]
    """The run directory."""
    images: tyro.conf.Positional[tuple[Path, ...]]
    """A sequence's folder, a folder of pictures, or pictures."""
    start: int = 0
    """First frame or picture, counted from 0."""
    stride: int = 1
    """Use every so many-th one."""
    limit: int | None = None
    """Use no more than so many."""
    out: Path | None = None
    """File to write the poses to; localized.txt in the run directory if left out."""
    overwrite: bool = False
    """Replace the file if it is there."""
    backend: str = "auto"
    """Rasterizer: auto, numba, reference, cuda or gsplat."""


def command(args: Args) -> int:
    """One line for each picture, and the file of the poses."""
    import torch

    from tcgsplat.cli.interrupt import stopping_on_interrupt
    from tcgsplat.cli.kernels import compile_kernels
    from tcgsplat.cli.pictures import frames_of, relocalizer
    from tcgsplat.config import from_toml
    from tcgsplat.render.backends import open_rasterizer
    from tcgsplat.scene.trajectory import format_tum
    from tcgsplat.storage import atomic
    from tcgsplat.storage.run_directory import RunDirectory

    run = RunDirectory.open(args.run)
    if not args.images:
        raise UsageError("give IMAGES too: a sequence's folder, a folder of pictures, or pictures")
    out = args.out or run.path / "localized.txt"
    if out.is_dir() or not out.parent.is_dir():
        raise UsageError(f"--out {out} cannot be written: give the name of a file, in a folder that is there")
    if out.exists() and not args.overwrite:
        raise UsageError(f"{out} exists; choose another file by --out, or replace it by --overwrite")
    rasterizer = open_rasterizer(args.backend)  # type: ignore[arg-type]  # it checks the name
    frames = frames_of(run, args.images, args.start, args.stride, args.limit)
    torch.set_num_threads(1)  # as in a run: the kernels have threads of their own
    config = from_toml(run.config_toml)
    compile_kernels(config, rasterizer)
    known, (_, atlas) = relocalizer(run, rasterizer), run.trajectory()
    stamps, poses, total = [], [], 0
    try:
        with stopping_on_interrupt() as stop:
            for name, frame in frames:
                total += 1
                found = known.relocalized(frame, atlas.T_world_map)
                if found is None:
                    sys.stdout.write(f"{name}: not found\n")
                else:
                    T_world_cam = atlas.T_world_map[found.reference.index] @ found.tracked.T_map_cam
                    x, y, z = T_world_cam[:3, 3].tolist()
                    stamps.append(frame.timestamp)
                    poses.append(T_world_cam)
                    sys.stdout.write(f"{name}: {x:.3f} {y:.3f} {z:.3f} m, in submap {found.reference.index}\n")
                if stop.is_set():
                    break
    finally:  # also where nobody reads the lines any more
        atomic.write_text(out, format_tum(stamps, poses))
    sys.stdout.write(f"{len(poses)} of {total} pictures found: {out}\n")
    return 130 if stop.is_set() else 0
