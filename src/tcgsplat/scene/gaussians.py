"""3D Gaussians: raw parameters, their activations (Eq. 1) and covariance (Eq. 2).

Every per-Gaussian tensor here and in `ConfidenceState` is a row table; rows are only ever appended and kept together,
through `Submap.grown` and `Submap.kept`.
"""

import math
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tcgsplat.geometry import quaternion
from tcgsplat.scene.harmonics import SH_C0
from tcgsplat.tensors import Ids, PerGaussian, PerGaussianFlag

MAX_SH_DEGREE = 3


def sh_basis(directions: Float[Tensor, "n 3"], degree: int) -> Float[Tensor, "n k"]:
    """Real spherical harmonics up to `degree` (0 to 3) at unit directions; k = (degree + 1)^2.

    Signs and order are those that 3D Gaussian splatting files use (Kerbl et al. 2023), so that maps open elsewhere.
    """
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        c = 0.4886025119029199
        basis += [-c * y, c * z, -c * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if degree >= 3:
        basis += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, dim=-1)


def sh_rotation(R_b_a: Float[Tensor, "3 3"], degree: int) -> Float[Tensor, "k k"]:
    """Matrix that turns harmonic coefficients of frame a into those of frame b, float64.

    Colour must stay the same along every physical direction: basis(d_b) sh_b = basis(R^T d_b) sh_a. The harmonics of
    one degree span a space that rotations map onto itself, so solving this over more directions than coefficients,
    well spread on the sphere (Fibonacci's lattice), is exact.
    """
    k = torch.arange(64, dtype=torch.float64) + 0.5
    z, turn = 1 - k / 32, k * math.pi * (3 - math.sqrt(5))
    radius = (1 - z * z).sqrt()
    directions_b = torch.stack((radius * turn.cos(), radius * turn.sin(), z), dim=-1)
    directions_a = directions_b @ R_b_a.to(torch.float64)
    solved: Tensor = torch.linalg.lstsq(sh_basis(directions_b, degree), sh_basis(directions_a, degree)).solution
    return solved


@dataclass(frozen=True)
class Gaussians:
    """A set of anisotropic Gaussians in the frame of their submap (Eq. 1), as raw, optimisable parameters."""

    ids: Ids
    """Unique in the run; a Gaussian keeps its id through growing and pruning. Negative: guessed where the sensor had no
    reading (`mapping.completion`)."""
    means: Float[Tensor, "n 3"]
    """Centres in the map frame, metres."""
    log_scales: Float[Tensor, "n 3"]
    """Natural logarithm of the standard deviations along the own axes, metres."""
    quats: Float[Tensor, "n 4"]
    """Own axes to map frame, wxyz, any non-zero length."""
    logit_opacities: Float[Tensor, " n"]
    sh: Float[Tensor, "n k 3"]
    """Spherical harmonics of colour; k = (degree + 1)^2."""

    def __len__(self) -> int:
        return int(self.ids.shape[0])

    @staticmethod
    def empty(sh_degree: int = 0, device: torch.device | None = None) -> "Gaussians":
        """No Gaussians yet."""
        k = (sh_degree + 1) ** 2
        return Gaussians(
            ids=torch.zeros(0, dtype=torch.int64, device=device),
            means=torch.zeros(0, 3, device=device),
            log_scales=torch.zeros(0, 3, device=device),
            quats=torch.zeros(0, 4, device=device),
            logit_opacities=torch.zeros(0, device=device),
            sh=torch.zeros(0, k, 3, device=device),
        )

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return math.isqrt(self.sh.shape[1]) - 1

    @property
    def scales(self) -> Float[Tensor, "n 3"]:
        """Standard deviations along the own axes, metres (s of Eq. 1)."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> PerGaussian:
        """Peak alpha in (0, 1) (o of Eq. 1)."""
        return self.logit_opacities.sigmoid()

    def colors(self, viewpoint: Float[Tensor, "3"]) -> Float[Tensor, "n 3"]:
        """RGB seen from a camera centre in the map frame: max(0, SH(direction) + 0.5)."""
        if self.sh_degree == 0:  # the direction does not matter, and neither should it cost time
            return (SH_C0 * self.sh[:, 0] + 0.5).clamp_min(0.0)
        directions = torch.nn.functional.normalize(self.means - viewpoint, dim=-1)
        basis = sh_basis(directions, self.sh_degree)
        return (torch.einsum("nk,nkc->nc", basis, self.sh) + 0.5).clamp_min(0.0)

    def covariances(self) -> Float[Tensor, "n 3 3"]:
        """Sigma = R(q) diag(s^2) R(q)^T in the map frame, square metres (Eq. 2)."""
        M = quaternion.to_matrix(self.quats) * self.scales[:, None, :]
        return M @ M.transpose(-1, -2)

    def appended(self, other: "Gaussians") -> "Gaussians":
        """These Gaussians, then the other ones."""
        return Gaussians(**{f.name: torch.cat((getattr(self, f.name), getattr(other, f.name))) for f in fields(self)})

    def kept(self, keep: PerGaussianFlag) -> "Gaussians":
        """Only the flagged rows, in their order."""
        return Gaussians(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    def picked(self, rows: Int[Tensor, " m"] | slice) -> "Gaussians":
        """The rows of the given places."""
        return Gaussians(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    def to(self, device: torch.device) -> "Gaussians":
        """The same Gaussians on another device."""
        return Gaussians(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})

    def cpu(self) -> "Gaussians":
        """The same Gaussians where numpy and the CPU's kernels can read them."""
        return Gaussians(**{f.name: getattr(self, f.name).cpu() for f in fields(self)})

    def transformed(self, T_b_a: Float[Tensor, "4 4"]) -> "Gaussians":
        """The same Gaussians in frame b, given here in frame a; view-dependent colour turns along."""
        T = T_b_a.to(self.means)
        q = quaternion.from_matrix(T[:3, :3])
        sh = self.sh
        if self.sh_degree > 0:
            sh = torch.einsum("jk,nkc->njc", sh_rotation(T_b_a[:3, :3], self.sh_degree).to(sh), sh)
        return replace(
            self,
            means=self.means @ T[:3, :3].T + T[:3, 3],
            quats=quaternion.multiply(q.expand_as(self.quats), self.quats),
            sh=sh,
        )
