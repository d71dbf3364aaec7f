"""Meshes as values, and as files."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic_room import pose
from meshes import box, joined, rectangle

from tcgsplat.datasets.synthetic.writer import write_mesh as write_true_mesh
from tcgsplat.errors import ArchiveError
from tcgsplat.scene.mesh import Mesh
from tcgsplat.storage.mesh_ply import read_mesh, write_mesh


def painted(mesh: Mesh) -> Mesh:
    generator = np.random.default_rng(0)
    n = len(mesh.vertices)
    return replace(
        mesh, colors=generator.integers(0, 256, (n, 3), np.uint8), confidence=generator.random(n, dtype=np.float32)
    )


def test_samples_lie_on_the_surface_in_proportion_to_area() -> None:
    mesh = joined(rectangle((0, 0), (3, 1)), rectangle((5, 0), (6, 1), z=2.0))
    assert mesh.areas.sum() == pytest.approx(4.0)
    points = mesh.sampled(20_000, np.random.default_rng(0))
    large = points[:, 0] < 4
    assert large.mean() == pytest.approx(0.75, abs=0.02)
    assert (points[large, 2] == 0).all() and (points[~large, 2] == 2).all()
    counts = np.histogram2d(points[large, 0], points[large, 1], (6, 2), ((0, 3), (0, 1)))[0]
    assert counts.min() > 0.85 * counts.mean()  # each part of the rectangle, on both sides of its diagonal
    again = mesh.sampled(20_000, np.random.default_rng(0))
    assert np.array_equal(points, again)


def test_nothing_is_sampled_of_nothing() -> None:
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    assert len(empty.sampled(100, np.random.default_rng(0))) == 0


def test_a_mesh_moves_as_its_frame_does() -> None:
    T = pose(1.0, -2.0, 0.5, degrees=(10, 20, 30))
    mesh = painted(box((0, 0, 0), (1, 2, 3)))
    moved = mesh.moved(T)
    for before, after in zip(mesh.vertices, moved.vertices, strict=True):
        np.testing.assert_allclose(after, (T.numpy() @ [*before, 1.0])[:3], atol=1e-12)
    assert moved.colors is mesh.colors and moved.triangles is mesh.triangles


def test_what_is_kept_has_its_own_vertices() -> None:
    mesh = painted(joined(rectangle((0, 0), (1, 1)), rectangle((5, 0), (6, 1))))
    kept = mesh.kept(np.array([False, False, True, True]))
    assert kept.colors is not None and mesh.colors is not None and kept.confidence is not None
    np.testing.assert_array_equal(kept.vertices[kept.triangles], mesh.vertices[mesh.triangles[2:]])
    np.testing.assert_array_equal(kept.colors[kept.triangles], mesh.colors[mesh.triangles[2:]])
    assert len(kept.vertices) == len(kept.confidence) == 4


def test_bytes_are_what_viewers_expect(tmp_path: Path) -> None:
    mesh = painted(rectangle((0, 0), (1, 2), z=0.5))
    write_mesh(tmp_path / "a.ply", mesh)
    content = (tmp_path / "a.ply").read_bytes()
    head, body = content.split(b"end_header\n", 1)
    assert head.decode("ascii").splitlines() == [
        "ply",
        "format binary_little_endian 1.0",
        "element vertex 4",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {color}" for color in ("red", "green", "blue")),
        "property float confidence",
        "element face 2",
        "property list uchar int vertex_indices",
    ]
    assert mesh.colors is not None and mesh.confidence is not None
    assert struct.unpack_from("<3f3Bf", body, 2 * 19) == (1.0, 2.0, 0.5, *mesh.colors[2], mesh.confidence[2])
    assert struct.unpack_from("<B3iB3i", body, 4 * 19) == (3, 0, 1, 2, 3, 0, 2, 3)
    assert len(body) == 4 * 19 + 2 * 13


@pytest.mark.parametrize("mesh", [box((0, 0, 0), (1, 2, 3)), painted(box((0, 0, 0), (1, 2, 3)))])
def test_round_trip(tmp_path: Path, mesh: Mesh) -> None:
    write_mesh(tmp_path / "a.ply", mesh)
    read = read_mesh(tmp_path / "a.ply")
    for name in ("vertices", "triangles", "colors", "confidence"):
        np.testing.assert_array_equal(getattr(read, name), getattr(mesh, name))


def test_a_true_mesh_of_the_synthetic_data_is_read(tmp_path: Path) -> None:
    mesh = box((0, 0, 0), (1, 2, 3))
    write_true_mesh(tmp_path / "mesh.ply", mesh.vertices, mesh.triangles)
    np.testing.assert_array_equal(read_mesh(tmp_path / "mesh.ply").triangles, mesh.triangles)


def test_quads_in_double_precision_with_other_properties_are_read(tmp_path: Path) -> None:
    """As Replica's own meshes have them, more or less."""
    header = "ply\nformat binary_little_endian 1.0\ncomment made elsewhere\nelement vertex 4\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz") + "property float quality\n"
    header += "element face 1\nproperty list uchar uint vertex_indices\nproperty uchar kind\nend_header\n"
    corners = rectangle((0, 0), (1, 2)).vertices
    body = b"".join(struct.pack("<3df", *corner, 7.0) for corner in corners) + struct.pack("<B4IB", 4, 0, 1, 2, 3, 9)
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    read = read_mesh(tmp_path / "a.ply")
    assert read.areas.sum() == pytest.approx(2.0) and read.colors is None
    assert read.triangles.tolist() == [[0, 1, 2], [0, 2, 3]]


def test_what_is_no_mesh(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    with pytest.raises(ArchiveError, match="cannot read"):
        read_mesh(path)
    path.write_bytes(b"solid cube")
    with pytest.raises(ArchiveError, match="not a binary little-endian PLY"):
        read_mesh(path)
    path.write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nend_header\n")
    with pytest.raises(ArchiveError, match="not a mesh"):
        read_mesh(path)
    write_mesh(path, box((0, 0, 0), (1, 1, 1)))
    whole = path.read_bytes()
    for cut in (whole[:-1], whole[:-140], whole[:300]):
        path.write_bytes(cut)
        with pytest.raises(ArchiveError, match="not a mesh"):
            read_mesh(path)
    write_mesh(path, replace(box((0, 0, 0), (1, 1, 1)), triangles=np.array([[0, 1, 8]], np.int32)))
    with pytest.raises(ArchiveError, match="a vertex that is not there"):
        read_mesh(path)
    mixed = whole.replace(b"element face 12", b"element face 2")[: -12 * 13]
    path.write_bytes(mixed + struct.pack("<B3iB4i", 3, 0, 1, 2, 4, 0, 1, 2, 3))
    with pytest.raises(ArchiveError, match="neither all triangles nor all quads"):
        read_mesh(path)
