"""The sentences of the paper's Sections 3.2 and 3.3 that promise something, held for all inputs: its own model."""

import math
from dataclasses import dataclass, replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tcgsplat.confidence import equations as eq
from tcgsplat.confidence.state import ConfidenceConfig, ConfidenceState, Observation
from tcgsplat.geometry import se3
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.submap import Submap

P_MIN = 0.1
unit = st.floats(0, 1)
confidence = st.floats(P_MIN, 1)
length = st.floats(0, 1)
coordinate = st.floats(-10, 10, width=32)  # a length of less than 1e-162 has no square
updates = st.integers(0, 200)
duration = st.floats(0, 200)
time = st.floats(0.5, 500)
repeatable = settings(deadline=None, derandomize=True)


def row(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def vectors(k: int) -> st.SearchStrategy[Tensor]:
    return st.lists(coordinate, min_size=k, max_size=k).map(lambda values: row(*values)[None])


quats = vectors(4).filter(lambda q: q.norm() > 1e-3)


# Section 3.2


@repeatable
@given(p=confidence, n=duration, m=duration, tau=time)
def test_eq4_decaying_twice_is_decaying_longer(p: float, n: float, m: float, tau: float) -> None:
    stepwise = eq.decay(
        eq.decay(row(p), decay_time=tau, p_min=P_MIN, elapsed=n), decay_time=tau, p_min=P_MIN, elapsed=m
    )
    torch.testing.assert_close(stepwise, eq.decay(row(p), decay_time=tau, p_min=P_MIN, elapsed=n + m))


@repeatable
@given(p=confidence, b=st.integers(0, 50), tau=time)
def test_eq16_is_the_decay_that_was_missed(p: float, b: int, tau: float) -> None:
    decayed = row(p)
    for _ in range(b):
        decayed = eq.decay(decayed, decay_time=tau, p_min=P_MIN)
    torch.testing.assert_close(eq.calibrate_age(row(p), torch.tensor([b]), decay_time=tau, p_min=P_MIN), decayed)


@repeatable
@given(p=confidence, elapsed=duration, tau=time)
def test_eq4_never_passes_the_floor_and_never_rises(p: float, elapsed: float, tau: float) -> None:
    assert P_MIN <= eq.decay(row(p), decay_time=tau, p_min=P_MIN, elapsed=elapsed).item() <= p


@repeatable
@given(a=vectors(3), b=vectors(3))
def test_eqs5_and_6_are_symmetric_and_zero_only_without_change(a: Tensor, b: Tensor) -> None:
    for change in (eq.mean_change, eq.scale_change):
        torch.testing.assert_close(change(a, b), change(b, a))
        assert change(a, a).item() == 0
    assert (eq.mean_change(a, b).item() > 0) == (not torch.equal(a, b))


@repeatable
@given(a=quats, b=quats, scale=st.floats(0.01, 100))
def test_eq7_ignores_sign_and_length(a: Tensor, b: Tensor, scale: float) -> None:
    change = eq.rotation_change(a, b)
    assert 0 <= change.item() <= 1
    for same in (-a, scale * a, -scale * a):
        torch.testing.assert_close(eq.rotation_change(same, b), change)
    torch.testing.assert_close(eq.rotation_change(-a, a), row(0.0))


@repeatable
@given(color=length, depth=length, valid=st.booleans())
def test_eq9_has_no_depth_term_without_a_reading(color: float, depth: float, valid: bool) -> None:
    R = eq.residual_map(row(color)[None], row(depth)[None], torch.tensor([[valid]]), color_weight=1.0, depth_weight=2.0)
    assert R.item() == pytest.approx(color + 2 * depth if valid else color)


@repeatable
@given(baseline=length, distance=length, scale=st.floats(1e-4, 1))
def test_eq11_is_positive_exactly_when_less_changed_than_usual(baseline: float, distance: float, scale: float) -> None:
    stability = eq.relative_stability(row(baseline), row(distance), scale=scale).item()
    assert -1 <= stability <= 1
    if abs(baseline - distance) > 1e-12:
        assert (stability > 0) == (distance < baseline)


@repeatable
@given(quality=unit, stability=st.floats(-1, 1), plus=st.floats(0, 5), minus=st.floats(0, 5))
def test_eq12_never_rewards_and_punishes_at_once(quality: float, stability: float, plus: float, minus: float) -> None:
    excitation, penalty = eq.feedback(row(quality), row(stability), excitation_gain=plus, penalty_gain=minus)
    assert excitation.item() >= 0
    assert penalty.item() >= 0
    assert excitation.item() == 0 or penalty.item() == 0


@repeatable
@given(good=unit, bad=unit, stability=st.floats(-1, 1))
def test_eq12_lets_the_residual_modulate_the_reward_only(good: float, bad: float, stability: float) -> None:
    quality = row(max(good, bad), min(good, bad))
    excitation, penalty = eq.feedback(quality, row(stability, stability), excitation_gain=1.0, penalty_gain=1.0)
    assert excitation[0] >= excitation[1]
    assert penalty[0] == penalty[1]


@repeatable
@given(p=confidence, a=st.floats(0, 1e6), b=st.floats(0, 1e6), rate=unit)
def test_eq13_never_leaves_its_bounds(p: float, a: float, b: float, rate: float) -> None:
    after = eq.apply_feedback(row(p), row(a), row(b), rate=rate, p_min=P_MIN).item()
    assert P_MIN <= after <= 1


@repeatable
@given(low=confidence, high=confidence, rate=unit)
def test_eq13_rewards_less_near_the_top_and_punishes_less_near_the_floor(low: float, high: float, rate: float) -> None:
    p = row(min(low, high), max(low, high))
    gain = eq.apply_feedback(p, row(1.0, 1.0), row(0.0, 0.0), rate=rate, p_min=P_MIN) - p
    loss = p - eq.apply_feedback(p, row(0.0, 0.0), row(1.0, 1.0), rate=rate, p_min=P_MIN)
    assert gain[0] >= gain[1] - 1e-12
    assert loss[0] <= loss[1] + 1e-12


@repeatable
@given(d=length, r=length, more_d=length, more_r=length)
def test_eq14_falls_with_distance_and_with_residual(d: float, r: float, more_d: float, more_r: float) -> None:
    a = eq.first_excitation(row(d, d + more_d, d), row(r, r, r + more_r), distance_ref=0.01, residual_ref=0.1)
    assert (a >= 0).all()
    assert (a <= 1).all()
    assert a[0] >= a[1]
    assert a[0] >= a[2]


@repeatable
@given(baseline=length, distance=length, rate=st.floats(0.01, 1))
def test_eq15_stays_between_the_old_baseline_and_the_new_distance(
    baseline: float, distance: float, rate: float
) -> None:
    after = eq.update_baseline(row(baseline), row(distance), rate=rate).item()
    assert min(baseline, distance) - 1e-12 <= after <= max(baseline, distance) + 1e-12


# Section 3.3


layers = st.lists(st.tuples(unit, confidence), min_size=1, max_size=8)


@repeatable
@given(layers=layers)
def test_eq17_is_the_sum_it_says_and_never_exceeds_alpha(layers: list[tuple[float, float]]) -> None:
    alphas, values = row(*(a for a, _ in layers)), row(*(p for _, p in layers))
    through, P = 1.0, 0.0
    for a, p in layers:
        P += through * a * p
        through *= 1 - a
    map_ = eq.composite(alphas, values).item()
    alpha = eq.composite(alphas, torch.ones_like(values)).item()
    assert map_ == pytest.approx(P)
    assert alpha == pytest.approx(1 - through)
    assert P_MIN * alpha - 1e-12 <= map_ <= alpha + 1e-12


@repeatable
@given(low=unit, high=unit, floor=st.floats(0.01, 1))
def test_eqs18_and_20_stay_in_range_and_run_against_each_other(low: float, high: float, floor: float) -> None:
    P = row(min(low, high), max(low, high))[None]
    tracking, mapping = eq.tracking_weight(P, floor=floor)[0], eq.mapping_weight(P)[0]
    assert floor - 1e-12 <= tracking[0] <= tracking[1] <= 1 + 1e-12  # tracking trusts the reliable
    assert 2 >= mapping[0] >= mapping[1] >= 1  # mapping works on the rest


@repeatable
@given(d=length, p=confidence, more_p=unit, age=updates, older=updates, reduction=st.sampled_from(["mean", "sum"]))
def test_eq23_allows_less_to_the_confident_and_to_the_old(
    d: float, p: float, more_p: float, age: int, older: int, reduction: str
) -> None:
    def loss(p: float, age: int) -> float:
        kappa = eq.maturity(row(p), torch.tensor([age]), maturity_time=10.0)
        return eq.stability_loss(
            row(d), kappa, torch.tensor([True]), weight=1.0, slack_min=0.002, slack_max=0.01, reduction=reduction
        ).item()

    assert loss(p, age) <= loss(min(1.0, p + more_p), age) + 1e-12
    assert loss(p, age) <= loss(p, age + older) + 1e-12
    assert max(0.0, d - 0.01) - 1e-12 <= loss(p, age) <= max(0.0, d - 0.002) + 1e-12


@repeatable
@given(baseline=length, kappa=unit, slack=st.floats(0, 0.01), reduction=st.sampled_from(["mean", "sum"]))
def test_eq23_is_zero_with_a_zero_gradient_when_nothing_moves(
    baseline: float, kappa: float, slack: float, reduction: str
) -> None:
    parameters = [torch.ones(2, k, dtype=torch.float64).requires_grad_() for k in (3, 3, 4)]
    before = [p.detach().clone() for p in parameters]
    changes = (eq.mean_change, eq.scale_change, eq.rotation_change)
    distance = eq.self_distance(
        *(change(now, old) for change, now, old in zip(changes, parameters, before, strict=True)),
        scale_weight=0.02,
        rotation_weight=1.0,
    )
    loss = eq.stability_loss(
        eq.abnormal_change(distance, row(baseline, baseline)),
        row(kappa, kappa),
        torch.tensor([True, True]),
        weight=0.01,
        slack_min=slack,
        slack_max=0.01,
        reduction=reduction,
    )
    loss.backward()
    assert loss.item() == 0
    for p in parameters:
        assert torch.equal(p.grad, torch.zeros_like(p))


@repeatable
@given(distance=length, reduction=st.sampled_from(["mean", "sum"]))
def test_eq23_does_not_count_gaussians_without_a_baseline(distance: float, reduction: str) -> None:
    config = ConfidenceConfig()
    known = ConfidenceState.born_at(0, 1, config).observed(
        Observation(torch.tensor([True]), torch.tensor([0.1]), torch.tensor([0.0])), config
    )
    state = known.appended(ConfidenceState.born_at(1, 1, config))

    def loss(last: float) -> float:
        return eq.stability_loss(
            eq.abnormal_change(torch.tensor([0.2, last]), state.baseline),
            eq.maturity(state.value, 1 - state.born, maturity_time=config.maturity_time),
            state.has_baseline,
            weight=config.stability_weight,
            slack_min=config.slack_min,
            slack_max=config.slack_max,
            reduction=reduction,
        ).item()

    assert loss(distance) == loss(0.0) > 0


@repeatable
@given(a=confidence, b=confidence, low=st.floats(0, 1), span=st.floats(0, 2), p_min=st.floats(0.01, 0.1))
def test_eq24_is_boldest_at_the_floor_and_falls_with_confidence(
    a: float, b: float, low: float, span: float, p_min: float
) -> None:
    g = eq.step_scale(row(1.0, p_min, max(a, b), min(a, b)), smallest=low, largest=low + span, p_min=p_min)
    torch.testing.assert_close(g[:2], row(low, low + span))
    assert low - 1e-12 <= g[2] <= g[3] + 1e-12 <= low + span + 1e-9


@repeatable
@given(scores=st.lists(unit, min_size=2, max_size=6), C=unit, floor=unit)
def test_eq25_keeps_the_order_where_confidence_is_equal(scores: list[float], C: float, floor: float) -> None:
    ordered = row(*sorted(scores))
    reranked = eq.rerank_score(ordered, torch.full_like(ordered, C), floor=floor)
    assert (reranked.diff() >= 0).all()
    assert (reranked <= ordered + 1e-12).all()
    assert (reranked >= floor * ordered - 1e-12).all()


@repeatable
@given(S=unit, low=unit, high=unit, floor=unit)
def test_eq25_prefers_the_more_reliable_of_equal_views(S: float, low: float, high: float, floor: float) -> None:
    reranked = eq.rerank_score(row(S, S), row(min(low, high), max(low, high)), floor=floor)
    assert reranked[0] <= reranked[1] + 1e-12


# The state: rows and their history


@dataclass
class Remembered:
    """What one Gaussian's row must hold, worked out on its own with plain numbers from the paper's text."""

    value: float
    born: int
    baseline: float = 0.0
    updates: int = 0

    def observe(self, valid: bool, d: float, r: float, c: ConfidenceConfig) -> None:
        self.value = c.p_min + (self.value - c.p_min) * math.exp(-1 / c.decay_time)
        if not valid:
            return
        if self.updates == 0:
            gain, loss = math.exp(-d / c.distance_ref - r / c.residual_ref), 0.0
            self.baseline = d
        else:
            xi = math.tanh((self.baseline - d) / c.stability_scale)
            gain = c.excitation_gain * math.exp(-r / c.residual_ref) * max(xi, 0)
            loss = c.penalty_gain * max(-xi, 0)
            self.baseline += c.baseline_rate * (d - self.baseline)
        p = self.value
        p += c.update_rate * gain * (1 - p) - c.update_rate * loss * (self.value - c.p_min)
        self.value = min(max(p, c.p_min), 1.0)
        self.updates += 1


def newborn(ids: list[int]) -> Gaussians:
    n = len(ids)
    return replace(
        Gaussians.empty(),
        ids=torch.tensor(ids, dtype=torch.int64),
        means=torch.zeros(n, 3),
        log_scales=torch.zeros(n, 3),
        quats=torch.ones(n, 4),
        logit_opacities=torch.zeros(n),
        sh=torch.zeros(n, 1, 3),
    )


@repeatable
@given(
    rounds=st.lists(st.tuples(st.integers(0, 4), st.integers(0, 2**32 - 1)), min_size=1, max_size=12),
    decay_time=st.floats(1, 200),
)
def test_every_gaussian_keeps_its_own_history_through_growing_and_pruning(
    rounds: list[tuple[int, int]], decay_time: float
) -> None:
    config = ConfidenceConfig(model="paper", decay_time=decay_time, excitation_gain=1.5)
    submap = Submap.anchored(se3.identity(), 0)
    expected: dict[int, Remembered] = {}
    made = 0
    for births, seed in rounds:
        ids = list(range(made, made + births))
        made += births
        submap = submap.grown(newborn(ids), config)
        expected |= {i: Remembered(config.initial, submap.clock) for i in ids}

        draw = torch.Generator().manual_seed(seed)
        keep = torch.rand(len(submap), generator=draw) < 0.7
        submap = submap.kept(keep)
        expected = {i: expected[i] for i in submap.gaussians.ids.tolist()}

        n = len(submap)
        valid = torch.rand(n, generator=draw) < 0.6
        distance, residual = 0.02 * torch.rand(n, generator=draw), 0.3 * torch.rand(n, generator=draw)
        observed = submap.confidence.observed(Observation(valid, distance, residual), config)
        for k, memory in enumerate(expected.values()):
            memory.observe(bool(valid[k]), distance[k].item(), residual[k].item(), config)
        submap = replace(submap, confidence=observed, clock=submap.clock + 1)

    state = submap.confidence
    assert submap.gaussians.ids.tolist() == list(expected)
    torch.testing.assert_close(state.value, torch.tensor([m.value for m in expected.values()]))
    torch.testing.assert_close(state.baseline, torch.tensor([m.baseline for m in expected.values()]))
    assert state.born.tolist() == [m.born for m in expected.values()]
    assert state.updates.tolist() == [m.updates for m in expected.values()]
    assert ((state.value >= torch.tensor(config.p_min)) & (state.value <= 1)).all()
    sealed = submap.sealed(config).confidence.value
    assert ((sealed >= torch.tensor(config.p_min)) & (sealed <= state.value)).all()


@repeatable
@given(late=st.integers(0, 40), after=st.integers(0, 40))
def test_sealing_makes_equal_histories_comparable_whenever_they_began(late: int, after: int) -> None:
    """Two Gaussians with the same feedback, one born later: sealed, they differ by nothing that age alone explains."""
    config = ConfidenceConfig(model="paper", decay_time=30.0)
    early = ConfidenceState.born_at(0, 1, config)
    nothing = Observation(torch.tensor([False]), torch.zeros(1), torch.zeros(1))
    for _ in range(late):
        early = early.observed(nothing, config)
    both = early.appended(ConfidenceState.born_at(late, 1, config))
    unseen = Observation(torch.tensor([False, False]), torch.zeros(2), torch.zeros(2))
    for _ in range(after):
        both = both.observed(unseen, config)
    assert both.value[1] >= both.value[0]  # the advantage of the newcomer, which sealing takes away
    value = both.sealed(config).value
    torch.testing.assert_close(value[1], value[0])


@repeatable
@given(late=st.integers(1, 40))
def test_at_equal_confidence_sealing_trusts_the_older(late: int) -> None:
    config = ConfidenceConfig(model="paper")
    value = (
        ConfidenceState.born_at(0, 1, config).appended(ConfidenceState.born_at(late, 1, config)).sealed(config).value
    )
    assert value[0] > value[1]


# What the numbers mean together: mean confidence over a population of Gaussians

COUNT = 2000
CHECKED = (0, 5, 10, 20, 30, 50)


def population(residual: float, *, share: float = 1.0, until: int = 50, jumping: bool = False) -> list[float]:
    """Mean confidence after some updates of 100 Adam steps, for Gaussians that come to rest within about ten of them.

    At rest the optimiser's random walk moves a centre by 1 mm, a log-scale by 0.05 and a quaternion by 0.01 along each
    axis (measured on Adam with gradients of pure noise); before, 7 mm exp(-k / 7) of true motion comes on top.
    A `share` of them is in view at a time, none after `until`; with `jumping` all change ever more after update 10.
    """
    draw = torch.Generator().manual_seed(0)
    config = ConfidenceConfig(model="paper")
    state = ConfidenceState.born_at(0, COUNT, config)
    means = [state.value.mean().item()]
    for k in range(1, max(CHECKED) + 1):
        walk = torch.randn(3, COUNT, 3, generator=draw).norm(dim=-1)
        distance = 7e-3 * math.exp(-k / 7) + eq.self_distance(
            1e-3 * walk[0],
            0.05 * walk[1],
            1e-4 * walk[2].square(),
            scale_weight=config.scale_change_weight,
            rotation_weight=config.rotation_change_weight,
        )
        if jumping and k > 10:
            distance = distance * 4.0 * 1.1 ** (k - 10)
        in_view = (torch.rand(COUNT, generator=draw) < share) & (k <= until)
        state = state.observed(Observation(in_view, distance, torch.full((COUNT,), residual)), config)
        means.append(state.value.mean().item())
    return [means[k] for k in CHECKED]


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        pytest.param({"residual": 0.015}, [0.30, 0.65, 0.87, 0.95, 0.92, 0.79], id="stable and visible"),
        pytest.param({"residual": 0.015, "share": 0.5}, [0.30, 0.47, 0.66, 0.84, 0.88, 0.86], id="half of the time"),
        pytest.param({"residual": 0.07}, [0.30, 0.55, 0.77, 0.90, 0.89, 0.75], id="noisy residual"),
        pytest.param({"residual": 0.3}, [0.30, 0.30, 0.35, 0.40, 0.42, 0.35], id="stable but wrong"),
        pytest.param({"residual": 0.015, "share": 0.0}, [0.30, 0.29, 0.28, 0.26, 0.25, 0.22], id="never visible"),
        pytest.param({"residual": 0.015, "until": 10}, [0.30, 0.65, 0.87, 0.79, 0.73, 0.61], id="then out of view"),
    ],
)
def test_the_papers_confidence_tells_kinds_of_gaussians_apart(kind: dict[str, float], expected: list[float]) -> None:
    """The rows of the design page (baseline.md 9.5); it does not say how its Gaussians converged, so within 0.045."""
    assert population(**kind) == pytest.approx(expected, abs=0.045)


def test_the_papers_confidence_orders_the_kinds_of_gaussians() -> None:
    stable, half, wrong, never = (
        population(residual, share=share)[3] for residual, share in ((0.015, 1.0), (0.015, 0.5), (0.3, 1.0), (0.3, 0.0))
    )
    assert stable > half + 0.05
    assert half > wrong + 0.3
    assert wrong > never + 0.05


def test_the_papers_confidence_drops_when_geometry_starts_to_jump() -> None:
    steady, jumping = population(0.015), population(0.015, jumping=True)
    assert jumping[2] == steady[2]
    assert jumping[3] < 0.5 * steady[3]
