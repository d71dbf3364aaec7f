"""Direct alignment of a frame to one view: its derivatives, and what it converges to."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_room import CAMERA, Room, errors, pose, rendering_of
from torch import Tensor

from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.view import Rendering
from tcgsplat.scene.frame import Frame
from tcgsplat.tensors import Pose
from tcgsplat.tracking import alignment, pyramids
from tcgsplat.tracking import alignment_kernels as kernels
from tcgsplat.tracking.alignment import Alignment, _exp, align, correlation
from tcgsplat.tracking.pyramids import halved, halved_depth, luma
from tcgsplat.tracking.reference import reference_view
from tcgsplat.tracking.settings import AlignmentConfig

CONFIG = AlignmentConfig(
    iterations=(8, 5, 5), stride=1, depth_weight=1.0, min_alpha=0.7, gate=0.05, sigma_floor=0.0017, sigma_slope=0.0019
)
EVERYWHERE = torch.ones(CAMERA.height, CAMERA.width)
TELE = replace(CAMERA, fx=160.0, fy=162.0)
"""Neighbouring pixels lie on one surface everywhere, so that depth is interpolated as smoothly as intensity."""


def aligned(live: Frame, reference: Frame, weight: Tensor = EVERYWHERE, config: AlignmentConfig = CONFIG) -> Alignment:
    return at_once(live, rendering_of(reference), weight, config=config)


def at_once(
    live: Frame,
    rendering: Rendering,
    weight: Tensor = EVERYWHERE,
    T_map_ref: Pose | None = None,
    config: AlignmentConfig = CONFIG,
) -> Alignment:
    """To a view from the very guess."""
    T = se3.identity() if T_map_ref is None else T_map_ref
    return align(live, reference_view(pyramids, rendering, weight, live.camera, T, config), T, config)


def normal_equations(
    points: np.ndarray,
    intensity: np.ndarray,
    depth: np.ndarray,
    tangent: np.ndarray,
    *,
    depth_weight: float = 1.0,
    camera: Camera = CAMERA,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One pass over points [n, POINT] at a pose off the identity by `tangent`: H [6, 6], g [6] and all sums."""
    padded = np.zeros((kernels.POINT, -(-len(points) // 16) * 16), np.float32)
    padded[:, : len(points)] = points.T
    T = se3.exp(torch.from_numpy(tangent)).numpy()
    intrinsics, settings = (camera.fx, camera.fy, camera.cx, camera.cy), (0.05, depth_weight, 0.0017, 0.0019)
    constants = np.array([*T[:3, :3].flat, *T[:3, 3], *intrinsics, 1.0, 0.0, 0.05, 2.0, *settings], np.float32)
    sums = alignment.normal_equations(padded, pyramids.sampled(intensity, depth), constants)
    H = np.zeros((6, 6))
    H[np.triu_indices(6)] = sums[:21]
    return H + np.triu(H, 1).T, sums[21:27], sums


def points_of(frame: Frame, stride: int = 1) -> np.ndarray:
    """The points of a frame [n, POINT]."""
    ones = np.ones((CAMERA.height, CAMERA.width), np.float32)
    points = pyramids.points(luma(frame.color), frame.depth.numpy(), ones, frame.camera, 1, stride)
    return points[:, points[kernels.PZ] > 0].T


class TestKernels:
    @pytest.mark.parametrize(("contrast", "depth_weight"), [(1.0, 0.0), (0.0, 1.0), (1.0, 1.0)])
    def test_the_gradient_changes_as_the_jacobian_says(self, contrast: float, depth_weight: float) -> None:
        """Where all residuals are zero, H is the derivative of g: at a frame aligned with itself.

        Points lie on pixel centres there, where the bilinear picture has two slopes and central differences their
        mean, so differences to both sides agree with the Jacobian.
        """
        frame = Room(contrast=contrast).frame(camera=TELE)

        def pass_at(tangent: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            live = luma(frame.color), frame.depth.numpy()
            return normal_equations(points_of(frame), *live, tangent, camera=TELE, depth_weight=depth_weight)

        H, at_rest, _ = pass_at(np.zeros(6))
        steps = 2e-4 * np.eye(6)  # a fiftieth of a pixel
        measured = np.stack([(pass_at(step)[1] - pass_at(-step)[1]) / 4e-4 for step in steps], axis=1)
        size = np.sqrt(np.outer(np.diag(H), np.diag(H)))
        assert np.abs(at_rest / np.sqrt(np.diag(H))).max() < 1e-3
        np.testing.assert_allclose(measured / size, H / size, atol=5e-3)

    def test_the_photometric_jacobian_of_one_point(self) -> None:
        """On a picture that is linear in u and v there is no sampling error, and every number can be checked."""
        v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float32)
        picture, nothing = 0.1 + 0.005 * u + 0.003 * v, np.zeros_like(u)
        point = np.zeros((1, kernels.POINT), np.float32)
        point[0, :3], point[0, kernels.REFERENCE], point[0, kernels.WEIGHT] = (0.23, -0.17, 1.4), 0.3, 0.7

        def intensity(tangent: np.ndarray) -> float:
            stats = normal_equations(point, picture, nothing, tangent)[2]
            return float(stats[kernels.GAIN_L] / stats[kernels.GAIN_W])

        x, y, z = point[0, :3]
        seen = 0.1 + 0.005 * (CAMERA.fx * x / z + CAMERA.cx) + 0.003 * (CAMERA.fy * y / z + CAMERA.cy)
        assert intensity(np.zeros(6)) == pytest.approx(seen, rel=1e-5)

        h = 4e-3
        expected = np.array([(intensity(step) - intensity(-step)) / (2 * h) for step in h * np.eye(6)])
        H, g, _ = normal_equations(point, picture, nothing, np.zeros(6))
        r = seen - 0.3
        weight = 0.7 * 6 / (5 + (r / 0.05) ** 2) / 0.05**2
        np.testing.assert_allclose(g / (weight * r), expected, rtol=2e-3, atol=1e-3)
        np.testing.assert_allclose(H / weight, np.outer(expected, expected), rtol=4e-3, atol=1e-3)

    def test_the_geometric_jacobian_of_one_point(self) -> None:
        """A wall half a centimetre behind a point that faces the camera: pulled along z, turned by its arm."""
        wall = np.full((CAMERA.height, CAMERA.width), 1.505, np.float32)
        point = np.zeros((1, kernels.POINT), np.float32)
        point[0, :3], point[0, kernels.NZ], point[0, kernels.WEIGHT] = (0.2, -0.1, 1.5), -1.0, 0.5
        H, g, stats = normal_equations(point, np.zeros_like(wall), wall, np.zeros(6))
        sigma = 0.0017 + 0.0019 * (1.505 - 0.4) ** 2
        r = -0.005  # the normal points at the camera, the wall lies on its other side
        weight = 0.5 * 6 / (5 + (r / (2 * sigma)) ** 2) / (2 * sigma) ** 2
        j = np.array([0, 0, 1, -0.1, -0.2, 0])  # dr/drho = -n; dr/domega = -(Y x n)
        np.testing.assert_allclose(g, weight * r * j, rtol=1e-3, atol=1e-6 * weight)
        np.testing.assert_allclose(H, weight * np.outer(j, j), rtol=1e-3, atol=1e-6 * weight)
        assert np.linalg.lstsq(H, -g, rcond=None)[0][2] > 0  # and moves away from the camera, towards the wall
        assert stats[kernels.IN_VIEW] == stats[kernels.AGREEING] == 1

    @pytest.mark.parametrize(
        ("depth", "in_view", "agreeing", "counted"),
        [
            (1.5, 1, 1, True),  # the surface itself
            (0.0, 1, 0, True),  # no reading: colour alone, and nothing to agree with
            (-1.0, 0, 0, False),  # the camera saw nothing of the world here
            (1.2, 1, 0, False),  # hidden by something in front
            (1.8, 1, 0, False),  # gone
        ],
    )
    def test_what_a_reading_does_to_a_point(self, depth: float, in_view: int, agreeing: int, counted: bool) -> None:
        image = np.full((CAMERA.height, CAMERA.width), depth, np.float32)
        v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float32)
        point = np.zeros((1, kernels.POINT), np.float32)
        point[0, :3], point[0, kernels.NZ], point[0, kernels.WEIGHT] = (0.0, 0.0, 1.5), -1.0, 1.0
        H, _, stats = normal_equations(point, (u + v) / 200, image, np.zeros(6))
        assert stats[kernels.IN_VIEW] == in_view
        assert stats[kernels.AGREEING] == agreeing
        assert bool(H.any()) is counted

    @pytest.mark.parametrize(
        "out", [(-0.9, 0, 1.5), (0.9, 0, 1.5), (0, -0.7, 1.5), (0, 0.7, 1.5), (0, 0, 0.05), (0, 0, -1)]
    )
    def test_points_outside_the_picture_are_left_out(self, out: tuple[float, float, float]) -> None:
        point = np.zeros((1, kernels.POINT), np.float32)
        point[0, :3] = out
        image = np.ones((CAMERA.height, CAMERA.width), np.float32)
        assert normal_equations(point, image, image, np.zeros(6))[2][kernels.IN_VIEW] == 0

    def test_points_lie_on_the_surface_with_its_normals(self) -> None:
        room = Room()
        frame = room.frame()
        points = points_of(frame, stride=3)
        assert len(points) == 19 * 26  # rows 2 to 56 and columns 2 to 77, every third
        known = np.abs(points[:, kernels.NX : kernels.NZ + 1]).max(axis=1) > 0
        assert known.mean() > 0.8
        # In the room's frame every normal is along an axis.
        normals = points[known][:, kernels.NX : kernels.NZ + 1] @ room.T_room_world[:3, :3].numpy().T
        assert np.quantile(np.abs(normals).max(axis=1), 0.1) > 0.999
        assert ((points[known, :3] * points[known, kernels.NX : kernels.NZ + 1]).sum(axis=1) < 0).all()

    def test_points_without_depth_are_left_out_and_beside_them_have_no_normal(self) -> None:
        frame = Room().frame()
        depth = frame.depth.clone()
        depth[20:40, 30:50] = 0.0
        points = points_of(replace(frame, depth=depth))
        assert len(points) == (CAMERA.height - 4) * (CAMERA.width - 4) - 400
        u = np.rint(CAMERA.fx * points[:, 0] / points[:, 2] + CAMERA.cx)
        v = np.rint(CAMERA.fy * points[:, 1] / points[:, 2] + CAMERA.cy)
        beside = (u == 29) & (v >= 20) & (v < 40)
        assert beside.sum() == 20
        assert not points[beside, kernels.NX : kernels.NZ + 1].any()

    def test_views(self) -> None:
        """Intensity, and depth that says -1 where nothing of the world was seen; a rendering's without background."""
        rng = np.random.default_rng(0)
        color, alpha, depth = (rng.random((60, 80, *more), np.float32) for more in ((3,), (), ()))
        alpha[0, :2], depth[1, 1] = 0, 0
        grey = color @ np.array([0.299, 0.587, 0.114], np.float32)
        planar = torch.from_numpy(np.ascontiguousarray(color.transpose(2, 0, 1))).permute(1, 2, 0)  # as it is drawn
        np.testing.assert_allclose(luma(torch.from_numpy(color)), grey, rtol=1e-6)
        np.testing.assert_allclose(luma(planar), grey, rtol=1e-6)

        frame = replace(Room().frame(), color=torch.from_numpy(color), depth=torch.from_numpy(depth))
        intensity, marked = pyramids.live(replace(frame, valid=torch.from_numpy(alpha > 0.5)))
        np.testing.assert_allclose(intensity, grey, rtol=1e-6)
        np.testing.assert_array_equal(marked, np.where(alpha > 0.5, depth, -1))

        seen = replace(frame, color=planar, valid=torch.ones(60, 80, dtype=torch.bool))
        rendering = rendering_of(seen, alpha=torch.from_numpy(alpha))
        intensity, marked, composited, solid = pyramids.rendered(rendering, 0.5)
        np.testing.assert_allclose(intensity[alpha > 1e-3], grey[alpha > 1e-3], rtol=1e-5)
        assert not intensity[0, :2].any()
        np.testing.assert_allclose(marked, np.where(alpha > 0.5, depth, -1), rtol=1e-6)
        np.testing.assert_array_equal(composited, luma(rendering.color))
        np.testing.assert_array_equal(solid, np.where(alpha > 0.95, marked, -1))

    def test_halved_pictures(self) -> None:
        image = np.arange(35, dtype=np.float32).reshape(5, 7)  # the odd row and column fall off
        np.testing.assert_allclose(halved(image), [[4, 6, 8], [18, 20, 22]])

    @pytest.mark.parametrize(
        ("readings", "expected"),
        [
            ([1.0, 1.01, 1.0, 1.01], 1.005),
            ([1.0, 0.0, 0.0, 0.0], 1.0),  # holes do not count
            ([1.0, 2.0, 1.02, 2.0], 1.01),  # the nearer surface hides the other
            ([0.0, 0.0, 0.0, 0.0], 0.0),
            ([1.0, -1.0, 1.0, 0.0], -1.0),  # the border of the picture spreads
        ],
    )
    def test_halved_depth(self, readings: list[float], expected: float) -> None:
        depth = np.array(readings, np.float32).reshape(2, 2)
        assert halved_depth(depth).item() == pytest.approx(expected, rel=1e-6)

    @pytest.mark.parametrize("size", [(5, 3), (4, 34), (37, 75)])
    def test_halved_depth_of_any_size(self, size: tuple[int, int]) -> None:
        rng = np.random.default_rng(0)
        depth = rng.choice(np.array([-1, 0, 1, 1.01, 1.02, 2, 2.5], np.float32), size, p=(0.02, 0.2, *[0.156] * 5))
        expected = np.zeros((size[0] // 2, size[1] // 2))
        for y, x in np.ndindex(expected.shape):
            four = depth[2 * y : 2 * y + 2, 2 * x : 2 * x + 2]
            readings = four[four > 0]
            if four.min() < 0:
                expected[y, x] = -1
            elif readings.size:
                expected[y, x] = readings[readings < readings.min() * 1.03].mean()
        np.testing.assert_allclose(halved_depth(depth), expected, rtol=1e-6)

    @pytest.mark.parametrize("size", [(3, 3), (5, 18), (37, 75)])
    def test_live_images_of_any_size(self, size: tuple[int, int]) -> None:
        image, depth = (np.random.default_rng(seed).random(size, np.float32) for seed in (0, 1))
        dv, du = np.gradient(image)
        expected = np.stack((image, du, dv, depth), axis=-1)[1:-1, 1:-1]
        np.testing.assert_allclose(pyramids.sampled(image, depth)[1:-1, 1:-1], expected, atol=1e-6)


T_NEAR = pose(0.02, -0.015, 0.015, degrees=(1.0, -1.4, 1.0))
"""Three centimetres and two degrees away."""


@pytest.mark.parametrize(
    "T_true",
    [
        T_NEAR,
        se3.inverse(T_NEAR),
        pose(0.03, degrees=(0, 2, 0)),
        pose(0, 0, -0.03, degrees=(0, 0, -2)),
        pose(0, -0.03, 0, degrees=(-1.4, 0, 1.4)),
    ],
)
def test_finds_the_pose_from_three_centimetres_and_two_degrees(T_true: Pose, room: Room) -> None:
    found = aligned(room.frame(T_true), room.frame())
    millimetres, degrees = errors(found.T_map_cam, T_true)
    assert millimetres < 1
    assert degrees < 0.1
    assert found.agreement > 0.98 and found.correlation > 0.98


def test_the_pose_of_the_view_is_where_it_starts_from(room: Room) -> None:
    """The same motion seen from a view that stands elsewhere in the map."""
    T_map_ref = pose(1.0, -2.0, 0.5, degrees=(40, 10, -70))
    here, there = (
        at_once(room.frame(T_NEAR), rendering_of(room.frame()), T_map_ref=T).T_map_cam
        for T in (se3.identity(), T_map_ref)
    )
    torch.testing.assert_close(there, T_map_ref @ here)


@pytest.mark.parametrize("T_true", [T_NEAR, pose(0.03, -0.01, 0.02, degrees=(1.0, -2.0, 0.5))])
def test_one_view_does_for_several_frames(room: Room, T_true: Pose) -> None:
    """What is found does not depend on how far the guess is from where the view was rendered."""
    view = reference_view(pyramids, rendering_of(room.frame()), EVERYWHERE, CAMERA, se3.identity(), CONFIG)
    near, far = (align(room.frame(T_true), view, guess, CONFIG) for guess in (T_true, se3.identity()))
    assert errors(near.T_map_cam, far.T_map_cam)[0] < 0.05
    assert errors(near.T_map_cam, T_true)[0] < 1
    hasty = replace(CONFIG, iterations=(1, 0, 0))
    view = reference_view(pyramids, rendering_of(room.frame()), EVERYWHERE, CAMERA, se3.identity(), hasty)
    near, far = (align(room.frame(T_true), view, guess, hasty) for guess in (T_true, se3.identity()))
    assert 2 * errors(near.T_map_cam, T_true)[0] < errors(far.T_map_cam, T_true)[0]


def test_a_frame_is_aligned_with_itself_exactly(room: Room) -> None:
    found = aligned(room.frame(), room.frame())
    assert errors(found.T_map_cam, se3.identity())[0] < 0.02
    assert found.overlap == 1 and found.agreement == 1
    assert found.iterations < sum(CONFIG.iterations)  # coarse levels stop when nothing moves


def test_colour_alone_is_enough_where_there_is_no_depth(room: Room) -> None:
    frame = room.frame(T_NEAR)
    found = aligned(replace(frame, depth=torch.zeros_like(frame.depth)), room.frame())
    assert errors(found.T_map_cam, T_NEAR)[0] < 3


@pytest.mark.parametrize("T_true", [T_NEAR, se3.inverse(T_NEAR), pose(0.02, 0.02, degrees=(0, 1, 1))])
def test_depth_alone_is_enough_where_there_is_no_texture(T_true: Pose) -> None:
    grey = Room(contrast=0.0)
    found = aligned(grey.frame(T_true), grey.frame())
    assert errors(found.T_map_cam, T_true)[0] < 1.5
    assert found.correlation > 0.9  # two flat pictures agree


def test_what_a_flat_wall_leaves_open_stays_put() -> None:
    """A grey wall tells its distance and two angles; along itself the camera must not be thrown about."""
    facing_a_wall = Room(low=(-9.0, -9.0, -9.0), high=(9.0, 9.0, 1.5), contrast=0.0, T_room_world=se3.identity())
    found = aligned(facing_a_wall.frame(pose(0, 0, 0.02, degrees=(1, -1, 0))), facing_a_wall.frame())
    sideways, (_, _, z) = found.T_map_cam[:2, 3], found.T_map_cam[:3, 3].tolist()
    assert z == pytest.approx(0.02, abs=1e-3)
    assert sideways.norm() < 0.005
    assert errors(found.T_map_cam, pose(0, 0, 0.02, degrees=(1, -1, 0)))[1] < 0.2


@pytest.mark.parametrize(("gain", "offset"), [(0.75, 0.1), (1.3, -0.1), (1.0, 0.2)])
def test_exposure_is_found_and_does_not_move_the_camera(gain: float, offset: float, room: Room) -> None:
    frame = room.frame(T_NEAR)
    bare = replace(frame, depth=torch.zeros_like(frame.depth))  # colour has to do it alone
    other = aligned(replace(bare, color=gain * frame.color + offset), room.frame())
    assert errors(other.T_map_cam, T_NEAR)[0] < 3
    assert other.correlation > 0.98


def with_box(frame: Frame, color: float = 0.9) -> Frame:
    """Something flat stands 25 cm in front of the wall, over a fifth of the picture."""
    box = torch.zeros_like(frame.valid)
    box[10:42, 20:50] = True
    near = torch.where(box, frame.depth - 0.25, frame.depth)
    return replace(frame, depth=near, color=torch.where(box[..., None], color, frame.color))


def test_what_stands_in_front_is_left_out(room: Room) -> None:
    found = aligned(with_box(room.frame(T_NEAR)), room.frame())
    assert errors(found.T_map_cam, T_NEAR)[0] < 1.5
    assert found.agreement == pytest.approx(1 - 32 * 30 / (60 * 80), abs=0.06)


def test_what_has_left_is_left_out(room: Room) -> None:
    found = aligned(room.frame(T_NEAR), with_box(room.frame()))
    assert errors(found.T_map_cam, T_NEAR)[0] < 1.5


def test_what_the_camera_did_not_see_is_ignored(room: Room) -> None:
    """The border that undistortion leaves: black, without depth, and not valid."""
    frame = room.frame(T_NEAR)
    valid = torch.zeros_like(frame.valid)
    valid[8:-8, 10:-10] = True
    bordered = replace(
        frame,
        valid=valid,
        color=torch.where(valid[..., None], frame.color, 0.0),
        depth=torch.where(valid, frame.depth, 0.0),
    )
    found = aligned(bordered, room.frame())
    assert errors(found.T_map_cam, T_NEAR)[0] < 1.5
    assert found.overlap == pytest.approx(44 * 60 / (56 * 76), abs=0.05)


def test_what_the_map_does_not_cover_gives_no_points(room: Room) -> None:
    """Unmapped pixels render black; an alpha below the limit keeps them out at every level."""
    view = rendering_of(room.frame())
    hole = torch.zeros_like(EVERYWHERE, dtype=torch.bool)
    hole[:, 48:] = True
    thin = torch.where(hole, 0.0, 0.99)
    holed = rendering_of(room.frame(), alpha=thin)
    full = at_once(room.frame(T_NEAR), view)
    half = at_once(room.frame(T_NEAR), holed)
    assert errors(full.T_map_cam, T_NEAR)[0] < 1
    assert errors(half.T_map_cam, T_NEAR)[0] < 2.5
    assert (full.coverage, half.coverage) == (1, pytest.approx(48 / 80))


def test_thin_coverage_gives_no_points(room: Room) -> None:
    """What is covered by less than `min_alpha` is more a guess than a surface."""
    frame = room.frame()
    thin = torch.zeros_like(frame.valid)
    thin[:, 40:] = True
    wrong = replace(frame, depth=torch.where(thin, frame.depth - 0.03, frame.depth))
    view = rendering_of(wrong, alpha=torch.where(thin, 0.6, 0.99))
    strict, lax = (at_once(room.frame(T_NEAR), view, config=replace(CONFIG, min_alpha=limit)) for limit in (0.7, 0.5))
    assert errors(strict.T_map_cam, T_NEAR)[0] < 2.5
    assert errors(lax.T_map_cam, T_NEAR)[0] > 5


def shifted_patch(frame: Frame) -> Frame:
    """The left third of a view is wrong by a little: 1.5 cm too near, and painted 2 pixels off."""
    left = torch.zeros_like(frame.valid)
    left[:, :27] = True
    depth = torch.where(left, frame.depth - 0.015, frame.depth)
    return replace(frame, depth=depth, color=torch.where(left[..., None], frame.color.roll(2, dims=1), frame.color))


def test_a_region_of_low_weight_loses_its_pull(room: Room) -> None:
    """Eq. 18: what is doubtful counts less, and at no weight at all it counts for nothing."""
    live, view = room.frame(T_NEAR), shifted_patch(room.frame())
    doubt = EVERYWHERE.clone()
    off = []
    for weight in (1.0, 0.28, 0.0):
        doubt[:, :27] = weight
        off.append(errors(aligned(live, view, doubt).T_map_cam, T_NEAR)[0])
    assert off[0] > 1.5 * off[1] > 1.5 * off[2]
    assert off[2] < 1.5


def test_a_common_factor_on_all_weights_changes_nothing(room: Room) -> None:
    live, view = room.frame(T_NEAR), room.frame()
    a, b = (aligned(live, view, factor * EVERYWHERE).T_map_cam for factor in (1.0, 0.3))
    assert errors(a, b)[0] < 0.01


def test_the_inputs_stay_as_they_are(room: Room) -> None:
    frame, view = room.frame(T_NEAR), rendering_of(room.frame())
    before = [t.clone() for t in (frame.color, frame.depth, view.color, view.composited_plane_depth)]
    at_once(frame, view)
    after = (frame.color, frame.depth, view.color, view.composited_plane_depth)
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))


@pytest.mark.parametrize("size", [0.0, 1e-200, 1e-9, 1e-4, 0.3, 3.0])
def test_the_exponential_in_numpy_is_that_in_torch(size: float) -> None:
    tangent = size * np.array([0.3, -0.2, 0.5, 0.4, 0.7, -0.5])
    np.testing.assert_allclose(_exp(tangent), se3.exp(torch.from_numpy(tangent)).numpy(), atol=1e-15, rtol=1e-15)
    assert np.isnan(_exp(np.full(6, np.nan))[:3]).all()


class TestCorrelation:
    def of(self, x: np.ndarray, y: np.ndarray) -> float:
        return correlation(len(x), x.sum(), y.sum(), x @ x, x @ y, y @ y)

    def test_is_pearsons_for_textured_pictures(self) -> None:
        random = np.random.default_rng(0)
        x = random.random(1000)
        y = 0.5 * x + 0.3 * random.random(1000)
        assert self.of(x, y) == pytest.approx(np.corrcoef(x, y)[0, 1], abs=0.01)
        assert self.of(x, 0.3 * x + 0.6) > 0.98
        assert self.of(x, 1 - x) < -0.98

    def test_of_flat_pictures(self) -> None:
        flat, textured = np.full(1000, 0.5), np.random.default_rng(0).random(1000)
        assert self.of(flat, 0.3 * flat) == pytest.approx(1)
        assert self.of(flat, textured) < 0.1

    def test_of_what_is_not_a_number(self) -> None:
        assert np.isnan(self.of(np.array([0.1, np.nan]), np.array([0.1, 0.2])))
