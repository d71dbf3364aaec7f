"""Time to drop and to recover of the places that somebody hides, on looks made by hand."""

import math
from collections.abc import Sequence

import pytest
import torch

from tcgsplat.evaluation.crossing import Crossing, Look, crossing, hidden_points
from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.tensors import Pose

CAMERA = Camera(fx=40.0, fy=40.0, cx=19.5, cy=14.5, width=40, height=30)
SEEN, HIDDEN, AWAY = "seen", "hidden", "away"
FLOOR = 0.1


def look(index: int, trust: float, what: str = SEEN, T_world_cam: Pose | None = None, wall: float = 2.0) -> Look:
    """A wall across the picture, and somebody before its middle; `away`: the camera looks elsewhere."""
    hidden = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
    hidden[10:20, 15:25] = what == HIDDEN
    turned = se3.identity()
    turned[:3, :3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0]).double())
    pose = turned if what == AWAY else se3.identity() if T_world_cam is None else T_world_cam
    depth = torch.full(hidden.shape, wall)
    return Look(index, torch.full(hidden.shape, trust), hidden, depth, CAMERA, pose)


def looks(*told: tuple[float, str], every: int = 5) -> list[Look]:
    return [look(every * i, trust, what) for i, (trust, what) in enumerate(told)]


def times(found: Crossing) -> tuple[float, float]:
    return found.time_to_drop, found.time_to_recover


def test_it_falls_a_look_after_he_came_and_is_back_two_after_he_went() -> None:
    told = ((0.9, SEEN), (0.9, HIDDEN), (0.3, HIDDEN), (0.2, HIDDEN), (0.3, SEEN), (0.7, SEEN), (0.85, SEEN))
    found = crossing(looks(*told), FLOOR)
    assert times(found) == (5, 10)
    assert found.places == found.dropped == found.left == found.recovered > 50


def test_half_way_is_to_the_floor_and_recovery_is_nine_tenths() -> None:
    told = [(0.9, SEEN), (0.51, HIDDEN), (0.49, HIDDEN), (0.80, SEEN), (0.82, SEEN)]
    assert times(crossing(looks(*told), FLOOR)) == (5, 5)
    assert crossing(looks(*told), 0.0).dropped == 0


def test_what_is_known_last_before_he_came_counts() -> None:
    told = ((0.2, SEEN), (0.8, SEEN), (0.4, HIDDEN), (0.75, SEEN))
    assert times(crossing(looks(*told), FLOOR)) == (0, 0)


def test_a_place_that_nobody_knew_does_not_count() -> None:
    found = crossing(looks((0.9, HIDDEN), (0.2, HIDDEN), (0.9, SEEN)), FLOOR)
    assert (found.places, found.dropped) == (0, 0)
    assert all(math.isnan(one) for one in times(found))
    assert crossing([look(0, math.nan), *looks((0.2, HIDDEN))], FLOOR).places == 0


def test_a_map_that_never_doubts_never_drops() -> None:
    found = crossing(looks((0.9, SEEN), (0.9, HIDDEN), (0.9, HIDDEN), (0.9, SEEN)), FLOOR)
    assert found.places > 50 and (found.dropped, found.left, found.recovered) == (0, 0, 0)


@pytest.mark.parametrize("after", [(), ((0.2, HIDDEN),), ((0.2, SEEN), (0.3, SEEN)), ((0.2, SEEN), (0.9, HIDDEN))])
def test_who_does_not_come_back_has_no_time(after: Sequence[tuple[float, str]]) -> None:
    found = crossing(looks((0.9, SEEN), (0.2, HIDDEN), *after), FLOOR)
    assert found.dropped > 50 and found.recovered == 0 and math.isnan(found.time_to_recover)
    assert found.left == (found.dropped if any(what == SEEN for _, what in after) else 0)


def test_what_he_left_behind_counts_though_he_is_gone() -> None:
    """The map made him a part of itself, and shows him, doubted, where he is no more."""
    told = ((0.9, SEEN), (0.9, HIDDEN), (0.8, SEEN), (0.2, SEEN), (0.9, SEEN))
    assert times(crossing(looks(*told), FLOOR)) == (10, 10)


def test_looks_elsewhere_take_no_time() -> None:
    away = [(0.9, AWAY)] * 20
    told = [(0.9, SEEN), *away, (0.9, HIDDEN), (0.2, HIDDEN), *away, (0.3, SEEN), *away, (0.85, SEEN)]
    assert times(crossing(looks(*told), FLOOR)) == (5, 5)


def test_a_place_keeps_its_place_while_the_camera_moves() -> None:
    aside = se3.identity()
    aside[0, 3] = 0.5  # ten pixels at 2 m: the places are seen beside the middle of the picture
    end = look(10, 0.9, SEEN, aside)
    end.trust[:, 12:28] = 0.2
    found = crossing([look(0, 0.9), look(5, 0.2, HIDDEN), end], FLOOR)
    assert found.dropped == found.left > 50
    assert 0.5 < found.recovered / found.left < 0.8  # seven of ten columns are seen left of the doubtful ones


def test_what_stands_before_a_place_is_not_the_place() -> None:
    near = look(10, 0.9, wall=1.0)
    assert crossing([look(0, 0.9), look(5, 0.2, HIDDEN), near], FLOOR).left == 0


def test_places_lie_on_the_surface_that_he_hides() -> None:
    points = hidden_points(looks((0.9, SEEN), (0.9, HIDDEN), (0.9, HIDDEN)))
    assert 50 < len(points) <= 100
    assert torch.allclose(points[:, 2], torch.tensor(2.0))
    assert points[:, :2].abs().max() < 0.3
    assert len(hidden_points([])) == 0 and crossing([], FLOOR).places == 0
