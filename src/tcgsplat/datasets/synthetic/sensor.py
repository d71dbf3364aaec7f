"""What a cheap RGB-D camera does to perfect images; each effect draws from a generator of its own.

The depth noise follows published figures of structured-light sensors: a spread that grows with the square of the
distance and disparity in eighths of a pixel (Khoshelham and Elberink, Sensors 2012), shadows beside edges because
projector and camera stand apart, and no reading at flat angles, far away, and on dark or shiny things.
"""

import enum
from typing import Any

import cv2
import numpy as np

Array = np.ndarray[Any, np.dtype[Any]]

_BASELINE_FOCAL = 0.075 * 570.0
"""Kinect: 7.5 cm between projector and camera times a focal length of 570 pixels, metre pixels."""

_EDGE = 0.02
"""How much the surface bends within the window, of its depth, where one surface ends before another."""


class Effect(enum.IntEnum):
    """Names the random numbers of an effect, so that switching one on changes no other."""

    DEPTH = 10
    EXPOSURE = 11
    DROPS = 12
    FREE = 13


def generator(seed: int, effect: Effect, frame: int = 0) -> np.random.Generator:
    """The generator of one effect in one frame."""
    return np.random.default_rng((seed, int(effect), frame))


def _blotches(rng: np.random.Generator, shape: tuple[int, int], cell: float) -> Array:
    """Smooth random field [h, w] in about [-1, 1] with structure of `cell` pixels."""
    h, w = shape
    coarse = rng.uniform(-1, 1, (int(h / cell) + 4, int(w / cell) + 4)).astype(np.float32)
    return np.asarray(cv2.resize(coarse, (w, h), interpolation=cv2.INTER_CUBIC))


def noisy_depth(
    depth: Array,
    incidence: Array,
    shine: Array,
    color: Array,
    focal: float,
    rng: np.random.Generator,
    spread: float = 1.0,
) -> Array:
    """Depth [h, w] as a structured-light sensor reports it, metres, 0 where it gets no answer.

    Args:
        depth: True depth [h, w] along the optical axis, metres, 0 where there is nothing.
        incidence: Cosine [h, w] between ray and surface normal.
        shine: How much each pixel's surface [h, w] mirrors, 0 to 1.
        color: Displayed colour [h, w, 3] in [0, 1].
        focal: Pixels.
        rng: For this frame alone.
        spread: Factor on the noise of disparity; edges, holes and rounding stay what they are.
    """
    h, w = depth.shape
    pixel = w / 640.0  # effects on the image have their size in a picture 640 wide
    # Edges: each reading comes from a little beside its pixel, the way a correlation window sees; the nearer surface
    # wins, so that it grows, and some pixels on the edge mix both.
    v, u = np.meshgrid(np.arange(h, dtype=np.float32), np.arange(w, dtype=np.float32), indexing="ij")
    du, dv = (
        pixel * (size * _blotches(rng, (h, w), 6 * pixel + 1) + 0.6 * rng.standard_normal((h, w), dtype=np.float32))
        for size in (1.6, 1.0)
    )
    shifted = cv2.remap(
        depth.astype(np.float32), u + du, v + dv, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
    ).astype(np.float64)
    reach = 2 * round(1.5 * pixel) + 1
    around = np.ones((reach, reach), np.uint8)
    nearest, farthest = cv2.erode(np.where(depth > 0, depth, 1e3), around), cv2.dilate(depth, around)
    # on a slope the one is as much nearer as the other is farther: it has no edge, and would only come nearer
    edge = np.abs(farthest + nearest - 2 * depth) > _EDGE * depth
    grows = edge & (_blotches(rng, (h, w), 10 * pixel + 1) > 0.15)
    grown = np.where(grows, np.minimum(shifted, nearest), shifted)
    mixed = cv2.blur(grown, (reach, reach))
    z = np.where(rng.uniform(0, 1, (h, w)) < 0.25, mixed, grown)
    # Range: noise of the disparity, part of it shared by neighbours, then its quantisation.
    disparity = _BASELINE_FOCAL / np.maximum(z, 0.05)
    white = rng.standard_normal((h, w))
    shared = 1.5 * _blotches(rng, (h, w), 4 * pixel + 1)
    disparity = np.round(8 * (disparity + spread * 0.035 * white + spread * 0.030 * shared)) / 8
    z = _BASELINE_FOCAL / np.maximum(disparity, 0.5)
    return np.where(_holes(depth, incidence, shine, color, focal, rng), 0.0, z)


def _holes(depth: Array, incidence: Array, shine: Array, color: Array, focal: float, rng: np.random.Generator) -> Array:
    """Pixels [h, w] that get no answer."""
    h, w = depth.shape
    pixel = w / 640.0
    rough = 0.5 + 0.5 * _blotches(rng, (h, w), 9 * pixel + 1) + 0.1 * rng.standard_normal((h, w))
    rough = np.maximum(rough, 0.02)  # where there is no risk, there is no hole
    large = 0.5 + 0.5 * _blotches(rng, (h, w), 40 * pixel + 1)
    dark = 0.8 * np.clip(1 - color.max(axis=2) / 0.16, 0, 1)
    risk = np.maximum.reduce([
        np.clip((0.30 - incidence) / 0.22, 0, 1),
        np.clip((depth - 4.6) / 3.0, 0, 1),
        np.clip((0.55 - depth) / 0.15, 0, 1),
        dark,
        0.75 * shine,
    ])  # fmt: skip
    patches = (large > 0.94) & (rough > 0.45)
    # The projector stands to the left: in its view, what is nearer moves farther right and hides what follows.
    disparity = np.where(depth > 0, 0.075 * focal / np.maximum(depth, 0.05), 0)
    seen_from = np.arange(w)[None] + disparity
    shadow = seen_from < np.maximum.accumulate(seen_from, axis=1) - 0.6
    return np.asarray((depth <= 0) | (rough < risk) | patches | shadow)


def exposure_gains(frames: int, seed: int) -> Array:
    """Factor [frames] on displayed colour: constant for a while, then a jump, as when a camera meters anew."""
    rng = generator(seed, Effect.EXPOSURE)
    count = max(2, min(frames // 6, 10))
    starts = np.concatenate(([0], np.sort(rng.choice(np.arange(1, frames), count - 1, replace=False))))
    gains = np.concatenate(([1.0], np.exp(rng.uniform(np.log(0.62), np.log(1.25), count - 1))))
    return np.asarray(gains[np.searchsorted(starts, np.arange(frames), side="right") - 1])


def dropped(frames: int, seed: int) -> Array:
    """Whether each frame [frames] is lost: runs of 2 to 7, about one in a hundred frames; never the first or last."""
    rng = generator(seed, Effect.DROPS)
    lost = np.zeros(frames, dtype=bool)
    for _ in range(max(1, frames // 100)):
        length = int(rng.integers(2, 8))
        start = int(rng.integers(1, max(2, frames - length)))
        lost[start : start + length] = True
    lost[[0, -1]] = False
    return lost
