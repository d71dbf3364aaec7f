"""How well doubt tells a passer-by, on maps made by hand."""

import math

import pytest
import torch

from tcgsplat.evaluation.prediction import of_fault
from tcgsplat.render.view import Rendering
from tcgsplat.tensors import Mask, Plane

WALL, HIM, SIZE = 2.0, 1.2, (20, 30)
TRUE = torch.full(SIZE, WALL)
SURE, DOUBTFUL = 0.9, 0.2


def columns(first: int, last: int) -> Mask:
    mask = torch.zeros(SIZE, dtype=torch.bool)
    mask[:, first:last] = True
    return mask


def shown(depth: Plane, trust: Plane, opacity: float = 0.8) -> Rendering:
    surface = opacity * depth
    alpha = torch.where(depth > 0, opacity, 0.0)
    none = torch.ones(0, dtype=torch.bool)
    return Rendering(torch.zeros(*SIZE, 3), surface, surface, alpha, trust * alpha, none)


def view(him: Mask, doubted: Mask) -> Rendering:
    return shown(torch.where(him, HIM, WALL), torch.where(doubted, DOUBTFUL, SURE))


def test_who_is_doubted_and_nothing_else_is_told() -> None:
    told = of_fault(view(columns(5, 10), columns(5, 10)), TRUE, columns(5, 10))
    assert (told.in_picture, told.in_map) == (1.0, 1.0)


def test_who_is_trusted_is_not() -> None:
    told = of_fault(view(columns(5, 10), columns(0, 5)), TRUE, columns(5, 10))
    assert told.in_picture == told.in_map == pytest.approx(0.4)  # a tie with 20 columns, below the doubtful 5


def test_a_right_map_behind_him_may_be_sure() -> None:
    told = of_fault(view(columns(5, 8), columns(5, 8)), TRUE, columns(5, 10))
    assert told.in_picture == pytest.approx(0.6 + 0.4 / 2)
    assert told.in_map == 1.0


def test_to_doubt_where_he_was_is_no_false_alarm() -> None:
    told = of_fault(view(columns(5, 20), columns(5, 20)), TRUE, columns(5, 10))
    assert told.in_picture == pytest.approx((15 + 10 / 2) / 25)
    assert told.in_map == 1.0


def test_to_doubt_what_is_right_is_one() -> None:
    told = of_fault(view(columns(5, 10), columns(5, 20)), TRUE, columns(5, 10))
    assert told.in_picture == told.in_map == pytest.approx((15 + 10 / 2) / 25)


def test_what_is_not_mapped_or_not_known_does_not_count() -> None:
    depth = torch.where(columns(5, 10), HIM, WALL)
    depth[:, 20:] = 0.0
    trust = torch.where(columns(5, 10) | columns(20, 30), DOUBTFUL, SURE)
    assert of_fault(shown(depth, trust), TRUE, columns(5, 10)).in_picture == 1.0
    unknown = torch.where(columns(5, 10), 0.0, TRUE)
    assert math.isnan(of_fault(shown(depth, trust), unknown, columns(5, 10)).in_map)


def test_nothing_to_tell_apart() -> None:
    told = of_fault(view(columns(0, 0), columns(0, 0)), TRUE, columns(0, 0))
    assert math.isnan(told.in_picture) and math.isnan(told.in_map)
    empty = of_fault(shown(torch.zeros(SIZE), torch.zeros(SIZE)), TRUE, columns(5, 10))
    assert math.isnan(empty.in_picture) and math.isnan(empty.in_map)
