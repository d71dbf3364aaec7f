"""Learned perceptual image patch similarity: LPIPS 0.1 with AlexNet (Zhang et al. 2018), without its weights."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from tcgsplat.errors import EvaluationError
from tcgsplat.tensors import Image, Mask

_LAYERS: Final = ((0, 3, 64, 11, 4, 2), (3, 64, 192, 5, 1, 2), (6, 192, 384, 3, 1, 1), (8, 384, 256, 3, 1, 1),
                  (10, 256, 256, 3, 1, 1))  # fmt: skip
"""AlexNet's convolutions: number in torchvision's `features`, channels in and out, size, stride, padding."""
_POOLED: Final = (3, 6)
"""Before these comes a max-pooling."""
_SMALLEST: Final = 31
"""Pixels that an image must have across and down, or nothing is left for the third layer."""
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""What makes of colours in [-1, 1] what AlexNet was trained on."""

Features = Float[Tensor, "1 c rows columns"]


def _shapes() -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    for head, (number, inward, outward, size, _, _) in enumerate(_LAYERS):
        shapes[f"features.{number}.weight"] = (outward, inward, size, size)
        shapes[f"features.{number}.bias"] = (outward,)
        shapes[f"lin{head}.model.1.weight"] = (1, outward, 1, 1)
    return shapes


@dataclass(frozen=True)
class Lpips:
    """The distance, with the weights of a network; about 0 for images that look alike, 0.7 for unrelated ones."""

    weights: Mapping[str, Tensor]
    """By the names of `read`."""

    @staticmethod
    def read(path: Path, device: torch.device) -> "Lpips":
        """The distance with the weights in a file, a dictionary of tensors as `torch.save` writes it.

        It holds, with these keys, the convolutions of torchvision's AlexNet: `features.N.weight` and `features.N.bias`
        for N = 0, 3, 6, 8, 10; and the five linear heads of the LPIPS authors' `alex.pth` (version 0.1):
        `lin0.model.1.weight` to `lin4.model.1.weight`. Others are ignored. The two files are joined by
        `torch.save(torch.load(alexnet) | torch.load(alex), path)`. Nothing but tensors is unpickled.

        Raises:
            EvaluationError: if the file cannot be read, or a tensor is missing or has another shape.
        """
        advice = "give a state dict of AlexNet's features and the five linear heads of LPIPS, joined in one file"
        try:
            state = torch.load(path, map_location=device, weights_only=True)
        except (OSError, RuntimeError, EOFError, ValueError, UnpicklingError) as error:
            reason = str(error).split("\n", 1)[0]
            raise EvaluationError(f"cannot read the weights in {path} ({reason}); {advice}") from error
        found = state if isinstance(state, Mapping) else {}
        for name, shape in _shapes().items():
            tensor = found.get(name)
            if not isinstance(tensor, Tensor):
                raise EvaluationError(f"{path} has no tensor {name}; {advice}")
            if tensor.shape != shape:
                raise EvaluationError(f"{name} in {path} has shape {tuple(tensor.shape)}, not {shape}; {advice}")
        return Lpips({name: found[name].to(torch.float32) for name in _shapes()})

    @torch.no_grad()
    def __call__(self, a: Image, b: Image, valid: Mask) -> float:
        """How different two images look, over the valid pixels; RGB in [0, 1].

        Where a pixel is not valid, `a` is given the colours of `b`, and each layer's mean is weighted by the share of
        valid pixels under each of its places. With all pixels valid this is LPIPS as published. NaN if no pixel is
        valid, or an image is smaller than 31 pixels across or down.
        """
        if min(valid.shape) < _SMALLEST or not bool(valid.any()):
            return math.nan
        a, b, valid = (image.to(next(iter(self.weights.values())).device) for image in (a, b, valid))
        distance = 0.0
        both = zip(self._features(torch.where(valid[..., None], a, b)), self._features(b), strict=True)
        for head, (one, other) in enumerate(both):
            apart = functional.conv2d((one - other).square(), self.weights[f"lin{head}.model.1.weight"])
            counted = functional.adaptive_avg_pool2d(valid.to(apart)[None, None], (apart.shape[2], apart.shape[3]))
            distance += float((apart * counted).sum(dtype=torch.float64) / counted.sum(dtype=torch.float64))
        return distance

    def _features(self, image: Image) -> Iterator[Features]:
        """Of the five layers, each place's of unit length."""
        shift, scale = (image.new_tensor(values) for values in (_SHIFT, _SCALE))
        x = ((2.0 * image - 1.0 - shift) / scale).permute(2, 0, 1)[None]
        for number, _, _, _, stride, padding in _LAYERS:
            if number in _POOLED:
                x = functional.max_pool2d(x, 3, stride=2)
            kernel, bias = self.weights[f"features.{number}.weight"], self.weights[f"features.{number}.bias"]
            x = functional.conv2d(x, kernel, bias, stride=stride, padding=padding).relu()
            yield x / (x.norm(dim=1, keepdim=True) + 1e-10)
