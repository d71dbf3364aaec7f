"""What is true of a sequence whose makers know it: exact depth, what is wrong in a frame, views beside the walk.

It lies beside what a camera recorded, in `truth/` and `free/`, and only evaluation reads it. The frames of these files
are numbered as the recording has them, from 0; `Truth` counts as the opened part of the sequence does.

    truth/events.json         what is wrong, or away, in a run of frames
    truth/depth/000012.png    depth of all that stands still, where the recording's own depth is not exact
    truth/fault/000012.png    255 where the recording is wrong, where something is wrong in parts of images
    free/camera.toml          of the free views, as for any sequence
    free/poses.txt            T_world_cam in the TUM format, by number
    free/color, free/depth    000.png and so on, exact
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tcgsplat.datasets.association import read_text
from tcgsplat.datasets.calibration import read_calibration
from tcgsplat.datasets.images import read_color, read_depth
from tcgsplat.datasets.opening import open_sequence
from tcgsplat.datasets.sequence import Sequence
from tcgsplat.errors import DatasetError
from tcgsplat.geometry.camera import Camera
from tcgsplat.scene.trajectory import parse_tum
from tcgsplat.tensors import Image, Mask, Plane, Pose

DEPTH_SCALE = 5000.0
"""Units per metre of every depth image here: steps of 0.2 mm up to 13.1 m, as in the TUM benchmark's recordings."""

Corner = tuple[float, float, float]


@dataclass(frozen=True)
class Region:
    """A box in the world, its sides along the axes."""

    lower: Corner
    """Metres."""
    upper: Corner
    """Metres."""

    def contains(self, points: Float[Tensor, "*batch 3"]) -> Bool[Tensor, " *batch"]:
        """Whether points in the world frame, metres, lie in it."""
        return ((points >= points.new_tensor(self.lower)) & (points <= points.new_tensor(self.upper))).all(dim=-1)


@dataclass(frozen=True)
class Event:
    """Something that happens in a run of frames."""

    name: str
    """`exposure jump`, `dropped frames` (the one frame after a gap), `still camera`, `moving object` (somebody is in
    the picture), `depth bias` (from when on a region reads wrong), `absence` (of the region that is seen first)."""
    first: int
    """Index of its first frame."""
    last: int
    """Index of its last frame."""
    region: Region | None = None
    """Where in the world, if it is about a place."""


@dataclass(frozen=True, eq=False)
class FreeView:
    """What a perfect camera sees from a place that the recording's camera was not at."""

    color: Image
    """Rounded to 8 bits; with the brightness of the first frame, whatever happened to the exposure later."""
    depth: Plane
    """Metres, rounded to 0.2 mm; 0 where there is nothing."""
    T_world_cam: Pose
    """In the world frame of the ground truth."""
    camera: Camera


@dataclass(frozen=True, eq=False)
class Truth:
    """What is known of the frames of a sequence."""

    root: Path
    """Folder of the sequence."""
    sequence: Sequence
    """The part of it that indices count."""
    numbers: tuple[int, ...]
    """Of each frame of the part: its number in the whole recording."""
    events: tuple[Event, ...]
    """In order of their first frames, as far as they touch the part."""

    @staticmethod
    def of(folder: Path | str, *, start: int = 0, stride: int = 1, limit: int | None = None) -> "Truth | None":
        """The truth of a sequence, or of a part of it as `open_sequence` takes it; None where nobody knows it.

        Raises:
            DatasetError: if there is no such sequence or part, or `truth/events.json` makes no sense.
        """
        root = Path(folder).expanduser()
        if not (root / "truth" / "events.json").is_file():
            return None
        sequence = open_sequence(root, start=start, stride=stride, limit=limit)
        numbers = tuple(start + stride * index for index in range(len(sequence)))
        counted = (_counted(event, numbers) for event in _read_events(root / "truth" / "events.json"))
        return Truth(root, sequence, numbers, tuple(event for event in counted if event))

    @property
    def exact(self) -> bool:
        """Whether the recording's own depth is the true one in every frame."""
        return not depth_file(self.root, 0).parent.is_dir()

    def depth(self, index: int) -> Plane | None:
        """Depth, metres, of all that stands still, as nobody were in the way: what a right map shows.

        Where the recording's depth is exact, it is that. None for a frame that is not there.

        Raises:
            DatasetError: if the image cannot be read.
        """
        if not 0 <= index < len(self.numbers):
            return None
        if self.exact:
            return self.sequence.frame(index).depth
        return torch.from_numpy(read_depth(depth_file(self.root, self.numbers[index]), DEPTH_SCALE))

    def fault(self, index: int) -> Mask | None:
        """Where an injected fault made the recording wrong; None where no part of an image is known to be wrong.

        Noise, and what happens to whole frames, is no fault in this sense.

        Raises:
            DatasetError: if the image cannot be read.
        """
        if not 0 <= index < len(self.numbers):
            return None
        path = fault_file(self.root, self.numbers[index])
        return torch.from_numpy(read_color(path)[..., 0] > 0) if path.parent.is_dir() else None

    def free_views(self) -> tuple[FreeView, ...]:
        """Exact pictures from beside the walk, of what it has seen; the same ones whatever was done to the recording.

        Raises:
            DatasetError: if they are there but cannot be read.
        """
        folder = self.root / "free"
        if not folder.is_dir():
            return ()
        camera = read_calibration(folder, {}).camera
        path = folder / "poses.txt"
        try:
            numbers, poses = parse_tum(read_text(path))
        except ValueError as error:
            raise DatasetError(f"{path} cannot be read ({error}); make the sequence anew") from error
        return tuple(
            FreeView(
                color=torch.from_numpy(read_color(color_path)).float() / 255,
                depth=torch.from_numpy(read_depth(depth_path, DEPTH_SCALE)),
                T_world_cam=pose,
                camera=camera,
            )
            for (color_path, depth_path), pose in zip(
                (free_files(self.root, int(number)) for number in numbers), poses, strict=True
            )
        )


def depth_file(root: Path, number: int) -> Path:
    """Where the exact depth of a recorded frame is."""
    return root / "truth" / "depth" / f"{number:06d}.png"


def fault_file(root: Path, number: int) -> Path:
    """Where the mask of what is wrong in a recorded frame is."""
    return root / "truth" / "fault" / f"{number:06d}.png"


def free_files(root: Path, number: int) -> tuple[Path, Path]:
    """Where colour and depth of a free view are."""
    return root / "free" / "color" / f"{number:03d}.png", root / "free" / "depth" / f"{number:03d}.png"


def events_text(events: Iterable[Event]) -> str:
    """Events as `truth/events.json` has them, their frames by number."""
    rows = [
        {"name": event.name, "first": event.first, "last": event.last}
        | ({"region": [event.region.lower, event.region.upper]} if event.region else {})
        for event in sorted(events, key=lambda event: (event.first, event.name))
    ]
    return "[" + ",".join(f"\n  {json.dumps(row)}" for row in rows) + "\n]\n"


def _read_events(path: Path) -> list[Event]:
    try:
        return [
            Event(str(row["name"]), int(row["first"]), int(row["last"]), _region(row.get("region")))
            for row in json.loads(read_text(path))
        ]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DatasetError(f"{path} is no list of events with name, first and last; make the sequence anew") from error


def _region(corners: Any) -> Region | None:
    """A region as its file has it, which may have anything."""
    if corners is None:
        return None
    (x0, y0, z0), (x1, y1, z1) = corners
    return Region((x0, y0, z0), (x1, y1, z1))


def _counted(event: Event, numbers: tuple[int, ...]) -> Event | None:
    """The event by index, if it touches any of the frames with these numbers."""
    touched = [index for index, number in enumerate(numbers) if event.first <= number <= event.last]
    return Event(event.name, touched[0], touched[-1], event.region) if touched else None
