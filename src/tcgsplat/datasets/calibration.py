"""What is known of the camera that took a sequence, and `camera.toml`, where a person writes it down."""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

from tcgsplat.errors import DatasetError
from tcgsplat.geometry.camera import Camera

LENS = ("width", "height", "fx", "fy", "cx", "cy", "distortion")
REQUIRED = (*LENS[:-1], "depth_scale")
OPTIONAL = ("distortion", "depth_distorted", "crop", "fps")
DISTORTION_LENGTHS = (0, 4, 5, 8)
HOW_TO_WRITE = (
    "width, height, fx, fy, cx, cy (pixels; the first pixel's centre is 0, 0) and depth_scale (depth units per metre), "
    "and where they apply distortion = [k1, k2, p1, p2, k3], depth_distorted = false, crop (pixels), fps"
)


@dataclass(frozen=True)
class Calibration:
    """How the numbers in the image files become metres and rays."""

    camera: Camera
    """Of the whole image, before the crop; it stays the same through undistortion."""
    depth_scale: float
    """Units of the depth file per metre."""
    distortion: tuple[float, ...] = ()
    """Brown's model in OpenCV's order k1 k2 p1 p2 [k3 [k4 k5 k6]]; empty for rectified images."""
    depth_distorted: bool = True
    """Depth lies on the pixel grid of the distorted colour image, as registration in the sensor's driver leaves it."""
    crop: int = 0
    """Pixels to cut off on every side after undistortion."""
    fps: float = 30.0
    """Frames a second, where the files carry no time stamps."""


def read_calibration(root: Path, defaults: Mapping[str, object]) -> Calibration:
    """The calibration of a sequence: what its layout is known for, overruled key by key by `camera.toml`.

    Width, height, focal lengths, centre and distortion are taken whole: if the file gives one of them, all defaults
    of that group are dropped, since one camera's focal length with another's distortion is no camera.

    Args:
        root: Folder of the sequence.
        defaults: Keys and values as they would stand in `camera.toml`.

    Raises:
        DatasetError: if the file is no TOML, has unknown keys or impossible values, or if something is missing.
    """
    path = root / "camera.toml"
    given = _read_toml(path) if path.is_file() else {}
    if any(key in given for key in LENS):
        defaults = {key: value for key, value in defaults.items() if key not in LENS}
    table = {**defaults, **given}
    missing = [key for key in REQUIRED if key not in table]
    if missing and not given:
        raise DatasetError(f"the camera of {root} is not known; write a file {path} with {HOW_TO_WRITE}")
    if missing:
        raise DatasetError(f"{path} lacks {', '.join(missing)}; it needs {HOW_TO_WRITE}")
    camera = Camera(
        fx=_positive(table, "fx", path),
        fy=_positive(table, "fy", path),
        cx=_number(table, "cx", path),
        cy=_number(table, "cy", path),
        width=_whole(table, "width", path, least=1),
        height=_whole(table, "height", path, least=1),
    )
    return Calibration(
        camera=camera,
        depth_scale=_positive(table, "depth_scale", path),
        distortion=_distortion(table, path),
        depth_distorted=_switch(table, "depth_distorted", path, otherwise=True),
        crop=_crop(table, path, camera),
        fps=_positive({"fps": 30.0, **table}, "fps", path),
    )


def _read_toml(path: Path) -> dict[str, object]:
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise DatasetError(f"{path} cannot be read as TOML ({error}); write lines such as 'fx = 525.0'") from error
    known = (*REQUIRED, *OPTIONAL)
    for key in table:
        if key not in known:
            near = get_close_matches(key, known, n=1)
            hint = f"did you mean {near[0]}" if near else f"it may hold {', '.join(known)}"
            raise DatasetError(f"{path} has an unknown key {key!r}; {hint}")
    return table


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _number(table: Mapping[str, object], key: str, path: Path) -> float:
    value = table[key]
    if not _is_number(value):
        raise DatasetError(f"{key} = {value!r} in {path} is not a number")
    return float(value)  # type: ignore[arg-type]


def _positive(table: Mapping[str, object], key: str, path: Path) -> float:
    value = _number(table, key, path)
    if value <= 0:
        raise DatasetError(f"{key} = {value:g} in {path} must be above zero")
    return value


def _whole(table: Mapping[str, object], key: str, path: Path, *, least: int) -> int:
    value = table[key]
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise DatasetError(f"{key} = {value!r} in {path} must be a whole number of pixels, {least} or more")
    return value


def _switch(table: Mapping[str, object], key: str, path: Path, *, otherwise: bool) -> bool:
    value = table.get(key, otherwise)
    if not isinstance(value, bool):
        raise DatasetError(f"{key} = {value!r} in {path} must be true or false")
    return value


def _distortion(table: Mapping[str, object], path: Path) -> tuple[float, ...]:
    value = table.get("distortion", ())
    if not isinstance(value, list | tuple) or len(value) not in DISTORTION_LENGTHS or not all(map(_is_number, value)):
        raise DatasetError(
            f"distortion = {value!r} in {path} must be a list of numbers k1, k2, p1, p2[, k3[, k4, k5, k6]]"
        )
    return tuple(map(float, value)) if any(value) else ()


def _crop(table: Mapping[str, object], path: Path, camera: Camera) -> int:
    crop = _whole({"crop": 0, **table}, "crop", path, least=0)
    if 2 * crop >= min(camera.width, camera.height):
        raise DatasetError(f"crop = {crop} in {path} leaves nothing of {camera.width}x{camera.height} pixels")
    return crop
