"""What is promised of confidence that comes from an expected error, held for all that a camera may show."""

from dataclasses import fields, replace

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tcgsplat.confidence import equations as eq
from tcgsplat.confidence import expectation
from tcgsplat.confidence.state import ConfidenceConfig, ConfidenceState, Observation
from tcgsplat.presets import preset

repeatable = settings(deadline=None, derandomize=True, max_examples=30)
metres = st.floats(0, 0.5, width=32)
pixels = st.floats(2**-10, 60, width=32)
configs = st.builds(
    ConfidenceConfig,
    p_min=st.floats(0.01, 0.29),
    error_ref=st.floats(1e-3, 0.2),
    error_memory=st.floats(0.05, 0.95),
    error_prior=st.floats(0, 20),
)
frames = st.lists(st.tuples(pixels, metres), min_size=1, max_size=12)
PAPERS = ("paper-replica", "paper-tum", "paper-scannet")


def one(value: float) -> Tensor:
    return torch.tensor([value])


def born(error: float, config: ConfidenceConfig) -> ConfidenceState:
    return ConfidenceState.born_at(0, 1, config, expected_error=one(error))


def shown(state: ConfidenceState, drawn: float, error: float, config: ConfidenceConfig) -> ConfidenceState:
    """After a frame that draws it in so many pixels, each off by so much."""
    return state.experienced(one(drawn), one(drawn) * error, config)


def same(a: ConfidenceState, b: ConfidenceState) -> bool:
    return all(torch.equal(getattr(a, field.name), getattr(b, field.name)) for field in fields(ConfidenceState))


@repeatable
@given(errors=st.lists(st.floats(0, 1e4), min_size=2, max_size=8), config=configs)
def test_confidence_is_within_its_bounds_and_falls_with_the_error(
    errors: list[float], config: ConfidenceConfig
) -> None:
    ordered = torch.tensor(sorted(errors))
    p = expectation.confidence(ordered, error_ref=config.error_ref, p_min=config.p_min)
    assert ((p >= torch.tensor(config.p_min)) & (p <= 1)).all()
    assert (p.diff() <= 0).all()
    apart = ordered.diff() > 1e-3 * (ordered[:-1] + config.error_ref)
    told = p[:-1] - torch.tensor(config.p_min) > 1e-3  # far down, float32 cannot tell
    assert (p.diff()[apart & told] < 0).all()


@repeatable
@given(first=metres, frames=frames, config=configs)
def test_whatever_is_shown_all_bounds_hold(
    first: float, frames: list[tuple[float, float]], config: ConfidenceConfig
) -> None:
    """Expected errors are averages of what was met; evidence is what a memory of lambda can hold."""
    state, met, most = born(first, config), [first], 0.0
    for drawn, error in frames:
        state, most = shown(state, drawn, error, config), max(most, drawn)
        met.append(error)
        assert torch.tensor(config.p_min) <= state.value <= 1
        assert min(met) - 1e-6 <= state.expected_error.item() <= max(met) + 1e-6
        limit = max(config.error_prior, max(most, 1.0) / (1 - config.error_memory))
        assert 0 < state.evidence.item() <= limit * (1 + 1e-5)


@repeatable
@given(first=metres, frames=frames, updates=st.integers(1, 40), config=configs)
def test_what_is_not_seen_stays_however_long(
    first: float, frames: list[tuple[float, float]], updates: int, config: ConfidenceConfig
) -> None:
    state = born(first, config)
    for drawn, error in frames:
        state = shown(state, drawn, error, config)
    later, unseen = state, Observation(torch.tensor([False]), torch.zeros(1), torch.zeros(1))
    for _ in range(updates):
        later = later.experienced(torch.zeros(1), torch.zeros(1), config).observed(unseen, config)
    assert same(later.sealed(config), state)


@repeatable
@given(first=metres, drawn=pixels, count=st.integers(1, 40), config=configs)
def test_a_still_camera_never_loses_confidence_in_what_is_right(
    first: float, drawn: float, count: int, config: ConfidenceConfig
) -> None:
    state = born(first, config)
    for _ in range(count):
        after = shown(state, drawn, 0.0, config)
        assert after.value >= state.value
        assert after.expected_error <= state.expected_error
        state = after


@repeatable
@given(first=metres, error=metres, drawn=st.floats(1, 60), config=configs)
def test_seen_again_and_again_it_comes_to_expect_what_it_sees(
    first: float, error: float, drawn: float, config: ConfidenceConfig
) -> None:
    """Towards its limit from one side, and there within a few memories."""
    state = born(first, config)
    limit = expectation.confidence(one(error), error_ref=config.error_ref, p_min=config.p_min)
    distance = (state.value - limit).abs()
    for _ in range(int(12 / (1 - config.error_memory)) + 1):
        state = shown(state, drawn, error, config)
        nearer = (state.value - limit).abs()
        assert nearer <= distance + 1e-6
        distance = nearer
    assert distance < 1e-3


@repeatable
@given(calm=st.integers(1, 40), drawn=st.floats(0.5, 60), error=st.floats(0.1, 0.5))
def test_a_sudden_error_is_found_out_in_five_frames_and_forgiven_when_it_ends(
    calm: int, drawn: float, error: float
) -> None:
    """With a memory of ten frames five of ten centimetres take a third, sixty right ones bring most of it back."""
    config = ConfidenceConfig(p_min=0.1, error_ref=0.03, error_memory=0.9, error_prior=4.0)
    state = born(0.005, config)
    for _ in range(calm):
        state = shown(state, drawn, 0.002, config)
    before = state.value.item()
    for _ in range(5):
        fallen = shown(state, drawn, error, config)
        assert fallen.value < state.value
        state = fallen
    assert state.value.item() < 0.75 * before
    lowest = state.value.item()
    for _ in range(60):
        risen = shown(state, drawn, 0.002, config)
        assert risen.value > state.value
        state = risen
    assert state.value.item() > lowest + 0.7 * (before - lowest)


@repeatable
@given(first=metres, frames=frames, more=metres, config=configs)
def test_who_was_farther_off_is_never_the_more_confident(
    first: float, frames: list[tuple[float, float]], more: float, config: ConfidenceConfig
) -> None:
    right = wrong = born(first, config)
    for drawn, error in frames:
        right, wrong = shown(right, drawn, error, config), shown(wrong, drawn, error + more, config)
    assert wrong.value <= right.value


@repeatable
@given(
    frames=st.lists(st.tuples(st.booleans(), pixels, metres), min_size=1, max_size=10),
    seed=st.integers(0, 2**32 - 1),
    config=configs,
)
def test_rows_do_not_know_of_each_other(
    frames: list[tuple[bool, float, float]], seed: int, config: ConfidenceConfig
) -> None:
    draw = torch.Generator().manual_seed(seed)
    errors = 0.5 * torch.rand(5, generator=draw)
    all_rows = ConfidenceState.born_at(0, 5, config, expected_error=errors)
    alone = born(errors[2].item(), config)
    for seen, drawn, error in frames:
        rest = 10 * torch.rand(5, generator=draw)
        rest[2] = drawn if seen else 0.0
        off = rest * torch.rand(5, generator=draw)
        off[2] = rest[2] * error
        all_rows = all_rows.experienced(rest, off, config)
        alone = alone.experienced(rest[2:3], off[2:3], config)
    assert same(all_rows.kept(torch.arange(5) == 2), alone)


@repeatable
@given(depth=st.integers(0, 2**32 - 1), holes=st.floats(0, 1), floor=st.floats(0, 0.01), largest=st.floats(0.05, 1.0))
def test_a_readings_error_is_within_its_bounds(depth: int, holes: float, floor: float, largest: float) -> None:
    draw = torch.Generator().manual_seed(depth)
    readings = 0.3 + 6 * torch.rand(7, 9, generator=draw)
    readings[torch.rand(7, 9, generator=draw) < holes] = 0.0
    error = expectation.reading_error(readings, noise_floor=floor, noise_slope=0.002, largest=largest)
    assert (error[readings == 0] == torch.tensor(largest)).all()
    assert ((error >= torch.tensor(floor)) & (error <= torch.tensor(largest))).all()


@repeatable
@given(depth=st.floats(0.5, 5), step=st.floats(0.05, 0.4), column=st.integers(2, 6), transposed=st.booleans())
def test_beside_a_step_a_reading_may_be_off_by_its_height(
    depth: float, step: float, column: int, transposed: bool
) -> None:
    readings = torch.full((9, 9), depth)
    readings[:, column:] += step
    if transposed:
        readings = readings.T.contiguous()
    error = expectation.reading_error(readings, noise_floor=0.0, noise_slope=0.0, largest=0.5)
    error = error.T if transposed else error
    torch.testing.assert_close(error[:, column - 1 : column + 1], torch.full((9, 2), step), atol=1e-5, rtol=0)
    assert error[:, : column - 1].max() == error[:, column + 1 :].max() == 0


@repeatable
@given(
    seed=st.integers(0, 2**32 - 1),
    name=st.sampled_from(PAPERS),
    clock=st.integers(0, 50),
    updates=st.integers(1, 12),
)
def test_a_published_preset_is_the_papers_equations_to_the_bit(seed: int, name: str, clock: int, updates: int) -> None:
    config, draw, n = preset(name).confidence, torch.Generator().manual_seed(seed), 20
    error = torch.rand(n, generator=draw)
    state = ConfidenceState.born_at(clock, n, config, expected_error=error)
    p, baseline, count = torch.full((n,), config.initial), torch.zeros(n), torch.zeros(n, dtype=torch.int64)
    for _ in range(updates):
        valid = torch.rand(n, generator=draw) < 0.6
        d, r = 0.02 * torch.rand(n, generator=draw), 0.3 * torch.rand(n, generator=draw)
        state = state.experienced(torch.rand(n, generator=draw), torch.rand(n, generator=draw), config)
        state = state.observed(Observation(valid, d, r), config)

        decayed = eq.decay(p, decay_time=config.decay_time, p_min=config.p_min)
        excitation, penalty = eq.feedback(
            eq.observation_quality(r, residual_ref=config.residual_ref),
            eq.relative_stability(baseline, d, scale=config.stability_scale),
            excitation_gain=config.excitation_gain,
            penalty_gain=config.penalty_gain,
        )
        first = eq.first_excitation(d, r, distance_ref=config.distance_ref, residual_ref=config.residual_ref)
        excitation, penalty = torch.where(count == 0, first, excitation), torch.where(count == 0, 0.0, penalty)
        fed = eq.apply_feedback(decayed, excitation, penalty, rate=config.update_rate, p_min=config.p_min)
        averaged = torch.where(count == 0, d, eq.update_baseline(baseline, d, rate=config.baseline_rate))
        p, baseline, count = torch.where(valid, fed, decayed), torch.where(valid, averaged, baseline), count + valid
    assert torch.equal(state.value, p) and torch.equal(state.baseline, baseline) and torch.equal(state.updates, count)
    assert not state.expected_error.any() and not state.evidence.any()
    sealed = eq.calibrate_age(p, state.born, decay_time=config.decay_time, p_min=config.p_min)
    assert torch.equal(state.sealed(config).value, sealed)
    assert same(replace(state.sealed(config), value=p), state)
