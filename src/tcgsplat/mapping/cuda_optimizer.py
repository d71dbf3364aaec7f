"""Adam on rows on a GPU: one kernel a table, where torch takes some twenty, in float64 in part."""

import math
from functools import cache

import torch
from torch import Tensor

from tcgsplat.mapping.adam import BETA_1, BETA_2, EPSILON
from tcgsplat.mapping.optimizer import HIGHER_HARMONICS, LearningRates, RowAdam
from tcgsplat.render.cuda.launching import THREADS, Compiled, Kernels, source
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.tensors import PerGaussian, PerGaussianFlag


def adam_text() -> str:
    """The kernel as C++."""
    constants = {"BETA_1": BETA_1, "BETA_2": BETA_2, "EPSILON": EPSILON}
    constants |= {"LOG_BETA_1": math.log(BETA_1), "LOG_BETA_2": math.log(BETA_2)}
    defined = {name: f"({value!r}f)" for name, value in constants.items()}
    return source(defined, "render/cuda/kernel.cuh", "mapping/adam.cu")


@cache
def adam_kernels(device: torch.device) -> Kernels:
    """Compiled for a GPU."""
    return Compiled(adam_text(), device)


class CudaRowAdam(RowAdam):
    """`RowAdam` by a kernel."""

    def __init__(self, gaussians: Gaussians, rates: LearningRates, kernels: Kernels) -> None:
        super().__init__(gaussians, rates)
        self._kernels = kernels
        self._steps = {name: steps.int() for name, steps in self._steps.items()}

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
        table, steps, rate = self._parameters[name], self._steps[name], getattr(self._rates, name)
        if not table.numel():
            return
        steps += 1 if visible is None else visible
        n, width = len(table), table[0].numel()
        self._kernels.launch("adam", -(-n * width // THREADS), {
            "parameters": table, "gradient": gradient.contiguous(), "first": self._first[name],
            "second": self._second[name], "steps": steps, "visible": visible, "gradient_scale": gradient_scale,
            "step_scale": step_scale, "pace": pace, "n": n, "width": width, "head": 3 if name == "sh" else width,
            "rate": rate, "tail_rate": HIGHER_HARMONICS * rate,
        })  # fmt: skip

    def _of(self, gaussians: Gaussians) -> "CudaRowAdam":
        return CudaRowAdam(gaussians, self._rates, self._kernels)
