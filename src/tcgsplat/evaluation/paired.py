"""Whether one arm of an experiment does better than another: paired differences, their intervals and tests."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.stats import wilcoxon

from tcgsplat.errors import EvaluationError

Run = tuple[str, str, int]
"""Arm, sequence, seed."""


@dataclass(frozen=True)
class PairedDifference:
    """How much greater a measure is in one arm than in another, on the same sequences with the same seeds."""

    arm: str
    reference: str
    mean: float
    """Of arm - reference: mean over sequences of the mean over their seeds, in the measure's unit."""
    low: float
    """End of the bootstrap interval; NaN if there is only one pair."""
    high: float
    level: float
    """Of the interval: 0.95 for 95 %."""
    by_sequence: Mapping[str, float]
    """Mean difference over the seeds of each sequence."""
    pairs: int
    left_out: int
    """Pairs of which one run is missing or has no finite result. Runs that fail are not there at random: say so."""
    p_of_pairs: float
    """Two-sided Wilcoxon signed-rank test over all pairs. Seeds of one sequence are not independent of each other, so
    this is too small where sequences differ in their sign. NaN if there is no difference other than 0."""
    p_of_sequences: float
    """The same over the means of sequences, which are independent; 5 sequences cannot give less than 0.0625."""


def paired_differences(
    results: Mapping[Run, float],
    reference: str,
    *,
    level: float = 0.95,
    draws: int = 10_000,
    seed: int = 0,
) -> tuple[PairedDifference, ...]:
    """Compare every arm with a reference arm.

    The interval is the percentile interval of a bootstrap in two stages, which draws sequences with replacement and
    then seeds within each (cluster bootstrap; A. Davison and D. Hinkley 1997, section 3.8): both the seeds and the
    sequences that happened to be chosen count. It is too narrow where sequences are few: simulated with 5 normal seeds
    each, intervals called 95 % held the truth in 75 to 84 % of the cases for 3 sequences, 82 to 87 % for 5, 89 to 92 %
    for 8 and 93 to 95 % for 15 (the first figure where sequences differ most). With one it speaks of the seeds alone.

    For ratios (an ATE 2 % worse) see `relative_differences`.

    Args:
        results: The measure by arm, sequence and seed; what is not finite counts as a failed run.
        reference: The arm that all others are compared with.
        level: Of the interval, in (0, 1).
        draws: Of the bootstrap.
        seed: Of its generator, the same for each arm: no interval hangs on which other arms there are.

    Returns:
        One for each other arm that shares a run with the reference, in the order in which arms are first met.

    Raises:
        EvaluationError: if the reference arm has no result.
    """
    arms = list(dict.fromkeys(arm for arm, _, _ in results))
    if reference not in arms:
        raise EvaluationError(f"no result of the arm {reference!r}; there are {', '.join(arms) or 'none at all'}")
    compared = (_compared(results, arm, reference, level, draws, seed) for arm in arms if arm != reference)
    return tuple(difference for difference in compared if difference is not None)


def relative_differences(results: Mapping[Run, float], reference: str) -> tuple[PairedDifference, ...]:
    """Compare every arm with a reference arm, in percent of it: `paired_differences` of logarithms, taken back.

    Args:
        results: As there; what is not above 0 counts as a failed run.
        reference: The arm that all others are compared with.

    Raises:
        EvaluationError: if the reference arm has no result.
    """
    logarithms = {run: math.log(value) if value > 0 else math.nan for run, value in results.items()}
    return tuple(_percent(one) for one in paired_differences(logarithms, reference))


def _percent(one: PairedDifference) -> PairedDifference:
    mean, low, high = (100 * math.expm1(value) for value in (one.mean, one.low, one.high))
    by_sequence = {name: 100 * math.expm1(value) for name, value in one.by_sequence.items()}
    return replace(one, mean=mean, low=low, high=high, by_sequence=by_sequence)


def _compared(
    results: Mapping[Run, float], arm: str, reference: str, level: float, draws: int, seed: int
) -> PairedDifference | None:
    runs = sorted({(sequence, run_seed) for name, sequence, run_seed in results if name in (arm, reference)})
    differences: dict[str, list[float]] = {}
    for sequence, run_seed in runs:
        ours, theirs = (results.get((name, sequence, run_seed), math.nan) for name in (arm, reference))
        if math.isfinite(ours) and math.isfinite(theirs):
            differences.setdefault(sequence, []).append(ours - theirs)
    if not differences:
        return None
    groups = [np.array(group, dtype=np.float64) for group in differences.values()]
    means = np.array([group.mean() for group in groups])
    pooled = np.concatenate(groups)
    low, high = math.nan, math.nan
    if len(pooled) > 1:
        drawn = bootstrap_means(groups, draws, np.random.default_rng(seed))
        low, high = (float(end) for end in np.quantile(drawn, ((1 - level) / 2, (1 + level) / 2)))
    return PairedDifference(
        arm=arm,
        reference=reference,
        mean=float(means.mean()),
        low=low,
        high=high,
        level=level,
        by_sequence=dict(zip(differences, means.tolist(), strict=True)),
        pairs=len(pooled),
        left_out=len(runs) - len(pooled),
        p_of_pairs=_signed_rank(pooled),
        p_of_sequences=_signed_rank(means),
    )


def bootstrap_means(
    groups: list[Float[np.ndarray, " _"]], draws: int, generator: np.random.Generator
) -> Float[np.ndarray, " draws"]:
    """Mean over groups of the mean within each, of groups and then members drawn with replacement.

    Args:
        groups: Values of each group, at least one in each; groups need not be of one size.
        draws: How often.
        generator: Of the draws.
    """
    sizes = np.array([len(group) for group in groups])
    begins = np.cumsum(sizes) - sizes
    drawn = generator.integers(0, len(groups), (draws, len(groups)))
    members = np.floor(generator.random((draws, len(groups), int(sizes.max()))) * sizes[drawn][..., None]).astype(int)
    values = np.concatenate(groups)[begins[drawn][..., None] + members]
    counted = np.arange(sizes.max()) < sizes[drawn][..., None]
    return np.asarray(((values * counted).sum(axis=2) / sizes[drawn]).mean(axis=1))


def _signed_rank(differences: Float[np.ndarray, " n"]) -> float:
    return float(wilcoxon(differences).pvalue) if differences.any() else math.nan
