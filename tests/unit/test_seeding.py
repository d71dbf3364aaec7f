"""Where Gaussians are born, and as what."""

import math
from dataclasses import replace

import pytest
import torch
from analytic_room import CAMERA, Room, pose, rendering_of
from torch import Tensor

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.errors import ConfigError
from tcgsplat.geometry import quaternion, se3
from tcgsplat.mapping.seeding import IdSource, SeedingConfig, needed, seed
from tcgsplat.render.backends import open_rasterizer
from tcgsplat.render.view import Rendering, render_view
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.submap import Submap
from tcgsplat.tensors import Pose

SURFACE = SeedingConfig(
    recipe="surface", min_alpha=0.6, opacity=0.8, push_back=0.0, spacing=1, footprint=0.5, flatness=0.2, behind=0.1
)
POINTS = SeedingConfig(
    recipe="points",
    min_alpha=0.6,
    opacity=0.5,
    push_back=0.0,
    behind_medians=40.0,
    first_points=700,
    first_gradient_points=0,
    points=300,
)


def plane(degrees_x: float = 0.0, degrees_y: float = 0.0, distance: float = 1.5) -> tuple[Frame, Tensor]:
    """A frame of one grey plane, tilted, and the plane's normal in the camera frame."""
    normal = torch.tensor([math.tan(math.radians(degrees_x)), math.tan(math.radians(degrees_y)), -1.0]).double()
    depth = -distance / (CAMERA.rays().double() @ normal)
    shape = (CAMERA.height, CAMERA.width)
    frame = Frame(0, 0.0, torch.full((*shape, 3), 0.5), depth.float(), torch.ones(shape, dtype=torch.bool), CAMERA)
    return frame, normal / normal.norm()


def normals_of(depth: Tensor) -> Tensor:
    """Of the discs at all pixels with a reading, in the camera frame; NaN at the others."""
    frame = Frame(0, 0.0, torch.full((*depth.shape, 3), 0.5), depth, depth > 0, CAMERA)
    normals = torch.full((*depth.shape, 3), torch.nan)
    normals[depth > 0] = quaternion.to_matrix(seeded(frame, SURFACE).quats)[..., 2]
    return normals


def seeded(
    frame: Frame,
    config: SeedingConfig,
    *,
    T_map_cam: Pose | None = None,
    rendering: Rendering | None = None,
    existing: Gaussians | None = None,
    ids: IdSource | None = None,
    random_seed: int = 0,
) -> Gaussians:
    return seed(
        frame,
        se3.identity() if T_map_cam is None else T_map_cam,
        rendering,
        Gaussians.empty() if existing is None else existing,
        ids or IdSource(),
        torch.Generator().manual_seed(random_seed),
        config,
    )


def degrees_between(a: Tensor, b: Tensor) -> Tensor:
    return torch.rad2deg((a.double() * b).sum(dim=-1).clamp(-1, 1).acos())


class TestNeeded:
    def test_every_reading_where_there_is_no_map(self, room: Room) -> None:
        frame = room.frame()
        depth = frame.depth.clone()
        depth[:10] = 0.0
        valid = frame.valid.clone()
        valid[:, :5] = False
        mask = needed(replace(frame, depth=depth, valid=valid), None, SURFACE)
        assert torch.equal(mask, (depth > 0) & valid)

    @pytest.mark.parametrize("config", [SURFACE, POINTS])
    def test_nothing_where_the_map_is_complete(self, config: SeedingConfig, room: Room) -> None:
        frame = room.frame()
        assert not needed(frame, rendering_of(frame, alpha=1.0), config).any()

    @pytest.mark.parametrize("config", [SURFACE, POINTS])
    def test_what_is_not_covered(self, config: SeedingConfig, room: Room) -> None:
        frame = room.frame()
        hole = torch.zeros_like(frame.valid)
        hole[20:30, 40:60] = True
        alpha = torch.where(hole, config.min_alpha - 0.01, config.min_alpha + 0.01)
        assert torch.equal(needed(frame, rendering_of(frame, alpha=alpha), config), hole)

    @pytest.mark.parametrize("config", [SURFACE, POINTS])
    def test_a_new_surface_in_front_but_not_one_behind(self, config: SeedingConfig, room: Room) -> None:
        frame = room.frame()
        depth = frame.depth + 0.001  # for a median that is not zero
        depth[10:20, 10:20] -= 0.3
        depth[40:50, 50:60] += 0.3
        front = torch.zeros_like(frame.valid)
        front[10:20, 10:20] = True
        assert torch.equal(needed(replace(frame, depth=depth), rendering_of(frame, alpha=1.0), config), front)

    def test_nothing_without_a_reading_or_outside_the_picture(self, room: Room) -> None:
        frame = room.frame()
        bare = rendering_of(frame, alpha=0.0)
        assert not needed(replace(frame, depth=torch.zeros_like(frame.depth)), bare, SURFACE).any()
        assert not needed(replace(frame, valid=torch.zeros_like(frame.valid)), bare, SURFACE).any()


class TestNormals:
    @pytest.mark.parametrize(("x", "y"), [(0, 0), (30, 0), (0, -45), (35, 25), (-40, 30)])
    def test_of_a_tilted_plane_up_to_the_border(self, x: float, y: float) -> None:
        frame, normal = plane(x, y)
        normals = normals_of(frame.depth)
        assert degrees_between(normals, normal)[1:-1, 1:-1].max() < 0.2
        torch.testing.assert_close(normals.norm(dim=-1), torch.ones_like(frame.depth))

    def test_beside_holes(self) -> None:
        """A window that hangs over a hole must not tilt the plane; right at a hole the viewing ray has to do."""
        frame, normal = plane(35, 25)
        hole = torch.zeros_like(frame.valid)
        hole[20:28, 30:50] = True
        off = degrees_between(normals_of(torch.where(hole, 0.0, frame.depth)), normal)
        touching = torch.nn.functional.max_pool2d(hole[None].float(), 3, stride=1, padding=1)[0] > 0
        assert off[1:-1, 1:-1][~touching[1:-1, 1:-1]].max() < 0.2

    def test_of_noisy_depth(self, generator: torch.Generator) -> None:
        frame, normal = plane(30, 10)
        noisy = frame.depth + 0.003 * torch.randn(frame.depth.shape, generator=generator)
        off = degrees_between(normals_of(noisy), normal)[1:-1, 1:-1]
        rim = torch.ones_like(off, dtype=torch.bool)
        rim[1:-1, 1:-1] = False
        raw_slope = math.degrees(0.003 * 2**0.5 / (2 * 1.5 / CAMERA.fx))  # what the noise does to one difference
        assert off.median() < 0.3 * raw_slope
        assert off[rim].median() < 0.6 * raw_slope  # where half of the window hangs over the border

    def test_do_not_smooth_over_an_edge(self) -> None:
        frame, normal = plane(20, 0)
        depth = frame.depth.clone()
        depth[:, 40:] += 0.5
        off = degrees_between(normals_of(depth)[:, 1:-1], normal)[1:-1]
        assert off[:, :38].max() < 0.2  # up to the two columns whose differences reach over the edge

    def test_face_the_camera_wherever_they_are_known(self, room: Room) -> None:
        normals = normals_of(room.frame(pose(degrees=(20, 70, 5))).depth)
        assert ((normals * CAMERA.rays()).sum(dim=-1) < 0).all()


def disc(frame: Frame, T_map_cam: Pose, v: int, u: int, config: SeedingConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, standard deviations and axes of the disc at a pixel, as the docstrings say it, in float64."""
    depth, points = frame.depth.double(), CAMERA.backproject(frame.depth.double()).double()

    def averaged(y: int, x: int) -> Tensor:
        about = slice(max(y - 2, 0), y + 3), slice(max(x - 2, 0), x + 3)
        mean = points[about][depth[about] > 0].mean(dim=0)
        return mean if abs(mean[2] - depth[y, x]) < 0.03 * depth[y, x] else points[y, x]

    ray = torch.nn.functional.normalize(CAMERA.rays().double()[v, u], dim=0)
    normal = -ray
    if 0 < v < CAMERA.height - 1 and 0 < u < CAMERA.width - 1 and (depth[v - 1 : v + 2, u - 1 : u + 2] > 0).all():
        slopes = averaged(v + 1, u) - averaged(v - 1, u), averaged(v, u + 1) - averaged(v, u - 1)
        known = torch.nn.functional.normalize(torch.linalg.cross(*slopes), dim=0)
        normal = known if -(known @ ray) > 0.15 else normal
    across = torch.linalg.cross(normal, ray)
    across = across if across.norm() > 1e-4 else torch.linalg.cross(normal, torch.tensor([0.0, 1.0, 0.0]).double())
    across = torch.nn.functional.normalize(across, dim=0)
    axes = torch.stack((torch.linalg.cross(across, normal), across, normal), dim=1)
    size = config.footprint * (config.spacing / 2) ** 0.5 * depth[v, u] / CAMERA.fx
    scales = size * torch.tensor([1 / max(float(-(normal @ ray)), 1 / 3), 1, config.flatness])
    return se3.transform(T_map_cam, (points[v, u] * (1 + config.push_back))[None])[0], scales, T_map_cam[:3, :3] @ axes


class TestSurfaceRecipe:
    def test_discs_are_what_the_formulas_say(self, generator: torch.Generator) -> None:
        """Beside holes, edges and the border, with noise, from a camera that has turned; row by row."""
        T_map_cam, config = pose(0.3, -0.2, 0.5, degrees=(20, -170, 60)), replace(SURFACE, push_back=0.01)
        frame = Room().frame(pose(degrees=(15, 40, 5)))
        depth = frame.depth + 0.002 * torch.randn(frame.depth.shape, generator=generator)
        depth[20:40, 30:32] *= 0.8
        depth[torch.rand(depth.shape, generator=generator) < 0.02] = 0.0
        frame = replace(frame, depth=depth)
        found = seeded(frame, config, T_map_cam=T_map_cam)
        pixels = (depth > 0).nonzero().tolist()
        expected = [
            torch.stack(tables)
            for tables in zip(*(disc(frame, T_map_cam, v, u, config) for v, u in pixels), strict=True)
        ]
        assert len(found) == len(pixels) > 4000
        torch.testing.assert_close(found.means.double(), expected[0], atol=1e-6, rtol=1e-6)
        axes = quaternion.to_matrix(found.quats.double())
        off = (axes - expected[2]).abs().amax(dim=(1, 2))
        assert off.quantile(0.99) < 1e-4  # beside thresholds the two may decide differently
        assert ((found.scales.double() / expected[1] - 1).abs() < 1e-3).all(dim=1).double().mean() > 0.99

    @pytest.mark.parametrize(("x", "y"), [(0, 0), (40, 0), (0, 35), (30, -30)])
    def test_discs_lie_on_the_plane_and_close_the_lattice(self, x: float, y: float) -> None:
        frame, normal = plane(x, y)
        T_map_cam = pose(0.3, -0.2, 0.5, degrees=(20, -40, 10))
        discs = seeded(frame, SURFACE, T_map_cam=T_map_cam)

        in_camera = se3.transform(se3.inverse(T_map_cam), discs.means)
        torch.testing.assert_close(in_camera, CAMERA.backproject(frame.depth).flatten(0, 1), atol=1e-5, rtol=1e-5)

        axes = T_map_cam[:3, :3].T @ quaternion.to_matrix(discs.quats.double())
        inner = torch.zeros_like(frame.valid)
        inner[1:-1, 1:-1] = True  # a pixel at the border has no neighbours to know its normal from
        inner = inner.flatten()
        assert degrees_between(axes[..., 2], normal)[inner].max() < 2

        depth = frame.depth.flatten()
        along, across, thick = (discs.scales * CAMERA.fx / depth[:, None]).unbind(dim=-1)  # in pixels
        expected = SURFACE.footprint * (SURFACE.spacing / 2) ** 0.5
        torch.testing.assert_close(across, torch.full_like(across, expected))
        torch.testing.assert_close(thick, SURFACE.flatness * across)
        ray = torch.nn.functional.normalize(CAMERA.rays().flatten(0, 1).double(), dim=-1)
        cosine = -(ray @ normal)
        stretch = (1 / cosine).clamp(1, 3).float()
        torch.testing.assert_close((along / across)[inner], stretch[inner], rtol=0.02, atol=0)
        # Stretched along the tilt: seen from the camera the first axis is foreshortened, the second is not.
        tilted = inner & (cosine < 0.9)
        across_ray = (axes[..., 1] * ray).sum(dim=-1).abs()
        assert not tilted.any() or across_ray[tilted].max() < 0.02

    @pytest.mark.parametrize(("spacing", "count"), [(1, 4800), (2, 2400), (4, 1200)])
    def test_spacing_thins_the_lattice_and_widens_the_discs(self, spacing: int, count: int) -> None:
        frame, _ = plane()
        discs = seeded(frame, replace(SURFACE, spacing=spacing))  # type: ignore[arg-type]
        assert len(discs) == count
        pixels = discs.scales[:, 1] * CAMERA.fx / 1.5
        torch.testing.assert_close(pixels, torch.full_like(pixels, 0.5 * (spacing / 2) ** 0.5))

    def test_colour_opacity_and_depth_are_those_of_the_pixel(self, room: Room) -> None:
        frame = room.frame()
        discs = seeded(frame, replace(SURFACE, push_back=0.01))
        torch.testing.assert_close(discs.colors(torch.zeros(3)), frame.color.flatten(0, 1), atol=1e-6, rtol=0)
        torch.testing.assert_close(discs.opacities, torch.full((4800,), 0.8))
        torch.testing.assert_close(discs.means[:, 2], 1.01 * frame.depth.flatten())

    def test_only_where_needed(self, room: Room) -> None:
        frame = room.frame()
        alpha = torch.ones_like(frame.depth)
        alpha[:6] = 0.0
        discs = seeded(frame, SURFACE, rendering=rendering_of(frame, alpha=alpha))
        assert len(discs) == 6 * CAMERA.width


class TestPointsRecipe:
    def test_the_first_frame_takes_its_number_and_every_edge(self) -> None:
        grey = Room(contrast=0.0).frame()
        assert len(seeded(grey, POINTS)) == 700
        stripe = grey.color.clone()
        stripe[:, 40:44] = 1.0
        edges = len(seeded(replace(grey, color=stripe), replace(POINTS, first_points=0)))
        assert 100 < edges < 0.25 * CAMERA.width * CAMERA.height

    def test_later_frames_take_at_most_their_number(self, room: Room) -> None:
        frame = room.frame()
        bare = rendering_of(frame, alpha=0.0)
        assert len(seeded(frame, POINTS, rendering=bare)) == 300
        assert len(seeded(frame, replace(POINTS, points=0), rendering=bare)) == 4800
        assert len(seeded(frame, replace(POINTS, points=10_000), rendering=bare)) == 4800

    def test_gradient_samples_go_where_the_picture_changes(self) -> None:
        frame = Room(contrast=0.0).frame()
        color = frame.color.clone()
        color[:, 50:] += 0.05 * torch.arange(30)[:, None] / 30  # a ramp, too gentle for an edge
        points = seeded(replace(frame, color=color), replace(POINTS, first_points=0, first_gradient_points=500))
        columns = CAMERA.project(points.means)[:, 0]
        assert len(points) > 100
        assert (columns > 47).all()

    def test_only_pixels_with_a_reading(self, room: Room) -> None:
        frame = room.frame()
        depth = frame.depth.clone()
        depth[:, 20:] = 0.0
        points = seeded(replace(frame, depth=depth), replace(POINTS, first_points=4800, first_gradient_points=100))
        assert len(points) == 60 * 20
        assert (points.means[:, 2] > 0).all()

    def test_round_and_as_large_as_the_neighbours_are_apart(self) -> None:
        frame, _ = plane(distance=2.0)
        points = seeded(frame, replace(POINTS, first_points=4800))
        inner = points.scales.reshape(60, 80, 3)[2:-2, 2:-2]
        x, y = 2.0 / CAMERA.fx, 2.0 / CAMERA.fy
        torch.testing.assert_close(inner, torch.full_like(inner, ((2 * y * y + x * x) / 3) ** 0.5), rtol=1e-3, atol=0)
        assert torch.equal(points.quats, torch.tensor([[1.0, 0, 0, 0]]).expand(4800, 4))

    def test_existing_gaussians_count_as_neighbours(self) -> None:
        frame, _ = plane(distance=2.0)
        everywhere = replace(POINTS, first_points=4800)
        once = seeded(frame, everywhere)
        again = seeded(frame, everywhere, existing=once)
        assert (again.scales < once.scales).all()

    def test_randomness_comes_from_the_generator_alone(self, room: Room) -> None:
        frame = room.frame()
        config = replace(POINTS, first_gradient_points=200)
        torch.manual_seed(1)
        a = seeded(frame, config, random_seed=3)
        torch.manual_seed(2)
        b, c = seeded(frame, config, random_seed=3), seeded(frame, config, random_seed=4)
        assert torch.equal(a.means, b.means)
        assert not torch.equal(a.means[:100], c.means[:100])

    def test_a_single_pixel_gets_a_finite_size(self) -> None:
        frame, _ = plane()
        depth = torch.zeros_like(frame.depth)
        depth[30, 40] = 1.0
        point = seeded(replace(frame, depth=depth), replace(POINTS, first_points=4800))
        assert len(point) == 1
        assert point.log_scales.isfinite().all()


@pytest.mark.parametrize("config", [SURFACE, POINTS])
class TestBoth:
    def test_no_depth_no_gaussians(self, config: SeedingConfig, room: Room) -> None:
        frame = room.frame()
        for unusable in (
            replace(frame, depth=torch.zeros_like(frame.depth)),
            replace(frame, depth=torch.full_like(frame.depth, math.nan)),
            replace(frame, valid=torch.zeros_like(frame.valid)),
        ):
            nothing = seeded(unusable, config)
            assert len(nothing) == 0
            assert nothing.sh.shape == (0, 1, 3)

    def test_ids_are_never_given_twice(self, config: SeedingConfig, room: Room) -> None:
        ids = IdSource()
        bunches = [seeded(room.frame(), config, ids=ids).ids for _ in range(3)]
        assert torch.equal(torch.cat(bunches), torch.arange(sum(len(bunch) for bunch in bunches)))

    def test_colour_has_the_degree_of_the_map(self, config: SeedingConfig, room: Room) -> None:
        born = seeded(room.frame(), config, existing=Gaussians.empty(sh_degree=2))
        assert born.sh.shape[1:] == (9, 3)
        assert not born.sh[:, 1:].any()


def test_ids_go_on_from_where_a_run_left_off() -> None:
    ids = IdSource(first=40)
    assert ids.take(2).tolist() == [40, 41]
    assert ids.take(0).tolist() == []
    assert ids.take(1).tolist() == [42]


@pytest.mark.parametrize(
    ("setting", "value", "reason"),
    [("recipe", "lines", "surface or points"), ("spacing", 3, "1, 2 or 4"), ("opacity", 1.0, "below 1")],
)
def test_settings_that_cannot_be_right_are_refused_by_name(setting: str, value: object, reason: str) -> None:
    with pytest.raises(ConfigError, match=rf"seeding\.{setting} .*{reason}"):
        replace(SURFACE, **{setting: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(("degrees", "nearer"), [(0, 0.0001), (45, 0.0005), (60, 0.001), (75, 0.004)])
def test_what_was_seen_near_is_where_it_was_when_seen_from_farther_and_aslant(degrees: float, nearer: float):
    """Discs are smaller than a pixel there: thick ones, or planes solved too softly, would hide what is behind them.

    With a thickness of 0.2 and a softening of 0.01 the surfaces came nearer by 0.13 to 1.2 % of their depth.
    """
    frame, normal = plane(degrees_y=degrees, distance=1.5)
    frame = replace(frame, depth=torch.where((frame.depth > 0) & (frame.depth < 5), frame.depth, 0.0))
    discs = seeded(frame, replace(SeedingConfig(), opacity=0.9))
    submap = Submap.anchored(se3.identity(), 0).grown(discs, ConfidenceConfig())
    T_map_cam = se3.identity().clone()
    T_map_cam[2, 3] = -1.5
    shown = render_view(submap, CAMERA, T_map_cam, open_rasterizer("numba")).depth
    true = (3.0 * normal[2] / (CAMERA.rays().double() @ normal)).float()
    seen = (shown > 0) & (true > 0) & (true < 6)
    assert int(seen.sum()) > 500
    assert abs(float(((shown - true) / true)[seen].median())) < nearer
