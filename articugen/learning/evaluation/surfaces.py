"""Surfaces of sampled fields, and distances to them.

Marching tetrahedra: six tetrahedra a cell, linear along edges, watertight, no ambiguous case
(Doi and Koide 1991). Grids are indexed [x, y, z] with samples at (i + 0.5) / R - 0.5.
"""

import itertools
import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from articugen.geometry import points_on_triangles

Floats = NDArray[np.float64]

_CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))
# Each monotone path from corner (0, 0, 0) to (1, 1, 1) is a tetrahedron; neighbours fit together.
_TETRAHEDRA = np.array(
    [
        [0, 1 << (2 - a), (1 << (2 - a)) + (1 << (2 - b)), 7]
        for a, b, _ in itertools.permutations(range(3))
    ]
)
# For each pattern of the inside corners of a tetrahedron: triangles, as its crossed edges.
_EDGES = {
    1: [[(0, 1), (0, 2), (0, 3)]],
    2: [[(1, 0), (1, 2), (1, 3)]],
    4: [[(2, 0), (2, 1), (2, 3)]],
    8: [[(3, 0), (3, 1), (3, 2)]],
    3: [[(0, 2), (0, 3), (1, 3)], [(0, 2), (1, 3), (1, 2)]],
    5: [[(0, 1), (0, 3), (2, 3)], [(0, 1), (2, 3), (2, 1)]],
    9: [[(0, 1), (0, 2), (3, 2)], [(0, 1), (3, 2), (3, 1)]],
}
_EDGES |= {15 - pattern: triangles for pattern, triangles in list(_EDGES.items())}


@dataclass(frozen=True)
class Triangles:
    """A triangle mesh: `vertices` (V, 3), `faces` (F, 3), normals to where the field is low."""

    vertices: Floats
    faces: NDArray[np.int64]

    @property
    def corners(self) -> Floats:
        """(F, 3, 3)."""
        return self.vertices[self.faces]


def surface(field: Floats) -> Triangles:
    """The surface field = 0 of a grid (R, R, R); inside is above 0, and nothing is beyond the grid.

    The vertices are in the unit frame; those on the grid's border lie up to half a voxel outside
    the outermost samples.
    """
    R = len(field)
    if not (field > 0.0).any():
        return Triangles(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    low = -max(float(np.abs(field).max()), 1.0)
    padded = np.pad(field, 1, constant_values=low)
    n = R + 2
    inside = padded > 0.0
    cell = np.zeros((n - 1,) * 3, np.uint8)
    for x, y, z in _CORNERS:
        cell += inside[x : n - 1 + x, y : n - 1 + y, z : n - 1 + z]
    mixed = np.argwhere((cell > 0) & (cell < 8))
    corner = mixed[:, None] + _CORNERS
    at = (corner[..., 0] * n + corner[..., 1]) * n + corner[..., 2]
    tetrahedra = at[:, _TETRAHEDRA].reshape(-1, 4)
    flat = padded.ravel()
    pattern = (flat[tetrahedra] > 0.0) @ np.array([1, 2, 4, 8])
    ends = [
        np.stack([np.stack([mine[:, a], mine[:, b]], 1) for a, b in triangle], 1)
        for code, triangles in _EDGES.items()
        for mine in (tetrahedra[pattern == code],)
        for triangle in triangles
    ]
    edges = np.sort(np.concatenate(ends).reshape(-1, 2), axis=1)
    keys, faces = np.unique(edges[:, 0] * n**3 + edges[:, 1], return_inverse=True)
    faces, unique = faces.reshape(-1, 3), np.stack(np.divmod(keys, n**3), 1)
    value = flat[unique]
    share = value[:, :1] / (value[:, :1] - value[:, 1:])
    position = np.stack(np.unravel_index(unique, (n, n, n)), -1).astype(np.float64)
    vertices = (position[:, 0] * (1.0 - share) + position[:, 1] * share - 0.5) / R - 0.5
    return Triangles(vertices, _outwards(vertices, faces, edges.reshape(-1, 3, 2), flat, n, R))


def _outwards(
    vertices: Floats,
    faces: NDArray[np.int64],
    edges: NDArray[np.int64],
    flat: Floats,
    n: int,
    R: int,
) -> NDArray[np.int64]:
    """The faces turned so that normals lead from inside to outside."""
    position = np.stack(np.unravel_index(edges, (n, n, n)), -1)
    inner_first = flat[edges[..., 0]] > 0.0
    step = (position[:, :, 1] - position[:, :, 0]) * np.where(inner_first, 1, -1)[..., None]
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    wrong = (np.cross(b - a, c - a) * step.sum(1)).sum(1) < 0.0
    return np.where(wrong[:, None], faces[:, ::-1], faces)


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
