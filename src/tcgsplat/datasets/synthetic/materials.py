"""What the apartment is made of: a texture, its size, and how it gives light or defeats a depth sensor."""

import zlib
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np

from tcgsplat.datasets.synthetic import patterns, prints
from tcgsplat.datasets.synthetic.patterns import Color

Array = np.ndarray[Any, np.dtype[Any]]


@dataclass(frozen=True)
class Material:
    """A Lambertian surface."""

    texture: Array
    """Displayed colours [h, w, 3] in [0, 1]; h and w are powers of two."""
    size: tuple[float, float] | None = None
    """Metres that one repeat of the texture covers along u and v; None stretches it over each patch."""
    emission: float = 0.0
    """Radiance of the texture's white as it is seen: 1 is a white wall in good light."""
    power: float = 0.0
    """The same as far as it lights the room; what lights casts no shadow. Seen at full power it would only be white."""
    two_sided: bool = False
    """Seen and lit from both sides: shades, leaves, curtains."""
    shine: float = 0.0
    """How readily an active depth sensor gets no answer from it, 0 to 1."""


@dataclass(frozen=True)
class Palette:
    """The colours that change with the seed, so that every apartment is somebody's own."""

    walls: tuple[Color, Color]
    accent: Color
    fabric: Color
    warm: Color
    cool: Color
    cabinet: Color
    oak: Color
    walnut: Color


_PALETTES = (
    Palette(
        walls=((0.86, 0.82, 0.72), (0.80, 0.84, 0.82)), accent=(0.42, 0.52, 0.42), fabric=(0.28, 0.45, 0.50),
        warm=(0.78, 0.36, 0.20), cool=(0.17, 0.28, 0.42), cabinet=(0.72, 0.77, 0.70), oak=(0.72, 0.53, 0.34),
        walnut=(0.44, 0.29, 0.19),
    ),
    Palette(
        walls=((0.80, 0.84, 0.86), (0.88, 0.83, 0.74)), accent=(0.35, 0.45, 0.60), fabric=(0.62, 0.34, 0.26),
        warm=(0.85, 0.62, 0.24), cool=(0.20, 0.38, 0.38), cabinet=(0.42, 0.52, 0.60), oak=(0.78, 0.60, 0.42),
        walnut=(0.38, 0.25, 0.18),
    ),
    Palette(
        walls=((0.87, 0.80, 0.76), (0.82, 0.83, 0.75)), accent=(0.62, 0.38, 0.35), fabric=(0.46, 0.50, 0.34),
        warm=(0.70, 0.28, 0.28), cool=(0.28, 0.32, 0.50), cabinet=(0.80, 0.72, 0.58), oak=(0.66, 0.47, 0.30),
        walnut=(0.50, 0.34, 0.24),
    ),
)  # fmt: skip

CREAM: Color = (0.91, 0.86, 0.74)


def palette(seed: int) -> Palette:
    """The palette of an apartment."""
    return _PALETTES[seed % len(_PALETTES)]


def _recipes(p: Palette) -> dict[str, Callable[[np.random.Generator], Material]]:
    """How to make every material; nothing is painted until the recipe is called with a generator."""
    four = [p.warm, p.cool, CREAM, p.accent]
    return {
        # The shell of the rooms.
        "floor_wood": lambda r: Material(patterns.planks(r, p.oak), (2.0, 2.0)),
        "floor_tile": lambda r: Material(patterns.tiles(r, [(0.86, 0.84, 0.80), (0.52, 0.50, 0.48)]), (1.2, 1.2)),
        "wallpaper": lambda r: Material(patterns.wallpaper(r, p.walls[0], p.accent), (0.8, 0.8)),
        "wallpaper_kitchen": lambda r: Material(patterns.wallpaper(r, p.walls[1], p.cool), (0.64, 0.64)),
        "brick": lambda r: Material(
            patterns.tiles(r, [(0.66, 0.36, 0.26), (0.60, 0.31, 0.23), (0.72, 0.43, 0.32)], rows=8, columns=3,
                           bond=0.5, variation=0.14), (0.75, 0.6)),
        "ceiling": lambda r: Material(patterns.tiles(r, [(0.93, 0.92, 0.89)], rows=2, columns=2, variation=0.03,
                                                     joint=(0.80, 0.79, 0.76)), (1.2, 1.2)),
        "trim": lambda r: Material(patterns.wood(r, (0.90, 0.88, 0.83), 0.06), (1.0, 0.5)),
        "outdoors": lambda r: Material(prints.outdoors(r), emission=0.8, power=45.0, shine=0.9),
        "outdoors_kitchen": lambda r: Material(prints.outdoors(r), emission=0.8, power=45.0, shine=0.9),
        # Wood, stone, metal, paint.
        "oak": lambda r: Material(patterns.wood(r, p.oak), (1.0, 0.4)),
        "walnut": lambda r: Material(patterns.wood(r, p.walnut, 0.3), (1.0, 0.4)),
        "worktop": lambda r: Material(patterns.stone(r, (0.34, 0.34, 0.36)), (0.9, 0.9), shine=0.3),
        "backsplash": lambda r: Material(
            patterns.tiles(r, [(0.90, 0.90, 0.87), p.cabinet, (0.86, 0.88, 0.86)], rows=4, columns=3, bond=0.5),
            (0.45, 0.3), shine=0.2),
        "cabinet": lambda r: Material(patterns.wood(r, p.cabinet, 0.10), (0.8, 0.4)),
        "metal": lambda r: Material(patterns.metal(r, (0.66, 0.67, 0.69)), (0.5, 0.5), shine=0.6),
        "brass": lambda r: Material(patterns.metal(r, (0.70, 0.56, 0.30)), (0.3, 0.3), shine=0.5),
        "black": lambda r: Material(patterns.plain(r, (0.13, 0.13, 0.14), 0.15), (0.3, 0.3), shine=0.7),
        "white": lambda r: Material(patterns.plain(r, (0.88, 0.87, 0.84), 0.05), (0.5, 0.5)),
        "ceramic": lambda r: Material(patterns.motif(r, (0.88, 0.86, 0.80), [p.cool, p.warm], "zigzag"), shine=0.2),
        "glaze": lambda r: Material(patterns.stripes(r, [p.cool, (0.85, 0.86, 0.85), p.accent], 12).transpose(1, 0, 2),
                                    shine=0.2),
        "terracotta": lambda r: Material(patterns.plain(r, (0.70, 0.40, 0.27), 0.12), (0.4, 0.4)),
        "soil": lambda r: Material(patterns.plain(r, (0.22, 0.16, 0.11), 0.5), (0.2, 0.2)),
        "fruit": lambda r: Material(patterns.plain(r, (0.90, 0.90, 0.85), 0.14), (0.12, 0.12)),
        # Cloth.
        "sofa": lambda r: Material(patterns.weave(r, p.fabric), (0.35, 0.35)),
        "armchair": lambda r: Material(patterns.motif(r, p.accent, [CREAM, p.cool], "diamonds"), (0.4, 0.4)),
        "zigzag": lambda r: Material(patterns.motif(r, CREAM, [p.warm, p.cool], "zigzag"), (0.5, 0.5)),
        "dots": lambda r: Material(patterns.motif(r, p.warm, [CREAM, p.cool], "dots"), (0.5, 0.5)),
        "checks": lambda r: Material(patterns.motif(r, CREAM, [p.accent, p.accent, p.cool], "checks"), (0.4, 0.4)),
        "blanket": lambda r: Material(patterns.motif(r, CREAM, [p.warm, p.warm, p.cool], "checks"), (0.3, 0.3),
                                      two_sided=True),
        "stripes": lambda r: Material(patterns.stripes(r, four), (0.5, 0.5)),
        "curtain": lambda r: Material(patterns.stripes(r, [CREAM, p.warm, CREAM, p.accent], 12), (0.6, 0.6),
                                      two_sided=True),
        "rug": lambda r: Material(patterns.rug(r, [p.warm, p.cool, CREAM, p.accent])),
        "round_rug": lambda r: Material(patterns.round_rug(r, four)),
        "wicker": lambda r: Material(patterns.weave(r, (0.66, 0.48, 0.28), 256, 16), (0.25, 0.25)),
        # Light.
        "shade": lambda r: Material(patterns.lamp(r, (1.0, 0.86, 0.62)), emission=1.3, power=40.0, two_sided=True),
        "globe": lambda r: Material(patterns.lamp(r, (1.0, 0.95, 0.85), 8), emission=2.0, power=80.0, two_sided=True),
        # Things to look at.
        "leaf": lambda r: Material(patterns.foliage(r, (0.30, 0.50, 0.22)), two_sided=True),
        "landscape": lambda r: Material(prints.landscape(r, (0.70, 0.80, 0.90), (0.20, 0.30, 0.20))),
        "sunset": lambda r: Material(prints.landscape(r, (0.95, 0.66, 0.45), (0.25, 0.16, 0.25))),
        "geometric": lambda r: Material(prints.geometric(r, [p.warm, p.cool, CREAM, (0.88, 0.68, 0.28)])),
        "city_map": lambda r: Material(prints.city_map(r)),
        "botanical": lambda r: Material(prints.botanical(r, (0.30, 0.48, 0.26))),
        "botanical_2": lambda r: Material(prints.botanical(r, (0.55, 0.35, 0.25))),
        "concert": lambda r: Material(prints.concert_poster(r, (0.90, 0.74, 0.32), (0.55, 0.12, 0.12))),
        "concert_2": lambda r: Material(prints.concert_poster(r, (0.30, 0.50, 0.55), (0.96, 0.90, 0.75))),
        "books": lambda r: Material(prints.book_spines(r), (1.0, 1.0)),
        "pages": lambda r: Material(patterns.stripes(r, [(0.92, 0.89, 0.80), (0.82, 0.78, 0.68)], 64), (0.1, 0.1)),
        "carton": lambda r: Material(prints.package(r, (0.92, 0.82, 0.34), (0.16, 0.36, 0.66))),
        "carton_2": lambda r: Material(prints.package(r, (0.88, 0.86, 0.80), (0.72, 0.18, 0.16))),
        "magazine": lambda r: Material(prints.page(r)),
        "cardboard": lambda r: Material(prints.cardboard(r)),
        # The person who walks about.
        "pullover": lambda r: Material(patterns.stripes(r, [p.cool, CREAM, p.warm], 14).transpose(1, 0, 2), (0.5, 0.5)),
        "trousers": lambda r: Material(patterns.weave(r, (0.25, 0.30, 0.42)), (0.15, 0.15)),
        "skin": lambda r: Material(patterns.plain(r, (0.85, 0.64, 0.52), 0.05), (0.3, 0.3)),
        "hair": lambda r: Material(patterns.metal(r, (0.26, 0.18, 0.12)), (0.2, 0.2)),
    }  # fmt: skip


def make(names: list[str], seed: int, workers: Executor) -> list[Material]:
    """Materials by name; each draws from a generator of its own, so that one more changes none of the others."""
    recipes = _recipes(palette(seed))

    def painted(name: str) -> Material:
        return recipes[name](np.random.default_rng((seed, zlib.crc32(name.encode()))))

    return list(workers.map(painted, names))
