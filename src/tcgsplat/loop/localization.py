"""Where a camera stands, from features alone: against another picture, or against many of a map.

RANSAC over three-point poses sorts the matches; the pose that it finds tells where to look for more of them; and least
squares, in which every measurement has the doubt of its sensor, ends it. Both sides are measured: with a depth image
of the located camera too, the pose has half the error that its pixels alone would leave.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import scipy  # its parts when they are used: together they are a tenth of the start-up
import torch
from jaxtyping import Bool, Float64, Int64

from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.loop.features import Features, matched
from tcgsplat.tensors import Pose

_PIXEL = 1.0
"""Standard deviation of where a feature of scale 1 is seen, pixels."""
_DEPTH = 0.003
"""Standard deviation of a depth reading at one metre, metres; it grows with the square of the distance."""
_DEPENDENCE = 2.0
"""Factor on the expected errors, because errors of neighbouring features are not independent. Measured over expected
without it, median and 99 %: 0.7 and 2 with a Kinect's noise on synthetic pictures, 2 and 8 on TUM RGB-D."""
_DRAWS, _ROUND, _MISSED = 1024, 64, 1e-3
"""Most triples drawn, and so many at once; fewer where the chance of having missed the right pose is below the last."""
_OUTLIER = 8.0
"""Standard deviations from which on a match costs the same."""
_SEARCHES = (12.0, 6.0)
"""Pixels around where the pose puts a point in which its feature is looked for; the pose is better every time."""
_LOOSE, _STRICT = 8.0, 4.0
"""Standard deviations up to which a match counts: at RANSAC's pose, and from the first refined one on."""
_BITS = 96
"""Most bits of 256 in which two descriptors look alike where they are expected; strangers differ in 128 +- 20."""
_FEWEST = 8
"""Matches below which nothing is tried."""
_NEAR = 0.05
"""Metres in front of the camera from which on a point is in view."""

Matrix = Float64[np.ndarray, "4 4"]
Information = Float64[np.ndarray, "6 6"]


@dataclass(frozen=True, eq=False)
class Found:
    """A camera that was located, and what speaks for it."""

    T_b_a: Pose
    """Where camera a stands in b's frame."""
    inliers: int
    """Features of a that agree, in pixel and depth, with a point of b that looks alike."""
    share: float
    """These over all features of a near which b has a point: how much of what both see was recognised."""
    information: Information
    """Inverse covariance of the tangent [rho, omega] of `inverse(T_b_a) @ truth`: metres, radians, a's axes."""

    @property
    def position_error(self) -> float:
        """Expected distance from the truth, metres, by the geometry of the inliers."""
        return math.sqrt(np.trace(np.linalg.inv(self.information)[:3, :3]))

    @property
    def rotation_error(self) -> float:
        """Expected angle from the truth, radians, by the geometry of the inliers."""
        return math.sqrt(np.trace(np.linalg.inv(self.information)[3:, 3:]))


def relative_pose(
    a: Features,
    b: Features,
    camera_a: Camera,
    *,
    min_inliers: int = 80,
    min_share: float = 0.15,
    max_position_error: float = 0.06,
) -> Found | None:
    """Locate a camera against what another one, or a whole map, has seen. The same every time.

    The defaults are for believing the pose as it is: of 2782 pairs of pictures that share a twentieth to all of what
    they see, synthetic with and without a Kinect's noise and of TUM RGB-D, 45 % were found, and one pose was wrong by
    more than 10 cm or 4 degrees. With 40, 0.12 and 0.08 it was 55 % and 26: better where every pose is verified.

    Args:
        a: Features of the picture to locate; without depth it works too.
        b: Features of one picture in its camera's frame, or of many pooled in a map frame; those that are points count.
        camera_a: Intrinsics of a's picture.
        min_inliers: Fewer are taken for chance.
        min_share: Less of what both see being recognised is taken for chance: among many, some always look alike.
        max_position_error: Metres; a pose that its inliers hold less firmly than this is not given.

    Returns:
        The pose, or None where nothing certain can be said.
    """
    b = b.measured
    pairs = matched(a, b)
    seen, limit, shown = _Measurements.of(a, b, pairs, camera_a), _LOOSE, 0
    T_a_b = _consensus(seen)
    if T_a_b is None:
        return None
    for radius in (*_SEARCHES, None):
        agreeing = seen.chosen(seen.deviations(T_a_b) < limit)
        if len(agreeing) < _FEWEST:
            return None
        T_a_b, information = agreeing.refined(T_a_b)
        if radius is not None:
            pairs, shown = _expected(a, b, T_a_b, camera_a, radius)
            seen, limit = _Measurements.of(a, b, pairs, camera_a), _STRICT
    inliers = int((seen.deviations(T_a_b) < _STRICT).sum())
    T_b_a = se3.inverse(torch.from_numpy(T_a_b))
    found = Found(T_b_a, inliers, inliers / max(shown, 1), information / _DEPENDENCE**2)
    certain = inliers >= min_inliers and found.share >= min_share and found.position_error <= max_position_error
    return found if certain else None


def _consensus(seen: "_Measurements") -> Matrix | None:
    """Pose `T_a_b` that costs least over all matches, each by its error or, at most, as an outlier (MSAC).

    The depth that a has read counts like its pixels: by pixels alone, far background under a slightly wrong pose
    outvotes the foreground, because its parallax is too small to tell.
    """
    if len(seen) < _FEWEST:
        return None
    generator = np.random.default_rng(0)
    best, lowest, draws, needed = None, math.inf, 0, _DRAWS
    while draws < needed:
        triples = generator.permuted(np.tile(np.arange(len(seen)), (_ROUND, 1)), axis=1)[:, :3]
        draws += _ROUND
        poses = seen.triangulated(triples)
        costs, share = seen.costs(poses)
        k = int(costs.argmin()) if len(poses) else 0
        if len(poses) and costs[k] < lowest:
            best, lowest = poses[k], costs[k]
            chance = min(max(share[k], 0.01), 0.99) ** 3  # that a triple is all inliers
            needed = min(_DRAWS, math.ceil(math.log(_MISSED) / math.log1p(-chance)))
    return best


def _expected(
    a: Features, b: Features, T_a_b: Matrix, camera: Camera, radius: float
) -> tuple[Int64[np.ndarray, "m 2"], int]:
    """Matches where the pose expects them, and how many features of a had a point of b to be matched with."""
    points = b.points @ T_a_b[:3, :3].T + T_a_b[:3, 3]
    rows = np.flatnonzero(points[:, 2] > _NEAR)
    x, y, z = points[rows].T
    seen = np.stack((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), axis=1)
    near = scipy.spatial.cKDTree(a.pixels).sparse_distance_matrix(
        scipy.spatial.cKDTree(seen), radius, output_type="coo_matrix"
    )
    i, j = near.row.astype(np.int64), rows[near.col]
    differing = a.descriptors[i].view(np.uint64) ^ b.descriptors[j].view(np.uint64)
    bits = np.bitwise_count(differing).sum(axis=1, dtype=np.int64)
    least_a, least_b = np.full(len(a), _BITS + 1), np.full(len(b), _BITS + 1)
    np.minimum.at(least_a, i, bits)
    np.minimum.at(least_b, j, bits)
    best = np.flatnonzero((bits <= _BITS) & (bits == least_a[i]) & (bits == least_b[j]))
    best = best[np.lexsort((j[best], i[best]))]
    _, first = np.unique(i[best], return_index=True)
    return np.stack((i[best[first]], j[best[first]]), axis=1), len(np.unique(i))


@dataclass(frozen=True, eq=False)
class _Measurements:
    """m matches as what a saw (pixel, depth) and what b knows of the point, each with its doubt."""

    camera: Camera
    points: Float64[np.ndarray, "m 3"]
    """In b's frame."""
    point_covariance: Float64[np.ndarray, "m 3 3"]
    """Long along the ray that measured it, square metres."""
    seen: Float64[np.ndarray, "m 3"]
    """Column, row, depth in a."""
    seen_covariance: Float64[np.ndarray, "m 3 3"]
    """Pixels and metres, squared; a depth that was not read has a vast one."""

    @staticmethod
    def of(a: Features, b: Features, pairs: Int64[np.ndarray, "m 2"], camera: Camera) -> "_Measurements":
        rows_a, rows_b = pairs.T
        points = b.points[rows_b].astype(np.float64)
        ray = points - b.origins[rows_b]
        range_ = np.linalg.norm(ray, axis=1)
        along = np.einsum("mi,mj->mij", ray, ray) * (_DEPTH**2 * range_[:, None, None] ** 2)
        across = (_PIXEL * b.scales[rows_b] * range_ / camera.fx) ** 2
        depth = a.points[rows_a, 2].astype(np.float64)
        pixel = (_PIXEL * a.scales[rows_a].astype(np.float64)) ** 2
        read = np.isfinite(depth)
        depth = np.where(read, depth, 1.0)
        doubt = np.where(read, (_DEPTH * depth**2) ** 2, 1e6)
        return _Measurements(
            camera,
            points,
            along + across[:, None, None] * np.eye(3),
            np.concatenate((a.pixels[rows_a].astype(np.float64), depth[:, None]), axis=1),
            np.stack((pixel, pixel, doubt), axis=1)[:, :, None] * np.eye(3),
        )

    def __len__(self) -> int:
        return len(self.points)

    @property
    def camera_matrix(self) -> Float64[np.ndarray, "3 3"]:
        camera = self.camera
        return np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])

    def chosen(self, flags: Bool[np.ndarray, " m"]) -> "_Measurements":
        return _Measurements(
            self.camera, self.points[flags], self.point_covariance[flags], self.seen[flags], self.seen_covariance[flags]
        )

    def linearized(
        self, T_a_b: Matrix
    ) -> tuple[Float64[np.ndarray, "m 3"], Float64[np.ndarray, "m 3 6"], Float64[np.ndarray, "m 3 3"]]:
        """Residuals [m 3], their derivatives by a step [rho, omega] of a's frame [m 3 6], and their weights [m 3 3]."""
        R = T_a_b[:3, :3]
        points = self.points @ R.T + T_a_b[:3, 3]
        x, y, z = points.T
        z = np.maximum(z, _NEAR)
        camera, zero, one = self.camera, np.zeros_like(z), np.ones_like(z)
        residual = np.stack((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, z), axis=1) - self.seen
        by_point = np.stack(
            (camera.fx / z, zero, -camera.fx * x / z**2, zero, camera.fy / z, -camera.fy * y / z**2, zero, zero, one),
            axis=1,
        ).reshape(-1, 3, 3)
        turned = -by_point @ _skew(points)
        by_b = by_point @ R
        weight = np.linalg.inv(self.seen_covariance + by_b @ self.point_covariance @ by_b.transpose(0, 2, 1))
        return residual, np.concatenate((by_point, turned), axis=2), weight

    def triangulated(self, triples: Int64[np.ndarray, "t 3"]) -> Float64[np.ndarray, "s 4 4"]:
        """All poses `T_a_b` under which three points are seen where they are, for each triple."""
        K = self.camera_matrix
        turns: list[Float64[np.ndarray, "3 1"]] = []
        shifts: list[Float64[np.ndarray, "3 1"]] = []
        for triple in triples:
            _, rotations, translations = cv2.solveP3P(
                self.points[triple], self.seen[triple, :2].copy(), K, None, flags=cv2.SOLVEPNP_AP3P
            )
            turns += rotations
            shifts += translations
        poses = np.tile(np.eye(4), (len(turns), 1, 1))
        if turns:
            poses[:, :3, :3] = scipy.spatial.transform.Rotation.from_rotvec(np.stack(turns)[:, :, 0]).as_matrix()
            poses[:, :3, 3] = np.stack(shifts)[:, :, 0]
        return poses[np.isfinite(poses).all(axis=(1, 2))]

    def costs(self, poses: Float64[np.ndarray, "s 4 4"]) -> tuple[Float64[np.ndarray, " s"], Float64[np.ndarray, " s"]]:
        """What all matches cost under each pose, and the share that agrees with it."""
        points = self.points @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
        x, y, z = np.moveaxis(points, 2, 0)
        behind, z = z < _NEAR, np.maximum(z, _NEAR)
        u, v, depth = self.seen.T
        pixel, doubt = self.seen_covariance[:, 0, 0], self.seen_covariance[:, 2, 2]
        du, dv = self.camera.fx * x / z + self.camera.cx - u, self.camera.fy * y / z + self.camera.cy - v
        squared = (du**2 + dv**2) / (2 * pixel) + (z - depth) ** 2 / (2 * doubt)
        squared = np.where(behind, math.inf, squared)
        return np.minimum(squared, _OUTLIER**2).sum(axis=1), (squared < _OUTLIER**2).mean(axis=1)

    def deviations(self, T_a_b: Matrix) -> Float64[np.ndarray, " m"]:
        """How far every match is off, in standard deviations; infinite behind the camera."""
        residual, _, weight = self.linearized(T_a_b)
        squared = np.einsum("mi,mij,mj->m", residual, weight, residual)
        in_front = self.points @ T_a_b[2, :3] + T_a_b[2, 3] > _NEAR
        return np.where(in_front, np.sqrt(squared), np.inf)

    def refined(self, T_a_b: Matrix, steps: int = 10) -> tuple[Matrix, Information]:
        """The pose of least squares with Cauchy's kernel, and the information of a step [rho, omega] of a's frame."""
        for _ in range(steps):
            residual, by_step, weight = self.linearized(T_a_b)
            squared = np.einsum("mi,mij,mj->m", residual, weight, residual)
            weight = weight / (1.0 + squared)[:, None, None]
            information = np.einsum("mki,mkl,mlj->ij", by_step, weight, by_step, optimize=True)
            information = information + 1e-9 * np.trace(information) * np.eye(6)
            step = -np.linalg.solve(information, np.einsum("mki,mkl,ml->i", by_step, weight, residual, optimize=True))
            T_a_b = _rigid(step[3:], step[:3]) @ T_a_b
            if np.abs(step).max() < 1e-6:
                break
        return T_a_b, information


def _skew(v: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "m 3 3"]:
    x, y, z = v.T
    zero = np.zeros_like(x)
    return np.stack((zero, -z, y, z, zero, -x, -y, x, zero), axis=1).reshape(-1, 3, 3)


def _rigid(rotation_vector: Float64[np.ndarray, "*a"], translation: Float64[np.ndarray, "*b"]) -> Matrix:
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(rotation_vector)[0]
    T[:3, 3] = np.ravel(translation)
    return T
