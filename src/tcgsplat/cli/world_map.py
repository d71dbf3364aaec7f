"""All submaps of a run as one map."""

from dataclasses import fields

import torch

from tcgsplat.errors import ArchiveError
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.storage.run_directory import RunDirectory
from tcgsplat.tensors import PerGaussian


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
