"""Where the submaps of a run stand in the world. The submaps themselves are on disk once sealed."""

from collections.abc import Mapping
from dataclasses import dataclass

from tcgsplat.tensors import Pose


@dataclass(frozen=True)
class Atlas:
    """World pose of every submap that the run has begun, by submap index."""

    T_world_map: tuple[Pose, ...] = ()

    def __len__(self) -> int:
        return len(self.T_world_map)

    def with_submap(self, T_world_map: Pose) -> "Atlas":
        """With the next submap's pose."""
        return Atlas((*self.T_world_map, T_world_map))

    def corrected(self, corrections: Mapping[int, Pose]) -> "Atlas":
        """With the poses of some submaps replaced: what loop closure does, and all that it does."""
        return Atlas(tuple(corrections.get(i, T) for i, T in enumerate(self.T_world_map)))
