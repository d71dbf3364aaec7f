"""Small things: books, prints, vases, fruit, lamps, plants; each around its own origin, base at z = 0, metres."""

import numpy as np

from tcgsplat.datasets.synthetic.shapes import (
    Patch,
    Vector,
    ball,
    box,
    cushion,
    cylinder,
    lathe,
    panel,
    placed,
    sheet,
    tube,
)

_COVERS: tuple[Vector, ...] = ((0.30, 0.10, 0.08), (0.08, 0.14, 0.26), (0.10, 0.20, 0.12), (0.45, 0.36, 0.22))
"""Linear colours of book covers."""


def picture(width: float, height: float, print_name: str, frame: str = "walnut") -> list[Patch]:
    """A framed print that hangs with its back at y = 0 and its centre at z = 0."""
    bar, z = 0.035, -height / 2
    parts = [panel((-width / 2, -0.012, -z), (width, 0, 0), (0, 0, -height), print_name)]
    for x in (-1, 1):
        parts += box((bar, 0.03, height + 2 * bar), frame, at=(x * (width + bar) / 2, -0.015, z - bar))
    for top in (z - bar, -z):
        parts += box((width, 0.03, bar), frame, at=(0, -0.015, top))
    return parts


def books(rng: np.random.Generator, width: float, clear: float) -> list[Patch]:
    """A row of books of at most `clear` height that stand on z = 0 between x = 0 and `width`, spines at y = 0."""
    parts: list[Patch] = []
    x = 0.0
    while True:
        thick = float(rng.uniform(0.022, 0.055))
        height, depth = clear * float(rng.uniform(0.72, 0.95)), float(rng.uniform(0.15, 0.21))
        if x + thick > width:
            return parts
        which = int(rng.integers(0, 16))
        cover = _COVERS[which % len(_COVERS)]
        parts += _book((thick, depth, height), which, cover, x)
        x += thick + 0.001


def _book(size: Vector, which: int, cover: Vector, x: float) -> list[Patch]:
    """One upright book whose spine shows the given sixteenth of the texture of spines."""
    patches = box(size, "white", at=(x + size[0] / 2, size[1] / 2, 0), tint=cover, top="pages")
    spine = Patch(patches[0].points, "books", extent=(1 / 16, 1.0), origin=(which / 16, 0.0))
    return [spine, *patches[1:]]


def ornament(rng: np.random.Generator, at: Vector, radius: float) -> list[Patch]:
    """A vase, a ball on a foot, or a box."""
    kind = rng.integers(0, 3)
    if kind == 0:
        return vase(0.24 * radius / 0.1, ["ceramic", "glaze"][int(rng.integers(0, 2))], at=at)
    if kind == 1:
        foot = cylinder(0.5 * radius, 0.02, "brass", at=at)
        return foot + ball(0.8 * radius, "city_map", at=(at[0], at[1], at[2] + 0.02 + 0.8 * radius))
    return box((1.6 * radius, 0.14, 0.16), "carton_2", at=at)


def vase(height: float, material: str, *, at: Vector = (0, 0, 0)) -> list[Patch]:
    """A bellied vase with a neck; its width follows its height."""
    z = np.linspace(1, 0, 17)
    r = 0.20 + 0.20 * np.sin(np.pi * (0.15 + 0.9 * (1 - z)) ** 1.4) + 0.05 * np.exp(-(((z - 1) / 0.06) ** 2))
    profile = [(float(a) * height, float(b) * height) for a, b in zip(r, z, strict=True)]
    inside = [(0.0, 0.55 * height), (profile[0][0] - 0.008, profile[0][1])]
    return lathe([*inside, *profile, (0.0, 0.0)], material, at=at)


def cup(at: Vector, material: str = "glaze") -> list[Patch]:
    """A mug with a handle."""
    profile = [(0.0, 0.02), (0.033, 0.025), (0.036, 0.092), (0.04, 0.092), (0.037, 0.0), (0.0, 0.0)]
    handle = [(0.038, 0.0, 0.075), (0.06, 0.0, 0.07), (0.068, 0.0, 0.045), (0.058, 0.0, 0.022), (0.036, 0.0, 0.016)]
    return lathe(profile, material, at=at, segments=20) + placed(tube(handle, 0.006, material), at, yaw=-40)


def fruit_bowl(rng: np.random.Generator, at: Vector, radius: float) -> list[Patch]:
    """A bowl with apples and oranges."""
    r = radius
    profile = [(0.0, 0.02), (0.45 * r, 0.03), (0.97 * r, 0.55 * r), (r, 0.55 * r), (0.5 * r, 0.0), (0.0, 0.0)]
    parts = lathe(profile, "ceramic", at=at, segments=28)
    colors: tuple[Vector, ...] = ((0.85, 0.22, 0.05), (0.60, 0.05, 0.04), (0.35, 0.50, 0.05), (0.90, 0.55, 0.05))
    for k in range(6):
        angle, size = k * 2 * np.pi / 5, float(rng.uniform(0.034, 0.042))
        ring = 0.0 if k == 5 else 0.47 * r
        center = (at[0] + ring * np.cos(angle), at[1] + ring * np.sin(angle), at[2] + (0.48 if k < 5 else 0.95) * r)
        parts += ball(size, "fruit", at=center, rings=10, tint=colors[int(rng.integers(0, 4))])
    return parts


def floor_lamp(height: float = 1.65) -> list[Patch]:
    """A pole with a pleated shade that glows."""
    parts = lathe([(0.0, 0.04), (0.12, 0.03), (0.16, 0.0), (0.0, 0.0)], "brass", segments=32)
    parts += cylinder(0.014, height - 0.2, "brass", at=(0, 0, 0.03), segments=10)
    return parts + lathe([(0.13, height), (0.22, height - 0.32)], "shade", segments=32)


def table_lamp() -> list[Patch]:
    """A ceramic foot with a small shade."""
    parts = vase(0.24, "ceramic")
    return parts + lathe([(0.09, 0.44), (0.15, 0.23)], "shade", segments=28)


def plant(rng: np.random.Generator, height: float = 1.3, leaves: int = 26, spread: float = 0.42) -> list[Patch]:
    """A house plant in a pot: stems with bent leaves in a spiral."""
    parts = lathe(
        [(0.0, 0.27), (0.155, 0.27), (0.16, 0.31), (0.185, 0.31), (0.185, 0.26), (0.13, 0.0), (0.0, 0.0)],
        "terracotta", segments=28,
    )  # fmt: skip
    parts += lathe([(0.0, 0.285), (0.157, 0.28)], "soil", segments=20)
    for k in range(leaves):
        angle = 2.39996 * k + float(rng.uniform(-0.2, 0.2))
        start = 0.32 + (height - 0.55) * k / leaves * float(rng.uniform(0.8, 1.0))
        length = spread * float(rng.uniform(0.75, 1.1)) * (1.1 - 0.4 * k / leaves)
        parts += _leaf(angle, start, length, 0.34 * length, lift=float(rng.uniform(0.5, 1.0)))
    stem = [(0.0, 0.0, z) for z in np.linspace(0.25, height - 0.15, 6)]
    stem = [(0.02 * float(np.sin(5 * z)), 0.02 * float(np.cos(4 * z)), z) for _, _, z in stem]
    return parts + tube(stem, 0.012, "terracotta", tint=(0.5, 0.7, 0.4))


def _leaf(angle: float, start: float, length: float, width: float, lift: float) -> list[Patch]:
    """A leaf that rises from the stem at height `start` and bends down at its tip."""
    t = np.linspace(0, 1, 8)
    reach, rise = length * t * (1 - 0.15 * t), length * lift * (1.1 * t - 1.25 * t**2.2)
    half = 0.5 * width * np.sin(np.pi * np.clip(t, 0.02, 1) ** 0.8)
    s = np.linspace(-1, 1, 3)
    fold = -0.35 * np.abs(s)[None] * half[:, None]
    x = reach[:, None] + 0 * s[None]
    y = half[:, None] * s[None]
    z = start + rise[:, None] - fold
    c, sn = np.cos(angle), np.sin(angle)
    points = np.stack((c * x - sn * y, sn * x + c * y, z), axis=-1)
    return sheet(points, "leaf", (width, length))


def carton(size: Vector, at: Vector, yaw: float, print_name: str = "cardboard") -> list[Patch]:
    """A closed box printed on every side."""
    return placed(box(size, print_name), at, yaw=yaw)


def basket() -> list[Patch]:
    """A wicker basket with rolled blankets and a ball."""
    profile = [(0.0, 0.03), (0.16, 0.03), (0.205, 0.34), (0.225, 0.34), (0.23, 0.32), (0.17, 0.0), (0.0, 0.0)]
    parts = lathe(profile, "wicker", segments=28)
    parts += ball(0.12, "dots", at=(0.04, 0.03, 0.34))
    return parts + cushion((0.24, 0.16, 0.30), "checks", at=(-0.07, -0.04, 0.14), edge=0.6)


def clock(radius: float = 0.17) -> list[Patch]:
    """A wall clock with its back at y = 0."""
    parts = lathe([(0.0, 0.02), (0.86 * radius, 0.02), (0.87 * radius, 0.035), (radius, 0.03), (radius, 0.0)], "white",
                  segments=36)  # fmt: skip
    for k in range(12):
        length = 0.035 if k % 3 == 0 else 0.02
        mark = box((0.008, length, 0.003), "black", at=(0, 0.78 * radius - length / 2, 0.02))
        parts += placed(mark, (0, 0, 0), yaw=30.0 * k)
    for angle, length in ((300.0, 0.09), (60.0, 0.125)):
        parts += placed(box((0.01, length, 0.003), "black", at=(0, length / 2, 0.022)), (0, 0, 0), yaw=-angle)
    return placed(parts, (0, 0, 0), tilt=90)
