"""`tcgsplat export`: a run's map and path in the formats that other programs open."""

import sys
from dataclasses import dataclass, fields
from pathlib import Path

import torch
import tyro

from tcgsplat.errors import ArchiveError
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.trajectory import format_tum
from tcgsplat.storage import atomic
from tcgsplat.storage.ply import write_gaussians
from tcgsplat.storage.run_directory import RunDirectory
from tcgsplat.tensors import PerGaussian


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


def world_map(run: RunDirectory) -> tuple[Gaussians, PerGaussian]:
    """The Gaussians of all sealed submaps in the world frame, and the confidence of each.

    Raises:
        ArchiveError: if there is no sealed submap, or one is damaged.
    """
    parts, confidences = [], []
    for index in range(run.submap_count):
        submap = run.load_submap(index)
        parts.append(submap.gaussians.transformed(submap.T_world_map))
        confidences.append(submap.confidence.value)
    if not parts:
        raise ArchiveError(f"{run.path} has no sealed submap yet; let the run go on for longer, or run again")
    columns = {f.name: torch.cat([getattr(part, f.name) for part in parts]) for f in fields(Gaussians)}
    return Gaussians(**columns), torch.cat(confidences)
