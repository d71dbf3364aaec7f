"""Where the submaps of a run stand in the world. The submaps themselves are on disk once sealed."""

from collections.abc import Sequence
from dataclasses import dataclass

from tcgsplat.geometry import se3
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

    def corrected(self, T_world_map: Sequence[Pose]) -> "Atlas":
        """With the first submaps standing elsewhere: what loop closure does, and all that it does.

        Those that have begun since then keep where they stand to the last of these.
        """
        known = len(T_world_map)
        if not known:
            return self
        moved = T_world_map[-1] @ se3.inverse(self.T_world_map[known - 1])
        since = self.T_world_map[known:]
        return Atlas((*T_world_map, *(se3.orthonormalized(moved @ T) for T in since)))
