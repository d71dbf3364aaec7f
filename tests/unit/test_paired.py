"""Paired differences: means by hand, the bootstrap against loops, what is left out, and coverage."""

import math

import numpy as np
import pytest
from scipy import stats

from tcgsplat.errors import EvaluationError
from tcgsplat.evaluation.paired import Run, bootstrap_means, paired_differences, relative_differences


def results(effect: float, *, sequences: int = 6, seeds: int = 4, noise: float = 0.1) -> dict[Run, float]:
    generator = np.random.default_rng(0)
    found: dict[Run, float] = {}
    for i in range(sequences):
        for seed in range(seeds):
            common = 10.0 * i + 5.0 * generator.standard_normal()  # what pairing takes away
            found["off", f"room{i}", seed] = common
            found["ours", f"room{i}", seed] = common + effect + noise * float(generator.standard_normal())
    return found


def test_pairing_finds_a_small_effect_below_large_differences_of_sequences() -> None:
    (found,) = paired_differences(results(-0.3), "off")
    assert (found.arm, found.reference, found.pairs, found.left_out) == ("ours", "off", 24, 0)
    assert found.low < -0.3 < found.high < 0
    assert found.low < found.mean < found.high
    assert found.p_of_pairs < 1e-4
    assert found.p_of_sequences == pytest.approx(2 / 2**6)  # all six of one sign: the least there can be


def test_an_arm_without_effect_has_an_interval_about_zero() -> None:
    (found,) = paired_differences(results(0.0), "off")
    assert found.low < 0 < found.high
    assert found.p_of_pairs > 0.05


def test_sequences_count_the_same_whatever_their_number_of_seeds() -> None:
    values: dict[Run, float] = {("off", s, i): 0.0 for s in "ab" for i in range(3)}
    values |= {("ours", "a", 0): 1.0, ("ours", "a", 1): 1.0, ("ours", "a", 2): 1.0, ("ours", "b", 0): 3.0}
    values |= {("ours", "b", 1): math.nan, ("ours", "b", 2): math.inf, ("ours", "c", 0): 100.0}
    (found,) = paired_differences(values, "off")
    assert found.mean == 2.0
    assert found.by_sequence == {"a": 1.0, "b": 3.0}
    assert (found.pairs, found.left_out) == (4, 3)
    assert found.p_of_pairs == pytest.approx(stats.wilcoxon([1.0, 1.0, 1.0, 3.0]).pvalue)


def test_intervals_hang_on_the_seed_and_not_on_order_or_other_arms() -> None:
    values = results(-0.3)
    (found,) = paired_differences(values, "off", seed=1)
    assert list(found.by_sequence) == [f"room{i}" for i in range(6)]
    other = {("other", sequence, seed): 0.0 for _, sequence, seed in values}
    assert paired_differences(other | dict(reversed(values.items())), "off", seed=1)[1] == found
    (again,) = paired_differences(values, "off", seed=2)
    assert again.low != found.low
    assert again.low == pytest.approx(found.low, abs=0.01)


def test_bootstrap_draws_sequences_and_then_seeds() -> None:
    """Against a loop that does it as one would say it, by mean and quantiles of many draws."""
    groups = [np.array([0.0, 1.0]), np.array([4.0]), np.array([2.0, 7.0, 9.0])]
    generator = np.random.default_rng(0)
    slow = []
    for _ in range(8000):
        drawn = [groups[i] for i in generator.integers(0, 3, 3)]
        slow.append(np.mean([generator.choice(group, len(group)).mean() for group in drawn]))
    quick = bootstrap_means(groups, 40_000, np.random.default_rng(1))
    assert quick.mean() == pytest.approx(np.mean(slow), abs=0.06)
    assert quick.std() == pytest.approx(np.std(slow), rel=0.05)
    for level in (0.025, 0.5, 0.975):
        assert np.quantile(quick, level) == pytest.approx(np.quantile(slow, level), abs=0.25)


def test_interval_holds_the_truth_about_as_often_as_it_says() -> None:
    generator = np.random.default_rng(0)
    held = 0
    for _ in range(200):
        x = generator.normal(size=(15, 1)) + generator.normal(size=(15, 3))
        low, high = np.quantile(bootstrap_means(list(x), 400, generator), (0.025, 0.975))
        held += low <= 0 <= high
    assert 0.9 <= held / 200 <= 0.99


def test_one_sequence_speaks_of_seeds_and_one_pair_of_nothing() -> None:
    (found,) = paired_differences(results(-0.3, sequences=1), "off")
    assert found.low < -0.3 < found.high
    (found,) = paired_differences(results(-0.3, sequences=1, seeds=1), "off")
    assert math.isnan(found.low)
    assert math.isnan(found.high)
    assert math.isfinite(found.mean)


def test_equal_arms_have_no_p() -> None:
    values = {(arm, sequence, 0): 1.0 for arm in ("off", "ours") for sequence in "abc"}
    (found,) = paired_differences(values, "off")
    assert (found.mean, found.low, found.high) == (0.0, 0.0, 0.0)
    assert math.isnan(found.p_of_pairs)


def test_arms_without_a_common_run_are_not_there_and_an_unknown_reference_is_refused() -> None:
    values: dict[Run, float] = {("off", "a", 0): 1.0, ("ours", "b", 0): 1.0, ("third", "a", 0): 0.5}
    assert [d.arm for d in paired_differences(values, "off")] == ["third"]
    with pytest.raises(EvaluationError, match="no result of the arm 'of'; there are off, ours, third"):
        paired_differences(values, "of")


def test_relative_differences_are_percent_whatever_the_size_and_failures_are_left_out() -> None:
    small, large = {("off", "a", 0): 0.01, ("ours", "a", 0): 0.008}, {("off", "b", 1): 50.0, ("ours", "b", 1): 40.0}
    failed = {("off", "c", 0): 1.0, ("ours", "c", 0): 0.0}
    (found,) = relative_differences(small | large | failed, "off")
    assert (found.mean, found.low, found.high) == pytest.approx((-20.0, -20.0, -20.0))
    assert found.by_sequence == pytest.approx({"a": -20.0, "b": -20.0})
    assert (found.pairs, found.left_out) == (2, 1)
