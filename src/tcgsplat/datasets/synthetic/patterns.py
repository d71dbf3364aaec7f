"""Procedural pictures: pure functions of a random generator that give colours [h, w, 3] in [0, 1], as displayed.

Sides are powers of two, because the renderer builds mip maps from them. Patterns meant to repeat do so seamlessly.
"""

from typing import Any

import cv2
import numpy as np

Array = np.ndarray[Any, np.dtype[Any]]
Color = tuple[float, float, float]


def noise(rng: np.random.Generator, height: int, width: int, rows: int, columns: int, octaves: int = 4) -> Array:
    """Seamless fractal value noise in about [-1, 1]; `rows` and `columns` (powers of two) count its coarsest cells."""
    total = np.zeros((height, width), dtype=np.float32)
    for octave in range(octaves):
        r, c = min(rows << octave, height), min(columns << octave, width)
        lattice = np.pad(rng.uniform(-1, 1, (r, c)).astype(np.float32), 2, mode="wrap")
        scale_y, scale_x = height // r, width // c
        size = (lattice.shape[1] * scale_x, lattice.shape[0] * scale_y)
        smooth = cv2.resize(lattice, size, interpolation=cv2.INTER_CUBIC)
        total += smooth[2 * scale_y : 2 * scale_y + height, 2 * scale_x : 2 * scale_x + width] * 0.5**octave
    return total


def _grid(height: int, width: int) -> tuple[Array, Array]:
    """Coordinates v, u of pixel centres in [0, 1)."""
    v, u = (np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width
    grid_v, grid_u = np.meshgrid(v.astype(np.float32), u.astype(np.float32), indexing="ij")
    return grid_v, grid_u


def _shade(color: Color, factor: Array) -> Array:
    return np.clip(np.asarray(color, dtype=np.float32) * factor[..., None].astype(np.float32), 0, 1)


def _mix(a: Array, b: Array | Color, weight: Array) -> Array:
    return a + (np.asarray(b, dtype=np.float32) - a) * weight[..., None].astype(np.float32)


def plain(rng: np.random.Generator, color: Color, grain: float = 0.04, side: int = 128) -> Array:
    """Paint, plaster or plastic: nearly one colour, with clouds and fine grain of the given strength."""
    clouds = 0.5 * noise(rng, side, side, 4, 4, 3)
    speckle = noise(rng, side, side, side // 4, side // 4, 2)
    return _shade(color, 1 + grain * (clouds + speckle))


def wood(rng: np.random.Generator, color: Color, contrast: float = 0.22, height: int = 256, width: int = 512) -> Array:
    """Grain along u: growth rings cut lengthways, with fibres and pores."""
    v, _ = _grid(height, width)
    bend = noise(rng, height, width, 2, 1, 3)
    rings = np.sin(2 * np.pi * (v * 9 + 0.8 * bend))
    fibres = noise(rng, height, width, height // 4, 8, 3)
    pores = np.clip(noise(rng, height, width, height // 2, 32, 2) - 0.75, 0, 1)
    return _shade(color, 1 + contrast * (0.28 * rings + 0.45 * fibres + 0.40 * bend) - 1.2 * contrast * pores)


def planks(rng: np.random.Generator, color: Color, side: int = 1024, rows: int = 16) -> Array:
    """A wooden floor: rows of boards of different tones, lengths and grain, with dark joints."""
    v, u = _grid(side, side)
    row = (v * rows).astype(int)
    start = rng.uniform(0, 0.5, rows).astype(np.float32)[row]
    board = ((u + start) % 1 * 2).astype(int)
    which = 2 * row + board
    tone = rng.uniform(0.78, 1.12, 2 * rows).astype(np.float32)[which]
    hue = rng.uniform(-0.04, 0.04, 2 * rows).astype(np.float32)[which]
    grain = wood(rng, (1.0, 1.0, 1.0), 0.16, side, side)[..., 0]
    shift = rng.integers(0, side, 2 * rows)[which]
    tone *= np.take_along_axis(grain, (np.arange(side)[None] + shift) % side, axis=1)
    to_row = np.abs((v * rows + 0.5) % 1 - 0.5) / rows * side
    to_end = np.abs(((u + start) * 2 + 0.5) % 1 - 0.5) / 2 * side
    joint = 1 - 0.75 * np.clip(1.6 - np.minimum(to_row, to_end), 0, 1)
    channels = [color[0] * tone * (1 + hue), color[1] * tone, color[2] * tone * (1 - hue)]
    return np.asarray(np.clip(np.stack(channels, axis=-1) * joint[..., None], 0, 1))


def tiles(
    rng: np.random.Generator,
    colors: list[Color],
    *,
    rows: int = 4,
    columns: int = 4,
    bond: float = 0.0,
    joint: Color = (0.72, 0.70, 0.67),
    variation: float = 0.06,
    side: int = 512,
) -> Array:
    """Ceramic tiles or bricks: `bond` is how far every second row is shifted, in tiles; colours alternate."""
    v, u = _grid(side, side)
    row = (v * rows).astype(int)
    x = u * columns + bond * (row % 2)
    column = np.floor(x).astype(int) % columns
    tone = 1 + rng.uniform(-variation, variation, (rows, columns))[row, column]
    tone = tone * (1 + variation * (noise(rng, side, side, 8, 8, 5) + 0.4 * noise(rng, side, side, 128, 128, 2)))
    image = np.asarray(colors)[(row + column) % len(colors)] * tone[..., None]
    to_row = np.abs((v * rows + 0.5) % 1 - 0.5) / rows * side
    to_end = np.abs((x + 0.5) % 1 - 0.5) / columns * side
    edge = np.minimum(to_row, to_end)
    image = _mix(image, (1.0, 1.0, 1.0), 0.12 * np.clip(1 - np.abs(edge - 5) / 2, 0, 1))
    return np.clip(_mix(image, joint, np.clip(4.0 - edge, 0, 1)), 0, 1)


def stone(rng: np.random.Generator, color: Color, side: int = 512) -> Array:
    """Speckled worktop stone with veins."""
    speckle = noise(rng, side, side, 64, 64, 4)
    vein = np.exp(-np.abs(noise(rng, side, side, 4, 4, 5)) * 14)
    image = _shade(color, 1 + 0.3 * speckle)
    return np.clip(_mix(image, (0.93, 0.91, 0.88), 0.5 * vein), 0, 1)


def weave(rng: np.random.Generator, color: Color, side: int = 256, threads: int = 32) -> Array:
    """Upholstery: threads over and under each other, with colour changing from thread to thread."""
    v, u = _grid(side, side)
    x, y = u * threads, v * threads
    over = (np.floor(x) + np.floor(y)) % 2
    profile = np.where(over > 0, np.abs(np.sin(np.pi * x)), np.abs(np.sin(np.pi * y)))
    warp = rng.uniform(0.85, 1.1, threads)[x.astype(int)]
    weft = rng.uniform(0.85, 1.1, threads)[y.astype(int)]
    blotch = noise(rng, side, side, 4, 4, 4)
    return _shade(color, (0.72 + 0.33 * profile) * np.where(over > 0, warp, weft) * (1 + 0.07 * blotch))


def wallpaper(rng: np.random.Generator, ground: Color, ink: Color, side: int = 512) -> Array:
    """Rows of stylised sprigs on a faintly striped ground, every second row shifted; repeats."""
    _, u = _grid(side, side)
    stripes = 1 + 0.025 * np.sign(np.sin(2 * np.pi * 16 * u))
    image = _shade(ground, stripes * (1 + 0.03 * noise(rng, side, side, 8, 8, 6)))
    mask = np.zeros((side, side), dtype=np.uint8)
    cell = side // 4
    for row in range(-1, 5):
        for column in range(-1, 5):
            x, y = (column + 0.5 + 0.5 * (row % 2)) * cell, (row + 0.5) * cell
            _sprig(mask, x, y, 0.40 * cell, flip=(row + column) % 2 == 0)
    weight = cv2.GaussianBlur(mask, (0, 0), 0.8) / 255.0 * (0.75 + 0.2 * noise(rng, side, side, 16, 16, 3))
    return np.clip(_mix(image, ink, weight), 0, 1)


def _sprig(mask: Array, x: float, y: float, size: float, *, flip: bool) -> None:
    """Paint one stem with pairs of leaves and a flower into a mask."""
    turn = -1 if flip else 1

    def point(a: float, b: float) -> tuple[int, int]:
        return round(x + turn * a * size), round(y - b * size)

    stem = np.array([point(0.25 * np.sin(2.2 * k), -1 + 2 * k) for k in np.linspace(0, 0.85, 12)], dtype=np.int32)
    cv2.polylines(mask, [stem], isClosed=False, color=255, thickness=2, lineType=cv2.LINE_AA)
    axes = (round(0.24 * size), round(0.09 * size))
    for k, height in enumerate((-0.7, -0.3, 0.1)):
        bend = 0.25 * np.sin(2.2 * (height + 1) / 2)
        for side in (-1, 1):
            angle = -side * turn * (35 + 6 * k)
            center = point(bend + side * 0.24, height + 0.14)
            cv2.ellipse(mask, center, axes, angle, 0, 360, 200, -1, cv2.LINE_AA)
    for k in range(6):
        dx, dy = 0.17 * np.cos(k * np.pi / 3), 0.17 * np.sin(k * np.pi / 3)
        cv2.circle(mask, point(0.24 + dx, 0.78 + dy), round(0.10 * size), 235, -1, cv2.LINE_AA)
    cv2.circle(mask, point(0.24, 0.78), round(0.08 * size), 120, -1, cv2.LINE_AA)


def stripes(rng: np.random.Generator, colors: list[Color], bands: int = 16, side: int = 256) -> Array:
    """Woven stripes along v of random widths, in the given colours."""
    edges = np.sort(rng.uniform(0, 1, bands))
    band = np.searchsorted(edges, (np.arange(side) + 0.5) / side)
    image = np.asarray(colors)[band % len(colors)][None].repeat(side, axis=0)
    return np.asarray(np.clip(image * weave(rng, (1.0, 1.0, 1.0), side), 0, 1))


def motif(rng: np.random.Generator, ground: Color, colors: list[Color], kind: str, side: int = 256) -> Array:
    """Cushion and curtain prints that repeat: `zigzag`, `dots`, `checks` or `diamonds`."""
    v, u = _grid(side, side)
    if kind == "zigzag":
        band = np.floor(8 * v + 1.2 * np.abs((4 * u) % 1 - 0.5) * 2)
    elif kind == "dots":
        x, y = (6 * u) % 1 - 0.5, (6 * v) % 1 - 0.5
        band = np.where(np.hypot(x, y) < 0.3, 1 + np.floor(6 * u) + np.floor(6 * v), 0)
    elif kind == "checks":
        band = (np.floor(8 * u) % 2) + 2 * (np.floor(8 * v) % 2)
    else:
        band = np.floor(4 * (np.abs((4 * u) % 1 - 0.5) + np.abs((4 * v) % 1 - 0.5)))
    palette = np.array([ground, *colors])
    image = palette[band.astype(int) % len(palette)]
    return np.asarray(np.clip(image * weave(rng, (1.0, 1.0, 1.0), side, 64) * 1.1, 0, 1))


def rug(rng: np.random.Generator, colors: list[Color], height: int = 512, width: int = 1024) -> Array:
    """An oriental rug: nested borders, a field of small medallions and a large one, mirrored both ways."""
    h, w = height // 2, width // 2
    v, u = np.meshgrid(np.arange(h) + 0.5, np.arange(w) + 0.5, indexing="ij")
    edge = np.minimum(v, u)
    band = np.digitize(edge, [14, 20, 46, 52, 62, 66])
    palette = np.array([colors[0], colors[2], colors[1], colors[2], colors[3], colors[2], colors[0]])
    image = palette[band]
    along = np.maximum(v, u)
    flower = np.hypot((along % 26) - 13, edge - 33)
    image = np.where(((band == 2) & (flower < 9))[..., None], np.asarray(colors[3]), image)
    image = np.where(((band == 2) & (flower < 4))[..., None], np.asarray(colors[0]), image)
    field = band == 6
    lattice = np.abs((u / 44) % 1 - 0.5) + np.abs((v / 44) % 1 - 0.5)
    for limit, color in ((0.30, colors[3]), (0.22, colors[1]), (0.12, colors[2])):
        image = np.where((field & (lattice < limit))[..., None], np.asarray(color), image)
    reach = np.hypot((w - u) / 0.40 / w, (h - v) / 0.62 / h)
    reach = reach * (1 + 0.07 * np.cos(12 * np.arctan2(h - v, (w - u) * 0.8)))
    for limit, color in ((1.0, colors[2]), (0.94, colors[1]), (0.62, colors[3]), (0.55, colors[0]), (0.25, colors[2])):
        image = np.where((field & (reach < limit))[..., None], np.asarray(color), image)
    image = np.concatenate((image, image[:, ::-1]), axis=1)
    image = np.concatenate((image, image[::-1]), axis=0)
    fade = 1 + 0.10 * noise(rng, height, width, 4, 8, 4) + 0.10 * noise(rng, height, width, 128, 256, 2)
    return np.clip(image * fade[..., None], 0, 1)


def round_rug(rng: np.random.Generator, colors: list[Color], side: int = 512) -> Array:
    """Braided rings in polar coordinates: v is the radius, u the angle."""
    v, u = _grid(side, side)
    ring = np.floor(v * 24)
    color = np.asarray(colors)[rng.integers(0, len(colors), 24)[ring.astype(int)]]
    braid = 0.8 + 0.25 * np.abs(np.sin(np.pi * (v * 24))) * (0.7 + 0.3 * np.sin(2 * np.pi * (u * 96 + 0.5 * ring)))
    braid *= 1 + 0.08 * noise(rng, side, side, 8, 8, 4)
    return np.asarray(np.clip(color * braid[..., None], 0, 1))


def foliage(rng: np.random.Generator, color: Color, side: int = 128) -> Array:
    """One leaf along v: a light midrib with veins."""
    v, u = _grid(side, side)
    across = np.abs(u - 0.5)
    veins = np.abs(np.sin(np.pi * (v * 9 + across * 5)))
    tone = 0.85 + 0.3 * v + 0.12 * noise(rng, side, side, 4, 4, 4) - 0.2 * np.exp(-veins * 8)
    return np.clip(_mix(_shade(color, tone), (0.75, 0.82, 0.5), np.exp(-across * 60)), 0, 1)


def lamp(rng: np.random.Generator, color: Color, pleats: int = 24, side: int = 128) -> Array:
    """A pleated, glowing shade, brightest at its middle height."""
    v, u = _grid(side, side)
    glow = 0.80 + 0.2 * np.exp(-(((v - 0.55) / 0.3) ** 2)) + 0.05 * np.cos(2 * np.pi * pleats * u)
    return _shade(color, glow + 0.02 * noise(rng, side, side, 16, 16, 3))


def metal(rng: np.random.Generator, color: Color, side: int = 256) -> Array:
    """Brushed along u."""
    return _shade(color, 1 + 0.09 * noise(rng, side, side, 128, 2, 2) + 0.06 * noise(rng, side, side, 2, 2, 2))
