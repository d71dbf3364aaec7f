"""Image files to arrays, checked; and the removal of lens distortion.

Pixel centres are integer coordinates throughout, which is also the convention of OpenCV's maps.
"""

import re
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from tcgsplat.errors import DatasetError
from tcgsplat.geometry.camera import Camera

SUFFIXES = frozenset((".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"))
BORDER_MARGIN = 2
"""Pixels beside the empty border of an undistorted image that are not trusted either."""


class UnreadableImageError(DatasetError):
    """One image file is missing, cut off or corrupt; the rest of the sequence may be fine."""


def image_files(folder: Path, prefix: str = "") -> list[Path]:
    """Images of a folder whose names begin with `prefix`, in the order people count: 2 before 10."""
    if not folder.is_dir():
        return []
    files = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.name.startswith(prefix)]
    files = [p for p in files if not p.name.startswith(".")]  # macOS leaves a "._" file beside each one it copies
    return sorted(files, key=lambda p: [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", p.stem)])


def read_color(path: Path) -> NDArray[np.uint8]:
    """RGB image, `[h w 3]`; the orientation that a camera wrote into the file is ignored, as intrinsics do.

    Raises:
        UnreadableImageError: if the file is missing or broken.
    """
    image = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)


def read_depth(path: Path, scale: float) -> NDArray[np.float32]:
    """Depth in metres, `[h w]`; 0 where there is no reading.

    Args:
        path: 16-bit PNG or floating-point TIFF.
        scale: Units of the file per metre.

    Raises:
        UnreadableImageError: if the file is missing or broken.
        DatasetError: if it is an image, but not of depth.
    """
    raw = _decode(path, cv2.IMREAD_UNCHANGED)
    if raw.ndim != 2 or raw.dtype not in (np.uint16, np.int32, np.float32, np.float64):
        channels = 1 if raw.ndim == 2 else raw.shape[2]
        raise DatasetError(
            f"{path} is no depth image: it has {channels} channel{'s' * (channels > 1)} of {raw.dtype}; "
            "depth is one channel of 16-bit integers (PNG) or floating-point numbers (TIFF)"
        )
    depth: NDArray[np.float32] = np.divide(raw, np.float32(scale), dtype=np.float32)
    if raw.dtype == np.uint16:  # every number is a reading or 0
        return depth
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def _decode(path: Path, how: int) -> NDArray[Any]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UnreadableImageError(f"{path} cannot be opened ({error.strerror})") from error
    # OpenCV, libpng and libjpeg write to stderr about broken files, and may return half an image: ask before they do.
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), how) if _is_whole(data) else None
    except cv2.error:
        image = None
    if image is None:
        raise UnreadableImageError(f"{path} is broken or cut off, {len(data)} bytes; copy it again from its source")
    return image


def _is_whole(data: bytes) -> bool:
    """Whether a file is an image that ends where it says: PNG, JPEG, TIFF; others are left to the decoder."""
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return _png_is_whole(data)
    if data.startswith(b"\xff\xd8"):
        return data.rfind(b"\xff\xd9") > len(data) // 2  # the end marker; one near the start ends a thumbnail
    if data.startswith((b"II*\0", b"MM\0*")):
        order: Literal["little", "big"] = "little" if data.startswith(b"II") else "big"
        directory = int.from_bytes(data[4:8], order)
        entries = int.from_bytes(data[directory : directory + 2], order)
        return entries > 0 and directory + 2 + 12 * entries + 4 <= len(data)
    return data.startswith(b"BM")


def _png_is_whole(data: bytes) -> bool:
    """Walk the chunks (length, name, content, checksum) to the end chunk."""
    at, whole = 8, memoryview(data)
    while at + 12 <= len(data):
        end = at + 12 + int.from_bytes(data[at : at + 4], "big")
        if zlib.crc32(whole[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            return False
        if data[at + 4 : at + 8] == b"IEND":
            return True
        at = end
    return False


@dataclass(frozen=True, eq=False)
class Rectification:
    """Where each pixel of the undistorted image is found in the distorted one; the camera matrix stays the same."""

    u: NDArray[np.float32]
    """Column in the distorted image, pixels, `[h w]`."""
    v: NDArray[np.float32]
    """Row in the distorted image, pixels, `[h w]`."""
    valid: NDArray[np.bool_]
    """Pixels that the distorted image covers, `BORDER_MARGIN` away from those that it does not, `[h w]`."""

    @staticmethod
    def of(camera: Camera, distortion: tuple[float, ...]) -> "Rectification":
        """For Brown's lens model in OpenCV's order k1 k2 p1 p2 [k3 [k4 k5 k6]]."""
        K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], dtype=np.float64)
        size = (camera.width, camera.height)
        u, v = cv2.initUndistortRectifyMap(K, np.array(distortion), np.eye(3), K, size, cv2.CV_32FC1)
        inside = (u >= 0) & (u <= camera.width - 1) & (v >= 0) & (v <= camera.height - 1)
        side = 2 * BORDER_MARGIN + 1
        valid = cv2.erode(inside.astype(np.uint8), np.ones((side, side), np.uint8)).astype(np.bool_)
        return Rectification(u.astype(np.float32), v.astype(np.float32), valid)

    def color(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The undistorted colour image, bilinear, `[h w 3]`."""
        return cv2.remap(image, self.u, self.v, cv2.INTER_LINEAR).astype(np.uint8, copy=False)

    def depth(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """The undistorted depth image, `[h w]`: nearest neighbour, for a mean of two surfaces is on neither."""
        return cv2.remap(image, self.u, self.v, cv2.INTER_NEAREST).astype(np.float32, copy=False)
