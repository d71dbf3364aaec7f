"""From which of its keyframes a submap is registered."""

import numpy as np
import pytest
import torch
from analytic_room import Room, rendering_of

from tcgsplat.loop.viewpoints import view_confidence, viewpoints

UNLIKE = np.eye(8, dtype=np.float32)
SCORES = np.array([0.1, 0.8, 0.2, 0.7, 0.75, 0.3, 0.4, 0.5], np.float32)


def similarity(best: np.ndarray = SCORES) -> np.ndarray:
    """Of views with three views of another submap, one of which is the most alike."""
    return np.stack((best - 0.05, best, best - 0.4), axis=1)


def test_the_most_alike_are_kept() -> None:
    assert viewpoints(similarity(), UNLIKE) == (1, 4)
    assert viewpoints(similarity(), UNLIKE, kept=3) == (1, 4, 3)


def test_confidence_ranks_the_preselected_anew_and_is_asked_for_no_others() -> None:
    asked = []

    def confidence(view: int) -> float:
        asked.append(view)
        return {1: 0.0, 3: 1.0, 4: 0.4}.get(view, 0.9)

    # By hand, floor 0.5: 1: 0.8 * 0.5 = 0.4; 3: 0.7 * 1 = 0.7; 4: 0.75 * 0.7 = 0.525; 7: 0.5 * 0.95 = 0.475
    assert viewpoints(similarity(), UNLIKE, kept=3, confidence=confidence) == (3, 4, 7)
    assert sorted(asked) == [1, 3, 4, 5, 6, 7]
    assert viewpoints(similarity(), UNLIKE, kept=3, preselected=3, confidence=confidence) == (3, 4, 1)


def test_the_second_view_sees_something_else() -> None:
    own = np.eye(8, dtype=np.float32)
    own[1, 4] = own[4, 1] = 0.5  # 0.75 * 0.5 is less than 0.7
    assert viewpoints(similarity(), own) == (1, 3)


def test_there_may_be_fewer_views_than_asked_for() -> None:
    assert viewpoints(similarity()[:1], UNLIKE[:1, :1]) == (0,)
    assert viewpoints(similarity()[:0], UNLIKE[:0, :0]) == ()


def test_a_view_that_is_unlike_all_is_not_raised_by_doubt() -> None:
    below = similarity(np.array([-0.2, -0.1, 0.3, 0.0], np.float32))
    assert viewpoints(below, UNLIKE[:4, :4], kept=1, confidence=lambda _: 0.0) == (2,)


def test_the_confidence_of_a_view_is_that_of_what_is_covered(room: Room) -> None:
    frame = room.frame()
    left = torch.arange(frame.depth.shape[1]).expand_as(frame.depth) < 40
    alpha = torch.where(left, 0.99, 0.9)
    assert view_confidence(rendering_of(frame, confidence=0.6, alpha=alpha)) == pytest.approx(0.6 * 0.99)
    assert view_confidence(rendering_of(frame, confidence=0.6, alpha=0.95)) == 0.0
