"""The one map of a run, for whoever draws it or gives it away."""

from tcgsplat.config import from_toml
from tcgsplat.errors import ArchiveError
from tcgsplat.mapping.merging import Merged, merged
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.storage.run_directory import RunDirectory


def world_map(run: RunDirectory, rasterizer: Rasterizer) -> Merged:
    """As `refine` has left it, if that was made of the submaps as they stand now; else merged now.

    Raises:
        ArchiveError: if there is no sealed submap, or a file of the run is damaged.
    """
    return run.load_map() or newly_merged(run, rasterizer)


def newly_merged(run: RunDirectory, rasterizer: Rasterizer) -> Merged:
    """From the submaps as they stand now; keyframes are read when they are asked for.

    Raises:
        ArchiveError: as `world_map`.
    """
    submaps = run.open_submaps()
    if not submaps:
        raise ArchiveError(f"{run.path} has no sealed submap yet; let the run go on for longer, or run again")
    return merged(submaps, from_toml(run.config_toml).mapper, rasterizer)
