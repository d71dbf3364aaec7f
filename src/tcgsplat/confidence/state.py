"""What is remembered of every Gaussian, and the two transitions that Section 3.2 of the paper puts it through."""

import math
from dataclasses import dataclass, fields, replace
from typing import Literal

import torch
from jaxtyping import Int
from torch import Tensor

from tcgsplat.confidence import equations as eq
from tcgsplat.confidence import expectation
from tcgsplat.errors import ConfigError
from tcgsplat.tensors import PerGaussian, PerGaussianFlag

MODELS = ("expectation", "paper", "constant", "shuffled")


@dataclass(frozen=True)
class ConfidenceConfig:
    """How confidence evolves and what it guides. The paper states six of these values and leaves the others open.

    The defaults suit mapping updates of 100 Adam steps. Four lengths (`distance_ref`, `stability_scale`, `slack_min`,
    `slack_max`) live on the scale of the self-distance of a Gaussian at rest. That is a random walk of the optimiser,
    so it grows with the square root of the steps in an update and in proportion to the learning rates. Simulated with
    pure noise as gradient at the base system's rates, fresh Adam moments in every update (median, 90 %): 3.6 mm and
    5.0 mm after 100 steps, 1.8 and 2.4 after 20, 1.3 and 1.7 after 10. `for_updates_of` scales the four lengths.
    """

    model: Literal["expectation", "paper", "constant", "shuffled"] = "expectation"
    """Where confidence comes from [ours]: `expectation`, the depth error that is to be expected of a Gaussian, from its
    reading and from what later frames showed before they were used (`confidence/expectation.py`); `paper`, equations 4
    to 16. Two more are controls for experiments: `constant`, always `initial`; `shuffled`, as `expectation`, but each
    Gaussian has that of another one, half of the map away in the order of birth: as much doubt, in the wrong places."""
    error_ref: float = 0.1
    """Expected error at which half of the confidence above the floor is gone, metres [ours]: well above what a sensor's
    noise explains (2.6 cm at 4 m), which tracking allows for by itself, and well below a wrong surface."""
    error_max: float = 0.5
    """No error counts for more, metres [ours]: a wrong surface is wrong, by however much."""
    error_memory: float = 0.9
    """What is left of the evidence after another frame that shows a Gaussian, in (0, 1] [ours]: it remembers ten
    mapped frames, as `baseline_rate` does, so that what has begun to move is soon found out."""
    error_prior: float = 4.0
    """Pixels that the error of the reading counts for at birth [ours]: a few, as the reading is one, so that the first
    frame that draws the Gaussian decides as much."""
    noise_floor: float = 0.0017
    """Depth noise at 0.4 m, metres [ours]: a structured-light sensor's (Nguyen et al. 2012), as in tracking."""
    noise_slope: float = 0.0019
    """Growth of depth noise with the square of the distance beyond 0.4 m, 1/metre [ours]: as in tracking."""
    p_min: float = 0.1
    """p_min, unitless, in (0, 1) [ours]: no pixel's tracking weight falls below 0.28, and p spans ten to one."""
    initial: float = 0.3
    """p at birth, unitless, in [p_min, 1] [ours]: new surface counts about half of mature surface in tracking."""
    decay_time: float = 100.0
    """tau, mapping updates; inf for no decay [ours]: twice the updates of a submap, or equation 16 would crush
    Gaussians that are born late."""
    scale_change_weight: float = 0.02
    """lambda_s of equation 8, metres per unit of log-scale [ours]: makes the noise of scales weigh as much as that of
    centres; one or two splat sizes."""
    rotation_change_weight: float = 1.0
    """lambda_q of equation 8, metres [ours]: 0.25 mm at rest, 6 mm while turning into place; 5 would let the rotation
    of nearly round splats dominate."""
    color_residual_weight: float = 1.0
    """lambda_rgb of equation 9, per unit of the colour range [ours]: about the balance of the mapping loss."""
    depth_residual_weight: float = 1.0
    """lambda_d of equation 9, per metre [ours]: about the balance of the mapping loss."""
    residual_ref: float = 0.10
    """r_ref, units of equation 9 [ours]: quality 0.85 on clean data, 0.4 to 0.55 on real data, below 0.05 where
    something else stands in front."""
    distance_ref: float = 0.01
    """d_ref, metres per mapping update [ours]: a Gaussian at rest begins with 0.7 of the full excitation, one still
    converging with 0.14. Scales with the steps per update."""
    stability_scale: float = 2e-3
    """sigma_d, metres per mapping update [ours]: 2 standard deviations at rest, so that jitter stays on the straight
    part of tanh and a jump of 4 mm saturates it. Scales with the steps per update."""
    excitation_gain: float = 1.0
    """gamma_+, unitless [ours]: the natural unit, as quality is at most 1."""
    penalty_gain: float = 0.3
    """gamma_-, unitless [ours]: below gamma_+, as a Gaussian at rest exceeds its own average half of the time and
    would sink for being average."""
    update_rate: float = 0.3
    """eta, unitless, in (0, 1] [ours]: ten good updates take 0.3 to 0.9, half of a submap."""
    baseline_rate: float = 0.1
    """beta, unitless, in (0, 1] [ours]: remembers ten observations, so that a converging Gaussian is seen to calm."""
    maturity_time: float = 10.0
    """tau_a, mapping updates [ours]: two thirds mature after a fifth of a submap."""
    slack_min: float = 2e-3
    """delta_min, metres per mapping update [ours]: the jitter of a mature Gaussian at rest. Scales with the steps."""
    slack_max: float = 1e-2
    """delta_max, metres per mapping update [ours]: a new Gaussian may jump by three times its rest noise. Scales with
    the steps."""
    stability_weight: float = 0.01
    """lambda_stab, per metre [paper]."""
    stability_reduction: Literal["mean", "sum"] = "sum"
    """How equation 23 adds up the Gaussians in view [ours]: "mean" is the paper's formula and next to inert (with
    1e5 Gaussians a thousandth of the photometric gradient); "sum" acts on each Gaussian whatever their number."""
    tracking_floor: float = 0.2
    """w_min, unitless, in (0, 1] [paper]."""
    view_floor: float = 0.5
    """w_min of loop closure, unitless, in [0, 1] [ours]: changes scores by at most a quarter, about their spread."""
    doubt_weight: float = -0.8
    """k of equation 20, unitless, above -1 [ours]: what is doubted weighs as little in mapping as in tracking at w_min
    0.2, since to doubt is not to trust here, and not to want more views; the paper's is 1."""
    step_scale_min: float = 1.0
    """g_min, unitless [ours]: what is trusted moves as it would without confidence; at the paper's 0.8 the few steps of
    an update do not reach as far, which costs 0.1 dB."""
    step_scale_max: float = 1.4
    """g_max, unitless [ours]: 0.4 above g_min, as the paper's 1.2."""
    step_scale_mode: Literal["step", "gradient"] = "step"
    """What equation 24 multiplies [ours]: "gradient" is the paper's text, and Adam cancels it; "step" is what Adam
    makes of the gradient."""
    guide_mapping: bool = True
    """Use confidence in mapping: equations 20 to 24 [paper]. The three switches make its ablation."""
    guide_tracking: bool = True
    """Use confidence in tracking: equation 18 [paper]."""
    rerank_views: bool = True
    """Use confidence in loop closure: equation 25 [paper]."""

    def __post_init__(self) -> None:
        """Refuse what cannot be right, or would only show as a strange map an hour later."""
        self._require("p_min", 0 < self.p_min < 1, "above 0 and below 1")
        self._require("initial", self.p_min <= self.initial <= 1, f"between p_min ({self.p_min:g}) and 1")
        self._require("decay_time", self.decay_time > 0, "above 0 mapping updates (inf for no decay)")
        self._require("model", self.model in MODELS, " or ".join(f'"{name}"' for name in MODELS))
        for name in ("residual_ref", "distance_ref", "stability_scale", "maturity_time", "error_ref", "error_max"):
            self._require(name, 0 < getattr(self, name) < math.inf, "above 0 and finite")
        for name in (
            "scale_change_weight",
            "rotation_change_weight",
            "color_residual_weight",
            "depth_residual_weight",
            "excitation_gain",
            "penalty_gain",
            "stability_weight",
            "slack_min",
            "step_scale_min",
            "error_prior",
            "noise_floor",
            "noise_slope",
        ):
            self._require(name, 0 <= getattr(self, name) < math.inf, "at least 0 and finite")
        for name in ("update_rate", "baseline_rate", "tracking_floor", "error_memory"):
            self._require(name, 0 < getattr(self, name) <= 1, "above 0 and at most 1")
        self._require("doubt_weight", -1 < self.doubt_weight < math.inf, "above -1 and finite")
        self._require("view_floor", 0 <= self.view_floor <= 1, "between 0 and 1")
        for name in ("slack", "step_scale"):
            low = getattr(self, f"{name}_min")
            high = f"{name}_max"
            self._require(high, low <= getattr(self, high) < math.inf, f"at least {name}_min ({low:g}) and finite")
        self._require("stability_reduction", self.stability_reduction in ("mean", "sum"), '"mean" or "sum"')
        self._require("step_scale_mode", self.step_scale_mode in ("step", "gradient"), '"step" or "gradient"')

    def for_updates_of(self, steps: int) -> "ConfidenceConfig":
        """The same model for mapping updates of `steps` Adam steps: its four lengths scaled by sqrt(steps / 100).

        Call it on values that suit 100 steps, as the defaults do.
        """
        factor = math.sqrt(steps / 100)
        lengths = ("distance_ref", "stability_scale", "slack_min", "slack_max")
        return replace(self, **{name: factor * getattr(self, name) for name in lengths})

    def _require(self, name: str, holds: bool, allowed: str) -> None:
        if not holds:
            raise ConfigError(f"confidence.{name} is {getattr(self, name)!r}; it must be {allowed}")


@dataclass(frozen=True)
class Observation:
    """What one mapping update showed of the Gaussians: one row each, aligned with the state that it is given to."""

    valid: PerGaussianFlag
    """Visible in the current view, and there both before and after the update."""
    distance: PerGaussian
    """Self-distance d of equation 8 over the update, metres; anything where not valid."""
    residual: PerGaussian
    """r: the residual map of equation 9 at the projected centre; anything where not valid."""


@dataclass(frozen=True)
class ConfidenceState:
    """One row per Gaussian, aligned with `Gaussians`; rows are only ever appended and kept together with theirs.

    Updated from observations, never by an optimiser: no tensor here takes part in autograd.
    """

    value: PerGaussian
    """p in [p_min, 1]."""
    baseline: PerGaussian
    """d-bar, metres per mapping update: moving average of the self-distance; 0 until the first valid observation."""
    born: Int[Tensor, " n"]
    """b: mapping updates of the submap before this Gaussian was created."""
    updates: Int[Tensor, " n"]
    """n_EMA: valid observations so far."""
    expected_error: PerGaussian
    """Of depth, metres; 0 where nothing is known."""
    evidence: PerGaussian
    """Pixels that the expected error rests on."""

    def __len__(self) -> int:
        return int(self.value.shape[0])

    @staticmethod
    def empty(device: torch.device | None = None) -> "ConfidenceState":
        """Of no Gaussians yet."""
        nothing = torch.zeros(0, device=device)
        none = torch.zeros(0, dtype=torch.int64, device=device)
        return ConfidenceState(
            value=nothing, baseline=nothing, born=none, updates=none, expected_error=nothing, evidence=nothing
        )

    @staticmethod
    def born_at(
        clock: int,
        n: int,
        config: ConfidenceConfig,
        *,
        expected_error: PerGaussian | None = None,
        device: torch.device | None = None,
    ) -> "ConfidenceState":
        """Of `n` Gaussians created after `clock` mapping updates of their submap, not yet observed.

        Args:
            clock: Mapping updates.
            n: How many.
            config: For their first confidence.
            expected_error: Of each one's depth, metres; if it is not known, confidence begins at `initial`.
            device: Of the state.
        """
        value, evidence = torch.full((n,), config.initial, device=device), torch.zeros(n, device=device)
        error = torch.zeros(n, device=device)
        if expected_error is not None and config.model != "paper":
            error, evidence = expected_error.to(error), torch.full_like(evidence, config.error_prior)
            value = _trusted(error, config)
        return ConfidenceState(
            value=value,
            baseline=torch.zeros(n, device=device),
            born=torch.full((n,), clock, dtype=torch.int64, device=device),
            updates=torch.zeros(n, dtype=torch.int64, device=device),
            expected_error=error,
            evidence=evidence,
        )

    @property
    def has_baseline(self) -> PerGaussianFlag:
        """Gaussians with a history to compare with; only these count in the stability loss (equation 23)."""
        return self.updates > 0

    def appended(self, other: "ConfidenceState") -> "ConfidenceState":
        """These rows, then the other ones."""
        return ConfidenceState(
            **{f.name: torch.cat((getattr(self, f.name), getattr(other, f.name))) for f in fields(self)}
        )

    def kept(self, keep: PerGaussianFlag) -> "ConfidenceState":
        """Only the flagged rows, in their order."""
        return ConfidenceState(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    def to(self, device: torch.device) -> "ConfidenceState":
        """The same state on another device."""
        return ConfidenceState(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})

    def cpu(self) -> "ConfidenceState":
        """The same state where numpy and the CPU's kernels can read it."""
        return ConfidenceState(**{f.name: getattr(self, f.name).cpu() for f in fields(self)})

    @torch.no_grad()
    def experienced(self, pixels: PerGaussian, errors: PerGaussian, config: ConfidenceConfig) -> "ConfidenceState":
        """After a frame that the map had not seen: how far off was what each Gaussian is part of.

        Nothing changes with the paper's model.

        Args:
            pixels: In which a Gaussian was drawn and the depth could be compared, counted by its weight in each.
            errors: Depth errors there, weighted alike, metres times pixels.
            config: The model and its constants.
        """
        if config.model == "paper":
            return self
        error, evidence = expectation.remembered(
            self.expected_error, self.evidence, pixels, errors, memory=config.error_memory
        )
        changed = pixels > 0 if config.model == "expectation" else evidence > 0
        value = torch.where(changed, _trusted(error, config), self.value)
        return replace(self, value=value, expected_error=error, evidence=evidence)

    @torch.no_grad()
    def observed(self, observation: Observation, config: ConfidenceConfig) -> "ConfidenceState":
        """After one more mapping update: all fade, and what was seen is rewarded or penalised (Eqs. 4, 10 to 15).

        Call it once for every mapping update, whether anything was seen or not. Rows whose distance or residual is
        not a number count as not seen. Only the paper's model changes confidence here; the average of the
        self-distance, which the stability loss needs, moves on in both.
        """
        distance, residual = observation.distance, observation.residual
        seen = observation.valid & ~distance.isnan() & ~residual.isnan()  # one NaN in p would never leave the map
        first = self.updates == 0

        averaged = eq.update_baseline(self.baseline, distance, rate=config.baseline_rate)
        return replace(
            self,
            value=self._judged(observation, seen, config) if config.model == "paper" else self.value,
            baseline=torch.where(seen, torch.where(first, distance, averaged), self.baseline),
            updates=self.updates + seen,
        )

    def _judged(self, observation: Observation, seen: PerGaussianFlag, config: ConfidenceConfig) -> PerGaussian:
        """The paper's confidence after an observation (Eqs. 4, 10 to 15)."""
        distance, residual, first = observation.distance, observation.residual, self.updates == 0
        decayed = eq.decay(self.value, decay_time=config.decay_time, p_min=config.p_min)
        quality = eq.observation_quality(residual, residual_ref=config.residual_ref)
        stability = eq.relative_stability(self.baseline, distance, scale=config.stability_scale)
        excitation, penalty = eq.feedback(
            quality, stability, excitation_gain=config.excitation_gain, penalty_gain=config.penalty_gain
        )
        absolute = eq.first_excitation(
            distance, residual, distance_ref=config.distance_ref, residual_ref=config.residual_ref
        )
        judged = eq.apply_feedback(
            decayed,
            torch.where(first, absolute, excitation),
            torch.where(first, 0.0, penalty),
            rate=config.update_rate,
            p_min=config.p_min,
        )
        return torch.where(seen, judged, decayed)

    @torch.no_grad()
    def sealed(self, config: ConfidenceConfig) -> "ConfidenceState":
        """Calibrated for unequal ages at the end of the submap (Eq. 16); once, as a second time would decay again.

        An expected error does not depend on age: with that model nothing changes.
        """
        if config.model != "paper":
            return self
        return replace(
            self, value=eq.calibrate_age(self.value, self.born, decay_time=config.decay_time, p_min=config.p_min)
        )


def _trusted(expected_error: PerGaussian, config: ConfidenceConfig) -> PerGaussian:
    """Confidence of Gaussians of which such errors are expected; not for the paper's model."""
    if config.model == "constant":
        return torch.full_like(expected_error, config.initial)
    value = expectation.confidence(expected_error, error_ref=config.error_ref, p_min=config.p_min)
    return value.roll(len(value) // 2) if config.model == "shuffled" else value
