"""From a map of Gaussians to a surface: depth as keyframes would see it, fused in a truncated signed distance grid.

Gaussians have no surface of their own. What they show from the keyframes has one, and where views disagree by a little
the grid takes their mean (Curless and Levoy 1996). The grid is Open3D's `VoxelBlockGrid`, which is not among what
tcgsplat always needs: it is imported when something is fused.
"""

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from tcgsplat.errors import BackendUnavailableError, ConfigError
from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import Rendering, SubmapView
from tcgsplat.scene.mesh import Mesh
from tcgsplat.scene.submap import Submap
from tcgsplat.tensors import Mask, Plane, Pose

_BLOCK = 8
"""Voxels along the edge of a block: half of Open3D's usual, as walls are thin and a block is allocated whole."""
_BLOCKS = 20_000
"""To begin with; the grid grows by itself."""

_Surface = tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"], Float[np.ndarray, "v 3"]]


@dataclass(frozen=True)
class FusionConfig:
    """How fine the surface is, and what of a view goes into it."""

    voxel_size: float = 0.01
    """Metres."""
    truncation: float = 4.0
    """Voxels on both sides of a surface that one view tells about; twice this is the thinnest wall with two sides."""
    max_depth: float = 10.0
    """Metres: what is seen from farther away does not count."""
    min_confidence: float = 0.0
    """Of a pixel, its coverage aside: what the map trusts less is left out."""
    min_views: int = 1
    """So many must have seen a place."""
    edge: float = 0.01
    """Share of its depth by which a pixel may be off the surfaces beside it: farther off it lies between two of them,
    where the picture of one runs into that of another behind it, and shows neither."""
    min_piece: int = 200
    """Vertices of the smallest piece that is kept, as LoopSplat has it: the rest floats about."""

    def __post_init__(self) -> None:
        if not (self.voxel_size > 0 and self.truncation > 0 and self.max_depth > 0):
            raise ConfigError("voxel_size, truncation and max_depth of a fusion are above 0; give larger ones")


def open3d() -> ModuleType:
    """Open3D, imported.

    Raises:
        BackendUnavailableError: if it is not installed, or cannot be loaded.
    """
    try:
        import open3d as module  # noqa: PLC0415  it takes its time, and only meshes need it
    except ModuleNotFoundError as error:
        raise BackendUnavailableError(
            f"meshes need Open3D, which is not installed ({error}); `pip install 'tcgsplat[mesh]'`, or in a checkout "
            "`pip install -c constraints.txt -e '.[mesh]'`, installs it"
        ) from error
    except (ImportError, OSError) as error:
        raise BackendUnavailableError(
            f"Open3D is installed and cannot be loaded ({error}); if a library of the system is missing: "
            "`apt install libusb-1.0-0 libegl1 libgl1`, or what your system calls these"
        ) from error
    return module


def fused(
    submap: Submap,
    rasterizer: Rasterizer,
    config: FusionConfig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Mesh:
    """The surface of a map, as it looks from its keyframes; their pictures are not looked at.

    Vertices have the map's colour and its rendered confidence divided by coverage, each the mean over the views. Their
    order is that of their coordinates, so that the same map gives the same mesh.

    Args:
        submap: With its keyframes: a submap, or the one map of a run (`storage.world_map`).
        rasterizer: Backend.
        config: How.
        progress: Told how many views of how many are fused; each is fused twice.

    Returns:
        The mesh in the submap's frame; without triangles if too little was seen.

    Raises:
        BackendUnavailableError: if Open3D cannot be imported.
    """
    config, view = config or FusionConfig(), SubmapView(submap, rasterizer)
    cameras = [(keyframe.frame.camera, keyframe.T_map_cam) for keyframe in submap.keyframes]

    def painted(paint: Callable[[Rendering], Float[torch.Tensor, "h w c"]], done: int) -> _Surface:
        """Drawn anew for each paint: a second grid at the same time would take more than drawing does."""
        grid = _Grid(config)
        for number, (camera, T_map_cam) in enumerate(cameras, start=done + 1):
            rendering = view(camera, T_map_cam)
            channels = (paint(rendering) / rendering.alpha.clamp_min(1e-3)[..., None]).clamp(0.0, 1.0)
            grid.integrate(surface_depth(rendering, config), channels.expand(-1, -1, 3), camera, T_map_cam)
            if progress is not None:
                progress(number, 2 * len(cameras))
        return grid.surface()

    vertices, triangles, colors = painted(lambda rendering: rendering.color, 0)
    _, _, confidence = painted(lambda rendering: rendering.confidence[..., None], len(cameras))
    mesh = Mesh(vertices, triangles, np.round(255.0 * colors).astype(np.uint8), confidence[:, 0])
    return _large_pieces(mesh, config.min_piece)


def surface_depth(rendering: Rendering, config: FusionConfig) -> Plane:
    """Depth of the pixels that show one surface, metres; 0 where coverage is thin, confidence low, or an edge near."""
    depth = rendering.depth
    doubtful = rendering.confidence < config.min_confidence * rendering.alpha
    return torch.where(doubtful | _between(depth, config.edge), 0.0, depth)


def _between(depth: Plane, share: float) -> Mask:
    """Pixels that belong to no surface beside them, in a row or in a column, on either side.

    Inverse depth is linear in the image over a plane, however inclined: two neighbours tell the third.
    """
    near = torch.where(depth > 0, 1.0 / depth.clamp_min(1e-3), 0.0)
    lonely = torch.zeros_like(depth, dtype=torch.bool)
    for axis in (0, 1):
        sides = [_disagreement(near, axis, way) for way in (1, -1)]
        lonely |= torch.minimum(*sides) > share * near
    return lonely


def _disagreement(near: Plane, axis: int, way: int) -> Plane:
    """Of a pixel with the next one to a side, or with the plane that the next two are of; the border has no next."""
    first, second = near.roll(way, axis), near.roll(2 * way, axis)
    off = torch.minimum((first - near).abs(), (2.0 * first - second - near).abs())
    ends = (slice(0, 2) if way > 0 else slice(-2, None),)
    off[(slice(None),) * axis + ends] = 0.0
    return off


class _Grid:
    """Signed distances with three painted channels, in blocks where there is surface."""

    def __init__(self, config: FusionConfig) -> None:
        self._o3d, self._config = open3d(), config
        core = self._o3d.core
        self._grid = self._o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"),
            (core.float32, core.float32, core.float32),
            ((1), (1), (3)),
            config.voxel_size,
            _BLOCK,
            _BLOCKS,
        )

    def integrate(self, depth: Plane, painted: Float[torch.Tensor, "h w 3"], camera: Camera, T_map_cam: Pose) -> None:
        """Take in a view: metres, and channels in [0, 1]."""
        # One point in four, for of a depth image Open3D takes one in sixteen: too few on walls that are slanted.
        seen = ((depth > 0) & (depth < self._config.max_depth))[::2, ::2]
        if not bool(seen.any()):
            return
        points = se3.transform(T_map_cam, camera.backproject(depth)[::2, ::2][seen])
        cloud = self._o3d.t.geometry.PointCloud(self._tensor(points.numpy()))
        # Open3D puts the centre of the first pixel at (0.5, 0.5).
        K = np.array([[camera.fx, 0.0, camera.cx + 0.5], [0.0, camera.fy, camera.cy + 0.5], [0.0, 0.0, 1.0]])
        intrinsics, extrinsics = self._tensor(K), self._tensor(se3.inverse(T_map_cam).numpy())
        image = self._o3d.t.geometry.Image
        planes = image(self._tensor(depth.numpy())), image(self._tensor(painted.numpy()))
        limits = 1.0, float(self._config.max_depth), float(self._config.truncation)
        blocks = self._grid.compute_unique_block_coordinates(cloud, limits[2])
        self._grid.integrate(blocks, *planes, intrinsics, extrinsics, *limits)

    def surface(self) -> _Surface:
        """Vertices (metres), triangles and channels, in the order of the coordinates: Open3D's depends on threads."""
        mesh = self._grid.extract_triangle_mesh(self._config.min_views - 0.5) if self._grid.hashmap().size() else None
        if mesh is None or "indices" not in mesh.triangle:
            return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32)
        vertices, channels = mesh.vertex.positions.numpy(), mesh.vertex.colors.numpy()
        order = np.lexsort(vertices.T)
        place = np.empty(len(order), np.int32)
        place[order] = np.arange(len(order), dtype=np.int32)
        triangles = place[mesh.triangle.indices.numpy()]
        first = triangles.argmin(axis=1)[:, None]
        triangles = np.take_along_axis(triangles, (first + np.arange(3)) % 3, axis=1)
        return vertices[order], triangles[np.lexsort(triangles.T)], channels[order]

    def _tensor(self, array: np.ndarray) -> object:
        return self._o3d.core.Tensor(np.ascontiguousarray(array))


def _large_pieces(mesh: Mesh, min_vertices: int) -> Mesh:
    """Without connected pieces of fewer vertices."""
    count, (a, b, c) = len(mesh.vertices), mesh.triangles.T
    links = coo_matrix((np.ones(2 * len(mesh), bool), (np.r_[a, b], np.r_[b, c])), shape=(count, count))
    _, piece = connected_components(links, directed=False)
    large = np.bincount(piece, minlength=1) >= min_vertices
    return mesh.kept(large[piece[a]])
