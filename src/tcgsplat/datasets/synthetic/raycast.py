"""Rays against triangles through a tree of boxes: what light and shadow are computed with."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

Array = np.ndarray[Any, np.dtype[Any]]

_BINS = 12
_LEAF = 4
"""Triangles that a leaf may hold."""


class Tree(NamedTuple):
    """A binary tree of axis-aligned boxes over triangles, depth first."""

    bounds: Array
    """[n, 6] float64 lower, then upper corner of each node, metres."""
    link: Array
    """[n, 2] int32: (second child, 0) of an inner node, its first one is next; (first triangle, count) of a leaf."""
    corner: Array
    """[t, 3, 3] float64 of each triangle, in the order of the leaves: a corner and the two edges from it, metres."""
    source: Array
    """[t] int32 number of each of them in the mesh that the tree was built from."""


def tree(vertices: Array, triangles: Array, source: Array) -> Tree:
    """Build the tree over triangles [t, 3] of vertices [v, 3]; `source` [t] says how they are called."""
    points = vertices[triangles]
    order = np.arange(len(triangles))
    bounds, link, count = _split(points.min(axis=1), points.max(axis=1), order)
    points = points[order]
    corner = np.stack((points[:, 0], points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=1)
    return Tree(bounds[:count], link[:count], np.ascontiguousarray(corner), source[order].astype(np.int32))


@njit(nogil=True, cache=True)
def _split(lower: Array, upper: Array, order: Array) -> tuple[Array, Array, int]:
    """Order triangles into a tree, each node cut where the boxes' surface times their contents is least."""
    count = len(order)
    bounds = np.empty((2 * count, 6))
    link = np.zeros((2 * count, 2), dtype=np.int32)
    stack = [(0, count, -1)]
    nodes = 0
    while len(stack) > 0:
        first, last, parent = stack.pop()
        node = nodes
        nodes += 1
        if parent >= 0:
            link[parent, 0] = node
        for c in range(3):
            bounds[node, c], bounds[node, c + 3] = 1e30, -1e30
            for n in range(first, last):
                bounds[node, c] = min(bounds[node, c], lower[order[n], c])
                bounds[node, c + 3] = max(bounds[node, c + 3], upper[order[n], c])
        middle = first if last - first <= _LEAF else _cut(lower, upper, order, first, last)
        if middle in (first, last):
            link[node, 0], link[node, 1] = first, last - first
            continue
        stack.append((middle, last, node))
        stack.append((first, middle, -1))
    return bounds, link, nodes


@njit(nogil=True, cache=True)
def _cut(lower: Array, upper: Array, order: Array, first: int, last: int) -> int:
    """Part `order[first:last]` in place where it is cheapest, and return where the second part begins."""
    bins, held, behind = np.empty((_BINS, 6)), np.empty(_BINS, dtype=np.int64), np.empty(_BINS)
    best, best_axis, best_at = 1e30, -1, 0.0
    for axis in range(3):
        low, high = 1e30, -1e30
        for n in range(first, last):
            middle = 0.5 * (lower[order[n], axis] + upper[order[n], axis])
            low, high = min(low, middle), max(high, middle)
        if high - low < 1e-9:
            continue
        _sort_into_bins(lower, upper, order, (first, last, axis), (low, high), bins, held)
        _sweep(bins, held, behind, False)
        cost, cut = _sweep(bins, held, behind, True)
        if cost < best:
            best, best_axis, best_at = cost, axis, low + (high - low) * cut / _BINS
    if best_axis < 0:
        return first
    head, tail = first, last - 1
    while head <= tail:
        triangle = order[head]
        if 0.5 * (lower[triangle, best_axis] + upper[triangle, best_axis]) < best_at:
            head += 1
        else:
            order[head], order[tail] = order[tail], triangle
            tail -= 1
    return head


@njit(nogil=True, cache=True)
def _sort_into_bins(
    lower: Array,
    upper: Array,
    order: Array,
    which: tuple[int, int, int],
    limits: tuple[float, float],
    bins: Array,
    held: Array,
) -> None:
    """Boxes and numbers of the triangles whose middles lie in each of equal slices along an axis."""
    first, last, axis = which
    low, high = limits
    for k in range(_BINS):
        held[k] = 0
        for c in range(3):
            bins[k, c], bins[k, c + 3] = 1e30, -1e30
    for n in range(first, last):
        triangle = order[n]
        middle = 0.5 * (lower[triangle, axis] + upper[triangle, axis])
        k = min(int((middle - low) / (high - low) * _BINS), _BINS - 1)
        held[k] += 1
        for c in range(3):
            bins[k, c] = min(bins[k, c], lower[triangle, c])
            bins[k, c + 3] = max(bins[k, c + 3], upper[triangle, c])


@njit(nogil=True, cache=True)
def _sweep(bins: Array, held: Array, behind: Array, forward: bool) -> tuple[float, int]:
    """Cost of what lies on one side of each cut: backwards it is stored, forwards added, and the best cut returned."""
    x0, y0, z0, x1, y1, z1 = 1e30, 1e30, 1e30, -1e30, -1e30, -1e30
    count, best, best_cut = 0, 1e30, 1
    for step in range(_BINS - 1):
        k = step if forward else _BINS - 1 - step
        count += held[k]
        x0, y0, z0 = min(x0, bins[k, 0]), min(y0, bins[k, 1]), min(z0, bins[k, 2])
        x1, y1, z1 = max(x1, bins[k, 3]), max(y1, bins[k, 4]), max(z1, bins[k, 5])
        x, y, z = x1 - x0, y1 - y0, z1 - z0
        cost = count * (x * y + y * z + z * x) if count > 0 else 0.0
        if not forward:
            behind[k] = cost
        elif cost + behind[k + 1] < best:
            best, best_cut = cost + behind[k + 1], k + 1
    return best, best_cut


@njit(nogil=True, cache=True)
def cast(
    tree: Tree, origin: Array, direction: Array, reach: float, first_hit: bool, stack: Array
) -> tuple[float, int, float, float]:
    """Follow a ray to the nearest triangle, or to any.

    Args:
        tree: What may be hit.
        origin: [3] metres.
        direction: [3]; distances count in its length.
        reach: Nothing farther counts.
        first_hit: Stop at any triangle: enough to know that there is one.
        stack: [64] int32 to work with.

    Returns:
        Distance, position in the tree's list of triangles (-1: none), and the weights of that triangle's second and
        third corner.
    """
    depth, node = 0, 0
    best, hit, best_b, best_c = reach, -1, 0.0, 0.0
    ix, iy, iz = _inverse(direction[0]), _inverse(direction[1]), _inverse(direction[2])
    while True:
        if _enters(tree.bounds[node], origin, ix, iy, iz, best):
            count = tree.link[node, 1]
            if count == 0:
                stack[depth] = tree.link[node, 0]
                depth += 1
                node += 1
                continue
            start = tree.link[node, 0]
            for n in range(start, start + count):
                distance, b, c = _meet(tree.corner[n], origin, direction)
                if 0 < distance < best:
                    best, hit, best_b, best_c = distance, n, b, c
                    if first_hit:
                        return best, hit, best_b, best_c
        if depth == 0:
            return best, hit, best_b, best_c
        depth -= 1
        node = stack[depth]


@njit(nogil=True, cache=True)
def _inverse(x: float) -> float:
    return 1 / x if abs(x) > 1e-12 else 1e12


@njit(nogil=True, cache=True)
def _enters(bounds: Array, origin: Array, ix: float, iy: float, iz: float, reach: float) -> bool:
    """Whether a ray meets a box within its reach."""
    x0, x1 = (bounds[0] - origin[0]) * ix, (bounds[3] - origin[0]) * ix
    y0, y1 = (bounds[1] - origin[1]) * iy, (bounds[4] - origin[1]) * iy
    z0, z1 = (bounds[2] - origin[2]) * iz, (bounds[5] - origin[2]) * iz
    near = max(min(x0, x1), min(y0, y1), min(z0, z1), 0.0)
    far = min(max(x0, x1), max(y0, y1), max(z0, z1), reach)
    return bool(near <= far)


@njit(nogil=True, cache=True)
def _meet(corner: Array, origin: Array, direction: Array) -> tuple[float, float, float]:
    """Distance to a triangle and the hit's weights (Moeller and Trumbore 1997); a distance of -1 is a miss."""
    ax, ay, az = corner[1, 0], corner[1, 1], corner[1, 2]
    bx, by, bz = corner[2, 0], corner[2, 1], corner[2, 2]
    dx, dy, dz = direction[0], direction[1], direction[2]
    px, py, pz = dy * bz - dz * by, dz * bx - dx * bz, dx * by - dy * bx
    det = ax * px + ay * py + az * pz
    if abs(det) < 1e-14:
        return -1.0, 0.0, 0.0
    tx, ty, tz = origin[0] - corner[0, 0], origin[1] - corner[0, 1], origin[2] - corner[0, 2]
    b = (tx * px + ty * py + tz * pz) / det
    if b < 0 or b > 1:
        return -1.0, 0.0, 0.0
    qx, qy, qz = ty * az - tz * ay, tz * ax - tx * az, tx * ay - ty * ax
    c = (dx * qx + dy * qy + dz * qz) / det
    if c < 0 or b + c > 1:
        return -1.0, 0.0, 0.0
    return (bx * qx + by * qy + bz * qz) / det, b, c
