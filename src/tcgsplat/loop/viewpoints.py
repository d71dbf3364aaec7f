"""From which of its keyframes a submap is registered: alike to the other submap, and reliably mapped (Section 3.3)."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float32

from tcgsplat.confidence import equations as eq
from tcgsplat.render.view import Rendering

_COVERED = 0.95
"""Alpha above which a pixel is the map's own."""


def view_confidence(rendering: Rendering) -> float:
    """Mean confidence over what the map covers well, in [0, 1]; 0 if that is nothing."""
    covered = rendering.alpha > _COVERED
    return float(rendering.confidence[covered].mean()) if bool(covered.any()) else 0.0


def viewpoints(
    similarity: Float32[np.ndarray, "v o"],
    own: Float32[np.ndarray, "v v"],
    *,
    preselected: int = 6,
    kept: int = 2,
    confidence: Callable[[int], float] | None = None,
    floor: float = 0.5,
) -> tuple[int, ...]:
    """The keyframes of a submap that are registered with another one, the best first.

    Those most alike to any view of the other submap are preselected and ranked anew by confidence. After the best one
    the next is chosen for being unlike those chosen before, too, which is ours: neighbouring keyframes see the same, so
    that two of them err in the same way and their agreement proves little.

    Args:
        similarity: Of v views with those of the other submap.
        own: Of the views with each other.
        preselected: Views that are ranked anew.
        kept: Views that remain.
        confidence: C of equation 25 for a view, asked only of the preselected; None for ranking by similarity alone.
        floor: $w^{lc}_{min}$ of equation 25.

    Returns:
        Rows of `similarity`, no more than there are.
    """
    best = similarity.max(axis=1, initial=0.0)  # below zero, less confidence would rank higher
    chosen = np.argsort(-best, kind="stable")[:preselected]
    scores = torch.from_numpy(best[chosen])
    if confidence is not None:
        scores = eq.rerank_score(scores, torch.tensor([confidence(int(view)) for view in chosen]), floor=floor)
    views: list[int] = []
    while len(views) < min(kept, len(chosen)):
        unlike = 1.0 - own[chosen][:, views].max(axis=1, initial=0.0)
        ranking = np.where(np.isin(chosen, views), -np.inf, scores.numpy() * unlike)
        views.append(int(chosen[ranking.argmax()]))
    return tuple(views)
