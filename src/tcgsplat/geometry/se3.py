"""Rigid transforms as 4x4 matrices `T_a_b` (b-coordinates to a), and their tangent vectors (translation, rotation).

A tangent is `[rho, omega]`: metres, then radians. Closed forms follow Barfoot, State Estimation for Robotics, ch. 7.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from tcgsplat.geometry import quaternion
from tcgsplat.tensors import Pose


def identity(dtype: torch.dtype = torch.float64) -> Pose:
    """The transform that moves nothing."""
    return torch.eye(4, dtype=dtype)


def skew(v: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The matrix whose product with `x` is the cross product `v` x `x`."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack((o, -z, y, z, o, -x, -y, x, o), dim=-1).reshape(*v.shape, 3)


def exp(tangent: Float[Tensor, "6"]) -> Pose:
    """Transform reached by following `[rho, omega]` for unit time; differentiable everywhere."""
    rho, omega = tangent.to(torch.float64).tensor_split([3])
    angle: Tensor = omega.norm()
    W = skew(omega)
    axis = W / angle.clamp_min(1e-300)
    a = torch.sinc(angle / math.pi)  # sin(angle) / angle
    b = 0.5 * torch.sinc(angle / (2 * math.pi)).square()  # (1 - cos(angle)) / angle^2, by the half angle
    eye = torch.eye(3, dtype=W.dtype, device=W.device)
    return from_rotation_translation(eye + a * W + b * (W @ W), (eye + b * W + (1 - a) * (axis @ axis)) @ rho)


def log(T: Pose) -> Float[Tensor, "6"]:
    """Tangent `[rho, omega]` with `exp(log(T)) == T`; the rotation angle is in [0, pi]. Not differentiable."""
    T = T.detach().to(torch.float64)
    # By way of the quaternion (cos, sin * axis) of half the angle, the axis is well defined up to half a turn.
    w, xyz = quaternion.from_matrix(T[:3, :3]).tensor_split([1])
    sine = float(xyz.norm())
    half = math.atan2(sine, float(w))
    omega = xyz * (2.0 * half / sine if sine > 0 else 2.0)
    # The last coefficient of the inverse left Jacobian is 0/0 at no rotation, where its limit is 1/12.
    e = 1 / 12 if half < 1e-4 else (1 - half / math.tan(half)) / (2.0 * half) ** 2
    W = skew(omega)
    V_inverse = torch.eye(3, dtype=torch.float64) - 0.5 * W + e * (W @ W)
    return torch.cat((V_inverse @ T[:3, 3], omega))


def inverse(T: Pose) -> Pose:
    """`T_b_a` of `T_a_b`, exact for a rigid transform and differentiable."""
    R_transposed = T[:3, :3].transpose(0, 1)
    top = torch.cat((R_transposed, -(R_transposed @ T[:3, 3:])), dim=1)
    return torch.cat((top, T[3:]), dim=0)


def adjoint(T: Pose) -> Float[Tensor, "6 6"]:
    """What carries tangents through a transform: T exp(xi) = exp(adjoint(T) xi) T."""
    R, zero = T[:3, :3], torch.zeros_like(T[:3, :3])
    return torch.cat((torch.cat((R, skew(T[:3, 3]) @ R), dim=1), torch.cat((zero, R), dim=1)))


def from_rotation_translation(R: Float[Tensor, "3 3"], t: Float[Tensor, "3"]) -> Pose:
    """Put a rotation and a translation (metres) together."""
    bottom = torch.eye(4, dtype=R.dtype, device=R.device)[3:]
    return torch.cat((torch.cat((R, t[:, None]), dim=1), bottom), dim=0)


def rotation_angle(T: Pose) -> float:
    """Angle of the rotation part, radians in [0, pi]."""
    R = T[:3, :3].to(torch.float64)
    vee = 0.5 * torch.stack((R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]))
    return math.atan2(float(vee.norm()), 0.5 * (float(R.trace()) - 1))


def translation_norm(T: Pose) -> float:
    """Length of the translation part, metres."""
    return float(T[:3, 3].norm())


def transform(T: Pose, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Points of b in a, for `T_a_b`; the points' own dtype is kept."""
    T = T.to(points)
    return points @ T[:3, :3].transpose(0, 1) + T[:3, 3]


def orthonormalized(T: Pose) -> Pose:
    """The nearest rigid transform: long products of poses drift off the rotation group by rounding."""
    U, _, Vt = torch.linalg.svd(T[:3, :3])
    d = torch.ones(3, dtype=T.dtype)
    d[2] = torch.linalg.det(U @ Vt).sign()
    return from_rotation_translation((U * d) @ Vt, T[:3, 3])
