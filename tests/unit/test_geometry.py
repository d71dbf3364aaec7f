"""Quaternions, rigid transforms, the camera, Gaussians and trajectories, against scipy and by hand."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y
from torch import Tensor

from tcgsplat.geometry import quaternion, se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.scene.atlas import Atlas
from tcgsplat.scene.gaussians import Gaussians, sh_basis
from tcgsplat.scene.trajectory import TrackedPose, Trajectory, format_tum, parse_tum

CAMERA = Camera(fx=500.0, fy=510.0, cx=319.5, cy=239.5, width=640, height=480)


def row(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def some_gaussians(n: int, sh_degree: int, generator: torch.Generator, first_id: int = 0) -> Gaussians:
    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        ids=torch.arange(first_id, first_id + n),
        means=normal(n, 3),
        log_scales=normal(n, 3) - 3,
        quats=normal(n, 4),
        logit_opacities=normal(n),
        sh=normal(n, (sh_degree + 1) ** 2, 3),
    )


# Quaternions


def test_a_quaternion_turns_the_way_its_axis_says() -> None:
    quarter_about_z = row(math.sqrt(0.5), 0, 0, math.sqrt(0.5))
    torch.testing.assert_close(quaternion.to_matrix(quarter_about_z) @ row(1, 0, 0), row(0, 1, 0))


def test_matrices_agree_with_scipy(generator: torch.Generator) -> None:
    quats = torch.randn(50, 4, generator=generator, dtype=torch.float64)
    scipys = Rotation.from_quat(quats.numpy(), scalar_first=True).as_matrix()
    torch.testing.assert_close(quaternion.to_matrix(quats), torch.from_numpy(scipys))


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("off", [0.0, 1e-12, 1e-8, 1e-4])
def test_every_half_turn_has_an_exact_quaternion(axis: int, off: float) -> None:
    rotvec = np.full(3, off)
    rotvec[axis] = math.pi
    matrix = torch.from_numpy(Rotation.from_rotvec(rotvec).as_matrix())
    quat = quaternion.from_matrix(matrix)
    assert quat[0] >= 0
    torch.testing.assert_close(quaternion.to_matrix(quat), matrix, atol=1e-14, rtol=0)


def test_the_zero_quaternion_gives_the_identity_and_no_nan() -> None:
    torch.testing.assert_close(quaternion.to_matrix(torch.zeros(4)), torch.eye(3))
    assert quaternion.normalize(torch.zeros(4)).tolist() == [0.0] * 4


def test_quaternions_keep_their_batch_shape() -> None:
    matrices = quaternion.to_matrix(torch.ones(2, 5, 4))
    assert matrices.shape == (2, 5, 3, 3)
    assert quaternion.from_matrix(matrices).shape == (2, 5, 4)


# Rigid transforms


def test_exp_follows_a_screw_by_hand() -> None:
    # Half a circle of radius 1 about z while moving forward: ends beside the start, looking back.
    T = se3.exp(row(math.pi, 0, 0, 0, 0, math.pi))
    expected = torch.diag(row(-1, -1, 1, 1))
    expected[1, 3] = 2.0
    torch.testing.assert_close(T, expected)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 1e-3, 1.0, math.pi])
def test_exp_is_differentiable_at_every_angle(angle: float) -> None:
    tangent = torch.cat((row(0.1, 0.2, 0.3), angle * row(2 / 3, -1 / 3, 2 / 3)))
    assert torch.autograd.gradcheck(se3.exp, (tangent.requires_grad_(),))


def test_exp_has_a_finite_gradient_at_the_smallest_turns() -> None:
    for angle in (0.0, 1e-300, 1e-160, 1e-20):
        tangent = row(1, 2, 3, angle, 0, 0).requires_grad_()
        se3.exp(tangent).sum().backward()
        assert tangent.grad.isfinite().all()


def test_inverse_is_differentiable() -> None:
    T = se3.exp(row(0.1, 0.2, 0.3, 0.4, 0.5, 0.6)).requires_grad_()
    assert torch.autograd.gradcheck(se3.inverse, (T,))


def test_transform_moves_points_and_keeps_their_type() -> None:
    quarter_about_z = se3.exp(row(0, 0, 0, 0, 0, math.pi / 2))
    quarter_about_z[:3, 3] = row(1, 2, 3)
    points = se3.transform(quarter_about_z, torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    torch.testing.assert_close(points, torch.tensor([[1.0, 3.0, 3.0], [1.0, 2.0, 4.0]]))


def test_norms_of_a_transform() -> None:
    T = se3.from_rotation_translation(quaternion.to_matrix(row(0.5, 0, math.sqrt(0.75), 0)), row(0, 3, 4))
    assert se3.rotation_angle(T) == pytest.approx(2 * math.pi / 3)
    assert se3.translation_norm(T) == 5.0


def test_orthonormalized_repairs_drift_and_never_mirrors() -> None:
    T = se3.exp(row(1, 2, 3, 0.4, 0.5, 0.6))
    drifted = T.clone()
    drifted[:3, :3] += 1e-4 * torch.tensor([[1.0, -2, 0], [3, 1, 1], [0, 0, -1]])
    R = se3.orthonormalized(drifted)[:3, :3]
    torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(R, T[:3, :3], atol=1e-3, rtol=0)
    mirrored = torch.diag(row(1, 1, -1.001, 1))
    assert torch.linalg.det(se3.orthonormalized(mirrored)[:3, :3]).item() == pytest.approx(1.0)


# The camera


def test_an_image_spans_half_a_pixel_around_its_outermost_centres() -> None:
    width, height = CAMERA.width, CAMERA.height
    inside = torch.tensor([[0, 0], [-0.49, 3], [width - 0.51, height - 0.51]])
    outside = torch.tensor([[-0.51, 3], [3, -0.51], [width - 0.49, 3], [3, height - 0.49], [math.nan, 3]])
    assert CAMERA.contains(inside).all() and not CAMERA.contains(outside).any()


def test_a_point_on_the_axis_projects_to_the_principal_point() -> None:
    torch.testing.assert_close(CAMERA.project(row(0, 0, 2)), row(319.5, 239.5))
    torch.testing.assert_close(CAMERA.project(row(0.2, -0.1, 2)), row(319.5 + 50, 239.5 - 25.5))


def test_pixel_centres_are_integers() -> None:
    rays = CAMERA.rays()
    assert rays.shape == (480, 640, 3)
    torch.testing.assert_close(CAMERA.project(rays[7, 11]), torch.tensor([11.0, 7.0]), atol=1e-4, rtol=0)


def test_halving_an_image_puts_a_new_centre_between_four_old_ones() -> None:
    half = CAMERA.scaled(0.5)
    assert (half.width, half.height) == (320, 240)
    point = row(0.3, 0.2, 1.5)
    torch.testing.assert_close(half.project(point), (CAMERA.project(point) - 0.5) / 2)


def test_cropping_shifts_pixels_by_the_border() -> None:
    cropped = CAMERA.cropped(10)
    assert (cropped.width, cropped.height) == (620, 460)
    point = row(0.3, 0.2, 1.5)
    torch.testing.assert_close(cropped.project(point), CAMERA.project(point) - 10)


# Gaussians


def test_harmonics_are_the_real_ones_with_the_condon_shortley_phase(generator: torch.Generator) -> None:
    directions = torch.nn.functional.normalize(torch.randn(40, 3, generator=generator, dtype=torch.float64), dim=-1)
    x, y, z = directions.numpy().T
    theta, phi = np.arccos(z), np.arctan2(y, x)
    expected = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            Y = sph_harm_y(degree, abs(order), theta, phi)
            expected.append(Y.real if order == 0 else math.sqrt(2) * (Y.real if order > 0 else Y.imag))
    torch.testing.assert_close(sh_basis(directions, 3), torch.from_numpy(np.stack(expected, axis=-1)))


def test_colour_of_degree_zero_is_the_same_from_everywhere_and_never_negative(generator: torch.Generator) -> None:
    gaussians = some_gaussians(20, 0, generator)
    assert torch.equal(gaussians.colors(torch.zeros(3)), gaussians.colors(torch.ones(3)))
    assert gaussians.colors(torch.zeros(3)).min() == 0


def test_colour_of_higher_degree_depends_on_where_it_is_seen_from(generator: torch.Generator) -> None:
    gaussians = some_gaussians(20, 2, generator)
    assert gaussians.sh_degree == 2
    viewpoint = torch.tensor([0.0, 0.0, -5.0])
    k = 7
    direction = gaussians.means[k] - viewpoint
    basis = sh_basis((direction / direction.norm())[None], 2)[0]
    expected = (basis @ gaussians.sh[k] + 0.5).clamp_min(0)
    torch.testing.assert_close(gaussians.colors(viewpoint)[k], expected)


def test_covariance_has_the_scales_along_the_own_axes() -> None:
    quarter_about_z = torch.tensor([[1.0, 0.0, 0.0, 1.0]])  # its length does not matter
    one = Gaussians(
        ids=torch.tensor([0]),
        means=torch.zeros(1, 3),
        log_scales=torch.tensor([[0.1, 0.2, 0.3]]).log(),
        quats=quarter_about_z,
        logit_opacities=torch.zeros(1),
        sh=torch.zeros(1, 1, 3),
    )
    torch.testing.assert_close(one.covariances()[0], torch.diag(torch.tensor([0.04, 0.01, 0.09])))
    torch.testing.assert_close(one.opacities, torch.tensor([0.5]))


def test_moving_gaussians_moves_centres_and_covariances(generator: torch.Generator) -> None:
    gaussians = some_gaussians(10, 0, generator)
    T = se3.exp(row(1, -2, 0.5, 0.3, -2.0, 1.0))
    moved = gaussians.transformed(T)
    R = T[:3, :3].float()
    torch.testing.assert_close(moved.means, se3.transform(T, gaussians.means))
    torch.testing.assert_close(moved.covariances(), R @ gaussians.covariances() @ R.T, atol=1e-6, rtol=1e-4)
    assert torch.equal(moved.ids, gaussians.ids)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colour_turns_with_the_gaussians(degree: int, generator: torch.Generator) -> None:
    gaussians = some_gaussians(20, degree, generator)
    T = se3.exp(row(1, -2, 0.5, 0.3, -2.0, 1.0))
    viewpoint = torch.tensor([0.4, -3.0, 1.5])
    seen_from_there = gaussians.transformed(T).colors(se3.transform(T, viewpoint[None])[0])
    torch.testing.assert_close(seen_from_there, gaussians.colors(viewpoint), atol=2e-5, rtol=1e-4)


def test_growing_and_pruning_keep_rows_whole(generator: torch.Generator) -> None:
    old, new = some_gaussians(4, 1, generator), some_gaussians(3, 1, generator, first_id=4)
    keep = torch.tensor([True, False, False, True, False, True, True])
    both = Gaussians.empty(1).appended(old).appended(new).kept(keep)
    assert both.ids.tolist() == [0, 3, 5, 6]
    for name in ("means", "log_scales", "quats", "logit_opacities", "sh"):
        expected = torch.cat((getattr(old, name)[[0, 3]], getattr(new, name)[[1, 2]]))
        assert torch.equal(getattr(both, name), expected)
    assert len(both) == 4


# Trajectories


def test_correcting_a_submap_moves_its_frames_and_no_others() -> None:
    T_map_cam, T_shift = se3.exp(row(1, 2, 3, 0.1, 0.2, 0.3)), se3.exp(row(0, 0, 1, 0, 0, 1))
    atlas = Atlas().with_submap(se3.identity()).with_submap(se3.identity())
    trajectory = Trajectory().with_row(TrackedPose(0, 0.0, 0, T_map_cam)).with_row(TrackedPose(1, 0.1, 1, T_map_cam))
    first, second = trajectory.world(atlas.corrected((se3.identity(), T_shift)))
    assert torch.equal(first, T_map_cam)
    torch.testing.assert_close(second, T_shift @ T_map_cam)


def test_a_trajectory_reads_back_as_it_was_written(generator: torch.Generator) -> None:
    poses = [se3.exp(torch.randn(6, generator=generator, dtype=torch.float64)) for _ in range(20)]
    stamps = [1305031102.175304 + i / 30 for i in range(20)]
    stamps_read, poses_read = parse_tum(format_tum(stamps, poses))
    assert stamps_read == stamps
    torch.testing.assert_close(torch.stack(poses_read), torch.stack(poses), atol=1e-14, rtol=0)


def test_tum_lines_are_time_position_then_quaternion_with_w_last() -> None:
    T = se3.from_rotation_translation(quaternion.to_matrix(row(0.8, 0, 0, 0.6)), row(1, 2, 3))
    words = format_tum([12.5], [T]).splitlines()[1].split()
    assert [float(w) for w in words] == pytest.approx([12.5, 1, 2, 3, 0, 0, 0.6, 0.8])


@pytest.mark.parametrize("bad", ["1 2 3", "0 0 0 0 0 0 0 one", "0 0 0 0 0 0 0 1 7"])
def test_a_bad_line_is_named_by_its_number(bad: str) -> None:
    with pytest.raises(ValueError, match="line 3 is not 'timestamp tx ty tz qx qy qz qw'"):
        parse_tum(f"# header\n0 0 0 0 0 0 0 1\n{bad}\n")
