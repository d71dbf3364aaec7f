"""One map from several submaps: what is there twice goes, what is seen stays, brightness and confidence come along."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic_room import CAMERA, Room, pose

from tcgsplat.confidence.state import ConfidenceConfig, ConfidenceState
from tcgsplat.geometry import se3
from tcgsplat.mapping import native_optimization
from tcgsplat.mapping.brightness import exposures_of
from tcgsplat.mapping.fields import Fields
from tcgsplat.mapping.mapper import Mapper
from tcgsplat.mapping.merging import Merged, merged
from tcgsplat.mapping.refinement import for_steps, refined
from tcgsplat.mapping.seeding import IdSource
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.conventions import MIN_ALPHA
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import Rendering, render_view
from tcgsplat.scene.atlas import Atlas
from tcgsplat.scene.exposure import UNCHANGED, Exposure
from tcgsplat.scene.harmonics import SH_C0
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.scene.trajectory import TrackedPose, Trajectory
from tcgsplat.storage.run_directory import RunDirectory
from tcgsplat.storage.world_map import world_map
from tcgsplat.tensors import Pose

CONFIG = MapperConfig(iterations=5, first_iterations=20)
CONFIDENCE = ConfidenceConfig().for_updates_of(10)
VIEWS = (pose(), pose(0.05, 0.02, 0.0, degrees=(2, -6, 0)), pose(-0.04, 0.01, 0.05, degrees=(-3, 5, 1)))


def mapped(index: int, T_world_map: Pose, rasterizer: Rasterizer, exposure: Exposure = UNCHANGED) -> Submap:
    """The room as one submap sees it whose own pictures are exposed so, without its knowing."""
    ids = IdSource(first=100_000 * index)
    mapper = Mapper(CONFIG, CONFIDENCE, rasterizer, ids, torch.Generator().manual_seed(index))
    submap = Submap.anchored(T_world_map, index=index)
    for i, T_map_cam in enumerate(VIEWS):
        frame = Room().frame(T_world_map @ T_map_cam, index=10 * index + i)
        frame = replace(frame, color=exposure.applied(frame.color))
        submap = mapper.optimized(mapper.grown(Keyframe(frame, T_map_cam), submap)).submap
    n = len(submap)
    value = torch.rand(n, generator=torch.Generator().manual_seed(index)) * 0.2 + 0.4
    state = ConfidenceState(
        value=value,
        baseline=torch.rand(n),
        born=torch.arange(n) % 3,
        updates=torch.arange(n) % 5,
        expected_error=torch.rand(n),
        evidence=torch.rand(n),
    )
    return replace(submap, clock=3, confidence=state)


@pytest.fixture(scope="module")
def first(rasterizer: Rasterizer) -> Submap:
    return mapped(0, se3.identity(), rasterizer)


@pytest.fixture(scope="module")
def second(rasterizer: Rasterizer) -> Submap:
    """Half of what it sees the first one sees too."""
    return mapped(1, pose(0.05, 0.0, 0.1, degrees=(4, 25, 0)), rasterizer)


def copy_of(submap: Submap, T: Pose) -> Submap:
    """The same submap again, the whole of it moved."""
    gaussians = replace(submap.gaussians, ids=submap.gaussians.ids + 100_000)
    return replace(submap, index=submap.index + 1, gaussians=gaussians, T_world_map=T @ submap.T_world_map)


def drawn(map_: Merged, submap: int, keyframe: Keyframe, rasterizer: Rasterizer) -> Rendering:
    T_world_cam = map_.posed(submap, keyframe.T_map_cam)
    return render_view(map_.submap, keyframe.frame.camera, T_world_cam, rasterizer)


def test_one_submap_is_the_map(second: Submap, rasterizer: Rasterizer) -> None:
    alone = merged([second], CONFIG, rasterizer)
    assert alone.exposures == (UNCHANGED,)
    assert torch.equal(alone.submap.gaussians.ids, second.gaussians.ids)
    assert torch.equal(alone.submap.T_world_map, se3.identity())
    for keyframe in second.keyframes:
        own = render_view(second, CAMERA, keyframe.T_map_cam, rasterizer)
        shown = drawn(alone, 0, keyframe, rasterizer)
        for map_, here in ((shown.color, own.color), (shown.confidence, own.confidence)):
            off = (map_ - here).abs()  # where a splat is on the verge of being too faint to be drawn, it may be or not
            assert off.max() < MIN_ALPHA and off.flatten().quantile(0.99) < 1e-5


def test_no_submap_is_an_empty_map(rasterizer: Rasterizer) -> None:
    nothing = merged([], CONFIG, rasterizer)
    assert len(nothing.submap) == 0 and nothing.exposures == nothing.T_world_map == ()
    empty = Submap.anchored(se3.identity(), index=0)
    assert len(merged([empty, replace(empty, index=1)], CONFIG, rasterizer).submap) == 0


def test_an_empty_submap_changes_nothing(first: Submap, rasterizer: Rasterizer) -> None:
    both = merged([first, Submap.anchored(pose(0.1), index=1)], CONFIG, rasterizer)
    assert both.exposures == (UNCHANGED, UNCHANGED)
    assert torch.equal(both.submap.gaussians.ids, first.gaussians.ids)


@pytest.mark.parametrize(("apart", "most"), [(0.0, 1.001), (0.003, 1.02), (0.006, 1.06), (0.01, 1.25)])
def test_a_copy_beside_itself_is_there_once(first: Submap, rasterizer: Rasterizer, apart: float, most: float) -> None:
    both = merged([first, copy_of(first, pose(apart, apart, apart))], CONFIG, rasterizer)
    assert len(both.submap) < most * len(first)
    for keyframe in first.keyframes:
        own = render_view(first, CAMERA, keyframe.T_map_cam, rasterizer)
        for index in range(2):
            shown = drawn(both, index, keyframe, rasterizer)
            assert (own.alpha - shown.alpha).clamp_min(0).mean() < 0.01
            assert float((shown.color - own.color).abs().mean()) < 0.02


def test_what_is_seen_twice_goes_and_what_is_seen_stays(first: Submap, second: Submap, rasterizer: Rasterizer) -> None:
    both = merged([first, second], CONFIG, rasterizer)
    assert max(len(first), len(second)) < len(both.submap) < 0.8 * (len(first) + len(second))
    assert len(both.submap.gaussians.ids.unique()) == len(both.submap)
    for index, submap in enumerate((first, second)):
        for keyframe in submap.keyframes:
            own = render_view(submap, CAMERA, keyframe.T_map_cam, rasterizer)
            shown = drawn(both, index, keyframe, rasterizer)
            closed = own.alpha > CONFIG.seeding.min_alpha
            assert ((shown.alpha < 0.9 * CONFIG.seeding.min_alpha) & closed).float().mean() < 0.002
            assert (own.alpha - shown.alpha).clamp_min(0).mean() < 0.005
            exposed = both.exposed(index, keyframe.exposure).applied(shown.color)
            assert float((exposed - keyframe.frame.color).square().mean()) < 1e-3


def test_confidence_follows_its_gaussian(first: Submap, second: Submap, rasterizer: Rasterizer) -> None:
    whole = merged([first, second], CONFIG, rasterizer).submap
    assert whole.clock == first.clock + second.clock
    assert len(whole.keyframes) == len(first.keyframes) + len(second.keyframes)
    for submap, later in ((first, 0), (second, first.clock)):
        mine = torch.isin(whole.gaussians.ids, submap.gaussians.ids)
        assert 0 < int(mine.sum()) < len(submap)
        rows = torch.searchsorted(submap.gaussians.ids, whole.gaussians.ids[mine])
        for field in fields(ConfidenceState):
            expected = getattr(submap.confidence, field.name)[rows] + (later if field.name == "born" else 0)
            assert torch.equal(getattr(whole.confidence, field.name)[mine], expected)


def test_of_two_equals_the_later_one_is_kept_and_of_others_the_more_confident(
    first: Submap, rasterizer: Rasterizer
) -> None:
    sure = replace(first, confidence=replace(first.confidence, value=2 * first.confidence.value))
    for earlier, expected in ((first, 1), (sure, 0)):
        whole = merged([earlier, copy_of(first, pose(0.002))], CONFIG, rasterizer).submap
        assert (whole.gaussians.ids // 100_000 == expected).float().mean() > 0.98


def test_twice_is_the_same(first: Submap, second: Submap, rasterizer: Rasterizer) -> None:
    one, other = (merged([first, second], CONFIG, rasterizer) for _ in range(2))
    assert one.exposures == other.exposures
    for field in fields(one.submap.gaussians):
        assert torch.equal(getattr(one.submap.gaussians, field.name), getattr(other.submap.gaussians, field.name))


@pytest.mark.parametrize("noises", [(0.0, 0.0), (0.005, 0.015)])
@pytest.mark.parametrize("greys", [(0.5, 0.5), (0.0, 0.0), (1.0, 1.0), (0.5, 0.6)])
def test_a_plain_wall_tells_no_gain(greys: tuple[float, float], noises: tuple[float, float]) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 2, (4000, 3)) * [1, 1, 0]
    values = [
        np.concatenate((np.ones((4000, 1)), rng.normal(grey, noise, (4000, 3))), axis=1)
        for grey, noise in zip(greys, noises, strict=True)
    ]
    a, b = exposures_of(Fields([points, points], values, 0.05))
    shown = [exposure.gain * grey + exposure.offset for exposure, grey in zip((a, b), greys, strict=True)]
    assert a.gain == pytest.approx(1.0, abs=0.1) and b.gain == pytest.approx(1.0, abs=0.1)
    assert shown[0] == pytest.approx(shown[1], abs=0.01)


def test_brightness_is_brought_together(first: Submap, rasterizer: Rasterizer) -> None:
    exposure = Exposure(0.8, 0.03)
    darker = mapped(1, pose(0.05, 0.0, 0.1, degrees=(4, 25, 0)), rasterizer, exposure)
    both = merged([first, darker], CONFIG, rasterizer)
    found = both.exposures[0].relative_to(
        both.exposures[1]
    )  # map = e0(first) = e1(darker), and darker = exposure(first)
    assert found.gain == pytest.approx(exposure.gain, rel=0.02)
    assert found.offset == pytest.approx(exposure.offset, abs=0.01)
    assert float(np.mean(np.log([e.gain for e in both.exposures]))) == pytest.approx(0.0, abs=1e-9)
    for index, submap in enumerate((first, darker)):
        for keyframe in submap.keyframes:
            shown = both.exposed(index, keyframe.exposure).applied(drawn(both, index, keyframe, rasterizer).color)
            assert float((shown - keyframe.frame.color).abs().mean()) < 0.02
    for keyframe in both.submap.keyframes:
        shown = render_view(both.submap, CAMERA, keyframe.T_map_cam, rasterizer).color
        assert float((shown - keyframe.balanced.color).abs().mean()) < 0.02


def test_no_step_where_submaps_meet(first: Submap, rasterizer: Rasterizer) -> None:
    """A copy brighter here and darker there, as a shining floor is: no exposure explains it, and it shows no edge."""
    x, seam, apart = first.gaussians.means[:, 0], 0.15, 0.06
    sh = first.gaussians.sh + torch.where(x > -0.05, apart, -apart)[:, None, None] / SH_C0
    other = copy_of(first, se3.identity())
    other = replace(
        other,
        gaussians=replace(other.gaussians, sh=sh),
        confidence=replace(first.confidence, value=torch.where(x > seam, 2.0, 0.5) * first.confidence.value),
    )
    whole = merged([first, other], CONFIG, rasterizer).submap.gaussians
    rows = torch.searchsorted(first.gaussians.ids, whole.ids % 100_000)
    change = SH_C0 * (whole.sh - first.gaussians.sh[rows])[:, 0].mean(dim=1)
    here, owner = (x[rows] - seam + 0.02).abs() < 0.06, whole.ids // 100_000
    assert min(int((here & (owner == index)).sum()) for index in range(2)) > 10
    step = float(change[here & (owner == 1)].mean() - change[here & (owner == 0)].mean())
    assert abs(step) < 0.4 * apart


def test_a_hole_in_the_better_copy_is_closed_by_the_other(first: Submap, rasterizer: Rasterizer) -> None:
    keyframe = first.keyframes[0]
    centre = se3.transform(keyframe.T_map_cam, CAMERA.backproject(keyframe.frame.depth)[30, 40][None])[0]
    around = (first.gaussians.means - centre).norm(dim=1) < 0.05
    assert 3 < int(around.sum()) < 0.1 * len(first)
    holed = copy_of(first, se3.identity())
    holed = replace(holed, confidence=replace(holed.confidence, value=2 * holed.confidence.value)).kept(~around)
    assert drawn(merged([holed], CONFIG, rasterizer), 0, keyframe, rasterizer).alpha.min() < 0.3
    both = merged([first, holed], CONFIG, rasterizer)
    assert drawn(both, 0, keyframe, rasterizer).alpha.min() > 0.5
    assert len(both.submap) < 1.1 * len(first)


def guess(submap: Submap, means: torch.Tensor) -> Submap:
    """The submap with guesses at these places of its frame."""
    rows = submap.gaussians.picked(torch.zeros(len(means), dtype=torch.int64))
    ids = -torch.arange(1, len(means) + 1) - (submap.index << 32)
    return submap.grown(replace(rows, ids=ids, means=means), replace(CONFIDENCE, initial=CONFIDENCE.p_min))


def test_guesses_yield_to_what_is_measured_and_to_free_space(first: Submap, rasterizer: Rasterizer) -> None:
    """In a submap that has measured only the left side, and beside another that has measured all of it or nothing."""
    left = first.gaussians.means[:, 0] < 0.0
    blind = [
        replace(
            keyframe, frame=replace(keyframe.frame, depth=torch.where(torch.arange(80) < 40, keyframe.frame.depth, 0.0))
        )
        for keyframe in first.keyframes
    ]
    half = replace(first.kept(left), keyframes=tuple(blind))
    surface = CAMERA.backproject(first.keyframes[0].frame.depth)[30, 65]
    guessing = guess(half, torch.stack((surface, 0.7 * surface)))

    def guesses(*submaps: Submap) -> list[int]:
        ids = merged(submaps, CONFIG, rasterizer).submap.gaussians.ids
        return sorted(ids[ids < 0].tolist())

    assert guesses(guessing) == [-2, -1]
    elsewhere = copy_of(first, pose(20.0))
    assert guesses(guessing, elsewhere) == [-2, -1]
    assert guesses(guessing, copy_of(first, se3.identity())) == []
    seen_through = replace(copy_of(first, se3.identity()), keyframes=first.keyframes[:1]).kept(left)
    assert guesses(guessing, seen_through) == [-1]


def test_fields_are_sums_that_are_read_where_they_were_made() -> None:
    points = [np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0]]), np.array([[0.05, 0.0, 0.0], [-7.0, 3.0, 1.0]])]
    about = Fields(points, [np.array([[1.0, 10.0], [2.0, 20.0]]), np.array([[4.0, 40.0], [8.0, 80.0]])], 0.1)
    submaps, near = about.near(points[0])
    assert submaps.tolist() == [0, 1] and near.shape == (2, 2, 2)
    np.testing.assert_allclose(near[0, 0], [1.0 + 2.0 * 0.5, 10.0 + 20.0 * 0.5])
    np.testing.assert_allclose(near[1, 0], [0.5 * 1.0 + 0.5 * 2.0, 0.5 * 10.0 + 0.5 * 20.0])
    np.testing.assert_allclose(near[1, 1], [0.5 * 4.0, 0.5 * 40.0])
    submaps, alone = about.near(points[1][1:])
    assert submaps.tolist() == [1]
    np.testing.assert_allclose(alone, [[[8.0, 80.0]]])
    a, b = about.shared(0, 1)
    assert len(a) == len(b) and a[:, 0].sum() == pytest.approx(3.0) and b[:, 0].sum() == pytest.approx(4.0)
    assert about.overlaps(len(a)) == [(0, 1)] and about.overlaps(len(a) + 1) == []


def test_what_others_have_looked_through_goes(first: Submap, rasterizer: Rasterizer) -> None:
    """A speck before the wall that a submap took for real: its own pictures do not refute it, those of others do."""
    place = 0.5 * CAMERA.backproject(first.keyframes[0].frame.depth)[20, 60][None]
    speck = replace(first.gaussians.picked(torch.zeros(1, dtype=torch.int64)), ids=torch.tensor([99_000]), means=place)
    specked = first.grown(speck, CONFIDENCE)

    def has_speck(*submaps: Submap) -> bool:
        return 99_000 in merged(submaps, CONFIG, rasterizer).submap.gaussians.ids.tolist()

    assert has_speck(specked)
    assert not has_speck(specked, copy_of(first, se3.identity()))
    assert has_speck(specked, copy_of(first, pose(20.0)))
    standing = [
        replace(k, frame=replace(k.frame, depth=0.5 * k.frame.depth)) for k in first.keyframes
    ]  # it stood there
    assert has_speck(specked, replace(copy_of(first, se3.identity()), keyframes=tuple(standing)))
    half = replace(specked, keyframes=(*specked.keyframes, *standing))  # as many have seen it as have looked through
    assert has_speck(half, copy_of(first, se3.identity()))


@pytest.fixture
def run(first: Submap, second: Submap, tmp_path: Path) -> RunDirectory:
    """Both submaps on disk."""
    run = RunDirectory.create(tmp_path / "run", config_toml="", sequence="/data/room")
    for submap in (first, second):
        run.write_submap(submap)
    rows = tuple(TrackedPose(10 * i, float(i), i, se3.identity()) for i in range(2))
    run.write_trajectory(Trajectory(rows), Atlas((first.T_world_map, second.T_world_map)))
    return run


def test_a_map_comes_back_from_disk(run: RunDirectory, rasterizer: Rasterizer) -> None:
    assert run.load_map() is None
    made = world_map(run, rasterizer)
    run.write_map(replace(made, steps=7))
    back = run.load_map()
    assert back is not None and back.steps == 7 and back.exposures == made.exposures
    for table in ("gaussians", "confidence"):
        one, other = (getattr(whole.submap, table) for whole in (made, back))
        for field in fields(one):
            assert torch.equal(getattr(one, field.name), getattr(other, field.name))
    assert len(back.submap.keyframes) == len(made.submap.keyframes) == 6
    for one, other in zip(back.submap.keyframes, made.submap.keyframes, strict=True):
        assert torch.equal(one.frame.color, other.frame.color) and torch.equal(one.T_map_cam, other.T_map_cam)
        assert one.exposure == other.exposure
    assert world_map(run, rasterizer).steps == 7


def test_a_map_of_other_submaps_or_poses_is_not_taken(run: RunDirectory, rasterizer: Rasterizer) -> None:
    run.write_map(replace(world_map(run, rasterizer), steps=7))
    trajectory, atlas = run.trajectory()
    run.write_trajectory(trajectory, atlas.corrected((atlas.T_world_map[0], pose(0.001) @ atlas.T_world_map[1])))
    assert run.load_map() is None and world_map(run, rasterizer).steps == 0
    run.write_trajectory(trajectory, atlas)
    assert run.load_map() is not None
    (run.path / "submaps" / "0001.npz").unlink()
    assert run.load_map() is None


def test_refining_needs_no_picture_in_memory(
    run: RunDirectory, rasterizer: Rasterizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = world_map(run, rasterizer).submap
    held = replace(whole, keyframes=tuple(whole.keyframes))

    def refined_map(submap: Submap) -> Submap:
        return refined(submap, CONFIG, CONFIDENCE, rasterizer, torch.Generator().manual_seed(0), for_steps(20))

    from_memory = refined_map(held)
    monkeypatch.setattr(native_optimization, "_MOST_HELD", 0)
    from_disk = refined_map(whole)
    for field in fields(whole.gaussians):
        assert torch.equal(getattr(from_memory.gaussians, field.name), getattr(from_disk.gaussians, field.name))
    assert not torch.equal(from_disk.gaussians.means, whole.gaussians.means)
