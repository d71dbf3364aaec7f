"""Mapping updates: better pictures, honest bookkeeping, and confidence only where it is asked for."""

import math
from collections.abc import Iterable
from dataclasses import fields, replace

import pytest
import torch
from analytic_room import CAMERA, Room, pose
from torch import Tensor

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.errors import ConfigError
from tcgsplat.geometry import se3
from tcgsplat.mapping.mapper import Mapped, Mapper
from tcgsplat.mapping.optimization import begin, self_distance
from tcgsplat.mapping.optimizer import LearningRates
from tcgsplat.mapping.seeding import IdSource, SeedingConfig
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import render_view
from tcgsplat.scene.exposure import Exposure
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.tensors import Pose

CONFIG = MapperConfig(
    seeding=SeedingConfig(recipe="surface", spacing=2, footprint=0.5, flatness=0.2, opacity=0.8, push_back=0.0),
    rates=LearningRates(means=1e-4, log_scales=5e-3, quats=1e-3, logit_opacities=0.05, sh=2.5e-3),
    iterations=6,
    first_iterations=12,
    current_share=0.4,
    color_weight=0.8,
    depth_weight=1.0,
    ssim_weight=0.2,
    isotropy_weight=0.0,
    depth_mode="planar",
    min_opacity=0.1,
    frozen_color_share=0.0,
    max_keyframes=0,
)
GUIDED = ConfidenceConfig(  # the paper's, which leaves confidence alone until an update is judged
    model="paper", guide_mapping=True, p_min=0.1, initial=0.3, doubt_weight=1.0, step_scale_min=0.8, step_scale_max=1.2
)
UNGUIDED = replace(GUIDED, guide_mapping=False)
T_SIDE = pose(0.05, 0.02, 0.0, degrees=(0, 12, 0))


def mapped(
    rasterizer: Rasterizer,
    submap: Submap | None = None,
    frame: Frame | None = None,
    T_map_cam: Pose | None = None,
    *,
    confidence: ConfidenceConfig = UNGUIDED,
    random_seed: int = 0,
    first_id: int = 1_000_000,
    **changes: object,
) -> Mapped:
    """One update: by default the first of an empty submap, with the room seen from the origin."""
    config = replace(CONFIG, **changes)  # type: ignore[arg-type]
    generator = torch.Generator().manual_seed(random_seed)
    mapper = Mapper(config, confidence, rasterizer, IdSource(first_id), generator)
    start = Submap.anchored(se3.identity(), index=0) if submap is None else submap
    T_map_cam = se3.identity() if T_map_cam is None else T_map_cam
    return mapper.optimized(mapper.grown(Keyframe(frame or Room().frame(), T_map_cam), start))


@pytest.fixture(scope="module")
def young(rasterizer: Rasterizer) -> Submap:
    """After one update, as if judged: a clock of one, everyone with a baseline."""
    submap = mapped(rasterizer, first_id=0).submap
    known = replace(submap.confidence, updates=torch.ones_like(submap.confidence.updates))
    return replace(submap, clock=1, confidence=known)


def same(a: object, b: object, names: Iterable[str] | None = None) -> bool:
    return all(torch.equal(getattr(a, n), getattr(b, n)) for n in names or [f.name for f in fields(a)])  # type: ignore[arg-type]


def psnr(submap: Submap, frame: Frame, rasterizer: Rasterizer) -> float:
    color = render_view(submap, CAMERA, submap.keyframes[-1].T_map_cam, rasterizer).color
    return -10 * math.log10(float((color - frame.color).square().mean()))


def moved(update: Mapped) -> tuple[Tensor, Tensor]:
    """How far the survivors' centres went along each axis, and their rows before."""
    rows = torch.searchsorted(update.before.ids, update.submap.gaussians.ids)
    return (update.submap.gaussians.means - update.before.means[rows]).abs(), rows


def test_a_picture_is_taken_in_as_the_map_keeps_it(room: Room, young: Submap, rasterizer: Rasterizer) -> None:
    """New surface has the same colours, however it was exposed; the picture itself is kept as it came."""
    T_new, exposure = pose(degrees=(0, 50, 0)), Exposure(0.64, 0.05)
    frame = room.frame(T_new)
    dark = replace(frame, color=exposure.applied(frame.color))
    grown = [
        Mapper(CONFIG, UNGUIDED, rasterizer, IdSource(5000), torch.Generator().manual_seed(0)).grown(keyframe, young)
        for keyframe in (Keyframe(dark, T_new, exposure), Keyframe(frame, T_new))
    ]
    balanced, plain = (each.submap.gaussians.sh[-each.seeded :] for each in grown)
    assert len(balanced) > 300
    torch.testing.assert_close(balanced, plain, atol=2e-5, rtol=0)
    torch.testing.assert_close(grown[0].frame.color, frame.color, atol=2e-6, rtol=0)
    assert torch.equal(grown[0].submap.keyframes[-1].frame.color, dark.color)


class TestOptimisation:
    def test_the_picture_gets_better_with_every_step(self, room: Room, rasterizer: Rasterizer) -> None:
        updates = [mapped(rasterizer, first_iterations=n) for n in (1, 10, 40)]
        losses = [update.loss for update in updates]
        quality = [psnr(update.submap, room.frame(), rasterizer) for update in updates]
        assert losses[0] > 1.3 * losses[1] > 1.3 * losses[2]
        assert quality[0] + 1 < quality[1] < quality[2] - 1

    def test_depth_gets_better_too(self, room: Room, rasterizer: Rasterizer) -> None:
        submap = mapped(rasterizer).submap
        bent = replace(submap, gaussians=replace(submap.gaussians, means=1.01 * submap.gaussians.means))
        after = mapped(rasterizer, bent, room.frame(), iterations=60, color_weight=0.0, ssim_weight=0.0).submap
        errors = [
            float((render_view(s, CAMERA, se3.identity(), rasterizer).depth - room.frame().depth).abs().mean())
            for s in (bent, after)
        ]
        assert errors[1] < 0.7 * errors[0]

    @pytest.mark.parametrize("depth_mode", ["composited", "expected", "planar"])
    def test_any_depth_can_be_compared(self, depth_mode: str, rasterizer: Rasterizer) -> None:
        update = mapped(rasterizer, depth_mode=depth_mode)
        assert update.loss < mapped(rasterizer, depth_mode=depth_mode, first_iterations=1).loss

    def test_older_keyframes_are_not_forgotten(self, room: Room, young: Submap, rasterizer: Rasterizer) -> None:
        """With a share for older keyframes the first view stays good while a repainted second one is learnt."""
        painted = replace(room.frame(T_SIDE), color=1 - room.frame(T_SIDE).color)
        quality = {}
        for share in (0.2, 1.0):
            update = mapped(rasterizer, young, painted, T_SIDE, iterations=30, current_share=share)
            color = render_view(update.submap, CAMERA, se3.identity(), rasterizer).color
            quality[share] = float((color - room.frame().color).abs().mean())
        assert quality[0.2] < 0.8 * quality[1.0]

    def test_frozen_colour_stays(self, rasterizer: Rasterizer) -> None:
        update = mapped(rasterizer, frozen_color_share=1.0)
        rows = moved(update)[1]
        assert torch.equal(update.submap.gaussians.sh, update.before.sh[rows])
        assert not torch.equal(update.submap.gaussians.means, update.before.means[rows])

    def test_isotropy_makes_discs_rounder(self, rasterizer: Rasterizer) -> None:
        def flatness(weight: float) -> float:
            scales = mapped(rasterizer, isotropy_weight=weight).submap.gaussians.scales
            return float((scales.amin(dim=1) / scales.amax(dim=1)).mean())

        assert flatness(100.0) > flatness(0.0)

    @pytest.mark.parametrize("what", ["depth", "valid"])
    def test_a_frame_that_shows_nothing_is_no_trouble(
        self, what: str, room: Room, young: Submap, rasterizer: Rasterizer
    ) -> None:
        frame = room.frame(T_SIDE)
        blank = replace(frame, **{what: torch.zeros_like(getattr(frame, what))})
        update = mapped(rasterizer, young, blank, T_SIDE)
        assert len(update.before) == len(young)
        assert all(getattr(update.submap.gaussians, f.name).isfinite().all() for f in fields(update.submap.gaussians))


class TestEnough:
    @pytest.mark.parametrize(("last", "steps"), [(1, 1), (2, 2), (3, 3), (4, 4), (9, 6)])
    def test_who_waits_has_the_map_after_as_many_steps_as_he_wants(
        self, last: int, steps: int, rasterizer: Rasterizer
    ) -> None:
        config = replace(CONFIG, first_iterations=6)
        mapper = Mapper(config, UNGUIDED, rasterizer, IdSource(), torch.Generator().manual_seed(0))
        grown = mapper.grown(Keyframe(Room().frame(), se3.identity()), Submap.anchored(se3.identity(), 0))
        found = mapper.optimized(grown, lambda made: made >= last).submap.gaussians

        expected = begin(grown.submap, config, UNGUIDED, rasterizer)
        expected.steps([0] * min(steps, 3))
        expected.prune()
        expected.steps([0] * (steps - 3))
        expected.prune()
        assert torch.equal(found.means, expected.submap().gaussians.means)


class TestBookkeeping:
    def test_the_first_update(self, rasterizer: Rasterizer) -> None:
        update = mapped(rasterizer, first_id=0)
        assert len(update.before) == 2400
        assert update.pruned == 2400 - len(update.submap)
        assert len(update.submap.keyframes) == 1
        assert update.submap.clock == 0  # judging ticks it
        torch.testing.assert_close(update.submap.confidence.value, torch.full((len(update.submap),), 0.3))

    def test_a_later_update_grows_where_the_view_is_new(
        self, room: Room, young: Submap, rasterizer: Rasterizer
    ) -> None:
        update = mapped(rasterizer, young, room.frame(T_SIDE, index=9), T_SIDE)
        newborn = update.before.ids >= 1_000_000
        assert 50 < int(newborn.sum()) == len(update.before) - len(young) < 1000
        assert torch.equal(update.before.ids[~newborn], young.gaussians.ids)
        assert torch.equal(update.before.means[~newborn], young.gaussians.means)
        pixels = CAMERA.project(se3.transform(se3.inverse(T_SIDE), update.before.means[newborn]))
        assert (pixels[:, 0] > 55).float().mean() > 0.9  # the camera turned to the right
        assert [keyframe.frame.index for keyframe in update.submap.keyframes] == [0, 9]
        assert torch.equal(update.submap.keyframes[-1].T_map_cam, T_SIDE)
        born = update.submap.confidence.born[update.submap.gaussians.ids >= 1_000_000]
        assert (born == young.clock).all()

    @pytest.mark.parametrize("iterations", [1, 9])  # pruned at the end only; mostly halfway
    def test_pruning_never_shifts_anothers_history(
        self, iterations: int, young: Submap, rasterizer: Rasterizer
    ) -> None:
        """Each row carries its own id, confidence and parameters, however many rows before it are dropped."""
        ids = young.gaussians.ids
        faint = torch.where(ids % 7 == 3, -1.5, young.gaussians.logit_opacities)
        marked = replace(
            young,
            gaussians=replace(young.gaussians, logit_opacities=faint),
            confidence=replace(
                young.confidence,
                value=0.1 + ids / 10_000,
                baseline=ids / 1e6,
                updates=ids.clone(),
            ),
        )
        update = mapped(rasterizer, marked, Room().frame(T_SIDE), T_SIDE, min_opacity=0.5, iterations=iterations)
        after, state = update.submap.gaussians, update.submap.confidence
        assert update.pruned > 200
        assert (after.opacities >= 0.5).all()
        assert len(after) == len(state) == len(update.before) - update.pruned

        old = after.ids < 1_000_000
        kept = after.ids[old]
        torch.testing.assert_close(state.value[old], 0.1 + kept / 10_000)
        torch.testing.assert_close(state.baseline[old], kept / 1e6)
        assert torch.equal(state.updates[old], kept)
        assert torch.equal(after.ids, after.ids.unique())  # sorted, each once
        by_id = young.gaussians.means[torch.searchsorted(ids, kept)]
        farthest = iterations * CONFIG.rates.means * 1.3
        assert (after.means[old] - by_id).abs().max() < farthest  # neighbours are ten times as far apart

    def test_a_map_that_fades_away_is_no_trouble(self, young: Submap, rasterizer: Rasterizer) -> None:
        update = mapped(rasterizer, young, min_opacity=0.9999)
        assert len(update.submap) == len(update.submap.confidence) == 0

    def test_keyframes_are_bounded(self, young: Submap, rasterizer: Rasterizer) -> None:
        submap = young
        for index in range(1, 5):
            T = pose(0.01 * index)
            submap = mapped(rasterizer, submap, Room().frame(T, index), T, iterations=1, max_keyframes=3).submap
        indices = [keyframe.frame.index for keyframe in submap.keyframes]
        assert len(indices) == 3 and indices[0] == 0 and indices[-1] == 4

    def test_the_submap_that_it_was_given_stays(self, young: Submap, rasterizer: Rasterizer) -> None:
        means, value = young.gaussians.means.clone(), young.confidence.value.clone()
        mapped(rasterizer, young, Room().frame(T_SIDE), T_SIDE)
        assert torch.equal(young.gaussians.means, means)
        assert torch.equal(young.confidence.value, value)
        assert len(young.keyframes) == 1


class TestRandomness:
    def test_the_same_seed_gives_the_same_bits(self, young: Submap, rasterizer: Rasterizer) -> None:
        frame = Room().frame(T_SIDE)
        a, b, c = (mapped(rasterizer, young, frame, T_SIDE, iterations=8, random_seed=s) for s in (5, 5, 6))
        assert same(a.submap.gaussians, b.submap.gaussians)
        assert not same(a.submap.gaussians, c.submap.gaussians)

    def test_only_the_choice_of_keyframes_is_random(self, young: Submap, rasterizer: Rasterizer) -> None:
        frame = Room().frame(T_SIDE)
        a, b = (mapped(rasterizer, young, frame, T_SIDE, current_share=1.0, random_seed=s) for s in (5, 6))
        assert same(a.submap.gaussians, b.submap.gaussians)


def with_confidence(submap: Submap, value: Tensor) -> Submap:
    return replace(submap, confidence=replace(submap.confidence, value=value))


class TestGuidance:
    def test_without_it_confidence_does_not_matter(self, young: Submap, rasterizer: Rasterizer) -> None:
        frame = Room().frame(T_SIDE)
        doubtful = with_confidence(young, torch.linspace(0.1, 1, len(young)))
        strange = replace(UNGUIDED, step_scale_max=9.0, stability_weight=1e3, slack_min=0.0, slack_max=0.0, initial=0.9)
        a = mapped(rasterizer, young, frame, T_SIDE, confidence=UNGUIDED)
        b = mapped(rasterizer, doubtful, frame, T_SIDE, confidence=strange)
        assert same(a.submap.gaussians, b.submap.gaussians)
        assert a.loss == b.loss
        guided = mapped(rasterizer, young, frame, T_SIDE, confidence=GUIDED)
        assert not same(a.submap.gaussians, guided.submap.gaussians)

    @pytest.mark.parametrize("doubt", [1.0, -0.8])
    def test_doubtful_pixels_count_up_to_twice_or_little(
        self, young: Submap, rasterizer: Rasterizer, doubt: float
    ) -> None:
        """Eq. 20 at the first step, before anything moves: as the paper has it, and as the default has it."""
        config = replace(GUIDED, doubt_weight=doubt)
        colour_only = {"iterations": 1, "ssim_weight": 0.0, "depth_weight": 0.0}
        for value in (1.0, 0.5, 0.1):
            submap = with_confidence(young, torch.full((len(young),), value))
            view = render_view(submap, CAMERA, se3.identity(), rasterizer)
            error = (view.color - Room().frame().color).abs().mean(dim=-1)
            expected = 0.8 * float(((1 + doubt * (1 - value * view.alpha)) * error).mean())
            found = mapped(rasterizer, submap, confidence=config, **colour_only).loss
            assert found == pytest.approx(expected, rel=1e-3)

    def test_the_certain_take_small_steps(self, young: Submap, rasterizer: Rasterizer) -> None:
        """Eq. 24: Adam's first step is the learning rate, times g: 0.8 for the certain, 1.2 at the floor."""
        value = torch.where(young.gaussians.ids % 2 == 0, 1.0, 0.1)
        update = mapped(rasterizer, with_confidence(young, value), confidence=GUIDED, iterations=1, min_opacity=0.0)
        steps = moved(update)[0]
        even = update.submap.gaussians.ids % 2 == 0
        for rows, scale in ((even, 0.8), (~even, 1.2)):
            taken = steps[rows][steps[rows] > 2e-5]
            assert len(taken) > 1000
            torch.testing.assert_close(taken, torch.full_like(taken, scale * 1e-4), rtol=5e-3, atol=3e-7)

    def test_the_papers_letter_scales_nothing(self, young: Submap, rasterizer: Rasterizer) -> None:
        value = torch.where(young.gaussians.ids % 2 == 0, 1.0, 0.1)
        literal = replace(GUIDED, step_scale_mode="gradient")
        steps = moved(
            mapped(rasterizer, with_confidence(young, value), confidence=literal, iterations=1, min_opacity=0.0)
        )[0]
        taken = steps[steps > 2e-5]
        torch.testing.assert_close(taken, torch.full_like(taken, 1e-4), rtol=5e-3, atol=3e-7)

    def test_the_stability_loss_holds_back_the_mature_and_not_the_newborn(
        self, young: Submap, rasterizer: Rasterizer
    ) -> None:
        """Eq. 23 with no slack and a heavy weight; a baseline of zero makes every move abnormal."""
        frame = replace(Room().frame(), depth=Room().frame().depth * 1.02)  # everything is asked to move
        aged = replace(young, clock=100, confidence=replace(young.confidence, baseline=torch.zeros(len(young))))
        strict = replace(GUIDED, slack_min=0.0, slack_max=0.0, stability_reduction="sum")
        newborn = replace(aged, confidence=replace(aged.confidence, born=torch.full_like(aged.confidence.born, 100)))
        fresh = replace(aged, confidence=replace(aged.confidence, updates=torch.zeros_like(aged.confidence.updates)))

        def distance(submap: Submap, weight: float, **changes: object) -> float:
            config = replace(strict, stability_weight=weight, **changes)  # type: ignore[arg-type]
            update = mapped(rasterizer, submap, frame, confidence=config, iterations=10, min_opacity=0.0)
            return float(self_distance(update.submap.gaussians, update.before, config).mean())

        assert distance(aged, 10.0) < 0.6 * distance(aged, 0.0)
        seen = int(render_view(aged, CAMERA, se3.identity(), rasterizer).visible.sum())
        mean = distance(aged, 10.0 * seen, stability_reduction="mean")  # over all in view, not only over who moved
        assert mean == pytest.approx(distance(aged, 10.0), rel=1e-3)
        assert distance(newborn, 10.0) == pytest.approx(distance(newborn, 0.0), rel=1e-6)
        assert distance(fresh, 10.0) == pytest.approx(distance(fresh, 0.0), rel=1e-6)


@pytest.mark.parametrize(
    ("setting", "value"), [("sh_degree", 4), ("sh_degree", -1), ("iterations", 0), ("first_iterations", 0)]
)
def test_settings_that_cannot_be_right_are_refused_by_name(setting: str, value: int) -> None:
    with pytest.raises(ConfigError, match=rf"mapper\..*{setting}"):
        replace(CONFIG, **{setting: value})  # type: ignore[arg-type]


@pytest.mark.parametrize("degree", [1, 3])
def test_harmonics_are_learnt(degree: int, rasterizer: Rasterizer) -> None:
    submap = Submap.anchored(se3.identity(), index=0, sh_degree=degree)
    update = mapped(rasterizer, submap, sh_degree=degree)
    assert update.submap.gaussians.sh_degree == degree
    assert update.submap.gaussians.sh[:, 1:].abs().max() > 0
