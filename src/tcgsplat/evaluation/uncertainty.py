"""Whether an uncertainty map tells where the errors are: scores of one number a pixel against the true error there.

Everywhere u is an uncertainty (1 - confidence, a predicted sigma, anything that is to grow with the error) and e >= 0 a
true error, both over the pixels of an image for which both are known. Only the order of u counts, but for
`calibrated`. Ties in u count in expectation over their random order, so a constant map scores as a random one does and
no score hangs on the order in which pixels are stored. Where a score is not defined (say, no pixel is bad) it is NaN.

Sorting is most of the work: `Ordered.of` does it once for several scores.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import isotonic_regression

from tcgsplat.errors import EvaluationError

Values = Float[np.ndarray, " n"]
Flags = Bool[np.ndarray, " n"]
Mean = Literal["mae", "rmse"]
"""How errors are averaged: their mean, or the root of their mean square."""

STEPS = 100
"""Points of a sparsification curve, as FisherRF has."""
_MOST_REMOVED = 0.999
_BINS = 15
_LEVELS = 1001
_NEGLIGIBLE = 1e-9
"""Share of a variance, or of an area, that rounding may leave of nothing."""


@dataclass(frozen=True)
class Ordered:
    """Values with their order from least to greatest, and where ties are."""

    values: Values
    """float64, in the order given."""
    indices: Int[np.ndarray, " n"]
    """Of the values, from least to greatest."""
    bounds: Int[np.ndarray, " ties"]
    """Places in the order at which a value begins that the place before has not: from 0; n ends the list."""
    ranks: Values
    """From 1; the mean rank for all that tie (midranks)."""

    @classmethod
    def of(cls, values: "Values | Ordered", name: str = "the value") -> "Ordered":
        """Sort values, unless they are sorted already.

        Raises:
            EvaluationError: if there are none, or one is not a number.
        """
        if isinstance(values, Ordered):
            return values
        if not len(values):
            raise EvaluationError(f"no pixel has {name}; score images in which some pixel has both a value and a truth")
        exact = values.astype(np.float64, copy=False)
        if np.isnan(exact).any():
            unknown = int(np.isnan(exact).sum())
            raise EvaluationError(f"{name} is NaN at {unknown} of {len(exact)} pixels; leave these out of both images")
        indices = np.argsort(exact)
        ascending = exact[indices]
        begins = np.flatnonzero(ascending[1:] != ascending[:-1]) + 1
        bounds = np.concatenate(([0], begins, [len(exact)]))
        ranks = np.empty_like(exact)
        ranks[indices] = np.repeat((bounds[:-1] + bounds[1:] + 1) / 2, np.diff(bounds))
        return cls(exact, indices, bounds, ranks)

    def __len__(self) -> int:
        return len(self.values)

    def sums(self, values: Values, places: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Sum of other values over the first places of this order, in expectation over random order of ties.

        Args:
            values: One for each of these.
            places: How many to sum, in [0, n]; a fraction takes that share of the last one.
        """
        cumulative = np.concatenate(([0.0], np.cumsum(values[self.indices])))
        return np.asarray(np.interp(places, self.bounds, cumulative[self.bounds]))


@dataclass(frozen=True)
class Sparsification:
    """Error of the pixels that are left when more and more of the most uncertain ones are removed (Ilg et al. 2018)."""

    removed: Float[np.ndarray, " steps"]
    """Share of the pixels, ascending."""
    error: Float[np.ndarray, " steps"]
    """Of the rest, when the most uncertain pixels are removed first; the unit is the error's."""
    oracle: Float[np.ndarray, " steps"]
    """Of the rest, when the worst pixels are removed first: no order does better."""
    random: float
    """Of the rest, when pixels are removed at random: that of all pixels."""

    @property
    def ause(self) -> float:
        """Area between the curve and the oracle's, both over their common maximum, as FisherRF defines it.

        0 for the oracle, and NaN if there is no error at all. Compare maps by `normalised_ause` rather: a map that is
        worse than random raises the maximum, which shrinks its area, at times below that of a random map.
        """
        highest = float(max(self.error.max(), self.oracle.max()))
        return self._area(self.error - self.oracle) / highest if highest > 0 else math.nan

    @property
    def normalised_ause(self) -> float:
        """Area between the curve and the oracle's over that of a random map: 0 oracle, 1 random, more is worse.

        This is `ause` over `ause_of_random` as long as the curve stays under its start, as that of a map better than
        random commonly does. NaN if all pixels have the same error, so that no order is better than any other.
        """
        at_random = self._area(self.random - self.oracle)
        return self._area(self.error - self.oracle) / at_random if at_random > _NEGLIGIBLE * self.random else math.nan

    def _area(self, difference: Float[np.ndarray, " steps"]) -> float:
        return float(np.trapezoid(difference, self.removed))


def sparsification(
    uncertainty: Values | Ordered,
    error: Values | Ordered,
    fractions: Float[np.ndarray, " steps"] | None = None,
    *,
    mean: Mean = "mae",
) -> Sparsification:
    """Remove the share r of the pixels with the largest u and average e over the rest, for each r.

    The rest are the floor((1 - r) n) pixels of least u, one at the least; ties in u count in expectation (for `rmse`
    the expectation is taken of the mean square). After E. Ilg et al., ECCV 2018; fractions after FisherRF (W. Jiang
    et al., ECCV 2024), `ause.py`.

    Args:
        uncertainty: u, any unit.
        error: e >= 0.
        fractions: r, ascending, in [0, 1); without, 100 from 0 to 0.999.
        mean: How e is averaged.

    Raises:
        EvaluationError: if there is no pixel, or a value is NaN, or an error negative.
    """
    u, e = Ordered.of(uncertainty, "an uncertainty"), _errors(error)
    removed = np.linspace(0.0, _MOST_REMOVED, STEPS) if fractions is None else fractions
    kept = np.maximum(np.floor((1.0 - removed) * len(e)), 1.0)
    averaged = e.values if mean == "mae" else np.square(e.values)
    ours, oracle, everywhere = u.sums(averaged, kept) / kept, e.sums(averaged, kept) / kept, float(averaged.mean())
    if mean == "rmse":
        return Sparsification(removed, np.sqrt(ours), np.sqrt(oracle), math.sqrt(everywhere))
    return Sparsification(removed, ours, oracle, everywhere)


def ause(uncertainty: Values | Ordered, error: Values | Ordered, *, steps: int = STEPS, mean: Mean = "mae") -> float:
    """Area under the sparsification error, as FisherRF has it: see `Sparsification.ause`. 0 is the oracle."""
    return sparsification(uncertainty, error, np.linspace(0.0, _MOST_REMOVED, steps), mean=mean).ause


def ause_of_random(error: Values | Ordered, *, steps: int = STEPS, mean: Mean = "mae") -> float:
    """`ause` of a map that knows nothing, in expectation; NaN if there is no error at all."""
    e = _errors(error)
    return ause(np.zeros(len(e)), e, steps=steps, mean=mean)


def normalised_ause(
    uncertainty: Values | Ordered, error: Values | Ordered, *, steps: int = STEPS, mean: Mean = "mae"
) -> float:
    """Sparsification error relative to a random map's: 0 oracle, 1 random; see `Sparsification.normalised_ause`."""
    return sparsification(uncertainty, error, np.linspace(0.0, _MOST_REMOVED, steps), mean=mean).normalised_ause


def spearman(uncertainty: Values | Ordered, error: Values | Ordered) -> float:
    """Correlation of the midranks of u and e, in [-1, 1]; NaN if one of them is constant (C. Spearman 1904)."""
    return partial_spearman(uncertainty, error, ())


def partial_spearman(
    uncertainty: Values | Ordered, error: Values | Ordered, controls: Sequence[Values | Ordered]
) -> float:
    """Rank correlation of u and e that what else is known of the pixels does not explain.

    Midranks of u and of e are each regressed, by least squares with an intercept, on the midranks of the controls, and
    the residuals correlated. It is computed from the correlations R between ranks, for x, y of u, e:
    s_xy = R_xy - R_xC pinv(R_CC) R_Cy, and s_ue / sqrt(s_uu s_ee). The pseudo-inverse leaves controls that say the same
    to share, and a constant one without effect.

    Args:
        uncertainty: u.
        error: e.
        controls: Say depth, image gradient, accumulated opacity, number of observations.

    Returns:
        In [-1, 1]; NaN if u or e is constant, or if the controls determine its ranks.

    Raises:
        EvaluationError: if there is no pixel, or a value is NaN, or an error negative.
    """
    columns = [Ordered.of(uncertainty, "an uncertainty"), _errors(error)]
    columns += [Ordered.of(control, "a control") for control in controls]
    centred = np.stack([column.ranks for column in columns]) - (len(columns[0]) + 1) / 2
    lengths = np.linalg.norm(centred, axis=1)
    R = centred @ centred.T / np.outer(lengths, lengths).clip(min=np.finfo(np.float64).tiny)
    across = R[:2, 2:]
    unexplained = R[:2, :2] - across @ np.linalg.pinv(R[2:, 2:], rcond=_NEGLIGIBLE, hermitian=True) @ across.T
    variances = unexplained.diagonal()
    if variances.min() < _NEGLIGIBLE:
        return math.nan
    return float(np.clip(unexplained[0, 1] / math.sqrt(variances.prod()), -1.0, 1.0))


def auroc(uncertainty: Values | Ordered, bad: Flags) -> float:
    """Chance that a bad pixel is more uncertain than a good one, a tie counting half (Mann-Whitney; Hanley 1982).

    The area under the curve of true over false positives. NaN if all pixels are bad or none is.
    """
    u = Ordered.of(uncertainty, "an uncertainty")
    n_bad = int(bad.sum())
    if n_bad in (0, len(bad)):
        return math.nan
    wins = float(u.ranks[bad].sum()) - n_bad * (n_bad + 1) / 2
    return wins / (n_bad * (len(bad) - n_bad))


def auprc(uncertainty: Values | Ordered, bad: Flags) -> float:
    """Average precision in finding bad pixels: the mean over bad pixels of the precision at their u.

    All pixels that tie are found together, so a constant map gets the share of bad pixels, `bad.mean()`: the base rate
    that a map has to exceed. NaN if no pixel is bad.
    """
    u = Ordered.of(uncertainty, "an uncertainty")
    found_after = np.concatenate(([0], np.cumsum(bad[u.indices])))[u.bounds]
    n_bad = int(found_after[-1])
    if n_bad == 0:
        return math.nan
    precision = (n_bad - found_after[:-1]) / (len(u) - u.bounds[:-1])
    return float((precision * np.diff(found_after)).sum()) / n_bad


@dataclass(frozen=True)
class Scores:
    """How well an uncertainty map tells the errors of one image; NaN where a score is not defined."""

    pixels: int
    mean_error: float
    """In the error's unit."""
    ause: float
    """FisherRF's, of the mean error."""
    ause_rmse: float
    normalised_ause: float
    """0 oracle, 1 random."""
    normalised_ause_rmse: float
    spearman: float
    partial_spearman: float
    """NaN without controls."""
    auroc: float
    auprc: float
    bad_share: float
    """Of the pixels: the `auprc` of a map that knows nothing."""

    @classmethod
    def of(
        cls,
        uncertainty: Values | Ordered,
        error: Values | Ordered,
        bad: Flags,
        controls: Sequence[Values | Ordered] = (),
    ) -> "Scores":
        """All scores, with each array sorted once.

        Args:
            uncertainty: u, any unit.
            error: e >= 0.
            bad: Which pixels are bad: an error above a bound, or a pixel of a known fault.
            controls: What u is to know more than.

        Raises:
            EvaluationError: if there is no pixel, or a value is NaN, or an error negative.
        """
        u, e = Ordered.of(uncertainty, "an uncertainty"), _errors(error)
        mae, rmse = sparsification(u, e), sparsification(u, e, mean="rmse")
        return cls(
            pixels=len(e),
            mean_error=mae.random,
            ause=mae.ause,
            ause_rmse=rmse.ause,
            normalised_ause=mae.normalised_ause,
            normalised_ause_rmse=rmse.normalised_ause,
            spearman=spearman(u, e),
            partial_spearman=partial_spearman(u, e, controls) if controls else math.nan,
            auroc=auroc(u, bad),
            auprc=auprc(u, bad),
            bad_share=float(bad.mean()),
        )


@dataclass(frozen=True)
class Calibration:
    """The error to expect at an uncertainty: never falling, constant over runs and linear between them."""

    uncertainty: Float[np.ndarray, " knots"]
    """Ascending."""
    error: Float[np.ndarray, " knots"]
    """Expected there, in the error's unit."""

    def expected_error(self, uncertainty: Values) -> Values:
        """At any uncertainty; outside those it was fitted to, that of the nearest."""
        return np.asarray(np.interp(uncertainty, self.uncertainty, self.error))


def calibrated(uncertainty: Values | Ordered, error: Values | Ordered) -> Calibration:
    """Learn from some images which error to expect at which uncertainty, to be tried on other images.

    The non-decreasing function of u next to e by least squares (isotonic regression; B. Zadrozny and C. Elkan 2002).

    Args:
        uncertainty: u of all pixels of the images.
        error: e of the same pixels.

    Raises:
        EvaluationError: if there is no pixel, or a value is NaN, or an error negative.
    """
    u, e = Ordered.of(uncertainty, "an uncertainty"), _errors(error)
    counts = np.diff(u.bounds)
    means = np.diff(u.sums(e.values, u.bounds.astype(np.float64))) / counts
    fit = isotonic_regression(means, weights=counts)
    ends = np.unique(np.concatenate((fit.blocks[:-1], fit.blocks[1:] - 1)))
    return Calibration(u.values[u.indices[u.bounds[ends]]], fit.x[ends])


@dataclass(frozen=True)
class Reliability:
    """Expected against found error, in bins of equally many pixels from the least to the most expected."""

    expected: Float[np.ndarray, " bins"]
    """Mean over each bin."""
    found: Float[np.ndarray, " bins"]
    """Mean over each bin."""
    quantiles: Float[np.ndarray, " levels"]
    """Expected error at levels from 0 to 1 at even steps: how often which error is expected."""

    @property
    def ece(self) -> float:
        """Expected calibration error: mean over the bins of |expected - found|, in the error's unit (Naeini 2015)."""
        return float(np.abs(self.expected - self.found).mean())

    @property
    def normalised_ece(self) -> float:
        """`ece` over the mean error found; NaN if there is no error at all."""
        mean = float(self.found.mean())
        return self.ece / mean if mean > 0 else math.nan


def reliability(expected: Values | Ordered, error: Values | Ordered, *, bins: int = _BINS) -> Reliability:
    """Compare expected with found error, on images that the expectation was not fitted to.

    A fitted expectation is constant over many pixels; where bins divide such pixels, each gets its share of their mean.

    Args:
        expected: By `Calibration.expected_error`, in the error's unit.
        error: e of the same pixels.
        bins: Of equally many pixels; no more than there are pixels.

    Raises:
        EvaluationError: if there is no pixel, or a value is NaN, or an error negative.
    """
    order, e = Ordered.of(expected, "an expected error"), _errors(error)
    places = np.linspace(0.0, len(e), min(bins, len(e)) + 1)
    expected_mean, found_mean = (
        np.diff(order.sums(values, places)) / np.diff(places) for values in (order.values, e.values)
    )
    evenly = np.arange(_LEVELS) * (len(e) - 1) // (_LEVELS - 1)
    return Reliability(expected_mean, found_mean, order.values[order.indices[evenly]])


def ece(expected: Values | Ordered, error: Values | Ordered, *, bins: int = _BINS) -> float:
    """Expected calibration error in the error's unit; see `Reliability.ece`."""
    return reliability(expected, error, bins=bins).ece


def _errors(error: Values | Ordered) -> Ordered:
    e = Ordered.of(error, "an error")
    if e.values[e.indices[0]] < 0:
        raise EvaluationError("an error is negative; give absolute errors")
    return e
