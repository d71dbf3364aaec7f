"""`tcgsplat export`: a run's map and path in the formats that other programs open."""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class Args:
    """Write a run's map as map.ply and its path as trajectory.txt, if nothing is asked for alone; or its surface.

    map.ply holds all submaps as one map in the world frame, with the Gaussians' confidence as one more property; the
    viewers of 3D Gaussian splatting open it. It is the map that `refine` made, if the submaps still stand as they did
    then; else they are merged now. trajectory.txt is in the TUM format, camera to world. --mesh writes mesh.ply: the
    surface of the same map as triangles with colour and confidence, fused from depth rendered at the keyframes. It
    needs Open3D: pip install 'tcgsplat[mesh]'.
    """

    run: tyro.conf.Positional[Path]
    """The run directory."""
    ply: bool = False
    """Only the map."""
    trajectory: bool = False
    """Only the path."""
    mesh: bool = False
    """Only the surface, which is not written if nothing is asked for."""
    voxel_size: float = 0.01
    """Of the surface, metres; half of it takes four times the memory."""
    min_confidence: float = 0.0
    """What the map trusts less is left out of the surface; in [0, 1]."""
    out: Path | None = None
    """Folder to write into; the run directory if left out."""
    backend: str = "auto"
    """Rasterizer for merging: auto, numba, reference, cuda or gsplat."""


def command(args: Args) -> int:
    """Write what was asked for, and say where it is."""
    from tcgsplat.cli.progress import counting
    from tcgsplat.cli.usage import UsageError
    from tcgsplat.mapping.fusion import FusionConfig, fused, open3d
    from tcgsplat.render.backends import open_rasterizer
    from tcgsplat.scene.trajectory import format_tum
    from tcgsplat.storage import atomic
    from tcgsplat.storage.mesh_ply import write_mesh
    from tcgsplat.storage.ply import write_gaussians
    from tcgsplat.storage.run_directory import RunDirectory
    from tcgsplat.storage.world_map import world_map

    if not args.voxel_size > 0 or not 0 <= args.min_confidence <= 1:
        raise UsageError("--voxel-size must be above 0, and --min-confidence between 0 and 1")
    if args.mesh:
        open3d()  # its absence is to be met now, not after the merging
    run = RunDirectory.open(args.run)
    out = args.out or run.path
    if out.exists() and not out.is_dir():
        raise UsageError(f"--out {out} is a file; give a folder")
    out.mkdir(parents=True, exist_ok=True)
    alone = args.ply or args.trajectory or args.mesh
    if args.ply or args.mesh or not alone:
        rasterizer = open_rasterizer(args.backend)  # type: ignore[arg-type]  # it checks the name
        merged = world_map(run, rasterizer)
        made = f"refined by {merged.steps} steps" if merged.steps else "merged now; `tcgsplat refine` makes it better"
        if args.ply or not alone:
            write_gaussians(out / "map.ply", merged.submap.gaussians, merged.submap.confidence.value)
            sys.stdout.write(f"{len(merged.submap)} Gaussians, {made}: {out / 'map.ply'}\n")
        if args.mesh:
            fusion = FusionConfig(voxel_size=args.voxel_size, min_confidence=args.min_confidence)
            with counting("view") as progress:
                mesh = fused(merged.submap, rasterizer, fusion, progress)
            write_mesh(out / "mesh.ply", mesh)
            sys.stdout.write(f"{len(mesh)} triangles, of the map {made}: {out / 'mesh.ply'}\n")
    if args.trajectory or not alone:
        trajectory, atlas = run.trajectory()
        text = format_tum([row.timestamp for row in trajectory.rows], trajectory.world(atlas))
        atomic.write_text(out / "trajectory.txt", text)
        sys.stdout.write(f"{len(trajectory)} poses: {out / 'trajectory.txt'}\n")
    return 0
