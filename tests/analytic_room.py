"""A closed box with a smooth solid texture, ray-cast in closed form: frames with exact depth at exactly known poses."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
from torch import Tensor

from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.view import Rendering
from tcgsplat.scene.frame import Frame
from tcgsplat.tensors import Pose

CAMERA = Camera(fx=70.0, fy=71.0, cx=39.2, cy=29.7, width=80, height=60)


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, *, degrees: tuple[float, float, float] = (0, 0, 0)) -> Pose:
    """Rigid transform from a tangent: metres, and a rotation vector in degrees."""
    return se3.exp(torch.tensor([x, y, z, *(math.radians(d) for d in degrees)], dtype=torch.float64))


@dataclass(frozen=True)
class Room:
    """The world is the inside of a box around the origin; wherever a camera in it looks, it sees a wall.

    The box is turned, so that the camera at the origin looks into a corner: three planes, none of them upright.
    """

    low: tuple[float, float, float] = (-0.8, -0.7, -1.2)
    high: tuple[float, float, float] = (0.9, 0.6, 1.3)
    contrast: float = 1.0
    """Of the texture; 0 paints everything grey."""
    T_room_world: Pose = field(default_factory=lambda: pose(degrees=(-24.0, 38.0, 0.0)))
    """The walls stand upright in the room's own frame."""

    def frame(self, T_world_cam: Pose | None = None, index: int = 0, camera: Camera = CAMERA) -> Frame:
        """What a camera sees, 30 frames a second."""
        T = self.T_room_world if T_world_cam is None else self.T_room_world @ T_world_cam
        rays = camera.rays().double() @ T[:3, :3].T
        walls = torch.where(rays > 0, torch.tensor(self.high).double(), torch.tensor(self.low).double())
        depth = ((walls - T[:3, 3]) / rays).nan_to_num(math.inf).amin(dim=-1)
        color = self.texture(T[:3, 3] + rays * depth[..., None])
        valid = torch.ones(depth.shape, dtype=torch.bool)
        return Frame(index, index / 30, color.float(), depth.float(), valid, camera)

    def texture(self, points: Tensor) -> Tensor:
        """RGB at points of the room: waves of 25 to 70 cm in all directions."""
        waves = (
            2
            * math.pi
            * torch.tensor([[2.9, 0.7, 1.3], [-0.8, 3.1, 1.1], [1.5, 1.9, -2.6], [1.3, -0.6, 0.4]], dtype=torch.float64)
        )
        sines = torch.sin((points @ waves.T)[..., None] + torch.tensor([0.0, 0.4, 1.7]).double())
        amplitudes = torch.tensor([0.12, 0.11, 0.09, 0.13], dtype=torch.float64)
        return 0.5 + self.contrast * (amplitudes[:, None] * sines).sum(dim=-2)


def walk(count: int) -> list[Pose]:
    """A hand-held path: about 1.5 cm and 0.7 degrees a frame, the first camera at the origin."""
    poses = [se3.identity()]
    for i in range(1, count):
        sway = math.sin(0.4 * i)
        poses.append(poses[-1] @ pose(0.012, 0.004 * sway, 0.006, degrees=(0.2 * sway, -0.6, 0.2)))
    return poses


def rendering_of(frame: Frame, *, confidence: float = 1.0, alpha: float | Tensor = 0.99) -> Rendering:
    """The view of a perfect map: what the frame itself shows, where it is covered."""
    coverage = torch.as_tensor(alpha).expand_as(frame.depth)
    return Rendering(
        color=frame.color * coverage[..., None],
        composited_depth=frame.depth * coverage,
        composited_plane_depth=frame.depth * coverage,
        alpha=coverage,
        confidence=confidence * coverage,
        visible=torch.zeros(0, dtype=torch.bool),
    )


@dataclass(frozen=True)
class RoomSequence:
    """The room as a recording whose ground truth must not be touched."""

    T_world_cam: tuple[Pose, ...]
    room: Room = field(default_factory=Room)
    name: str = "room"
    camera: Camera = CAMERA

    def __len__(self) -> int:
        return len(self.T_world_cam)

    def __iter__(self) -> Iterator[Frame]:
        return self.frames_from(0)

    def frames_from(self, first: int) -> Iterator[Frame]:
        return (self.frame(i) for i in range(first, len(self)))

    def frame(self, index: int) -> Frame:
        return self.room.frame(self.T_world_cam[index], index, self.camera)

    def ground_truth(self) -> dict[int, Pose]:
        raise AssertionError("the online system looked at the ground truth")


def errors(T: Pose, T_true: Pose) -> tuple[float, float]:
    """Distance in millimetres and angle in degrees between two poses."""
    apart = se3.inverse(T_true) @ T
    return 1000 * se3.translation_norm(apart), math.degrees(se3.rotation_angle(apart))
