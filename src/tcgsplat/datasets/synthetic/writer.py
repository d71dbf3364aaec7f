"""Recorded sequences on disk, in the layout of the TUM RGB-D benchmark or of Replica as NICE-SLAM distributes it."""

import json
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch

from tcgsplat.datasets import truth
from tcgsplat.datasets.synthetic.raster import View
from tcgsplat.errors import DatasetError
from tcgsplat.scene.trajectory import format_tum

Array = np.ndarray[Any, np.dtype[Any]]

Layout = Literal["tum", "replica"]

DEPTH_SCALE: Mapping[Layout, float] = {"tum": 5000.0, "replica": 6553.5}
"""Units of the 16-bit depth images per metre."""


@contextmanager
def complete_or_absent(out: Path) -> Iterator[Path]:
    """A folder to write into that becomes `out` when all went well, and is gone when it did not.

    It stands beside `out`, hidden, with `.partial-` in its name: after a power cut that is what is left.

    Raises:
        DatasetError: if `out` exists and is not an empty folder.
    """
    out = out.absolute()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DatasetError(f"{out} exists and is not an empty folder; give a new one, or empty it first")
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.partial-") as staging:
        folder = Path(staging) / out.name
        folder.mkdir()
        yield folder
        if out.exists():
            out.rmdir()
        folder.rename(out)


@dataclass(frozen=True)
class SequenceFiles:
    """Where the frames of a sequence go."""

    root: Path
    layout: Layout
    names: tuple[str, ...]
    """Of each frame, in time order: its time stamp in seconds (TUM) or its number (Replica)."""

    def paths(self, index: int) -> tuple[Path, Path, Path]:
        """Files of colour, depth and mask of a frame."""
        name = self.names[index]
        if self.layout == "tum":
            return self.root / f"rgb/{name}.png", self.root / f"depth/{name}.png", self.root / f"mask/{name}.png"
        results = self.root / "results"
        return results / f"frame{name}.jpg", results / f"depth{name}.png", self.root / f"mask/mask{name}.png"

    def write_frame(self, index: int, color: Array, depth: Array, mask: Array | None) -> None:
        """Write one frame: colour [h, w, 3] uint8 RGB, depth [h, w] metres (0 = none), mask [h, w] bool if any."""
        color_path, depth_path, mask_path = self.paths(index)
        _write_image(color_path, color[..., ::-1])
        _write_depth(depth_path, depth, DEPTH_SCALE[self.layout])
        if mask is not None:
            _write_mask(mask_path, mask)

    def write_truth(self, index: int, depth: Array | None, fault: Array | None) -> None:
        """Write what is true of one frame: depth [h, w] metres and fault [h, w] bool, each if all frames have it."""
        if depth is not None:
            _write_depth(truth.depth_file(self.root, index), depth, truth.DEPTH_SCALE)
        if fault is not None:
            _write_mask(truth.fault_file(self.root, index), fault)

    def write_events(self, events: Iterable[truth.Event]) -> None:
        """Write what happens to runs of frames."""
        (self.root / "truth" / "events.json").write_text(truth.events_text(events))

    def write_free_view(self, number: int, color: Array, depth: Array) -> None:
        """Write a view beside the walk: colour [h, w, 3] uint8 RGB, depth [h, w] metres."""
        color_path, depth_path = truth.free_files(self.root, number)
        _write_image(color_path, color[..., ::-1])
        _write_depth(depth_path, depth, truth.DEPTH_SCALE)

    def write_free_poses(self, view: View, T_world_cam: Array) -> None:
        """Write camera and poses [n, 4, 4] of the views beside the walk."""
        free = self.root / "free"
        numbers: list[float] = list(range(len(T_world_cam)))
        (free / "poses.txt").write_text(format_tum(numbers, list(torch.from_numpy(T_world_cam))))
        (free / "camera.toml").write_text(_camera_toml(view, truth.DEPTH_SCALE))

    def write_index(self, view: View, seconds: Array, T_world_cam: Array, kept: Array) -> None:
        """Write intrinsics, lists and ground truth, which make the folder readable.

        Args:
            view: The camera.
            seconds: [n] times of all frames, lost ones included.
            T_world_cam: [n, 4, 4] their poses.
            kept: [n] bool: frames that were recorded.
        """
        if self.layout == "replica":
            rows = [" ".join(f"{x:.17g}" for x in T.ravel()) for T in T_world_cam[kept]]
            (self.root / "traj.txt").write_text("\n".join(rows) + "\n")
            camera = {"w": view.width, "h": view.height, "fx": view.focal, "fy": view.focal, "cx": view.cx,
                      "cy": view.cy, "scale": DEPTH_SCALE["replica"]}  # fmt: skip
            (self.root / "cam_params.json").write_text(json.dumps({"camera": camera}, indent=2) + "\n")
            return
        for kind in ("rgb", "depth"):
            lines = [f"{name} {kind}/{name}.png" for name in self.names]
            (self.root / f"{kind}.txt").write_text("\n".join(["# timestamp filename", *lines]) + "\n")
        # Motion capture goes on while a camera loses frames.
        poses = list(torch.from_numpy(T_world_cam))
        (self.root / "groundtruth.txt").write_text(format_tum(list(seconds), poses))
        (self.root / "camera.toml").write_text(_camera_toml(view, DEPTH_SCALE["tum"]))

    def write_gains(self, gains: Array) -> None:
        """Write `exposure.txt`: each frame's name and the factor on its displayed colour."""
        lines = [f"{name} {gain:.17g}" for name, gain in zip(self.names, gains, strict=True)]
        (self.root / "exposure.txt").write_text("\n".join(["# frame gain", *lines]) + "\n")


def sequence_files(root: Path, layout: Layout, seconds: Array, extras: Iterable[str]) -> SequenceFiles:
    """Make the folders of a sequence whose recorded frames have these times [n], seconds, and those it has besides."""
    folders = ["rgb", "depth"] if layout == "tum" else ["results"]
    for folder in [*folders, "truth", *extras]:
        (root / folder).mkdir(parents=True)
    names = [f"{t:.6f}" if layout == "tum" else f"{index:06d}" for index, t in enumerate(seconds)]
    return SequenceFiles(root, layout, tuple(names))


def _camera_toml(view: View, depth_scale: float) -> str:
    return (
        "# ray-cast pictures; pixel centres at integer coordinates (OpenCV convention)\n"
        f"width = {view.width}\nheight = {view.height}\n"
        f"fx = {view.focal!r}\nfy = {view.focal!r}\ncx = {view.cx!r}\ncy = {view.cy!r}\n"
        "distortion = [0.0, 0.0, 0.0, 0.0, 0.0]  # k1 k2 p1 p2 k3\n"
        f"depth_scale = {depth_scale}  # units per metre; 0 = no reading\n"
    )


def _write_depth(path: Path, depth: Array, scale: float) -> None:
    units = np.round(depth * scale)
    _write_image(path, np.where(units <= 65535, units, 0).astype(np.uint16))


def _write_mask(path: Path, mask: Array) -> None:
    _write_image(path, np.where(mask, 255, 0).astype(np.uint8))


def _write_image(path: Path, image: Array) -> None:
    options = [cv2.IMWRITE_JPEG_QUALITY, 97] if path.suffix == ".jpg" else []
    ok, data = cv2.imencode(path.suffix, image, options)
    if not ok:
        raise DatasetError(f"OpenCV could not encode {path}; check its installation with `tcgsplat doctor`")
    path.write_bytes(data.tobytes())


def write_mesh(path: Path, vertices: Array, triangles: Array) -> None:
    """Write vertices [v, 3] (metres, kept as float32) and triangles [t, 3] as a binary PLY."""
    faces = np.empty(len(triangles), dtype=[("count", "u1"), ("vertices", "<i4", (3,))])
    faces["count"], faces["vertices"] = 3, triangles
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(header.encode("ascii") + vertices.astype("<f4").tobytes() + faces.tobytes())
