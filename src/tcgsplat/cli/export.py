"""`tcgsplat export`: a run's map and path in the formats that other programs open."""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class Args:
    """Write a run's map as map.ply and its path as trajectory.txt; both, if neither is asked for alone.

    map.ply holds all submaps as one map in the world frame, with the Gaussians' confidence as one more property; the
    viewers of 3D Gaussian splatting open it. It is the map that `refine` made, if the submaps still stand as they did
    then; else they are merged now. trajectory.txt is in the TUM format, camera to world.
    """

    run: tyro.conf.Positional[Path]
    """The run directory."""
    ply: bool = False
    """Only the map."""
    trajectory: bool = False
    """Only the path."""
    out: Path | None = None
    """Folder to write into; the run directory if left out."""
    backend: str = "auto"
    """Rasterizer for merging: auto, numba or reference."""


def command(args: Args) -> int:
    """Write what was asked for, and say where it is."""
    from tcgsplat.render.backends import open_rasterizer
    from tcgsplat.scene.trajectory import format_tum
    from tcgsplat.storage import atomic
    from tcgsplat.storage.ply import write_gaussians
    from tcgsplat.storage.run_directory import RunDirectory
    from tcgsplat.storage.world_map import world_map

    run = RunDirectory.open(args.run)
    out = args.out or run.path
    out.mkdir(parents=True, exist_ok=True)
    if args.ply or not args.trajectory:
        merged = world_map(run, open_rasterizer(args.backend))  # type: ignore[arg-type]  # it checks the name
        write_gaussians(out / "map.ply", merged.submap.gaussians, merged.submap.confidence.value)
        made = f"refined by {merged.steps} steps" if merged.steps else "merged now; `tcgsplat refine` makes it better"
        sys.stdout.write(f"{len(merged.submap)} Gaussians, {made}: {out / 'map.ply'}\n")
    if args.trajectory or not args.ply:
        trajectory, atlas = run.trajectory()
        text = format_tum([row.timestamp for row in trajectory.rows], trajectory.world(atlas))
        atomic.write_text(out / "trajectory.txt", text)
        sys.stdout.write(f"{len(trajectory)} poses: {out / 'trajectory.txt'}\n")
    return 0
