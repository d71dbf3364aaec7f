"""`tcgsplat localize`: where in a finished map pictures were taken."""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class Args:
    """Find where in the map of a finished run pictures were taken, each by itself.

    IMAGES is a recorded RGB-D sequence, or pictures of the camera that made the run: files, or a folder of them. These
    must be as large as the run's pictures and without lens distortion. Depth makes it more certain, but is not needed.
    A picture is looked up by its features and then aligned to the map; where the two do not agree it counts as not
    found, rather than a pose being made up. The poses go to localized.txt in the run directory, camera to world in the
    TUM format: time stamps for a sequence, numbers from 0 for pictures; those not found are missing.
    """

    run: tyro.conf.Positional[Path]
    """The run directory."""
    images: tyro.conf.Positional[tuple[Path, ...]]
    """A sequence's folder, a folder of pictures, or pictures."""
    start: int = 0
    """First frame of a sequence, counted from 0."""
    stride: int = 1
    """Use every so many-th frame of a sequence."""
    limit: int | None = None
    """Use no more than so many frames of a sequence."""
    out: Path | None = None
    """File to write the poses to; localized.txt in the run directory if left out."""
    backend: str = "auto"
    """Rasterizer: auto, numba or reference."""


def command(args: Args) -> int:
    """One line for each picture, and the file of the poses."""
    import torch

    from tcgsplat.cli.kernels import compile_kernels
    from tcgsplat.cli.pictures import frames_of
    from tcgsplat.cli.progress import counting, say
    from tcgsplat.config import from_toml
    from tcgsplat.loop.relocalization import Relocalizer
    from tcgsplat.render.backends import open_rasterizer
    from tcgsplat.scene.trajectory import format_tum
    from tcgsplat.storage import atomic
    from tcgsplat.storage.run_directory import RunDirectory

    run = RunDirectory.open(args.run)
    config = from_toml(run.config_toml)
    rasterizer = open_rasterizer(args.backend)  # type: ignore[arg-type]  # it checks the name
    frames = frames_of(run, args.images, args.start, args.stride, args.limit)
    torch.set_num_threads(1)  # as in a run: the kernels have threads of their own
    compile_kernels(config, rasterizer, lambda: say("compiling kernels, once per machine: some twenty seconds"))
    relocalizer = Relocalizer(config.loop, config.tracker, config.confidence, rasterizer, run.load_submap, config.seed)
    with counting("submap") as tell:
        for index in range(run.submap_count):
            tell(index, run.submap_count)
            relocalizer.remember(run.load_submap(index))
    _, atlas = run.trajectory()
    stamps, poses, total = [], [], 0
    for name, frame in frames:
        total += 1
        found = relocalizer.relocalized(frame)
        if found is None:
            sys.stdout.write(f"{name}: not found\n")
            continue
        T_world_cam = atlas.T_world_map[found.reference.index] @ found.tracked.T_map_cam
        x, y, z = T_world_cam[:3, 3].tolist()
        sys.stdout.write(f"{name}: {x:.3f} {y:.3f} {z:.3f} m, in submap {found.reference.index}\n")
        stamps.append(frame.timestamp)
        poses.append(T_world_cam)
    out = args.out or run.path / "localized.txt"
    atomic.write_text(out, format_tum(stamps, poses))
    sys.stdout.write(f"{len(poses)} of {total} pictures found: {out}\n")
    return 0
