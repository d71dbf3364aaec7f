"""Adam on rows: one optimiser for all parameters of the Gaussians, with a step scale for each Gaussian (Eq. 24).

Adam divides a gradient by its own running size, so a constant factor on one Gaussian's gradients cancels: scaling
gradients, as the paper's text has it, changes nothing. The factor that has the effect the text describes multiplies
the step.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tcgsplat.mapping.adam import BETA_1, BETA_2, EPSILON
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.tensors import PerGaussian, PerGaussianFlag

GEOMETRY = ("means", "log_scales", "quats")
"""What Eq. 24 scales."""
PARAMETERS = (*GEOMETRY, "logit_opacities", "sh")


@dataclass(frozen=True)
class LearningRates:
    """Adam step sizes, in the parameters' own units. [base] throughout, where not said otherwise."""

    means: float = 3e-4
    """Metres: three times the base system's step, for a tenth of its steps in an update. [ours] (base: 1e-4)"""
    log_scales: float = 5e-3
    quats: float = 1e-3
    logit_opacities: float = 0.05
    sh: float = 5e-3
    """Constant harmonic: ten steps move colour by at most 1.4 % of its range; higher ones get a twentieth. [ours]
    (base: 2.5e-3)"""


HIGHER_HARMONICS = 0.05
"""Of the constant one's rate. [base]"""


@dataclass(frozen=True)
class _Rows:
    """The rows of tables that take part in a step.

    On the CPU they are picked, since most Gaussians are out of view. A device would be waited for until it had counted
    them: there all rows are worked on, and those that take part are written.
    """

    picked: Tensor | None
    """Their places; None where all rows are worked on."""
    flags: PerGaussianFlag | None
    """Of all rows, those to be written; None where all that is worked on is."""

    @staticmethod
    def of(visible: PerGaussianFlag | None, table: Tensor) -> "_Rows":
        """The flagged rows of such a table; None for all."""
        if visible is None or not table.is_cpu:
            return _Rows(None, visible)
        return _Rows(visible.nonzero().flatten(), None)

    def read(self, table: Tensor) -> Tensor:
        """The rows that are worked on."""
        return table if self.picked is None else table[self.picked]

    def write(self, table: Tensor, values: Tensor) -> None:
        """Into a table, in place, what has become of these rows."""
        if self.picked is not None:
            table[self.picked] = values
        elif self.flags is None:
            table.copy_(values)
        else:
            flags = self.flags.view(-1, *[1] * (table.dim() - 1))
            table.copy_(torch.where(flags, values, table))


class RowAdam:
    """Adam over a set of Gaussians whose rows stay the same for the life of the optimiser.

    The only mutable thing of mapping: made for one mapping update, dropped after it.
    """

    def __init__(self, gaussians: Gaussians, rates: LearningRates) -> None:
        self._rates = rates
        self._parameters = {name: getattr(gaussians, name).clone().requires_grad_() for name in PARAMETERS}
        self._first = {name: torch.zeros_like(p) for name, p in self._parameters.items()}
        self._second = {name: torch.zeros_like(p) for name, p in self._parameters.items()}
        self._steps = {name: p.new_zeros(len(p), dtype=torch.float64) for name, p in self._parameters.items()}
        self._template = gaussians

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians as they are now; differentiable leaves."""
        return replace(self._template, **self._parameters)

    @property
    def tables(self) -> list[Tensor]:
        """All that a step changes, in place."""
        kinds = (self._parameters, self._first, self._second, self._steps)
        return [table.detach() for tables in kinds for table in tables.values()]

    def detached(self) -> Gaussians:
        """The Gaussians as they are now, as plain values that later steps leave alone."""
        return replace(self._template, **{name: p.detach().clone() for name, p in self._parameters.items()})

    def step(
        self,
        loss: Tensor,
        visible: PerGaussianFlag | None = None,
        frozen: tuple[str, ...] = (),
        pace: Tensor | None = None,
        gradient_scale: PerGaussian | None = None,
        step_scale: PerGaussian | None = None,
    ) -> None:
        """Follow the gradient of `loss` by one Adam step.

        Args:
            loss: Scalar that depends on `gaussians`.
            visible: Rows that take part; the others stay, and so do their moments and their count of steps. None
                for all.
            frozen: Names of parameters that stay.
            pace: Factor on all learning rates, [], float32; 1 if left out.
            gradient_scale: Eq. 24 to the letter: multiplies the geometry's gradients.
            step_scale: Eq. 24 as it is meant: multiplies the geometry's steps.
        """
        pace = torch.ones((), device=loss.device) if pace is None else pace
        active = [name for name in PARAMETERS if name not in frozen]
        gradients = torch.autograd.grad(loss, [self._parameters[name] for name in active], allow_unused=True)
        for name, gradient in zip(active, gradients, strict=True):
            if gradient is not None:
                scales = (gradient_scale, step_scale) if name in GEOMETRY else (None, None)
                self._advance(name, gradient, visible, pace, *scales)

    @torch.no_grad()
    def _advance(
        self,
        name: str,
        gradient: Tensor,
        visible: PerGaussianFlag | None,
        pace: Tensor,
        gradient_scale: PerGaussian | None,
        step_scale: PerGaussian | None,
    ) -> None:
        """One step of one table."""
        rows = _Rows.of(visible, gradient)
        g = torch.nan_to_num(rows.read(gradient), nan=0.0, posinf=0.0, neginf=0.0)  # one bad pixel must not end a map
        if gradient_scale is not None:
            g = g * rows.read(gradient_scale)[:, None]
        age = rows.read(self._steps[name]) + 1  # moments are as young as a row's first gradient
        steps = age.view(-1, *[1] * (gradient.dim() - 1))
        first = rows.read(self._first[name]).lerp(g, 1 - BETA_1)
        second = BETA_2 * rows.read(self._second[name]) + (1 - BETA_2) * g * g
        rows.write(self._steps[name], age)
        rows.write(self._first[name], first)
        rows.write(self._second[name], second)
        young_1, young_2 = ((1 - beta**steps).to(g) for beta in (BETA_1, BETA_2))
        step = first / young_1 / ((second / young_2).sqrt() + EPSILON)
        if step_scale is not None:
            step *= rows.read(step_scale)[:, None]
        if name == "sh":
            step[:, 1:] *= HIGHER_HARMONICS
        parameters = self._parameters[name]
        rows.write(parameters, rows.read(parameters) - pace * getattr(self._rates, name) * step)

    def _of(self, gaussians: Gaussians) -> "RowAdam":
        """Another one of this kind."""
        return RowAdam(gaussians, self._rates)

    def kept(self, keep: PerGaussianFlag) -> "RowAdam":
        """The optimiser of the flagged rows only, moments included."""
        smaller = self._of(self.detached().kept(keep))
        smaller._first = {name: moment[keep] for name, moment in self._first.items()}
        smaller._second = {name: moment[keep] for name, moment in self._second.items()}
        smaller._steps = {name: steps[keep] for name, steps in self._steps.items()}
        return smaller
