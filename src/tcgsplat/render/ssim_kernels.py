"""Structural similarity and its derivative on the CPU: two passes of a separable window, nothing kept but three maps.

With means m and window averages of a a, a b, b b, S is a function of m_a, E[aa], E[ab] for a fixed observed image b.
Its three partial derivatives, spread back by the same symmetric window, give
    dL/da = blur(G dS/dm_a) + 2 a blur(G dS/dE[aa]) + b blur(G dS/dE[ab]).
"""

from typing import Final

import numpy as np
from numba import njit

RADIUS = 5
_TWO = np.float32(2)
_FAST: Final = {"contract", "nsz", "arcp", "reassoc"}


@njit(fastmath=_FAST, error_model="numpy", nogil=True, cache=True)
def _across(padded, window, out):  # type: ignore[no-untyped-def]
    """Window along a row; `padded` has RADIUS zeros on both sides."""
    for x in range(out.size):
        total = window[RADIUS] * padded[x + RADIUS]
        for k in range(RADIUS):
            total += window[k] * (padded[x + k] + padded[x + 2 * RADIUS - k])
        out[x] = total


@njit(fastmath=_FAST, error_model="numpy", nogil=True, cache=True)
def _down(rows, y, window, out):  # type: ignore[no-untyped-def]
    """Window along the columns, for row y; `rows` has RADIUS zero rows above and below."""
    middle = rows[y + RADIUS]
    for x in range(out.size):
        out[x] = window[RADIUS] * middle[x]
    for k in range(RADIUS):
        above, below, weight = rows[y + k], rows[y + 2 * RADIUS - k], window[k]
        for x in range(out.size):
            out[x] += weight * (above[x] + below[x])


@njit(fastmath=_FAST, error_model="numpy", nogil=True, cache=True)
def forward(a, b, window, c1, c2, similarity, by_mean, by_aa, by_ab):  # type: ignore[no-untyped-def]
    """S of images [channels, h, w] and its partial derivatives by m_a, E[aa] and E[ab], maps of the same shape."""
    channels, h, w = a.shape
    rows = np.zeros((5, h + 2 * RADIUS, w), np.float32)
    line, average = np.zeros((5, w + 2 * RADIUS), np.float32), np.empty((5, w), np.float32)
    for c in range(channels):
        for y in range(h):
            ra, rb = a[c, y], b[c, y]
            for x in range(w):
                va, vb = ra[x], rb[x]
                line[0, x + RADIUS], line[1, x + RADIUS] = va, vb
                line[2, x + RADIUS], line[3, x + RADIUS], line[4, x + RADIUS] = va * va, vb * vb, va * vb
            for m in range(5):
                _across(line[m], window, rows[m, y + RADIUS])
        for y in range(h):
            for m in range(5):
                _down(rows[m], y, window, average[m])
            for x in range(w):
                ma, mb, ab = average[0, x], average[1, x], average[4, x]
                luminance, structure = _TWO * ma * mb + c1, _TWO * (ab - ma * mb) + c2
                luminance_inverse = np.float32(1) / (ma * ma + mb * mb + c1)
                structure_inverse = np.float32(1) / (average[2, x] - ma * ma + average[3, x] - mb * mb + c2)
                both = luminance_inverse * structure_inverse
                s = luminance * structure * both
                similarity[c, y, x] = s
                by_mean[c, y, x] = _TWO * (
                    mb * (structure - luminance) * both - ma * s * (luminance_inverse - structure_inverse)
                )
                by_aa[c, y, x] = -s * structure_inverse
                by_ab[c, y, x] = _TWO * luminance * both


@njit(fastmath=_FAST, error_model="numpy", nogil=True, cache=True)
def backward(upstream, a, b, by_mean, by_aa, by_ab, window, out):  # type: ignore[no-untyped-def]
    """dL/da from dL/dS, all [channels, h, w]."""
    channels, h, w = a.shape
    rows = np.zeros((3, h + 2 * RADIUS, w), np.float32)
    line, average = np.zeros((3, w + 2 * RADIUS), np.float32), np.empty((3, w), np.float32)
    for c in range(channels):
        for y in range(h):
            for x in range(w):
                g = upstream[c, y, x]
                line[0, x + RADIUS] = g * by_mean[c, y, x]
                line[1, x + RADIUS] = g * by_aa[c, y, x]
                line[2, x + RADIUS] = g * by_ab[c, y, x]
            for m in range(3):
                _across(line[m], window, rows[m, y + RADIUS])
        for y in range(h):
            for m in range(3):
                _down(rows[m], y, window, average[m])
            ra, rb = a[c, y], b[c, y]
            for x in range(w):
                out[c, y, x] = average[0, x] + _TWO * ra[x] * average[1, x] + rb[x] * average[2, x]
