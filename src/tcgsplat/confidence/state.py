"""Placeholder; the equations' composition comes with them."""

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tcgsplat.tensors import PerGaussian, PerGaussianFlag


@dataclass(frozen=True)
class ConfidenceConfig:
    initial: float = 0.3


@dataclass(frozen=True)
class ConfidenceState:
    """One row per Gaussian, aligned with `Gaussians`; never a leaf of autograd."""

    value: PerGaussian
    """p in [p_min, 1]."""
    baseline: PerGaussian
    """EMA of the self-distance, d-bar of Eq. 15, metres."""
    born: Int[Tensor, " n"]
    """b: mapping updates of the submap before this Gaussian was created."""
    updates: Int[Tensor, " n"]
    """n_EMA: valid observations so far."""
