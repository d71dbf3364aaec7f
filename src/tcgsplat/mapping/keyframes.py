"""Which keyframes a submap keeps: enough to hold what it has learnt, and no more however long the camera stays."""

import math

import torch

from tcgsplat.scene.submap import Keyframe

_METERS, _RADIANS = 0.5, math.radians(50.0)
"""A submap's extent in the paper; as far apart in position as in direction."""


def thinned(keyframes: tuple[Keyframe, ...], limit: int) -> tuple[Keyframe, ...]:
    """At most `limit` keyframes (0: all): the one seen best from its neighbours goes first.

    The first, which anchors the submap, and the newest always stay. Of the closest pair the older one goes, so that
    a camera that stands still keeps a recent picture and one that moves keeps its whole way.
    """
    kept = list(keyframes)
    while limit and len(kept) > max(limit, 2):
        poses = torch.stack([keyframe.T_map_cam for keyframe in kept])
        apart = torch.cdist(poses[:, :3, 3], poses[:, :3, 3]) / _METERS
        cosine = 0.5 * (torch.einsum("aij,bij->ab", poses[:, :3, :3], poses[:, :3, :3]) - 1.0)
        apart = apart + cosine.clamp(-1.0, 1.0).acos() / _RADIANS
        apart.fill_diagonal_(math.inf)
        redundancy = apart.min(dim=1).values
        redundancy[0] = redundancy[-1] = math.inf
        kept.pop(int(redundancy.argmin()))  # the first of equals, which is the older
    return tuple(kept)
