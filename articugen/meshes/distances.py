"""Points on triangles, and distances to them."""

import math

import numpy as np

from articugen.core.arrays import Floats, Indices, Ints
from articugen.core.geometry import points_on_triangles
from articugen.core.jit import dot, helper, kernel, minus, vector


def sample(triangles: Floats, count: int, rng: np.random.Generator) -> Floats:
    """Return (count, 3) points spread over triangles (F, 3, 3) uniformly by area.

    Points count as triangles whose corners coincide; where all do, some of them are drawn.
    """
    return points_on_triangles(triangles, count, rng=rng)[0]


LEAF = 6  # so many triangles at most share a box that is not divided further


def distance(points: Floats, triangles: Floats) -> Floats:
    """Return (n,) the distance from each point to the nearest of the triangles (F, 3, 3); inf if
    none.

    Points count as triangles whose corners coincide.
    """
    return nearest(points, triangles)[0]


def nearest(points: Floats, triangles: Floats) -> tuple[Floats, Indices]:
    """Return the `distance` (n,), and (n,) which of the triangles is the nearest; -1 if none."""
    far, which = np.full(len(points), np.inf), np.full(len(points), -1)
    if len(triangles) and len(points):
        along = np.argsort(_along_a_curve(points))  # what is near the last one is near the next
        corners, boxes, order = _tree(np.asarray(triangles, np.float64))
        far[along], place = _distances(points[along], corners, boxes)
        which[along] = order[place]
    return far, which


def _tree(triangles: Floats) -> tuple[Floats, Floats, Indices]:
    """Return the triangles along a curve that fills space, so that neighbours in memory lie
    together; (2 L, 6) boxes around runs of them: node n has the children 2 n and 2 n + 1, from
    1 on, and node L + i is the i-th of L leaves, a power of 2, which share the triangles evenly;
    and (F,) the number of each triangle."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    order = np.argsort(_along_a_curve(a + b + c))
    corners = triangles[order]
    leaves = 1 << (-(-len(corners) // LEAF) - 1).bit_length()
    first = np.arange(leaves) * len(corners) // leaves
    boxes = np.empty((2 * leaves, 6))
    boxes[leaves:, :3] = np.minimum.reduceat(np.minimum(np.minimum(a, b), c)[order], first)
    boxes[leaves:, 3:] = np.maximum.reduceat(np.maximum(np.maximum(a, b), c)[order], first)
    while leaves > 1:
        below, leaves = boxes[leaves : 2 * leaves], leaves // 2
        boxes[leaves : 2 * leaves, :3] = np.minimum(below[::2, :3], below[1::2, :3])
        boxes[leaves : 2 * leaves, 3:] = np.maximum(below[::2, 3:], below[1::2, 3:])
    return corners, boxes, order


def _along_a_curve(points: Floats) -> Ints:
    """Return (n,) the place of each point (n, 3) on Morton's curve: the bits of its cells,
    interleaved."""
    low, size = points.min(0), max(float(np.ptp(points, axis=0).max()), 1e-30)
    cell = ((points - low) / size * 1023.0).astype(np.int64)
    for shift, mask in ((16, 0x30000FF), (8, 0x300F00F), (4, 0x30C30C3), (2, 0x9249249)):
        cell = (cell | cell << shift) & mask
    return cell @ np.array([4, 2, 1])


@kernel
def _distances(points, corners, boxes):  # pragma: no cover - compiled
    result, places = np.empty(len(points)), np.empty(len(points), np.int64)
    leaves, nearest = len(boxes) // 2, 0
    waiting, away = np.empty(64, np.int64), np.empty(64)
    for i in range(len(points)):
        p = vector(points, i)
        best = _to_triangle(p, corners, nearest)
        beyond = best * best * (1.0 + 1e-9)  # whatever the rounding
        waiting[0], away[0] = 1, 0.0
        left = 1
        while left > 0:
            left -= 1
            node = waiting[left]
            if away[left] > beyond:
                continue
            if node >= leaves:
                first = (node - leaves) * len(corners) // leaves
                for f in range(first, (node - leaves + 1) * len(corners) // leaves):
                    square = _to_triangle(p, corners, f)
                    if square < best:
                        best, nearest = square, f
                beyond = best * best * (1.0 + 1e-9)
                continue
            one, two = 2 * node, 2 * node + 1
            to_one, to_two = _to_box(p, boxes, one), _to_box(p, boxes, two)
            if to_one < to_two:
                one, two, to_one, to_two = two, one, to_two, to_one
            waiting[left], away[left] = one, to_one  # the nearer one is looked at first
            waiting[left + 1], away[left + 1] = two, to_two
            left += 2
        result[i], places[i] = best, nearest
    return result, places


@helper
def _to_box(p, boxes, n):  # pragma: no cover - compiled
    """Return the square of the distance."""
    x = max(boxes[n, 0] - p[0], p[0] - boxes[n, 3], 0.0)
    y = max(boxes[n, 1] - p[1], p[1] - boxes[n, 4], 0.0)
    z = max(boxes[n, 2] - p[2], p[2] - boxes[n, 5], 0.0)
    return x * x + y * y + z * z


@helper
def _to_triangle(p, corners, f):  # noqa: PLR0911  # pragma: no cover - compiled
    """From a point to a triangle (Ericson 2005, "Real-Time Collision Detection", 5.1.5)."""
    a = corners[f, 0, 0], corners[f, 0, 1], corners[f, 0, 2]
    b = corners[f, 1, 0], corners[f, 1, 1], corners[f, 1, 2]
    c = corners[f, 2, 0], corners[f, 2, 1], corners[f, 2, 2]
    ab, ac, ap = minus(b, a), minus(c, a), minus(p, a)
    d1, d2 = dot(ab, ap), dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return math.sqrt(dot(ap, ap))
    bp = minus(p, b)
    d3, d4 = dot(ab, bp), dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return math.sqrt(dot(bp, bp))
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return _beside(ap, d1 / (d1 - d3), ab, 0.0, ac)
    cp = minus(p, c)
    d5, d6 = dot(ab, cp), dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return math.sqrt(dot(cp, cp))
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return _beside(ap, 0.0, ab, d2 / (d2 - d6), ac)
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        along = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return _beside(bp, -along, ab, along, ac)
    whole = 1.0 / (va + vb + vc)
    return _beside(ap, vb * whole, ab, vc * whole, ac)


@helper
def _beside(point, s, one, t, two):  # pragma: no cover - compiled
    """Return how far `point` is from s * one + t * two."""
    x = point[0] - s * one[0] - t * two[0]
    y = point[1] - s * one[1] - t * two[1]
    z = point[2] - s * one[2] - t * two[2]
    return math.sqrt(x * x + y * y + z * z)
