"""Every equation by hand, with numbers small enough to check on paper."""

import math

import pytest
import torch
from torch import Tensor

from tcgsplat.confidence import equations as eq


def row(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def is_close(actual: Tensor, *expected: float) -> None:
    torch.testing.assert_close(actual, row(*expected).reshape(actual.shape))


def test_eq4_lets_confidence_fade_towards_the_floor() -> None:
    is_close(eq.decay(row(0.9), decay_time=100.0, p_min=0.1), 0.1 + 0.8 * math.exp(-0.01))
    assert round(eq.decay(row(0.9), decay_time=100.0, p_min=0.1).item(), 4) == 0.8920
    is_close(eq.decay(row(0.9, 0.1), decay_time=10.0, p_min=0.1, elapsed=20.0), 0.1 + 0.8 * math.exp(-2), 0.1)


def test_eq4_does_not_decay_with_an_infinite_time() -> None:
    is_close(eq.decay(row(0.9), decay_time=math.inf, p_min=0.1), 0.9)


def test_eq5_is_a_distance() -> None:
    is_close(eq.mean_change(row(1, 2, 3)[None], row(1, 5, 7)[None]), 5.0)


def test_eq6_is_the_norm_of_the_log_ratios() -> None:
    before = row(0.01, 0.02, 0.03)[None]
    is_close(eq.scale_change((2 * before).log(), before.log(), epsilon=1e-15), math.log(2) * math.sqrt(3))


def test_eq6_on_stored_log_scales_is_the_papers_form_on_scales() -> None:
    epsilon = 1e-3  # large enough to matter beside scales of a millimetre
    now, before = row(1e-3, 2e-2, 5e-4)[None], row(2e-3, 1e-2, 5e-4)[None]
    paper = ((now + epsilon).log() - (before + epsilon).log()).norm(dim=-1)
    torch.testing.assert_close(eq.scale_change(now.log(), before.log(), epsilon=epsilon), paper)


def test_eq6_stays_finite_when_a_scale_vanishes() -> None:
    gone = row(-math.inf, 0.0, 0.0)[None]
    is_close(eq.scale_change(gone, gone), 0.0)
    assert eq.scale_change(gone, row(-5.0, 0.0, 0.0)[None]).isfinite().all()


def test_eq7_is_the_squared_sine_of_half_the_angle() -> None:
    sixty_degrees_about_z = row(math.cos(math.pi / 6), 0, 0, math.sin(math.pi / 6))[None]
    is_close(eq.rotation_change(3.0 * sixty_degrees_about_z, row(1, 0, 0, 0)[None]), 0.25)


def test_eq7_is_never_negative_in_single_precision(generator: torch.Generator) -> None:
    quats = torch.randn(10_000, 4, generator=generator)
    change = eq.rotation_change(quats, quats)
    assert change.min() >= 0
    assert change.max() < 1e-6


def test_eq8_adds_up_in_metres() -> None:
    d = eq.self_distance(row(0.001), row(0.1), row(0.002), scale_weight=0.02, rotation_weight=1.5)
    is_close(d, 0.001 + 0.002 + 0.003)


def test_eqs5_to_8_have_a_zero_gradient_where_nothing_has_moved(generator: torch.Generator) -> None:
    parameters = [torch.randn(5, k, generator=generator).requires_grad_() for k in (3, 3, 4)]
    before = [p.detach().clone() for p in parameters]
    changes = (eq.mean_change, eq.scale_change, eq.rotation_change)
    d = eq.self_distance(
        *(change(now, old) for change, now, old in zip(changes, parameters, before, strict=True)),
        scale_weight=0.02,
        rotation_weight=1.0,
    )
    d.sum().backward()
    for p in parameters:
        torch.testing.assert_close(p.grad, torch.zeros_like(p), atol=1e-6, rtol=0)


def test_eqs5_to_7_have_the_right_gradients_elsewhere(generator: torch.Generator) -> None:
    for change, k in ((eq.mean_change, 3), (eq.scale_change, 3), (eq.rotation_change, 4)):
        now = torch.randn(4, k, generator=generator, dtype=torch.float64).requires_grad_()
        before = torch.randn(4, k, generator=generator, dtype=torch.float64)
        assert torch.autograd.gradcheck(lambda x, b=before, f=change: f(x, b), (now,))


def test_eq9_counts_depth_only_where_there_is_a_reading() -> None:
    depth = torch.tensor([[0.02, math.nan]], dtype=torch.float64)
    valid = torch.tensor([[True, False]])
    R = eq.residual_map(row(0.1, 0.3)[None], depth, valid, color_weight=1.0, depth_weight=2.0)
    is_close(R, 0.14, 0.3)


def test_sample_at_reads_the_nearest_pixel_column_first() -> None:
    plane = torch.tensor([[0.0, 1.0, 2.0], [10.0, 11.0, 12.0]])
    pixels = torch.tensor([[0.0, 0.0], [2.0, 0.0], [1.4, 0.6], [-0.5, 1.4]])
    assert eq.sample_at(plane, pixels).tolist() == [0.0, 2.0, 11.0, 10.0]


def test_sample_at_survives_centres_outside_the_image() -> None:
    pixels = torch.tensor([[-7.0, 0.0], [99.0, 99.0], [math.nan, 0.0], [math.inf, -math.inf]])
    assert eq.sample_at(torch.ones(2, 3), pixels).tolist() == [1.0] * 4


def test_eq10_is_one_over_e_at_the_reference() -> None:
    is_close(eq.observation_quality(row(0.0, 0.1, 0.2), residual_ref=0.1), 1.0, math.exp(-1), math.exp(-2))


def test_eq11_is_positive_for_less_change_than_usual() -> None:
    stability = eq.relative_stability(row(4e-3, 4e-3, 4e-3), row(2e-3, 4e-3, 6e-3), scale=2e-3)
    is_close(stability, math.tanh(1), 0.0, -math.tanh(1))


def test_eq12_rewards_or_punishes() -> None:
    excitation, penalty = eq.feedback(row(0.5, 0.5), row(0.4, -0.4), excitation_gain=2.0, penalty_gain=0.3)
    is_close(excitation, 0.4, 0.0)
    is_close(penalty, 0.0, 0.12)


def test_eq13_pulls_towards_its_ends() -> None:
    after = eq.apply_feedback(row(0.5, 0.5), row(0.4, 0.0), row(0.0, 0.4), rate=0.5, p_min=0.1)
    is_close(after, 0.5 + 0.5 * 0.4 * 0.5, 0.5 - 0.5 * 0.4 * 0.4)


def test_eq14_by_hand() -> None:
    is_close(eq.first_excitation(row(0.01), row(0.2), distance_ref=0.01, residual_ref=0.1), math.exp(-3))


def test_eq15_by_hand() -> None:
    is_close(eq.update_baseline(row(0.004), row(0.014), rate=0.1), 0.005)


def test_eq16_by_hand() -> None:
    born = torch.tensor([0, 100])
    is_close(eq.calibrate_age(row(0.9, 0.9), born, decay_time=100.0, p_min=0.1), 0.9, 0.1 + 0.8 / math.e)


def test_eq17_composites_from_front_to_back() -> None:
    is_close(eq.composite(row(0.5, 0.5), row(1.0, 0.2)), 0.5 * 1.0 + 0.5 * 0.5 * 0.2)
    is_close(eq.composite(row(1.0, 0.5), row(0.3, 1.0)), 0.3)  # an opaque surface hides what is behind it


def test_eqs18_and_20_by_hand() -> None:
    is_close(eq.tracking_weight(row(0.0, 0.5, 1.0)[None], floor=0.2), 0.2, 0.6, 1.0)
    is_close(eq.mapping_weight(row(0.0, 0.5, 1.0)[None]), 2.0, 1.5, 1.0)
    is_close(eq.mapping_weight(row(0.0, 0.5, 1.0)[None], doubt=-0.8), 0.2, 0.6, 1.0)


def test_eq19_by_hand() -> None:
    loss = eq.tracking_loss(
        row(0.2, 1.0)[None], row(0.1, 0.2)[None], row(0.01, 0.02)[None], color_weight=0.5, depth_weight=10.0
    )
    is_close(loss, 0.2 * (0.05 + 0.1) + 1.0 * (0.1 + 0.2))


def test_eq21_by_hand() -> None:
    loss = eq.mapping_loss(
        row(2.0, 1.0)[None],
        row(0.1, 0.2)[None],
        row(0.01, 0.02)[None],
        row(0.3).squeeze(),
        row(0.4).squeeze(),
        row(0.5).squeeze(),
        color_weight=0.5,
        depth_weight=10.0,
        ssim_weight=0.2,
        regularization_weight=0.1,
    )
    is_close(loss, 2.0 * (0.05 + 0.1) + 1.0 * (0.1 + 0.2) + 0.06 + 0.04 + 0.5)


def test_eq22_is_the_excess_over_the_baseline() -> None:
    is_close(eq.abnormal_change(row(0.005, 0.002), row(0.003, 0.003)), 0.002, 0.0)


def test_maturity_grows_with_age_from_zero() -> None:
    kappa = eq.maturity(row(0.8, 0.8, 0.8), torch.tensor([-3, 0, 10]), maturity_time=10.0)
    is_close(kappa, 0.0, 0.0, 0.8 * (1 - 1 / math.e))


ABNORMAL, KAPPA = row(0.02, 0.02, 0.001, 9.0), row(0.0, 0.5, 0.0, 0.0)
COUNTED = torch.tensor([True, True, True, False])


def test_eq23_by_hand() -> None:
    # Slacks 10, 6 and 10 mm: the first two exceed theirs by 10 and 14 mm, the third does not, the fourth is not in V.
    def loss(reduction: str) -> Tensor:
        return eq.stability_loss(
            ABNORMAL, KAPPA, COUNTED, weight=0.01, slack_min=0.002, slack_max=0.01, reduction=reduction
        )

    is_close(loss("mean"), 0.01 * 0.024 / 3)
    is_close(loss("sum"), 0.01 * 0.024)


@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_eq23_is_zero_when_nothing_is_in_view(reduction: str) -> None:
    nothing = torch.zeros(4, dtype=torch.bool)
    loss = eq.stability_loss(ABNORMAL, KAPPA, nothing, weight=0.01, slack_min=0.0, slack_max=0.0, reduction=reduction)
    assert loss.item() == 0


@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_eq23_pulls_back_what_moved_too_far_and_nothing_else(reduction: str) -> None:
    before = torch.zeros(3, 3)
    means = torch.tensor([[0.03, 0.0, 0.0], [0.001, 0.0, 0.0], [0.0, 0.0, 0.0]]).requires_grad_()
    abnormal = eq.abnormal_change(eq.mean_change(means, before), torch.zeros(3))
    counted = torch.ones(3, dtype=torch.bool)
    eq.stability_loss(
        abnormal, torch.ones(3), counted, weight=0.01, slack_min=0.002, slack_max=0.01, reduction=reduction
    ).backward()
    per_gaussian = 0.01 if reduction == "sum" else 0.01 / 3
    expected = torch.zeros(3, 3)
    expected[0, 0] = per_gaussian
    torch.testing.assert_close(means.grad, expected)


def test_eq24_by_hand() -> None:
    is_close(eq.step_scale(row(1.0, 0.1, 0.55), smallest=0.8, largest=1.2, p_min=0.1), 0.8, 1.2, 1.0)


def test_eq25_by_hand() -> None:
    is_close(eq.rerank_score(row(0.5, 1.0), row(0.6, 1.0), floor=0.5), 0.4, 1.0)
