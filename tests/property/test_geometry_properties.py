"""Rotations and rigid transforms near the places where formulas break: no turn, a tiny turn, half a turn."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from tcgsplat.geometry import quaternion, se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.scene.trajectory import format_tum, parse_tum

repeatable = settings(deadline=None, derandomize=True)

NEAR_SINGULAR = (0.0, 1e-300, 1e-16, 1e-12, 1e-8, 1e-7, 1e-5, 9.9e-5, 1.01e-4, 2.01e-4, 9.9e-4, 1.01e-3, 3e-2, 0.1)
angles = st.one_of(
    st.floats(0, math.pi),
    st.sampled_from(NEAR_SINGULAR),
    st.sampled_from(NEAR_SINGULAR).map(lambda small: math.pi - small),
    st.sampled_from(NEAR_SINGULAR).map(lambda small: math.pi / 2 + small),
)
component = st.one_of(st.sampled_from((0.0, 1.0, -1.0, 1e-9)), st.floats(-1, 1))
axes = st.tuples(component, component, component).filter(lambda v: math.hypot(*v) > 1e-3)
positions = st.tuples(*[st.floats(-100, 100)] * 3)


@st.composite
def rotvecs(draw: st.DrawFn) -> Tensor:
    axis = torch.tensor(draw(axes), dtype=torch.float64)
    return draw(angles) * axis / axis.norm()


@st.composite
def tangents(draw: st.DrawFn) -> Tensor:
    return torch.cat((torch.tensor(draw(positions), dtype=torch.float64), draw(rotvecs())))


@repeatable
@given(rotvec=rotvecs())
def test_exp_turns_as_scipy_does(rotvec: Tensor) -> None:
    R = se3.exp(torch.cat((torch.zeros(3, dtype=torch.float64), rotvec)))[:3, :3]
    torch.testing.assert_close(
        R, torch.from_numpy(Rotation.from_rotvec(rotvec.numpy()).as_matrix()), atol=1e-14, rtol=0
    )


@repeatable
@given(tangent=tangents())
def test_exp_of_log_is_the_same_transform(tangent: Tensor) -> None:
    T = se3.exp(tangent)
    back = se3.exp(se3.log(T))
    torch.testing.assert_close(back[:3, :3], T[:3, :3], atol=1e-14, rtol=0)
    torch.testing.assert_close(back[:3, 3], T[:3, 3], atol=1e-12, rtol=0)


@repeatable
@given(tangent=tangents())
def test_log_of_exp_is_the_same_tangent_short_of_half_a_turn(tangent: Tensor) -> None:
    back = se3.log(se3.exp(tangent))
    angle = float(tangent[3:].norm())
    assert 0 <= float(back[3:].norm()) <= math.pi + 1e-12
    if angle < math.pi - 1e-6:
        torch.testing.assert_close(back, tangent, atol=1e-12, rtol=0)
    else:  # either way round is right
        assert min(float((back[3:] - sign * tangent[3:]).norm()) for sign in (1, -1)) < 1e-5


@repeatable
@given(tangent=tangents())
def test_the_angle_of_a_rotation_is_the_length_of_its_log(tangent: Tensor) -> None:
    T = se3.exp(tangent)
    assert se3.rotation_angle(T) == pytest.approx(float(se3.log(T)[3:].norm()), abs=1e-12)
    assert se3.rotation_angle(T) == pytest.approx(float(tangent[3:].norm()), abs=1e-12)


@repeatable
@given(tangent=tangents())
def test_inverse_undoes_and_is_the_opposite_tangent(tangent: Tensor) -> None:
    T = se3.exp(tangent)
    torch.testing.assert_close(se3.inverse(T) @ T, se3.identity(), atol=1e-12, rtol=0)
    torch.testing.assert_close(se3.inverse(T), se3.exp(-tangent), atol=1e-12, rtol=0)


@repeatable
@given(tangent=tangents())
def test_orthonormalized_leaves_a_rigid_transform_alone(tangent: Tensor) -> None:
    T = se3.exp(tangent)
    torch.testing.assert_close(se3.orthonormalized(T), T, atol=1e-13, rtol=0)


@repeatable
@given(rotvec=rotvecs(), dtype=st.sampled_from([torch.float32, torch.float64]))
def test_matrix_to_quaternion_and_back_is_the_same_rotation(rotvec: Tensor, dtype: torch.dtype) -> None:
    R = torch.from_numpy(Rotation.from_rotvec(rotvec.numpy()).as_matrix()).to(dtype)
    quat = quaternion.from_matrix(R)
    eps = torch.finfo(dtype).eps
    assert quat[0] >= 0
    torch.testing.assert_close(quat.norm(), torch.ones((), dtype=dtype), atol=4 * eps, rtol=0)
    torch.testing.assert_close(quaternion.to_matrix(quat), R, atol=16 * eps, rtol=0)


@repeatable
@given(a=rotvecs(), b=rotvecs(), length=st.floats(0.01, 100))
def test_multiplying_quaternions_multiplies_rotations(a: Tensor, b: Tensor, length: float) -> None:
    qa, qb = (torch.from_numpy(np.asarray(Rotation.from_rotvec(v.numpy()).as_quat(scalar_first=True))) for v in (a, b))
    product = quaternion.to_matrix(quaternion.multiply(length * qa, -qb))
    torch.testing.assert_close(product, quaternion.to_matrix(qa) @ quaternion.to_matrix(qb), atol=1e-14, rtol=0)


@repeatable
@given(
    u=st.integers(0, 63),
    v=st.integers(0, 47),
    z=st.floats(0.1, 20),
    focal=st.floats(20, 200),
    centre=st.floats(-10, 80),
)
def test_backprojecting_a_pixel_and_projecting_it_gives_the_pixel(
    u: int, v: int, z: float, focal: float, centre: float
) -> None:
    camera = Camera(focal, 1.1 * focal, centre, 0.5 * centre, 64, 48)
    points = camera.backproject(torch.full((48, 64), z))
    torch.testing.assert_close(camera.project(points[v, u]), torch.tensor([u, v]).float(), atol=1e-3, rtol=0)
    assert points[v, u, 2].item() == pytest.approx(z)


@repeatable
@given(factor=st.sampled_from((0.25, 0.5, 2.0, 4.0)), x=st.floats(-1, 1), y=st.floats(-1, 1))
def test_scaling_a_camera_there_and_back_changes_nothing(factor: float, x: float, y: float) -> None:
    camera = Camera(50.0, 55.0, 31.5, 23.5, 64, 48)
    back = camera.scaled(factor).scaled(1 / factor)
    point = torch.tensor([x, y, 1.0], dtype=torch.float64)
    torch.testing.assert_close(back.project(point), camera.project(point))
    assert (back.width, back.height) == (64, 48)


@repeatable
@given(tangent=tangents(), stamp=st.floats(0, 2e9))
def test_trajectory_text_keeps_time_and_pose(tangent: Tensor, stamp: float) -> None:
    T = se3.exp(tangent)
    (stamp_read,), (T_read,) = parse_tum(format_tum([stamp], [T]))
    assert stamp_read == stamp
    assert torch.equal(T_read[:3, 3], T[:3, 3])
    torch.testing.assert_close(T_read, T, atol=1e-14, rtol=0)
