"""The kernels of mapping against autograd: the same steps on the same views."""

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from analytic_room import Room, pose

from tcgsplat.confidence import equations as eq
from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.mapping.mapper import Mapper
from tcgsplat.mapping.native_optimization import NativeOptimization, covers
from tcgsplat.mapping.optimization import AutogradOptimization, Optimization
from tcgsplat.mapping.optimizer import PARAMETERS
from tcgsplat.mapping.seeding import IdSource
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.numba_cpu.rasterizer import NumbaRasterizer
from tcgsplat.scene.exposure import Exposure
from tcgsplat.scene.submap import Keyframe, Submap

CONFIDENCE = ConfidenceConfig().for_updates_of(10)
RASTERIZER = NumbaRasterizer()


@pytest.fixture(scope="module")
def submap() -> Submap:
    """Two keyframes of the room, the second one partly unseen, and Gaussians of all ages."""
    generator = torch.Generator().manual_seed(3)
    mapper = Mapper(MapperConfig(first_iterations=3), CONFIDENCE, RASTERIZER, IdSource(), generator)
    start = Submap.anchored(se3.identity(), index=0)
    first = mapper.optimized(mapper.grown(Keyframe(Room().frame(), se3.identity()), start)).submap
    T_side = pose(0.05, 0.02, 0.0, degrees=(0, 12, 0))
    side = Room().frame(T_side)
    valid = side.valid.clone()
    valid[:, -5:] = False
    n = len(first)

    def uniform(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(n, generator=generator)

    known = replace(
        first.confidence,
        value=uniform(0.1, 1.0),
        baseline=uniform(0.0, 4e-4),
        born=(uniform(0, 9)).long(),
        updates=(uniform(0, 3)).long(),
    )
    color = (side.color + 0.05 * torch.randn(side.color.shape, generator=generator)).clamp(0, 1)
    keyframes = (*first.keyframes, Keyframe(replace(side, valid=valid, color=color), T_side))
    return replace(first, clock=8, confidence=known, keyframes=keyframes)


def both(submap: Submap, config: MapperConfig, confidence: ConfidenceConfig) -> Iterator[Optimization]:
    yield AutogradOptimization(submap, config, confidence, RASTERIZER)
    yield NativeOptimization(submap, config, confidence, RASTERIZER.passes)


GUIDANCE = {
    "guided": CONFIDENCE,
    "unguided": replace(CONFIDENCE, guide_mapping=False),
    "mean": replace(CONFIDENCE, stability_reduction="mean", stability_weight=100.0),
    "strong": replace(CONFIDENCE, stability_weight=10.0, slack_min=0.0, slack_max=1e-5),
}


@pytest.mark.parametrize("depth_mode", ["composited", "expected", "planar"])
@pytest.mark.parametrize("guidance", GUIDANCE)
def test_takes_the_steps_of_autograd(submap: Submap, guidance: str, depth_mode: str) -> None:
    config = MapperConfig(depth_mode=depth_mode, min_opacity=0.952)  # type: ignore[arg-type]
    results = []
    for optimization in both(submap, config, GUIDANCE[guidance]):
        losses = []
        for step, view in enumerate((0, 1, 1)):
            if step == 1:
                optimization.prune()
            optimization.steps([view])
            losses.append(optimization.loss)
        results.append((optimization.submap(), losses))
    (slow, slow_losses), (fast, fast_losses) = results
    # Where Eq. 23 is made to dominate, each Gaussian that took a step in the other direction (below) shows in the sum.
    assert fast_losses == pytest.approx(slow_losses, rel=1e-2 if guidance == "strong" else 2e-5)
    assert len(fast) < len(submap)
    assert torch.equal(fast.gaussians.ids, slow.gaussians.ids)
    assert torch.equal(fast.confidence.value, slow.confidence.value)
    before = submap.kept(torch.isin(submap.gaussians.ids, fast.gaussians.ids)).gaussians
    for name in PARAMETERS:
        step = getattr(config.rates, name)
        old, a, b = (getattr(g, name) for g in (before, slow.gaussians, fast.gaussians))
        assert float((a - old).abs().max()) > 0.5 * step
        # Adam makes a full step of any gradient, so that a sign lost in rounding is a step in the other direction.
        assert float(((a - b).abs() < 0.02 * step).float().mean()) > (0.95 if guidance == "strong" else 0.98)


def test_unequal_exposures_are_balanced_alike(submap: Submap) -> None:
    """Both compare with the pictures as the map keeps them, and both feel it."""
    plain = submap.keyframes[1]
    exposed = replace(submap, keyframes=(submap.keyframes[0], replace(plain, exposure=Exposure(0.7, 0.05))))
    frames = tuple(replace(keyframe, frame=keyframe.balanced) for keyframe in exposed.keyframes)
    assert exposed.keyframes[1].balanced.color.max() > 1  # nor is it clipped
    by_hand = replace(submap, keyframes=tuple(replace(k, exposure=Exposure()) for k in frames))
    results = []
    for each in (exposed, by_hand, submap):
        for optimization in both(each, MapperConfig(), CONFIDENCE):
            losses = []
            for view in (0, 1, 1):
                optimization.steps([view])
                losses.append(optimization.loss)
            results.append((losses, optimization.submap().gaussians))
    (slow, slow_map), (fast, fast_map), (_, slow_by_hand), (_, fast_by_hand), (unfelt, _), _ = results
    assert fast == pytest.approx(slow, rel=2e-5)
    assert all(abs(a - b) > 0.02 * b for a, b in zip(slow[1:], unfelt[1:], strict=True))  # at view 1
    for name in PARAMETERS:
        assert torch.equal(getattr(slow_map, name), getattr(slow_by_hand, name))
        assert torch.equal(getattr(fast_map, name), getattr(fast_by_hand, name))
        agree = (getattr(slow_map, name) - getattr(fast_map, name)).abs() < 0.02 * getattr(MapperConfig().rates, name)
        assert float(agree.float().mean()) > 0.98


def test_the_self_distance_is_between_rows_of_the_same_id(submap: Submap) -> None:
    """Of the Gaussians before, some were pruned on the way: nobody may inherit another's history."""
    for optimization in both(submap, MapperConfig(min_opacity=0.952), CONFIDENCE):
        for view in (0, 1):
            optimization.steps([view])
            optimization.prune()
        after = optimization.submap().gaussians
        before = submap.gaussians.kept(torch.isin(submap.gaussians.ids, after.ids))
        assert len(after) < len(submap)
        expected = eq.self_distance(
            eq.mean_change(after.means, before.means),
            eq.scale_change(after.log_scales, before.log_scales),
            eq.rotation_change(after.quats, before.quats),
            scale_weight=CONFIDENCE.scale_change_weight,
            rotation_weight=CONFIDENCE.rotation_change_weight,
        )
        torch.testing.assert_close(optimization.self_distance(), expected, atol=2e-6, rtol=1e-4)  # rounding of Eq. 7


def test_the_same_bits_whatever_the_number_of_threads(submap: Submap) -> None:
    results = []
    for threads in (1, 2, 3):
        optimization = NativeOptimization(submap, MapperConfig(), CONFIDENCE, NumbaRasterizer(threads).passes)
        for view in (1, 0, 1):
            optimization.steps([view])
        results.append((optimization.submap().gaussians, optimization.loss))
    for gaussians, loss in results[1:]:
        assert loss == results[0][1]
        assert all(torch.equal(getattr(gaussians, name), getattr(results[0][0], name)) for name in PARAMETERS)


def test_what_is_out_of_view_stays(submap: Submap) -> None:
    away = replace(submap, keyframes=tuple(replace(k, T_map_cam=pose(degrees=(0, 180, 0))) for k in submap.keyframes))
    for optimization in both(away, MapperConfig(), CONFIDENCE):
        optimization.steps([1])
        for name in PARAMETERS:
            assert torch.equal(getattr(optimization.submap().gaussians, name), getattr(submap.gaussians, name))


def test_a_nan_in_a_picture_does_not_reach_the_map(submap: Submap) -> None:
    keyframe = submap.keyframes[0]
    color = keyframe.frame.color.clone()
    color[20, 30] = torch.nan
    broken = replace(submap, keyframes=(replace(keyframe, frame=replace(keyframe.frame, color=color)),))
    for optimization in both(broken, MapperConfig(), CONFIDENCE):
        optimization.steps([0])
        for name in PARAMETERS:
            assert bool(getattr(optimization.submap().gaussians, name).isfinite().all())


def test_what_only_autograd_knows_is_left_to_it(submap: Submap) -> None:
    assert covers(submap, MapperConfig(), CONFIDENCE)
    assert not covers(submap, MapperConfig(sh_degree=1), CONFIDENCE)
    assert not covers(submap, MapperConfig(isotropy_weight=1.0), CONFIDENCE)
    assert not covers(submap, MapperConfig(frozen_color_share=0.5), CONFIDENCE)
    assert not covers(submap, MapperConfig(), replace(CONFIDENCE, step_scale_mode="gradient"))
    keyframe = submap.keyframes[0]
    narrow = replace(keyframe, frame=replace(keyframe.frame, camera=replace(keyframe.frame.camera, width=15)))
    assert not covers(replace(submap, keyframes=(narrow,)), MapperConfig(), CONFIDENCE)


def test_asking_how_far_they_went_does_not_change_the_loss(submap: Submap) -> None:
    optimization = NativeOptimization(submap, MapperConfig(), GUIDANCE["mean"], RASTERIZER.passes)
    for view in (0, 1):
        optimization.steps([view])
    loss = optimization.loss
    optimization.self_distance()
    assert optimization.loss == loss


def test_a_width_that_is_no_multiple_of_sixteen(submap: Submap) -> None:
    border = 3

    def cropped(keyframe: Keyframe) -> Keyframe:
        frame, inner = keyframe.frame, slice(border, -border)
        images = {name: getattr(frame, name)[inner, inner] for name in ("color", "depth", "valid")}
        return replace(keyframe, frame=replace(frame, camera=frame.camera.cropped(border), **images))

    odd = replace(submap, keyframes=tuple(cropped(keyframe) for keyframe in submap.keyframes))
    losses = []
    for optimization in both(odd, MapperConfig(), CONFIDENCE):
        for view in (1, 0):
            optimization.steps([view])
            losses.append(optimization.loss)
    assert losses[2:] == pytest.approx(losses[:2], rel=2e-5)
