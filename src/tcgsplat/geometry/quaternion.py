"""Unit quaternions in the order w, x, y, z; `q` and `-q` are the same rotation."""

import torch
from jaxtyping import Float
from torch import Tensor


def normalize(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Scale quaternions (wxyz) to unit length; one shorter than 1e-12 stays short, and zero stays zero, never NaN."""
    length: Tensor = quats.norm(dim=-1, keepdim=True)
    return quats / length.clamp_min(1e-12)


def multiply(a: Float[Tensor, "*batch 4"], b: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Hamilton product: rotate by `b`, then by `a` (both wxyz)."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        dim=-1,
    )


def to_matrix(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions (wxyz) of any length: the length cancels, so raw parameters may be given.

    The zero quaternion gives the identity.
    """
    w, x, y, z = normalize(quats).unbind(-1)
    return torch.stack(
        (
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ),
        dim=-1,
    ).reshape(*quats.shape[:-1], 3, 3)  # fmt: skip


def from_matrix(rotations: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions (wxyz, w >= 0) of rotation matrices.

    Each of the four squared components is a signed sum of the diagonal; the largest one is divided by, so that no
    rotation is near a singularity (Shepperd's method).
    """
    m00, m11, m22 = rotations[..., 0, 0], rotations[..., 1, 1], rotations[..., 2, 2]
    twice = torch.stack((1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22), dim=-1)
    s = twice.clamp_min(1e-12).sqrt()  # 2|w|, 2|x|, 2|y|, 2|z|
    d21 = rotations[..., 2, 1] - rotations[..., 1, 2]
    d02 = rotations[..., 0, 2] - rotations[..., 2, 0]
    d10 = rotations[..., 1, 0] - rotations[..., 0, 1]
    s10 = rotations[..., 1, 0] + rotations[..., 0, 1]
    s20 = rotations[..., 2, 0] + rotations[..., 0, 2]
    s21 = rotations[..., 2, 1] + rotations[..., 1, 2]
    s0, s1, s2, s3 = s.unbind(-1)
    rows = torch.stack(
        (
            torch.stack((s0 * s0, d21, d02, d10), dim=-1) / s0[..., None],
            torch.stack((d21, s1 * s1, s10, s20), dim=-1) / s1[..., None],
            torch.stack((d02, s10, s2 * s2, s21), dim=-1) / s2[..., None],
            torch.stack((d10, s20, s21, s3 * s3), dim=-1) / s3[..., None],
        ),
        dim=-2,
    )
    best = s.argmax(dim=-1)[..., None, None].expand(*s.shape[:-1], 1, 4)
    quats = 0.5 * rows.gather(-2, best).squeeze(-2)
    return normalize(torch.where(quats[..., :1] < 0, -quats, quats))
