"""Things printed or painted to be looked at: posters, book spines, packages, pages, the view from a window.

Pure functions of a random generator; pictures [h, w, 3] in [0, 1], as displayed, with sides that are powers of two.
"""

from typing import Any

import cv2
import numpy as np

from tcgsplat.datasets.synthetic.patterns import Color, noise

Array = np.ndarray[Any, np.dtype[Any]]

_SYLLABLES = ("ka", "lo", "mi", "ren", "tas", "vel", "on", "dor", "sie", "mar", "ul", "pen", "gra", "bis", "nor", "ta")


def word(rng: np.random.Generator, syllables: int) -> str:
    """A word of no language."""
    return "".join(_SYLLABLES[k] for k in rng.integers(0, len(_SYLLABLES), syllables))


def _text(image: Array, text: str, at: tuple[float, float], height: float, color: Color, weight: int = 1) -> None:
    """Write text whose capitals are `height` pixels tall, its baseline starting at `at` (x, y)."""
    mask = np.zeros(image.shape[:2], dtype=np.uint8)  # OpenCV 5 writes into 8-bit images only
    where = (round(at[0]), round(at[1]))
    cv2.putText(mask, text, where, cv2.FONT_HERSHEY_SIMPLEX, height / 21.0, 255, weight, cv2.LINE_AA)
    image += (np.asarray(color, dtype=np.float32) - image) * (mask / np.float32(255))[..., None]


def _paper(rng: np.random.Generator, height: int, width: int, color: Color) -> Array:
    grain = 1 + 0.02 * noise(rng, height, width, 4, 4, 6)
    return np.ascontiguousarray(np.asarray(color, dtype=np.float32) * grain[..., None], dtype=np.float32)


def landscape(rng: np.random.Generator, sky: Color, near: Color, height: int = 256, width: int = 512) -> Array:
    """Ranges of hills under a low sun, darker the nearer they are, with a lake and trees."""
    v = (np.arange(height)[:, None] + 0.5) / height
    u = np.arange(width)
    image = np.asarray(sky) * (1.05 - 0.35 * v[..., None]) + np.array([0.25, 0.12, 0.0]) * np.exp(-3 * v[..., None])
    image = np.broadcast_to(image, (height, width, 3)).astype(np.float32).copy()
    clouds = np.clip(noise(rng, height, width, 8, 2, 5), 0, 1)[..., None] * (1 - v[..., None])
    image = image + (1 - image) * 0.6 * clouds
    cv2.circle(image, (round(width * rng.uniform(0.2, 0.8)), round(0.28 * height)), height // 11, (1, 0.93, 0.7), -1)
    for k in range(6):
        depth = (k + 1) / 6
        ridge = 0.30 + 0.13 * k + 0.11 * (1.1 - depth) * noise(rng, 64, width, 1, 4, 6)[0]
        color = np.asarray(sky) * (1 - depth) * 0.8 + np.asarray(near) * depth
        below = (v >= ridge[None]) * (0.8 + 0.25 * noise(rng, height, width, 16, 16, 4))
        image = np.where((v >= ridge[None])[..., None], color * below[..., None], image)
    for x in rng.integers(0, width, 26):
        base, tall = round(height * rng.uniform(0.86, 1.0)), round(height * rng.uniform(0.08, 0.24))
        tree = np.array([(x - tall // 5, base), (x + tall // 5, base), (x, base - tall)], dtype=np.int32)
        cv2.fillPoly(image, [tree], tuple(float(0.45 * c) for c in near), cv2.LINE_AA)
    image *= 1 + 0.05 * noise(rng, height, width, height // 4, u.size // 4, 2)[..., None]
    return np.asarray(np.clip(image, 0, 1))


def geometric(rng: np.random.Generator, colors: list[Color], height: int = 512, width: int = 512) -> Array:
    """Circles, bars and arcs on a grid, in the manner of the twenties."""
    image = _paper(rng, height, width, (0.93, 0.90, 0.82))
    cell = height // 4
    for row in range(height // cell):
        for column in range(width // cell):
            x, y = column * cell, row * cell
            a, b, c = (colors[k] for k in rng.choice(len(colors), 3, replace=False))
            cv2.rectangle(image, (x + 3, y + 3), (x + cell - 4, y + cell - 4), a, -1)
            kind = rng.integers(0, 4)
            center = (x + cell // 2, y + cell // 2)
            if kind == 0:
                for k, color in enumerate((b, c, a, b)):
                    cv2.circle(image, center, round(cell * (0.44 - 0.1 * k)), color, -1, cv2.LINE_AA)
            elif kind == 1:
                corner = (x + 3 + (cell - 7) * int(rng.integers(0, 2)), y + 3 + (cell - 7) * int(rng.integers(0, 2)))
                tile = image[y + 3 : y + cell - 3, x + 3 : x + cell - 3]
                local = (corner[0] - x - 3, corner[1] - y - 3)
                for k, color in enumerate((b, c, b)):
                    cv2.circle(tile, local, round(cell * (0.9 - 0.28 * k)), color, -1, cv2.LINE_AA)
            elif kind == 2:
                for k in range(5):
                    top = y + 6 + round(k * cell / 5)
                    cv2.rectangle(image, (x + 6, top), (x + cell - 7, top + cell // 10), b if k % 2 else c, -1)
            else:
                half = np.array([(x + 3, y + cell - 4), (x + cell - 4, y + cell - 4), (x + cell - 4, y + 3)])
                cv2.fillPoly(image, [half.astype(np.int32)], b, cv2.LINE_AA)
                cv2.circle(image, center, cell // 6, c, -1, cv2.LINE_AA)
    return np.clip(image * (1 + 0.04 * noise(rng, height, width, 64, 64, 3)[..., None]), 0, 1)


def city_map(rng: np.random.Generator, side: int = 512) -> Array:
    """A street map: blocks, parks, a river, a rail line and names."""
    image = _paper(rng, side, side, (0.91, 0.87, 0.78))
    for _ in range(90):
        x, y = rng.integers(0, side, 2)
        w, h = rng.integers(14, 60, 2)
        tone = rng.uniform(0.72, 0.92)
        color = (tone, tone * 0.92, tone * 0.78) if rng.uniform() < 0.8 else (0.55, 0.68, 0.42)
        cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), color, -1)
    u = np.linspace(0, side, 40)
    river = np.stack((u, side * 0.6 + 70 * np.sin(u / 90) + 0.15 * u), axis=1)
    cv2.polylines(image, [river.astype(np.int32)], False, (0.45, 0.62, 0.72), 26, cv2.LINE_AA)
    for _ in range(34):
        a, angle = rng.uniform(0, side, 2), rng.choice([0.2, 0.2 + np.pi / 2]) + rng.normal(0, 0.08)
        step = side * np.array([np.cos(angle), np.sin(angle)])
        ends = [tuple(int(c) for c in a + k * step) for k in (-1, 1)]
        wide = int(rng.choice([2, 3, 3, 6]))
        cv2.line(image, ends[0], ends[1], (0.5, 0.46, 0.42), wide + 2, cv2.LINE_AA)
        cv2.line(image, ends[0], ends[1], (0.98, 0.95, 0.85) if wide < 6 else (0.93, 0.72, 0.35), wide, cv2.LINE_AA)
    for _ in range(26):
        x, y = rng.uniform(0, 0.85 * side, 2)
        _text(image, word(rng, 2).upper(), (x, y + 20), 9, (0.25, 0.2, 0.2))
    cv2.rectangle(image, (0, 0), (side - 1, 58), (0.20, 0.25, 0.33), -1)
    _text(image, word(rng, 3).upper(), (24, 44), 30, (0.95, 0.92, 0.85), 3)
    return np.clip(image, 0, 1)


def botanical(rng: np.random.Generator, ink: Color, height: int = 512, width: int = 256) -> Array:
    """A pressed branch on old paper with a caption."""
    image = _paper(rng, height, width, (0.92, 0.88, 0.76))
    x = width / 2 + 18 * np.sin(np.linspace(0, 4, 30))
    y = np.linspace(0.84, 0.08, 30) * height
    stem = np.stack((x, y), axis=1).astype(np.int32)
    cv2.polylines(image, [stem], False, tuple(0.6 * c for c in ink), 4, cv2.LINE_AA)
    for k in range(3, 30, 2):
        size = width * 0.20 * (1.15 - k / 40)
        for side in (-1, 1):
            angle = side * (25 + rng.uniform(-8, 8))
            center = (round(x[k] + side * size * 0.85), round(y[k] - size * 0.4))
            tone = tuple(float(np.clip(c * rng.uniform(0.7, 1.25), 0, 1)) for c in ink)
            cv2.ellipse(image, center, (round(size), round(size * 0.36)), -angle, 0, 360, tone, -1, cv2.LINE_AA)
            tip = (round(center[0] + side * size * 0.8), round(center[1] - size * 0.37))
            cv2.line(image, tuple(int(c) for c in stem[k]), tip, (0.85, 0.85, 0.65), 1, cv2.LINE_AA)
    _text(image, f"{word(rng, 3).title()} {word(rng, 2)}", (width * 0.16, height * 0.92), 13, (0.25, 0.2, 0.15))
    _text(image, f"fig. {rng.integers(1, 90)}", (width * 0.4, height * 0.965), 9, (0.35, 0.3, 0.25))
    cv2.rectangle(image, (8, 8), (width - 9, height - 9), (0.4, 0.33, 0.25), 2)
    return np.clip(image, 0, 1)


def concert_poster(rng: np.random.Generator, ground: Color, ink: Color, height: int = 512, width: int = 256) -> Array:
    """Large letters, a record with grooves, small print."""
    image = _paper(rng, height, width, ground)
    center = (width // 2, round(0.46 * height))
    for radius in range(round(0.42 * width), 8, -4):
        tone = 0.16 + 0.10 * ((radius // 4) % 2)
        cv2.circle(image, center, radius, (tone, tone, tone * 1.1), -1, cv2.LINE_AA)
    cv2.circle(image, center, round(0.15 * width), ink, -1, cv2.LINE_AA)
    cv2.circle(image, center, 5, ground, -1, cv2.LINE_AA)
    _text(image, word(rng, 2).upper(), (width * 0.07, height * 0.11), 34, ink, 5)
    _text(image, word(rng, 3).upper(), (width * 0.07, height * 0.18), 20, ink, 2)
    for k in range(8):
        line = f"{rng.integers(1, 30):02d} {word(rng, 2)} {word(rng, 2)}"
        _text(image, line, (width * 0.07, height * (0.76 + 0.03 * k)), 10, ink)
    return np.clip(image * (1 + 0.05 * noise(rng, height, width, 32, 16, 3)[..., None]), 0, 1)


def book_spines(rng: np.random.Generator, count: int = 16, height: int = 256, width: int = 512) -> Array:
    """`count` spines side by side, each as wide as the others, with titles that run along them."""
    each = width // count
    image = np.zeros((height, width, 3), dtype=np.float32)
    for k in range(count):
        hue, value = rng.choice([4, 14, 28, 42, 95, 150, 205, 220, 345]) + rng.normal(0, 6), rng.uniform(0.25, 0.85)
        pixel = np.array([[[hue % 360, rng.uniform(0.25, 0.7), value]]], dtype=np.float32)
        color = cv2.cvtColor(pixel, cv2.COLOR_HSV2RGB)[0, 0]
        ink = (0.93, 0.88, 0.70) if value < 0.6 else (0.12, 0.10, 0.12)
        spine = np.ascontiguousarray(np.broadcast_to(color, (each, height, 3)).astype(np.float32))
        for x in (0.04, 0.08, 0.90, 0.94):
            cv2.line(spine, (round(x * height), 0), (round(x * height), each), ink, 2)
        if rng.uniform() < 0.5:
            label = tuple(float(c) for c in np.clip(1.15 - color, 0, 1) * 0.7)
            cv2.rectangle(spine, (round(0.14 * height), 3), (round(0.62 * height), each - 4), label, -1)
        _text(spine, word(rng, 3).upper(), (0.16 * height, 0.66 * each), 0.36 * each, ink, 2)
        _text(spine, word(rng, 2), (0.68 * height, 0.62 * each), 0.26 * each, ink, 1)
        rounding = 0.72 + 0.33 * np.sin(np.pi * (np.arange(each) + 0.5) / each)
        image[:, k * each : (k + 1) * each] = np.rot90(spine * rounding[:, None, None], 3)
    return np.clip(image * (1 + 0.05 * noise(rng, height, width, 64, 128, 2)[..., None]), 0, 1)


def package(rng: np.random.Generator, ground: Color, ink: Color, height: int = 256, width: int = 256) -> Array:
    """A food carton: a name, a round picture, bands and small print."""
    image = _paper(rng, height, width, ground)
    cv2.rectangle(image, (0, round(0.10 * height)), (width, round(0.30 * height)), ink, -1)
    _text(image, word(rng, 2).title(), (0.08 * width, 0.25 * height), 0.10 * height, ground, 4)
    center = (round(0.5 * width), round(0.55 * height))
    cv2.circle(image, center, round(0.2 * height), (0.96, 0.93, 0.85), -1, cv2.LINE_AA)
    for _ in range(30):
        dx, dy = rng.normal(0, 0.07 * height, 2)
        tone = tuple(float(c) for c in np.clip(np.asarray(ink) * rng.uniform(0.5, 1.4), 0, 1))
        cv2.circle(image, (round(center[0] + dx), round(center[1] + dy)), round(0.03 * height), tone, -1, cv2.LINE_AA)
    for k in range(5):
        line = " ".join(word(rng, 2) for _ in range(4))
        _text(image, line, (0.08 * width, height * (0.82 + 0.035 * k)), 6, (0.2, 0.2, 0.2))
    return np.clip(image, 0, 1)


def page(rng: np.random.Generator, height: int = 256, width: int = 256) -> Array:
    """A magazine page: headline, picture, columns of text."""
    image = _paper(rng, height, width, (0.92, 0.91, 0.88))
    _text(image, word(rng, 4).title(), (14, 34), 20, (0.15, 0.15, 0.2), 3)
    picture = landscape(rng, (0.6, 0.72, 0.85), (0.3, 0.4, 0.25), 64, 128)
    image[48:112, 14:142] = picture
    for column, top in ((14, 126), (96, 126), (174, 48)):
        for y in range(top, height - 12, 8):
            _text(image, word(rng, 5), (column, y), 5, (0.25, 0.25, 0.25))
    return np.clip(image, 0, 1)


def cardboard(rng: np.random.Generator, height: int = 256, width: int = 256) -> Array:
    """Corrugated board with tape, a label and stamps."""
    image = _paper(rng, height, width, (0.68, 0.53, 0.36))
    flutes = 1 + 0.03 * np.sin(np.arange(width) * 2 * np.pi / 8)
    image *= (flutes[None] * (1 + 0.05 * noise(rng, height, width, 4, 4, 5)))[..., None].astype(np.float32)
    cv2.rectangle(image, (round(0.42 * width), 0), (round(0.58 * width), round(0.35 * height)), (0.78, 0.68, 0.5), -1)
    corner = (round(0.52 * width), round(0.5 * height))
    cv2.rectangle(image, corner, (round(0.92 * width), round(0.85 * height)), (0.93, 0.92, 0.9), -1)
    for k in range(5):
        _text(image, word(rng, 3), (corner[0] + 8, corner[1] + 18 + 15 * k), 9, (0.1, 0.1, 0.1))
    _text(image, word(rng, 2).upper(), (0.08 * width, 0.64 * height), 26, (0.35, 0.2, 0.12), 3)
    cv2.rectangle(image, (round(0.07 * width), round(0.72 * height)), (round(0.4 * width), round(0.9 * height)),
                  (0.55, 0.15, 0.12), 3)  # fmt: skip
    return np.clip(image, 0, 1)


def outdoors(rng: np.random.Generator, height: int = 256, width: int = 256) -> Array:
    """What one sees through a window by day: sky, houses, trees, a lawn, all bright."""
    v = (np.arange(height)[:, None, None] + 0.5) / height
    sky = np.array([0.72, 0.86, 1.0]) * (1 - v) + np.array([0.97, 0.98, 1.0]) * v
    image = np.ascontiguousarray(np.broadcast_to(sky, (height, width, 3)), dtype=np.float32)
    image += 0.25 * np.clip(noise(rng, height, width, 4, 2, 5), 0, 1)[..., None]
    ground = round(0.78 * height)
    for x in np.arange(-0.1, 1.0, 0.24):
        left, wide = round((x + rng.uniform(0, 0.08)) * width), round(rng.uniform(0.18, 0.24) * width)
        top = ground - round(rng.uniform(0.22, 0.32) * height)
        wall = tuple(float(c) for c in np.array([0.93, 0.84, 0.74]) * rng.uniform(0.8, 1.0))
        cv2.rectangle(image, (left, top), (left + wide, ground), wall, -1)
        roof = np.array([(left - 4, top), (left + wide + 4, top), (left + wide // 2, top - round(0.13 * height))])
        cv2.fillPoly(image, [roof.astype(np.int32)], (0.66, 0.36, 0.28), cv2.LINE_AA)
        for k in range(2):
            for j in range(2):
                x0, y0 = left + round((0.2 + 0.4 * k) * wide), top + 10 + 26 * j
                cv2.rectangle(image, (x0, y0), (x0 + wide // 5, y0 + 15), (0.42, 0.5, 0.6), -1)
    image[ground:] = (0.52, 0.66, 0.34)
    for x in rng.uniform(0, width, 6):
        base, tall = ground + round(rng.uniform(0, 0.12) * height), rng.uniform(0.25, 0.5) * height
        cv2.line(image, (round(x), base), (round(x), round(base - 0.5 * tall)), (0.4, 0.3, 0.2), 5, cv2.LINE_AA)
        for _ in range(40):
            dx, dy = rng.normal(0, 0.14 * tall, 2)
            tone = tuple(float(c) for c in np.array([0.36, 0.52, 0.24]) * rng.uniform(0.7, 1.3))
            at = (round(x + dx), round(base - 0.7 * tall + dy))
            cv2.circle(image, at, round(0.08 * tall), tone, -1, cv2.LINE_AA)
    return np.clip(image, 0, 1)
