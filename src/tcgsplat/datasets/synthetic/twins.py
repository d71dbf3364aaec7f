"""Two rooms that nobody could tell apart at a glance, side by side on a hall: what a false loop is made of.

Room one is the apartment's living room; room two stands `APART` metres to the north of it, the same patch for patch,
down to the grain of the wood. Only one poster is another, and one row of books. The hall shows the same things
through both doorways and lights both rooms alike.
"""

from dataclasses import replace

import numpy as np

from tcgsplat.datasets.synthetic import apartment
from tcgsplat.datasets.synthetic import ornaments as o
from tcgsplat.datasets.synthetic.apartment import DOORWAY, LIVING, Array
from tcgsplat.datasets.synthetic.shapes import Patch, Vector, box, placed

APART: Vector = (0.0, 4.8, 0.0)
"""From anything in room one to the same thing in room two, metres: whole repeats of the wallpaper and of the tiles."""
HALL = (5.1, 6.4, 0.0, LIVING[3] + APART[1])
"""x from, x to, y from, y to of the hall, metres."""

_LOOK_AROUND = apartment.WALK[:6]
"""From the first view of room one, all around, to its doorway."""
_TO_ROOM_TWO = np.array(
    [
        (5.02, 2.32, 1.49, 384, -10),
        (5.52, 2.86, 1.48, 424, -11),
        (5.70, 3.72, 1.47, 448, -11),
        (5.72, 4.65, 1.47, 450, -12),
        (5.70, 5.62, 1.48, 452, -11),
        (5.52, 6.52, 1.48, 478, -11),
        (5.02, 7.02, 1.49, 514, -12),
        (4.35, 6.90, 1.48, 516, -13),
    ]
)
_TO_ROOM_ONE = np.array(
    [
        (5.02, 6.98, 1.49, 706, -10),
        (5.52, 6.44, 1.48, 664, -11),
        (5.70, 5.58, 1.47, 632, -11),
        (5.72, 4.65, 1.47, 630, -12),
        (5.70, 3.60, 1.48, 628, -11),
        (5.52, 2.78, 1.48, 602, -11),
        (5.02, 2.28, 1.49, 566, -12),
        (4.35, 2.10, 1.48, 532, -13),
        (3.63, 1.85, 1.45, 502, -13),
    ]
)
WALK: Array = np.concatenate((_LOOK_AROUND, _TO_ROOM_TWO, _LOOK_AROUND + np.array((*APART, 360, 0)), _TO_ROOM_ONE))
"""Points on the camera's way: around room one, around room two by the same views, and back to the start."""


def furnished(seed: int) -> list[Patch]:
    """Both rooms and the hall with everything in them; the seed chooses what it chooses in the apartment."""
    rng = np.random.default_rng((seed, 1))
    passage = apartment.doorway(LIVING[1], HALL[0])
    room = _settled(apartment.living_shell() + passage + apartment.living_room(rng), rng)
    return room + placed(map(_other, room), APART) + _hall(rng)


def _settled(patches: list[Patch], rng: np.random.Generator) -> list[Patch]:
    """The patches, with a start for each texture that might start anywhere: their copies will have the same."""
    starts: Array = rng.uniform(0, 2, (len(patches), 2))
    return [
        patch if patch.origin else replace(patch, origin=(float(u), float(v)))
        for patch, (u, v) in zip(patches, starts, strict=True)
    ]


def _other(patch: Patch) -> Patch:
    """The patch as it is in room two: the same, but for the poster on the south wall and the books on the low shelf."""
    if patch.material == "concert_2":
        return replace(patch, material="botanical_2")
    x, _, z = patch.points.min(axis=(0, 1))
    if patch.material == "books" and patch.origin and x < 1.75 and z > 1.19:
        return replace(patch, origin=(patch.origin[0] + 4 / 16, 0.0))  # another, of the same colour
    return patch


def _hall(rng: np.random.Generator) -> list[Patch]:
    """Opposite each doorway the same; a closed door in the middle, and an end of its own to the north and south."""
    x0, x1, y0, y1 = HALL
    low, high, top = DOORWAY
    holes: dict[str, list[apartment.Opening]] = {
        "west": [(low, high, 0.0, top), (low + APART[1], high + APART[1], 0.0, top)]
    }
    parts = apartment.shell(HALL, "wallpaper", "brick", "floor_tile", holes)
    middle = (low + high) / 2
    opposite = placed(o.picture(0.80, 0.60, "city_map", "black"), (x1 - 0.005, middle, 1.55), yaw=-90)
    opposite += placed(o.picture(0.36, 0.54, "botanical", "oak"), (x1 - 0.005, middle - 0.95, 1.55), yaw=-90)
    opposite += placed(o.picture(0.36, 0.54, "sunset", "oak"), (x1 - 0.005, middle + 0.95, 1.55), yaw=-90)
    opposite += apartment.ceiling_lamp(((x0 + x1) / 2, middle))
    opposite = _settled(opposite, rng)
    parts += opposite + placed(opposite, APART)
    parts += box((0.8, y1 - 1.2, 0.010), "trim", at=((x0 + x1) / 2, y1 / 2, 0), top="stripes")
    parts += placed(apartment.closed_door(), (x1, y1 / 2 + 0.05, 0), yaw=-90)
    parts += placed(o.picture(0.50, 0.80, "concert", "black"), (x0 + 0.005, 4.0, 1.55), yaw=90)
    parts += placed(o.picture(0.60, 0.60, "geometric", "oak"), (x0 + 0.005, 5.3, 1.6), yaw=90)
    parts += placed(o.picture(0.86, 0.60, "landscape", "walnut"), ((x0 + x1) / 2, y1 - 0.005, 1.6))
    parts += placed(o.plant(rng, 1.15, 24, 0.36), (x0 + 0.4, y1 - 0.4, 0))
    parts += placed(o.clock(), ((x0 + x1) / 2, y0 + 0.005, 2.0), yaw=180)
    parts += o.carton((0.52, 0.42, 0.38), (x0 + 0.4, y0 + 0.36, 0.0), 6.0)
    return parts + o.carton((0.40, 0.34, 0.30), (x0 + 0.42, y0 + 0.38, 0.38), -14.0)
