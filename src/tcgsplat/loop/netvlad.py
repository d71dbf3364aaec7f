"""NetVLAD (Arandjelovic et al., CVPR 2016) with the published weights, which are a user's to download.

The layout of `Pitts30K_struct.mat`, also passed on as `VGG16-NetVLAD-Pitts30K.mat`: a struct `net` whose `layers` are
VGG16 up to conv5_3 (0 to 28), the aggregation (30, its centres negated) and a whitening (33), and whose
`meta.normalization.averageImage` is the mean colour. Tested with files of this layout and random weights; it has not
been run with the published ones. A picture of 320x240 takes a second or so on a CPU.
"""

import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy  # its parts when they are used: together they are a tenth of the start-up
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn
from torch.nn.functional import conv2d, max_pool2d, normalize, softmax

from tcgsplat.errors import ConfigError

_BLOCKS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
"""Layers that are convolutions; the picture is halved between the blocks."""
_AGGREGATION, _WHITENING = 30, 33


@dataclass(frozen=True, eq=False)
class Weights:
    """What the file holds, in torch's order of axes."""

    convolutions: tuple[tuple[tuple[Float[Tensor, "_ _ _ _"], Float[Tensor, " _"]], ...], ...]
    """Kernel [out, in, rows, columns] and bias [out], block by block."""
    assignment: Float[Tensor, "d k"]
    """How much a local feature is each centre's, before the softmax."""
    centers: Float[Tensor, "d k"]
    whitening: Float[Tensor, "dk out"]
    bias: Float[Tensor, " out"]
    mean_color: Float[Tensor, "3"]
    """RGB of 0 to 255."""


class NetVlad(nn.Module):
    """VGG16's local features, summed up by how they differ from learned centres, and whitened."""

    def __init__(self, weights: Weights) -> None:
        super().__init__()
        self._weights = weights

    def forward(self, rgb: Float[Tensor, "1 3 h w"]) -> Float[Tensor, "1 out"]:
        """The descriptor, of unit length, of a picture in [0, 1]; at least 16 pixels wide and high."""
        weights = self._weights
        x = 255.0 * rgb - weights.mean_color[:, None, None]
        for i, block in enumerate(weights.convolutions):
            x = max_pool2d(x.relu(), 2) if i > 0 else x
            for j, (kernel, bias) in enumerate(block):
                x = conv2d(x.relu() if j > 0 else x, kernel, bias, padding=kernel.shape[-1] // 2)
        local = normalize(x[0].flatten(1), dim=0)
        share = softmax(weights.assignment.T @ local, dim=0)
        differences = local @ share.T - weights.centers * share.sum(dim=1)
        whole = normalize(normalize(differences, dim=0).flatten(), dim=0)
        return normalize(whole @ weights.whitening + weights.bias, dim=0)[None]


def load(path: Path) -> NetVlad:
    """Read the published weights.

    Raises:
        ConfigError: if there is no such file, or it is laid out otherwise.
    """
    if not path.is_file():
        raise ConfigError(f"no file {path}; download NetVLAD's weights (Pitts30K_struct.mat) and give their path")
    advice = "give NetVLAD's Pitts30K_struct.mat, as it was published"
    try:
        content = scipy.io.loadmat(path, struct_as_record=False, squeeze_me=True)
    except (ValueError, TypeError, OSError, NotImplementedError, zlib.error, scipy.io.matlab.MatReadError) as error:
        raise ConfigError(f"{path} cannot be read as a MATLAB file of version 5; {advice}") from error
    try:
        weights = _weights(content["net"])
    except (KeyError, AttributeError, IndexError, TypeError, ValueError) as error:
        raise ConfigError(f"{path} is a MATLAB file, but not laid out as NetVLAD's ({error}); {advice}") from error
    return NetVlad(weights)


def _weights(net: Any) -> Weights:
    """Weights from MATLAB's struct.

    Raises:
        KeyError, AttributeError, IndexError, TypeError, ValueError: if something is not where it should be.
    """

    def pair(layer: int) -> tuple[Float32[np.ndarray, "*first"], Float32[np.ndarray, "*second"]]:
        first, second = net.layers[layer].weights
        return np.asarray(first, np.float32), np.asarray(second, np.float32)

    def convolution(layer: int) -> tuple[Tensor, Tensor]:
        kernel, bias = pair(layer)  # rows, columns, in, out
        return torch.from_numpy(kernel.transpose(3, 2, 0, 1).copy()), torch.from_numpy(bias.ravel())

    convolutions = tuple(tuple(convolution(layer) for layer in block) for block in _BLOCKS)
    assignment, negated_centers = pair(_AGGREGATION)
    whitening, bias = pair(_WHITENING)
    mean_color = np.asarray(net.meta.normalization.averageImage, np.float32).reshape(-1, 3)[0]
    channels = 3
    for kernel, offset in (each for block in convolutions for each in block):
        if kernel.shape[1] != channels or offset.shape != kernel.shape[:1]:
            raise ValueError(f"a kernel of shape {tuple(kernel.shape)} after {channels} channels")
        channels = kernel.shape[0]
    if assignment.shape != negated_centers.shape or assignment.shape[0] != channels:
        raise ValueError(f"centres of shape {negated_centers.shape} for {channels} channels")
    if whitening.shape != (assignment.size, bias.size):
        raise ValueError(f"a whitening of shape {whitening.shape} for {assignment.size} numbers")
    return Weights(
        convolutions,
        torch.from_numpy(assignment),
        -torch.from_numpy(negated_centers),
        torch.from_numpy(whitening),
        torch.from_numpy(bias.ravel()),
        torch.from_numpy(mean_color),
    )
