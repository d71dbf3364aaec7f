"""Meshes made by hand, and the mark of tests that need Open3D."""

import numpy as np
import pytest

from tcgsplat.errors import BackendUnavailableError
from tcgsplat.mapping.fusion import open3d
from tcgsplat.scene.mesh import Mesh


def _missing() -> str:
    try:
        open3d()
    except BackendUnavailableError as error:
        return str(error)
    return ""


needs_open3d = pytest.mark.skipif(bool(_missing()), reason=_missing())


def rectangle(low: tuple[float, float], high: tuple[float, float], z: float = 0.0) -> Mesh:
    """Two triangles in the plane of one z."""
    (a, b), (c, d) = low, high
    corners = np.array([[a, b, z], [c, b, z], [c, d, z], [a, d, z]], np.float64)
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def joined(*meshes: Mesh) -> Mesh:
    """All of them as one, without colours."""
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    triangles = [mesh.triangles + n for mesh, n in zip(meshes, first, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(triangles))


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Mesh:
    """Its six sides."""
    corners = np.array(
        [
            [float(x), float(y), float(z)]
            for x in (low[0], high[0])
            for y in (low[1], high[1])
            for z in (low[2], high[2])
        ]
    )
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Mesh(corners, np.array([[a, b, c] for p, q, r, s in sides for a, b, c in ((p, q, r), (p, r, s))], np.int32))
