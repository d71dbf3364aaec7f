"""Gaussians as the PLY files that 3D Gaussian splatting viewers open (Kerbl et al. 2023).

Little-endian float32 properties of each vertex, in this order: `x y z` (metres), `nx ny nz` (zero), `f_dc_0..2` and
`f_rest_*` (spherical harmonics; the rest channel by channel: all of red, then green, then blue), `opacity` (logit),
`scale_0..2` (natural logarithm of metres), `rot_0..3` (unit quaternion wxyz), and last our own `confidence` in [0, 1],
which viewers that do not know it skip.
"""

from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float

from tcgsplat.errors import ArchiveError
from tcgsplat.geometry import quaternion
from tcgsplat.scene.gaussians import MAX_SH_DEGREE, Gaussians
from tcgsplat.storage import atomic
from tcgsplat.tensors import PerGaussian

TYPES: Final = {
    "char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4", "float": "<f4",
    "double": "<f8", "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4",
    "float32": "<f4", "float64": "<f8",
}  # fmt: skip
"""PLY's names of the types of properties, and numpy's."""
_REST_COUNTS = tuple(3 * ((degree + 1) ** 2 - 1) for degree in range(MAX_SH_DEGREE + 1))


def write_gaussians(path: Path, gaussians: Gaussians, confidence: PerGaussian) -> None:
    """Write Gaussians, in whatever frame they are given, with their confidence; ids are not kept."""
    columns = {
        ("x", "y", "z"): gaussians.means,
        ("nx", "ny", "nz"): torch.zeros_like(gaussians.means),
        _numbered("f_dc", 3): gaussians.sh[:, 0],
        _numbered("f_rest", 3 * (gaussians.sh.shape[1] - 1)): gaussians.sh[:, 1:].transpose(1, 2).flatten(1),
        ("opacity",): gaussians.logit_opacities[:, None],
        _numbered("scale", 3): gaussians.log_scales,
        _numbered("rot", 4): quaternion.normalize(gaussians.quats),
        ("confidence",): confidence[:, None],
    }
    names = [name for group in columns for name in group]
    rows = torch.cat([column.detach().cpu().to(torch.float32) for column in columns.values()], dim=1)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(gaussians)}",
        *(f"property float {name}" for name in names),
        "end_header\n",
    ]
    with atomic.writing(path) as file:
        file.write("\n".join(header).encode("ascii"))
        file.write(rows.numpy().astype("<f4").tobytes())


def read_gaussians(path: Path) -> tuple[Gaussians, PerGaussian | None]:
    """Read Gaussians, numbered from 0 in the order of the file, and their confidence if the file has it.

    Raises:
        ArchiveError: if the file is missing, cut short, not binary little-endian, or holds no Gaussians.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ArchiveError(f"cannot read {path} ({error.strerror}); give a PLY file of Gaussians") from error
    head, mark, body = content.partition(b"end_header\n")
    count, dtype = _parse_header(path, head.decode("ascii", errors="replace") if mark else "")
    if len(body) < count * dtype.itemsize:
        raise ArchiveError(f"{path} is cut short: {len(body)} of {count * dtype.itemsize} bytes; copy it again")
    table = np.frombuffer(body, dtype=dtype, count=count)

    def columns(*names: str) -> Float[torch.Tensor, "n c"]:
        return torch.from_numpy(np.stack([table[name].astype(np.float32) for name in names], axis=1))

    names = dtype.names or ()
    rest_count = sum(name.startswith("f_rest_") for name in names)
    if rest_count not in _REST_COUNTS:
        raise ArchiveError(f"{path} has {rest_count} f_rest properties, not one of {_REST_COUNTS}; export it again")
    try:
        dc = columns(*_numbered("f_dc", 3))[:, None]
        rest = dc[:, 1:]
        if rest_count:
            rest = columns(*_numbered("f_rest", rest_count)).reshape(count, 3, rest_count // 3).transpose(1, 2)
        gaussians = Gaussians(
            ids=torch.arange(count),
            means=columns("x", "y", "z"),
            log_scales=columns(*_numbered("scale", 3)),
            quats=columns(*_numbered("rot", 4)),
            logit_opacities=columns("opacity")[:, 0],
            sh=torch.cat((dc, rest), dim=1),
        )
        confidence = columns("confidence")[:, 0] if "confidence" in names else None
    except (KeyError, ValueError) as error:
        raise ArchiveError(
            f"{path} is not a PLY of Gaussians ({error}); give one that has f_dc, scale and rot"
        ) from error
    return gaussians, confidence


def _numbered(stem: str, count: int) -> tuple[str, ...]:
    return tuple(f"{stem}_{i}" for i in range(count))


def _parse_header(path: Path, head: str) -> tuple[int, np.dtype[np.void]]:
    """Number of vertices and the layout of one."""
    lines = [line.split() for line in head.splitlines()]
    if lines[:1] != [["ply"]] or ["format", "binary_little_endian", "1.0"] not in lines:
        raise ArchiveError(f"{path} is not a binary little-endian PLY; convert it, or give one that tcgsplat wrote")
    elements = [i for i, words in enumerate(lines) if words[:1] == ["element"]]
    if not elements or lines[elements[0]][1:2] != ["vertex"]:
        raise ArchiveError(f"{path} does not begin with vertices; give a PLY of Gaussians")
    end = elements[1] if len(elements) > 1 else len(lines)
    properties = [words for words in lines[elements[0] + 1 : end] if words[:1] == ["property"]]
    unknown = [" ".join(words) for words in properties if len(words) != 3 or words[1] not in TYPES]
    if unknown:
        raise ArchiveError(
            f"{path} has vertices with '{unknown[0]}', which Gaussians have not; give a PLY of Gaussians"
        )
    return int(lines[elements[0]][2]), np.dtype([(name, TYPES[kind]) for _, kind, name in properties])
