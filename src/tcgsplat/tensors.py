"""Names for the tensor shapes that cross module borders: n Gaussians, h w pixels, c channels."""

from jaxtyping import Bool, Float, Int
from torch import Tensor

Pose = Float[Tensor, "4 4"]
"""Rigid transform `T_a_b`, mapping coordinates of b to a; float64 until it meets a rasterizer."""

Plane = Float[Tensor, "h w"]
"""One number a pixel: depth in metres, alpha, confidence, a residual."""

Image = Float[Tensor, "h w 3"]
"""RGB in [0, 1]."""

Mask = Bool[Tensor, "h w"]
PerGaussian = Float[Tensor, " n"]
PerGaussianFlag = Bool[Tensor, " n"]
Ids = Int[Tensor, " n"]
"""Unique Gaussian ids, int64."""
