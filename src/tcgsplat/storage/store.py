"""Where finished submaps go, and come back from."""

from typing import Protocol, runtime_checkable

from tcgsplat.scene.submap import Submap
from tcgsplat.storage.checkpoint import Checkpoint


@runtime_checkable
class SubmapStore(Protocol):
    """What SLAM needs of whoever keeps its submaps: a run directory, or memory."""

    def keep(self, submap: Submap, checkpoint: Checkpoint | None) -> None:
        """Keep a finished submap; and the state that the run can go on from, unless it was the last one."""
        ...

    def load_submap(self, index: int) -> Submap:
        """A submap that was kept."""
        ...


class InMemory:
    """Keeps everything, pictures included, until the program ends."""

    def __init__(self) -> None:
        self._submaps: dict[int, Submap] = {}

    def keep(self, submap: Submap, checkpoint: Checkpoint | None) -> None:  # noqa: ARG002
        """Remember a submap; nobody can go on from here once the program has ended."""
        self._submaps[submap.index] = submap

    def load_submap(self, index: int) -> Submap:
        """The very submap."""
        return self._submaps[index]
