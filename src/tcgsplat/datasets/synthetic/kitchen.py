"""The kitchen block: base cabinets with oven and sink, worktop, tiles, wall cabinets, refrigerator, clutter."""

import numpy as np

from tcgsplat.datasets.synthetic.ornaments import cup, fruit_bowl, plant, vase
from tcgsplat.datasets.synthetic.shapes import Patch, Vector, ball, box, cylinder, lathe, panel, placed, tube

_TOP = 0.90
"""Height of the worktop, metres."""


def _door(center: float, width: float, z: float, height: float, front: float, *, drawer: bool = False) -> list[Patch]:
    """A framed cabinet front with a bar handle; `front` is the y of the carcass."""
    rail = 0.055
    parts = box((width - 0.008, 0.012, height - 0.008), "cabinet", at=(center, front - 0.006, z + 0.004))
    for x in (-1.0, 1.0):
        at = (center + x * (width - rail - 0.008) / 2, front - 0.017, z + 0.004)
        parts += box((rail, 0.010, height - 0.008), "cabinet", at=at)
    for bottom in (z + 0.004, z + height - rail - 0.004):
        parts += box((width - 2 * rail - 0.008, 0.010, rail), "cabinet", at=(center, front - 0.017, bottom))
    y = front - 0.05
    if drawer:
        ends = [(center - 0.07, y, z + height / 2), (center + 0.07, y, z + height / 2)]
    else:
        x = center + width / 2 - 0.035
        top = z + height - 0.06 if z < 1.2 else z + 0.22
        ends = [(x, y, top), (x, y, top - 0.16)]
    parts += tube(ends, 0.007, "brass")
    for end in ends:
        parts += tube([end, (end[0], front - 0.01, end[2])], 0.005, "brass")
    return parts


def _oven(center: float, width: float, front: float) -> list[Patch]:
    """An oven below a hob with four plates and a pot."""
    parts = box((width - 0.01, 0.02, 0.72), "metal", at=(center, front - 0.010, 0.12))
    parts += box((width - 0.12, 0.008, 0.40), "black", at=(center, front - 0.022, 0.20))
    handle = [(center - width / 2 + 0.07, front - 0.06, 0.66), (center + width / 2 - 0.07, front - 0.06, 0.66)]
    parts += tube(handle, 0.011, "metal")
    for k in range(5):
        knob = cylinder(0.022, 0.03, "black")
        parts += placed(knob, (center + (k - 2) * 0.095, front - 0.02, 0.77), tilt=90)
    parts += box((width - 0.04, 0.48, 0.008), "black", at=(center, front + 0.31, _TOP))
    for x in (-0.13, 0.13):
        for y in (0.20, 0.43):
            parts += lathe([(0, 0.004), (0.085, 0.004), (0.09, 0.0)], "metal", at=(center + x, front + y, _TOP + 0.008))
    return parts + _pot((center + 0.13, front + 0.43, _TOP + 0.012))


def _pot(at: Vector) -> list[Patch]:
    """A cooking pot with lid and two handles."""
    parts = lathe(
        [(0.0, 0.18), (0.012, 0.175), (0.012, 0.155), (0.105, 0.145), (0.11, 0.135), (0.11, 0.0), (0.0, 0.0)],
        "metal", at=at, segments=28,
    )  # fmt: skip
    for x in (-1, 1):
        loop = [(x * 0.108, -0.04, 0.10), (x * 0.145, -0.03, 0.105), (x * 0.145, 0.03, 0.105), (x * 0.108, 0.04, 0.10)]
        parts += placed(tube(loop, 0.007, "black"), at)
    return parts


def _sink(center: float, front: float) -> list[Patch]:
    """A basin set on the worktop, with a bent tap."""
    rim = [(-0.27, 0.0), (0.27, 0.0)]
    parts = box((0.56, 0.03, 0.02), "metal", at=(center, front + 0.09, _TOP))
    parts += box((0.56, 0.03, 0.02), "metal", at=(center, front + 0.47, _TOP))
    for x, _ in rim:
        parts += box((0.03, 0.38, 0.02), "metal", at=(center + x, front + 0.28, _TOP))
    parts += box((0.50, 0.34, 0.003), "metal", at=(center, front + 0.28, _TOP))
    angle = np.linspace(0, np.pi, 7)
    arc = [(center, front + 0.43 - 0.08 * (1 - float(np.cos(a))), _TOP + 0.24 + 0.08 * float(np.sin(a))) for a in angle]
    parts += tube([(center, front + 0.43, _TOP), *arc, (center, front + 0.27, _TOP + 0.19)], 0.012, "metal")
    return parts + tube([(center + 0.02, front + 0.43, _TOP + 0.07), (center + 0.09, front + 0.40, _TOP + 0.10)], 0.008,
                        "metal")  # fmt: skip


def _wall_cabinets(left: float, right: float) -> list[Patch]:
    """Closed cupboards on both sides of an open shelf with crockery, over the worktop."""
    z, height, depth, back = 1.48, 0.70, 0.34, 0.30
    front = back - depth
    parts: list[Patch] = []
    edges = np.linspace(left, right, 6)
    for k in range(5):
        a, b = float(edges[k]), float(edges[k + 1])
        if k != 2:
            parts += box((b - a, depth, height), "cabinet", at=((a + b) / 2, back - depth / 2, z))
            parts += _door((a + b) / 2, b - a, z, height, front)
            continue
        for bottom in (z, z + 0.34, z + height - 0.02):
            parts += box((b - a, depth, 0.02), "oak", at=((a + b) / 2, back - depth / 2, bottom))
        middle = (a + b) / 2
        for j in range(3):
            parts += cup((middle - 0.15 + 0.13 * j, front + 0.12, z + 0.02))
            parts += cylinder(0.045, 0.16, "fruit", at=(middle - 0.16 + 0.15 * j, front + 0.14, z + 0.36),
                              tint=((0.8, 0.3, 0.2), (0.9, 0.7, 0.3), (0.4, 0.5, 0.3))[j])  # fmt: skip
        stack = [(r, 0.02 * k) for k in range(5, 0, -1) for r in (0.08, 0.095)]
        parts += lathe([(0, 0.11), *stack, (0.06, 0.0)], "glaze", at=(middle + 0.13, front + 0.22, z + 0.02))
    return parts


def _refrigerator(center: float) -> list[Patch]:
    """A tall refrigerator with notes and postcards on its door."""
    front = -0.34
    parts = box((0.62, 0.62, 1.85), "metal", at=(center, -0.01, 0.02))
    parts += box((0.61, 0.03, 0.62), "white", at=(center, front, 1.23)) + box(
        (0.61, 0.03, 1.16), "white", at=(center, front, 0.05)
    )
    for z0, z1 in ((1.30, 1.55), (0.85, 1.15)):
        parts += tube([(center - 0.25, front - 0.05, z1), (center - 0.25, front - 0.05, z0)], 0.012, "metal")
    notes = ((-0.05, 1.70, 0.14, 0.10, "sunset"), (0.16, 1.62, 0.12, 0.16, "magazine"),
             (0.02, 1.46, 0.11, 0.11, "carton"),
             (0.15, 1.02, 0.17, 0.24, "botanical_2"), (-0.06, 0.98, 0.12, 0.12, "geometric"), (0.0, 0.70, 0.2, 0.14,
             "city_map"))  # fmt: skip
    for x, z, w, h, name in notes:
        corner = (center + x - w / 2, front - 0.018, z + h / 2)
        parts.append(panel(corner, (w, 0, 0), (0, 0, -h), name))
        parts += ball(0.012, "fruit", at=(center + x, front - 0.02, z + h / 2 - 0.012), rings=8, tint=(0.8, 0.1, 0.1))
    return parts + carton_row(center, 1.87)


def carton_row(center: float, z: float) -> list[Patch]:
    """Packages on top of something."""
    parts = placed(box((0.20, 0.09, 0.28), "carton_2", front="carton"), (center - 0.14, 0.0, z), yaw=8)
    parts += placed(box((0.24, 0.14, 0.20), "carton", front="carton_2"), (center + 0.12, 0.03, z), yaw=-12)
    return parts


def _clutter(rng: np.random.Generator, left: float, front: float) -> list[Patch]:
    """Bottles, packages, a chopping board, a kettle, herbs: what stands on a worktop."""
    z = _TOP
    parts: list[Patch] = []
    bottle = [(0.0, 0.30), (0.014, 0.30), (0.014, 0.24), (0.034, 0.19), (0.034, 0.0), (0.0, 0.0)]
    for x, y, tint in (
        (0.12, 0.50, (0.15, 0.30, 0.12)),
        (0.20, 0.52, (0.55, 0.35, 0.10)),
        (0.26, 0.46, (0.5, 0.1, 0.1)),
    ):
        parts += lathe(bottle, "fruit", at=(left + x, front + y, z), segments=18, tint=tint)
    parts += placed(box((0.19, 0.07, 0.27), "carton_2", front="carton"), (left + 0.45, front + 0.48, z), yaw=12)
    parts += placed(box((0.16, 0.08, 0.22), "carton", front="carton_2"), (left + 0.64, front + 0.50, z), yaw=-8)
    parts += placed(box((0.42, 0.28, 0.025), "oak"), (left + 0.45, front + 0.20, z), yaw=7)
    parts += placed(ball(0.04, "fruit", rings=10, tint=(0.8, 0.1, 0.05)), (left + 0.36, front + 0.18, z + 0.065))
    parts += placed(ball(0.036, "fruit", rings=10, tint=(0.8, 0.5, 0.05)), (left + 0.47, front + 0.24, z + 0.06))
    kettle = [(0.0, 0.24), (0.02, 0.235), (0.06, 0.20), (0.085, 0.12), (0.09, 0.02), (0.08, 0.0), (0.0, 0.0)]
    spot = (left + 1.45, front + 0.40, z)
    parts += lathe(kettle, "brass", at=spot, segments=28)
    grip = [(0.06, 0.0, 0.20), (0.11, 0.0, 0.22), (0.13, 0.0, 0.14), (0.10, 0.0, 0.06)]
    spout = [(0.06, 0.0, 0.09), (0.11, 0.0, 0.13), (0.14, 0.0, 0.19)]
    parts += placed(tube(grip, 0.010, "black"), spot, yaw=-50) + placed(tube(spout, 0.014, "brass"), spot, yaw=130)
    parts += placed(plant(rng, 0.52, 16, 0.17), (left + 2.55, front + 0.46, z - 0.13))
    parts += fruit_bowl(rng, (left + 2.88, front + 0.28, z), 0.14)
    return parts + vase(0.26, "ceramic", at=(left + 3.12, front + 0.48, z))


def kitchen_block(rng: np.random.Generator, width: float = 3.3) -> list[Patch]:
    """Everything along one wall; x runs from 0 to `width` (m), the wall stands at y = 0.31."""
    depth, wall = 0.62, 0.31
    front, left = wall - depth, 0.70
    parts = _refrigerator(0.34)
    run = width - left
    parts += box((run, depth - 0.06, 0.10), "black", at=(left + run / 2, 0.03, 0.0))
    parts += box((run, depth, 0.76), "cabinet", at=(left + run / 2, 0.0, 0.10))
    parts += box((run + 0.02, depth + 0.03, 0.04), "worktop", at=(left + run / 2, -0.015, _TOP - 0.04))
    count = 5
    each = run / count
    for k in range(count):
        center = left + (k + 0.5) * each
        if k == 1:
            parts += _oven(center, each, front)
        elif k == 3:
            parts += [patch for z in (0.12, 0.36, 0.60) for patch in _door(center, each, z, 0.235, front, drawer=True)]
        else:
            parts += _door(center, each, 0.12, 0.72, front)
    parts += _sink(left + 3.5 * each, front)
    parts.append(panel((left, wall - 0.008, 1.48), (run, 0, 0), (0, 0, _TOP - 1.48), "backsplash"))
    parts += _wall_cabinets(left, left + run)
    return parts + _clutter(rng, left, front)
