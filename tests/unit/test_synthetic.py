"""The synthetic apartment: exact where it says so, the same every time, and every switch does one thing."""

from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tcgsplat.cli.synth import warn_of_speed
from tcgsplat.datasets.opening import open_sequence
from tcgsplat.datasets.synthetic import SynthConfig, greatest_step, synthesize, twins
from tcgsplat.datasets.synthetic.lighting import Workspace
from tcgsplat.datasets.synthetic.materials import palette
from tcgsplat.datasets.synthetic.patterns import noise
from tcgsplat.datasets.synthetic.raster import add_light
from tcgsplat.datasets.synthetic.raycast import cast, tree
from tcgsplat.datasets.synthetic.sensor import dropped, exposure_gains
from tcgsplat.datasets.synthetic.studio import Studio
from tcgsplat.datasets.synthetic.synthesis import camera_poses, record
from tcgsplat.datasets.synthetic.writer import complete_or_absent
from tcgsplat.errors import ConfigError, DatasetError

Array = np.ndarray[Any, np.dtype[Any]]
SMALL = SynthConfig(frames=12, width=64, height=48, free_views=4)
STILL = np.eye(4)[None]
Recorder = Callable[..., Path]


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("synthetic") / "base"
    synthesize(out, SMALL)
    return out


@pytest.fixture
def recorded(studio: Studio, peopled: Studio, workers: Executor, tmp_path: Path) -> Recorder:
    """Record the small walk with some settings changed, in a studio that is there already."""

    def recorded(**changes: object) -> Path:
        config = replace(SMALL, **changes)  # type: ignore[arg-type]
        out = tmp_path / "-".join(changes)
        out.mkdir()
        record(peopled if config.moving_object else studio, out, config, workers)
        return out

    return recorded


def files(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def some(contents: dict[str, bytes], *starts: str) -> dict[str, bytes]:
    return {name: data for name, data in contents.items() if name.startswith(starts)}


def images(root: Path, kind: str) -> Array:
    names = [line.split()[1] for line in (root / f"{kind}.txt").read_text().splitlines()[1:]]
    return np.stack([cv2.imread(str(root / name), cv2.IMREAD_UNCHANGED) for name in names])


def read_mesh(path: Path) -> tuple[Array, Array]:
    """Vertices [v, 3] and triangles [t, 3] of a binary PLY, by hand."""
    header, body = path.read_bytes().split(b"end_header\n", 1)
    counts = [int(line.split()[2]) for line in header.decode().splitlines() if line.startswith("element")]
    vertices = np.frombuffer(body, "<f4", 3 * counts[0]).reshape(-1, 3).astype(np.float64)
    faces = np.frombuffer(body, np.dtype([("n", "u1"), ("v", "<i4", 3)]), counts[1], offset=12 * counts[0])
    assert (faces["n"] == 3).all()
    return vertices, faces["v"]


def nearest_hit(corners: Array, origin: Array, direction: Array, *, one_sided: bool) -> float:
    """Distance along a ray to the nearest of triangles [t, 3, 3], by Cramer's rule on every one of them."""
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(e1, e2)
    with np.errstate(divide="ignore", invalid="ignore"):
        det = -(normal @ direction)
        to = origin - a
        t = (normal * to).sum(axis=1) / det
        across = np.cross(to, direction)
        u, v = (e2 * across).sum(axis=1) / det, -(e1 * across).sum(axis=1) / det
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6) & ((det > 0) | (not one_sided))
    return float(t[hit].min())


def motion(T: Array) -> tuple[Array, Array]:
    """Metres and degrees from pose to pose."""
    relative = np.linalg.inv(T[:-1]) @ T[1:]
    cosine = (np.trace(relative[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    return np.linalg.norm(relative[:, :3, 3], axis=1), np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def shot_at(studio: Studio, config: SynthConfig, seconds: float) -> tuple[Array, Any]:
    T = camera_poses(config, np.array([seconds]))
    return T[0], studio.shot(T, STILL)


# What is exact.


def test_depth_is_that_of_the_mesh_file_at_pixel_centres(studio: Studio, base: Path) -> None:
    vertices, triangles = read_mesh(base / "mesh.ply")
    patch = studio.scene.mesh.patch
    two_sided = studio.scene.mesh.two_sided[patch]
    corners = vertices[triangles]
    facing_both_ways = np.concatenate((corners, corners[two_sided][:, ::-1]))
    rng = np.random.default_rng(0)
    for seconds in (0.0, 0.13, 0.24):
        T, shot = shot_at(studio, SMALL, seconds)
        for row, column in zip(rng.integers(0, 48, 8), rng.integers(0, 64, 8), strict=True):
            view = studio.view
            ray = np.array([(column - view.cx) / view.focal, (row - view.cy) / view.focal, 1.0])
            expected = nearest_hit(facing_both_ways, T[:3, 3], T[:3, :3] @ ray, one_sided=True)
            assert shot.depth[row, column] == pytest.approx(expected, abs=1e-9)


def test_files_hold_depth_to_a_tenth_of_a_millimetre(studio: Studio, base: Path) -> None:
    stored = images(base, "depth")[3] / 5000.0
    _, shot = shot_at(studio, SMALL, 3 / SMALL.fps)
    assert np.abs(stored - shot.depth).max() <= 1e-4 + 1e-9


def test_points_of_depth_lie_on_the_mesh(studio: Studio, base: Path) -> None:
    """Each point's triangle is found by a ray that leaves a camera elsewhere in the room for the point."""
    vertices, triangles = read_mesh(base / "mesh.ply")
    corners = vertices[triangles]
    depth = images(base, "depth")[0] / 5000.0
    T = camera_poses(SMALL, np.zeros(1))[0]
    for row, column in ((5, 5), (20, 30), (40, 50), (44, 10)):
        ray = np.array([(column - studio.view.cx) / studio.view.focal, (row - studio.view.cy) / studio.view.focal, 1])
        point = T[:3, :3] @ (ray * depth[row, column]) + T[:3, 3]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        height = ((point - corners[:, 0]) * normal).sum(axis=1)
        foot = point - height[:, None] * normal
        inside = np.ones(len(corners), dtype=bool)
        for k in range(3):
            edge = corners[:, (k + 1) % 3] - corners[:, k]
            inside &= (np.cross(edge, foot - corners[:, k]) * normal).sum(axis=1) >= -1e-6
        assert np.abs(height[inside]).min() < 1e-3


def test_the_mesh_has_no_empty_triangle_and_encloses_the_camera(base: Path) -> None:
    vertices, triangles = read_mesh(base / "mesh.ply")
    corners = vertices[triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert area.min() > 0
    assert triangles.max() == len(vertices) - 1
    T = camera_poses(replace(SMALL, frames=100), np.arange(100) / 30)
    assert (images(base, "depth") > 0).all(), "a ray has slipped between two surfaces"
    assert (T[:, :3, 3] > vertices.min(axis=0) + 0.5).all()
    assert (T[:, :3, 3] < vertices.max(axis=0) - 0.5).all()


def test_colour_and_depth_of_one_frame_predict_another(studio: Studio) -> None:
    config, view = SynthConfig(width=64, height=48), studio.view
    v, u = np.meshgrid(np.arange(48), np.arange(64), indexing="ij")

    def compared(T_first: Array, T_second: Array, first: Any, second: Any) -> tuple[float, float]:
        """Part of the first picture that the second one shows, and how much colours differ there."""
        z = first.depth
        points = np.stack(((u - view.cx) / view.focal * z, (v - view.cy) / view.focal * z, z, np.ones_like(z)), axis=-1)
        there = points @ (np.linalg.inv(T_second) @ T_first).T
        x, y = (view.focal * there[..., k] / there[..., 2] + c for k, c in ((0, view.cx), (1, view.cy)))
        warped = cv2.remap(second.color, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
        seen = cv2.remap(second.depth, x.astype(np.float32), y.astype(np.float32), cv2.INTER_NEAREST)
        same = (x > 1) & (x < 62) & (y > 1) & (y < 46) & (np.abs(seen - there[..., 2]) < 0.02 * there[..., 2])
        return float(same.mean()), float(np.abs(warped - first.color)[same].mean())

    for seconds in (2.0, 8.0, 13.0):
        T_first, first = shot_at(studio, config, seconds)
        T_second, second = shot_at(studio, config, seconds + 4 / 30)
        shown, difference = compared(T_first, T_second, first, second)
        assert shown > 0.6
        assert difference < 0.03
        assert compared(T_first, T_first, first, second)[1] > 2 * difference, "this would not notice wrong poses"


def test_the_tree_finds_what_asking_every_triangle_finds(studio: Studio) -> None:
    vertices, triangles = studio.scene.static_mesh()
    boxes = tree(vertices, triangles, np.arange(len(triangles)))
    assert (np.sort(boxes.source) == np.arange(len(triangles))).all()
    rng = np.random.default_rng(1)
    space = Workspace(np.empty((2, 3)), np.empty((7, 3)), np.empty(64, dtype=np.int32))
    for _ in range(20):
        origin, direction = rng.uniform((0.5, 0.5, 0.5), (4.5, 3.0, 2.2)), rng.standard_normal(3)
        distance, hit, _, _ = cast(boxes, origin, direction, 100.0, False, space.stack)
        assert hit >= 0
        assert distance == pytest.approx(nearest_hit(vertices[triangles], origin, direction, one_sided=False))


# What the camera does.


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(("frames", "metres", "degrees"), [(600, 0.0205, 1.55), (300, 0.041, 3.1)])
def test_the_camera_moves_gently_and_comes_back(seed: int, frames: int, metres: float, degrees: float) -> None:
    T = camera_poses(SynthConfig(frames=frames, seed=seed), np.arange(frames) / 30)
    moved, turned = motion(T)
    assert moved.max() < metres
    assert turned.max() < degrees
    assert moved.sum() > 6, "it walks through both rooms"
    assert turned.sum() > 360, "it looks around"
    (away,), (askew,) = motion(T[[0, -1]])
    assert away < 0.05
    assert askew < 3
    rotation = T[:, :3, :3]
    np.testing.assert_allclose(
        rotation @ rotation.transpose(0, 2, 1), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-12
    )
    assert (np.linalg.det(rotation) > 0).all()


@pytest.mark.parametrize("rest", [0, 20])
def test_its_greatest_step_is_known(rest: int) -> None:
    config = SynthConfig(frames=60, fps=10, still=rest)
    moved, turned = motion(camera_poses(config, np.arange(config.timetable.recorded) / 10))
    assert greatest_step(config) == pytest.approx((moved.max(), turned.max()), rel=1e-6)
    assert greatest_step(config).metres > 0.1


@pytest.mark.parametrize(
    ("config", "advice"),
    [
        (SynthConfig(), None),
        (SynthConfig(frames=200), None),
        (SynthConfig(place="twins"), None),
        (SynthConfig(frames=60), "the camera moves by up to 19 cm and 14 degrees a frame, faster than"),
        (SynthConfig(frames=60), "--frames 190 or more, and for a short run take the first "),
        (SynthConfig(frames=3), "--frames 190 or more"),
        (SynthConfig(frames=300, place="twins"), "--frames 410 or more"),
    ],
)  # fmt: skip
def test_a_walk_too_fast_to_be_tracked_is_told(
    config: SynthConfig, advice: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    warn_of_speed(config)
    if advice is None:
        assert caplog.messages == []
    else:
        (told,) = caplog.messages
        assert advice in told


def test_the_camera_visits_both_rooms_and_the_seed_shakes_it() -> None:
    T = camera_poses(SynthConfig(), np.arange(600) / 30)
    assert T[:, 0, 3].min() < 3
    assert T[:, 0, 3].max() > 6
    other = camera_poses(SynthConfig(seed=1), np.arange(600) / 30)
    apart = np.linalg.norm(T[:, :3, 3] - other[:, :3, 3], axis=1)
    assert 0 < apart.max() < 0.05


def test_what_it_sees_is_near_and_full_of_detail(base: Path) -> None:
    depth, color = images(base, "depth") / 5000.0, images(base, "rgb").astype(np.float32)
    assert ((depth > 0.8) & (depth < 5)).mean() > 0.85
    assert depth.min() > 0.3
    for image in color:
        across = np.abs(np.diff(image.mean(axis=2), axis=1))
        assert (across > 3).mean() > 0.4
        assert 60 < image.mean() < 200


def test_things_stand_in_their_own_shade(studio: Studio) -> None:
    def brightness(x: float, y: float) -> float:
        total = np.zeros(3)
        for light in (studio.direct, studio.indirect):
            add_light(light, 0, x / 5.0, 1 - y / 4.4, total)  # patch 0 is the living room's floor
        return float(total.mean())

    open_floor, under_sofa, under_table = brightness(3.3, 1.7), brightness(2.0, 3.95), brightness(2.0, 2.6)
    assert under_sofa < 0.3 * open_floor
    assert under_table < 0.8 * open_floor


# What is written.


def test_the_same_configuration_gives_the_same_bytes(peopled: Studio, workers: Executor, tmp_path: Path) -> None:
    everything = replace(
        SMALL, layout="replica", depth_noise=True, exposure_jumps=True, motion_blur=True, moving_object=True,
        dropped_frames=True, depth_noise_scale=2.0, depth_bias=0.03, still=3,
    )  # fmt: skip
    reports: list[tuple[int, int]] = []
    synthesize(tmp_path / "a", everything, lambda done, total: reports.append((done, total)))
    (tmp_path / "b").mkdir()
    with ThreadPoolExecutor(1) as alone:
        record(peopled, tmp_path / "b", everything, alone)
    assert files(tmp_path / "a") == files(tmp_path / "b")
    assert reports == [(k + 1, len(reports)) for k in range(len(reports))]
    assert len(reports) == len(list((tmp_path / "a/results").glob("frame*.jpg")))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]


def test_the_tum_layout_can_be_opened(base: Path) -> None:
    sequence = open_sequence(base)
    frames = list(sequence)
    assert [frame.timestamp for frame in frames] == pytest.approx(np.arange(12) / 30, abs=1e-6)
    camera = sequence.camera
    assert (camera.width, camera.height, camera.cx, camera.cy) == (64, 48, 31.5, 23.5)
    assert np.degrees(2 * np.arctan(32 / camera.fx)) == pytest.approx(70)
    truth = sequence.ground_truth()
    T = camera_poses(SMALL, np.arange(12) / 30)
    for index, pose in enumerate(T):
        np.testing.assert_allclose(truth[index].numpy(), pose, atol=1e-12)
    np.testing.assert_allclose(frames[5].depth.numpy(), images(base, "depth")[5] / 5000, atol=1e-6)


def test_the_replica_layout_can_be_opened_and_shows_the_same(base: Path, recorded: Recorder) -> None:
    sequence = open_sequence(recorded(layout="replica"))
    frames = list(sequence)
    assert len(frames) == 12
    truth = sequence.ground_truth()
    np.testing.assert_array_equal(truth[11].numpy(), camera_poses(SMALL, np.array([11 / 30]))[0])
    for frame, depth, color in zip(frames, images(base, "depth"), images(base, "rgb"), strict=True):
        np.testing.assert_allclose(frame.depth.numpy(), depth / 5000, atol=2e-4)
        assert np.abs(255 * frame.color.numpy() - color[..., ::-1]).mean() < 6  # JPEG


def test_a_folder_with_something_in_it_is_refused(tmp_path: Path) -> None:
    (tmp_path / "kept.txt").write_text("mine")
    with pytest.raises(DatasetError, match="not an empty folder"):
        synthesize(tmp_path, SMALL)
    with pytest.raises(DatasetError, match=r"kept\.txt"):
        synthesize(tmp_path / "kept.txt", SMALL)
    assert (tmp_path / "kept.txt").read_text() == "mine"


def test_a_sequence_is_there_when_it_is_complete(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "room"
    with pytest.raises(KeyboardInterrupt), complete_or_absent(out) as folder:
        (folder / "half").write_text("")
        raise KeyboardInterrupt
    assert list(out.parent.iterdir()) == []
    out.mkdir()
    with complete_or_absent(out) as folder:
        (folder / "whole").write_text("")
        assert ".partial-" in str(folder)
    assert [path.name for path in out.parent.iterdir()] == ["room"]
    assert [path.name for path in out.iterdir()] == ["whole"]


@pytest.mark.parametrize(
    ("change", "name"),
    [({"frames": 1}, "frames"), ({"width": 8}, "width"), ({"fps": 0.0}, "fps"), ({"seed": -1}, "seed"),
     ({"depth_bias": 3.0}, "depth_bias"), ({"still": -1}, "still"), ({"free_views": -1}, "free_views"),
     ({"depth_noise_scale": 2.0}, "depth_noise_scale"), ({"depth_noise": True, "depth_noise_scale": -1.0}, "scale"),
     ({"layout": "kitti"}, "layout"), ({"place": "attic"}, "place"), ({"fps": float("nan")}, "fps")],
)  # fmt: skip
def test_settings_that_cannot_be_are_named(change: dict[str, object], name: str) -> None:
    with pytest.raises(ConfigError, match=name):
        SynthConfig(**change)  # type: ignore[arg-type]


# What each switch does, and what it leaves alone.


def test_recording_twice_in_other_studios_gives_the_same(base: Path, recorded: Recorder) -> None:
    assert files(recorded(layout="tum")) == files(base)


def test_depth_noise_changes_depth_alone(base: Path, recorded: Recorder) -> None:
    noisy = recorded(depth_noise=True)
    a, b = files(base), files(noisy)
    assert b.keys() - a.keys() == set(some(b, "truth/depth/"))
    assert {name for name in a if a[name] != b[name]} == set(some(a, "depth/"))
    assert list(some(b, "truth/depth/").values()) == list(some(a, "depth/").values())
    true, measured = images(base, "depth") / 5000, images(noisy, "depth") / 5000
    valid = measured > 0
    assert 0.01 < 1 - valid.mean() < 0.3
    error = np.abs(measured - true)
    near, far = valid & (true > 1) & (true < 1.7), valid & (true > 3)
    assert 0.0005 < np.median(error[near]) < 0.006
    assert 0.004 < np.median(error[far]) < 0.04
    assert (error[valid] > 0.1).mean() < 0.1, "only edges are far off"
    assert 1 - valid[true > 5].mean() > 1 - valid[true < 3].mean(), "far things are lost more often"


def test_exposure_jumps_scale_colour_alone(base: Path, recorded: Recorder) -> None:
    jumpy = recorded(exposure_jumps=True)
    a, b = files(base), files(jumpy)
    assert b.keys() - a.keys() == {"exposure.txt"}
    assert {name for name in a if a[name] != b[name]} <= set(some(a, "rgb/")) | {"truth/events.json"}
    rows = [line.split() for line in (jumpy / "exposure.txt").read_text().splitlines()[1:]]
    gains = np.array([float(gain) for _, gain in rows])
    np.testing.assert_array_equal(gains, exposure_gains(12, 0))
    assert gains[0] == 1
    assert len(set(gains)) > 1
    expected = np.clip(gains[:, None, None, None] * images(base, "rgb"), 0, 255)
    assert np.abs(images(jumpy, "rgb") - expected).max() <= 1.3  # both are rounded


def test_motion_blur_smooths_colour_alone(base: Path, recorded: Recorder) -> None:
    blurred = recorded(motion_blur=True)
    a, b = files(base), files(blurred)
    assert {name for name in a if a[name] != b[name]} == set(some(a, "rgb/"))
    sharp, smooth = (np.abs(np.diff(images(root, "rgb").astype(float), axis=2)).mean() for root in (base, blurred))
    assert smooth < 0.8 * sharp


def test_the_moving_object_is_where_its_mask_says(base: Path, recorded: Recorder) -> None:
    crowded = recorded(moving_object=True)
    a, b = files(base), files(crowded)
    assert b.keys() - a.keys() == set(some(b, "mask/", "truth/depth/", "truth/fault/"))
    assert len(some(b, "mask/")) == 12
    assert list(some(b, "mask/").values()) == list(some(b, "truth/fault/").values())
    assert list(some(b, "truth/depth/").values()) == list(some(a, "depth/").values())
    assert some(a, "free/") == some(b, "free/")
    for name in ("mesh.ply", "groundtruth.txt", "rgb.txt", "depth.txt", "camera.toml"):
        assert a[name] == b[name]
    mask = np.stack([cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in sorted((crowded / "mask").iterdir())])
    assert set(np.unique(mask)) == {0, 255}
    inside = mask > 0
    assert (inside.mean(axis=(1, 2)) > 0.01).sum() >= 3
    true, seen = images(base, "depth").astype(int), images(crowded, "depth").astype(int)
    assert (true[~inside] == seen[~inside]).all()
    assert (true[inside] > seen[inside]).all()
    around = np.stack([cv2.dilate(m, np.ones((3, 3), np.uint8)) for m in mask]) > 0
    assert (images(base, "rgb")[~around] == images(crowded, "rgb")[~around]).all()
    assert (images(base, "rgb")[inside] != images(crowded, "rgb")[inside]).mean() > 0.8


def test_dropped_frames_are_missing_and_the_others_are_untouched(base: Path, recorded: Recorder) -> None:
    gappy = recorded(dropped_frames=True)
    a, b = files(base), files(gappy)
    lost = dropped(12, 0)
    assert 0 < lost.sum() < 11
    assert not lost[0]
    assert not lost[-1]
    kept = {name: data for name, data in a.items() if name not in {"rgb.txt", "depth.txt"}}
    assert some(b, "rgb/", "depth/", "mesh", "ground", "camera").items() <= kept.items()
    assert len(some(b, "rgb/")) == 12 - lost.sum()
    assert [frame.timestamp for frame in open_sequence(gappy)] == pytest.approx(np.flatnonzero(~lost) / 30, abs=1e-6)


def test_effects_do_not_disturb_each_other(recorded: Recorder) -> None:
    alone, together = recorded(depth_noise=True), recorded(depth_noise=True, dropped_frames=True, exposure_jumps=True)
    a, b = some(files(alone), "depth/"), some(files(together), "depth/")
    assert len(b) < len(a)
    assert b.items() <= a.items()
    gains = {line.split()[0]: line.split()[1] for line in (together / "exposure.txt").read_text().splitlines()[1:]}
    expected = dict(zip((f"{k / 30:.6f}" for k in range(12)), exposure_gains(12, 0), strict=True))
    assert {name: float(gain) for name, gain in gains.items()} == {name: expected[name] for name in gains}


def test_long_walks_lose_runs_of_frames() -> None:
    lost = dropped(600, 3)
    edges = np.flatnonzero(np.diff(lost.astype(int)))
    assert 4 <= len(edges) // 2 <= 6
    assert 0.01 < lost.mean() < 0.07


# Two rooms that look the same.


def test_the_apartment_is_what_it_was_before_there_were_twins(base: Path) -> None:
    """A texture that starts elsewhere changes these pixels already."""
    vertices, triangles = read_mesh(base / "mesh.ply")
    assert (len(vertices), len(triangles)) == (60513, 72604)
    color, depth = images(base, "rgb"), images(base, "depth")
    np.testing.assert_allclose(color.mean(axis=(1, 2, 3))[::4], [136.627, 134.522, 128.689], atol=0.05)
    np.testing.assert_allclose(depth.mean(axis=(1, 2))[::4], [14171.05, 17504.28, 10023.94], atol=0.5)
    before = [
        [[205, 215, 211], [116, 149, 156], [168, 195, 197], [87, 102, 123]],
        [[107, 128, 134], [86, 115, 126], [73, 115, 198], [118, 123, 82]],
        [[115, 157, 215], [57, 78, 65], [62, 72, 77], [67, 83, 138]],
    ]
    np.testing.assert_allclose(color[0, 8:48:16, 8:64:16], before, atol=1.0)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_walk_sees_room_two_as_it_saw_room_one_and_comes_back(seed: int) -> None:
    T = camera_poses(SynthConfig(place="twins", seed=seed), np.arange(600) / 30)
    moved, turned = motion(T)
    assert moved.max() < 0.042
    assert turned.max() < 3.1
    (away,), (askew,) = motion(T[[0, -1]])
    assert away < 0.05
    assert askew < 3
    in_the_hall = T[:, 0, 3] > twins.HALL[0]
    assert np.flatnonzero(np.diff(in_the_hall.astype(int))).size == 4, "into the hall and out of it, twice"
    for view in T[:100:10]:
        analogous = view.copy()
        analogous[:3, 3] += twins.APART
        metres, degrees = np.transpose([motion(np.stack((analogous, pose))) for pose in T])[0]
        assert (metres + np.radians(degrees)).min() < 0.1


def test_from_inside_the_twins_look_the_same(twin_rooms: Studio) -> None:
    differing = []
    for T in camera_poses(SynthConfig(place="twins"), np.array([0, 18, 36, 54, 72, 90, 108]) / 30):
        one = twin_rooms.shot(T[None], STILL)
        elsewhere = T.copy()
        elsewhere[:3, 3] += twins.APART
        two = twin_rooms.shot(elsewhere[None], STILL)
        np.testing.assert_allclose(two.depth, one.depth, atol=1e-4)
        difference = 255 * np.abs(two.color - one.color).max(axis=2)
        assert np.median(difference) < 5, "the light of a few rays differs a little"
        differing.append(float((difference > 40).mean()))
        elsewhere[:3, 3] += (0.3, 0.0, 0.0)
        beside = twin_rooms.shot(elsewhere[None], STILL)
        moved = 255 * np.abs(beside.color - one.color).max(axis=2)
        assert moved.mean() > 3 * difference.mean(), "this would not notice another room"
    assert 0.01 < max(differing) < 0.06, "a poster"
    assert np.median(differing) < 0.01


def test_the_twins_are_recorded_like_the_apartment(twin_rooms: Studio, workers: Executor, tmp_path: Path) -> None:
    config = replace(SMALL, place="twins")
    record(twin_rooms, tmp_path, config, workers)
    truth = open_sequence(tmp_path).ground_truth()
    np.testing.assert_allclose(truth[7].numpy(), camera_poses(config, np.array([7 / 30]))[0], atol=1e-12)
    vertices, triangles = read_mesh(tmp_path / "mesh.ply")
    corners = vertices[triangles]
    two_sided = twin_rooms.scene.mesh.two_sided[twin_rooms.scene.mesh.patch]
    facing_both_ways = np.concatenate((corners, corners[two_sided][:, ::-1]))
    depth, view = images(tmp_path, "depth") / 5000.0, twin_rooms.view
    assert (depth > 0).all(), "a ray has slipped between two surfaces"
    for index, row, column in ((0, 20, 30), (3, 10, 50), (5, 40, 12), (7, 24, 32), (9, 30, 60)):
        T = truth[index].numpy()
        ray = np.array([(column - view.cx) / view.focal, (row - view.cy) / view.focal, 1.0])
        expected = nearest_hit(facing_both_ways, T[:3, 3], T[:3, :3] @ ray, one_sided=True)
        assert depth[index, row, column] == pytest.approx(expected, abs=2e-4)


# Paint.


def test_noise_has_no_seam() -> None:
    field = noise(np.random.default_rng(0), 64, 128, 4, 8)
    inner = np.abs(np.diff(field, axis=1)).mean()
    assert np.abs(field[:, 0] - field[:, -1]).mean() < 1.5 * inner
    assert np.abs(field[0] - field[-1]).mean() < 1.5 * np.abs(np.diff(field, axis=0)).mean()


def test_another_seed_has_other_colours() -> None:
    assert palette(0) != palette(1)
