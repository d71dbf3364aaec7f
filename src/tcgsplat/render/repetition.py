"""The same step again and again: plainly, or recorded once and launched as a whole where a rasterizer can do that."""

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

from torch import Tensor

from tcgsplat.render.protocol import Rasterizer

Step = Callable[..., None]
Given = Callable[[int], tuple[Tensor, ...]]


@runtime_checkable
class Repeater(Protocol):
    """A rasterizer that has a way of its own to repeat steps that draw with it."""

    def repeat(self, step: Step, given: Given, times: int, state: Sequence[Tensor]) -> None:
        """See the function of that name."""
        ...


def repeat(rasterizer: Rasterizer, step: Step, given: Given, times: int, state: Sequence[Tensor]) -> None:
    """`step(*given(0))`, `step(*given(1))` ... `step(*given(times - 1))`.

    Args:
        rasterizer: What the step draws with.
        step: Changes the tensors of `state` in place, and leaves nothing else behind. What it does must depend on
            `state` and on what it is given alone, and it may not ask a device for a value.
        given: What the k-th step takes: tensors on the rasterizer's device, of the same shapes and types for each k.
        times: How many steps.
        state: All that steps change.
    """
    if isinstance(rasterizer, Repeater):
        rasterizer.repeat(step, given, times, state)
    else:
        each(step, given, times)


def each(step: Step, given: Given, times: int) -> None:
    """The same, plainly."""
    for k in range(times):
        step(*given(k))
