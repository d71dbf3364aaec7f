"""What stays in memory of finished submaps, and which of them are compared."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch
from analytic_room import errors, pose
from mapped_room import CAMERA, mapped
from patterned_room import PatternedRoom

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.loop.descriptor import Impression, Vectors, Vlad
from tcgsplat.loop.features import Features, features
from tcgsplat.loop.places import NEAREST, Place, Places, measured
from tcgsplat.loop.settings import LoopConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.tensors import Pose

ROOM = PatternedRoom()
HEADINGS = (0, 60, 120, 180, 240, 300, 5, 125)
"""Degrees; the last two look where the first and the third did."""


def heading(degrees: float) -> Pose:
    return pose(degrees=(0, degrees, 0))


def pictures(index: int, T_world_cam: Sequence[Pose], room: PatternedRoom = ROOM) -> Submap:
    """A submap of which nothing but its keyframes matters."""
    keyframes = [
        Keyframe(room.frame(T, 10 * index + i, CAMERA), se3.inverse(T_world_cam[0]) @ T)
        for i, T in enumerate(T_world_cam)
    ]
    return replace(Submap.anchored(T_world_cam[0], index), keyframes=keyframes)


@pytest.fixture(scope="module")
def around() -> list[Submap]:
    """Submaps on a turn in the room, of four keyframes each."""
    return [
        pictures(i, [heading(at) @ pose(0.02 * k, 0, 0.03 * k, degrees=(0, 3 * k, k)) for k in range(4)])
        for i, at in enumerate(HEADINGS)
    ]


@pytest.fixture(scope="module")
def places(around: list[Submap], rasterizer: Rasterizer) -> Places:
    places = Places(Vlad(seed=0), rasterizer)
    for submap in around:
        places.append(submap)
    return places


@pytest.fixture(scope="module")
def T_world_map(around: list[Submap]) -> list[Pose]:
    return [submap.T_world_map for submap in around]


class TestPlace:
    def test_remembers_every_keyframe_as_it_stands(self, around: list[Submap], rasterizer: Rasterizer) -> None:
        submap = around[1]
        place = Place.of(submap, rasterizer)
        assert place.index == 1
        for view, keyframe in zip(place.views, submap.keyframes, strict=True):
            assert torch.equal(view.T_map_cam, keyframe.T_map_cam)
            assert view.camera == CAMERA
            assert np.array_equal(view.features.points, features(keyframe.frame).points)

    def test_confidence_is_of_the_map_that_a_view_looks_at(self, rasterizer: Rasterizer) -> None:
        submap = mapped([heading(0)], rasterizer)
        sure, unsure = (
            Place.of(replace(submap, confidence=replace(submap.confidence, value=value)), rasterizer)
            .views[0]
            .confidence
            for value in (torch.full((len(submap),), 0.9), torch.full((len(submap),), 0.3))
        )
        assert 0.85 < sure <= 0.9
        assert 0.25 < unsure <= 0.3
        nothing = Place.of(replace(pictures(0, [heading(0)])), rasterizer)
        assert nothing.views[0].confidence == 0

    def test_a_picture_is_located_in_it(self, around: list[Submap], rasterizer: Rasterizer) -> None:
        place, T = Place.of(around[2], rasterizer), heading(125) @ pose(0.1, -0.05, 0.0)
        frame = ROOM.frame(T, 99, CAMERA)
        found = place.guess(features(frame), CAMERA, range(4))
        assert found is not None
        assert errors(found, se3.inverse(around[2].T_world_map) @ T)[0] < 15
        assert Place.of(around[5], rasterizer).guess(features(frame), CAMERA, range(4)) is None

    def test_what_was_guessed_is_left_out(self, corner: Submap) -> None:
        ids = corner.gaussians.ids.clone()
        ids[::3] = -1
        submap = replace(corner, gaussians=replace(corner.gaussians, ids=ids))
        assert len(measured(submap)) == int((ids >= 0).sum()) < len(corner)
        assert len(measured(corner)) == len(corner)


class TestOverlap:
    def test_with_itself_it_is_whole(self, places: Places) -> None:
        assert places[0].overlap(places[0], se3.identity()) > 0.99

    def test_with_one_that_looks_away_there_is_none(self, places: Places, T_world_map: list[Pose]) -> None:
        assert places[0].overlap(places[3], se3.inverse(T_world_map[3]) @ T_world_map[0]) == 0

    def test_turned_away_from_itself_neither(self, places: Places) -> None:
        assert places[0].overlap(places[0], heading(180)) == 0

    def test_falls_with_the_angle(self, places: Places) -> None:
        shares = [places[0].overlap(places[0], heading(at)) for at in (0, 20, 40, 60)]
        assert shares == sorted(shares, reverse=True)
        assert len(set(shares)) == len(shares)

    def test_the_pose_is_of_this_place_in_the_other(self, places: Places) -> None:
        """What stands a metre to the right of the other is seen by it only if it looks right."""
        other = replace(
            places[0], views=tuple(replace(v, T_map_cam=heading(90) @ v.T_map_cam) for v in places[0].views)
        )
        assert places[0].overlap(other, heading(90)) > 0.99
        assert places[0].overlap(other, heading(-90)) == 0

    def test_a_place_without_a_feature_overlaps_with_nothing(self, places: Places, rasterizer: Rasterizer) -> None:
        grey = Place.of(pictures(0, [heading(0)], replace(ROOM, contrast=0.0)), rasterizer)
        flat = replace(grey, views=tuple(replace(v, features=v.features._chosen(np.arange(0))) for v in grey.views))
        assert flat.overlap(places[0], se3.identity()) == 0


@dataclass
class Counting:
    """A descriptor that counts how often it learns; its vectors tell after how many pictures."""

    learnt_from: list[int] = field(default_factory=list)
    described_by: dict[int, int] = field(default_factory=dict)
    words: int = 0

    def impression(self, frame: Frame, features: Features) -> Impression:  # noqa: ARG002
        return np.array([frame.index])

    def described(self, impressions: Sequence[Impression]) -> Vectors:
        self.described_by[self.words] = self.described_by.get(self.words, 0) + len(impressions)
        rows = np.zeros((len(impressions), 4), np.float32)
        rows[:, 0] = self.words
        return rows

    def learnt(self, impressions: Sequence[Impression]) -> "Counting":
        self.learnt_from.append(len(impressions))
        return Counting(self.learnt_from, self.described_by, len(impressions))


class TestWords:
    def test_are_learnt_again_whenever_there_are_twice_as_many(self, rasterizer: Rasterizer) -> None:
        descriptor = Counting()
        places = Places(descriptor, rasterizer)
        for index in range(9):
            places.append(pictures(index, [heading(0), heading(3)]))
        assert descriptor.learnt_from == [2, 4, 8, 16]
        assert descriptor.described_by == {2: 2, 4: 4 + 2, 8: 8 + 6, 16: 16 + 2}

    def test_all_vectors_are_of_the_newest(
        self, around: list[Submap], T_world_map: list[Pose], rasterizer: Rasterizer
    ) -> None:
        """After five submaps the words are those of the first four, whichever submap is compared."""
        five = Places(Vlad(seed=4), rasterizer)
        for submap in around[:5]:
            five.append(submap)
        bits = [[features(keyframe.frame).descriptors for keyframe in submap.keyframes] for submap in around[:5]]
        newest = Vlad(seed=4).learnt([each for submap in bits[:4] for each in submap])
        vectors = [newest.described(each) for each in bits]
        config = LoopConfig(min_interval=0, min_score=0.0, min_coverage=0.0, candidates=5)
        for index in (1, 3, 4):
            for candidate in five.candidates(index, T_world_map[:5], config):
                expected = vectors[index] @ vectors[candidate.submap].T
                np.testing.assert_allclose(candidate.similarity, expected, atol=1e-5)

    def test_the_same_every_time(self, around: list[Submap], T_world_map: list[Pose], rasterizer: Rasterizer) -> None:
        one, two = Places(Vlad(seed=0), rasterizer), Places(Vlad(seed=0), rasterizer)
        for submap in around[:3]:
            one.append(submap)
            two.append(submap)
        config = LoopConfig(min_score=0.0, min_coverage=0.0)
        found, again = (places.candidates(2, T_world_map[:3], config) for places in (one, two))
        assert found
        for a, b in zip(found, again, strict=True):
            assert (a.submap, a.score) == (b.submap, b.score)
            assert np.array_equal(a.similarity, b.similarity)


class TestCandidates:
    def test_the_place_seen_before_comes_first(self, places: Places, T_world_map: list[Pose]) -> None:
        assert places.candidates(6, T_world_map, LoopConfig())[0].submap == 0
        assert places.candidates(7, T_world_map, LoopConfig())[0].submap == 2

    def test_similarity_has_the_asking_views_by_row(self, places: Places, T_world_map: list[Pose]) -> None:
        for candidate in places.candidates(7, T_world_map, LoopConfig()):
            assert candidate.similarity.shape == (len(places[7].views), len(places[candidate.submap].views))

    def test_by_looks_alone_where_the_path_has_drifted(self, places: Places, T_world_map: list[Pose]) -> None:
        drifted = [*T_world_map[:7], T_world_map[7] @ heading(180)]
        assert places.candidates(7, drifted, LoopConfig())[0].submap == 2

    def test_by_where_they_stand_alone_where_all_looks_alike(
        self, T_world_map: list[Pose], rasterizer: Rasterizer
    ) -> None:
        """Submaps of one picture each in which every vector is the same: only overlap tells."""
        places = Places(Counting(), rasterizer)
        for index, at in enumerate(HEADINGS):
            places.append(pictures(index, [heading(at)]))
        found = places.candidates(7, T_world_map, LoopConfig(min_score=1.0))
        assert found[0].submap == 2
        assert found[0].score > 0.8
        assert all(candidate.score > LoopConfig().min_coverage for candidate in found)
        scores = [candidate.score for candidate in found]
        assert scores == sorted(scores, reverse=True)

    @pytest.mark.parametrize("budget", [1, 2, 3, 4, 7])
    def test_budget(self, budget: int, places: Places, T_world_map: list[Pose]) -> None:
        config = LoopConfig(candidates=budget, min_score=0.0, min_coverage=0.0)
        found = [candidate.submap for candidate in places.candidates(7, T_world_map, config)]
        assert len(found) == len(set(found)) <= budget
        assert found[0] == 2

    def test_half_by_looks_and_then_by_where_they_stand(self, places: Places, T_world_map: list[Pose]) -> None:
        """Told to stand where submap 5 does, the one that looks like 2 is compared with both."""
        told = [*T_world_map[:7], T_world_map[5]]
        found = places.candidates(7, told, LoopConfig(candidates=2, min_score=0.0))
        assert [candidate.submap for candidate in found] == [2, 5]
        assert found[1].score > 0.9  # the share that overlaps

    def test_near_ones_in_the_sequence_are_none(self, places: Places, T_world_map: list[Pose]) -> None:
        for interval in (0, 1, 3, 7):
            config = LoopConfig(min_interval=interval, min_score=0.0, min_coverage=0.0, candidates=8)
            nearest = [7 - candidate.submap for candidate in places.candidates(7, T_world_map, config)]
            assert all(apart > interval for apart in nearest)
            assert bool(nearest) is (interval < 7)
        alike = [heading(0)] * 8
        config = LoopConfig(min_interval=0, min_score=1.0, min_coverage=0.5, candidates=8)
        assert {candidate.submap for candidate in places.candidates(7, alike, config)} == set(range(7))

    def test_those_that_follow_are_not_looked_at(self, places: Places, T_world_map: list[Pose]) -> None:
        config = LoopConfig(min_interval=0, min_score=0.0, min_coverage=0.0, candidates=8)
        assert all(candidate.submap < 4 for candidate in places.candidates(4, T_world_map, config))
        assert places.candidates(0, T_world_map, config) == []


class TestSimilar:
    @pytest.mark.parametrize("at", [1, 3, 4, 5])
    def test_the_place_of_a_picture(self, at: int, places: Places) -> None:
        frame = ROOM.frame(heading(HEADINGS[at]) @ pose(0.03, 0.02, 0.04, degrees=(2, 4, -2)), 99, CAMERA)
        found = places.similar(frame, features(frame), 3)
        assert len(found) == 3
        index, views = found[0]
        assert index == at
        assert len(views) == len(set(views)) == NEAREST
        assert set(views) <= set(range(4))

    def test_the_most_alike_view_first(self, places: Places, around: list[Submap]) -> None:
        for view in range(4):
            frame = around[4].keyframes[view].frame
            index, views = places.similar(frame, features(frame), 1)[0]
            assert (index, views[0]) == (4, view)

    def test_nowhere_before_there_is_a_place(self, rasterizer: Rasterizer) -> None:
        frame = ROOM.frame(heading(0), 0, CAMERA)
        assert Places(Vlad(), rasterizer).similar(frame, features(frame), 4) == []


class TestViewpoints:
    def test_as_many_as_configured_and_the_most_alike_first(self, places: Places, T_world_map: list[Pose]) -> None:
        candidate = places.candidates(7, T_world_map, LoopConfig())[0]
        views = places.viewpoints(7, candidate.similarity, LoopConfig(views=2), None)
        assert len(views) == 2
        assert views[0] == int(candidate.similarity.max(axis=1).argmax())

    def test_confidence_ranks_them_anew(self, rasterizer: Rasterizer) -> None:
        """Eq. 25: of two views as much alike, the one that looks at the more reliable map."""
        base = mapped([heading(0), heading(0)], rasterizer)
        places = Places(Vlad(), rasterizer)
        places.append(replace(base, confidence=replace(base.confidence, value=torch.full((len(base),), 0.9))))
        place = places[0]
        unsure = replace(place.views[0], confidence=0.1)
        places._places[0] = replace(place, views=(unsure, place.views[1]))
        similarity = np.array([[0.55, 0.5], [0.5, 0.4]], np.float32)
        config = LoopConfig(views=1)
        assert places.viewpoints(0, similarity, config, None) == (0,)
        assert places.viewpoints(0, similarity, config, ConfidenceConfig().view_floor) == (1,)
        assert places.viewpoints(0, similarity, config, 1.0) == (0,)
