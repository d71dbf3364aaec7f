"""Furniture, each piece as patches around its own origin: base at z = 0, front towards -y, metres."""

import numpy as np

from tcgsplat.datasets.synthetic.ornaments import books, cup, fruit_bowl, ornament, vase
from tcgsplat.datasets.synthetic.shapes import Patch, ball, box, cushion, cylinder, lathe, placed, sheet, tube


def _legs(width: float, depth: float, height: float, material: str, radius: float = 0.025) -> list[Patch]:
    """Four round legs under a rectangle."""
    corners = ((x * width / 2, y * depth / 2, 0.0) for x in (-1, 1) for y in (-1, 1))
    return [patch for at in corners for patch in cylinder(radius, height, material, at=at, segments=12)]


def bookshelf(rng: np.random.Generator, width: float = 1.9, height: float = 2.0, wood: str = "walnut") -> list[Patch]:
    """An open case with books and ornaments."""
    depth, board = 0.30, 0.025
    parts = box((width, 0.015, height), wood, at=(0, depth / 2 - 0.0075, 0))
    for x in (-width / 2 + board / 2, 0.0, width / 2 - board / 2):
        parts += box((board, depth, height), wood, at=(x, -0.01, 0))
    shelves = 6
    gap = (height - 0.08 - board) / (shelves - 1)
    for k in range(shelves):
        parts += box((width - 2 * board, depth - 0.02, board), wood, at=(0, -0.005, 0.08 + k * gap))
    room = width / 2 - 1.5 * board
    for k in range(shelves - 1):
        for side in (-1, 1):
            left = -width / 2 + board if side < 0 else board / 2
            floor = 0.08 + k * gap + board
            filled = room * float(rng.uniform(0.45, 0.98))
            row = books(rng, filled, gap - board - 0.02)
            parts += placed(row, (left + 0.004, -depth / 2 + 0.03, floor))
            if room - filled > 0.16:
                spot = (left + (filled + room) / 2, -0.02, floor)
                parts += ornament(rng, spot, min(0.10, (room - filled) / 2 - 0.02))
    return parts


def sofa(width: float = 2.1) -> list[Patch]:
    """Three seats, soft arms, and thrown cushions."""
    depth, seat = 0.9, 0.24
    parts = cushion((width, depth, seat), "sofa", at=(0, 0, 0.08), edge=0.12)
    parts += _legs(width - 0.2, depth - 0.2, 0.12, "walnut")
    inner = width - 0.44
    for k in range(3):
        x = (k - 1) * inner / 3
        parts += cushion((inner / 3 - 0.01, 0.68, 0.19), "sofa", at=(x, -0.10, 0.31), edge=0.25)
        back = cushion((inner / 3 - 0.015, 0.22, 0.50), "sofa", edge=0.3)
        parts += placed(back, (x, 0.27, 0.44), tilt=-10)
    parts += cushion((width, 0.20, 0.74), "sofa", at=(0, 0.36, 0.10), edge=0.2)
    for x in (-1.0, 1.0):
        parts += cushion((0.22, depth, 0.55), "sofa", at=(x * (width / 2 - 0.11), 0, 0.09), edge=0.25)
    for x, name, yaw in ((-0.62, "zigzag", 14), (-0.30, "dots", -8), (0.60, "stripes", -16)):
        parts += placed(cushion((0.44, 0.15, 0.42), name, edge=0.55), (x, 0.06, 0.49), yaw=yaw, tilt=-22)
    blanket = np.array([[[x, y, z] for x in np.linspace(0.66, 1.02, 5)] for y, z in _drape()])
    return parts + sheet(blanket, "blanket", (0.4, 1.3))


def _drape() -> list[tuple[float, float]]:
    """A profile (y, z) that hangs over the arm side of a sofa from behind to the front."""
    return [(0.47, 0.60), (0.47, 0.86), (0.30, 0.875), (0.24, 0.80), (0.05, 0.665), (-0.30, 0.66), (-0.468, 0.62),
            (-0.475, 0.30)]  # fmt: skip


def armchair() -> list[Patch]:
    """A single seat with a high back."""
    parts = cushion((0.80, 0.78, 0.22), "armchair", at=(0, 0, 0.16), edge=0.2)
    parts += _legs(0.6, 0.6, 0.18, "oak", 0.022)
    parts += cushion((0.52, 0.60, 0.17), "armchair", at=(0, -0.09, 0.35), edge=0.3)
    parts += placed(cushion((0.74, 0.20, 0.66), "armchair", edge=0.3), (0, 0.28, 0.34), tilt=-9)
    for x in (-1.0, 1.0):
        parts += cushion((0.15, 0.70, 0.40), "armchair", at=(x * 0.34, -0.02, 0.20), edge=0.3)
    return parts + placed(cushion((0.40, 0.14, 0.38), "zigzag", edge=0.55), (0.02, 0.06, 0.50), yaw=10, tilt=-20)


def coffee_table(rng: np.random.Generator) -> list[Patch]:
    """A round top on three legs with magazines, a bowl and cups."""
    top = 0.42
    parts = lathe([(0, top), (0.45, top), (0.47, top - 0.015), (0.45, top - 0.03), (0, top - 0.03)], "oak", segments=48)
    for angle in (20.0, 140.0, 260.0):
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        parts += tube([(0.28 * c, 0.28 * s, top - 0.03), (0.40 * c, 0.40 * s, 0.0)], 0.02, "walnut")
    for k in range(3):
        page = box((0.21, 0.28, 0.008), "pages", top="magazine")
        parts += placed(page, (-0.18 + 0.01 * k, -0.08 + 0.015 * k, top + 0.0085 * k), yaw=float(rng.uniform(-40, 40)))
    parts += fruit_bowl(rng, (0.16, 0.14, top), 0.13)
    return parts + cup((0.12, -0.20, top)) + cup((0.26, -0.10, top))


def sideboard(width: float = 1.3) -> list[Patch]:
    """A low cupboard with two doors, three drawers and round knobs."""
    depth, height, foot = 0.42, 0.62, 0.14
    parts = box((width, depth, height), "walnut", at=(0, 0, foot))
    parts += _legs(width - 0.12, depth - 0.1, foot, "walnut", 0.02)
    front = -depth / 2 - 0.009
    for k, x in enumerate((-1, 0, 1)):
        wide = width / 3 - 0.02
        for z, tall in ((0.02, 0.58),) if k != 1 else ((0.02, 0.18), (0.22, 0.18), (0.42, 0.18)):
            parts += box((wide, 0.018, tall), "oak", at=(x * width / 3, front, foot + z))
            knob = (x * (width / 3 - (0.4 * wide if k != 1 else 0)), front - 0.025, foot + z + tall / 2)
            parts += ball(0.016, "brass", at=knob, rings=8)
    return parts


def chair(wood: str = "oak") -> list[Patch]:
    """A dining chair with a slatted back and a seat pad."""
    parts = cushion((0.44, 0.43, 0.04), wood, at=(0, 0, 0.43), edge=0.2, cells=5)
    parts += cushion((0.38, 0.37, 0.045), "checks", at=(0, -0.01, 0.465), edge=0.4, cells=5)
    for x in (-1.0, 1.0):
        parts += tube([(0.18 * x, -0.18, 0.44), (0.20 * x, -0.21, 0.0)], 0.017, wood)
        parts += tube([(0.18 * x, 0.27, 0.95), (0.18 * x, 0.20, 0.45), (0.20 * x, 0.23, 0.0)], 0.017, wood)
        parts += tube([(0.19 * x, -0.19, 0.22), (0.19 * x, 0.21, 0.22)], 0.010, wood)
    parts += placed(box((0.37, 0.018, 0.09), wood), (0, 0.262, 0.84), tilt=-8)
    for x in (-0.11, 0.0, 0.11):
        parts += placed(box((0.035, 0.012, 0.34), wood), (x, 0.215, 0.50), tilt=-8)
    return parts


def dining_table(rng: np.random.Generator, length: float = 1.4, depth: float = 0.85) -> list[Patch]:
    """A table with a runner, laid with plates, cups, a fruit bowl and a jug."""
    top = 0.75
    parts = box((length, depth, 0.035), "walnut", at=(0, 0, top - 0.035))
    parts += box((length - 0.16, depth - 0.16, 0.07), "walnut", at=(0, 0, top - 0.105))
    for x in (-1.0, 1.0):
        for y in (-1.0, 1.0):
            at = (x * (length / 2 - 0.07), y * (depth / 2 - 0.07), 0.0)
            profile = [(0.032, top - 0.035), (0.036, 0.55), (0.026, 0.3), (0.02, 0.0)]
            parts += lathe(profile, "walnut", at=at, segments=14, turned=True)
    parts += box((length * 0.96, 0.32, 0.003), "stripes", at=(0, 0, top))
    parts += fruit_bowl(rng, (0.08, 0.0, top + 0.003), 0.16)
    parts += vase(0.26, "glaze", at=(-0.38, 0.02, top + 0.003))
    for x, y in ((-0.38, -0.29), (0.38, -0.29), (-0.38, 0.29), (0.38, 0.29)):
        parts += lathe(
            [(0, 0.012), (0.075, 0.012), (0.12, 0.022), (0.122, 0.018), (0.07, 0.0)], "glaze", at=(x, y, top)
        )
        parts += cup((x + 0.17, y * 0.95, top), "ceramic")
    return parts


def radiator(width: float = 1.1) -> list[Patch]:
    """A row of rounded white columns."""
    parts: list[Patch] = []
    for x in np.arange(-width / 2 + 0.03, width / 2, 0.06):
        parts += cushion((0.05, 0.10, 0.55), "white", at=(float(x), 0, 0.12), edge=0.4, cells=4)
    pipe = [(-width / 2, 0.0, 0.2), (width / 2, 0.0, 0.2)]
    return parts + tube(pipe, 0.018, "white")


def curtain(width: float, height: float, waves: float, phase: float) -> list[Patch]:
    """Cloth that hangs in folds from z = `height` down to 3 cm over the floor."""
    s, t = np.linspace(0, 1, 50), np.linspace(0, 1, 5)[:, None]
    sway = (0.75 + 0.25 * t) * np.sin(2 * np.pi * waves * s + phase)
    x = width * (s - 0.5) + 0.012 * np.sin(4 * np.pi * waves * s) + 0 * t
    points = np.stack((x, 0.045 * sway, np.broadcast_to(height - t * (height - 0.03), x.shape)), axis=-1)
    return sheet(points, "curtain", (1.7 * width, height))


def person() -> list[Patch]:
    """Somebody standing: shoes, legs, pullover, arms, head with hair; turned to -y, 1.74 m tall."""
    parts: list[Patch] = []
    for x in (-0.095, 0.095):
        parts += cushion((0.10, 0.27, 0.09), "walnut", at=(x, -0.04, 0.0), edge=0.6, cells=5)
        leg = [(0.095, 0.88), (0.085, 0.65), (0.065, 0.45), (0.07, 0.35), (0.05, 0.07)]
        parts += lathe(leg, "trousers", at=(x, 0, 0), segments=18)
    torso = [(0.0, 1.46), (0.07, 1.455), (0.15, 1.41), (0.185, 1.33), (0.17, 1.12), (0.165, 0.95), (0.175, 0.85),
             (0.0, 0.84)]  # fmt: skip
    parts += lathe(torso, "pullover", segments=28)
    for x in (-1.0, 1.0):
        parts += tube(
            [(0.17 * x, 0, 1.38), (0.24 * x, 0.01, 1.12), (0.23 * x, -0.08, 0.86)], 0.052, "pullover", sides=12
        )
        parts += ball(0.05, "skin", at=(0.23 * x, -0.09, 0.82), rings=10)
    parts += cylinder(0.05, 0.12, "skin", at=(0, 0, 1.44))
    parts += cushion((0.165, 0.20, 0.25), "skin", at=(0, 0, 1.49), edge=0.9)
    parts += ball(0.016, "skin", at=(0, -0.103, 1.60), rings=8)
    for x in (-0.034, 0.034):
        parts += ball(0.012, "black", at=(x, -0.086, 1.635), rings=8)
    parts += cushion((0.05, 0.02, 0.012), "fruit", at=(0, -0.095, 1.555), tint=(0.5, 0.1, 0.1), edge=0.9, cells=4)
    return parts + cushion((0.185, 0.20, 0.17), "hair", at=(0, 0.025, 1.59), edge=0.9)
