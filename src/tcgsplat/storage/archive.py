"""Versioned `.npz` archives, and a sealed submap as one of them: it needs no data set, no config and no pickle.

Gaussians, confidence and poses come back bit by bit. Keyframe images are PNG inside the archive:

- colour in 8 bits: exact for frames that were read from 8-bit images;
- depth in 16 bits at 5000 units a metre, so rounded by at most 0.1 mm, and exact where the sensor file has 5000
  (TUM) or 1000 (ScanNet) units a metre. A keyframe that sees farther than 13.1 m takes the finest scale that holds
  its farthest reading: at most 0.2 mm off up to 26 m;
- the mask of valid pixels, exact.
"""

import zipfile
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import astuple, fields, replace
from pathlib import Path
from typing import overload

import cv2
import numpy as np
import torch
from jaxtyping import Shaped, UInt8
from numpy.lib.npyio import NpzFile
from torch import Tensor

from tcgsplat.confidence.state import ConfidenceState
from tcgsplat.errors import ArchiveError
from tcgsplat.geometry.camera import Camera
from tcgsplat.scene.exposure import UNCHANGED, Exposure
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.storage import atomic
from tcgsplat.tensors import Image, Mask, Plane

VERSION = 1
"""Of every archive's layout; a reader refuses any other."""
DEPTH_UNITS_PER_METRE = 5000.0
_DEPTH_UNITS_MAX = 65535

_COLUMNS = (
    *("index", "clock", "T_world_map", "keyframes"),
    *(f"gaussians.{f.name}" for f in fields(Gaussians)),
    *(f"confidence.{f.name}" for f in fields(ConfidenceState)),
)
"""Of a submap's file without its keyframes."""
_KEYFRAME_COLUMNS = (
    *("frame_index", "timestamp", "camera", "T_map_cam", "exposure"),
    *("color", "depth", "depth_units_per_metre", "valid"),
)

Array = Shaped[np.ndarray, "..."]
Png = UInt8[np.ndarray, " bytes"]


def write_arrays(path: Path, kind: str, arrays: Mapping[str, Array]) -> None:
    """Write named arrays as a `.npz` file that says what it is and of which version."""
    with atomic.writing(path) as file:
        np.savez(file, allow_pickle=False, kind=np.array(kind), version=np.array(VERSION), **arrays)


def read_arrays(path: Path, kind: str, names: Collection[str] | None = None) -> dict[str, Array]:
    """Read back what `write_arrays` wrote, all of it or some arrays, checked against the checksums of the file.

    Raises:
        ArchiveError: if the file is missing, truncated, damaged, of another kind or of another version.
    """
    try:
        with path.open("rb") as file, NpzFile(file, allow_pickle=False) as archive:
            wanted = archive.files if names is None else {"kind", "version", *names}.intersection(archive.files)
            arrays = {name: archive[name] for name in wanted}
    except FileNotFoundError as error:
        raise ArchiveError(f"no file {path}; give a run directory that holds it") from error
    except (OSError, ValueError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        again = "`tcgsplat refine` makes it anew" if kind == "map" else "run again with --overwrite"
        raise ArchiveError(f"{path} is not a complete archive ({error}); {again}") from error
    found = str(arrays.get("kind", "something else"))
    if found != kind:
        raise ArchiveError(f"{path} holds {found}, not a {kind}; give the file or folder that a run of tcgsplat wrote")
    if int(arrays["version"]) != VERSION:
        raise ArchiveError(
            f"{path} has layout version {int(arrays['version'])}, and this tcgsplat reads version {VERSION}; "
            "use the tcgsplat that wrote it, or run again"
        )
    return arrays


def write_submap(path: Path, submap: Submap) -> None:
    """Write a submap with everything in it to `path`."""
    arrays = {**pack_submap(submap), "keyframes": np.array(len(submap.keyframes))}
    for i, keyframe in enumerate(submap.keyframes):
        arrays |= {f"keyframe.{i}.{name}": array for name, array in _pack_keyframe(keyframe).items()}
    write_arrays(path, "submap", arrays)


def read_submap(path: Path) -> Submap:
    """Read a submap back, on the CPU.

    Raises:
        ArchiveError: if the file is missing, truncated, damaged, of another kind or of another version.
    """
    arrays = read_arrays(path, "submap")
    submap = unpack_submap(path, arrays)
    with _complete(path):
        keyframes = tuple(_unpack_keyframe(arrays, f"keyframe.{i}.") for i in range(int(arrays["keyframes"])))
    return replace(submap, keyframes=keyframes)


def open_submap(path: Path) -> Submap:
    """Read a submap back without its keyframes: each is read when it is asked for.

    Raises:
        ArchiveError: as `read_submap`; also when a keyframe is asked for.
    """
    arrays = read_arrays(path, "submap", _COLUMNS)
    submap = unpack_submap(path, arrays)
    with _complete(path):
        return replace(submap, keyframes=StoredKeyframes(path, int(arrays["keyframes"])))


class StoredKeyframes(Sequence[Keyframe]):
    """The keyframes in a submap's file. Reading one takes a few milliseconds; none is kept in memory."""

    def __init__(self, path: Path, count: int) -> None:
        self._path, self._count = path, count

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, place: int) -> Keyframe: ...
    @overload
    def __getitem__(self, place: slice) -> tuple[Keyframe, ...]: ...
    def __getitem__(self, place: int | slice) -> Keyframe | tuple[Keyframe, ...]:
        """Read a keyframe, or several."""
        if isinstance(place, slice):
            return tuple(self[i] for i in range(*place.indices(len(self))))
        prefix = f"keyframe.{range(len(self))[place]}."
        arrays = read_arrays(self._path, "submap", [f"{prefix}{name}" for name in _KEYFRAME_COLUMNS])
        with _complete(self._path):
            return _unpack_keyframe(arrays, prefix)


def pack_submap(submap: Submap) -> dict[str, Array]:
    """Everything in a submap but its keyframes, by name."""
    return {
        "index": np.array(submap.index),
        "clock": np.array(submap.clock),
        "T_world_map": _array(submap.T_world_map),
        **{f"gaussians.{f.name}": _array(getattr(submap.gaussians, f.name)) for f in fields(Gaussians)},
        **{f"confidence.{f.name}": _array(getattr(submap.confidence, f.name)) for f in fields(ConfidenceState)},
    }


def unpack_submap(path: Path, arrays: Mapping[str, Array]) -> Submap:
    """The submap that `pack_submap` packed, without keyframes.

    Raises:
        ArchiveError: if an array is missing; `path` is where they come from.
    """
    with _complete(path):
        return Submap(
            index=int(arrays["index"]),
            T_world_map=torch.from_numpy(arrays["T_world_map"]),
            gaussians=Gaussians(**{f.name: torch.from_numpy(arrays[f"gaussians.{f.name}"]) for f in fields(Gaussians)}),
            confidence=ConfidenceState(**_confidence(arrays)),
            clock=int(arrays["clock"]),
        )


def _confidence(arrays: Mapping[str, Array]) -> dict[str, Tensor]:
    columns = {name: f"confidence.{name}" for name in (f.name for f in fields(ConfidenceState))}
    unknown = np.zeros_like(arrays["confidence.value"])  # an older tcgsplat expected no errors
    given = dict(arrays) | {
        columns[name]: arrays.get(columns[name], unknown) for name in ("expected_error", "evidence")
    }
    return {name: torch.from_numpy(given[column]) for name, column in columns.items()}


def submap_size(path: Path) -> int:
    """How many Gaussians a submap's file holds; nothing else of it is read.

    Raises:
        ArchiveError: as `read_submap`.
    """
    return len(read_arrays(path, "submap", ("gaussians.ids",))["gaussians.ids"])


@contextmanager
def _complete(path: Path) -> Iterator[None]:
    try:
        yield
    except KeyError as error:
        raise ArchiveError(f"{path} lacks the entry {error}; run again with --overwrite") from error


def _array(tensor: Tensor) -> Array:
    return np.ascontiguousarray(tensor.detach().cpu().numpy())


def _pack_keyframe(keyframe: Keyframe) -> dict[str, Array]:
    frame = keyframe.frame
    color = (_array(frame.color) * 255.0).round().clip(0, 255).astype(np.uint8)
    depth = _array(frame.depth).astype(np.float64)
    units = min(DEPTH_UNITS_PER_METRE, _DEPTH_UNITS_MAX / max(float(depth.max(initial=0.0)), 1e-6))
    return {
        "frame_index": np.array(frame.index),
        "timestamp": np.array(frame.timestamp),
        "camera": np.array(astuple(frame.camera), dtype=np.float64),
        "T_map_cam": _array(keyframe.T_map_cam),
        "exposure": np.array(astuple(keyframe.exposure), dtype=np.float64),
        "color": _encode_png(color[..., ::-1]),
        "depth": _encode_png((depth * units).round().clip(0, _DEPTH_UNITS_MAX).astype(np.uint16)),
        "depth_units_per_metre": np.array(units),
        "valid": _encode_png(_array(frame.valid).astype(np.uint8) * 255),
    }


def _unpack_keyframe(arrays: Mapping[str, Array], prefix: str) -> Keyframe:
    fx, fy, cx, cy, width, height = arrays[f"{prefix}camera"].tolist()
    color: Image = torch.from_numpy(_decode_png(arrays[f"{prefix}color"])[..., ::-1].astype(np.float32) / 255.0)
    units = float(arrays[f"{prefix}depth_units_per_metre"])
    depth: Plane = torch.from_numpy((_decode_png(arrays[f"{prefix}depth"]) / units).astype(np.float32))
    valid: Mask = torch.from_numpy(_decode_png(arrays[f"{prefix}valid"]) > 0)
    frame = Frame(
        index=int(arrays[f"{prefix}frame_index"]),
        timestamp=float(arrays[f"{prefix}timestamp"]),
        color=color,
        depth=depth,
        valid=valid,
        camera=Camera(fx, fy, cx, cy, int(width), int(height)),
    )
    exposure = arrays.get(f"{prefix}exposure", np.array(astuple(UNCHANGED)))  # an older tcgsplat knew none
    return Keyframe(frame, torch.from_numpy(arrays[f"{prefix}T_map_cam"]), Exposure(*exposure.tolist()))


def _encode_png(image: Array) -> Png:
    encoded, png = cv2.imencode(".png", np.ascontiguousarray(image))
    if not encoded:
        raise ArchiveError(f"an image of shape {image.shape} cannot be written as PNG; check the size of the frames")
    return np.asarray(png, dtype=np.uint8).reshape(-1)


def _decode_png(png: Png) -> Array:
    image = cv2.imdecode(png, cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ArchiveError("a keyframe image in the archive is not a PNG; run again with --overwrite")
    return np.asarray(image)
