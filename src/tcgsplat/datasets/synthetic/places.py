"""Where a recording can be made: what stands there, and the camera's way through it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from tcgsplat.datasets.synthetic import apartment, twins
from tcgsplat.datasets.synthetic.apartment import Array
from tcgsplat.datasets.synthetic.shapes import Patch
from tcgsplat.datasets.truth import Region

Name = Literal["apartment", "twins"]


@dataclass(frozen=True)
class Place:
    """Somewhere to walk through and back."""

    furnished: Callable[[int], list[Patch]]
    """All that stands there, by the seed."""
    walk: Array
    """[k, 5] points on the way, see `path.camera_poses`."""
    degrees: float
    """How far the view moves in the whole walk, about: turning, and moving past things two metres away."""
    first_seen: Region
    """What the first frame looks at; the walk leaves it for long and comes back."""
    biased: Region
    """Where depth may read wrong: something that stays in the picture for long."""
    biased_from: float
    """Part of the walk in time from which on it does: about half of what is seen of the region is seen before."""


PLACES: Mapping[Name, Place] = MappingProxyType(
    {
        "apartment": Place(
            apartment.furnished,
            apartment.WALK,
            900.0,
            first_seen=Region((0.0, 1.2, 0.0), (2.9, 4.5, 2.6)),
            biased=Region((8.9, -0.1, 0.9), (9.4, 2.9, 2.7)),
            biased_from=0.45,
        ),
        "twins": Place(
            twins.furnished,
            twins.WALK,
            1600.0,
            first_seen=Region((0.0, 0.0, 0.0), (2.9, 4.5, 2.6)),
            biased=Region((5.3, 7.4, -0.1), (6.6, 9.4, 2.7)),
            biased_from=0.32,
        ),
    }
)
