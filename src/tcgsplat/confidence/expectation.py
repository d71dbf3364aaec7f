r"""The depth error to expect of a Gaussian: the default model of confidence, in the place of equations 4 to 16.

A Gaussian is born with the error that its reading may have, and remembers how far the map was from each later frame
before that frame was used, wherever it was drawn itself. Confidence falls from 1 as that error grows. What is not seen
stays as it is, however long; what is seen again and again as it was expected gains.

`n` Gaussians, `h w` pixels; lengths in metres. Pure functions of tensors, as in `equations`.
"""

import torch
from torch.nn import functional

from tcgsplat.tensors import PerGaussian, Plane

NEAREST = 0.4
"""Where a depth sensor's noise is least, metres (Nguyen et al., 3DIMPVT 2012)."""


def noise(depth: Plane, *, noise_floor: float, noise_slope: float) -> Plane:
    r"""Spread of a depth reading, metres: $\sigma(z) = floor + slope (z - 0.4)^2$; see `reading_error`."""
    return noise_floor + noise_slope * (depth - NEAREST).square()


def reading_error(depth: Plane, *, noise_floor: float, noise_slope: float, largest: float) -> Plane:
    r"""The error that a depth reading may have, metres: its noise, and what it may be off beside an edge.

    $e_0(u) = \sigma(D(u)) + |\max_{v \in N(u)} D(v) + \min_{v \in N(u)} D(v) - 2 D(u)|$
    with $\sigma(z) = floor + slope (z - 0.4)^2$ and N(u) the 3 x 3 readings about u. The second term is zero on
    a plane, however slanted, and the height of the step beside a step: there a sensor gives one depth or the other. At
    the border of the image and beside a hole, where a neighbour is missing, it is the slope over a pixel.

    Args:
        depth: Readings, metres; 0 where there is none.
        noise_floor: At 0.4 m, metres.
        noise_slope: Growth with the square of the distance beyond it, 1/metre.
        largest: Nothing is expected to be farther off than that, metres.

    Returns:
        In [noise_floor, largest] where there is a reading; `largest` where there is none.
    """
    read = depth > 0
    far, near = _farthest(depth), -_farthest(torch.where(read, -depth, -torch.inf))
    spread = noise(depth, noise_floor=noise_floor, noise_slope=noise_slope)
    return torch.where(read, spread + (far + near - 2 * depth).abs(), largest).clamp_max(largest)


def _farthest(depth: Plane) -> Plane:
    """Of each pixel and its eight neighbours: down, then across, a quarter of the time of `max_pool2d` on a CPU."""
    padded = functional.pad(depth, (1, 1, 1, 1), value=-torch.inf)
    columns = torch.maximum(torch.maximum(padded[:-2], padded[1:-1]), padded[2:])
    return torch.maximum(torch.maximum(columns[:, :-2], columns[:, 1:-1]), columns[:, 2:])


def remembered(
    expected: PerGaussian, evidence: PerGaussian, pixels: PerGaussian, errors: PerGaussian, *, memory: float
) -> tuple[PerGaussian, PerGaussian]:
    r"""What is expected after one more frame, and on how much that rests.

    $n' = f n + \Delta n, \quad e' = (f n e + \Delta s) / n', \quad f = \lambda^{\min(1, \Delta n)}$
    with $\Delta n = \sum_u w(u) M(u)$ and $\Delta s = \sum_u w(u) M(u) |\hat D(u) - D(u)|$, where w is the weight
    $T \alpha$ of the Gaussian in a pixel, M tells where the map and the frame both have a depth, and $\hat D$ is the
    depth of the map before it has seen the frame. Who is hardly seen hardly forgets.

    Args:
        expected: $e$, metres.
        evidence: $n \ge 0$, pixels.
        pixels: $\Delta n \ge 0$; where it is 0 nothing changes.
        errors: $\Delta s$, metres times pixels.
        memory: $\lambda$ in (0, 1]: what is left of the evidence after a frame that shows a pixel of the Gaussian.

    Returns:
        $e'$ and $n'$.
    """
    seen = pixels > 0
    kept = memory ** pixels.clamp_max(1.0) * evidence
    total = kept + pixels
    mean = (kept * expected + errors) / total.clamp_min(torch.finfo(total.dtype).tiny)
    return torch.where(seen, mean, expected), torch.where(seen, total, evidence)


def confidence(expected: PerGaussian, *, error_ref: float, p_min: float) -> PerGaussian:
    r"""Confidence of what is expected to be off by so much.

    $p = p_{min} + (1 - p_{min}) / (1 + e / e_{ref})$

    Args:
        expected: $e \ge 0$, metres.
        error_ref: $e_{ref}$, metres, at which half of the way to the floor is gone.
        p_min: Floor of every confidence.
    """
    return p_min + (1.0 - p_min) / (1.0 + expected / error_ref)


def expected_error(confidence: Plane, *, error_ref: float, p_min: float) -> Plane:
    r"""The error that makes a confidence, metres; the inverse of `confidence`, infinite at the floor and below.

    Args:
        confidence: p, of a Gaussian or of a pixel.
        error_ref: $e_{ref}$, metres.
        p_min: Floor of every confidence.
    """
    share = (confidence - p_min).clamp_min(0.0) / (1.0 - p_min)
    return (error_ref * (1.0 / share - 1.0)).clamp_min(0.0)
