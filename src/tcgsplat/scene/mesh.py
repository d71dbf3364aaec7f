"""A triangle mesh: what fusion makes, what files hold, and what a true surface is given as."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8

from tcgsplat.geometry import se3
from tcgsplat.tensors import Pose

Points = Float[np.ndarray, "n 3"]


@dataclass(frozen=True)
class Mesh:
    """Triangles over shared vertices."""

    vertices: Float[np.ndarray, "v 3"]
    """Metres."""
    triangles: Int[np.ndarray, "t 3"]
    """Rows of `vertices`."""
    colors: UInt8[np.ndarray, "v 3"] | None = None
    """RGB."""
    confidence: Float[np.ndarray, " v"] | None = None
    """In [0, 1]."""

    def __len__(self) -> int:
        """Triangles."""
        return len(self.triangles)

    @property
    def areas(self) -> Float[np.ndarray, " t"]:
        """Of the triangles, square metres."""
        a, b, c = self.vertices.astype(np.float64)[self.triangles].transpose(1, 0, 2)
        return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))

    def sampled(self, count: int, generator: np.random.Generator) -> Points:
        """Points spread uniformly over the surface; of a mesh without area, none."""
        areas = self.areas
        if not areas.sum() > 0:
            return np.zeros((0, 3))
        chosen = generator.choice(len(areas), count, p=areas / areas.sum())
        s, t = generator.random((2, count, 1))
        s, t = np.where(s + t > 1, 1 - s, s), np.where(s + t > 1, 1 - t, t)  # the parallelogram folded onto its half
        a, b, c = self.vertices.astype(np.float64)[self.triangles[chosen]].transpose(1, 0, 2)
        return np.asarray(a + s * (b - a) + t * (c - a))

    def moved(self, T: Pose) -> "Mesh":
        """In another frame, `T_other_mesh`."""
        points = torch.from_numpy(self.vertices.astype(np.float64))
        return replace(self, vertices=se3.transform(T, points).numpy())

    def kept(self, keep: Bool[np.ndarray, " t"]) -> "Mesh":
        """With only the flagged triangles, and the vertices that these have."""
        used, triangles = np.unique(self.triangles[keep], return_inverse=True)
        return Mesh(
            self.vertices[used],
            triangles.reshape(-1, 3).astype(self.triangles.dtype),
            None if self.colors is None else self.colors[used],
            None if self.confidence is None else self.confidence[used],
        )
