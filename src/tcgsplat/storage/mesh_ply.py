"""Triangle meshes as PLY files that MeshLab, Open3D and trimesh open.

Written little-endian: `float x y z` (metres), `uchar red green blue` and `float confidence` (in [0, 1]) of each vertex,
as far as the mesh has them, and triangles as `list uchar int vertex_indices`. Read is what other programs write in
binary as well: coordinates of double precision, properties that we do not know, and quads.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Int

from tcgsplat.errors import ArchiveError
from tcgsplat.scene.mesh import Mesh
from tcgsplat.storage import atomic
from tcgsplat.storage.ply import TYPES

_COLORS = ("red", "green", "blue")


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Put a mesh at `path`, in whatever frame it is given."""
    columns = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    columns += [(name, "u1") for name in _COLORS if mesh.colors is not None]
    columns += [("confidence", "<f4")] if mesh.confidence is not None else []
    vertices = np.empty(len(mesh.vertices), dtype=columns)
    for axis, name in enumerate("xyz"):
        vertices[name] = mesh.vertices[:, axis]
    if mesh.colors is not None:
        for channel, name in enumerate(_COLORS):
            vertices[name] = mesh.colors[:, channel]
    if mesh.confidence is not None:
        vertices["confidence"] = mesh.confidence
    faces = np.empty(len(mesh), dtype=[("count", "u1"), ("rows", "<i4", (3,))])
    faces["count"], faces["rows"] = 3, mesh.triangles
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *(f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in columns),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    with atomic.writing(path) as file:
        file.write("\n".join(header).encode("ascii"))
        file.write(vertices.tobytes())
        file.write(faces.tobytes())


def read_mesh(path: Path) -> Mesh:
    """The mesh of a binary PLY file whose faces all are triangles, or all quads; these are cut in two.

    Raises:
        ArchiveError: if the file is missing, cut short, not binary little-endian, or not such a mesh.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ArchiveError(f"cannot read {path} ({error.strerror}); give a PLY file of a mesh") from error
    head, mark, body = content.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", errors="replace").splitlines()] if mark else []
    if lines[:1] != [["ply"]] or ["format", "binary_little_endian", "1.0"] not in lines:
        raise ArchiveError(f"{path} is not a binary little-endian PLY; convert it, in MeshLab for example")
    elements: list[tuple[str, int, list[list[str]]]] = []
    for words in lines:
        if words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            elements[-1][2].append(words[1:])
    try:
        (_, count, columns), (_, face_count, face_columns) = elements[:2]
        if [name for name, _, _ in elements[:2]] != ["vertex", "face"]:
            raise ValueError("its first elements are not vertex and face")
        vertices = np.frombuffer(body, np.dtype([(name, TYPES[kind]) for kind, name in columns]), count)
        triangles = _triangles(body[vertices.nbytes :], face_count, face_columns)
        points = np.stack([vertices[name] for name in "xyz"], axis=1)
        if len(triangles) and not 0 <= triangles.min() <= triangles.max() < count:
            raise ValueError("a face has a vertex that is not there")
    except (KeyError, ValueError) as error:
        raise ArchiveError(f"{path} is not a mesh that can be read ({error}); give one of triangles") from error
    names = vertices.dtype.names or ()
    colored = set(_COLORS) <= set(names) and all(vertices.dtype[name] == np.uint8 for name in _COLORS)
    return Mesh(
        points,
        triangles,
        np.stack([vertices[name] for name in _COLORS], axis=1) if colored else None,
        vertices["confidence"].copy() if "confidence" in names else None,
    )


def _triangles(body: bytes, count: int, columns: list[list[str]]) -> Int[np.ndarray, "t 3"]:
    """Of faces that all have three corners, or all four; what else a face has may follow its corners."""
    (_, size_kind, row_kind, _), *rest = (words for words in columns if words[0] == "list" or len(columns) > 1)
    if count == 0:
        return np.zeros((0, 3), np.int32)
    size = np.dtype(TYPES[size_kind])
    corners = int(np.frombuffer(body, size, 1)[0])
    extra = [(name, TYPES[kind]) for kind, name in rest]
    faces = np.frombuffer(body, np.dtype([("size", size), ("rows", TYPES[row_kind], (corners,)), *extra]), count)
    if corners not in (3, 4) or (faces["size"] != corners).any():
        raise ValueError("its faces are neither all triangles nor all quads")
    rows = faces["rows"].astype(np.int32)
    return rows if corners == 3 else np.concatenate((rows[:, [0, 1, 2]], rows[:, [0, 2, 3]]))
