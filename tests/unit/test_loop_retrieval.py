"""Which submaps may show the same place."""

import numpy as np
import pytest

from tcgsplat.loop.retrieval import Vectors, candidates, most_alike


def place(angle: float, spread: float = 20.0, views: int = 4) -> Vectors:
    """Views of a place: directions in a plane around an angle, degrees."""
    angles = np.radians(angle + np.linspace(-spread, spread, views))
    return np.stack((np.cos(angles), np.sin(angles), 0 * angles, 0 * angles), axis=1).astype(np.float32)


def strange(angle: float, **how) -> Vectors:
    """Views of a place that has nothing in common with those."""
    return np.roll(place(angle, **how), 2, axis=1)


def indices(found) -> list[int]:
    return [each.submap for each in found]


WALK = [place(0), strange(90), strange(80), strange(5), strange(10), place(10)]


def test_the_place_seen_before_is_found_and_strangers_are_not() -> None:
    found = candidates(5, WALK)
    assert indices(found) == [0]
    np.testing.assert_allclose(found[0].similarity, WALK[5] @ WALK[0].T)
    assert found[0].score > 0.5


def test_neighbours_in_the_order_are_no_loop() -> None:
    walk = [*WALK, place(10)]
    assert indices(candidates(6, walk, min_interval=0)) == [5, 0]
    assert indices(candidates(6, walk, min_interval=1)) == [0]
    assert indices(candidates(6, walk, min_interval=6)) == []
    assert indices(candidates(0, walk, min_interval=1)) == [5, 6]  # later ones count too


def test_the_score_is_one_where_the_rule_of_the_base_system_is_met_exactly() -> None:
    asking, strangers = place(0), [strange(90, spread=0.0)] * 6
    threshold = np.sort(asking @ asking.T, axis=1)[:, ::-1][:, 1]  # int(4 * 0.5) = 2, itself included
    for more, met in ((0.3, True), (-0.3, False)):
        angle = np.degrees(np.arccos(threshold[0])) - more
        other = place(-20.0 - angle, spread=0.0)  # beyond the first view, by a little more or less than the second
        found = candidates(0, [asking, *strangers, other], min_score=0.0)
        assert found[0].submap == 7
        assert (found[0].score > 1.0) is met


def test_a_larger_quantile_asks_for_less() -> None:
    walk = [place(40), *[strange(90, spread=0.0)] * 4, place(0)]
    strict, loose = (candidates(5, walk, min_similarity=share)[0].score for share in (0.5, 1.0))
    assert loose > strict > 0


def test_one_view_is_enough_to_ask_and_to_be_found() -> None:
    walk = [place(2, views=1), *[strange(90, views=1)] * 4, place(0, views=1)]
    assert indices(candidates(5, walk)) == [0]


def test_no_more_than_the_limit_and_the_best_first() -> None:
    walk = [place(angle, spread=1.0) for angle in (30, 5, 20, 10)] + [strange(90)] * 20 + [place(0, spread=2.0)]
    found = candidates(24, walk, limit=3)
    assert indices(found) == [1, 3, 2]
    assert [each.score for each in found] == sorted((each.score for each in found), reverse=True)


@pytest.mark.parametrize("views", [0, 1])
def test_submaps_with_nothing_in_them_do_no_harm(views: int) -> None:
    nothing = np.zeros((views, 4), np.float32)
    walk = [nothing, strange(90), strange(90), nothing, strange(90), strange(90), nothing]
    assert candidates(6, walk) == ()
    assert 0 not in indices(candidates(5, walk))
    assert candidates(0, [place(0)]) == ()


def test_a_picture_is_looked_up_everywhere() -> None:
    found = most_alike(place(12, views=1, spread=0.0), WALK, limit=2)
    assert indices(found) == [5, 0]
    assert found[0].similarity.shape == (1, 4)
    assert most_alike(place(0, views=1), []) == ()
