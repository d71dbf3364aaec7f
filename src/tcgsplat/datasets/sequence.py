"""What every data set is to the rest of the program: an iterator of frames, with ground truth held apart."""

from collections.abc import Iterator
from typing import Protocol

from tcgsplat.geometry.camera import Camera
from tcgsplat.scene.frame import Frame
from tcgsplat.tensors import Pose


class Sequence(Protocol):
    """A recorded RGB-D sequence. Iterating decodes one frame at a time; broken frames are skipped with a warning."""

    name: str
    camera: Camera

    def __len__(self) -> int:
        """Frames listed, broken ones included."""
        ...

    def __iter__(self) -> Iterator[Frame]:
        """Frames in order of time."""
        ...

    def ground_truth(self) -> dict[int, Pose]:
        """`T_world_cam` by frame index, as far as known; read by `evaluation` only, never by the online system."""
        ...
