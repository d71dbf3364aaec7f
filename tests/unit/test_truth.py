"""The truth beside a recording: what a clean one would show, what is wrong with this one, and views from elsewhere."""

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tcgsplat.datasets.opening import open_sequence
from tcgsplat.datasets.synthetic import SynthConfig, lighting, raycast
from tcgsplat.datasets.synthetic.free import APART, CLEARANCE, SEEN
from tcgsplat.datasets.synthetic.places import PLACES
from tcgsplat.datasets.synthetic.sensor import dropped, exposure_gains
from tcgsplat.datasets.synthetic.studio import Studio
from tcgsplat.datasets.synthetic.synthesis import camera_poses, record
from tcgsplat.datasets.synthetic.timetable import Timetable
from tcgsplat.datasets.truth import Event, Region, Truth, events_text
from tcgsplat.errors import DatasetError

Array = np.ndarray[Any, np.dtype[Any]]
SMALL = SynthConfig(frames=24, width=64, height=48, free_views=6)
EVERYTHING: dict[str, Any] = {
    "depth_noise": True, "depth_noise_scale": 2.0, "depth_bias": 0.03, "exposure_jumps": True, "motion_blur": True,
    "moving_object": True, "dropped_frames": True, "still": 5,
}  # fmt: skip
Recorder = Callable[..., Path]


@pytest.fixture(scope="module")
def recorded(studio: Studio, peopled: Studio, workers: Executor, tmp_path_factory: pytest.TempPathFactory) -> Recorder:
    """The small walk with some settings changed, recorded once for each."""
    made: dict[str, Path] = {}

    def recorded(**changes: Any) -> Path:
        config = replace(SMALL, **changes)
        if repr(config) not in made:
            out = made[repr(config)] = tmp_path_factory.mktemp("truth")
            record(peopled if config.moving_object else studio, out, config, workers)
        return made[repr(config)]

    return recorded


def truth_of(folder: Path) -> Truth:
    truth = Truth.of(folder)
    assert truth
    return truth


def depths(folder: Path) -> Array:
    return np.stack([frame.depth.numpy() for frame in open_sequence(folder)])


def true_depths(folder: Path) -> Array:
    truth = truth_of(folder)
    return np.stack([truth.depth(index).numpy() for index in range(len(truth.numbers))])  # type: ignore[union-attr]


def faults(folder: Path) -> Array:
    truth = truth_of(folder)
    return np.stack([truth.fault(index).numpy() for index in range(len(truth.numbers))])  # type: ignore[union-attr]


def events(folder: Path, name: str) -> list[tuple[int, int]]:
    return [(event.first, event.last) for event in truth_of(folder).events if event.name == name]


# Depth and masks.


def test_where_the_recording_is_exact_nothing_is_written_twice(recorded: Recorder) -> None:
    clean = recorded()
    assert sorted(path.name for path in (clean / "truth").iterdir()) == ["events.json"]
    np.testing.assert_array_equal(true_depths(clean), depths(clean))
    truth = truth_of(clean)
    assert truth.fault(3) is None
    assert truth.depth(24) is None
    assert truth.depth(-1) is None


@pytest.mark.parametrize("layout", ["tum", "replica"])
def test_the_truth_of_a_bad_recording_is_the_clean_one(recorded: Recorder, layout: str) -> None:
    changes = {**EVERYTHING, "still": 0}
    bad, clean = recorded(layout=layout, **changes), depths(recorded())
    kept = np.flatnonzero(~dropped(24, 0))
    np.testing.assert_array_equal(true_depths(bad), clean[kept])
    assert (depths(bad) != clean[kept]).mean() > 0.9, "this would not notice that the recording was taken"


def test_masks_mark_what_differs_from_the_clean_recording(recorded: Recorder) -> None:
    clean = depths(recorded())
    biased = recorded(depth_bias=0.03)
    wrong = faults(biased)
    np.testing.assert_array_equal(depths(biased) != clean, wrong)
    np.testing.assert_allclose(depths(biased)[wrong], 1.03 * clean[wrong], atol=2.1e-4)
    both = recorded(depth_bias=0.03, moving_object=True)
    np.testing.assert_array_equal(faults(both), wrong | faults(recorded(moving_object=True)))
    np.testing.assert_array_equal(depths(both) != clean, faults(both))


def test_bias_changes_noisy_depth_in_its_region_alone(recorded: Recorder) -> None:
    noisy, both = (depths(recorded(depth_noise=True, **more)) for more in ({}, {"depth_bias": 0.05}))
    wrong = faults(recorded(depth_noise=True, depth_bias=0.05))
    np.testing.assert_array_equal(both[~wrong], noisy[~wrong])
    np.testing.assert_allclose(both[wrong], 1.05 * noisy[wrong], atol=2.1e-4)
    assert ((noisy[wrong] > 0) == (both[wrong] > 0)).all()


@pytest.mark.parametrize("place", ["apartment", "twins"])
def test_the_biased_region_is_seen_right_for_long_before_it_is_seen_wrong(
    place: Any, studio: Studio, twin_rooms: Studio
) -> None:
    studio = twin_rooms if place == "twins" else studio
    config = SynthConfig(place=place)
    shares = []
    for T in camera_poses(config, np.arange(0, 600, 5) / 30):
        depth = 1 / studio.inverse_depth(T)
        v, u = np.mgrid[:48, :64]
        rays = np.stack(((u - 31.5) / studio.view.focal, (v - 23.5) / studio.view.focal, np.ones((48, 64))), axis=-1)
        points = (rays * depth[..., None]) @ T[:3, :3].T + T[:3, 3]
        shares.append(PLACES[place].biased.contains(torch.from_numpy(points)).double().mean().item())
    onset = round(120 * PLACES[place].biased_from)
    seen = np.array(shares) > 0.05
    assert seen[onset - 9 : onset + 6].all(), "in sight when it goes wrong"
    assert seen[:onset].sum() >= 10
    assert seen[onset:].sum() >= 15
    assert max(shares) < 0.5, "most of the picture stays right"


def test_more_spread_leaves_holes_where_they_were(recorded: Recorder) -> None:
    clean, one, four = (
        depths(recorded(**changes))
        for changes in ({}, {"depth_noise": True}, {"depth_noise": True, "depth_noise_scale": 4.0})
    )
    np.testing.assert_array_equal(one > 0, four > 0)
    flat = (one > 0) & (clean > 2) & (np.abs(one - clean) < 0.03 * clean)
    little, much = (np.median(np.abs(noisy - clean)[flat] / clean[flat] ** 2) for noisy in (one, four))
    assert 2.5 * little < much < 5 * little


# What happens to runs of frames.


def test_a_rest_comes_on_top_of_the_walk(recorded: Recorder) -> None:
    table = Timetable(24, 5)
    walk, rested = recorded(), recorded(still=5)
    shown = table.shown()
    assert table.recorded == len(depths(rested)) == 24 + 5 + 6
    assert sorted(set(range(24)) - set(shown.tolist())) == [10, 11, 12, 13, 14]
    once = shown >= 0
    np.testing.assert_array_equal(depths(rested)[once], depths(walk)[shown[once]])
    for a, b in zip(np.flatnonzero(once), shown[once], strict=True):
        before, after = open_sequence(walk).frame(int(b)), open_sequence(rested).frame(int(a))
        assert torch.equal(before.color, after.color)
    truth = open_sequence(rested).ground_truth()
    T = np.stack([truth[index].numpy() for index in range(35)])
    ((first, last),) = events(rested, "still camera")
    assert last - first == 5
    np.testing.assert_allclose(T[first : last + 1], np.broadcast_to(T[first], (6, 4, 4)), atol=1e-12)
    assert np.linalg.norm(T[first, :3, 3] - T[0, :3, 3]) > 2, "far from where it began"
    steps = np.diff(table.behind(np.arange(35)))
    assert (np.diff(steps[first - 6 : first]) > 0).all(), "it slows, and does not stop dead"
    assert (np.diff(steps[last : last + 6]) < 0).all()


def test_a_short_walk_stops_at_once() -> None:
    table = Timetable(6, 4)
    assert table.shown().tolist() == [0, 1, 2, 3, -1, -1, -1, 3, 4, 5]
    assert (np.arange(10) - table.behind(np.arange(10))).tolist() == [0, 1, 2, 3, 3, 3, 3, 3, 4, 5]
    assert Timetable(6, 0).shown().tolist() == [0, 1, 2, 3, 4, 5]


def test_a_camera_that_stands_still_has_noise_and_nothing_else(recorded: Recorder) -> None:
    noisy = recorded(still=5, depth_noise=True)
    ((first, last),) = events(noisy, "still camera")
    true = true_depths(noisy)[first : last + 1]
    np.testing.assert_array_equal(true, np.broadcast_to(true[0], true.shape))
    measured = depths(noisy)[first : last + 1]
    assert all((a != b).mean() > 0.3 for a, b in zip(measured[:-1], measured[1:], strict=True))
    elsewhere = Timetable(24, 5).shown()
    once = elsewhere >= 0
    np.testing.assert_array_equal(depths(noisy)[once], depths(recorded(depth_noise=True))[elsewhere[once]])


def test_events_say_when_something_happens(recorded: Recorder) -> None:
    bad = recorded(exposure_jumps=True, dropped_frames=True)
    kept = np.flatnonzero(~dropped(24, 0))
    gains = exposure_gains(24, 0)[kept]
    jumps = events(bad, "exposure jump")
    assert [first for first, _ in jumps] == (np.flatnonzero(np.diff(gains)) + 1).tolist()
    assert all(len(set(gains[first : last + 1])) == 1 for first, last in jumps)
    assert jumps[-1][1] == len(kept) - 1
    gaps = events(bad, "dropped frames")
    assert [first for first, _ in gaps] == (np.flatnonzero(np.diff(kept) > 1) + 1).tolist()
    assert gaps
    crowded = recorded(moving_object=True)
    there = {k for first, last in events(crowded, "moving object") for k in range(first, last + 1)}
    assert there == set(np.flatnonzero(faults(crowded).any(axis=(1, 2))).tolist())
    assert 0 < len(there) < 24
    ((first, last),) = events(recorded(depth_bias=0.03), "depth bias")
    assert (first, last) == (11, 23)
    assert not faults(recorded(depth_bias=0.03))[:first].any()


def test_what_the_first_frame_sees_is_away_for_long(recorded: Recorder) -> None:
    away = [event for event in truth_of(recorded()).events if event.name == "absence"]
    longest = max(away, key=lambda event: event.last - event.first)
    assert longest.region == PLACES["apartment"].first_seen
    assert longest.first < 6
    assert 16 <= longest.last < 22
    prolonged = max(events(recorded(still=5), "absence"), key=lambda run: run[1] - run[0])
    assert prolonged[1] - prolonged[0] == longest.last - longest.first + 11


def test_a_part_is_counted_as_the_sequence_counts_it(recorded: Recorder) -> None:
    folder = recorded(**EVERYTHING)
    whole, part = truth_of(folder), Truth.of(folder, start=3, stride=2, limit=12)
    assert part
    assert part.numbers == tuple(range(3, 27, 2))
    assert torch.equal(part.depth(4), whole.depth(11))  # type: ignore[arg-type]
    assert torch.equal(part.fault(4), whole.fault(11))  # type: ignore[arg-type]
    assert part.depth(12) is None
    by_name = {event.name: event for event in part.events}
    for event in whole.events:
        inside = [k for k, number in enumerate(part.numbers) if event.first <= number <= event.last]
        if event.name == "still camera":
            assert (by_name[event.name].first, by_name[event.name].last) == (inside[0], inside[-1])
    assert all(0 <= event.first <= event.last < 12 for event in part.events)


# Views beside the walk.


def test_free_views_are_off_the_walk_in_free_space_and_of_what_it_saw(studio: Studio, recorded: Recorder) -> None:
    """Each by rays through the whole scene, which know nothing of how the views were found."""
    views = truth_of(recorded()).free_views()
    assert len(views) == 6
    walk = camera_poses(SMALL, np.arange(24) / 30)
    vertices, triangles = studio.scene.static_mesh()
    boxes = raycast.tree(vertices, triangles, np.arange(len(triangles)))
    stack = lighting.Workspace(np.empty((2, 3)), np.empty((7, 3)), np.empty(64, dtype=np.int32)).stack
    rng = np.random.default_rng(0)

    def free(origin: Array, direction: Array, reach: float) -> bool:
        return bool(raycast.cast(boxes, origin, direction, reach, True, stack)[1] < 0)

    for view in views:
        T = view.T_world_cam.numpy()
        assert np.linalg.norm(walk[:, :3, 3] - T[:3, 3], axis=1).min() >= APART
        for direction in rng.standard_normal((300, 3)):
            assert free(T[:3, 3], direction / np.linalg.norm(direction), CLEARANCE)
        assert ((T[:3, 3] > 0) & (T[:3, 3] < (9.2, 4.4, 2.6))).all()
        points = view.camera.backproject(view.depth).double().numpy() @ T[:3, :3].T + T[:3, 3]
        some = points[4::9, 4::9].reshape(-1, 3)
        seen = np.zeros(len(some), dtype=bool)
        for pose in walk:
            local = (some - pose[:3, 3]) @ pose[:3, :3]
            in_view = view.camera.contains(view.camera.project(torch.from_numpy(local))).numpy() & (local[:, 2] > 0.1)
            for k in np.flatnonzero(in_view & ~seen):
                seen[k] = free(pose[:3, 3], some[k] - pose[:3, 3], 0.995)
        assert seen.mean() >= SEEN


def test_free_views_are_exact(studio: Studio, recorded: Recorder) -> None:
    for view in truth_of(recorded()).free_views():
        shot = studio.shot(view.T_world_cam.numpy()[None], np.eye(4)[None])
        np.testing.assert_allclose(view.depth.numpy(), shot.depth, atol=1.01e-4)
        # On an edge, the last digit of a pose may send a ray past it.
        assert (np.abs(view.color.numpy() - shot.color) < 0.5 / 255 + 1e-6).mean() > 0.99
        assert view.camera == open_sequence(recorded()).camera
        assert (view.depth > 0).all()


def test_free_views_are_the_same_whatever_happens_to_the_recording(recorded: Recorder) -> None:
    clean, bad = recorded(), recorded(**EVERYTHING)
    files = sorted(path.relative_to(clean) for path in (clean / "free").rglob("*.*"))
    assert len(files) == 2 * 6 + 2
    assert all((clean / file).read_bytes() == (bad / file).read_bytes() for file in files)
    assert not (recorded(free_views=0) / "free").exists()
    assert truth_of(recorded(free_views=0)).free_views() == ()


# Files.


def test_a_sequence_without_truth_has_none(tmp_path: Path) -> None:
    assert Truth.of(tmp_path) is None


def test_events_come_back_as_they_were_written(tmp_path: Path, recorded: Recorder) -> None:
    folder = recorded(free_views=1)
    path = folder / "truth" / "events.json"
    written = (
        Event("still camera", 2, 5),
        Event("depth bias", 4, 23, Region((0.0, -1.0, 0.5), (1.0, 2.0, 2.5))),
    )
    path.write_text(events_text(reversed(written)))
    assert truth_of(folder).events == written
    for broken in ("{", '[{"name": "x", "first": 1}]', "[3]", '[{"name": "x", "first": 1, "last": 2, "region": [1]}]'):
        path.write_text(broken)
        with pytest.raises(DatasetError, match=r"events\.json"):
            Truth.of(folder)
    (folder / "free" / "poses.txt").write_text("0 1 2\n")
    path.write_text("[]")
    with pytest.raises(DatasetError, match=r"poses\.txt"):
        truth_of(folder).free_views()


def test_a_region_holds_what_is_in_it() -> None:
    region = Region((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
    points = torch.tensor([[[0.5, 1.5, 2.5], [1.5, 1.5, 2.5]], [[0.5, -0.1, 0.0], [1.0, 2.0, 3.0]]])
    assert region.contains(points).tolist() == [[True, False], [False, True]]
