"""A furnished apartment of two rooms: x to the east, y to the north, z up; the floor is z = 0, metres.

The living room spans x 0 to 5, the kitchen x 5.12 to 9.2, both y 0 to 4.4; a wide doorway joins them.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from tcgsplat.datasets.synthetic import furniture as f
from tcgsplat.datasets.synthetic import ornaments as o
from tcgsplat.datasets.synthetic.kitchen import kitchen_block
from tcgsplat.datasets.synthetic.shapes import Patch, Vector, ball, box, cylinder, lathe, panel, placed, tube

Array = np.ndarray[Any, np.dtype[Any]]

HEIGHT = 2.6
"""Of both rooms, metres."""
LIVING = (0.0, 5.0, 0.0, 4.4)
"""x from, x to, y from, y to of the living room, metres."""
KITCHEN = (5.12, 9.2, 0.0, 4.4)
"""The same of the kitchen."""
DOORWAY = (1.65, 2.85, 2.12)
"""y from, y to and height of the passage between the rooms, metres."""
PERSON_AT: Vector = (2.9, 1.8, 0.0)
"""A free place in the middle of the living room."""
WALK = np.array(
    [
        # x, y, z in metres; yaw from the x axis towards y, pitch upwards, in degrees.
        (3.62, 1.84, 1.45, 142, -13),
        (3.16, 1.66, 1.48, 176, -14),
        (2.66, 1.82, 1.50, 226, -14),
        (2.82, 2.05, 1.47, 284, -11),
        (3.42, 2.22, 1.46, 336, -11),
        (4.25, 2.25, 1.48, 362, -10),
        (5.06, 2.26, 1.49, 374, -10),
        (5.78, 2.36, 1.48, 394, -12),
        (6.24, 2.50, 1.46, 408, -13),
        (6.36, 2.54, 1.48, 364, -13),
        (6.28, 2.50, 1.49, 318, -15),
        (6.12, 2.40, 1.49, 274, -13),
        (5.84, 2.32, 1.48, 228, -12),
        (5.40, 2.26, 1.46, 196, -10),
        (4.72, 2.16, 1.47, 178, -12),
        (4.06, 2.00, 1.47, 158, -13),
        (3.63, 1.85, 1.45, 142, -13),
    ]
)
"""Points on the camera's way through both rooms and back."""

Opening = tuple[float, float, float, float]
"""A hole in a wall: from, to along the wall from its left end, from, to in height, metres."""


def _wall(start: tuple[float, float], end: tuple[float, float], material: str, holes: list[Opening]) -> list[Patch]:
    """A wall from its left to its right end as seen from inside, with holes and skirting; its pattern runs through."""
    a, b = np.asarray(start), np.asarray(end)
    length = float(np.linalg.norm(b - a))
    along = (b - a) / length

    def piece(s0: float, s1: float, z0: float, z1: float) -> Patch:
        corner = a + s0 * along
        right = (s1 - s0) * along
        patch = panel((corner[0], corner[1], z1), (right[0], right[1], 0), (0, 0, z0 - z1), material)
        return replace(patch, origin=(s0, HEIGHT - z1))

    pieces: list[Patch] = []
    s = 0.0
    for s0, s1, z0, z1 in sorted(holes):
        pieces += [piece(s, s0, 0, HEIGHT), piece(s0, s1, z1, HEIGHT)]
        if z0 > 0:
            pieces.append(piece(s0, s1, 0, z0))
        s = s1
    pieces.append(piece(s, length, 0, HEIGHT))
    passages = [hole for hole in sorted(holes) if hole[2] == 0]
    starts = [0.0] + [hole[1] for hole in passages]
    ends = [hole[0] for hole in passages] + [length]
    inward = np.array([along[1], -along[0]])
    yaw = float(np.degrees(np.arctan2(along[1], along[0])))
    for s0, s1 in zip(starts, ends, strict=True):
        middle = a + 0.5 * (s0 + s1) * along + 0.009 * inward
        pieces += placed(box((s1 - s0, 0.018, 0.09), "trim"), (middle[0], middle[1], 0), yaw=yaw)
    return pieces


def shell(
    room: tuple[float, float, float, float], wall: str, other: str, floor: str, holes: dict[str, list[Opening]]
) -> list[Patch]:
    """Floor, ceiling and four walls; the north and south walls may be of another material than the rest."""
    x0, x1, y0, y1 = room
    ground = panel((x0, y1, 0), (x1 - x0, 0, 0), (0, y0 - y1, 0), floor)
    above = panel((x0, y0, HEIGHT), (x1 - x0, 0, 0), (0, y1 - y0, 0), "ceiling")
    parts = [replace(ground, origin=(0.0, 0.0)), replace(above, origin=(0.0, 0.0))]
    parts += _wall((x0, y0), (x0, y1), wall, holes.get("west", []))
    parts += _wall((x0, y1), (x1, y1), wall, holes.get("north", []))
    parts += _wall((x1, y1), (x1, y0), wall, holes.get("east", []))
    return parts + _wall((x1, y0), (x0, y0), other, holes.get("south", []))


def _window(width: float, height: float, view: str) -> list[Patch]:
    """A window in a wall at y = 0 seen from -y: reveal, frame, sill, and the bright view; centred on x, from z = 0."""
    deep, bar = 0.16, 0.05
    w = width / 2
    parts = [
        panel((-w, deep, height), (width, 0, 0), (0, 0, -height), view),
        panel((-w, 0, height), (0, deep, 0), (0, 0, -height), "trim", turned=True),
        panel((w, deep, height), (0, -deep, 0), (0, 0, -height), "trim", turned=True),
        panel((-w, 0, height), (width, 0, 0), (0, deep, 0), "trim"),
        panel((-w, deep, 0), (width, 0, 0), (0, -deep, 0), "trim"),
    ]
    for x in (-w + bar / 2, 0.0, w - bar / 2):
        parts += box((bar, 0.04, height), "trim", at=(x, deep - 0.025, 0))
    for z in (0.0, 0.68 * height, height - bar):
        parts += box((width - 2 * bar, 0.036, bar), "trim", at=(0, deep - 0.025, z))
    for x in (-w - 0.035, w + 0.035):
        parts += box((0.07, 0.02, height + 0.14), "trim", at=(x, -0.01, -0.07))
    parts += box((width, 0.02, 0.07), "trim", at=(0, -0.01, height))
    return parts + box((width + 0.2, 0.16, 0.03), "trim", at=(0, -0.04, -0.03))


def doorway(x0: float, x1: float) -> list[Patch]:
    """Jambs and casings of the passage through a wall from `x0` to `x1`."""
    y0, y1, top = DOORWAY
    deep = x1 - x0
    parts = [
        panel((x1, y0, top), (-deep, 0, 0), (0, 0, -top), "trim", turned=True),
        panel((x0, y1, top), (deep, 0, 0), (0, 0, -top), "trim", turned=True),
        panel((x0, y0, top), (deep, 0, 0), (0, y1 - y0, 0), "trim", turned=True),
        replace(panel((x0, y1, 0), (deep, 0, 0), (0, y0 - y1, 0), "walnut", turned=True)),
    ]
    for x in (x0 - 0.011, x1 + 0.011):
        for y in (y0 - 0.045, y1 + 0.045):
            parts += box((0.022, 0.09, top + 0.09), "trim", at=(x, y, 0))
        parts += box((0.022, y1 - y0, 0.09), "trim", at=(x, (y0 + y1) / 2, top))
    return parts


def closed_door() -> list[Patch]:
    """A panelled door with its casing and handle, in front of a wall at y = 0 seen from -y."""
    parts = box((0.86, 0.03, 2.02), "oak", at=(0, -0.015, 0))
    for x in (-0.2, 0.2):
        for z, tall in ((0.18, 0.62), (0.92, 0.36), (1.40, 0.46)):
            parts += box((0.27, 0.016, tall), "walnut", at=(x, -0.038, z))
    for x in (-0.475, 0.475):
        parts += box((0.09, 0.04, 2.11), "trim", at=(x, -0.02, 0))
    parts += box((0.86, 0.04, 0.09), "trim", at=(0, -0.02, 2.02))
    parts += tube([(0.36, -0.03, 1.02), (0.36, -0.08, 1.02), (0.24, -0.085, 1.02)], 0.011, "brass")
    return parts


def living_shell() -> list[Patch]:
    """The living room without anything in it, but with holes for its window and the doorway."""
    y0, y1, top = DOORWAY
    holes: dict[str, list[Opening]] = {
        "east": [(LIVING[3] - y1, LIVING[3] - y0, 0.0, top)],
        "west": [(1.55, 3.05, 0.95, 2.20)],
    }
    return shell(LIVING, "wallpaper", "wallpaper", "floor_wood", holes)


def living_room(rng: np.random.Generator) -> list[Patch]:
    """Sofa under pictures, round table on a rug, armchair, bookshelf, sideboard, plants, lamps."""
    parts = placed(_window(1.5, 1.25, "outdoors"), (0, 2.3, 0.95), yaw=90)
    for y, phase in ((1.27, 0.0), (3.33, 1.0)):
        parts += placed(f.curtain(0.62, 2.38, 4.5, phase), (0.13, y, 0), yaw=90)
    parts += tube([(0.13, 0.85, 2.40), (0.13, 3.75, 2.40)], 0.016, "brass")
    parts += placed(f.radiator(1.3), (0.09, 2.3, 0), yaw=90)
    parts += placed(f.sofa(), (2.0, 3.90, 0))
    parts += placed(f.coffee_table(rng), (2.0, 2.62, 0.012))
    parts += box((2.5, 1.6, 0.012), "walnut", at=(2.05, 2.65, 0), top="rug")
    parts += placed(f.armchair(), (0.82, 0.85, 0), yaw=142)
    parts += placed(o.floor_lamp(), (3.42, 4.05, 0))
    parts += placed(o.plant(rng), (0.42, 3.98, 0))
    parts += placed(o.plant(rng, 1.05, 22, 0.36), (4.62, 0.40, 0))
    parts += placed(f.bookshelf(rng), (2.75, 0.17, 0), yaw=180)
    parts += placed(f.bookshelf(rng, 0.9, 1.2, "oak"), (1.35, 0.17, 0), yaw=180)
    parts += placed(o.vase(0.30, "glaze"), (1.55, 0.17, 1.2))
    parts += placed(o.books(rng, 0.32, 0.26), (1.36, 0.24, 1.2), yaw=180)
    parts += placed(f.sideboard(), (4.77, 3.68, 0), yaw=-90)
    parts += placed(o.table_lamp(), (4.76, 4.08, 0.76))
    parts += placed(o.vase(0.34, "ceramic"), (4.80, 3.25, 0.76))
    parts += placed(o.picture(0.17, 0.22, "sunset", "brass"), (4.80, 3.62, 0.90), yaw=-80, tilt=-10)
    parts += placed(o.books(rng, 0.22, 0.24), (4.70, 3.90, 0.76), yaw=-90)
    parts += placed(o.basket(), (4.62, 1.22, 0))
    parts += placed(_stool(), (1.55, 0.78, 0))
    for (x, z), (w, h), name in zip(
        ((1.15, 1.62), (2.0, 1.68), (2.85, 1.62)), ((0.40, 0.62), (0.86, 0.60), (0.40, 0.62)),
        ("botanical", "landscape", "botanical_2"), strict=True,
    ):  # fmt: skip
        parts += placed(o.picture(w, h, name), (x, 4.395, z))
    parts += placed(o.picture(0.62, 0.62, "geometric", "oak"), (4.995, 3.62, 1.72), yaw=-90)
    parts += placed(o.picture(0.50, 0.80, "concert", "black"), (4.995, 0.95, 1.55), yaw=-90)
    parts += placed(o.picture(0.44, 0.34, "sunset", "oak"), (1.35, 0.005, 1.86), yaw=180)
    parts += placed(o.picture(0.55, 0.80, "concert_2", "black"), (4.15, 0.005, 1.60), yaw=180)
    parts += placed(o.picture(0.40, 0.54, "city_map", "walnut"), (0.005, 0.50, 1.55), yaw=90)
    return parts + ceiling_lamp((2.5, 2.2))


def _stool() -> list[Patch]:
    """A round stool with magazines on it."""
    parts = cylinder(0.20, 0.03, "oak", at=(0, 0, 0.40), segments=32)
    for angle in (0.5, 2.6, 4.7):
        c, s = float(np.cos(angle)), float(np.sin(angle))
        parts += tube([(0.12 * c, 0.12 * s, 0.41), (0.18 * c, 0.18 * s, 0.0)], 0.015, "oak")
    parts += placed(box((0.21, 0.28, 0.015), "pages", top="magazine"), (0, 0, 0.43), yaw=25)
    return parts + o.cup((0.10, -0.11, 0.445))


def _kitchen(rng: np.random.Generator) -> list[Patch]:
    """The block along the north wall, a laid table with chairs on a rug, a window, shelves, boxes, a door."""
    parts = placed(kitchen_block(rng), (5.90, 4.09, 0))
    parts += placed(_window(1.4, 1.1, "outdoors_kitchen"), (9.2, 1.75, 1.0), yaw=-90)
    for y, phase in ((0.82, 0.4), (2.68, 1.7)):
        parts += placed(f.curtain(0.45, 2.30, 3.5, phase), (9.09, y, 0), yaw=-90)
    parts += tube([(9.09, 0.50, 2.32), (9.09, 3.0, 2.32)], 0.014, "brass")
    parts += placed(f.radiator(1.1), (9.10, 1.75, 0), yaw=-90)
    table = (7.55, 1.45)
    radius = 1.25
    parts += lathe([(0.0, 0.010), (radius, 0.010)], "round_rug", at=(*table, 0), segments=64)
    parts += lathe([(radius, 0.010), (radius, 0.0)], "trim", at=(*table, 0), segments=64)
    parts += placed(f.dining_table(rng), (*table, 0.010))
    chairs = ((-0.36, -0.62, 178.0), (0.40, -0.60, 185.0), (-0.42, 0.60, 6.0), (0.36, 0.72, -24.0), (-1.02, 0.05, 96.0))
    for x, y, yaw in chairs:
        parts += placed(f.chair(), (table[0] + x, table[1] + y, 0.010), yaw=yaw + float(rng.uniform(-6, 6)))
    parts += _pendant(table)
    parts += placed(closed_door(), (5.85, 0.0, 0), yaw=180)
    parts += placed(o.picture(0.60, 0.60, "city_map", "black"), (7.10, 0.005, 1.6), yaw=180)
    parts += placed(o.picture(0.36, 0.54, "botanical", "oak"), (7.75, 0.005, 1.6), yaw=180)
    parts += placed(o.clock(), (6.54, 0.005, 2.05), yaw=180)
    parts += placed(_wall_shelf(rng), (8.55, 0.005, 1.35), yaw=180)
    for x, y, z, size, yaw in (
        (8.82, 0.36, 0.0, (0.52, 0.42, 0.38), 6.0), (8.80, 0.38, 0.38, (0.40, 0.34, 0.30), -14.0),
        (8.36, 0.30, 0.0, (0.34, 0.30, 0.26), 20.0),
    ):  # fmt: skip
        parts += o.carton(size, (x, y, z), yaw)
    parts += placed(f.sideboard(1.0), (5.34, 0.62, 0), yaw=90)
    parts += placed(o.table_lamp(), (5.34, 0.32, 0.76))
    parts += o.fruit_bowl(rng, (5.36, 0.85, 0.76), 0.15)
    parts += placed(o.picture(0.80, 0.50, "landscape", "black"), (5.125, 0.72, 1.62), yaw=90)
    parts += placed(o.picture(0.45, 0.45, "geometric", "black"), (5.125, 3.45, 1.60), yaw=90)
    parts += placed(o.plant(rng, 1.15, 24, 0.36), (5.48, 3.55, 0))
    parts += placed(o.plant(rng, 0.95, 20, 0.32), (8.85, 3.30, 0))
    return parts + ceiling_lamp((7.2, 2.9))


def _wall_shelf(rng: np.random.Generator) -> list[Patch]:
    """Two boards on brackets with books, a vase and a ball."""
    parts: list[Patch] = []
    for z in (0.0, 0.42):
        parts += box((0.95, 0.22, 0.025), "oak", at=(0, -0.11, z))
        for x in (-0.35, 0.35):
            parts += box((0.025, 0.16, 0.05), "black", at=(x, -0.08, z - 0.05))
    parts += placed(o.books(rng, 0.5, 0.30), (-0.44, -0.205, 0.025))
    parts += o.vase(0.26, "ceramic", at=(0.28, -0.11, 0.025))
    parts += placed(o.books(rng, 0.38, 0.26), (0.04, -0.2, 0.445))
    return parts + ball(0.10, "city_map", at=(-0.28, -0.11, 0.545))


def _pendant(at: tuple[float, float]) -> list[Patch]:
    """A lamp that hangs over the table."""
    parts = cylinder(0.006, 0.72, "black", at=(*at, 1.88), segments=8)
    return parts + lathe([(0.05, 1.90), (0.24, 1.66)], "shade", at=(*at, 0), segments=32)


def ceiling_lamp(at: tuple[float, float]) -> list[Patch]:
    """A flat glowing globe under the ceiling."""
    profile = [(0.19, HEIGHT - 0.03), (0.185, HEIGHT - 0.07), (0.14, HEIGHT - 0.11), (0.0, HEIGHT - 0.125)]
    parts = lathe(profile, "globe", at=(*at, 0), segments=32)
    return parts + lathe([(0.20, HEIGHT - 0.001), (0.20, HEIGHT - 0.035), (0.18, HEIGHT - 0.035)], "brass", at=(*at, 0),
                         segments=32)  # fmt: skip


def furnished(seed: int) -> list[Patch]:
    """Both rooms with everything in them; the seed chooses books, fruits, plants and how chairs were left."""
    rng = np.random.default_rng((seed, 1))
    y0, y1, top = DOORWAY
    holes: dict[str, list[Opening]] = {
        "west": [(y0, y1, 0.0, top)],
        "east": [(KITCHEN[3] - 2.45, KITCHEN[3] - 1.05, 1.0, 2.10)],
    }
    parts = living_shell() + shell(KITCHEN, "wallpaper_kitchen", "brick", "floor_tile", holes)
    return parts + doorway(LIVING[1], KITCHEN[0]) + living_room(rng) + _kitchen(rng)


def person() -> list[Patch]:
    """Somebody who stands at `PERSON_AT`, where their light is computed, whichever way they go later."""
    return placed(f.person(), PERSON_AT)
