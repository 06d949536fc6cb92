"""Distances from points to triangles."""

import math

import numpy as np

from articugen.core.arrays import Floats, Indices, Ints
from articugen.core.jit import cross, dot, helper, kernel, minus, vector
from articugen.meshes.bvh import ordered


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
        corners = np.ascontiguousarray(triangles, np.float64)
        order, *tree, count = ordered(corners)
        far[along], place = _distances(points[along], corners[order], *tree, count)
        which[along] = order[place]
    return far, which


def _along_a_curve(points: Floats) -> Ints:
    """Return (n,) the place of each point (n, 3) on Morton's curve: the bits of its cells,
    interleaved."""
    low, size = points.min(0), max(float(np.ptp(points, axis=0).max()), 1e-30)
    cell = ((points - low) / size * 1023.0).astype(np.int64)
    for shift, mask in ((16, 0x30000FF), (8, 0x300F00F), (4, 0x30C30C3), (2, 0x9249249)):
        cell = (cell | cell << shift) & mask
    return cell @ np.array([4, 2, 1])


@kernel
def _distances(points, corners, box, skip, leaf, nodes):  # pragma: no cover - compiled
    result, places, nearest = np.empty(len(points)), np.empty(len(points), np.int64), 0
    for i in range(len(points)):
        p = vector(points, i)
        best, node = _to_triangle(p, corners, nearest), 0
        while node < nodes:
            if to_box(p, box, node) > best:
                node = skip[node]
                continue
            for f in range(leaf[node, 0], leaf[node, 0] + leaf[node, 1]):
                square = _to_triangle(p, corners, f)
                if square < best:
                    best, nearest = square, f
            node += 1
        result[i], places[i] = math.sqrt(best), nearest
    return result, places


@helper
def to_box(p, box, n):  # pragma: no cover - compiled
    """Return the squared distance of `p` to box `n`."""
    x = max(box[n, 0] - p[0], p[0] - box[n, 3], 0.0)
    y = max(box[n, 1] - p[1], p[1] - box[n, 4], 0.0)
    z = max(box[n, 2] - p[2], p[2] - box[n, 5], 0.0)
    return x * x + y * y + z * z


@helper
def _to_triangle(p, corners, f):  # pragma: no cover - compiled
    a, b, c = vector(corners[f], 0), vector(corners[f], 1), vector(corners[f], 2)
    return to_triangle(p, a, b, c)


@helper
def to_triangle(q, a, b, c):  # pragma: no cover - compiled
    """Return the squared distance of `q` to a triangle: to its plane if over it, else an edge."""
    normal = cross(minus(b, a), minus(c, a))
    square = dot(normal, normal)
    over = square > 0.0 and _on_inner_side(q, a, b, normal)
    if over and _on_inner_side(q, b, c, normal) and _on_inner_side(q, c, a, normal):
        height = dot(minus(q, a), normal)
        return height * height / square
    return min(_to_segment(q, a, b), _to_segment(q, b, c), _to_segment(q, c, a))


@helper
def _on_inner_side(q, a, b, normal):  # pragma: no cover - compiled
    """Return whether `q`, dropped on the triangle's plane, lies on the inner side of its edge a,
    b."""
    return dot(cross(minus(b, a), minus(q, a)), normal) >= 0.0


@helper
def _to_segment(q, a, b):  # pragma: no cover - compiled
    e, p = minus(b, a), minus(q, a)
    length = dot(e, e)
    share = 0.0
    if length > 0.0:
        share = min(max(dot(p, e) / length, 0.0), 1.0)
    off = minus(p, (share * e[0], share * e[1], share * e[2]))
    return dot(off, off)
