"""What a map may take of a GPU's memory: how many Gaussians a submap may have, and how many pictures stay beside them.

It is planned from sizes and never asked of the device, so that a run with a limit gives the same map on every machine.
"""

import math
from dataclasses import dataclass

import torch

from tcgsplat.geometry.camera import Camera
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.tensors import PerGaussianFlag

BYTES_PER_GB = 2**30
OVERHEAD = 600 * 2**20
"""Bytes that CUDA, torch and the kernels take before anything is drawn. Assumed, not measured."""
WORKING_BYTES_PER_PIXEL = 2200
"""Of the images while one frame is tracked and another mapped: channels, losses, and the derivatives of both. Torch's
tensors were counted on a pretend device, 106 for tracking and 399 for mapping: once for the step that is done before
one is recorded, and twice for the recorded one, whose pool may be twice what it needs (`render/cuda/graphs.py`).
Rasterizer and allocator need the rest."""
WORKING_COPIES = 48
"""Of a Gaussian's own 96 bytes (more with harmonics) during an update. Counted likewise, it takes 465 with Adam's
tables and all gradients, and tracking 34. Then there are the submap before and up to two in loop closure, 128 each, and
of `render.cuda` some 200 and 100 for each tile: about fifteen copies. Adam's tables as they were before, and what a
step makes of tensors twice more, with half as much room again for tiles, are another twenty-six. What the allocator
cannot use comes on top."""
IMAGE_BYTES = 3 * 4 + 4 + 1
"""Of a pixel of a keyframe: colour, depth, whether it is valid."""
LEAST = 10_000
"""Gaussians that a submap may have however small the limit is: without a map nothing can be tracked."""


@dataclass(frozen=True)
class MemoryLimit:
    """A limit on GPU memory, and what it means for a submap."""

    gb: float
    """Of 2^30 bytes; 0 or inf for no limit."""

    def gaussians(self, camera: Camera, sh_degree: int) -> int | None:
        """How many a submap may have; None for any number."""
        if not self._limits:
            return None
        return max(int(self._free(camera) // _working_bytes(sh_degree)), LEAST)

    def pictures(self, camera: Camera, sh_degree: int, gaussians: int) -> int | None:
        """How many keyframes' pictures may be on the device beside so many Gaussians, at least one; None for all."""
        if not self._limits:
            return None
        left = self._free(camera) - gaussians * _working_bytes(sh_degree)
        submaps = 2  # the one before is still tracked against while the next one is young
        return max(int(left // (submaps * IMAGE_BYTES * camera.width * camera.height)), 1)

    @property
    def _limits(self) -> bool:
        return 0 < self.gb < math.inf

    def _free(self, camera: Camera) -> float:
        """Bytes for Gaussians and keyframes."""
        return self.gb * BYTES_PER_GB - OVERHEAD - WORKING_BYTES_PER_PIXEL * camera.width * camera.height


def _working_bytes(sh_degree: int) -> int:
    parameters, confidence, integers = 11 + 3 * (sh_degree + 1) ** 2, 4, 3
    return WORKING_COPIES * (4 * (parameters + confidence) + 8 * integers)


@torch.no_grad()
def most_useful(submap: Submap, count: int) -> PerGaussianFlag:
    """Flags so many Gaussians: those with the most opacity times confidence, the older one of equals."""
    useful = submap.gaussians.opacities * submap.confidence.value
    keep = torch.zeros_like(useful, dtype=torch.bool)
    keep[useful.argsort(descending=True, stable=True)[:count]] = True
    return keep


def paged(keyframes: tuple[Keyframe, ...], count: int) -> tuple[Keyframe, ...]:
    """The same keyframes, of which only the newest `count` have their pictures on a device, if they had."""
    older = max(len(keyframes) - count, 0)
    return (*(keyframe.cpu() for keyframe in keyframes[:older]), *keyframes[older:])
