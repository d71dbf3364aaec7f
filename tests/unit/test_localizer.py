"""Where a picture stands in a map that was not made of it, and when that is not believed."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_room import Room, errors, pose

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import quaternion, se3
from tcgsplat.loop.localizer import ALIKE, Localized, Localizer
from tcgsplat.loop.settings import LoopConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.submap import Submap
from tcgsplat.tensors import Pose
from tcgsplat.tracking.settings import AlignmentConfig, TrackerConfig
from tcgsplat.tracking.tracker import Tracked

T_TRUE = pose(0.05, -0.03, 0.04, degrees=(1.5, -2.0, 1.0))
T_NEAR = T_TRUE @ pose(0.03, 0.02, -0.03, degrees=(-1.5, 1.0, 1.0))
T_FAR = T_TRUE @ pose(degrees=(0, 180, 0))


def localizer(
    rasterizer: Rasterizer, *, loop: LoopConfig | None = None, tracker: TrackerConfig | None = None
) -> Localizer:
    return Localizer(loop or LoopConfig(), tracker or TrackerConfig(), ConfidenceConfig(), rasterizer)


def noisy(frame: Frame, seed: int = 0, *, depth: float = 0.003, color: float = 0.02) -> Frame:
    generator = torch.Generator().manual_seed(seed)
    return replace(
        frame,
        depth=frame.depth * (1 + depth * torch.randn(frame.depth.shape, generator=generator)),
        color=frame.color + color * torch.randn(frame.color.shape, generator=generator),
    )


@pytest.fixture
def frame() -> Frame:
    return Room().frame(T_TRUE, 7)


class TestFound:
    def test_from_a_displaced_guess(self, frame: Frame, corner: Submap, rasterizer: Rasterizer) -> None:
        found = localizer(rasterizer).localized(frame, corner, [T_NEAR])
        assert not found.failed
        millimetres, degrees = errors(found.tracked.T_map_cam, T_TRUE)
        assert millimetres < 2
        assert degrees < 0.1
        assert 0.9 < found.tracked.coverage < 1

    def test_without_depth(self, frame: Frame, corner: Submap, rasterizer: Rasterizer) -> None:
        blind = replace(frame, depth=torch.zeros_like(frame.depth))
        found = localizer(rasterizer).localized(blind, corner, [T_NEAR])
        assert not found.failed
        assert errors(found.tracked.T_map_cam, T_TRUE)[0] < 4
        seeing = localizer(rasterizer).localized(frame, corner, [T_NEAR])
        assert np.trace(found.information) < np.trace(seeing.information)

    def test_in_another_light(self, frame: Frame, corner: Submap, rasterizer: Rasterizer) -> None:
        found = localizer(rasterizer).localized(replace(frame, color=0.6 * frame.color + 0.1), corner, [T_NEAR])
        assert not found.failed
        assert errors(found.tracked.T_map_cam, T_TRUE)[0] < 3
        assert found.tracked.exposure.gain == pytest.approx(0.6, abs=0.05)

    def test_the_map_is_left_as_it_was_and_so_is_the_answer(
        self, frame: Frame, corner: Submap, rasterizer: Rasterizer
    ) -> None:
        before = corner.gaussians.means.clone()
        a, b = (localizer(rasterizer).localized(frame, corner, [T_NEAR]) for _ in range(2))
        assert torch.equal(a.tracked.T_map_cam, b.tracked.T_map_cam)
        assert np.array_equal(a.information, b.information)
        assert torch.equal(corner.gaussians.means, before)

    def test_by_alignment_whatever_frames_are_tracked_by(
        self, frame: Frame, corner: Submap, rasterizer: Rasterizer
    ) -> None:
        """The other solver knows no information."""
        found = localizer(rasterizer, tracker=TrackerConfig(solver="descent")).localized(frame, corner, [T_NEAR])
        assert not found.failed
        assert np.linalg.eigvalsh(found.information)[0] > 0


class TestGuesses:
    def test_none_is_a_failure(self, frame: Frame, corner: Submap, rasterizer: Rasterizer) -> None:
        found = localizer(rasterizer).localized(frame, corner, [])
        assert found.failed == "no guess"
        assert found.tracked.lost
        assert found.tracked.coverage == 0
        assert np.array_equal(found.information, np.zeros((6, 6)))

    def test_the_second_is_used_where_the_first_fails(
        self, frame: Frame, corner: Submap, rasterizer: Rasterizer
    ) -> None:
        assert localizer(rasterizer).localized(frame, corner, [T_FAR]).failed
        found = localizer(rasterizer).localized(frame, corner, [T_FAR, T_NEAR])
        assert not found.failed
        assert errors(found.tracked.T_map_cam, T_TRUE)[0] < 2

    def test_what_is_not_needed_is_not_asked_for(self, frame: Frame, corner: Submap, rasterizer: Rasterizer) -> None:
        def guesses() -> Iterator[Pose]:
            yield T_NEAR
            raise AssertionError("features were asked although rendering had found the pose")

        assert not localizer(rasterizer).localized(frame, corner, guesses()).failed

    def test_the_last_failure_is_told(self, frame: Frame, corner: Submap, rasterizer: Rasterizer) -> None:
        alone = localizer(rasterizer).localized(frame, corner, [T_FAR])
        both = localizer(rasterizer).localized(frame, corner, [T_NEAR @ pose(0.4), T_FAR])
        assert alone.failed == both.failed
        assert torch.equal(both.tracked.T_map_cam, T_FAR)


class TestGates:
    """Each is passed just below, and refuses just above."""

    def test_coverage(self, corner: Submap, rasterizer: Rasterizer) -> None:
        aside = T_TRUE @ pose(degrees=(0, 20, 0))
        frame = Room().frame(aside, 7)
        found = localizer(rasterizer).localized(frame, corner, [aside])
        assert 0.3 < found.tracked.coverage < 0.9
        assert not found.failed
        for limit, passes in ((found.tracked.coverage - 0.01, True), (found.tracked.coverage + 0.01, False)):
            again = localizer(rasterizer, loop=LoopConfig(min_coverage=limit)).localized(frame, corner, [aside])
            assert (not again.failed) is passes
        assert again.failed == f"the map covers only {100 * found.tracked.coverage:.0f} % of it"

    def test_coverage_is_of_what_the_camera_saw(self, frame: Frame, corner: Submap, rasterizer: Rasterizer) -> None:
        aside = T_TRUE @ pose(degrees=(0, 20, 0))
        frame = Room().frame(aside, 7)
        half = replace(frame, valid=frame.valid & (torch.arange(frame.camera.width) > frame.camera.width // 2))
        whole, right = (localizer(rasterizer).localized(f, corner, [aside]) for f in (frame, half))
        other = replace(frame, valid=~half.valid)
        left = localizer(rasterizer).localized(other, corner, [aside])
        assert max(left.tracked.coverage, right.tracked.coverage) > whole.tracked.coverage + 0.1
        assert min(left.tracked.coverage, right.tracked.coverage) < whole.tracked.coverage - 0.1

    def test_agreement(self, frame: Frame, corner: Submap, rasterizer: Rasterizer) -> None:
        """Something that is not in the map stands before a part of the picture."""
        depth = frame.depth.clone()
        depth[:, :30] *= 0.7
        found = localizer(rasterizer).localized(replace(frame, depth=depth), corner, [T_TRUE])
        assert 0.5 < found.tracked.agreement < 0.7
        assert found.failed == f"only {100 * found.tracked.agreement:.0f} % of its depth agrees with the map"
        loop = LoopConfig(min_agreement=found.tracked.agreement - 0.01)
        assert not localizer(rasterizer, loop=loop).localized(replace(frame, depth=depth), corner, [T_TRUE]).failed

    def test_correlation(self, frame: Frame, corner: Submap, rasterizer: Rasterizer) -> None:
        spoiled = noisy(frame, color=0.2)
        found = localizer(rasterizer).localized(spoiled, corner, [T_TRUE])
        assert 0.6 < found.tracked.correlation < 0.8
        assert found.failed == f"its colours correlate by only {found.tracked.correlation:.2f} with the map's"
        loop = LoopConfig(min_correlation=found.tracked.correlation - 0.01)
        assert not localizer(rasterizer, loop=loop).localized(spoiled, corner, [T_TRUE]).failed

    def test_not_settled(self, frame: Frame, corner: Submap, rasterizer: Rasterizer) -> None:
        """One step does not reach the end of a long way."""
        hasty = TrackerConfig(alignment=AlignmentConfig(iterations=(0, 0, 1)))
        guess = T_TRUE @ pose(0.06, 0.04, -0.05, degrees=(-3.0, 3.0, 2.0))
        found = localizer(rasterizer, tracker=hasty).localized(frame, corner, [guess])
        assert found.failed.startswith("its pose is not settled: it moved on by ")

    @pytest.mark.parametrize(
        ("moved", "settled"),
        [
            (pose(0.0045), True),
            (pose(0.0055), False),
            (pose(degrees=(0, 0.25, 0)), True),
            (pose(degrees=(0, 0.32, 0)), False),
        ],
    )
    def test_settled_in_place_and_in_direction(self, moved: Pose, settled: bool, rasterizer: Rasterizer) -> None:
        objection = localizer(rasterizer)._objection(Tracked(T_TRUE), Tracked(T_TRUE @ moved))
        assert (not objection) is settled

    def test_what_the_tracker_refuses(self, frame: Frame, corner: Submap, rasterizer: Rasterizer) -> None:
        dark = replace(frame, color=torch.zeros_like(frame.color))
        found = localizer(rasterizer).localized(dark, corner, [T_NEAR])
        assert found.failed == found.tracked.lost != ""

    def test_nothing_is_known_in_an_empty_map(self, frame: Frame, rasterizer: Rasterizer) -> None:
        found = localizer(rasterizer).localized(frame, Submap.anchored(se3.identity(), 0), [T_NEAR])
        assert found.failed == "the map covers only 0 % of it"

    def test_a_picture_without_a_valid_pixel_is_nowhere(
        self, frame: Frame, corner: Submap, rasterizer: Rasterizer
    ) -> None:
        nothing = replace(frame, valid=torch.zeros_like(frame.valid))
        assert localizer(rasterizer).localized(nothing, corner, [T_TRUE]).failed


def turned(submap: Submap, T: Pose) -> Submap:
    """The same submap in another map frame, for `T_new_old`."""
    g = submap.gaussians
    q = quaternion.from_matrix(T[:3, :3]).to(g.quats)
    w, v, w2, v2 = q[0], q[1:], g.quats[:, :1], g.quats[:, 1:]
    quats = torch.cat((w * w2 - v2 @ v[:, None], w * v2 + w2 * v + torch.linalg.cross(v.expand_as(v2), v2)), dim=1)
    moved: Gaussians = replace(g, means=se3.transform(T, g.means), quats=quats)
    return replace(submap, gaussians=moved)


class TestInformation:
    def test_symmetric_and_positive(self, frame: Frame, corner: Submap, rasterizer: Rasterizer) -> None:
        information = localizer(rasterizer).localized(noisy(frame), corner, [T_NEAR]).information
        assert np.array_equal(information, information.T)
        assert np.linalg.eigvalsh(information)[0] > 0

    def test_residuals_that_are_alike_count_as_one(self, frame: Frame, corner: Submap, rasterizer: Rasterizer) -> None:
        found = localizer(rasterizer).localized(noisy(frame), corner, [T_NEAR])
        assert found.tracked.color is not None
        assert found.tracked.depth is not None
        together = found.tracked.color.H + found.tracked.depth.H
        np.testing.assert_allclose(ALIKE * found.information, together, rtol=1e-3, atol=1e-3 * np.abs(together).max())

    def test_of_a_pose_that_nobody_computed_there_is_none(self) -> None:
        assert np.array_equal(Localized(Tracked(T_TRUE), "").information, np.zeros((6, 6)))

    def test_it_is_what_the_poses_spread_by(self, frame: Frame, corner: Submap, rasterizer: Rasterizer) -> None:
        """Over noise, poses spread as the information of a left perturbation of map to camera says, in all directions
        alike, in a map whose frame is far from the camera: there, any other perturbation is another matrix."""
        T_far_map = pose(1.5, -2.0, 1.0, degrees=(40, 100, -30))
        far, locate = turned(corner, T_far_map), localizer(rasterizer)
        found = [locate.localized(noisy(frame, seed), far, [T_far_map @ T_TRUE]) for seed in range(40)]
        assert not any(one.failed for one in found)
        T_cam_map = [se3.inverse(one.tracked.T_map_cam) for one in found]
        middle = T_cam_map[0]
        for _ in range(3):
            steps = torch.stack([se3.log(T @ se3.inverse(middle)) for T in T_cam_map])
            middle = se3.exp(steps.mean(dim=0)) @ middle
        errors_left = torch.stack([se3.log(T @ se3.inverse(middle)) for T in T_cam_map]).numpy()
        errors_right = torch.stack([se3.log(se3.inverse(middle) @ T) for T in T_cam_map]).numpy()
        information = np.mean([one.information for one in found], axis=0)
        L = np.linalg.cholesky(information)
        left, right = (np.linalg.eigvalsh(L.T @ np.cov(e.T) @ L) * ALIKE for e in (errors_left, errors_right))
        assert left[-1] / left[0] < 10
        assert 0.1 < np.median(left) < 2  # noise of pixels is independent, that of a real sensor is less so
        assert right[-1] / right[0] > 100
