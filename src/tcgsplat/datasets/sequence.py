"""What every data set is to the rest of the program: frames in order of time, with ground truth held apart."""

from collections.abc import Iterator
from typing import Protocol, runtime_checkable

from tcgsplat.geometry.camera import Camera
from tcgsplat.scene.frame import Frame
from tcgsplat.tensors import Pose


@runtime_checkable
class Sequence(Protocol):
    """A recorded RGB-D sequence. Iterating decodes one frame at a time; broken frames are skipped with a warning."""

    @property
    def name(self) -> str:
        """What people call it: as a rule the name of its folder."""
        ...

    @property
    def camera(self) -> Camera:
        """Intrinsics of every frame: undistorted, after the crop, pixel centres at integer coordinates."""
        ...

    def __len__(self) -> int:
        """Frames listed, broken ones included."""
        ...

    def __iter__(self) -> Iterator[Frame]:
        """Frames in order of time; `Frame.index` counts the listed ones from 0, so a skipped one leaves a gap."""
        ...

    def frames_from(self, first: int) -> Iterator[Frame]:
        """The same from one index on."""
        ...

    def frame(self, index: int) -> Frame:
        """The frame of one index, out of turn.

        Raises:
            DatasetError: if there is no such frame, or its images cannot be read.
        """
        ...

    def ground_truth(self) -> dict[int, Pose]:
        """`T_world_cam` by frame index, as far as known; read by `evaluation` only, never by the online system.

        Raises:
            DatasetError: if the file of the poses is there but cannot be read.
        """
        ...
