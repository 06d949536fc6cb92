"""Points on triangles, and distances to them."""

import math

import numba
import numpy as np

from articugen.geometry import points_on_triangles
from articugen.records import Floats


def sample(triangles: Floats, count: int, rng: np.random.Generator) -> Floats:
    """(count, 3) points spread over triangles (F, 3, 3) uniformly by area.

    Points count as triangles whose corners coincide; where all do, some of them are drawn.
    """
    return points_on_triangles(triangles, count, rng=rng)[0]


def distance(points: Floats, triangles: Floats) -> Floats:
    """(n,) the distance from each point to the nearest of the triangles (F, 3, 3); inf if none.

    Points count as triangles whose corners coincide.
    """
    if not len(triangles):
        return np.full(len(points), np.inf)
    triangles = np.ascontiguousarray(triangles, np.float64)
    centre = triangles.mean(axis=1)
    radius = np.linalg.norm(triangles - centre[:, None], axis=2).max(axis=1)
    return _distance(np.ascontiguousarray(points, np.float64), triangles, centre, radius)


@numba.njit(cache=True, nogil=True)
def _distance(points, triangles, centre, radius):  # pragma: no cover - compiled
    result = np.empty(len(points))
    to_centre = np.empty(len(centre))
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        best = np.inf
        for f in range(len(centre)):
            dx, dy, dz = x - centre[f, 0], y - centre[f, 1], z - centre[f, 2]
            to_centre[f] = math.sqrt(dx * dx + dy * dy + dz * dz)
            best = min(best, to_centre[f] + radius[f])  # no triangle's nearest point is farther
        best *= 1.0 + 1e-12
        for f in range(len(centre)):
            if to_centre[f] - radius[f] <= best:
                best = min(best, _to_triangle(points[i], triangles[f]))
        result[i] = best
    return result


@numba.njit(cache=True, nogil=True)
def _to_triangle(p, t):  # noqa: PLR0911  # pragma: no cover - compiled
    """From a point to a triangle (Ericson 2005, "Real-Time Collision Detection", 5.1.5)."""
    a, b, c = t[0], t[1], t[2]
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = np.sum(ab * ap), np.sum(ac * ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return np.sqrt(np.sum(ap * ap))
    bp = p - b
    d3, d4 = np.sum(ab * bp), np.sum(ac * bp)
    if d3 >= 0.0 and d4 <= d3:
        return np.sqrt(np.sum(bp * bp))
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        off = ap - d1 / (d1 - d3) * ab
        return np.sqrt(np.sum(off * off))
    cp = p - c
    d5, d6 = np.sum(ab * cp), np.sum(ac * cp)
    if d6 >= 0.0 and d5 <= d6:
        return np.sqrt(np.sum(cp * cp))
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        off = ap - d2 / (d2 - d6) * ac
        return np.sqrt(np.sum(off * off))
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        off = bp - (d4 - d3) / ((d4 - d3) + (d5 - d6)) * (c - b)
        return np.sqrt(np.sum(off * off))
    whole = 1.0 / (va + vb + vc)
    off = ap - vb * whole * ab - vc * whole * ac
    return np.sqrt(np.sum(off * off))
