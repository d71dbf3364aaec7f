"""How soon a confidence falls when a fault begins, and how soon it is back when the fault is over."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from tcgsplat.errors import EvaluationError

Series = Float[np.ndarray, " frames"]
"""Mean confidence inside a region for each frame; NaN where the region is not in view."""

_SIGMA_OF_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
_SIGNIFICANT = 3.0
"""Standard deviations that a fall must exceed to be one."""


@dataclass(frozen=True)
class Reaction:
    """What a fault did to a confidence."""

    before: float
    """Median of the frames before the fault; NaN if none is known."""
    lowest: float
    """Least during the fault; NaN if no frame is known."""
    threshold: float
    """Half-way between the two."""
    dropped: bool
    """Whether it fell by more than it varies anyway."""
    time_to_drop: int | None
    """Frames from the first frame of the fault to the first one below the threshold: 0 is at once, None is never."""
    time_to_recover: int | None
    """Frames from the first frame after the fault to the first one above the threshold; None if it never fell, never
    came back, or the fault never ends."""


def reaction(
    values: Series,
    fault_begins: int,
    fault_ends: int | None = None,
    *,
    hold: int = 3,
    least_drop: float = 0.02,
) -> Reaction:
    """Time to drop and time to recover of a frame-wise mean confidence.

    The threshold lies half-way between the median level before the fault and the lowest level during it, so it needs no
    choice, whatever the scale of the confidence. Any series has a lowest value: it is a drop only if it lies deeper
    under the level before than `least_drop` and than three standard deviations before the fault (by the median absolute
    deviation). A crossing counts if `hold` known frames in a row lie beyond the threshold, or all that are left of the
    stretch; its time is that of the first of them.

    Args:
        values: Mean confidence of each frame; frames that are NaN are passed over, but count as time.
        fault_begins: First frame with the fault.
        fault_ends: First frame without it again; without, it lasts to the end of the series.
        hold: Frames in a row, at least 1.
        least_drop: Smallest fall that matters, in units of confidence.

    Raises:
        EvaluationError: if the fault does not lie within the series.
    """
    ends = len(values) if fault_ends is None else fault_ends
    if not 0 <= fault_begins < ends <= len(values):
        raise EvaluationError(
            f"the fault, frames {fault_begins} to {ends}, does not lie within the {len(values)} frames"
        )
    known = np.isfinite(values)
    earlier, during = values[:fault_begins][known[:fault_begins]], values[fault_begins:ends][known[fault_begins:ends]]
    if not len(earlier) or not len(during):
        return Reaction(math.nan, math.nan, math.nan, False, None, None)
    before, lowest = float(np.median(earlier)), float(during.min())
    spread = _SIGMA_OF_MAD * float(np.median(np.abs(earlier - before)))
    threshold = (before + lowest) / 2
    if before - lowest <= max(least_drop, _SIGNIFICANT * spread):
        return Reaction(before, lowest, threshold, False, None, None)
    to_drop = _first_run(values[fault_begins:ends] < threshold, known[fault_begins:ends], hold)
    to_recover = _first_run(values[ends:] > threshold, known[ends:], hold) if to_drop is not None else None
    return Reaction(before, lowest, threshold, to_drop is not None, to_drop, to_recover)


def time_to_drop(
    values: Series, fault_begins: int, fault_ends: int | None = None, *, hold: int = 3, least_drop: float = 0.02
) -> int | None:
    """Frames until the confidence falls, None if it does not; see `reaction`."""
    return reaction(values, fault_begins, fault_ends, hold=hold, least_drop=least_drop).time_to_drop


def time_to_recover(
    values: Series, fault_begins: int, fault_ends: int, *, hold: int = 3, least_drop: float = 0.02
) -> int | None:
    """Frames until the confidence is back, None if it did not fall or is not back; see `reaction`."""
    return reaction(values, fault_begins, fault_ends, hold=hold, least_drop=least_drop).time_to_recover


def _first_run(beyond: Bool[np.ndarray, " k"], known: Bool[np.ndarray, " k"], hold: int) -> int | None:
    """The first frame from which `hold` known frames lie beyond, or all that are left."""
    frames = np.flatnonzero(known)
    hits = beyond[frames]
    for i in np.flatnonzero(hits):
        if hits[i : i + hold].all():
            return int(frames[i])
    return None
