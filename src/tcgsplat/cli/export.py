"""`tcgsplat export`: a run's map and path in the formats that other programs open."""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class Args:
    """Write a run's map as map.ply and its path as trajectory.txt; both, if neither is asked for alone.

    map.ply holds the Gaussians of all submaps in the world frame, with their confidence as one more property; the
    viewers of 3D Gaussian splatting open it. trajectory.txt is in the TUM format, camera to world.
    """

    run: tyro.conf.Positional[Path]
    """The run directory."""
    ply: bool = False
    """Only the map."""
    trajectory: bool = False
    """Only the path."""
    out: Path | None = None
    """Folder to write into; the run directory if left out."""


def command(args: Args) -> int:
    """Write what was asked for, and say where it is."""
    from tcgsplat.cli.world_map import world_map
    from tcgsplat.scene.trajectory import format_tum
    from tcgsplat.storage import atomic
    from tcgsplat.storage.ply import write_gaussians
    from tcgsplat.storage.run_directory import RunDirectory

    run = RunDirectory.open(args.run)
    out = args.out or run.path
    out.mkdir(parents=True, exist_ok=True)
    if args.ply or not args.trajectory:
        gaussians, confidence = world_map(run)
        write_gaussians(out / "map.ply", gaussians, confidence)
        sys.stdout.write(f"{len(gaussians)} Gaussians: {out / 'map.ply'}\n")
    if args.trajectory or not args.ply:
        trajectory, atlas = run.trajectory()
        text = format_tum([row.timestamp for row in trajectory.rows], trajectory.world(atlas))
        atomic.write_text(out / "trajectory.txt", text)
        sys.stdout.write(f"{len(trajectory)} poses: {out / 'trajectory.txt'}\n")
    return 0
