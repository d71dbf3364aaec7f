r"""Temporal confidence: equations 4 to 25 of TCGSplat, one function each, in the paper's order.

Pure functions of tensors: no state, no settings objects, no devices, no `no_grad`. Whether gradients are kept is the
caller's choice, because the stability loss differentiates the self-distance and the confidence update does not.

Time is counted in mapping updates of a submap. `n` Gaussians, `h w` pixels; lengths in metres.
"""

import math
from typing import Literal

import torch
from jaxtyping import Float, Real
from torch import Tensor

from tcgsplat.geometry import quaternion
from tcgsplat.tensors import Mask, PerGaussian, PerGaussianFlag, Plane

# Section 3.2: how a Gaussian's confidence evolves.


def decay(confidence: PerGaussian, *, decay_time: float, p_min: float, elapsed: float = 1.0) -> PerGaussian:
    r"""Let confidence fade towards its floor.

    $p^- = p_{min} + (p - p_{min}) \exp(-\Delta t / \tau)$  (Eq. 4)

    Args:
        confidence: $p$ after the previous mapping update, in [p_min, 1].
        decay_time: $\tau$, mapping updates until 1/e of the height above the floor is left; infinite for no decay.
        p_min: Floor of every confidence, in (0, 1).
        elapsed: $\Delta t$, mapping updates; the paper uses 1.

    Returns:
        Confidence before the feedback of this update, in [p_min, 1].
    """
    return p_min + (confidence - p_min) * math.exp(-elapsed / decay_time)


def _length(vectors: Float[Tensor, "n 3"]) -> PerGaussian:
    """Euclidean norm with gradient zero, not NaN, at zero: where the stability loss begins every mapping update."""
    length: Tensor = torch.linalg.vector_norm(vectors, dim=-1)
    return length


def mean_change(means: Float[Tensor, "n 3"], means_before: Float[Tensor, "n 3"]) -> PerGaussian:
    r"""How far the centres moved in one mapping update, metres.

    $d_\mu = \|\mu^t - \mu^{t-1}\|_2$  (Eq. 5)

    Differentiable everywhere; the gradient at no change is zero.
    """
    return _length(means - means_before)


def scale_change(
    log_scales: Float[Tensor, "n 3"], log_scales_before: Float[Tensor, "n 3"], *, epsilon: float = 1e-8
) -> PerGaussian:
    r"""How much the extents changed in one mapping update: norm of the log ratios, unitless.

    $d_s = \|\log(s^t + \epsilon) - \log(s^{t-1} + \epsilon)\|_2$  (Eq. 6)

    Args:
        log_scales: Natural logarithm of the standard deviations $s$ (metres): the stored parameter, not $s$ itself.
        log_scales_before: The same before the mapping update.
        epsilon: Metres; far below the smallest splat, it only keeps a vanished scale finite.

    Returns:
        $d_s \ge 0$; its gradient at no change is zero.
    """
    log_epsilon = log_scales.new_full((), math.log(epsilon))
    shifted, shifted_before = torch.logaddexp(log_scales, log_epsilon), torch.logaddexp(log_scales_before, log_epsilon)
    return _length(shifted - shifted_before)


def rotation_change(quats: Float[Tensor, "n 4"], quats_before: Float[Tensor, "n 4"]) -> PerGaussian:
    r"""How far the axes turned in one mapping update: the squared sine of half the angle, unitless, in [0, 1].

    $d_q = 1 - |\langle q^t, q^{t-1} \rangle|^2$  (Eq. 7)

    Quaternions (wxyz) of any non-zero length are normalised here; `q` and `-q` count as equal.
    """
    cosine = (quaternion.normalize(quats) * quaternion.normalize(quats_before)).sum(dim=-1)
    return torch.relu(1.0 - cosine.square())  # rounding must not make a change negative


def self_distance(
    mean_change: PerGaussian,
    scale_change: PerGaussian,
    rotation_change: PerGaussian,
    *,
    scale_weight: float,
    rotation_weight: float,
) -> PerGaussian:
    r"""How far a Gaussian is from itself before a mapping update, metres.

    $d = d_\mu + \lambda_s d_s + \lambda_q d_q$  (Eq. 8)

    Args:
        mean_change: $d_\mu$, metres.
        scale_change: $d_s$, unitless.
        rotation_change: $d_q$, unitless.
        scale_weight: $\lambda_s$ of the self-distance, metres (not the weight of SSIM that shares its symbol).
        rotation_weight: $\lambda_q$, metres.
    """
    return mean_change + scale_weight * scale_change + rotation_weight * rotation_change


def residual_map(
    color_residual: Plane, depth_residual: Plane, depth_valid: Mask, *, color_weight: float, depth_weight: float
) -> Plane:
    r"""How badly the map explains each pixel of the current view.

    $R(u) = \lambda_{rgb} r_{rgb}(u) + \lambda_d M_D(u) r_d(u)$  (Eq. 9)

    Args:
        color_residual: $r_{rgb} \ge 0$, in units of the colour range [0, 1].
        depth_residual: $r_d \ge 0$, metres; anything, NaN included, where `depth_valid` is false.
        depth_valid: $M_D$, pixels with a depth reading.
        color_weight: $\lambda_{rgb}$.
        depth_weight: $\lambda_d$ of the residual, per metre (not the weight of the losses that shares its symbol).
    """
    return color_weight * color_residual + depth_weight * torch.where(depth_valid, depth_residual, 0.0)


def sample_at(plane: Plane, pixels: Float[Tensor, "n 2"]) -> PerGaussian:
    r"""Value of the nearest pixel: $r_i = R(u_i)$ at projected centres (column, row; integers are pixel centres).

    A centre outside the image, behind the camera or not finite reads some pixel of the image: mask it.
    """
    height, width = plane.shape
    columns, rows = pixels.round().long().unbind(-1)
    return plane[rows.clamp(0, height - 1), columns.clamp(0, width - 1)]


def observation_quality(residual: PerGaussian, *, residual_ref: float) -> PerGaussian:
    r"""How well an observation is explained: 1 without residual, 1/e at the reference.

    $Q_r = \exp(-r / r_{ref})$  (Eq. 10)

    Args:
        residual: $r \ge 0$ of equation 9 at the projected centres.
        residual_ref: $r_{ref} > 0$, in the units of the residual.
    """
    return torch.exp(-residual / residual_ref)


def relative_stability(baseline: PerGaussian, distance: PerGaussian, *, scale: float) -> PerGaussian:
    r"""Did a Gaussian move less (> 0) or more (< 0) than it used to? In (-1, 1).

    $\xi = \tanh((\bar d - d) / \sigma_d)$  (Eq. 11)

    Args:
        baseline: $\bar d$ before its update of equation 15, metres.
        distance: $d$ of this mapping update, metres.
        scale: $\sigma_d$, metres: the excess that counts as clear.
    """
    return torch.tanh((baseline - distance) / scale)


def feedback(
    quality: PerGaussian, stability: PerGaussian, *, excitation_gain: float, penalty_gain: float
) -> tuple[PerGaussian, PerGaussian]:
    r"""Excitation of a Gaussian that calms down, penalty of one that is stirred up; never both.

    $A = \gamma_+ Q_r [\xi]_+, \quad B = \gamma_- [-\xi]_+$  (Eq. 12)

    Args:
        quality: $Q_r$, in [0, 1]; scales the excitation only, so that a bad explanation is not rewarded.
        stability: $\xi$, in [-1, 1].
        excitation_gain: $\gamma_+ \ge 0$.
        penalty_gain: $\gamma_- \ge 0$.

    Returns:
        $A$ and $B$, both not negative.
    """
    return excitation_gain * quality * torch.relu(stability), penalty_gain * torch.relu(-stability)


def apply_feedback(
    decayed: PerGaussian, excitation: PerGaussian, penalty: PerGaussian, *, rate: float, p_min: float
) -> PerGaussian:
    r"""Pull the decayed confidence towards 1 or towards its floor.

    $p = \mathrm{clip}(p^- + \eta A (1 - p^-) - \eta B (p^- - p_{min}))$  (Eq. 13)

    Args:
        decayed: $p^-$ of equation 4, in [p_min, 1].
        excitation: $A \ge 0$ of equation 12, or of equation 14 on a first observation.
        penalty: $B \ge 0$ of equation 12; zero on a first observation.
        rate: $\eta$, unitless, in (0, 1].
        p_min: Floor of every confidence, in (0, 1).

    Returns:
        Confidence after this mapping update, in [p_min, 1].
    """
    gain = rate * excitation * (1.0 - decayed)
    loss = rate * penalty * (decayed - p_min)
    return (decayed + gain - loss).clamp(p_min, 1.0)


def first_excitation(
    distance: PerGaussian, residual: PerGaussian, *, distance_ref: float, residual_ref: float
) -> PerGaussian:
    r"""Excitation on a first observation, when there is no baseline to compare with; the penalty is zero then.

    $A = \exp(-d / d_{ref} - r / r_{ref})$  (Eq. 14)

    Args:
        distance: $d$ of this mapping update, metres.
        residual: $r \ge 0$ of equation 9 at the projected centres.
        distance_ref: $d_{ref} > 0$, metres.
        residual_ref: $r_{ref} > 0$, in the units of the residual.

    Returns:
        $A$ in [0, 1].
    """
    return torch.exp(-distance / distance_ref - residual / residual_ref)


def update_baseline(baseline: PerGaussian, distance: PerGaussian, *, rate: float) -> PerGaussian:
    r"""Moving average of the self-distance, after the confidence has been judged against the old one.

    $\bar d^t = (1 - \beta) \bar d^{t-1} + \beta d^t$  (Eq. 15)

    Args:
        baseline: $\bar d^{t-1}$, metres.
        distance: $d^t$, metres.
        rate: $\beta$ in (0, 1]: the memory is about 1 / rate observations.
    """
    return (1.0 - rate) * baseline + rate * distance


def calibrate_age(confidence: PerGaussian, born: Real[Tensor, " n"], *, decay_time: float, p_min: float) -> PerGaussian:
    r"""Make up for the decay that a Gaussian missed before it was created, once, when its submap is finished.

    $p_{sub} = p_{min} + (p - p_{min}) \exp(-b / \tau)$  (Eq. 16)

    Args:
        confidence: $p$ at the end of the submap, in [p_min, 1].
        born: $b$, mapping updates of the submap before the Gaussian was created.
        decay_time: $\tau$ of equation 4, mapping updates.
        p_min: Floor of every confidence, in (0, 1).
    """
    return p_min + (confidence - p_min) * torch.exp(-born.to(confidence) / decay_time)


# Section 3.3: what confidence guides.


def composite(alphas: Float[Tensor, "*pixels k"], values: Float[Tensor, "*pixels k"]) -> Float[Tensor, "*pixels"]:
    r"""The confidence map from the Gaussians of each pixel: the definition that rasterizers are held to.

    $P(u) = \sum_i T_i(u) \alpha_i(u) p_i, \quad T_i = \prod_{j<i} (1 - \alpha_j)$  (Eq. 17)

    In a run the rasterizer composites confidence as one more colour channel. The sum is not divided by alpha, so that
    P never exceeds it: what the map does not cover counts as low confidence.

    Args:
        alphas: Contributions in [0, 1] from front to back along the last axis.
        values: Confidences in the same order.
    """
    through = torch.cumprod(1.0 - alphas, dim=-1)
    transmittance = torch.cat((torch.ones_like(alphas[..., :1]), through[..., :-1]), dim=-1)
    return (transmittance * alphas * values).sum(dim=-1)


def tracking_weight(confidence_map: Plane, *, floor: float) -> Plane:
    r"""Weight of a pixel when the camera is tracked: reliable surfaces hold it, no pixel is lost.

    $W_{tr}(u) = w_{min} + (1 - w_{min}) P(u)$  (Eq. 18)

    Args:
        confidence_map: $P$ of equation 17, detached: a pose must not gain by looking at unreliable surfaces.
        floor: $w_{min}$ in (0, 1].

    Returns:
        Weights in [floor, 1].
    """
    return floor + (1.0 - floor) * confidence_map


def tracking_loss(
    weight: Plane, color_residual: Plane, depth_residual: Plane, *, color_weight: float, depth_weight: float
) -> Float[Tensor, ""]:
    r"""What tracking minimises over the pose of the camera.

    $L_{tr} = \sum_u W_{tr}(u) [\lambda_c L_{rgb}(u) + \lambda_d L_{depth}(u)]$  (Eq. 19)

    Args:
        weight: $W_{tr}$.
        color_residual: $L_{rgb}$, zero on masked pixels.
        depth_residual: $L_{depth}$, metres, zero on masked pixels.
        color_weight: $\lambda_c$.
        depth_weight: $\lambda_d$, per metre.
    """
    return (weight * (color_weight * color_residual + depth_weight * depth_residual)).sum()


def mapping_weight(confidence_map: Plane, *, doubt: float = 1.0) -> Plane:
    r"""Let mapping work more, or less, where the map is doubted.

    $W_{map}(u) = 1 + k (1 - P(u))$  (Eq. 20)

    Args:
        confidence_map: $P$ of equation 17, detached.
        doubt: $k > -1$: how much more what is wholly doubted weighs; the paper has no k, which is to say 1.

    Returns:
        Weights between 1 and 1 + k; 1 + k where there is no map.
    """
    return 1.0 + doubt * (1.0 - confidence_map)


def mapping_loss(
    weight: Plane,
    color_residual: Plane,
    depth_residual: Plane,
    ssim_loss: Float[Tensor, ""],
    regularization: Float[Tensor, ""],
    stability: Float[Tensor, ""],
    *,
    color_weight: float | Float[Tensor, ""],
    depth_weight: float | Float[Tensor, ""],
    ssim_weight: float,
    regularization_weight: float,
) -> Float[Tensor, ""]:
    r"""What mapping minimises over the Gaussians.

    $L_{map} = \sum_u W_{map}(u) [\lambda_c L_{rgb}(u) + \lambda_d L_{depth}(u)]
    + \lambda_s L_{ssim} + \lambda_r L_{reg} + L_{stab}$  (Eq. 21)

    The base system takes means over the valid pixels; give color_weight / pixels and depth_weight / pixels for that,
    as tensors where a device has counted the pixels.

    Args:
        weight: $W_{map}$.
        color_residual: $L_{rgb}$, zero on masked pixels.
        depth_residual: $L_{depth}$, metres, zero on masked pixels.
        ssim_loss: $L_{ssim}$, one minus the structural similarity.
        regularization: $L_{reg}$, the base system's isotropy term.
        stability: $L_{stab}$ of equation 23, its weight included.
        color_weight: $\lambda_c$.
        depth_weight: $\lambda_d$ of the loss, per metre.
        ssim_weight: $\lambda_s$ of the loss.
        regularization_weight: $\lambda_r$.
    """
    reconstruction = (weight * (color_weight * color_residual + depth_weight * depth_residual)).sum()
    return reconstruction + ssim_weight * ssim_loss + regularization_weight * regularization + stability


def abnormal_change(distance: PerGaussian, baseline: PerGaussian) -> PerGaussian:
    r"""By how much a Gaussian moves more than it used to, metres; zero if it moves less.

    $\Delta d = [d - \bar d]_+$  (Eq. 22)

    Args:
        distance: $d$ of equation 8 between the parameters being optimised and those before this mapping update.
        baseline: $\bar d$ before this update, a constant.
    """
    return torch.relu(distance - baseline)


def maturity(confidence: PerGaussian, age: Real[Tensor, " n"], *, maturity_time: float) -> PerGaussian:
    r"""How much a Gaussian has earned to be left alone: $\kappa = p (1 - \exp(-a / \tau_a))$, in [0, 1).

    Args:
        confidence: $p$ after the previous mapping update.
        age: $t - b$ in mapping updates; a negative age counts as none.
        maturity_time: $\tau_a > 0$, mapping updates.
    """
    return confidence * (1.0 - torch.exp(-age.to(confidence).clamp_min(0.0) / maturity_time))


def allowed_change(maturity: PerGaussian, *, slack_min: float, slack_max: float) -> PerGaussian:
    r"""Abnormal change that costs nothing: $\delta_{max} - \kappa (\delta_{max} - \delta_{min})$, metres.

    Args:
        maturity: $\kappa$, in [0, 1].
        slack_min: $\delta_{min}$, metres, allowed to the fully mature.
        slack_max: $\delta_{max}$, metres, allowed to the new and the doubtful.
    """
    return slack_max - maturity * (slack_max - slack_min)


def stability_loss(
    abnormal: PerGaussian,
    maturity: PerGaussian,
    counted: PerGaussianFlag,
    *,
    weight: float,
    slack_min: float,
    slack_max: float,
    reduction: Literal["mean", "sum"] = "mean",
) -> Float[Tensor, ""]:
    r"""Penalty on abnormal change beyond a slack that shrinks as a Gaussian matures.

    $L_{stab} = \lambda_{stab} \frac{1}{|V|} \sum_{i \in V}
    [\Delta d_i - (\delta_{max} - \kappa_i (\delta_{max} - \delta_{min}))]_+$  (Eq. 23)

    Args:
        abnormal: $\Delta d$ of equation 22, metres.
        maturity: $\kappa$, in [0, 1].
        counted: $V$: in view, there before this mapping update, and with a baseline to compare with.
        weight: $\lambda_{stab}$, per metre.
        slack_min: $\delta_{min}$, metres, allowed to the fully mature.
        slack_max: $\delta_{max}$, metres, allowed to the new and the doubtful.
        reduction: "mean" is the paper's. Its gradient for one Gaussian is weight / |V|, with 1e5 Gaussians in view
            about a thousandth of that of a mean photometric loss; "sum" leaves the division by |V| out.

    Returns:
        A loss that is zero, and has a zero gradient, when nothing is counted or nothing moves.
    """
    allowed = allowed_change(maturity, slack_min=slack_min, slack_max=slack_max)
    total = weight * torch.where(counted, torch.relu(abnormal - allowed), 0.0).sum()
    return total / counted.sum().clamp_min(1) if reduction == "mean" else total


def step_scale(confidence: PerGaussian, *, smallest: float, largest: float, p_min: float) -> PerGaussian:
    r"""How boldly the geometry of a Gaussian is optimised: its centre, scales and rotation, not its colour or opacity.

    $g = g_{min} + (g_{max} - g_{min}) (1 - p) / (1 - p_{min})$  (Eq. 24)

    Args:
        confidence: $p$ after the previous mapping update, in [p_min, 1].
        smallest: $g_{min}$, reached at p = 1.
        largest: $g_{max}$, reached at p = p_min.
        p_min: Floor of every confidence, in (0, 1).
    """
    return smallest + (largest - smallest) * (1.0 - confidence) / (1.0 - p_min)


def rerank_score(
    score: Float[Tensor, " v"], view_confidence: Float[Tensor, " v"], *, floor: float
) -> Float[Tensor, " v"]:
    r"""Descriptor score of a preselected viewpoint, lowered where it looks at an unreliable part of its map.

    $\tilde S = S [w^{lc}_{min} + (1 - w^{lc}_{min}) C]$  (Eq. 25)

    Args:
        score: $S$, similarity of descriptors, for v viewpoints.
        view_confidence: $C$ in [0, 1], mean confidence over the well covered pixels of each view.
        floor: $w^{lc}_{min}$ in [0, 1].
    """
    return score * (floor + (1.0 - floor) * view_confidence)
