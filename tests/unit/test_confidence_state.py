"""The state of the Gaussians' confidence: its settings, its two transitions, and its rows."""

import math
from dataclasses import fields

import pytest
import torch
from torch import Tensor

from tcgsplat.confidence.state import ConfidenceConfig, ConfidenceState, Observation
from tcgsplat.errors import ConfigError

CONFIG = ConfidenceConfig(
    model="paper",
    p_min=0.1,
    initial=0.3,
    decay_time=100.0,
    residual_ref=0.1,
    distance_ref=0.01,
    stability_scale=0.002,
    excitation_gain=2.0,
    penalty_gain=0.5,
    update_rate=0.3,
    baseline_rate=0.1,
)
KEPT = math.exp(-1 / 100)  # what one update of decay leaves of the height above the floor


def seen(distance: list[float], residual: list[float], valid: list[bool] | None = None) -> Observation:
    flags = [True] * len(distance) if valid is None else valid
    return Observation(torch.tensor(flags, dtype=torch.bool), torch.tensor(distance), torch.tensor(residual))


def close(actual: Tensor, *expected: float) -> None:
    torch.testing.assert_close(actual, torch.tensor(expected))


def test_defaults_are_the_papers_where_the_paper_states_them() -> None:
    config = ConfidenceConfig()
    assert config.tracking_floor == 0.2
    assert config.stability_weight == 0.01
    assert config.guide_mapping
    assert config.guide_tracking
    assert config.rerank_views


def test_no_decay_is_a_valid_setting() -> None:
    config = ConfidenceConfig(model="paper", decay_time=math.inf)
    state = ConfidenceState.born_at(3, 2, config)
    close(state.observed(seen([0.0, 0.0], [0.0, 0.0], [False, False]), config).sealed(config).value, 0.3, 0.3)


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("p_min", 0.0, "above 0 and below 1"),
        ("p_min", math.nan, "above 0 and below 1"),
        ("initial", 0.05, "between p_min (0.1) and 1"),
        ("decay_time", 0.0, "above 0 mapping updates (inf for no decay)"),
        ("residual_ref", 0.0, "above 0 and finite"),
        ("distance_ref", -1.0, "above 0 and finite"),
        ("stability_scale", math.inf, "above 0 and finite"),
        ("maturity_time", 0.0, "above 0 and finite"),
        ("scale_change_weight", -0.1, "at least 0 and finite"),
        ("rotation_change_weight", math.nan, "at least 0 and finite"),
        ("color_residual_weight", -1.0, "at least 0 and finite"),
        ("depth_residual_weight", -1.0, "at least 0 and finite"),
        ("excitation_gain", -1.0, "at least 0 and finite"),
        ("penalty_gain", -1.0, "at least 0 and finite"),
        ("stability_weight", -1.0, "at least 0 and finite"),
        ("slack_min", -1.0, "at least 0 and finite"),
        ("slack_max", 0.001, "at least slack_min (0.002) and finite"),
        ("step_scale_min", -0.1, "at least 0 and finite"),
        ("step_scale_max", 0.5, "at least step_scale_min (1) and finite"),
        ("update_rate", 0.0, "above 0 and at most 1"),
        ("baseline_rate", 1.5, "above 0 and at most 1"),
        ("tracking_floor", 0.0, "above 0 and at most 1"),
        ("view_floor", 1.1, "between 0 and 1"),
        ("doubt_weight", -1.0, "above -1 and finite"),
        ("stability_reduction", "max", '"mean" or "sum"'),
        ("step_scale_mode", "adam", '"step" or "gradient"'),
        ("model", "base", '"expectation" or "paper" or "constant" or "shuffled"'),
        ("error_ref", 0.0, "above 0 and finite"),
        ("error_max", math.inf, "above 0 and finite"),
        ("error_memory", 0.0, "above 0 and at most 1"),
        ("error_prior", -1.0, "at least 0 and finite"),
        ("noise_floor", -0.001, "at least 0 and finite"),
        ("noise_slope", math.inf, "at least 0 and finite"),
    ],
)
def test_settings_that_cannot_be_right_are_refused_by_name(name: str, value: object, allowed: str) -> None:
    with pytest.raises(ConfigError) as caught:
        ConfidenceConfig(**{name: value})
    assert str(caught.value) == f"confidence.{name} is {value!r}; it must be {allowed}"


def test_every_number_is_checked() -> None:
    for field in fields(ConfidenceConfig):
        if field.type is float:
            with pytest.raises(ConfigError):
                ConfidenceConfig(**{field.name: math.nan})


def test_a_newborn_has_the_initial_confidence_and_no_history() -> None:
    state = ConfidenceState.born_at(7, 2, CONFIG)
    close(state.value, 0.3, 0.3)
    close(state.baseline, 0.0, 0.0)
    assert state.born.tolist() == [7, 7]
    assert state.updates.tolist() == [0, 0]
    assert not state.has_baseline.any()
    assert len(state) == 2


def test_a_first_observation_is_judged_absolutely() -> None:
    state = ConfidenceState.born_at(0, 1, CONFIG).observed(seen([0.005], [0.05]), CONFIG)
    decayed = 0.1 + 0.2 * KEPT
    excitation = math.exp(-0.5 - 0.5)  # the gain of equation 12 does not multiply it, the rate of equation 13 does
    close(state.value, decayed + 0.3 * excitation * (1 - decayed))
    close(state.baseline, 0.005)
    assert state.updates.tolist() == [1]
    assert state.has_baseline.all()


def test_a_first_observation_is_never_a_penalty() -> None:
    state = ConfidenceState.born_at(0, 1, CONFIG).observed(seen([10.0], [10.0]), CONFIG)
    close(state.value, 0.1 + 0.2 * KEPT)


def test_later_observations_are_judged_against_the_baseline_before_its_update() -> None:
    once = ConfidenceState.born_at(0, 2, CONFIG).observed(seen([0.005, 0.005], [0.05, 0.05]), CONFIG)
    twice = once.observed(seen([0.003, 0.007], [0.05, 0.05]), CONFIG)
    decayed = 0.1 + (once.value[0].item() - 0.1) * KEPT
    gain = 0.3 * 2.0 * math.exp(-0.5) * math.tanh(1) * (1 - decayed)
    loss = 0.3 * 0.5 * math.tanh(1) * (decayed - 0.1)
    close(twice.value, decayed + gain, decayed - loss)
    close(twice.baseline, 0.9 * 0.005 + 0.1 * 0.003, 0.9 * 0.005 + 0.1 * 0.007)
    assert twice.updates.tolist() == [2, 2]


def test_what_is_not_seen_only_fades() -> None:
    once = ConfidenceState.born_at(0, 2, CONFIG).observed(seen([0.005, 0.005], [0.0, 0.0]), CONFIG)
    twice = once.observed(seen([math.nan, 0.005], [math.nan, 0.0], [False, True]), CONFIG)
    close(twice.value[:1], 0.1 + (once.value[0].item() - 0.1) * KEPT)
    close(twice.baseline[:1], 0.005)
    assert twice.updates.tolist() == [1, 2]


def test_a_value_that_is_not_a_number_counts_as_not_seen() -> None:
    state = ConfidenceState.born_at(0, 2, CONFIG).observed(seen([math.nan, 0.0], [0.0, math.nan]), CONFIG)
    close(state.value, *[0.1 + 0.2 * KEPT] * 2)
    assert state.updates.tolist() == [0, 0]


def test_sealing_compensates_for_a_late_birth() -> None:
    early, late = ConfidenceState.born_at(0, 1, CONFIG), ConfidenceState.born_at(50, 1, CONFIG)
    close(early.appended(late).sealed(CONFIG).value, 0.3, 0.1 + 0.2 * math.exp(-0.5))


def test_transitions_keep_no_gradients_and_leave_the_old_state_alone() -> None:
    state = ConfidenceState.born_at(0, 1, CONFIG)
    distance = torch.tensor([0.001], requires_grad=True)
    after = state.observed(Observation(torch.tensor([True]), distance, distance), CONFIG)
    assert not after.value.requires_grad
    assert not after.baseline.requires_grad
    close(state.value, 0.3)
    assert state.updates.tolist() == [0]


def test_rows_keep_their_types_through_everything() -> None:
    state = ConfidenceState.empty().appended(ConfidenceState.born_at(0, 3, CONFIG))
    state = state.kept(torch.tensor([True, False, True])).observed(seen([0.0] * 2, [0.0] * 2), CONFIG).sealed(CONFIG)
    state = state.to(torch.device("cpu"))
    assert state.value.dtype == state.baseline.dtype == torch.float32
    assert state.born.dtype == state.updates.dtype == torch.int64
    assert len(state) == 2


def test_an_empty_map_can_be_observed_and_sealed() -> None:
    state = ConfidenceState.empty().observed(seen([], [], []), CONFIG).sealed(CONFIG)
    assert len(state) == 0


def test_lengths_follow_the_steps_of_an_update():
    config = ConfidenceConfig()
    quarter = config.for_updates_of(25)
    for name in ("distance_ref", "stability_scale", "slack_min", "slack_max"):
        assert getattr(quarter, name) == pytest.approx(0.5 * getattr(config, name))
    assert quarter.decay_time == config.decay_time
    assert config.for_updates_of(100) == config
