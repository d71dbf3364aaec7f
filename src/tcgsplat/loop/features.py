"""Local features of a picture: what a place is known again by, with no learned weights.

Oriented binary features (ORB) take a few milliseconds a picture and 32 bytes each. Where the sensor has a reading, a
feature is also a point in space; features of several pictures can be put together in the frame of their map.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Int64, UInt8

from tcgsplat.geometry.camera import Camera
from tcgsplat.scene.frame import Frame
from tcgsplat.tensors import Pose

_PATCH = 31
"""Side of the patch that a feature of the finest pyramid level describes, pixels of that level."""
_ENLARGED = 2
"""Pyramid levels above the picture's own size. Small pictures hold more than corners of one pixel can tell: on
320x240 these two levels find a tenth more of the pairs of views than the picture's own size does."""
_LEVEL = 1.2
"""Size of a pyramid level over that of the next."""
_REACH = 2
"""Pixels around a feature in which the nearest surface is looked for: it may sit beside the edge that made it."""
_SURFACE = 1.05
"""Readings up to this factor beyond the nearest belong to the same surface."""
_NEIGHBORS = 16
"""Nearest descriptors among which the first that lies elsewhere in space is looked for."""


@dataclass(frozen=True, eq=False)
class Features:
    """Local features of one picture, or of several of one map, and where in its frame each of them is."""

    pixels: Float32[np.ndarray, "k 2"]
    """Column and row (u, v) in the picture; the centre of the first pixel is (0, 0)."""
    scales: Float32[np.ndarray, " k"]
    """Side of the described patch over that in the picture's own size: 2 has half the resolution in `pixels`."""
    descriptors: UInt8[np.ndarray, "k 32"]
    """256 comparisons of brightness in the patch, as bits."""
    points: Float32[np.ndarray, "k 3"]
    """Metres, in the camera's frame or the map's; NaN where the sensor has no reading."""
    origins: Float32[np.ndarray, "k 3"]
    """Where the camera that measured the point stood, in the same frame: its doubt is along the line from there."""

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def measured(self) -> "Features":
        """Those that are points in space."""
        return self._chosen(np.flatnonzero(np.isfinite(self.points[:, 2])))

    def moved(self, T_map_cam: Pose) -> "Features":
        """The same features with their points in another frame."""
        T = T_map_cam.numpy(force=True)
        R, t = T[:3, :3], T[:3, 3]
        points, origins = ((p @ R.T + t).astype(np.float32) for p in (self.points, self.origins))
        return Features(self.pixels, self.scales, self.descriptors, points, origins)

    def _chosen(self, rows: Int64[np.ndarray, " m"]) -> "Features":
        return Features(
            self.pixels[rows], self.scales[rows], self.descriptors[rows], self.points[rows], self.origins[rows]
        )


def features(frame: Frame, limit: int = 1000) -> Features:
    """The clearest corners of a picture over its pyramid; the same every time, and none in a flat picture.

    Args:
        frame: Only its valid pixels are looked at; it needs no depth.
        limit: Most features to keep.

    Returns:
        At most `limit` features in the camera's frame, the clearest first. Source: Rublee et al., ORB, ICCV 2011.
    """
    orb = cv2.ORB.create(
        nfeatures=limit,
        scaleFactor=_LEVEL,
        nlevels=8,
        edgeThreshold=_PATCH // 2 + 1,
        firstLevel=_ENLARGED,
        scoreType=cv2.ORB_FAST_SCORE,
        patchSize=_PATCH,
        fastThreshold=7,
    )
    rgb = (frame.color.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy(force=True)
    found, descriptors = orb.detectAndCompute(
        cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), frame.valid.to(torch.uint8).numpy(force=True)
    )
    if not found:
        return pooled(())
    response = np.array([keypoint.response for keypoint in found])
    clearest = np.argsort(-response, kind="stable")[:limit]  # ties let ORB keep more than it was asked for
    pixels = np.array([found[i].pt for i in clearest], dtype=np.float32)
    depths = _surface_depths(frame.depth.numpy(force=True), pixels)
    return Features(
        pixels,
        np.array([found[i].size / _PATCH for i in clearest], dtype=np.float32),
        descriptors[clearest],
        _backprojected(frame.camera, pixels, depths),
        np.zeros((len(pixels), 3), dtype=np.float32),
    )


def pooled(parts: Sequence[tuple[Features, Pose]]) -> Features:
    """The measured features of several pictures in one frame, so that a picture is located against all of them.

    Args:
        parts: Features of each picture in its camera's frame, and that camera's pose `T_map_cam`.

    Returns:
        Features with points in the map frame; `pixels` are still those of the picture that each came from.
    """
    moved = [features.measured.moved(T_map_cam) for features, T_map_cam in parts]
    return Features(
        np.concatenate([np.zeros((0, 2), np.float32), *(part.pixels for part in moved)]),
        np.concatenate([np.zeros(0, np.float32), *(part.scales for part in moved)]),
        np.concatenate([np.zeros((0, 32), np.uint8), *(part.descriptors for part in moved)]),
        np.concatenate([np.zeros((0, 3), np.float32), *(part.points for part in moved)]),
        np.concatenate([np.zeros((0, 3), np.float32), *(part.origins for part in moved)]),
    )


def matched(a: Features, b: Features, *, ratio: float = 0.8, same_place: float = 0.05) -> Int64[np.ndarray, "m 2"]:
    """Pairs of features that look alike: each the other's nearest, and clearly nearer than any other place.

    A corner is found on several levels of the pyramid and in several pictures of a map, so the rival that a match
    has to beat is the nearest descriptor at another place in space, not the second nearest of all.

    Args:
        a: Features of a picture.
        b: Features of another, or of a map.
        ratio: Most that the distance may be of the rival's, in bits.
        same_place: Metres up to which points of b are one place.

    Returns:
        Rows of a and of b.
    """
    if not len(a) or not len(b):
        return np.zeros((0, 2), dtype=np.int64)
    bits, rows = _nearest(a, b, min(_NEIGHBORS, len(b)))
    _, back = _nearest(b._chosen(rows[:, 0]), a, 1)
    apart = np.linalg.norm(b.points[rows] - b.points[rows[:, :1]], axis=2)
    rival = np.where(apart <= same_place, np.inf, bits)[:, 1:].min(axis=1, initial=np.inf)  # NaN is elsewhere
    kept = np.flatnonzero((back[:, 0] == np.arange(len(a))) & (bits[:, 0] < ratio * rival))
    return np.stack((kept, rows[kept, 0]), axis=1)


def _nearest(
    a: Features, b: Features, count: int
) -> tuple[Int64[np.ndarray, "k {count}"], Int64[np.ndarray, "k {count}"]]:
    """Distances in bits to the nearest descriptors of b, and their rows."""
    bits, rows = cv2.batchDistance(a.descriptors, b.descriptors, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=count)
    return bits.astype(np.int64), rows.astype(np.int64)


def _surface_depths(depth: Float32[np.ndarray, "h w"], pixels: Float32[np.ndarray, "k 2"]) -> Float32[np.ndarray, " k"]:
    """Depth of the nearest surface around each pixel, metres: its median over the neighbourhood; NaN without any.

    A corner at a depth edge is, as a rule, the foreground's: the background changes behind it as the camera moves.
    """
    height, width = depth.shape
    offsets = np.arange(-_REACH, _REACH + 1)
    columns, rows = (np.rint(pixels[:, i]).astype(np.int64)[:, None, None] for i in (0, 1))
    rows, columns = rows + offsets[:, None], columns + offsets
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    read = np.where(inside, depth[rows.clip(0, height - 1), columns.clip(0, width - 1)], 0.0).reshape(len(pixels), -1)
    read = np.sort(np.where(read > 0, read, np.inf), axis=1)
    nearest = np.where(np.isfinite(read[:, 0]), read[:, 0], np.nan)
    on_surface = (read <= _SURFACE * nearest[:, None]).sum(axis=1)
    middle = read[np.arange(len(read)), on_surface // 2]
    return np.where(on_surface > 0, middle, np.nan).astype(np.float32)


def _backprojected(
    camera: Camera, pixels: Float32[np.ndarray, "k 2"], depths: Float32[np.ndarray, " k"]
) -> Float32[np.ndarray, "k 3"]:
    x = (pixels[:, 0] - camera.cx) / camera.fx * depths
    y = (pixels[:, 1] - camera.cy) / camera.fy * depths
    return np.stack((x, y, depths), axis=1).astype(np.float32)
