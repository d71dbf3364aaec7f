"""Adam on rows: torch's, step for step, and what Eq. 24 does to it."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tcgsplat.mapping.optimizer import GEOMETRY, PARAMETERS, LearningRates, RowAdam
from tcgsplat.scene.gaussians import Gaussians

RATES = LearningRates(means=1e-3, log_scales=5e-3, quats=2e-3, logit_opacities=0.05, sh=2.5e-3)
N = 12


def gaussians(sh_degree: int = 0) -> Gaussians:
    g = torch.Generator().manual_seed(1)
    return Gaussians(
        ids=torch.arange(100, 100 + N),
        means=torch.randn(N, 3, generator=g),
        log_scales=torch.randn(N, 3, generator=g) - 3,
        quats=torch.randn(N, 4, generator=g),
        logit_opacities=torch.randn(N, generator=g),
        sh=torch.randn(N, (sh_degree + 1) ** 2, 3, generator=g),
    )


def loss_of(current: Gaussians, step: int, rows: Tensor | None = None) -> Tensor:
    """Something smooth and different at every step, a sum over rows that do not feel each other."""
    each = torch.zeros(len(current))
    for k, name in enumerate(PARAMETERS):
        value = (
            getattr(current, name).flatten(1) if getattr(current, name).dim() > 1 else getattr(current, name)[:, None]
        )
        each = each + 10.0 ** (-2 * k) * (value * (1 + 0.1 * step) - 0.3 * k).pow(2).sum(dim=1)
    return each.sum() if rows is None else each[rows].sum()


def stepped(steps: int, **options: object) -> Gaussians:
    adam = RowAdam(gaussians(), RATES)
    for step in range(steps):
        adam.step(loss_of(adam.gaussians, step), **options)  # type: ignore[arg-type]
    return adam.detached()


@pytest.mark.parametrize("sh_degree", [0, 1])
def test_is_adam_step_for_step(sh_degree: int) -> None:
    ours = RowAdam(gaussians(sh_degree), RATES)
    start = gaussians(sh_degree)
    leaves = {name: getattr(start, name).clone().requires_grad_() for name in PARAMETERS if name != "sh"}
    constant, higher = start.sh[:, :1].clone().requires_grad_(), start.sh[:, 1:].clone().requires_grad_()
    groups = [{"params": [leaf], "lr": getattr(RATES, name)} for name, leaf in leaves.items()]
    groups += [{"params": [constant], "lr": RATES.sh}, {"params": [higher], "lr": RATES.sh / 20}]
    theirs = torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-15)

    for step in range(25):
        ours.step(loss_of(ours.gaussians, step))
        theirs.zero_grad()
        loss_of(replace(start, **leaves, sh=torch.cat((constant, higher), dim=1)), step).backward()
        theirs.step()
        for name, leaf in leaves.items():
            torch.testing.assert_close(getattr(ours.detached(), name), leaf.detach(), atol=1e-6, rtol=1e-6)
        torch.testing.assert_close(ours.detached().sh[:, :1], constant.detach(), atol=1e-6, rtol=1e-6)
        torch.testing.assert_close(ours.detached().sh[:, 1:], higher.detach(), atol=1e-6, rtol=1e-6)
    assert torch.equal(ours.detached().ids, start.ids)


def test_scaling_gradients_to_the_letter_changes_nothing() -> None:
    """Eq. 24 as the paper writes it: Adam divides the factor out again."""
    factors = torch.linspace(0.8, 1.2, N)
    plain, literal = stepped(30), stepped(30, gradient_scale=factors)
    for name in PARAMETERS:
        moved = (getattr(plain, name) - getattr(gaussians(), name)).abs().max()
        difference = (getattr(plain, name) - getattr(literal, name)).abs().max()
        assert moved > 1e-3
        assert difference < 1e-5 * max(1.0, float(getattr(plain, name).abs().max())), name


def test_scaling_steps_gives_exactly_the_ratio_to_geometry_and_to_nothing_else() -> None:
    factors = torch.linspace(0.8, 1.2, N)
    start, plain, scaled = gaussians(), stepped(1), stepped(1, step_scale=factors)
    for name in PARAMETERS:
        before = getattr(start, name).double()
        ratio = (getattr(scaled, name).double() - before) / (getattr(plain, name).double() - before)
        expected = factors if name in GEOMETRY else torch.ones(N)
        expected = expected.reshape(-1, *[1] * (ratio.dim() - 1)).expand_as(ratio).double()
        torch.testing.assert_close(ratio, expected, atol=2e-3, rtol=0)  # float32 steps of 1e-3 on values of 1


def test_scaled_steps_go_on_being_scaled() -> None:
    """With a constant gradient every Adam step is as long as the rate, so the ratio shows after any number of steps."""
    factors = torch.linspace(0.8, 1.2, N)
    adam = RowAdam(gaussians(), RATES)
    for _ in range(40):
        adam.step(adam.gaussians.means.sum(), step_scale=factors)
    moved = (gaussians().means - adam.detached().means).mean(dim=1)
    torch.testing.assert_close(moved, 40 * RATES.means * factors, rtol=1e-3, atol=0)


def test_what_is_frozen_stays_and_what_it_becomes_later_does_not_depend_on_how_long() -> None:
    adam = RowAdam(gaussians(), RATES)
    for step in range(7):
        adam.step(loss_of(adam.gaussians, step), frozen=("sh",))
    assert torch.equal(adam.detached().sh, gaussians().sh)
    assert not torch.equal(adam.detached().means, gaussians().means)
    adam.step(adam.gaussians.sh.sum())
    moved = gaussians().sh - adam.detached().sh
    torch.testing.assert_close(moved, torch.full_like(moved, RATES.sh), rtol=1e-3, atol=0)  # a first step is the rate


def test_parameters_without_a_gradient_stay() -> None:
    adam = RowAdam(gaussians(), RATES)
    adam.step(adam.gaussians.means.square().sum())
    assert torch.equal(adam.detached().quats, gaussians().quats)


def test_kept_rows_take_their_moments_with_them() -> None:
    """Dropping rows halfway must not change what becomes of the others, to the last bit."""
    keep = torch.tensor([i % 3 != 1 for i in range(N)])
    whole, pruned = RowAdam(gaussians(), RATES), RowAdam(gaussians(), RATES)
    for step in range(6):
        whole.step(loss_of(whole.gaussians, step))
        pruned.step(loss_of(pruned.gaussians, step))
    pruned = pruned.kept(keep)
    for step in range(6, 12):
        whole.step(loss_of(whole.gaussians, step))
        pruned.step(loss_of(pruned.gaussians, step))
    for name in (*PARAMETERS, "ids"):
        assert torch.equal(getattr(whole.detached().kept(keep), name), getattr(pruned.detached(), name)), name


def test_one_bad_gradient_spoils_nothing() -> None:
    adam = RowAdam(gaussians(), RATES)
    weights = torch.ones(N, 1)
    weights[3], weights[4] = float("nan"), float("inf")
    adam.step((weights * adam.gaussians.means).sum())
    after = adam.detached()
    assert after.means.isfinite().all()
    assert torch.equal(after.means[3:5], gaussians().means[3:5])
    assert not torch.equal(after.means[5], gaussians().means[5])


def test_the_values_that_it_was_made_from_stay() -> None:
    start = gaussians()
    adam = RowAdam(start, RATES)
    adam.step(loss_of(adam.gaussians, 0))
    assert torch.equal(start.means, gaussians().means)
    assert not start.means.requires_grad


def test_detached_values_do_not_move_with_later_steps() -> None:
    adam = RowAdam(gaussians(), RATES)
    adam.step(loss_of(adam.gaussians, 0))
    now = adam.detached()
    means = now.means.clone()
    adam.step(loss_of(adam.gaussians, 1))
    assert torch.equal(now.means, means)


def test_no_gaussians_are_no_trouble() -> None:
    adam = RowAdam(Gaussians.empty(), RATES)
    adam.step(adam.gaussians.means.sum(), step_scale=torch.zeros(0))
    assert len(adam.kept(torch.zeros(0, dtype=torch.bool)).detached()) == 0
