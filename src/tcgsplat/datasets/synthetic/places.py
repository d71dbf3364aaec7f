"""Where a recording can be made: what stands there, and the camera's way through it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from tcgsplat.datasets.synthetic import apartment, twins
from tcgsplat.datasets.synthetic.apartment import Array
from tcgsplat.datasets.synthetic.shapes import Patch

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


PLACES: Mapping[Name, Place] = MappingProxyType(
    {
        "apartment": Place(apartment.furnished, apartment.WALK, 900.0),
        "twins": Place(twins.furnished, twins.WALK, 1600.0),
    }
)
