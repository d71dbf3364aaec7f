"""How one submap stands to another: views of each are localised in the other, and those that agree decide.

The base system averages four estimates, whatever they are. Here an estimate must pass the gates of `localizer`, and
then agree with another one to within what both claim to know; the rest is named, with a reason.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float64

from tcgsplat.geometry import se3
from tcgsplat.loop.localizer import Localizer
from tcgsplat.loop.places import Place
from tcgsplat.scene.submap import Submap
from tcgsplat.tensors import Pose

Doubles = Float64[np.ndarray, "6 6"]

FLOOR = np.diag([0.002**2] * 3 + [0.001**2] * 3)
"""Covariance of a view's estimate that no number of residuals brings down, square metres and radians: keyframes have
errors of their own, with which pictures agree perfectly. Measured: the best rigid placement of tracked submaps leaves
1.5 mm a frame."""
COMMON = np.diag([0.006**2] * 3 + [0.004**2] * 3)
"""The same of what views agree upon: they share the bend of both submaps. Measured: registered submaps of 20 cm of
fr1/xyz are off by 5.5 mm and 5.8 mrad an axis (motion capture's errors in it), where edges of the odometry are off by
6.1 and 6.5; of a synthetic walk with a Kinect's noise by 2.3 mm and 0.7 mrad, and those by 1.0 and 0.5. So these must
not be overruled."""
_CHI2 = 22.46
"""Squared Mahalanobis distance that two estimates of one pose exceed once in a thousand, six degrees of freedom."""
_APART_METERS, _APART_RADIANS = 0.05, 0.035
"""Estimates farther apart do not agree, however little they claim to know."""
_POOLED = 3
"""Views of the other submap that a view is first compared with."""


@dataclass(frozen=True, eq=False)
class Side:
    """A submap that is registered: its map, what is remembered of it, and which of its views are used."""

    submap: Submap
    place: Place
    views: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Estimate:
    """What one view says."""

    frame_index: int
    failed: str
    """Why it does not count; empty if it does."""
    T_target_source: Pose = field(default_factory=se3.identity)
    information: Doubles = field(default_factory=lambda: np.zeros((6, 6)))
    """Of T_target_source exp(xi), translation first."""
    coverage: float = 0.0


@dataclass(frozen=True, eq=False)
class Registration:
    """What came of comparing two submaps."""

    source: int
    target: int
    failed: str
    """Why they are not registered; empty if they are."""
    estimates: tuple[Estimate, ...] = ()
    T_target_source: Pose = field(default_factory=se3.identity)
    information: Doubles = field(default_factory=lambda: np.zeros((6, 6)))
    """Inverse covariance of T_target_source exp(xi), translation first."""


def registered(
    source: Side,
    target: Side,
    similarity: npt.NDArray[np.float32],
    T_target_source: Pose,
    localizer: Localizer,
) -> Registration:
    """Register two submaps.

    Args:
        source: One submap.
        target: The other.
        similarity: Of the source's views [rows] to the target's [columns].
        T_target_source: How they stand as far as is known; used where features give no pose.
        localizer: That aligns a view to a map.
    """
    by_features = cache(lambda: _by_features(source, target, similarity))
    back = cache(lambda: None if (T := by_features()) is None else se3.inverse(T))
    estimates = (
        *(_estimate(source, target, i, (lambda: T_target_source, by_features), localizer) for i in source.views),
        *(
            _turned(_estimate(target, source, i, (lambda: se3.inverse(T_target_source), back), localizer))
            for i in target.views
        ),
    )
    between = (source.submap.index, target.submap.index)
    believed = [estimate for estimate in estimates if not estimate.failed]
    if len(believed) < 2:
        reason = next((one.failed for one in estimates if one.failed), "it has one view only")
        return Registration(*between, f"fewer than two of {len(estimates)} views were localised: {reason}", estimates)
    agreeing = _largest_agreement(believed)
    if len(agreeing) < 2:
        return Registration(*between, f"no two of {len(believed)} localised views agree", estimates)
    if 2 * len(agreeing) <= len(believed):
        return Registration(*between, f"as many localised views contradict as agree: {len(agreeing)}", estimates)
    T, information = _fused(agreeing)
    return Registration(*between, "", estimates, T, information)


def _estimate(
    of: Side, within: Side, view: int, guesses: Sequence[Callable[[], Pose | None]], localizer: Localizer
) -> Estimate:
    """What a view of one submap says, localised within the other, from guesses of `T_within_of`."""
    keyframe = of.submap.keyframes[view]
    where = (T @ keyframe.T_map_cam for T in (guess() for guess in guesses) if T is not None)
    found = localizer.localized(keyframe.balanced, within.submap, where)
    if found.failed:
        return Estimate(keyframe.frame.index, found.failed)
    carried = se3.adjoint(se3.inverse(keyframe.T_map_cam)).numpy()
    return Estimate(
        keyframe.frame.index,
        "",
        found.tracked.T_map_cam @ se3.inverse(keyframe.T_map_cam),
        carried.T @ found.information @ carried,
        found.tracked.coverage,
    )


def _by_features(source: Side, target: Side, similarity: npt.NDArray[np.float32]) -> Pose | None:
    """`T_target_source` from features of the likeliest view of either side among those of the other."""
    i = int(similarity.max(axis=1).argmax())
    seen = source.place.views[i]
    T_target_cam = target.place.guess(seen.features, seen.camera, _nearest(similarity[i]))
    if T_target_cam is not None:
        return T_target_cam @ se3.inverse(seen.T_map_cam)
    j = int(similarity.max(axis=0).argmax())
    seen = target.place.views[j]
    T_source_cam = source.place.guess(seen.features, seen.camera, _nearest(similarity[:, j]))
    return None if T_source_cam is None else seen.T_map_cam @ se3.inverse(T_source_cam)


def _nearest(similarity: npt.NDArray[np.float32]) -> tuple[int, ...]:
    return tuple(np.argsort(-similarity, kind="stable")[:_POOLED].tolist())


def _turned(estimate: Estimate) -> Estimate:
    """The same estimate of the inverse. With T exp(xi) inverted, xi becomes -adjoint(T) xi of the inverse."""
    T = estimate.T_target_source
    carried = se3.adjoint(se3.inverse(T)).numpy()
    return Estimate(
        estimate.frame_index,
        estimate.failed,
        se3.inverse(T),
        carried.T @ estimate.information @ carried,
        estimate.coverage,
    )


def covariance(information: Doubles, floor: Doubles = FLOOR) -> Doubles:
    """Of an estimate: what its residuals say, and the floor."""
    return np.asarray(np.linalg.inv(information + 1e-3 * np.eye(6)) + floor)


def _largest_agreement(estimates: Sequence[Estimate]) -> list[Estimate]:
    """The estimates that agree with one of them, for the one with which the most agree; of equals, the surest."""
    groups = [[other for other in estimates if _agree(one, other)] for one in estimates]
    return max(groups, key=lambda group: (len(group), sum(one.coverage for one in group)))


def _agree(a: Estimate, b: Estimate) -> bool:
    apart = se3.log(se3.inverse(a.T_target_source) @ b.T_target_source).numpy()
    if np.linalg.norm(apart[:3]) > _APART_METERS or np.linalg.norm(apart[3:]) > _APART_RADIANS:
        return False
    spread = covariance(a.information) + covariance(b.information)
    return float(apart @ np.linalg.solve(spread, apart)) < _CHI2


def _fused(estimates: Sequence[Estimate]) -> tuple[Pose, Doubles]:
    """The most probable pose of several estimates, and its information, what they have in common included."""
    T = max(estimates, key=lambda one: one.coverage).T_target_source
    information = sum((one.information for one in estimates), np.zeros((6, 6)))
    for _ in range(3):
        pull = sum(
            (one.information @ se3.log(se3.inverse(T) @ one.T_target_source).numpy() for one in estimates),
            np.zeros(6),
        )
        T = T @ se3.exp(torch.from_numpy(np.linalg.solve(information + 1e-3 * np.eye(6), pull)))
    inverse = np.asarray(np.linalg.inv(covariance(information, COMMON)))
    return se3.orthonormalized(T), 0.5 * (inverse + inverse.T)
