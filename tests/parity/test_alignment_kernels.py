"""The alignment kernels against the same formulas written out in float64, point after point."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pytest
import torch

from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.tracking import alignment_kernels as kernels
from tcgsplat.tracking import pyramids
from tcgsplat.tracking.alignment import normal_equations

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]

HEIGHT, WIDTH = 48, 70
FX, FY, CX, CY = 61.0, 62.5, 34.2, 23.1
SEEN_BY = Camera(FX, FY, CX, CY, WIDTH, HEIGHT)


@dataclass(frozen=True)
class Scene:
    """All that a pass reads: points [POINT, n], a live picture with its depth, a pose and its constants."""

    points: Floats
    intensity: Floats
    depth: Floats
    T: Doubles
    gain: float = 1.1
    offset: float = -0.03
    color_scale: float = 0.07
    depth_scale: float = 1.7
    gate: float = 0.05
    depth_weight: float = 0.8
    sigma_floor: float = 0.0017
    sigma_slope: float = 0.0019

    @property
    def constants(self) -> Floats:
        constants = np.empty(kernels.CONSTANTS, np.float32)
        constants[kernels.ROTATION : kernels.TRANSLATION] = self.T[:3, :3].ravel()
        constants[kernels.TRANSLATION : kernels.INTRINSICS] = self.T[:3, 3]
        constants[kernels.INTRINSICS : kernels.GAIN] = FX, FY, CX, CY
        constants[kernels.GAIN], constants[kernels.OFFSET] = self.gain, self.offset
        constants[kernels.COLOR_SCALE], constants[kernels.DEPTH_SCALE] = self.color_scale, self.depth_scale
        constants[kernels.GATE], constants[kernels.BALANCE] = self.gate, self.depth_weight
        constants[kernels.SIGMA_FLOOR], constants[kernels.SIGMA_SLOPE] = self.sigma_floor, self.sigma_slope
        return constants

    def sums(self) -> Doubles:
        live = pyramids.sampled(self.intensity, self.depth)
        live[[0, -1]] = live[:, [0, -1]] = np.nan  # no pass may ask for the border
        return normal_equations(self.points, live, self.constants)  # type: ignore[no-any-return]


def scene(seed: int, count: int = 480) -> Scene:
    """A slanted wall and a box before it, with noise, holes and an unseen patch; points on them, near them, and lost.

    Two in three points lie on what the live camera sees, moved by about a depth's noise; of the others some are in
    front, some behind, out of view, behind the camera or no points at all.
    """
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    depth = 1.4 + 0.006 * u + 0.004 * v + rng.normal(0, 0.002, u.shape)
    depth[12:30, 20:44] -= 0.3
    depth[rng.random(u.shape) < 0.1] = 0
    depth[34:40, 30:60] = -1
    intensity = rng.random(u.shape)

    T = se3.exp(torch.from_numpy(rng.normal(0, 0.03, 6))).numpy()
    pixels = rng.uniform((-6, -6), (WIDTH + 6, HEIGHT + 6), (count, 2))
    column, row = np.clip(np.rint(pixels).astype(int), 0, (WIDTH - 1, HEIGHT - 1)).T
    z = np.where(depth[row, column] > 0, depth[row, column], 1.5)
    z *= 1 + np.where(rng.random(count) < 2 / 3, rng.normal(0, 0.003, count), rng.normal(0, 0.2, count))
    z[rng.random(count) < 0.05] *= -1
    z[rng.random(count) < 0.03] = 0.05
    in_live = np.stack(((pixels[:, 0] - CX) / FX * z, (pixels[:, 1] - CY) / FY * z, z))
    normals = rng.normal(0, 0.6, (3, count)) - np.eye(3)[:, 2:]
    normals /= np.linalg.norm(normals, axis=0)
    normals[:, rng.random(count) < 0.2] = 0
    points = np.zeros((kernels.POINT, count), np.float32)
    points[: kernels.NX] = T[:3, :3].T @ (in_live - T[:3, 3:])
    points[kernels.NX : kernels.REFERENCE] = T[:3, :3].T @ normals
    points[kernels.REFERENCE] = intensity[row, column] + rng.normal(0, 0.05, count)
    points[kernels.WEIGHT] = rng.uniform(0, 1, count)
    points[:, rng.random(count) < 0.1] = 0
    return Scene(points, intensity.astype(np.float32), depth.astype(np.float32), T)


def bilinear(image: Doubles, u: float, v: float) -> float:
    x, y = int(u), int(v)
    a, b = u - x, v - y
    above = (1 - a) * image[y, x] + a * image[y, x + 1]
    below = (1 - a) * image[y + 1, x] + a * image[y + 1, x + 1]
    return float((1 - b) * above + b * below)


def live_depth(depth: Doubles, u: float, v: float) -> float:
    """Bilinear on one surface, else the nearest pixel's."""
    around = depth[int(v) : int(v) + 2, int(u) : int(u) + 2]
    if around.min() > 0 and around.max() - around.min() < 0.03 * around.min():
        return bilinear(depth, u, v)
    return float(depth[int(v + 0.5), int(u + 0.5)])


def slope(image: Doubles, u: float, v: float) -> tuple[float, float]:
    """Bilinear mean of the central differences of the four pixels around."""
    du, dv = np.zeros_like(image), np.zeros_like(image)
    du[:, 1:-1] = (image[:, 2:] - image[:, :-2]) / 2
    dv[1:-1] = (image[2:] - image[:-2]) / 2
    return bilinear(du, u, v), bilinear(dv, u, v)


def expected(scene: Scene) -> Doubles:
    """The sums of a pass, as the docstring of `normal_equations` defines them."""
    intensity, depth = scene.intensity.astype(np.float64), scene.depth.astype(np.float64)
    R, t = scene.T[:3, :3], scene.T[:3, 3]
    H, g, stats = np.zeros((6, 6)), np.zeros(6), np.zeros(kernels.SUMS)

    def add(weight: float, r: float, by_point: Doubles, point: Doubles) -> None:
        """The point moves by rho + omega x point."""
        j = np.concatenate((by_point, np.cross(point, by_point)))
        H[:] += weight * np.outer(j, j)
        g[:] += weight * r * j

    for p in scene.points.T.astype(np.float64):
        if p[kernels.PZ] == 0:
            continue
        X, Y, Z = point = R @ p[:3] + t
        if Z < 0.1:
            continue
        u, v = FX * X / Z + CX, FY * Y / Z + CY
        if not (1 <= u < WIDTH - 2 and 1 <= v < HEIGHT - 2):
            continue
        d = live_depth(depth, u, v)
        if d < 0:
            continue
        stats[kernels.IN_VIEW] += 1
        weight = p[kernels.WEIGHT]
        if d > 0:
            stats[kernels.READINGS] += 1
            if abs(d - Z) > scene.gate * (1 + d / 2):
                continue
            stats[kernels.AGREEING] += 1
            normal = R @ p[kernels.NX : kernels.REFERENCE]
            facing = normal @ point / Z
            if abs(facing) > 0.2:
                sigma = (scene.sigma_floor + scene.sigma_slope * (d - 0.4) ** 2) * abs(facing)
                r = (d - Z) * facing
                student = 6 / (5 + (r / sigma / scene.depth_scale) ** 2)
                stats[kernels.DEPTH_SQUARES] += weight * student * (r / sigma) ** 2
                stats[kernels.DEPTH_WEIGHT] += weight
                add(weight * student * scene.depth_weight / (sigma * scene.depth_scale) ** 2, r, -normal, point)
        seen, reference = bilinear(intensity, u, v), p[kernels.REFERENCE]
        r = seen - (scene.gain * reference + scene.offset)
        counts = weight * 6 / (5 + (r / scene.color_scale) ** 2)
        stats[kernels.COLOR_SQUARES] += counts * r**2
        stats[kernels.COLOR_WEIGHT] += weight
        moments = (1, reference, seen, reference**2, reference * seen, seen**2)
        stats[kernels.GAIN_W : kernels.GAIN_LL + 1] += counts * np.array(moments)
        du, dv = slope(intensity, u, v)
        by_point = np.array([du * FX / Z, dv * FY / Z, -(du * FX * X + dv * FY * Y) / Z**2])
        add(counts / scene.color_scale**2, r, by_point, point)
    stats[:21], stats[21:27] = H[np.triu_indices(6)], g
    return stats


def assert_equal_sums(found: Doubles, true: Doubles, tolerance: float) -> None:
    """Relative to what each number could be: sqrt(H_ii H_jj) for H, sqrt(H_ii squared residuals) for g."""
    diagonal = true[[0, 6, 11, 15, 18, 20]]
    rows, columns = np.triu_indices(6)
    size = np.abs(true)
    size[:21] = np.sqrt(diagonal[rows] * diagonal[columns])
    size[21:27] = np.sqrt(diagonal * (true[kernels.DEPTH_SQUARES] + true[kernels.COLOR_SQUARES] / 0.07**2))
    np.testing.assert_allclose(found / size, true / size, atol=tolerance, rtol=0)
    counts = [kernels.IN_VIEW, kernels.READINGS, kernels.AGREEING]
    np.testing.assert_array_equal(found[counts], true[counts])


@pytest.mark.parametrize("seed", range(4))
def test_a_pass_is_the_sum_over_its_points(seed: int) -> None:
    random = scene(seed)
    true = expected(random)
    in_view, readings, agreeing = true[kernels.IN_VIEW : kernels.AGREEING + 1]
    assert min(480 - in_view, in_view - readings, readings - agreeing, agreeing) > 10  # a bit of everything
    assert_equal_sums(random.sums(), true, 1e-5)


@pytest.mark.parametrize(
    "name", ["gain", "offset", "color_scale", "depth_scale", "gate", "depth_weight", "sigma_floor", "sigma_slope"]
)
def test_every_constant_is_where_the_kernel_looks_for_it(name: str) -> None:
    random = scene(0)
    changed = replace(random, **{name: 0.5 * getattr(random, name)})
    assert not np.allclose(changed.sums(), random.sums(), rtol=1e-4)
    assert_equal_sums(changed.sums(), expected(changed), 1e-5)


def test_one_point_at_a_time() -> None:
    """No lane leaks into another, and none is lost: sixteen points, alone in each lane."""
    random = scene(5, 48)
    for at in range(48):
        alone = np.zeros((kernels.POINT, 16), np.float32)
        alone[:, at % 16] = random.points[:, at]
        one = replace(random, points=alone)
        np.testing.assert_allclose(one.sums(), expected(one), rtol=1e-3, atol=1e-3)


def test_nothing_becomes_not_a_number() -> None:
    """Points in the camera's centre and plane, out of view, infinitely slanted: their weight is 0, not 0 times inf."""
    random = scene(0)
    still = replace(random, T=np.eye(4))
    hard = np.zeros((kernels.POINT, 16), np.float32)
    hard[:, :8] = np.array(
        [
            [1, 1, 1e-7, 0, 0, 1, 0.5, 1],
            [0, 0, 1e-30, 0, 0, 1, 0.5, 1],
            [0, 0, -1, 0, 0, 1, 0.5, 1],
            [1e18, 0, 1, 0, 0, 1, 0.5, 1],
            [0, -1e18, 1e18, 0, 0, 1, 0.5, 1],
            [1e9, 1e9, -1e9, 1, 0, 0, 0.5, 1],
            [0, 0, 1.5, 0, 0, 0, 0.5, 1],
            [0, 0, 1.5, 1, 0, 0, 0.5, 1],
        ],
        np.float32,
    ).T
    out = hard.copy()
    out[:, 6:] = 0
    assert not replace(still, points=out).sums().any()
    assert np.isfinite(replace(still, points=hard).sums()).all()
    backed = np.eye(4)
    backed[2, 3] = -1.5  # the last two points now lie in the camera's plane
    assert not replace(still, points=hard, T=backed).sums()[kernels.IN_VIEW]
    assert np.isfinite(replace(still, points=hard, T=backed).sums()).all()


def test_no_points() -> None:
    assert not replace(scene(0), points=np.zeros((kernels.POINT, 0), np.float32)).sums().any()
    ahead = np.eye(4)
    ahead[2, 3] = 1.5  # where the reference camera's centre is in view
    assert not replace(scene(0), points=np.zeros((kernels.POINT, 64), np.float32), T=ahead).sums().any()


def test_long_sums_keep_their_digits() -> None:
    """Two hundred thousand points in one pass are as exact as passes of sixteen, added in float64."""
    random = scene(1, 2048)
    many = replace(random, points=np.tile(random.points, 100))
    vectors = [random.points[:, k : k + 16].copy() for k in range(0, 2048, 16)]
    pieces = np.stack([replace(random, points=vector).sums() for vector in vectors])
    assert_equal_sums(many.sums() / 100, pieces.sum(axis=0), 2e-7)


def test_the_same_bits_every_time_and_on_every_thread() -> None:
    random = scene(2, 2048)
    with ThreadPoolExecutor(4) as threads:
        sums = [future.result() for future in [threads.submit(random.sums) for _ in range(12)]]
    for other in sums:
        np.testing.assert_array_equal(other, random.sums())


def expected_points(
    intensity: Floats, depth: Floats, weight: Floats, radius: int, stride: int
) -> list[tuple[int, int, Doubles]]:
    """Row, column and numbers of every point of a view."""
    d = depth.astype(np.float64)
    points = []
    for y in range(2, depth.shape[0] - 2, stride):
        for x in range(2, depth.shape[1] - 2, stride):
            if d[y, x] <= 0:
                continue
            ray = np.array([(x - CX) / FX, (y - CY) / FY, 1.0])
            left, right, up, down = d[y, x - radius], d[y, x + radius], d[y - radius, x], d[y + radius, x]
            jump, bend = 0.04 * radius * d[y, x], 0.015 * radius * d[y, x]
            straight = (
                min(left, right, up, down) > 0
                and max(abs(neighbour - d[y, x]) for neighbour in (left, right, up, down)) < jump
                and abs(left + right - 2 * d[y, x]) < bend
                and abs(up + down - 2 * d[y, x]) < bend
            )
            normal = np.zeros(3)
            if straight:
                along_u = d[y, x] * np.array([1 / FX, 0, 0]) + ray * (right - left) / (2 * radius)
                along_v = d[y, x] * np.array([0, 1 / FY, 0]) + ray * (down - up) / (2 * radius)
                normal = np.cross(along_v, along_u)
                normal /= np.linalg.norm(normal)
            points.append((y, x, np.array([*(ray * d[y, x]), *normal, intensity[y, x], weight[y, x]])))
    return points


@pytest.mark.parametrize(("radius", "stride"), [(1, 1), (2, 3), (2, 2), (1, 5)])
@pytest.mark.parametrize("seed", range(2))
def test_reference_points(seed: int, radius: int, stride: int) -> None:
    random = scene(seed)
    weight = np.random.default_rng(seed).random((HEIGHT, WIDTH), np.float32)
    points = pyramids.points(random.intensity, random.depth, weight, SEEN_BY, radius, stride)
    assert points.shape[1] % 16 == 0
    found = points[:, points[kernels.PZ] != 0]
    true = expected_points(random.intensity, random.depth, weight, radius, stride)
    assert found.shape[1] == len(true)
    np.testing.assert_allclose(found.T, np.stack([numbers for _, _, numbers in true]), atol=3e-6)
    with_normal = np.abs(found[kernels.NX : kernels.REFERENCE]).max(axis=0) > 0
    assert 0.3 < with_normal.mean() < 0.95


@pytest.mark.parametrize("size", [(3, 40), (5, 5), (6, 21), (40, 4)])
def test_reference_points_of_small_pictures(size: tuple[int, int]) -> None:
    depth = np.full(size, 2.0, np.float32)
    points = pyramids.points(depth, depth, depth, SEEN_BY, 1, 1)
    assert np.count_nonzero(points[kernels.PZ]) == max(size[0] - 4, 0) * max(size[1] - 4, 0)


def test_what_a_pass_samples() -> None:
    random = scene(3)
    live = pyramids.sampled(random.intensity, random.depth)[1:-1, 1:-1]
    image = random.intensity
    np.testing.assert_array_equal(live[..., 0], image[1:-1, 1:-1])
    np.testing.assert_allclose(live[..., 1], (image[1:-1, 2:] - image[1:-1, :-2]) / 2, rtol=1e-6)
    np.testing.assert_allclose(live[..., 2], (image[2:, 1:-1] - image[:-2, 1:-1]) / 2, rtol=1e-6)
    np.testing.assert_array_equal(live[..., 3], random.depth[1:-1, 1:-1])
