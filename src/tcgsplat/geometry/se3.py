"""Rigid transforms as 4x4 matrices `T_a_b` (b-coordinates to a), and their tangent vectors (translation, rotation).

A tangent is `[rho, omega]`: metres, then radians. Closed forms follow Barfoot, State Estimation for Robotics, ch. 7.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from tcgsplat.tensors import Pose


def identity(dtype: torch.dtype = torch.float64) -> Pose:
    """The transform that moves nothing."""
    return torch.eye(4, dtype=dtype)


def skew(v: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The matrix whose product with `x` is the cross product `v` x `x`."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack((o, -z, y, z, o, -x, -y, x, o), dim=-1).unflatten(-1, (3, 3))


def _coefficients(angle: float) -> tuple[float, float, float]:
    """sin(t)/t, (1-cos t)/t^2, (t-sin t)/t^3; by series near zero, where the closed forms lose all digits."""
    if angle < 1e-4:
        t2 = angle * angle
        return 1 - t2 / 6, 0.5 - t2 / 24, 1 / 6 - t2 / 120
    return math.sin(angle) / angle, (1 - math.cos(angle)) / angle**2, (angle - math.sin(angle)) / angle**3


def exp(tangent: Float[Tensor, "6"]) -> Pose:
    """Transform reached by following `[rho, omega]` for unit time."""
    tangent = tangent.to(torch.float64)
    w = skew(tangent[3:])
    a, b, c = _coefficients(float(tangent[3:].norm()))
    eye, ww = torch.eye(3, dtype=torch.float64), w @ w
    T = identity()
    T[:3, :3] = eye + a * w + b * ww
    T[:3, 3] = (eye + b * w + c * ww) @ tangent[:3]
    return T


def log(T: Pose) -> Float[Tensor, "6"]:
    """Tangent `[rho, omega]` with `exp(log(T)) == T`; the rotation angle is in [0, pi]."""
    T = T.to(torch.float64)
    R = T[:3, :3]
    vee = 0.5 * torch.stack((R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]))  # sin(angle) * axis
    sine, cosine = float(vee.norm()), 0.5 * (float(R.trace()) - 1)
    angle = math.atan2(sine, cosine)
    if sine > 1e-7:
        omega = vee * (angle / sine)
    elif cosine > 0:
        omega = vee  # angle / sin(angle) -> 1
    else:  # half a turn: the antisymmetric part vanishes, the axis is the eigenvector of R + I
        column = int(R.diagonal().argmax())
        axis = (R + torch.eye(3, dtype=torch.float64))[:, column]
        omega = angle * axis / axis.norm()
    a, b, _ = _coefficients(angle)
    # The last term of the inverse left Jacobian; its closed form is 0/0 at zero, where the limit is 1/12.
    e = 1 / 12 if angle < 1e-3 else (1 - 0.5 * a / b) / angle**2
    w = skew(omega)
    V_inverse = torch.eye(3, dtype=torch.float64) - 0.5 * w + e * (w @ w)
    return torch.cat((V_inverse @ T[:3, 3], omega))


def inverse(T: Pose) -> Pose:
    """`T_b_a` of `T_a_b`, exact for a rigid transform and differentiable."""
    R_transposed = T[:3, :3].transpose(0, 1)
    top = torch.cat((R_transposed, -(R_transposed @ T[:3, 3:])), dim=1)
    return torch.cat((top, T[3:]), dim=0)


def from_rotation_translation(R: Float[Tensor, "3 3"], t: Float[Tensor, "3"]) -> Pose:
    """Put a rotation and a translation (metres) together."""
    bottom = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=R.dtype, device=R.device)
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
