"""Making a finished map prettier: the losses of mapping, over all of its keyframes, for as long as one likes."""

import time
from collections.abc import Callable
from dataclasses import replace

import torch

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.mapping.optimization import begin
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.submap import Submap

LAST_PACE = 0.05
"""Learning rates at the end, of those at the beginning: they fall evenly in the logarithm, so that what was found
roughly settles finely."""
AT_ONCE = 16
"""Steps between two looks at the clock: a GPU does as many in one go, a CPU takes some tenths of a second for them."""


def refined(
    submap: Submap,
    config: MapperConfig,
    confidence: ConfidenceConfig,
    rasterizer: Rasterizer,
    generator: torch.Generator,
    progress: Callable[[int], float],
) -> Submap:
    """A submap, or all of them merged, optimised further over the keyframes, each seen once before any is seen again.

    Confidence weighs pixels and steps as it does online (equations 20 and 24) and stays what it was. The stability loss
    is left out: it holds a Gaussian to where it was before one mapping update, and this is no such update.

    Args:
        submap: With its keyframes, of which not all need fit into memory.
        config: Losses and learning rates.
        confidence: Guidance.
        rasterizer: Backend.
        generator: Order of the keyframes.
        progress: Given the steps taken so far, the share of the work that is done; the work ends at 1. A share of
            steps makes the result repeatable, one of time does not.
    """
    if len(submap) == 0 or not submap.keyframes:
        return submap
    optimization = begin(submap, config, replace(confidence, stability_weight=0.0), rasterizer)
    order: list[int] = []
    steps = 0
    while paces := _paces(progress, steps):
        while len(order) < len(paces):
            order = torch.randperm(len(submap.keyframes), generator=generator).tolist() + order
        views = [order.pop() for _ in paces]
        optimization.steps(views, paces=paces)
        steps += len(paces)
    optimization.prune()
    return optimization.submap().to(submap.device)


def _paces(progress: Callable[[int], float], steps: int) -> list[float]:
    """Of the next steps, as many as are taken in one go; none at the end."""
    paces: list[float] = []
    while len(paces) < AT_ONCE and (done := progress(steps + len(paces))) < 1:
        paces.append(LAST_PACE**done)
    return paces


def for_seconds(seconds: float) -> Callable[[int], float]:
    """Progress by the clock, which begins now."""
    started = time.perf_counter()
    return lambda _: (time.perf_counter() - started) / max(seconds, 1e-9)


def for_steps(count: int) -> Callable[[int], float]:
    """Progress by a number of steps."""
    return lambda steps: steps / max(count, 1)
