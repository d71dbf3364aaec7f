"""Which submaps may show the place of another one, by the descriptors of their keyframes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

Vectors = Float32[np.ndarray, "_ d"]
"""Descriptors of a submap's keyframes, of unit length."""

_STRANGER = 0.25
"""Quantile of a view's similarities to other submaps that is taken for that of places it does not show."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A submap that may show the same place."""

    submap: int
    """Its index."""
    score: float
    """Of its most alike view: 0 as alike as a stranger, 1 as the views of the asking submap are to each other."""
    similarity: Float32[np.ndarray, "q v"]
    """Of each view of the asking submap, by row, with each of its own."""


def candidates(
    index: int,
    submaps: Sequence[Vectors],
    *,
    min_similarity: float = 0.5,
    min_interval: int = 1,
    min_score: float = 0.2,
    limit: int = 4,
) -> tuple[Candidate, ...]:
    """Submaps that look like one of them, the most alike first.

    The base system's rule holds each view of a submap against its own submap: another one is a candidate if it has a
    view that is more alike to it than, as a rule, those of its own submap are. Two faults of it are mended here.

    - A view counted as one of its own: with up to three views the threshold was a similarity of 1, and nothing was
      ever a candidate. Now a view is held against others of its submap; one that is alone, against itself.
    - Between neighbouring keyframes local features are far more alike than between two visits, so that the rule in
      its first form finds almost none of the revisits of the synthetic apartment: 1 of 11 submaps of 30 frames. So
      similarities are measured on a scale from those of strangers, 0, to the rule's threshold, 1. `min_score` 1 is
      the rule of the base system; the default finds 9 to 11 of those 11 over three seeds of the words, with 7 to 9
      strangers among 32 to 38 candidates.

    Args:
        index: Of the submap that asks.
        submaps: Descriptors of every submap, by index.
        min_similarity: Which of a view's similarities to its own submap is the threshold, as a share of their number
            from the highest on; 0.5 is the middle one.
        min_interval: Submaps that are not further apart in their order than this are not looked at.
        min_score: What a candidate's score must exceed.
        limit: Most candidates, so that a closure costs the same however many submaps there are.
    """
    others = [other for other in range(len(submaps)) if abs(other - index) > min_interval and len(submaps[other])]
    asking = submaps[index]
    if not others or not len(asking):
        return ()
    own = np.sort(asking @ asking.T, axis=1)[:, ::-1]
    rank = min(max(int(len(asking) * min_similarity), 2), len(asking))
    similarity = {other: asking @ submaps[other].T for other in others}
    stranger = np.quantile(np.concatenate(list(similarity.values()), axis=1), _STRANGER, axis=1)
    scale = np.maximum(own[:, rank - 1] - stranger, 1e-3)
    found = [
        Candidate(other, float(((alike - stranger[:, None]) / scale[:, None]).max()), alike)
        for other, alike in similarity.items()
    ]
    found = sorted((each for each in found if each.score > min_score), key=lambda each: -each.score)
    return tuple(found[:limit])


def most_alike(picture: Vectors, submaps: Sequence[Vectors], *, limit: int = 4) -> tuple[Candidate, ...]:
    """Submaps for a picture that may have been taken anywhere, the most alike first; its similarity is their score.

    Args:
        picture: One descriptor, or those of a few pictures of one place.
        submaps: Descriptors of every submap, by index.
        limit: Most submaps.
    """
    alike = [picture @ vectors.T for vectors in submaps]
    found = [Candidate(i, float(each.max()), each) for i, each in enumerate(alike) if each.size]
    return tuple(sorted(found, key=lambda each: -each.score)[:limit])
