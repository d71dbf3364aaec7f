"""How one submap stands to another, and when that is not believed."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from analytic_room import errors, pose
from mapped_room import mapped

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.loop.descriptor import Vectors, Vlad
from tcgsplat.loop.localizer import Localizer
from tcgsplat.loop.places import Place
from tcgsplat.loop.registration import (
    COMMON,
    Estimate,
    Registration,
    Side,
    _agree,
    _estimate,
    _fused,
    _largest_agreement,
    _turned,
    covariance,
    registered,
)
from tcgsplat.loop.settings import LoopConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.submap import Submap
from tcgsplat.tensors import Pose
from tcgsplat.tracking.settings import TrackerConfig

T_WORLD_A = [pose(0.05 * i, 0, 0.02 * i, degrees=(0, -4 * i, 0)) for i in range(3)]
T_WORLD_B = [
    pose(0.1, 0.05, -0.05, degrees=(2, 10, -3)) @ pose(-0.03 * i, 0.02 * i, 0.02 * i, degrees=(i, 3 * i, 0))
    for i in range(3)
]
T_B_A = se3.inverse(T_WORLD_B[0]) @ T_WORLD_A[0]
NEAR = pose(0.02, -0.015, 0.015, degrees=(0.6, 0.8, -0.5))
FAR = pose(0.6, -0.3, 0.2, degrees=(20, 30, -10))
MILLIMETRE = np.diag([1e6] * 6)  # information


@dataclass(frozen=True)
class Known:
    """A submap and what is remembered of it."""

    submap: Submap
    place: Place
    vectors: Vectors

    @staticmethod
    def of(submap: Submap, rasterizer: Rasterizer) -> "Known":
        place = Place.of(submap, rasterizer)
        return Known(submap, place, Vlad().described([view.features.descriptors for view in place.views]))

    def side(self, *views: int) -> Side:
        return Side(self.submap, self.place, views or tuple(range(len(self.place.views))))

    def with_keyframes_moved(self, *T: Pose) -> "Known":
        """With its keyframes where they were not, and its map as it was."""
        pairs = zip(self.submap.keyframes, self.place.views, T, strict=True)
        moved = [(replace(k, T_map_cam=k.T_map_cam @ X), replace(v, T_map_cam=v.T_map_cam @ X)) for k, v, X in pairs]
        keyframes, views = zip(*moved, strict=True)
        return replace(
            self, submap=replace(self.submap, keyframes=keyframes), place=replace(self.place, views=tuple(views))
        )

    def without_features(self) -> "Known":
        bare = tuple(replace(view, features=view.features._chosen(np.arange(0))) for view in self.place.views)
        return replace(self, place=replace(self.place, views=bare))


@pytest.fixture(scope="module")
def a(rasterizer: Rasterizer) -> Known:
    return Known.of(mapped(T_WORLD_A, rasterizer, index=0), rasterizer)


@pytest.fixture(scope="module")
def b(rasterizer: Rasterizer) -> Known:
    return Known.of(mapped(T_WORLD_B, rasterizer, index=1), rasterizer)


@pytest.fixture(scope="module")
def behind(rasterizer: Rasterizer) -> Known:
    """What is behind the back of a's cameras."""
    around = pose(degrees=(0, 180, 0))
    return Known.of(mapped([around @ T for T in T_WORLD_A], rasterizer, index=2), rasterizer)


@pytest.fixture(scope="module")
def localizer(rasterizer: Rasterizer) -> Localizer:
    return Localizer(LoopConfig(), TrackerConfig(), ConfidenceConfig(), rasterizer)


def together(source: Known, target: Known, T: Pose, localizer: Localizer) -> Registration:
    return registered(source.side(), target.side(), source.vectors @ target.vectors.T, T, localizer)


class TestTwoSubmaps:
    @pytest.mark.parametrize("displaced", [se3.identity(), NEAR], ids=["right", "near"])
    def test_are_found_where_they_stand(self, displaced: Pose, a: Known, b: Known, localizer: Localizer) -> None:
        pair = together(a, b, T_B_A @ displaced, localizer)
        assert (pair.failed, pair.source, pair.target) == ("", 0, 1)
        millimetres, degrees = errors(pair.T_target_source, T_B_A)
        assert millimetres < 3
        assert degrees < 0.15
        assert [one.frame_index for one in pair.estimates] == [0, 1, 2, 100, 101, 102]
        for one in pair.estimates:
            assert not one.failed
            assert one.coverage > 0.5
            assert errors(one.T_target_source, T_B_A)[0] < 5

    def test_without_features_if_they_stand_nearly_right(self, a: Known, b: Known, localizer: Localizer) -> None:
        pair = together(a.without_features(), b.without_features(), T_B_A @ NEAR, localizer)
        assert not pair.failed
        assert errors(pair.T_target_source, T_B_A)[0] < 3

    def test_the_other_way_round_it_is_the_inverse(self, a: Known, b: Known, localizer: Localizer) -> None:
        there, back = together(a, b, T_B_A, localizer), together(b, a, se3.inverse(T_B_A), localizer)
        assert (back.source, back.target) == (1, 0)
        assert errors(se3.inverse(back.T_target_source), there.T_target_source)[0] < 0.5
        for one, other in zip(there.estimates, (*back.estimates[3:], *back.estimates[:3]), strict=True):
            assert one.frame_index == other.frame_index
            turned = _turned(other)
            torch.testing.assert_close(turned.T_target_source, one.T_target_source, atol=1e-9, rtol=0)
            np.testing.assert_allclose(turned.information, one.information, atol=1e-9 * np.abs(one.information).max())

    def test_features_bridge_what_rendering_does_not_reach(self, a: Known, b: Known, localizer: Localizer) -> None:
        pair = together(a, b, T_B_A @ FAR, localizer)
        assert not pair.failed
        assert errors(pair.T_target_source, T_B_A)[0] < 3
        assert not any(one.failed for one in pair.estimates)
        blind = together(a.without_features(), b.without_features(), T_B_A @ FAR, localizer)
        assert blind.failed.startswith("fewer than two of 6 views were localised: ")
        assert all(one.failed for one in blind.estimates)

    def test_features_of_either_side_will_do(self, a: Known, b: Known, localizer: Localizer) -> None:
        """One side's likeliest view sees a covered lens; the other side's is located all the same."""
        likeliest = int((a.vectors @ b.vectors.T).max(axis=1).argmax())
        views = list(a.place.views)
        views[likeliest] = a.without_features().place.views[likeliest]
        pair = together(replace(a, place=replace(a.place, views=tuple(views))), b, T_B_A @ FAR, localizer)
        assert not pair.failed
        assert errors(pair.T_target_source, T_B_A)[0] < 3

    def test_that_show_different_places_are_not_registered(self, a: Known, behind: Known, localizer: Localizer) -> None:
        apart = se3.inverse(behind.submap.T_world_map) @ a.submap.T_world_map
        for guess in (apart, se3.identity()):
            pair = together(a, behind, guess, localizer)
            assert pair.failed.startswith("fewer than two of 6 views were localised: ")
            assert pair.failed.endswith(pair.estimates[0].failed)
            assert np.array_equal(pair.information, np.zeros((6, 6)))
            assert all(one.failed for one in pair.estimates)

    def test_the_same_every_time(self, a: Known, b: Known, localizer: Localizer) -> None:
        one, two = (together(a, b, T_B_A @ FAR, localizer) for _ in range(2))
        assert torch.equal(one.T_target_source, two.T_target_source)
        assert np.array_equal(one.information, two.information)

    def test_one_view_is_no_witness_for_itself(self, a: Known, b: Known, localizer: Localizer) -> None:
        none = Side(b.submap, b.place, ())
        pair = registered(a.side(0), none, a.vectors @ b.vectors.T, T_B_A, localizer)
        assert pair.failed == "fewer than two of 1 views were localised: it has one view only"
        assert len(pair.estimates) == 1


class TestContradiction:
    """Keyframes of a that say that they stood elsewhere, each within reach of rendering."""

    SHIFTS = (pose(0.03), pose(0, 0.03), pose(0, 0, 0.03))

    def test_no_two_agree(self, a: Known, b: Known, localizer: Localizer) -> None:
        liar = a.with_keyframes_moved(*self.SHIFTS)
        none = Side(b.submap, b.place, ())
        pair = registered(liar.side(), none, a.vectors @ b.vectors.T, T_B_A, localizer)
        assert pair.failed == "no two of 3 localised views agree"
        assert not any(one.failed for one in pair.estimates)

    def test_half_of_them_do(self, a: Known, b: Known, localizer: Localizer) -> None:
        liar = a.with_keyframes_moved(self.SHIFTS[0], self.SHIFTS[0], self.SHIFTS[1])
        pair = registered(liar.side(0, 1, 2), b.side(0), a.vectors @ b.vectors.T, T_B_A, localizer)
        assert pair.failed == "as many localised views contradict as agree: 2"

    def test_one_is_outvoted(self, a: Known, b: Known, localizer: Localizer) -> None:
        liar = a.with_keyframes_moved(self.SHIFTS[0], se3.identity(), se3.identity())
        pair = registered(liar.side(), b.side(), a.vectors @ b.vectors.T, T_B_A, localizer)
        assert not pair.failed
        assert errors(pair.estimates[0].T_target_source, T_B_A)[0] > 20
        assert errors(pair.T_target_source, T_B_A)[0] < 3

    def test_the_larger_group_counts_and_of_equals_the_surer(self) -> None:
        here, there = (
            [Estimate(i, "", T, MILLIMETRE, 0.5) for i, T in enumerate((pose(0.0), pose(0.001)))],
            Estimate(2, "", pose(0.04), MILLIMETRE, 0.9),
        )
        assert _largest_agreement([*here, there]) == here
        sure = replace(there, T_target_source=pose(0.041))
        assert _largest_agreement([*here, there, sure]) == [there, sure]

    def test_agreement_is_by_what_is_claimed_to_be_known(self) -> None:
        """Millimetres where both are sure; and never more than 5 cm or 2 degrees."""
        sure, unsure = (Estimate(0, "", se3.identity(), information) for information in (1e8 * np.eye(6), np.eye(6)))
        for one, step, agrees in (
            (sure, pose(0.01), True),
            (sure, pose(0.02), False),
            (unsure, pose(0.045), True),
            (unsure, pose(0.055), False),
            (sure, pose(degrees=(0, 0, 0.3)), True),
            (sure, pose(degrees=(0, 0, 0.5)), False),
            (unsure, pose(degrees=(0, 0, 1.9)), True),
            (unsure, pose(degrees=(0, 0, 2.1)), False),
        ):
            other = replace(one, T_target_source=step)
            assert _agree(one, other) is agrees
            assert _agree(other, one) is agrees

    def test_it_does_not_matter_where_they_stand(self) -> None:
        X = pose(2.0, -1.0, 0.5, degrees=(30, 60, -20))
        apart = (0.02 * np.random.default_rng(0).standard_normal((40, 6))).tolist()
        information = np.diag([1e2, 1e5, 1e5, 1e5, 1e3, 1e5])
        found = set()
        for tangent in apart:
            step = se3.exp(torch.tensor(tangent, dtype=torch.float64))
            pairs = [Estimate(0, "", T, information) for T in (se3.identity(), step, X, X @ step)]
            assert _agree(*pairs[:2]) is _agree(*pairs[2:])
            found.add(_agree(*pairs[:2]))
        assert found == {True, False}


def quadratic(information: np.ndarray, tangent: torch.Tensor) -> float:
    x = tangent.numpy()
    return float(x @ information @ x)


def tangents(scale: float) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(2)
    return [scale * torch.randn(6, generator=generator, dtype=torch.float64) for _ in range(6)]


class TestInformation:
    """Carried rightly, an error costs the same wherever it is written down."""

    def test_of_the_inverse(self) -> None:
        generator = np.random.default_rng(1)
        root = generator.standard_normal((6, 6)) * [1, 2, 5, 10, 20, 50]
        T = pose(1.0, -2.0, 0.5, degrees=(20, 80, -40))
        one = Estimate(3, "", T, root.T @ root, 0.7)
        turned = _turned(one)
        torch.testing.assert_close(turned.T_target_source, se3.inverse(T))
        assert (turned.frame_index, turned.failed, turned.coverage) == (3, "", 0.7)
        for xi in tangents(1e-4):
            wrong = se3.inverse(T @ se3.exp(xi))
            zeta = se3.log(se3.inverse(turned.T_target_source) @ wrong)
            assert quadratic(turned.information, zeta) == pytest.approx(quadratic(one.information, xi), rel=1e-3)
        again = _turned(turned)
        np.testing.assert_allclose(again.information, one.information, rtol=1e-9, atol=1e-7)

    def test_a_failure_stays_one(self) -> None:
        assert _turned(Estimate(5, "why")).failed == "why"

    @pytest.mark.parametrize("view", [0, 1, 2])
    def test_from_the_camera_to_the_submap(self, view: int, a: Known, b: Known, localizer: Localizer) -> None:
        far = pose(1.0, 2.0, -1.5, degrees=(60, -70, 20))  # so that no two conventions give the same
        origin = a.submap.keyframes[view].T_map_cam
        source = a.with_keyframes_moved(*[se3.inverse(k.T_map_cam) @ far @ k.T_map_cam for k in a.submap.keyframes])
        T_within_of = T_B_A @ se3.inverse(far)
        one = _estimate(source.side(), b.side(), view, (lambda: T_within_of,), localizer)
        keyframe = source.submap.keyframes[view]
        found = localizer.localized(keyframe.balanced, b.submap, [T_within_of @ keyframe.T_map_cam])
        assert not one.failed
        torch.testing.assert_close(keyframe.T_map_cam, far @ origin)
        for xi in tangents(1e-5):
            T_cam_within = se3.exp(xi) @ se3.inverse(found.tracked.T_map_cam)
            wrong = se3.inverse(T_cam_within) @ se3.inverse(keyframe.T_map_cam)
            zeta = se3.log(se3.inverse(one.T_target_source) @ wrong)
            assert quadratic(one.information, zeta) == pytest.approx(quadratic(found.information, xi), rel=1e-3)

    def test_guesses_are_taken_in_turn(self, a: Known, b: Known, localizer: Localizer) -> None:
        def never() -> Pose:
            raise AssertionError("the first guess was good")

        asked: list[Callable[[], Pose | None]] = [lambda: None, lambda: T_B_A, never]
        assert not _estimate(a.side(), b.side(), 0, asked, localizer).failed
        assert _estimate(a.side(), b.side(), 0, (lambda: None,), localizer).failed == "no guess"


class TestFusion:
    def test_lies_between_by_what_each_knows(self) -> None:
        X = pose(0.5, 0.2, -0.3, degrees=(10, -50, 20))
        one, three = (
            Estimate(0, "", X @ pose(-0.004), 1e4 * np.eye(6)),
            Estimate(1, "", X @ pose(0.004), 3e4 * np.eye(6)),
        )
        T, _ = _fused([one, three])
        torch.testing.assert_close(T, X @ pose(0.002), atol=1e-6, rtol=0)

    def test_each_direction_by_itself(self) -> None:
        """Two corridors, each blind along its own axis."""
        along_x, along_y = (np.diag([1e6 if i != blind else 0.0 for i in range(6)]) for blind in (0, 1))
        T, _ = _fused([Estimate(0, "", pose(0.01, 0.002), along_x), Estimate(1, "", pose(0.002, 0.01), along_y)])
        torch.testing.assert_close(T[:3, 3], torch.tensor([0.002, 0.002, 0.0], dtype=torch.float64), atol=1e-6, rtol=0)

    def test_the_order_does_not_matter(self) -> None:
        ones = [Estimate(i, "", se3.exp(x), MILLIMETRE * (i + 1), 0.1 * i) for i, x in enumerate(tangents(2e-3))]
        torch.testing.assert_close(_fused(ones)[0], _fused(ones[::-1])[0], atol=1e-9, rtol=0)

    def test_knows_more_than_each_until_what_all_have_in_common(self) -> None:
        generator = np.random.default_rng(3)
        root = 30 * generator.standard_normal((6, 6))
        one = Estimate(0, "", se3.identity(), root.T @ root)
        informations = [_fused([one] * count)[1] for count in (1, 2, 4, 8)]
        informations.append(_fused([replace(one, information=1e9 * one.information)] * 2)[1])
        for less, more in pairwise(informations):
            assert np.linalg.eigvalsh(more - less)[0] > 0
        np.testing.assert_allclose(informations[0], np.linalg.inv(covariance(one.information, COMMON)), rtol=1e-6)
        ceiling = np.linalg.inv(COMMON)
        for information in informations:
            assert np.linalg.eigvalsh(ceiling - information)[0] > -1e-6 * ceiling.max()
        np.testing.assert_allclose(informations[-1], ceiling, rtol=0.01, atol=0.01 * ceiling.max())

    def test_of_submaps(self, a: Known, b: Known, localizer: Localizer) -> None:
        pair = together(a, b, T_B_A, localizer)
        believed = [se3.log(se3.inverse(T_B_A) @ one.T_target_source)[:3] for one in pair.estimates]
        fused = se3.log(se3.inverse(T_B_A) @ pair.T_target_source)[:3]
        low, high = torch.stack(believed).amin(dim=0), torch.stack(believed).amax(dim=0)
        assert bool(((fused > low - 5e-4) & (fused < high + 5e-4)).all())
        assert np.abs(pair.information - pair.information.T).max() <= 1e-9 * np.abs(pair.information).max()
        assert np.linalg.eigvalsh(pair.information)[0] > 0
        for one in pair.estimates:
            sure = np.linalg.inv(covariance(one.information, COMMON))
            assert np.linalg.eigvalsh(pair.information - sure)[0] > -1e-6 * sure.max()
