"""Depth moved to the instant of colour: against scenes whose depth at both instants is known in closed form."""

import math
from dataclasses import replace

import pytest
import torch
from analytic_room import Room
from torch import Tensor

from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.scene.frame import Frame
from tcgsplat.tensors import Mask, Plane, Pose
from tcgsplat.tracking.synchronization import synchronized

CAMERA = Camera(fx=258.0, fy=257.0, cx=159.0, cy=127.4, width=320, height=240)
HAND = (0.30, -0.20, 0.25, math.radians(20), math.radians(-30), math.radians(25))
"""Fast for a hand: metres and radians a second; four pixels in 17 ms."""
LATE, EARLY = 0.017, -0.017


def twist(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def frame_of(depth: Tensor, delay: float, camera: Camera = CAMERA, valid: Mask | None = None) -> Frame:
    """A grey frame whose depth image was taken `delay` seconds after its colour image."""
    color = torch.full((*depth.shape, 3), 0.5)
    valid = torch.ones(depth.shape, dtype=torch.bool) if valid is None else valid
    return Frame(7, 100.0, color, depth.float(), valid, camera, depth_timestamp=100.0 + delay)


def wall(T_world_cam: Pose, camera: Camera = CAMERA) -> Plane:
    """Depth of a wall 2 m ahead of the origin that leans back and turns away."""
    normal, distance = twist(0.35, -0.25, -1.0), -2.0
    rays = camera.rays().double() @ T_world_cam[:3, :3].T
    return (distance - normal @ T_world_cam[:3, 3]) / (rays @ normal)


def board(T_world_cam: Pose) -> Plane:
    """Depth of a board of 40 cm by 30 cm at 0.9 m, infinite beside it."""
    rays = CAMERA.rays().double() @ T_world_cam[:3, :3].T
    depth = (0.9 - T_world_cam[2, 3]) / rays[..., 2]
    points = T_world_cam[:3, 3] + rays * depth[..., None]
    return torch.where((points[..., 0].abs() < 0.2) & (points[..., 1].abs() < 0.15), depth, math.inf)


def seen_in_depth_image(depth: Plane, T_color_depth: Pose, camera: Camera = CAMERA) -> Tensor:
    """Pixel (u, v) of the depth image at which a surface seen by the colour image is."""
    points = camera.backproject(depth.float()).double().reshape(-1, 3)
    return camera.project(se3.transform(se3.inverse(T_color_depth), points)).reshape(*depth.shape, 2)


@pytest.mark.parametrize("delay", [LATE, EARLY, 0.004])
def test_what_is_left_of_the_error_is_a_hundredth(room: Room, delay: float) -> None:
    """Corners and walls of a room: 0.2 to 0.7 % of the error was measured to be left; a share is in concave edges."""
    true = room.frame(camera=CAMERA)
    later = room.frame(se3.exp(twist(*HAND) * delay), camera=CAMERA)
    moved = synchronized(replace(true, depth=later.depth, depth_timestamp=delay), twist(*HAND)).depth
    read = moved > 0
    assert float(read.float().mean()) > 0.97
    uncompensated = (later.depth - true.depth)[read].abs()
    left = (moved - true.depth)[read].abs()
    assert float(uncompensated.mean()) > 1e-3
    assert float(left.mean()) < 0.01 * float(uncompensated.mean())
    assert float(left.quantile(0.99)) < 0.05 * float(uncompensated.mean())


def test_depth_grows_back_by_the_way_that_the_camera_came_nearer() -> None:
    depth = torch.full((240, 320), 1.98)
    moved = synchronized(frame_of(depth, delay=0.02), twist(0, 0, 1.0, 0, 0, 0)).depth
    assert float((moved[5:-5, 5:-5] - 2.0).abs().max()) < 1e-5


@pytest.mark.parametrize("delay", [LATE, EARLY])
def test_an_edge_moves_and_stays_sharp(delay: float) -> None:
    """No reading is between board and wall, 19 of 20 wrong pixels become right, and what was shown is kept."""
    velocity = twist(0.7, 0.3, 0.1, 0.1, -0.2, 0.3)
    T = se3.exp(velocity * delay)
    near, far = board(se3.identity()), wall(se3.identity())
    true, later = torch.minimum(near, far), torch.minimum(board(T), wall(T))
    moved = synchronized(frame_of(later, delay), velocity).depth.double()
    read = moved > 0
    plate = torch.where(near.isinf(), 0.9, near)  # the board's plane, beyond its rim too
    assert float(torch.minimum((moved - plate).abs(), (moved - far).abs())[read].max()) < 0.004

    wrong_before, wrong = (later - true).abs() > 0.3, ((moved - true).abs() > 0.3) & read
    assert int(wrong.sum()) < 0.06 * int(wrong_before.sum())
    inner = torch.zeros_like(read)
    inner[12:-12, 12:-12] = True
    torn = inner & ~read
    column, row = seen_in_depth_image(true, T)[torn].round().long().unbind(-1)
    shown = (later[row, column] - true[torn]).abs() < 0.3
    assert bool(torn.any())  # beside the board there is wall that it hides at the one instant and not at the other
    assert float(shown.double().mean()) < 0.02


@pytest.mark.parametrize("delay", [LATE, EARLY])
def test_there_is_a_reading_exactly_where_there_was_one(delay: float, generator: torch.Generator) -> None:
    """Holes of all sizes, and the border: at less than half a pixel from both, either answer will do."""
    T = se3.exp(twist(*HAND) * delay)
    true, later = wall(se3.identity()), wall(T)
    later[60:100, 200:240] = 0
    later[torch.rand(later.shape, generator=generator) < 0.02] = 0
    moved = synchronized(frame_of(later, delay), twist(*HAND)).depth
    uv = seen_in_depth_image(true, T)
    lowest, highest = torch.zeros(2), torch.tensor([319.0, 239.0])
    outside = ((uv < lowest - 0.52) | (uv > highest + 0.52)).any(dim=-1)
    column, row = uv[..., 0].round().long(), uv[..., 1].round().long()
    there = later[row.clamp(0, 239), column.clamp(0, 319)] > 0
    clear = ((uv - uv.floor() - 0.5).abs() > 0.03).all(dim=-1)  # which pixel is the nearest is not a matter of rounding
    inside = ((uv > lowest - 0.48) & (uv < highest + 0.48)).all(dim=-1)
    assert int(outside.sum()) > 100
    assert not bool((moved > 0)[outside].any())
    assert int((inside & clear & ~there).sum()) > 1000
    assert torch.equal((moved > 0)[inside & clear], there[inside & clear])


def test_colour_and_mask_are_left_alone_and_the_mask_is_kept_to() -> None:
    valid = torch.ones(240, 320, dtype=torch.bool)
    valid[:, :9] = False
    depth = wall(se3.exp(twist(*HAND) * LATE)) * valid
    frame = frame_of(depth, LATE, valid=valid)
    before = frame.depth.clone()
    moved = synchronized(frame, twist(*HAND))
    assert moved.color is frame.color
    assert moved.valid is frame.valid
    assert (moved.index, moved.timestamp, moved.depth_delay) == (7, 100.0, 0.0)
    assert moved.depth.dtype == torch.float32
    assert torch.equal(frame.depth, before)
    assert not bool(moved.depth[~valid].any())
    assert bool(moved.depth[120, 20:300].all())


@pytest.mark.parametrize(
    ("delay", "velocity"),
    [
        (0.0, HAND),
        (LATE, (0.0,) * 6),
        (LATE, (0.002, 0.001, 0.0, 0.0, 0.004, 0.0)),  # 0.03 + 0.03 pixels
        (LATE, (math.nan, *HAND[1:])),
        (LATE, (math.inf, *HAND[1:])),
        (LATE, (0.0, 0.0, 0.0, 0.0, 40.0, 0.0)),
        (LATE, (0.0, 1e9, 0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_nothing_is_moved_without_need_or_on_a_mad_velocity(delay: float, velocity: tuple[float, ...]) -> None:
    frame = frame_of(wall(se3.identity()), delay)
    assert synchronized(frame, twist(*velocity)) is frame


def test_one_stamp_for_both_images_is_one_instant(room: Room) -> None:
    frame = room.frame()
    assert frame.depth_delay == 0.0
    assert synchronized(frame, twist(*HAND)) is frame


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("sign", [-1, 1])
def test_the_fastest_motion_that_is_believed_gives_depths(axis: int, sign: int) -> None:
    velocity = torch.zeros(6, dtype=torch.float64)
    velocity[axis] = sign * 0.299 / LATE
    depth = wall(se3.identity())
    depth[::7] = 0
    depth[100, 100], depth[101, 101] = 1e-30, 1e30
    moved = synchronized(frame_of(depth, LATE), velocity).depth
    assert bool(torch.isfinite(moved).all())
    assert float(moved.min()) >= 0
    assert 0 < float((moved > 0).float().mean()) < 1


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (2, 2)])
def test_the_smallest_images(shape: tuple[int, int]) -> None:
    camera = Camera(20.0, 20.0, (shape[1] - 1) / 2, (shape[0] - 1) / 2, shape[1], shape[0])
    moved = synchronized(frame_of(torch.full(shape, 2.0), LATE, camera), twist(0, 0, 3.0, 0, 0, 0)).depth
    torch.testing.assert_close(moved, torch.full(shape, 2.0 + 3.0 * LATE), atol=1e-5, rtol=0)


def test_without_any_reading_there_is_none_afterwards() -> None:
    moved = synchronized(frame_of(torch.zeros(240, 320), LATE), twist(*HAND)).depth
    assert not bool(moved.any())
