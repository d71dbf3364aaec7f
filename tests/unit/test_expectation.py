"""The depth error to expect of a Gaussian: of its reading, after frames not yet seen, and as confidence."""

import math
from dataclasses import fields, replace

import pytest
import torch
from analytic_room import CAMERA, Room, pose
from torch import Tensor

from tcgsplat.confidence import equations as eq
from tcgsplat.confidence import expectation
from tcgsplat.confidence.state import ConfidenceConfig, ConfidenceState, Observation
from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.mapping.mapper import Grown, Mapper, birth_error, experienced
from tcgsplat.mapping.seeding import IdSource, SeedingConfig
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import Rendering, render_view
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.tensors import Plane, Pose

CONFIG = ConfidenceConfig(
    p_min=0.1, initial=0.3, error_ref=0.02, error_max=0.5, error_memory=0.8, error_prior=4.0, noise_floor=0.001,
    noise_slope=0.002,
)  # fmt: skip
PAPER = replace(CONFIG, model="paper")
DEFAULT = ConfidenceConfig()  # which the mapped corner was made with
VGA = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)


def read_error(depth: Plane, *, noise_floor: float = 0.0, noise_slope: float = 0.0, largest: float = 0.5) -> Plane:
    return expectation.reading_error(depth, noise_floor=noise_floor, noise_slope=noise_slope, largest=largest)


class TestReading:
    @pytest.mark.parametrize(("distance", "noise"), [(0.4, 0.001), (1.4, 0.003), (4.4, 0.033), (0.0001, 0.00132)])
    def test_on_a_wall_it_is_the_sensors_noise(self, distance: float, noise: float) -> None:
        error = read_error(torch.full((5, 6), distance), noise_floor=0.001, noise_slope=0.002)
        torch.testing.assert_close(error, torch.full((5, 6), noise), atol=1e-6, rtol=1e-4)

    @pytest.mark.parametrize("gradient", [(0.0, 0.01), (0.02, 0.0), (0.01, -0.03), (-0.2, 0.2)])
    def test_where_depth_is_linear_in_the_image_the_edge_term_is_zero(self, gradient: tuple[float, float]) -> None:
        """Inside; in the outermost rows and columns half of the neighbours are missing."""
        v, u = torch.meshgrid(torch.arange(9.0), torch.arange(11.0), indexing="ij")
        error = read_error(4.0 + gradient[0] * v + gradient[1] * u)
        assert error[1:-1, 1:-1].max() < 1e-5

    @pytest.mark.parametrize("degrees", [0, 30, 60, 75])
    def test_a_slanted_plane_is_expected_to_be_off_by_far_less_than_it_falls(self, degrees: float) -> None:
        """A plane is linear in inverse depth, so the term is not zero but of second order: (step / z)^2 z."""
        slope = math.tan(math.radians(degrees))
        ray = VGA.rays()[..., 0]
        depth = 2.0 / (1 - slope * ray.clamp_max(0.2))
        inside = (slice(1, -1), slice(1, 420))
        step = depth.diff(dim=1)[1:-1, 1:420]
        error = read_error(depth)[inside]
        assert error.max() <= 2.5 * (step.square() / depth[inside]).max() + 2e-6
        assert error.max() < 0.07 * step.max() + 2e-6

    @pytest.mark.parametrize("turned", [False, True])
    def test_beside_a_step_it_is_the_steps_height(self, turned: bool) -> None:
        depth = torch.full((8, 8), 1.0)
        depth[:, 4:] = 1.3
        error = read_error(depth.T.contiguous() if turned else depth)
        error = error.T if turned else error
        torch.testing.assert_close(error[:, 3:5], torch.full((8, 2), 0.3))
        assert error[:, :3].max() == error[:, 5:].max() == 0

    def test_no_more_than_the_largest_and_that_where_nothing_was_read(self) -> None:
        depth = torch.full((6, 6), 1.0)
        depth[:, 3:] = 4.0
        depth[0, 0] = 0.0
        error = read_error(depth, largest=0.5)
        assert error[0, 0] == 0.5
        assert (error[:, 2:4] == 0.5).all()

    def test_a_hole_is_no_step(self) -> None:
        depth = torch.full((7, 7), 2.0)
        depth[3, 3] = depth[0, 0] = depth[6] = 0.0
        error = read_error(depth, largest=0.5)
        assert torch.equal(error, torch.where(depth > 0, 0.0, 0.5))

    def test_a_frame_without_any_reading(self) -> None:
        assert torch.equal(read_error(torch.zeros(4, 5), largest=0.4), torch.full((4, 5), 0.4))


class TestMemory:
    def test_an_average_over_pixels_old_ones_counting_less(self) -> None:
        error, evidence = expectation.remembered(
            torch.tensor([0.02]), torch.tensor([10.0]), torch.tensor([2.0]), torch.tensor([0.2]), memory=0.8
        )
        torch.testing.assert_close(evidence, torch.tensor([10.0]))
        torch.testing.assert_close(error, torch.tensor([(8 * 0.02 + 0.2) / 10]))

    def test_without_forgetting_it_is_the_mean_of_all(self) -> None:
        error, evidence = torch.zeros(1), torch.zeros(1)
        for each in (0.01, 0.03, 0.08):
            error, evidence = expectation.remembered(
                error, evidence, torch.tensor([2.0]), torch.tensor([2 * each]), memory=1.0
            )
        torch.testing.assert_close(error, torch.tensor([0.04]))
        torch.testing.assert_close(evidence, torch.tensor([6.0]))

    def test_what_nothing_is_known_of_believes_its_first_frame(self) -> None:
        error, evidence = expectation.remembered(
            torch.zeros(1), torch.zeros(1), torch.tensor([0.5]), torch.tensor([0.02]), memory=0.9
        )
        torch.testing.assert_close(error, torch.tensor([0.04]))
        torch.testing.assert_close(evidence, torch.tensor([0.5]))

    def test_who_is_not_drawn_stays_to_the_bit(self) -> None:
        before = torch.tensor([0.1, 0.0]), torch.tensor([3.3, 0.0])
        after = expectation.remembered(*before, torch.zeros(2), torch.zeros(2), memory=0.5)
        assert torch.equal(after[0], before[0]) and torch.equal(after[1], before[1])


def test_confidence_at_no_error_at_the_reference_and_far_off() -> None:
    p = expectation.confidence(torch.tensor([0.0, 0.02, 1e6]), error_ref=0.02, p_min=0.1)
    torch.testing.assert_close(p, torch.tensor([1.0, 0.55, 0.1]))


@pytest.mark.parametrize("error", [0.0, 0.003, 0.02, 0.5])
def test_the_error_that_makes_a_confidence(error: float) -> None:
    p = expectation.confidence(torch.tensor([error]), error_ref=0.02, p_min=0.1)
    found = expectation.expected_error(p.expand(2, 3), error_ref=0.02, p_min=0.1)
    torch.testing.assert_close(found, torch.full((2, 3), error), atol=1e-6, rtol=1e-4)


def test_any_error_makes_the_least_confidence() -> None:
    p = torch.tensor([[0.1, 0.05, 1.0]])
    assert expectation.expected_error(p, error_ref=0.02, p_min=0.1).tolist() == [[math.inf, math.inf, 0.0]]


def columns(state: ConfidenceState) -> dict[str, Tensor]:
    return {field.name: getattr(state, field.name) for field in fields(state)}


def same(a: ConfidenceState, b: ConfidenceState) -> bool:
    return all(torch.equal(x, y) for x, y in zip(columns(a).values(), columns(b).values(), strict=True))


class TestState:
    def test_born_with_the_error_of_the_reading(self) -> None:
        state = ConfidenceState.born_at(3, 2, CONFIG, expected_error=torch.tensor([0.02, 0.5]))
        torch.testing.assert_close(state.value, torch.tensor([0.55, 0.1 + 0.9 / 26]))
        torch.testing.assert_close(state.expected_error, torch.tensor([0.02, 0.5]))
        torch.testing.assert_close(state.evidence, torch.tensor([4.0, 4.0]))
        assert state.born.tolist() == [3, 3] and state.updates.tolist() == [0, 0]

    def test_of_whom_nothing_is_known_begins_at_the_initial_confidence_and_believes_the_first_frame(self) -> None:
        state = ConfidenceState.born_at(0, 2, CONFIG)
        torch.testing.assert_close(state.value, torch.tensor([0.3, 0.3]))
        assert not state.evidence.any() and not state.expected_error.any()
        seen = state.experienced(torch.tensor([0.0, 0.5]), torch.tensor([0.0, 0.01]), CONFIG)
        torch.testing.assert_close(seen.value, torch.tensor([0.3, 0.55]))

    def test_the_papers_model_knows_no_errors(self) -> None:
        error = torch.tensor([0.02, 0.5])
        born = ConfidenceState.born_at(3, 2, PAPER, expected_error=error)
        assert same(born, ConfidenceState.born_at(3, 2, PAPER))
        torch.testing.assert_close(born.value, torch.tensor([0.3, 0.3]))
        assert born.experienced(torch.ones(2), error, PAPER) is born

    def test_a_mapping_update_changes_the_history_and_not_confidence(self) -> None:
        born = ConfidenceState.born_at(0, 3, CONFIG, expected_error=torch.tensor([0.01, 0.02, 0.03]))
        observation = Observation(torch.tensor([True, True, False]), torch.tensor([1e-3, 1.0, 0.0]), torch.zeros(3))
        ours, papers = born.observed(observation, CONFIG), born.observed(observation, PAPER)
        assert torch.equal(ours.value, born.value) and not torch.equal(papers.value, born.value)
        for name in ("baseline", "born", "updates", "expected_error", "evidence"):
            assert torch.equal(getattr(ours, name), getattr(papers, name))
        assert ours.updates.tolist() == [1, 1, 0]

    def test_sealing_changes_nothing(self) -> None:
        late = ConfidenceState.born_at(50, 3, CONFIG, expected_error=torch.tensor([0.01, 0.02, 0.03]))
        assert same(late.sealed(CONFIG), late)
        expected = eq.calibrate_age(late.value, late.born, decay_time=PAPER.decay_time, p_min=PAPER.p_min)
        assert torch.equal(late.sealed(PAPER).value, expected)
        assert (expected < late.value).all()

    @pytest.mark.parametrize("model", ["constant", "shuffled"])
    def test_a_control_learns_as_ours_does_and_is_trusted_otherwise(self, model: str) -> None:
        errors, pixels = torch.tensor([0.0, 0.1, 0.2, 0.5]), torch.tensor([2.0, 0.0, 3.0, 1.0])
        config = replace(CONFIG, model=model)
        ours = ConfidenceState.born_at(0, 4, CONFIG, expected_error=errors)
        other = ConfidenceState.born_at(0, 4, config, expected_error=errors)
        for _ in range(2):
            values = ours.value[[2, 3, 0, 1]] if model == "shuffled" else torch.full((4,), config.initial)
            assert torch.equal(other.value, values)
            assert torch.equal(other.expected_error, ours.expected_error)
            ours, other = (
                state.experienced(pixels, 0.3 * pixels, one) for state, one in ((ours, CONFIG), (other, config))
            )
        assert same(other.sealed(config), other)

    def test_no_gradients_are_kept(self) -> None:
        state = ConfidenceState.born_at(0, 1, CONFIG, expected_error=torch.tensor([0.01]))
        pixels = torch.tensor([1.0], requires_grad=True)
        after = state.experienced(pixels, 0.1 * pixels, CONFIG)
        assert not any(column.requires_grad for column in columns(after).values())
        assert torch.equal(state.evidence, torch.tensor([4.0]))

    def test_rows_keep_their_types_and_stay_together(self) -> None:
        error = torch.tensor([0.01, 0.02, 0.03], dtype=torch.float64)
        state = ConfidenceState.empty().appended(ConfidenceState.born_at(0, 3, CONFIG, expected_error=error))
        state = state.kept(torch.tensor([True, False, True])).experienced(torch.ones(2), torch.zeros(2), CONFIG)
        assert state.value.dtype == state.expected_error.dtype == state.evidence.dtype == torch.float32
        torch.testing.assert_close(state.expected_error, torch.tensor([0.01, 0.03]) * 3.2 / 4.2)
        assert len(ConfidenceState.empty().experienced(torch.zeros(0), torch.zeros(0), CONFIG)) == 0


T_SIDE = pose(0.03, 0.01, -0.02, degrees=(1, 4, -2))


def grown(
    submap: Submap,
    frame: Frame,
    T_map_cam: Pose,
    rasterizer: Rasterizer,
    config: ConfidenceConfig = DEFAULT,
    known: Rendering | None = None,
) -> Grown:
    seeding = SeedingConfig(recipe="surface", spacing=1, footprint=0.5, flatness=0.2, opacity=0.9, push_back=0.0)
    settings = MapperConfig(seeding=seeding, first_iterations=20, depth_mode="planar", min_opacity=0.1, complete=False)
    mapper = Mapper(settings, config, rasterizer, IdSource(1_000_000), torch.Generator().manual_seed(0))
    return mapper.grown(Keyframe(frame, T_map_cam), submap, known)


def within(submap: Submap, T_map_cam: Pose, low: tuple[int, int], high: tuple[int, int]) -> Tensor:
    pixels = CAMERA.project(se3.transform(se3.inverse(T_map_cam), submap.gaussians.means))
    return ((pixels > torch.tensor(low)) & (pixels < torch.tensor(high))).all(dim=-1)


def shown(depth: float, error: float, opacity: float = 1.0) -> Rendering:
    """A map of one wall, by whose confidence it is off by so much."""
    alpha = torch.full((CAMERA.height, CAMERA.width), opacity)
    p = expectation.confidence(torch.tensor([error]), error_ref=CONFIG.error_ref, p_min=CONFIG.p_min)
    surface = depth * alpha
    return Rendering(torch.zeros(*alpha.shape, 3), surface, surface, alpha, p * alpha, torch.ones(0, dtype=torch.bool))


def wall(depth: float) -> Frame:
    frame = Room().frame()
    return replace(frame, depth=torch.full_like(frame.depth, depth))


class TestBirth:
    """What is expected of a reading by a map that shows, or does not show, something there."""

    OWN = 0.001 + 0.002 * 1.1**2  # at 1.5 m

    def born(self, rendering: Rendering | None) -> float:
        error = birth_error(wall(1.5), rendering, CONFIG)[5:-5, 5:-5]
        assert (error - error.mean()).abs().max() < 1e-5
        return float(error.mean())

    @pytest.mark.parametrize("rendering", [None, shown(1.5, 0.3, opacity=0.4)])
    def test_where_nothing_is_mapped_it_is_the_readings(self, rendering: Rendering | None) -> None:
        assert self.born(rendering) == pytest.approx(self.OWN, abs=1e-5)

    @pytest.mark.parametrize(
        ("known", "expected"), [(0.0, OWN), (0.03, 0.015), (0.4, 0.2), (9.0, CONFIG.error_max / 2)]
    )
    @pytest.mark.parametrize("opacity", [0.7, 1.0])
    def test_of_the_same_surface_the_map_is_believed_as_much_as_the_reading(
        self, known: float, expected: float, opacity: float
    ) -> None:
        assert self.born(shown(1.5, known, opacity)) == pytest.approx(expected, rel=1e-3)

    @pytest.mark.parametrize("known", [0.0, 0.03])
    def test_before_a_surface_it_is_how_far(self, known: float) -> None:
        assert self.born(shown(1.7, known)) == pytest.approx(0.2, rel=1e-3)
        assert self.born(shown(4.0, known)) == CONFIG.error_max

    @pytest.mark.parametrize("known", [0.0, 0.03, 0.15])
    def test_what_comes_into_sight_behind_a_surface_has_nothing_of_it(self, known: float) -> None:
        """Somebody has gone, of whom the map was in doubt or not: what he hid is not to blame."""
        assert self.born(shown(1.3, known)) == pytest.approx(self.OWN, abs=1e-5)

    def test_within_the_doubt_of_the_map_it_is_the_same_surface(self) -> None:
        assert self.born(shown(1.4, 0.15)) == pytest.approx((0.15 + 0.1) / 2, rel=1e-3)
        assert self.born(shown(1.6, 0.15)) == pytest.approx((0.15 + 0.1) / 2, rel=1e-3)


class TestFrames:
    """What a frame teaches a map that has not seen it."""

    def test_seeds_are_born_with_the_error_of_their_own_reading(self, rasterizer: Rasterizer) -> None:
        frame = Room().frame()
        depth = frame.depth.clone()
        depth[:, 40:] -= 0.1
        born = grown(Submap.anchored(se3.identity(), 0), replace(frame, depth=depth), se3.identity(), rasterizer)
        state = born.submap.confidence
        beside = within(born.submap, se3.identity(), (38, 5), (41, 55))
        away = within(born.submap, se3.identity(), (45, 5), (75, 20))
        assert beside.sum() > 80 and away.sum() > 300
        assert (state.expected_error[beside] - 0.1).abs().median() < 0.01
        assert state.expected_error[away].median() < 0.01
        assert state.value[beside].median() < 0.6 < 0.85 < state.value[away].median()
        assert (state.evidence == DEFAULT.error_prior).all()

    def test_a_new_submap_takes_over_what_the_one_before_knew(self, corner: Submap, rasterizer: Rasterizer) -> None:
        """Somebody stands before a wall that the submap before shows, and a part of that is doubtful."""
        frame, left = Room().frame(), within(corner, se3.identity(), (0, 0), (30, 60))
        somebody = torch.zeros_like(frame.valid)
        somebody[15:45, 45:65] = True
        depth = torch.where(somebody, 0.6 * frame.depth, frame.depth)
        value = torch.where(left, expectation.confidence(torch.tensor([0.05]), error_ref=0.1, p_min=0.1), 1.0)
        known = render_view(
            replace(corner, confidence=replace(corner.confidence, value=value)), CAMERA, se3.identity(), rasterizer
        )
        begun = Submap.anchored(se3.identity(), 1)
        states = [
            grown(begun, replace(frame, depth=depth), se3.identity(), rasterizer, DEFAULT, before).submap
            for before in (None, known)
        ]
        errors = [state.confidence.expected_error for state in states]
        person, wall = (within(states[0], se3.identity(), *box) for box in (((48, 18), (62, 42)), ((5, 5), (25, 55))))
        assert torch.equal(states[0].gaussians.means, states[1].gaussians.means)
        assert errors[0][person].median() < 0.01 and errors[1][person].min() > 0.2
        assert errors[0][wall].median() < 0.01 and abs(errors[1][wall].median() - 0.025) < 0.003

    def test_an_empty_map_has_nothing_to_learn(self, rasterizer: Rasterizer) -> None:
        born = grown(Submap.anchored(se3.identity(), 0), Room().frame(), se3.identity(), rasterizer)
        assert born.first and born.view is None and len(born.before) == 0
        assert experienced(born, DEFAULT) is born.submap

    def test_the_papers_model_learns_nothing_from_a_frame(self, corner: Submap, rasterizer: Rasterizer) -> None:
        update = grown(corner, Room().frame(T_SIDE), T_SIDE, rasterizer, replace(DEFAULT, model="paper"))
        assert experienced(update, replace(DEFAULT, model="paper")) is update.submap
        assert (
            update.submap.confidence.value[len(corner) :] == torch.tensor(replace(DEFAULT, model="paper").initial)
        ).all()

    def test_those_who_were_wrong_lose_and_those_who_were_right_gain(
        self, corner: Submap, rasterizer: Rasterizer
    ) -> None:
        frame = Room().frame(T_SIDE)
        patch = torch.zeros_like(frame.valid)
        patch[20:35, 30:50] = True
        wrong = replace(frame, depth=torch.where(patch, frame.depth + 0.2, frame.depth))
        update = grown(corner, wrong, T_SIDE, rasterizer)
        before = update.submap.confidence
        after = experienced(update, DEFAULT).confidence
        hit = within(update.before, T_SIDE, (32, 22), (47, 32))
        clear = within(update.before, T_SIDE, (2, 2), (77, 57)) & ~within(update.before, T_SIDE, (27, 17), (52, 37))
        n = len(corner)
        assert (after.expected_error[:n][hit] > before.expected_error[:n][hit] + 0.02).float().mean() > 0.95
        assert (after.value[:n][hit] < before.value[:n][hit]).float().mean() > 0.95
        assert after.value[:n][clear].median() > before.value[:n][clear].median()
        assert (after.evidence[:n] <= before.evidence[:n] + update.frame.depth.numel()).all()

    def test_the_newborn_learn_nothing_from_the_frame_that_they_are_made_of(
        self, corner: Submap, rasterizer: Rasterizer
    ) -> None:
        T_far = pose(0.05, 0.02, 0.0, degrees=(0, 25, 0))
        update = grown(corner, Room().frame(T_far), T_far, rasterizer)
        after, n = experienced(update, DEFAULT), len(corner)
        assert update.seeded > 300 and len(after) == n + update.seeded
        for name, column in columns(update.submap.confidence).items():
            assert torch.equal(getattr(after.confidence, name)[n:], column[n:])
        assert after.gaussians is update.submap.gaussians and after.clock == update.submap.clock

    @pytest.mark.parametrize("what", ["depth", "valid"])
    def test_without_a_reading_nothing_is_learnt(self, what: str, corner: Submap, rasterizer: Rasterizer) -> None:
        frame = Room().frame(T_SIDE)
        blind = replace(frame, **{what: torch.zeros_like(getattr(frame, what))})
        update = grown(corner, blind, T_SIDE, rasterizer)
        assert same(experienced(update, DEFAULT).confidence, update.submap.confidence)

    def test_no_error_counts_for_more_than_the_largest(self, corner: Submap, rasterizer: Rasterizer) -> None:
        frame = Room().frame(T_SIDE)
        unknown = replace(corner, confidence=replace(corner.confidence, evidence=torch.zeros(len(corner))))
        update = grown(unknown, replace(frame, depth=frame.depth + 50.0), T_SIDE, rasterizer)
        state = experienced(update, DEFAULT).confidence
        assert state.expected_error.max() <= DEFAULT.error_max * (1 + 1e-5)
        assert state.expected_error[: len(corner)].max() > 0.9 * DEFAULT.error_max

    def test_it_is_judged_before_the_frame_is_used(self, corner: Submap, rasterizer: Rasterizer) -> None:
        """Optimising towards the frame afterwards does not take back what was found."""
        frame = Room().frame(T_SIDE)
        update = grown(corner, replace(frame, depth=frame.depth * 1.05), T_SIDE, rasterizer)
        state = experienced(update, DEFAULT).confidence
        mapper = Mapper(
            MapperConfig(iterations=20, depth_mode="planar", min_opacity=0.0, complete=False),
            DEFAULT,
            rasterizer,
            IdSource(2_000_000),
            torch.Generator().manual_seed(0),
        )
        assert torch.equal(mapper.optimized(update).submap.confidence.expected_error, state.expected_error)
