"""Convex polytopes: what planes leave of the cube of the unit frame, and the parts they make."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import product

import numpy as np
from numpy.typing import NDArray

from articugen.core.records import Floats
from articugen.evaluation.reconstruction import Reconstruction
from articugen.learning.fields import grid_centres, reconstruction_of_surfaces

EPSILON = 1e-9  # lengths below which a vertex lies on a plane
SHORT = 1e-9  # normals shorter than that bound nothing, or leave nothing
_CUBE = np.concatenate([np.hstack([s * np.eye(3), np.full((3, 1), -0.5)]) for s in (-1.0, 1.0)])


@dataclass(frozen=True, eq=False)
class Polytope:
    """A bounded convex polytope.

    Attributes:
        vertices: (V, 3).
        facets: (F, 4) planes with unit normals, outward; n . x + d <= 0 inside.
        on: (V, F) bool, which vertices lie on which facets.
    """

    vertices: Floats
    facets: Floats
    on: NDArray[np.bool_]

    def triangles(self) -> Floats:
        """Return (T, 3, 3), the surface, counterclockwise from outside."""
        fans = []
        for normal, on in zip(self.facets[:, :3], self.on.T, strict=True):
            corners = self.vertices[on]
            u = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
            around = corners - corners.mean(0)
            order = np.argsort(np.arctan2(around @ np.cross(normal, u), around @ u))
            ring = corners[order]
            fans.append(
                np.stack([np.broadcast_to(ring[0], ring[2:].shape), ring[1:-1], ring[2:]], 1)
            )
        return np.concatenate(fans)

    def clearance(self, points: Floats) -> Floats:
        """Return (n,) of points (n, 3): the least distance to a facet's plane, negative outside."""
        return -(points @ self.facets[:, :3].T + self.facets[:, 3]).max(1)


def cut(planes: Floats) -> Polytope | None:
    """Return what of the unit frame's cube has n . x + d <= 0 for each of some planes (m, 4), rows
    of normal and offset; None if that has no volume.

    The plane that cuts deepest is next, until none cuts: most of the others never do.
    """
    length = np.linalg.norm(planes[:, :3], axis=1)
    if (planes[length < SHORT, 3] > 0.0).any():
        return None
    planes = planes[length >= SHORT] / length[length >= SHORT, None]
    corners = np.array(list(product((-0.5, 0.5), repeat=3)))
    left = Polytope(corners, _CUBE, np.abs(corners @ _CUBE[:, :3].T - 0.5) < EPSILON)
    while True:
        beyond = planes[:, :3] @ left.vertices.T + planes[:, 3:]
        cuts = beyond.max(1) > EPSILON
        if not cuts.any():
            return left
        planes, beyond = planes[cuts], beyond[cuts]
        deepest = beyond.max(1).argmax()
        if beyond[deepest].min() >= -EPSILON:
            return None
        left = _without(left, planes[deepest], beyond[deepest])


def _without(whole: Polytope, plane: Floats, beyond: Floats) -> Polytope:
    """Return a polytope without what is beyond a plane; `beyond` (V,) is by how much vertices are.

    Two vertices are joined by an edge where no third one lies on all the facets that they share.
    """
    inner, outer = np.flatnonzero(beyond < -EPSILON), np.flatnonzero(beyond > EPSILON)
    shared = whole.on[inner, None] & whole.on[None, outer]
    lacks = shared.astype(np.float64) @ ~whole.on.T
    i, j = ((shared.sum(2) >= 2) & ((lacks == 0).sum(2) == 2)).nonzero()
    a, b = beyond[inner[i], None], beyond[outer[j], None]
    fresh = (b * whole.vertices[inner[i]] - a * whole.vertices[outer[j]]) / (b - a)
    kept = beyond <= EPSILON
    vertices = np.concatenate([whole.vertices[kept], fresh])
    before = np.concatenate([whole.on[kept], shared[i, j]])
    now = np.concatenate([beyond[kept] >= -EPSILON, np.ones(len(fresh), bool)])
    on = np.column_stack([before, now])
    there = on.sum(0) >= 3
    return Polytope(vertices, np.vstack([whole.facets, plane])[there], on[:, there])


def reconstruction_of_polytopes(
    convexes: Sequence[Polytope | None], resolution: int
) -> Reconstruction:
    """Return convexes as parts, each with its polygons; the whole is drawn on a grid."""
    points = grid_centres(resolution).double().numpy()
    surfaces = [c.triangles() if c else np.zeros((0, 3, 3)) for c in convexes]
    clearances = (c.clearance(points) for c in convexes if c)
    inside = reduce(np.maximum, clearances, np.full(len(points), -1.0))
    return reconstruction_of_surfaces(surfaces, inside.reshape(3 * [resolution]))
