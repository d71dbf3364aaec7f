"""How near a mesh comes to the true surface, and how much of it is there.

Four decisions part these figures from the published ones (NICE-SLAM, Co-SLAM, LoopSplat):

- Distances are to the nearest point of the other mesh's triangles, not to the nearest of its samples. 200 000 samples
  of an apartment of 100 m2 lie two centimetres apart, which drowns a threshold of one, and no mesh would agree with
  itself.
- What no training camera saw is not asked about: a point counts if it lies in a camera's image and nothing of its own
  mesh stands before it (the published culling, by points and rays instead of whole faces). A distance may go to what is
  left out: a mesh is not worse for coming near a true surface that nobody saw.
- Virtual views begin anywhere in the bounding box of truth and training cameras that a training camera has looked
  through: in no wall, and not outside. The published ones begin in the middle of the truth's bounding box, raised by
  40 cm, which suits Replica's rooms only, and show nothing unseen; of ours, half of what they show must have been seen.
- In a virtual view those pixels count where both meshes show something and the truth was seen. The published measure
  counts pixels without truth as well, with a depth of zero. Neither counts holes: `depth_coverage` tells of them.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float

from tcgsplat.errors import EvaluationError
from tcgsplat.evaluation import ate
from tcgsplat.geometry import quaternion, se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.mapping.fusion import FusionConfig, fused, open3d
from tcgsplat.mapping.merging import Merged
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.mesh import Mesh, Points
from tcgsplat.storage.run_directory import RunDirectory
from tcgsplat.storage.world_map import world_map
from tcgsplat.tensors import Pose

VIRTUAL = Camera(fx=300.0, fy=300.0, cx=249.5, cy=249.5, width=500, height=500)
"""The camera of Depth L1, as published."""
THRESHOLDS = (0.01, 0.05)
"""Metres: of precision, recall and F1, and of the completion ratio."""

_DRAWN = 0.125
"""Virtual views are cast at this scale: more of them tell more than more pixels of each."""
_BEFORE = 0.01
"""Metres that a point may lie behind its own mesh and count as seen: what rounding and slanted triangles need."""
_CLEAR = 0.2
"""Metres about a virtual camera without true surface; nearer than a rasterizer's near plane nobody looks."""
_ATTEMPTS = 50
"""Places for each virtual view, before the search ends."""
_SPARE = 2
"""Virtual views for each that is wanted, as some do not show enough."""
_SHOWN = 0.5
"""Share of a virtual view's pixels with true surface that must have been seen."""
_ICP_REACH, _ICP_STEPS = 0.1, 50
"""Metres, as published; and at most so many steps."""

Distances = Float[np.ndarray, " n"]
Flags = Bool[np.ndarray, " n"]


@dataclass(frozen=True)
class Views:
    """Training cameras: what they saw is what a mesh is asked about."""

    camera: Camera
    T_world_cam: Sequence[Pose]
    """In the frame of the truth."""

    def spread(self, count: int) -> "Views":
        """So many of them at most, evenly from the first to the last."""
        if len(self.T_world_cam) <= count:
            return self
        chosen = np.linspace(0, len(self.T_world_cam) - 1, count).round().astype(int)
        return Views(self.camera, [self.T_world_cam[i] for i in chosen])


@dataclass(frozen=True)
class SurfaceConfig:
    """How much is sampled."""

    points: int = 200_000
    """Of each mesh, before those that nobody saw are left out."""
    virtual_views: int = 200
    """Of Depth L1 (published: 1000 of 64 times as many pixels)."""
    training_views: int = 200
    """At most so many decide what was seen."""
    icp: bool = False
    """Fit the estimate to the truth by its surface, after the trajectories have aligned it, as the published F1 does:
    point-to-point within 10 cm. It hides what is off as a whole."""
    seed: int = 0


@dataclass(frozen=True)
class SurfaceScore:
    """Of an estimated mesh beside the true one."""

    accuracy: float
    """Metres: mean distance of the estimate from the truth."""
    completion: float
    """Metres: mean distance of the truth from the estimate."""
    precision: float
    """Share of the estimate within 1 cm of the truth."""
    recall: float
    """Share of the truth within 1 cm of the estimate: the completion ratio at 1 cm."""
    completion_ratio: float
    """Share of the truth within 5 cm of the estimate, as the papers print it."""
    depth_l1: float
    """Metres: mean over virtual views of the mean over the pixels that show both."""
    depth_coverage: float
    """Share of the pixels of virtual views with seen truth that show the estimate."""
    virtual_views: int
    """As many as could be placed."""
    seen: float
    """Share of the true surface that a training camera saw."""
    icp: float | None = None
    """Metres that ICP has moved the estimate's points, in the mean; None if it was not asked for."""

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall, both at 1 cm."""
        total = self.precision + self.recall
        return 2.0 * self.precision * self.recall / total if total > 0 else 0.0

    def rows(self) -> Mapping[str, tuple[float, str]]:
        """Figures for a report: name to value and unit. One that is not a number could not be measured."""
        return {
            "mesh_accuracy": (100.0 * self.accuracy, "cm"),
            "mesh_completion": (100.0 * self.completion, "cm"),
            "mesh_completion_ratio_5cm": (100.0 * self.completion_ratio, "%"),
            "mesh_precision_1cm": (100.0 * self.precision, "%"),
            "mesh_recall_1cm": (100.0 * self.recall, "%"),
            "mesh_f1_1cm": (100.0 * self.f1, "%"),
            "mesh_depth_l1": (100.0 * self.depth_l1, "cm"),
            "mesh_depth_coverage": (100.0 * self.depth_coverage, "%"),
        }

    def evaluated(self) -> str:
        """What the figures were measured on, in a line."""
        fit = "poses" if self.icp is None else f"poses, then ICP (moved it by {1000 * self.icp:.1f} mm)"
        return (
            f"points spread evenly, to triangles; {100 * self.seen:.0f} % of the true surface was seen by a training "
            f"camera and counts; aligned by {fit}; depth L1 over {self.virtual_views} virtual views"
        )


def surface_metrics(
    estimated: Mesh,
    truth: Mesh,
    views: Views,
    config: SurfaceConfig | None = None,
) -> SurfaceScore:
    """Score a mesh, of any system, in the frame of the truth.

    Args:
        estimated: The mesh, aligned as far as poses tell.
        truth: The true surface.
        views: The cameras that the estimate was made from, at their true poses.
        config: How.

    Raises:
        BackendUnavailableError: if Open3D cannot be imported.
        EvaluationError: if one of the meshes has no surface, or no training camera saw any of the truth.
    """
    config = config or SurfaceConfig()
    for name, mesh in (("estimated", estimated), ("true", truth)):
        if not mesh.areas.sum() > 0:
            raise EvaluationError(f"the {name} mesh has no surface; give one with triangles")
    generator = np.random.default_rng(config.seed)
    views = views.spread(config.training_views)
    true = _Surface(truth)
    asked = truth.sampled(config.points, generator)
    seen = true.seen(asked, views)
    if not seen.any():
        raise EvaluationError("no training camera saw any of the true mesh; are poses and mesh of the same frame?")
    moved, surface = None, _Surface(estimated)
    given = estimated.sampled(config.points, generator)
    given = given[surface.seen(given, views)]
    if config.icp and len(given):
        fit = _icp(given, true)
        moved = float(np.linalg.norm(fit.apply(given) - given, axis=1).mean())
        surface, given = _Surface(_fitted(estimated, fit)), fit.apply(given)
    near, far = THRESHOLDS
    off, lacking = true.distance(given), surface.distance(asked[seen])
    depth = _depth_errors(surface, true, views, config, generator)
    return SurfaceScore(
        accuracy=float(off.mean()) if len(off) else math.nan,
        completion=float(lacking.mean()),
        precision=float((off < near).mean()) if len(off) else 0.0,
        recall=float((lacking < near).mean()),
        completion_ratio=float((lacking < far).mean()),
        depth_l1=float(np.mean([l1 for l1, _ in depth if not math.isnan(l1)] or [math.nan])),
        depth_coverage=float(np.mean([coverage for _, coverage in depth] or [math.nan])),
        virtual_views=len(depth),
        seen=float(seen.mean()),
        icp=moved,
    )


def surface_of_run(
    run: RunDirectory,
    truth: Mesh,
    camera: Camera,
    T_truth_cam: Mapping[int, Pose],
    rasterizer: Rasterizer,
    *,
    whole: Merged | None = None,
    fusion: FusionConfig | None = None,
    config: SurfaceConfig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Mesh, SurfaceScore]:
    """Fuse the one map of a run and score it.

    Args:
        run: With sealed submaps.
        truth: The true surface, in the frame of the true poses.
        camera: Of the sequence.
        T_truth_cam: True pose by frame index (`Sequence.ground_truth`).
        rasterizer: Backend.
        whole: The one map of the run, if it is at hand.
        fusion: How to fuse.
        config: How to score.
        progress: Told how many views of how many are fused.

    Returns:
        The mesh, in the frame of the truth by the alignment of the trajectories, and its score.

    Raises:
        ArchiveError: if there is no sealed submap, or a file of the run is damaged.
        BackendUnavailableError: if Open3D cannot be imported.
        EvaluationError: if fewer than three frames have a true pose, or as `surface_metrics`.
    """
    estimated, true = paired_poses(run, T_truth_cam)
    fit = aligned_by_poses(estimated, true)
    whole = world_map(run, rasterizer) if whole is None else whole
    mesh = _fitted(fused(whole.submap, rasterizer, fusion, progress), fit)
    return mesh, surface_metrics(mesh, truth, Views(camera, true), config)


def paired_poses(run: RunDirectory, T_truth_cam: Mapping[int, Pose]) -> tuple[list[Pose], list[Pose]]:
    """Estimated `T_world_cam` of the frames of a run that have a true pose, and the true ones."""
    trajectory, atlas = run.trajectory()
    posed = zip(trajectory.rows, trajectory.world(atlas), strict=True)
    pairs = [(T, T_truth_cam[row.frame_index]) for row, T in posed if row.frame_index in T_truth_cam]
    return [T for T, _ in pairs], [T for _, T in pairs]


def aligned_by_poses(estimated: Sequence[Pose], truth: Sequence[Pose]) -> ate.Alignment:
    """The rigid motion that brings what cameras look at nearest to what the true ones look at, by least squares.

    Centres alone, as the trajectory error takes them, say little of a turn about a path that is nearly straight: 0.13
    cm of them were 0.3 degrees of the walls. So each camera counts with points a metre away as well.

    Args:
        estimated: `T_world_cam`, row i belongs to row i of `truth`.
        truth: The same in the frame of the truth.

    Raises:
        EvaluationError: if there are fewer than three pairs.
    """
    if len(estimated) < 3:
        raise EvaluationError(f"only {len(estimated)} poses have a true counterpart; at least 3 are needed to align")
    reach = torch.cat((torch.zeros(1, 3), torch.eye(3), -torch.eye(3))).double()
    there, here = (torch.cat([se3.transform(T, reach) for T in poses]).numpy() for poses in (estimated, truth))
    return ate.align(there, here)


def true_mesh_path(sequence: Path) -> Path | None:
    """Where the true mesh of a sequence lies, if it does: in its folder (synthetic) or beside it (Replica)."""
    places = (sequence / "mesh.ply", sequence.parent / f"{sequence.name}_mesh.ply")
    return next((place for place in places if place.is_file()), None)


class _Surface:
    """A mesh that rays can be cast at."""

    def __init__(self, mesh: Mesh) -> None:
        self._core = open3d().core
        self._scene = open3d().t.geometry.RaycastingScene()
        vertices, triangles = mesh.vertices.astype(np.float32), mesh.triangles.astype(np.uint32)
        self._scene.add_triangles(self._core.Tensor(vertices), self._core.Tensor(triangles))
        self.corners = np.stack((vertices.min(axis=0), vertices.max(axis=0)))

    def nearest(self, points: Points) -> Points:
        """The surface's nearest point to each."""
        found = self._scene.compute_closest_points(self._tensor(points))["points"].numpy()
        return np.asarray(found, dtype=np.float64)

    def distance(self, points: Points) -> Distances:
        """From the surface, metres."""
        return np.asarray(np.linalg.norm(self.nearest(points) - points, axis=1))

    def hit(self, origins: Points, rays: Points) -> Distances:
        """Multiples of each ray at which it meets the surface; infinite where it does not."""
        cast = np.concatenate((origins, rays), axis=1)
        return np.asarray(self._scene.cast_rays(self._tensor(cast))["t_hit"].numpy(), dtype=np.float64)

    def seen(self, points: Points, views: Views) -> Flags:
        """Which points lie in the image of a camera, without this surface before them."""
        found = np.zeros(len(points), dtype=bool)
        for T_world_cam in views.T_world_cam:
            asked = np.flatnonzero(~found)
            asked = asked[_in_image(points[asked], views.camera, T_world_cam)]
            found[asked] = ~self._hidden(points[asked], T_world_cam[:3, 3].numpy())
        return found

    def _hidden(self, points: Points, origin: Float[np.ndarray, "3"]) -> Flags:
        rays = points - origin
        rays = rays * np.clip(1.0 - _BEFORE / np.linalg.norm(rays, axis=1, keepdims=True).clip(1e-9), 0.0, 1.0)
        cast = np.concatenate((np.broadcast_to(origin, rays.shape), rays), axis=1)
        return np.asarray(self._scene.test_occlusions(self._tensor(cast), 0.0, 1.0).numpy(), dtype=bool)

    def _tensor(self, array: np.ndarray) -> Any:
        return self._core.Tensor(np.ascontiguousarray(array, dtype=np.float32))


def _in_image(points: Points, camera: Camera, T_world_cam: Pose) -> Flags:
    local = se3.transform(se3.inverse(T_world_cam), torch.from_numpy(points))
    ahead = local[:, 2] > 1e-3
    pixels = camera.project(torch.cat((local[:, :2], local[:, 2:].clamp_min(1e-3)), dim=1))
    return np.asarray((ahead & camera.contains(pixels)).numpy())


def _depth_errors(
    estimated: _Surface,
    truth: _Surface,
    views: Views,
    config: SurfaceConfig,
    generator: np.random.Generator,
) -> list[tuple[float, float]]:
    """Of each virtual view: mean depth difference (metres, not a number if nothing shows both), and coverage."""
    rays = VIRTUAL.scaled(_DRAWN).rays().double().flatten(0, 1)
    shots: list[tuple[Points, Points, Distances]] = []
    for T_world_cam in _virtual_poses(truth, views, _SPARE * config.virtual_views, generator):
        cast = (rays @ T_world_cam[:3, :3].T).numpy()
        origins = np.broadcast_to(T_world_cam[:3, 3].numpy(), cast.shape)
        depth = truth.hit(origins, cast)
        shown = np.isfinite(depth)
        shots.append((origins[shown], cast[shown], depth[shown]))
    if not shots:
        return []
    places = np.concatenate([origins + cast * depth[:, None] for origins, cast, depth in shots])
    seen = np.split(truth.seen(places, views), np.cumsum([len(depth) for _, _, depth in shots])[:-1])
    rows: list[tuple[float, float]] = []
    for (origins, cast, depth), counts in zip(shots, seen, strict=True):
        if len(depth) == 0 or counts.mean() < _SHOWN:
            continue
        error = np.abs(estimated.hit(origins[counts], cast[counts]) - depth[counts])
        both = np.isfinite(error)
        rows.append((float(error[both].mean()) if both.any() else math.nan, float(both.mean())))
    return rows[: config.virtual_views]


def _virtual_poses(truth: _Surface, views: Views, count: int, generator: np.random.Generator) -> list[Pose]:
    """Poses `T_world_cam` anywhere that a training camera has looked through, turned anyhow."""
    corners = np.concatenate((truth.corners, ate.positions(views.T_world_cam)))
    places = generator.uniform(corners.min(axis=0), corners.max(axis=0), (_ATTEMPTS * count, 3))
    turns = quaternion.normalize(torch.from_numpy(generator.standard_normal((_ATTEMPTS * count, 4))))
    clear = np.flatnonzero(truth.distance(places) > _CLEAR)
    chosen = clear[truth.seen(places[clear], views)][:count]
    return [se3.from_rotation_translation(quaternion.to_matrix(turns[i]), torch.from_numpy(places[i])) for i in chosen]


def _icp(points: Points, truth: _Surface) -> ate.Alignment:
    """The rigid motion that brings points nearest to the surface, by those of them that are within reach of it."""
    fit = ate.Alignment(np.eye(3), np.zeros(3))
    for _ in range(_ICP_STEPS):
        moved = fit.apply(points)
        nearest = truth.nearest(moved)
        distance = np.linalg.norm(nearest - moved, axis=1)
        within = distance < _ICP_REACH
        if within.sum() < 3:
            break
        fit = ate.align(points[within], nearest[within])
        if np.linalg.norm(fit.apply(points) - moved, axis=1).max() < 1e-5:
            break
    return fit


def _fitted(mesh: Mesh, fit: ate.Alignment) -> Mesh:
    return mesh.moved(se3.from_rotation_translation(torch.from_numpy(fit.rotation), torch.from_numpy(fit.translation)))
