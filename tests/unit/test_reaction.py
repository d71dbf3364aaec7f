"""Time to drop and to recover, on series made by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tcgsplat.errors import EvaluationError
from tcgsplat.evaluation.reaction import Reaction, reaction, time_to_drop, time_to_recover


def series(*stretches: tuple[int, float]) -> np.ndarray:
    return np.concatenate([np.full(length, level) for length, level in stretches])


def test_a_step_down_and_up_again() -> None:
    values = series((20, 0.75), (4, 0.625), (16, 0.25), (7, 0.375), (13, 0.75))  # the fault lasts from 20 to 40
    assert reaction(values, 20, 40) == Reaction(0.75, 0.25, 0.5, True, 4, 7)
    assert (time_to_drop(values, 20, 40), time_to_recover(values, 20, 40)) == (4, 7)


def test_a_spike_before_the_fault_does_not_raise_the_level() -> None:
    values = series((10, 0.75), (1, 1.0), (9, 0.75), (5, 0.6), (15, 0.25))
    assert reaction(values, 20).before == 0.75
    assert time_to_drop(values, 20) == 5


def test_at_once() -> None:
    values = series((20, 0.8), (10, 0.4), (10, 0.8))
    assert (time_to_drop(values, 20, 30), time_to_recover(values, 20, 30)) == (0, 0)


def test_a_series_that_stays_down_never_recovers() -> None:
    values = series((20, 0.8), (30, 0.4))
    assert (time_to_drop(values, 20, 40), time_to_recover(values, 20, 40)) == (0, None)
    assert reaction(values, 20).time_to_recover is None


@given(st.integers(0, 2**32 - 1))
def test_noise_is_not_a_drop(seed: int) -> None:
    values = 0.8 + 0.005 * np.random.default_rng(seed).standard_normal(60).clip(-3, 3)
    found = reaction(values, 20, 40)
    assert not found.dropped
    assert found.time_to_drop is None
    assert time_to_drop(values, 20, 40, least_drop=0.5) is None


def test_a_noisy_series_needs_a_deeper_drop() -> None:
    before = np.tile([0.7, 0.9], 10)
    assert time_to_drop(np.concatenate((before, np.full(10, 0.6))), 20) is None
    assert time_to_drop(np.concatenate((before, np.full(10, 0.2))), 20) == 0


def test_a_single_frame_beyond_does_not_count_unless_asked() -> None:
    values = series((20, 0.8), (2, 0.8), (1, 0.4), (5, 0.8), (12, 0.4), (2, 0.4), (1, 0.8), (3, 0.4), (14, 0.8))
    assert (time_to_drop(values, 20, 40), time_to_recover(values, 20, 40)) == (8, 6)
    assert (time_to_drop(values, 20, 40, hold=1), time_to_recover(values, 20, 40, hold=1)) == (2, 2)


def test_frames_out_of_view_pass_but_count_as_time() -> None:
    values = series((20, 0.8), (20, 0.4), (20, 0.8))
    values[[3, 4, 20, 21, 23, 40]] = math.nan
    assert (time_to_drop(values, 20, 40), time_to_recover(values, 20, 40)) == (2, 1)


def test_nothing_known_before_or_during_is_no_drop() -> None:
    values = series((20, 0.8), (20, 0.4))
    assert math.isnan(reaction(values, 0, 20).before)
    values[20:] = math.nan
    assert reaction(values, 20).time_to_drop is None


@given(st.floats(0.05, 0.7), st.floats(0.1, 10.0), st.integers(0, 9))
def test_scale_does_not_matter(low: float, scale: float, delay: int) -> None:
    values = series((20, 0.8), (delay, 0.8), (20 - delay, low), (20, 0.8))
    assert time_to_drop(scale * values, 20, 40, least_drop=0.0) == delay


def test_a_fault_outside_of_the_series_is_refused() -> None:
    with pytest.raises(EvaluationError, match="frames 5 to 30"):
        reaction(np.zeros(20), 5, 30)
