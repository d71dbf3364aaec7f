"""Scores of uncertainty maps: against slow obvious versions, scipy, and cases made by hand."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from tcgsplat.errors import EvaluationError
from tcgsplat.evaluation import uncertainty as un

coarse = st.integers(0, 5).map(lambda i: i / 4)  # so that there are ties
fine = st.floats(0.0, 4.0, width=32).map(float)


@st.composite
def pairs(draw: Callable, least: int = 1) -> tuple[np.ndarray, np.ndarray]:
    n = draw(st.integers(least, 40))
    u, e = (draw(arrays(np.float64, n, elements=draw(st.sampled_from((coarse, fine))))) for _ in range(2))
    return u, e


def noisy(n: int = 5000, noise: float = 1.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    e = np.abs(generator.normal(size=n))
    return e + noise * generator.normal(size=n), e


def slow_curve(u: np.ndarray, e: np.ndarray, fractions: np.ndarray) -> list[float]:
    """Mean over what is kept, in expectation: each pixel counts with its chance to be kept."""
    curve = []
    for r in fractions:
        kept = max(1, math.floor((1 - r) * len(e)))
        total = 0.0
        for i in range(len(u)):
            below, tied = sum(u < u[i]), sum(u == u[i])
            total += e[i] * min(max((kept - below) / tied, 0.0), 1.0)
        curve.append(total / kept)
    return curve


@settings(max_examples=50)
@given(pairs())
def test_curves_are_expected_means_of_what_is_kept(pair: tuple[np.ndarray, np.ndarray]) -> None:
    u, e = pair
    fractions = np.array([0.0, 0.13, 0.5, 0.75, 0.999])
    found = un.sparsification(u, e, fractions)
    np.testing.assert_allclose(found.error, slow_curve(u, e, fractions), atol=1e-12)
    np.testing.assert_allclose(found.oracle, slow_curve(e, e, fractions), atol=1e-12)
    root = un.sparsification(u, e, fractions, mean="rmse")
    np.testing.assert_allclose(root.error, np.sqrt(slow_curve(u, e**2, fractions)), atol=1e-8)
    assert root.random == pytest.approx(math.sqrt(np.mean(e**2)))


def test_ties_count_in_expectation_over_their_order() -> None:
    generator = np.random.default_rng(3)
    u, e = generator.integers(0, 4, 200).astype(float), generator.random(200)
    broken = [un.sparsification(u + 1e-3 * generator.random(200), e).error for _ in range(800)]
    np.testing.assert_allclose(un.sparsification(u, e).error[:90], np.mean(broken, axis=0)[:90], atol=0.02)


def fisher_rf(u: np.ndarray, e: np.ndarray) -> float:
    """The definition, step by step, for values without ties."""
    by_u, by_e, n = e[np.argsort(u)], np.sort(e), len(e)
    removed = np.linspace(0, 0.999, 100)
    ours = np.array([by_u[: int((1 - r) * n)].mean() for r in removed])
    best = np.array([by_e[: int((1 - r) * n)].mean() for r in removed])
    highest = max(ours.max(), best.max())
    return float(np.trapezoid(ours / highest - best / highest, removed))


@pytest.mark.parametrize("noise", [0.1, 1.0, 10.0])
def test_ause_is_that_of_fisher_rf(noise: float) -> None:
    u, e = noisy(noise=noise)
    assert un.ause(u, e) == pytest.approx(fisher_rf(u, e), abs=1e-12)


@pytest.mark.parametrize("mean", ["mae", "rmse"])
def test_oracle_constant_and_reversed_maps(mean: un.Mean) -> None:
    _, e = noisy()
    assert un.normalised_ause(np.exp(e), e, mean=mean) == 0.0
    assert un.normalised_ause(np.full(len(e), 0.7), e, mean=mean) == pytest.approx(1.0, abs=1e-12)
    assert un.normalised_ause(-e, e, mean=mean) > 1.5


def test_a_random_map_scores_one() -> None:
    generator = np.random.default_rng(0)
    e = generator.exponential(size=4000)
    scores = [un.normalised_ause(generator.random(4000), e) for _ in range(50)]
    assert np.mean(scores) == pytest.approx(1.0, abs=0.02)


@settings(max_examples=50)
@given(pairs(least=3))
def test_no_map_beats_the_oracle(pair: tuple[np.ndarray, np.ndarray]) -> None:
    u, e = pair
    found = un.sparsification(u, e)
    assert (found.oracle <= found.error + 1e-12).all()
    assert math.isnan(found.normalised_ause) or found.normalised_ause >= -1e-9


def test_normalised_ause_is_the_ratio_for_maps_that_never_rise() -> None:
    u, e = noisy(20_000, noise=0.5)
    assert (un.sparsification(u, e).error <= e.mean() + 1e-12).all()
    assert un.normalised_ause(u, e) == pytest.approx(un.ause(u, e) / un.ause_of_random(e), rel=1e-9)


def test_the_common_maximum_flatters_a_reversed_map_and_the_normalised_score_does_not() -> None:
    e = np.zeros(1000)
    e[3] = 1.0
    assert un.ause(-e, e) < 0.02 < 0.9 < un.ause_of_random(e)
    assert un.normalised_ause(-e, e) > 5


def test_without_error_or_with_equal_errors_there_is_nothing_to_score() -> None:
    u = np.random.default_rng(0).random(500)
    assert math.isnan(un.ause(u, np.zeros(500)))
    assert math.isnan(un.ause_of_random(np.zeros(500)))
    assert math.isnan(un.normalised_ause(u, np.zeros(500)))
    assert math.isnan(un.normalised_ause(u, np.full(500, 0.1)))
    assert un.ause(u, np.full(500, 0.1)) == pytest.approx(0.0, abs=1e-12)


@settings(max_examples=50)
@given(pairs(least=2))
def test_spearman_is_scipys(pair: tuple[np.ndarray, np.ndarray]) -> None:
    u, e = pair
    if np.ptp(u) == 0 or np.ptp(e) == 0:
        assert math.isnan(un.spearman(u, e))
    else:
        assert un.spearman(u, e) == pytest.approx(stats.spearmanr(u, e).statistic, abs=1e-9)


def slow_partial(u: np.ndarray, e: np.ndarray, controls: list[np.ndarray]) -> float:
    design = np.stack([np.ones(len(u)), *(stats.rankdata(c) for c in controls)], axis=1)
    residuals = []
    for values in (u, e):
        ranks = stats.rankdata(values)
        residuals.append(ranks - design @ np.linalg.lstsq(design, ranks)[0])
    return float(np.corrcoef(*residuals)[0, 1])


def test_partial_spearman_is_the_correlation_of_residuals() -> None:
    generator = np.random.default_rng(1)
    depth, texture = generator.random(400), generator.integers(0, 6, 400).astype(float)
    e = depth + generator.random(400) + 0.1 * texture
    u = depth + 0.5 * e + generator.random(400)
    assert un.partial_spearman(u, e, [depth, texture]) == pytest.approx(slow_partial(u, e, [depth, texture]), abs=1e-9)


def test_what_the_controls_explain_does_not_count() -> None:
    generator = np.random.default_rng(2)
    depth = generator.random(20_000)
    u, e = depth + 0.2 * generator.random(20_000), depth + 0.2 * generator.random(20_000)
    assert un.spearman(u, e) > 0.9
    assert abs(un.partial_spearman(u, e, [depth])) < 0.05


def test_controls_may_repeat_each_other_or_be_constant() -> None:
    u, e = noisy()
    depth = e + np.random.default_rng(5).random(len(e))
    once = un.partial_spearman(u, e, [depth])
    assert un.partial_spearman(u, e, [depth, 2 * depth, -depth, np.ones(len(e))]) == pytest.approx(once, abs=1e-9)
    assert un.partial_spearman(u, e, [np.ones(len(e))]) == pytest.approx(un.spearman(u, e), abs=1e-12)
    assert math.isnan(un.partial_spearman(u, e, [u]))
    assert math.isnan(un.partial_spearman(u, e, [depth, u**3, u]))


@settings(max_examples=50)
@given(pairs(), st.data())
def test_auroc_is_the_share_of_pairs_won(pair: tuple[np.ndarray, np.ndarray], data: st.DataObject) -> None:
    u, _ = pair
    bad = data.draw(arrays(np.bool_, len(u)))
    won = [float(b > g) + 0.5 * float(b == g) for b in u[bad] for g in u[~bad]]
    if won:
        assert un.auroc(u, bad) == pytest.approx(np.mean(won), abs=1e-12)
    else:
        assert math.isnan(un.auroc(u, bad))


@settings(max_examples=50)
@given(pairs(), st.data())
def test_auprc_is_precision_summed_over_recall(pair: tuple[np.ndarray, np.ndarray], data: st.DataObject) -> None:
    u, _ = pair
    bad = data.draw(arrays(np.bool_, len(u)))
    if not bad.any():
        assert math.isnan(un.auprc(u, bad))
        return
    area, recall = 0.0, 0.0
    for threshold in sorted(set(u.tolist()), reverse=True):
        found = u >= threshold
        area += (bad & found).sum() / found.sum() * ((bad & found).sum() / bad.sum() - recall)
        recall = (bad & found).sum() / bad.sum()
    assert un.auprc(u, bad) == pytest.approx(area, abs=1e-12)


def test_detection_by_perfect_constant_and_reversed_maps() -> None:
    bad = np.arange(100) < 20
    assert (un.auroc(bad.astype(float), bad), un.auprc(bad.astype(float), bad)) == (1.0, 1.0)
    assert (un.auroc(np.ones(100), bad), un.auprc(np.ones(100), bad)) == (0.5, pytest.approx(0.2))
    assert un.auroc(-bad.astype(float), bad) == 0.0


@settings(max_examples=50)
@given(pairs())
def test_no_monotone_function_fits_better(pair: tuple[np.ndarray, np.ndarray]) -> None:
    """The minimum over monotone fits: value at i is max over starts, min over ends, of the mean in between."""
    u, e = pair
    fit = un.calibrated(u, e)
    levels = np.unique(u)
    for at in levels:
        best = max(
            min(e[(u >= low) & (u <= high)].mean() for high in levels if high >= at) for low in levels if low <= at
        )
        assert fit.expected_error(np.array([at]))[0] == pytest.approx(best, abs=1e-9)


def test_calibration_is_monotone_and_flat_outside() -> None:
    u, e = noisy()
    fit = un.calibrated(u, e)
    assert (np.diff(fit.uncertainty) > 0).all()
    assert (np.diff(fit.error) >= 0).all()
    assert fit.expected_error(np.array([-99.0, 99.0])).tolist() == [fit.error[0], fit.error[-1]]
    assert fit.expected_error(u).mean() == pytest.approx(e.mean())


@settings(max_examples=50)
@given(pairs())
def test_bins_share_pixels_that_tie(pair: tuple[np.ndarray, np.ndarray]) -> None:
    expected, e = pair
    found = un.reliability(expected, e, bins=4)
    n, k = len(e), min(4, len(e))
    order = np.argsort(expected, kind="stable")
    tied_mean = np.array([e[expected == value].mean() for value in expected[order]])
    fine = np.repeat(tied_mean, k).reshape(k, n).mean(axis=1)  # each pixel as k equal parts
    np.testing.assert_allclose(found.found, fine, atol=1e-9)
    np.testing.assert_allclose(found.expected, np.repeat(expected[order], k).reshape(k, n).mean(axis=1), atol=1e-9)
    levels = [expected[order][i * (n - 1) // 1000] for i in range(1001)]
    assert found.quantiles.tolist() == levels
    assert found.ece == pytest.approx(np.abs(found.expected - found.found).mean())


def test_calibration_error_by_hand() -> None:
    expected, e = np.array([1.0, 1.0, 3.0, 3.0]), np.array([1.0, 2.0, 2.0, 3.0])
    found = un.reliability(expected, e, bins=2)
    assert (found.expected.tolist(), found.found.tolist()) == ([1.0, 3.0], [1.5, 2.5])
    assert (found.ece, found.normalised_ece) == (0.5, 0.25)
    assert un.ece(e, e) == 0.0
    assert math.isnan(un.reliability(expected, np.zeros(4)).normalised_ece)


def test_calibration_carries_over_to_other_images() -> None:
    fit = un.calibrated(*noisy(20_000, seed=0))
    u, e = noisy(20_000, seed=1)
    same, doubled = (un.reliability(fit.expected_error(u), scale * e).normalised_ece for scale in (1.0, 2.0))
    assert same < 0.05
    assert doubled == pytest.approx(0.5, abs=0.03)


def test_all_scores_at_once_are_the_scores_one_by_one() -> None:
    u, e = noisy(600)
    depth = np.random.default_rng(9).random(600)
    scores = un.Scores.of(u.astype(np.float32), e, e > 1, [depth])
    u = u.astype(np.float32).astype(np.float64)
    assert scores == un.Scores(
        pixels=600,
        mean_error=float(e.mean()),
        ause=un.ause(u, e),
        ause_rmse=un.ause(u, e, mean="rmse"),
        normalised_ause=un.normalised_ause(u, e),
        normalised_ause_rmse=un.normalised_ause(u, e, mean="rmse"),
        spearman=un.spearman(u, e),
        partial_spearman=un.partial_spearman(u, e, [depth]),
        auroc=un.auroc(u, e > 1),
        auprc=un.auprc(u, e > 1),
        bad_share=float((e > 1).mean()),
    )
    assert math.isnan(un.Scores.of(u, e, e > 1).partial_spearman)


def test_what_cannot_be_scored_is_refused() -> None:
    with pytest.raises(EvaluationError, match="no pixel has an uncertainty"):
        un.ause(np.zeros(0), np.zeros(0))
    with pytest.raises(EvaluationError, match="an uncertainty is NaN at 1 of 2 pixels"):
        un.ause(np.array([0.1, np.nan]), np.ones(2))
    with pytest.raises(EvaluationError, match="negative"):
        un.spearman(np.ones(2), np.array([0.1, -0.1]))
