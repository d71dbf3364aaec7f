"""Exposures as maps of intensity: how they undo, compose and average."""

import math
from dataclasses import fields, replace

import pytest
import torch
from analytic_room import Room
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tcgsplat.scene.exposure import UNCHANGED, Exposure, mean

repeatable = settings(deadline=None, derandomize=True)
gains = st.floats(0.4, 2.5)
offsets = st.floats(-0.5, 0.5)
exposures = st.builds(Exposure, gains, offsets)
several = st.lists(exposures, min_size=1, max_size=8)
seeds = st.integers(0, 9999)


def picture(seed: int) -> Tensor:
    """Colours of a small picture [2, 3, 3], float32."""
    return torch.rand(2, 3, 3, generator=torch.Generator().manual_seed(seed))


def close(a: Exposure, b: Exposure) -> bool:
    return a.gain == pytest.approx(b.gain, rel=1e-12) and a.offset == pytest.approx(b.offset, abs=1e-12)


def test_a_picture_is_gain_times_map_plus_offset() -> None:
    color = torch.tensor([[[0.0, 0.5, 1.0]]])
    torch.testing.assert_close(Exposure(0.8, 0.1).applied(color), torch.tensor([[[0.1, 0.5, 0.9]]]))
    torch.testing.assert_close(Exposure(0.5, 0.25).removed(color), torch.tensor([[[-0.5, 0.5, 1.5]]]))  # not clipped


def test_unchanged_leaves_the_very_picture() -> None:
    color = picture(0)
    assert UNCHANGED.applied(color) is color and UNCHANGED.removed(color) is color
    assert Exposure() == UNCHANGED == Exposure(1.0, 0.0)


@repeatable
@given(exposure=exposures, seed=seeds)
def test_removing_undoes_applying(exposure: Exposure, seed: int) -> None:
    color = picture(seed)
    for there_and_back in (exposure.removed(exposure.applied(color)), exposure.applied(exposure.removed(color))):
        assert there_and_back.dtype == torch.float32
        torch.testing.assert_close(there_and_back, color, atol=2e-6, rtol=0)


@repeatable
@given(exposure=exposures, other=exposures, seed=seeds)
def test_what_is_relative_to_another_comes_on_top_of_it(exposure: Exposure, other: Exposure, seed: int) -> None:
    color = picture(seed)
    on_top = exposure.relative_to(other).applied(other.applied(color))
    torch.testing.assert_close(on_top, exposure.applied(color), atol=1e-5, rtol=0)


@repeatable
@given(exposure=exposures, a=exposures, b=exposures)
def test_what_two_are_relative_to_cancels(exposure: Exposure, a: Exposure, b: Exposure) -> None:
    assert close(exposure.relative_to(b).relative_to(a.relative_to(b)), exposure.relative_to(a))
    assert exposure.relative_to(exposure) == UNCHANGED
    assert exposure.relative_to(UNCHANGED) == exposure


@repeatable
@given(exposures=several)
def test_gains_stand_around_their_mean(exposures: list[Exposure]) -> None:
    middle = mean(exposures)
    assert mean([exposure.relative_to(middle) for exposure in exposures]).gain == pytest.approx(1.0, rel=1e-12)
    assert math.log(middle.gain) == pytest.approx(sum(math.log(e.gain) for e in exposures) / len(exposures), abs=1e-12)


@repeatable
@given(gain=gains, offsets=st.lists(offsets, min_size=1, max_size=8))
def test_offsets_do_so_where_the_gains_agree(gain: float, offsets: list[float]) -> None:
    """Where they do not, an offset's worth depends on the gain, and no mean of offsets has that property."""
    exposures = [Exposure(gain, offset) for offset in offsets]
    middle = mean(exposures)
    assert close(middle, Exposure(gain, sum(offsets) / len(offsets)))
    assert close(mean([exposure.relative_to(middle) for exposure in exposures]), UNCHANGED)


@repeatable
@given(exposure=exposures, exposures=several, number=st.integers(1, 9))
def test_the_mean_of_equals_is_they_and_order_does_not_matter(
    exposure: Exposure, exposures: list[Exposure], number: int
) -> None:
    assert close(mean([exposure] * number), exposure)
    assert close(mean(exposures), mean(exposures[::-1]))


@repeatable
@given(exposure=exposures, share=st.floats(0.0, 1.0))
def test_relaxing_goes_a_share_of_the_way_to_none(exposure: Exposure, share: float) -> None:
    relaxed = exposure.relaxed(share)
    assert math.log(relaxed.gain) == pytest.approx((1 - share) * math.log(exposure.gain), abs=1e-12)
    assert relaxed.offset == pytest.approx((1 - share) * exposure.offset, abs=1e-12)
    assert exposure.relaxed(0.0) == exposure and close(exposure.relaxed(1.0), UNCHANGED)


def test_a_frame_without_its_exposure_is_the_same_but_for_colour(room: Room) -> None:
    frame = room.frame()
    exposure = Exposure(1.3, -0.1)
    exposed = replace(frame, color=exposure.applied(frame.color))
    back = exposed.unexposed(exposure)
    torch.testing.assert_close(back.color, frame.color, atol=1e-6, rtol=0)
    assert all(
        getattr(back, field.name) is getattr(exposed, field.name) for field in fields(frame) if field.name != "color"
    )
    assert frame.unexposed(UNCHANGED).color is frame.color
