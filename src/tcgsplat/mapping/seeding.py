"""Where the map needs new Gaussians, and what they are at birth.

Two recipes: `surface` places discs on the measured surface, one for every few pixels, flat along the normal and
stretched so that they look round from where they were seen; `points` is the base system's: random pixels (more of
them where the picture has edges), round blobs as large as their neighbours are apart.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch
from torch import Tensor

from tcgsplat.errors import ConfigError
from tcgsplat.geometry import se3
from tcgsplat.mapping import seeding_kernels as kernels
from tcgsplat.render.view import Rendering
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.harmonics import SH_C0
from tcgsplat.tensors import Mask, Pose


@dataclass(frozen=True)
class SeedingConfig:
    """Where and how Gaussians are born."""

    recipe: Literal["surface", "points"] = "surface"
    """Discs on the surface [ours], or the base system's points [base]."""
    min_alpha: float = 0.6
    """Pixels covered less are unmapped. [base]"""
    opacity: float = 0.95
    """At birth: a seed is a measured surface, not a guess. [ours] (base: 0.5)"""
    push_back: float = 0.0
    """Share of the depth by which seeds are set behind the measured point. [ours] (base: 0.005)"""
    spacing: int = 2
    """`surface`: one seed for every so many pixels: 1 all, 2 a checkerboard, 4 every second row and column. [ours]"""
    footprint: float = 0.6
    """`surface`: standard deviation at birth, in pixels, for a seed at every pixel's distance; grows with the root of
    `spacing / 2`. With the renderer's blur of 0.3 px^2 a checkerboard of them is closed and still sharp. [ours]"""
    flatness: float = 0.03
    """`surface`: thickness over the smaller of the other two. The plane that a rasterizer solves for leans
    1 / (1 + (flatness / tan a)^2) times as far as the disc, seen at an angle a: with 0.2 half as far at 11 degrees.
    [ours]"""
    behind: float = 0.1
    """`surface`: a pixel whose rendered depth lies this much behind the sensor, metres, shows a new surface in front:
    twenty times the depth noise at 1.5 m. [ours]"""
    behind_medians: float = 40.0
    """`points`: the same in medians of the depth error. [base]"""
    first_points: int = 100_000
    """`points`: uniform samples of a new submap's first frame. [base: TUM]"""
    first_gradient_points: int = 50_000
    """`points`: samples by image gradient of a new submap's first frame. [base]"""
    points: int = 30_000
    """`points`: at most so many seeds in later frames; 0 for all. [base: TUM]"""

    def __post_init__(self) -> None:
        if self.recipe not in ("surface", "points"):
            raise ConfigError(f"seeding.recipe is {self.recipe!r}; choose surface or points")
        if self.spacing not in (1, 2, 4):
            raise ConfigError(f"seeding.spacing is {self.spacing!r}; choose 1, 2 or 4")
        for name in ("footprint", "flatness", "behind"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"seeding.{name} is {getattr(self, name)!r}; it must be above 0")
        if not 0 < self.opacity < 1:
            raise ConfigError(f"seeding.opacity is {self.opacity!r}; it must be above 0 and below 1")


class IdSource:
    """Unique Gaussian ids for one run."""

    def __init__(self, first: int = 0) -> None:
        self.next = first

    def take(self, count: int) -> Tensor:
        """The next `count` ids, int64."""
        ids = torch.arange(self.next, self.next + count)
        self.next += count
        return ids


def needed(frame: Frame, rendering: Rendering | None, config: SeedingConfig) -> Mask:
    """Pixels with a reading at which the map has no surface, or one that lies behind what is seen now."""
    measured = frame.valid & (frame.depth > 0)
    if rendering is None:
        return measured
    unmapped = rendering.alpha < config.min_alpha
    if config.recipe == "surface":
        hidden_by_new = (rendering.depth > 0) & (rendering.depth - frame.depth > config.behind)
    else:
        error = torch.where(frame.depth > 0, (frame.depth - rendering.composited_depth).abs(), 0.0)
        hidden_by_new = (rendering.composited_depth > frame.depth) & (error > config.behind_medians * error.median())
    return measured & (unmapped | hidden_by_new)


def seed(
    frame: Frame,
    T_map_cam: Pose,
    rendering: Rendering | None,
    existing: Gaussians,
    ids: IdSource,
    generator: torch.Generator,
    config: SeedingConfig,
) -> Gaussians:
    """New Gaussians in the map frame for what a frame shows and the map lacks, on the device of the frame.

    Args:
        frame: The frame to be mapped.
        T_map_cam: Its pose.
        rendering: The map seen from there, or None for the first frame of a submap.
        existing: The map's Gaussians (their spacing sets sizes in the `points` recipe).
        ids: Source of unique ids.
        generator: Randomness of the `points` recipe.
        config: Recipe and constants.
    """
    mask = needed(frame, rendering, config).cpu()
    frame, device = frame.cpu(), frame.color.device
    if config.recipe == "surface":
        seeds = surface_seeds(frame, T_map_cam, mask, existing.sh_degree, ids, config)
    else:
        seeds = _point_seeds(frame, T_map_cam, mask, rendering is None, existing, ids, generator, config)
    return seeds.to(device)


def surface_seeds(
    frame: Frame, T_map_cam: Pose, mask: Mask, sh_degree: int, ids: IdSource, config: SeedingConfig
) -> Gaussians:
    """Discs in the map frame on what a frame shows at the flagged pixels, which must have a depth; on the CPU.

    See the kernel `discs`.
    """
    height, width = mask.shape
    camera, depth = frame.camera, frame.depth.contiguous().numpy()
    chosen = (mask & _lattice(height, width, config.spacing)).numpy()
    n = int(np.count_nonzero(chosen))
    rays_x = ((np.arange(width) - camera.cx) / camera.fx).astype(np.float32)
    rays_y = ((np.arange(height) - camera.cy) / camera.fy).astype(np.float32)
    points = cv2.merge((rays_x * depth, rays_y[:, None] * depth, depth, (depth > 0).astype(np.float32)))
    window = (kernels.WINDOW, kernels.WINDOW)
    sums = cv2.boxFilter(points, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
    size = config.footprint * (config.spacing / 2) ** 0.5 / camera.fx
    constants = np.empty(kernels.CONSTANTS, np.float32)
    constants[kernels.PUSH_BACK] = 1 + config.push_back
    constants[kernels.LOG_SIZE], constants[kernels.LOG_FLATNESS] = np.log(size), np.log(config.flatness)
    means, log_scales, quats, sh = (np.empty((n, columns), np.float32) for columns in (3, 3, 4, 3))
    T = np.ascontiguousarray(T_map_cam.float().numpy())
    kernels.discs(
        depth, frame.color.contiguous().numpy(), chosen, sums, rays_x, rays_y, T, constants,
        means, log_scales, quats, sh,
    )  # fmt: skip
    born = [torch.from_numpy(table) for table in (means, log_scales, quats, sh)]
    return _born(*born, sh_degree=sh_degree, ids=ids, opacity=config.opacity)


def _lattice(height: int, width: int, spacing: int) -> Mask:
    v, u = torch.arange(height)[:, None], torch.arange(width)
    if spacing == 1:
        return torch.ones(height, width, dtype=torch.bool)
    if spacing == 2:
        return (u + v) % 2 == 0
    return (u % 2 == 0) & (v % 2 == 0)


def _born(
    means: Tensor, log_scales: Tensor, quats: Tensor, first_sh: Tensor, *, sh_degree: int, ids: IdSource, opacity: float
) -> Gaussians:
    n = len(means)
    sh = torch.zeros(n, (sh_degree + 1) ** 2, 3)
    sh[:, 0] = first_sh
    return Gaussians(
        ids=ids.take(n),
        means=means,
        log_scales=log_scales,
        quats=quats,
        logit_opacities=torch.full((n,), float(np.log(opacity / (1 - opacity)))),
        sh=sh,
    )


def _point_seeds(
    frame: Frame,
    T_map_cam: Pose,
    mask: Mask,
    first: bool,
    existing: Gaussians,
    ids: IdSource,
    generator: torch.Generator,
    config: SeedingConfig,
) -> Gaussians:
    from scipy.spatial import cKDTree  # noqa: PLC0415 (a tenth of the start-up, for the `points` recipe only)

    measured = frame.valid & (frame.depth > 0)
    if first:
        chosen = _first_frame_pixels(frame, generator, config) & measured
        picked = chosen.flatten().nonzero().flatten()
    else:
        candidates = mask.flatten().nonzero().flatten()
        order = torch.randperm(len(candidates), generator=generator)
        limit = config.points or len(candidates)
        picked = candidates[order[:limit]].sort().values
    points = ((frame.camera.rays() * frame.depth[..., None]).flatten(0, 1)[picked]) * (1 + config.push_back)
    means = se3.transform(T_map_cam, points)
    everything = torch.cat((existing.means.cpu(), means)).numpy()
    if len(everything) > 3:
        distances = cKDTree(everything).query(means.numpy(), k=4)[0][:, 1:]
        spread = torch.from_numpy((distances**2).mean(axis=1)).clamp_min(1e-7).sqrt()
    else:
        spread = torch.full((len(means),), 0.01)
    n = len(means)
    return _born(
        means,
        spread.log().float()[:, None].expand(n, 3),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(n, 4).clone(),
        (frame.color.flatten(0, 1)[picked] - 0.5) / SH_C0,
        sh_degree=existing.sh_degree,
        ids=ids,
        opacity=config.opacity,
    )


def _first_frame_pixels(frame: Frame, generator: torch.Generator, config: SeedingConfig) -> Mask:
    """Uniform pixels, pixels by image gradient, and all pixels on edges (the base system's new submap)."""
    gray = (frame.color @ torch.tensor([0.299, 0.587, 0.114])).numpy()
    gray_8bit = np.clip(255 * gray, 0, 255).astype(np.uint8)
    edges = cv2.dilate(cv2.Canny(gray_8bit, 100, 200, L2gradient=True), np.ones((2, 2), np.uint8)) > 0
    chosen = torch.from_numpy(edges).flatten().clone()
    uniform = torch.randperm(chosen.numel(), generator=generator)[: config.first_points]
    chosen[uniform] = True
    slope = np.hypot(cv2.Sobel(gray, cv2.CV_64F, 1, 0), cv2.Sobel(gray, cv2.CV_64F, 0, 1)).ravel()
    if config.first_gradient_points and slope.sum() > 0:
        cumulative = torch.from_numpy(np.cumsum(slope) / slope.sum())
        draws = torch.rand(config.first_gradient_points, generator=generator, dtype=torch.float64)
        chosen[torch.searchsorted(cumulative, draws).clamp_max(chosen.numel() - 1)] = True
    return chosen.reshape(gray.shape)
