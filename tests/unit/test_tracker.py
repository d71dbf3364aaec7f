"""Tracking as a whole: a pose where there is one, and else a reason."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from analytic_room import CAMERA, Room, errors, pose, rendering_of
from torch import Tensor

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.errors import ConfigError
from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.protocol import Raster, Rasterizer, Splats
from tcgsplat.render.view import render_view
from tcgsplat.scene.exposure import UNCHANGED, Exposure
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Submap
from tcgsplat.tensors import Pose
from tcgsplat.tracking import pyramids
from tcgsplat.tracking.alignment import align
from tcgsplat.tracking.descent import DescentConfig
from tcgsplat.tracking.reference import reference_view
from tcgsplat.tracking.settings import AlignmentConfig, TrackerConfig
from tcgsplat.tracking.tracker import Tracker

T_TRUE = pose(0.01, -0.006, 0.012, degrees=(0.4, 0.6, -0.3))
ALIGNMENT = TrackerConfig(
    solver="alignment",
    alignment=AlignmentConfig(iterations=(4, 3, 3), stride=2),
    max_step=0.3,
    max_turn=30.0,
    min_overlap=0.1,
    min_agreement=0.3,
    min_correlation=0.6,
)
DESCENT = replace(
    ALIGNMENT,
    solver="descent",
    descent=DescentConfig(iterations=30, rotation_rate=1e-3, translation_rate=2e-3, depth_mode="planar"),
)


def tracker(rasterizer: Rasterizer, config: TrackerConfig = ALIGNMENT, **confidence: object) -> Tracker:
    return Tracker(config, ConfidenceConfig(**confidence), rasterizer)  # type: ignore[arg-type]


def noise(like: Tensor) -> Tensor:
    return torch.rand(like.shape, generator=torch.Generator().manual_seed(0))


def with_a_bad_pixel(color: Tensor) -> Tensor:
    color = color.clone()
    color[30, 40] = math.nan
    return color


UNUSABLE: dict[str, tuple[Callable[[Frame], Frame], str]] = {
    "black": (lambda f: replace(f, color=torch.zeros_like(f.color)), "correlate"),
    "white": (lambda f: replace(f, color=torch.ones_like(f.color)), "correlate"),
    "noise": (lambda f: replace(f, color=noise(f.color)), "correlate"),
    "black without depth": (
        lambda f: replace(f, color=torch.zeros_like(f.color), depth=torch.zeros_like(f.depth)),
        "correlate",
    ),
    "depth of another place": (lambda f: replace(f, depth=f.depth + 0.7), "depth agrees"),
    "another place": (lambda _: Room().frame(pose(degrees=(0, 90, 0))), ""),
    "mirror place": (lambda _: Room().frame(pose(degrees=(0, 180, 0))), ""),
    "colour is not a number": (lambda f: replace(f, color=f.color * math.nan), ""),
    "one pixel is not a number": (lambda f: replace(f, color=with_a_bad_pixel(f.color)), ""),
    "blind": (lambda f: replace(f, valid=torch.zeros_like(f.valid)), "in the picture"),
}


@pytest.mark.parametrize("config", [ALIGNMENT, DESCENT], ids=["alignment", "descent"])
def test_a_frame_is_tracked_against_the_map(
    config: TrackerConfig, room: Room, corner: Submap, rasterizer: Rasterizer
) -> None:
    tracked = tracker(rasterizer, config).track(room.frame(T_TRUE), corner, se3.identity())
    assert tracked.converged and tracked.lost == ""
    millimetres, degrees = errors(tracked.T_map_cam, T_TRUE)
    assert millimetres < 4
    assert degrees < 0.3
    R = tracked.T_map_cam[:3, :3]
    torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=torch.float64), atol=1e-12, rtol=0)
    assert tracked.overlap > 0.9 and tracked.agreement > 0.9 and tracked.correlation > 0.9
    assert 0.9 < tracked.coverage <= 1


class Counting:
    """A rasterizer that counts what it draws."""

    def __init__(self, rasterizer: Rasterizer) -> None:
        self.name, self.device, self.reserved = rasterizer.name, rasterizer.device, rasterizer.reserved
        self._rasterizer, self.drawn = rasterizer, 0

    def __call__(self, splats: Splats, camera: Camera, T_cam_map: Pose) -> Raster:
        self.drawn += 1
        return self._rasterizer(splats, camera, T_cam_map)


def test_the_map_is_drawn_again_when_the_camera_has_moved_on_or_the_map_is_another(
    room: Room, corner: Submap, rasterizer: Rasterizer
) -> None:
    counting = Counting(rasterizer)
    config = replace(ALIGNMENT, view_distance=0.02, view_angle=2.0)
    tracking, another = tracker(counting, config), replace(corner)
    wide = replace(CAMERA, fx=CAMERA.fx + 1)
    for T, submap, camera, drawn in [
        (pose(), corner, CAMERA, 1),
        (pose(0.015, 0, 0, degrees=(0, 1.5, 0)), corner, CAMERA, 1),
        (pose(0.025, 0, 0), corner, CAMERA, 2),
        (pose(0.025, 0, 0, degrees=(0, 2.5, 0)), corner, CAMERA, 3),
        (pose(0.025, 0, 0, degrees=(0, 2.5, 0)), another, CAMERA, 4),
        (pose(0.025, 0, 0, degrees=(0, 2.5, 0)), another, wide, 5),
    ]:
        tracked = tracking.track(replace(room.frame(T), camera=camera), submap, T)
        assert tracked.converged and counting.drawn == drawn, tracked.lost
        assert camera is wide or errors(tracked.T_map_cam, T)[0] < 4


def test_a_frame_is_not_lost_for_being_aligned_to_an_old_view(
    room: Room, corner: Submap, rasterizer: Rasterizer
) -> None:
    """From far away the view that was kept shows something else: the frame is tried again against a new one."""
    T_far = pose(degrees=(0, 60, 0))
    counting = Counting(rasterizer)
    tracking = tracker(counting, replace(ALIGNMENT, view_distance=10.0, view_angle=180.0))
    assert tracking.track(room.frame(), corner, se3.identity()).converged
    old = tracking.track(room.frame(T_far), corner, T_far)
    fresh = tracker(rasterizer).track(room.frame(T_far), corner, T_far)
    assert counting.drawn == 2
    assert torch.equal(old.T_map_cam, fresh.T_map_cam) and old.lost == fresh.lost


@pytest.mark.parametrize("case", UNUSABLE)
def test_an_unusable_frame_is_lost_for_a_reason_and_keeps_the_guess(
    case: str, room: Room, corner: Submap, rasterizer: Rasterizer
) -> None:
    spoil, reason = UNUSABLE[case]
    guess = T_TRUE @ pose(0.004, 0, 0)
    tracked = tracker(rasterizer).track(spoil(room.frame(T_TRUE)), corner, guess)
    assert not tracked.converged
    assert reason in tracked.lost and tracked.lost
    assert torch.equal(tracked.T_map_cam, guess)


@pytest.mark.parametrize("case", ["black", "black without depth", "colour is not a number", "depth of another place"])
def test_descent_loses_them_too(case: str, room: Room, corner: Submap, rasterizer: Rasterizer) -> None:
    tracked = tracker(rasterizer, DESCENT).track(UNUSABLE[case][0](room.frame(T_TRUE)), corner, T_TRUE)
    assert tracked.lost
    assert torch.equal(tracked.T_map_cam, T_TRUE)


def test_exposure_does_not_lose_a_frame(room: Room, corner: Submap, rasterizer: Rasterizer) -> None:
    frame = room.frame(T_TRUE)
    brighter = replace(frame, color=(1.3 * frame.color + 0.05).clamp(0, 1))
    tracked = tracker(rasterizer).track(brighter, corner, se3.identity())
    assert tracked.converged
    assert errors(tracked.T_map_cam, T_TRUE)[0] < 6


def seen_at(T_map_cam: Pose, exposure: Exposure, corner: Submap, rasterizer: Rasterizer) -> tuple[Frame, Tensor]:
    """What the map itself shows there, exposed so and not clipped; and its colours before."""
    rendering = render_view(corner, CAMERA, T_map_cam, rasterizer)
    frame = replace(Room().frame(T_map_cam), color=exposure.applied(rendering.color), depth=rendering.depth)
    return frame, rendering.color


EXPOSURES = [
    UNCHANGED, Exposure(0.7), Exposure(0.7, 0.1), Exposure(0.85, -0.05), Exposure(1.2, 0.05), Exposure(1.4, -0.1),
]  # fmt: skip


@pytest.mark.parametrize("exposure", EXPOSURES, ids=str)
def test_the_exposure_of_a_picture_of_the_map(exposure: Exposure, corner: Submap, rasterizer: Rasterizer) -> None:
    frame, before = seen_at(T_TRUE, exposure, corner, rasterizer)
    found = tracker(rasterizer).track(frame, corner, T_TRUE).exposure
    middle = float(before.mean())
    assert found.gain * middle + found.offset == pytest.approx(exposure.gain * middle + exposure.offset, abs=0.004)
    # What keeps flat pictures at a gain of 1 pulls these towards it, by a tenth, around their mean.
    assert found.gain == pytest.approx(exposure.gain, abs=0.002 + 0.12 * abs(exposure.gain - 1))
    assert (found.applied(before) - frame.color).abs().mean() < 0.001 + 0.015 * abs(exposure.gain - 1)


@pytest.mark.parametrize("exposure", EXPOSURES, ids=str)
def test_the_exposure_does_not_move_the_camera(exposure: Exposure, corner: Submap, rasterizer: Rasterizer) -> None:
    frame, before = seen_at(T_TRUE, exposure, corner, rasterizer)
    tracked = tracker(rasterizer).track(frame, corner, se3.identity())
    plain = tracker(rasterizer).track(replace(frame, color=before), corner, se3.identity())
    assert tracked.converged
    assert errors(tracked.T_map_cam, T_TRUE)[0] < 1.7 and errors(tracked.T_map_cam, T_TRUE)[1] < 0.12
    assert errors(tracked.T_map_cam, plain.T_map_cam)[0] < 0.5
    assert tracked.correlation == pytest.approx(plain.correlation, abs=0.01)
    # From 2 cm away, a view of the map is compared with a picture that was sampled between its pixels.
    assert (tracked.exposure.applied(before) - frame.color).abs().mean() < 0.008 + 0.015 * abs(exposure.gain - 1)


def test_saturated_colours_are_told_by_the_rest(corner: Submap, rasterizer: Rasterizer) -> None:
    """A gain of 1.2 makes a sixtieth of the picture white, which looks like a little less gain and some offset."""
    frame, before = seen_at(T_TRUE, Exposure(1.2), corner, rasterizer)
    assert 0.01 < float((frame.color > 1).float().mean()) < 0.05
    clipped = replace(frame, color=frame.color.clamp(0, 1))
    tracked = tracker(rasterizer).track(clipped, corner, se3.identity())
    assert errors(tracked.T_map_cam, T_TRUE)[0] < 1.7
    found = tracker(rasterizer).track(clipped, corner, T_TRUE).exposure
    assert found.gain == pytest.approx(1.2, abs=0.04)
    assert (found.applied(before).clamp(0, 1) - clipped.color).abs().mean() < 0.006


@pytest.mark.parametrize("alpha", [0.75, 0.9])
def test_only_what_is_all_but_opaque_tells_the_exposure(alpha: float) -> None:
    """Half of the view is thin: its composited colours are darker than the surface, and its divided ones lighter."""
    frame = Room().frame()
    thin = torch.zeros_like(frame.valid)
    thin[:, 40:] = True
    rendering, config = rendering_of(frame, alpha=torch.where(thin, alpha, 1.0)), AlignmentConfig()
    view = reference_view(pyramids, rendering, torch.ones_like(frame.depth), frame.camera, se3.identity(), config)
    for shown in (0.0, 0.5):  # behind the thin half, black or grey shows through
        color = torch.where(thin[..., None], alpha * frame.color + (1 - alpha) * shown, frame.color)
        found = align(replace(frame, color=color), view, se3.identity(), config)
        assert (found.exposure.gain, found.exposure.offset) == pytest.approx((1.0, 0.0), abs=0.005)


@pytest.mark.parametrize("iterations", [(5, 3, 3), (0, 3, 3), (0, 0, 3)])
def test_the_exposure_is_found_at_the_finest_level_that_has_passes(iterations: tuple[int, ...]) -> None:
    frame, exposure = Room().frame(), Exposure(0.7, 0.1)
    exposed, config = replace(frame, color=exposure.applied(frame.color)), AlignmentConfig(iterations=iterations)
    rendering, everywhere = rendering_of(frame, alpha=1.0), torch.ones_like(frame.depth)
    view = reference_view(pyramids, rendering, everywhere, frame.camera, se3.identity(), config)
    found = align(exposed, view, se3.identity(), config).exposure
    middle = float(frame.color.mean())
    assert found.gain * middle + found.offset == pytest.approx(exposure.gain * middle + exposure.offset, abs=0.01)
    assert found.gain == pytest.approx(0.7, abs=0.05)


@pytest.mark.parametrize("config", [replace(ALIGNMENT, exposure=False), DESCENT], ids=["switched off", "descent"])
def test_who_finds_no_exposure_takes_pictures_as_they_come(
    config: TrackerConfig, corner: Submap, rasterizer: Rasterizer
) -> None:
    frame, _ = seen_at(T_TRUE, Exposure(0.7, 0.1), corner, rasterizer)
    assert tracker(rasterizer, config).track(frame, corner, T_TRUE).exposure == UNCHANGED


def test_the_pose_does_not_feel_whether_the_exposure_is_told(corner: Submap, rasterizer: Rasterizer) -> None:
    frame, _ = seen_at(T_TRUE, Exposure(0.7, 0.1), corner, rasterizer)
    told, not_told = (
        tracker(rasterizer, replace(ALIGNMENT, exposure=switch)).track(frame, corner, T_TRUE)
        for switch in (True, False)
    )
    assert torch.equal(told.T_map_cam, not_told.T_map_cam)


def test_flat_walls_are_no_reason_to_be_lost(rasterizer: Rasterizer, corner: Submap) -> None:
    """A map without texture has nothing to correlate with; its depth is enough."""
    gaussians = replace(corner.gaussians, sh=torch.zeros_like(corner.gaussians.sh))
    grey = Room(contrast=0.0).frame(T_TRUE)
    tracked = tracker(rasterizer).track(grey, replace(corner, gaussians=gaussians), se3.identity())
    assert tracked.converged
    assert errors(tracked.T_map_cam, T_TRUE)[0] < 4


@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        ({"max_step": 1e-3}, "cm and"),
        ({"max_turn": 1e-2}, "cm and"),
        ({"min_overlap": 1.01}, "in the picture"),
        ({"min_agreement": 1.01}, "of the depth agrees"),
        ({"min_correlation": 1.01}, "correlate"),
    ],
)
def test_every_limit_can_lose_a_frame(
    limits: dict[str, float], reason: str, room: Room, corner: Submap, rasterizer: Rasterizer
) -> None:
    tracked = tracker(rasterizer, replace(ALIGNMENT, **limits)).track(room.frame(T_TRUE), corner, se3.identity())  # type: ignore[arg-type]
    assert reason in tracked.lost
    assert torch.equal(tracked.T_map_cam, se3.identity())
    assert tracked.exposure == UNCHANGED


def test_an_empty_submap_returns_the_guess(room: Room, rasterizer: Rasterizer) -> None:
    tracked = tracker(rasterizer).track(room.frame(), Submap.anchored(se3.identity(), index=0), T_TRUE)
    assert tracked.converged
    assert torch.equal(tracked.T_map_cam, T_TRUE)


def test_a_map_cannot_begin_without_depth(room: Room, rasterizer: Rasterizer) -> None:
    frame = room.frame()
    empty = Submap.anchored(se3.identity(), index=0)
    for hopeless in (
        replace(frame, depth=torch.zeros_like(frame.depth)),
        replace(frame, valid=torch.zeros_like(frame.valid)),
    ):
        tracked = tracker(rasterizer).track(hopeless, empty, T_TRUE)
        assert "no depth to begin one" in tracked.lost


@pytest.mark.parametrize("config", [ALIGNMENT, replace(DESCENT, descent=replace(DESCENT.descent, iterations=5))])
def test_confidence_moves_the_pose_only_where_it_guides_tracking(
    config: TrackerConfig, room: Room, corner: Submap, rasterizer: Rasterizer
) -> None:
    frame = room.frame(T_TRUE)
    half = torch.where(corner.gaussians.means[:, 0] < 0, 0.1, 1.0)
    doubtful = replace(corner, confidence=replace(corner.confidence, value=half))

    def found(submap: Submap, guide: bool) -> Tensor:
        return tracker(rasterizer, config, guide_tracking=guide).track(frame, submap, se3.identity()).T_map_cam

    assert torch.equal(found(corner, guide=False), found(doubtful, guide=False))
    assert not torch.equal(found(corner, guide=True), found(doubtful, guide=True))


def test_an_unknown_solver_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match=r"tracker\.solver is 'icp'; choose alignment or descent"):
        TrackerConfig(solver="icp")  # type: ignore[arg-type]
