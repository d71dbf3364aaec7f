"""What somebody who walks about does to the confidence of the places that he hides, and for how long.

A place is a spot of what stands still, in the world. It is looked at again and again: while he hides it the map should
come to doubt what it shows there, and when he is gone it should come to trust it again.
"""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.tensors import Mask, Plane, Pose

SPACING = 0.05
"""Places are so far apart, metres."""
SAME_SURFACE = 0.05
"""Share of its distance by which a place may lie off the surface that is seen in its pixel."""
RECOVERED = 0.9
"""Share of its confidence before, from which on a place has recovered."""


@dataclass(frozen=True, eq=False)
class Look:
    """A frame, and what a map said of its view before it was used."""

    index: int
    """Of the frame."""
    trust: Plane
    """Confidence over opacity; NaN where nothing is mapped."""
    hidden: Mask
    """Where somebody stands in the way."""
    depth: Plane
    """True depth of all that stands still, metres; 0 where it is not known."""
    camera: Camera
    T_world_cam: Pose
    """The true one: where a place is does not depend on the map."""


@dataclass(frozen=True)
class Crossing:
    """What became of the places, each from the first time that it was hidden to the second."""

    places: int
    """That were hidden, and of which the map knew something before."""
    dropped: int
    """Of these: whose confidence fell below half-way from what it was to the floor."""
    time_to_drop: float
    """Frames from the first look at which a place is hidden to the first below half-way, median of those that dropped.
    Looks at which a place is not in the picture take no time. NaN if none dropped."""
    left: int
    """Of those that dropped: that were seen again without anybody in the way, before they were hidden again."""
    recovered: int
    """Of these: whose confidence came back to `RECOVERED` of what it was."""
    time_to_recover: float
    """Frames from the first look without anybody in the way, median of those that recovered; NaN if none did."""


def crossing(looks: Sequence[Look], floor: float) -> Crossing:
    """Time to drop and time to recover of the places that somebody hid.

    Args:
        looks: In their order.
        floor: The least confidence that there is.
    """
    points = hidden_points(looks)
    if not len(points):
        return Crossing(0, 0, math.nan, 0, 0, math.nan)
    read = [_read(look, points) for look in looks]
    trust, hidden, seen = (np.stack(planes) for planes in zip(*read, strict=True))
    steps = np.diff([look.index for look in looks], prepend=looks[0].index)
    told = [
        _told(trust[:, i], hidden[:, i], np.cumsum(steps * seen[:, i]), seen[:, i], floor) for i in range(len(points))
    ]
    known = [one for one in told if one is not None]
    dropped = [one for one in known if one.drop is not None]
    left = [one for one in dropped if one.left]
    recovered = [one.recover for one in left if one.recover is not None]
    return Crossing(
        places=len(known),
        dropped=len(dropped),
        time_to_drop=_median([one.drop for one in dropped if one.drop is not None]),
        left=len(left),
        recovered=len(recovered),
        time_to_recover=_median(recovered),
    )


def hidden_points(looks: Sequence[Look]) -> Float[torch.Tensor, "n 3"]:
    """The surface behind somebody in any of the looks, in the world, metres: one point of each cube of `SPACING`."""
    found = []
    for look in looks:
        behind = look.hidden & (look.depth > 0)
        points = (look.camera.rays() * look.depth[..., None])[behind]
        found.append(se3.transform(look.T_world_cam, points).float())
    points = torch.cat(found) if found else torch.zeros(0, 3)
    _, chosen = np.unique(np.floor(points.numpy() / SPACING).astype(np.int64), axis=0, return_index=True)
    return points[torch.from_numpy(np.sort(chosen))]


def _read(
    look: Look, points: Float[torch.Tensor, "n 3"]
) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """At each point: the map's confidence, whether somebody hides it, and whether it would else be in sight."""
    there = se3.transform(se3.inverse(look.T_world_cam), points)
    z, camera = there[:, 2], look.camera
    pixels = camera.project(torch.cat((there[:, :2], z[:, None].clamp_min(1e-3)), dim=1))
    columns, rows = pixels.nan_to_num().round().long().unbind(-1)
    columns, rows = columns.clamp(0, camera.width - 1), rows.clamp(0, camera.height - 1)
    surface = (look.depth[rows, columns] - z).abs() <= SAME_SURFACE * z
    seen = camera.contains(pixels) & (z > 1e-3) & surface
    trust = torch.where(seen, look.trust[rows, columns], torch.nan)
    return trust.numpy(), (seen & look.hidden[rows, columns]).numpy(), seen.numpy()


@dataclass(frozen=True)
class _Told:
    """Of one place: frames, None for never."""

    drop: int | None
    left: bool
    recover: int | None


def _told(
    trust: Float[np.ndarray, " looks"],
    hidden: Bool[np.ndarray, " looks"],
    elapsed: Int[np.ndarray, " looks"],
    seen: Bool[np.ndarray, " looks"],
    floor: float,
) -> _Told | None:
    """Of one place; None if it was never hidden, or the map knew nothing of it before."""
    looks = np.arange(len(trust))
    first = _first(hidden)
    earlier = trust[:first][np.isfinite(trust[:first])]
    if first == len(trust) or not len(earlier):
        return None
    before = float(earlier[-1])
    left = _first(seen & ~hidden & (looks > first))
    again = _first(hidden & (looks > left))
    drop = _first((trust < (before + floor) / 2) & (looks >= first) & (looks < again))
    if drop == len(trust):
        return _Told(None, left < len(trust), None)
    back = _first((trust >= RECOVERED * before) & (looks >= max(left, drop)) & (looks < again))
    to_recover = int(elapsed[back] - elapsed[left]) if back < len(trust) else None
    return _Told(int(elapsed[drop] - elapsed[first]), left < len(trust), to_recover)


def _first(flags: Bool[np.ndarray, " looks"]) -> int:
    """Index of the first that is set; their number if none is."""
    return int(np.argmax(flags)) if flags.any() else len(flags)


def _median(values: Sequence[int]) -> float:
    return float(statistics.median(values)) if values else math.nan
