"""Sharp edges: where the faces of a surface turn by more than an angle, and points along them.

What uniform points miss: an edge has no area. Dora (Chen et al. 2025) and learners after it take
half of their points there.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from articugen.geometry import apply, cross, pick_by_weight
from articugen.portable import cos, dot, norm, turned
from articugen.records import Floats, LabelledMesh
from articugen.sampling import SurfacePoints

OFFSET = 2e-4
"""A point on an edge is visible where the point this far in front of it, half-way between its
faces, is seen free."""

_ROUNDS = 8
_MOST_AT_AN_EDGE = 8
"""Faces, of which each two are compared; of more, those that follow one another."""


@dataclass(frozen=True, eq=False)
class SharpEdges:
    """Edges in the canonical pose: `ends` (n, 2, 3), the `normals` (n, 3) half-way between those of
    their faces, `part` (n,)."""

    ends: Floats
    normals: Floats
    part: NDArray[np.uint8]

    def moved(self, part_motion: Floats) -> "SharpEdges":
        """With each part moved by its own motion (P, 4, 4)."""
        ends, normals = self.ends.copy(), self.normals.copy()
        for part, T in enumerate(part_motion):
            mine = self.part == part
            ends[mine] = apply(T, ends[mine])
            normals[mine] = turned(T[:3, :3], normals[mine])
        return SharpEdges(ends, normals, self.part)


def sharp_edges(mesh: LabelledMesh, degrees: float) -> SharpEdges:
    """The edges at which two faces of one part turn by `degrees` or more.

    Vertices in one place are one vertex: soups have an own corner for each face. Of more than two
    faces at an edge the two that turn most count; an edge of one face alone is none.
    """
    corners = mesh.vertices[mesh.faces]
    across = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = norm(across)
    there = length > 0.0
    normals = across[there] / length[there, None]
    welded = np.unique(mesh.vertices, axis=0, return_inverse=True)[1].reshape(-1)
    faces, part = welded[mesh.faces[there]], mesh.part_of_face[there]
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    face = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort((face, part[face], sides[:, 1], sides[:, 0]))
    sides, face = sides[order], face[order]
    same_as_before = (sides[1:] == sides[:-1]).all(axis=1) & (part[face[1:]] == part[face[:-1]])
    edge = np.concatenate([[0], np.cumsum(~same_as_before)]) if len(face) else np.zeros(0, int)
    best, pair = _widest(edge, normals[face])
    found = np.flatnonzero(best <= cos(np.radians(degrees)) + 1e-9)
    one, other = face[pair[found, 0]], face[pair[found, 1]]
    middle = normals[one] + normals[other]
    size = norm(middle)
    folded = size < 1e-6  # back to back: the rim of a plate without thickness
    middle = np.where(folded[:, None], normals[one], middle / np.maximum(size, 1e-6)[:, None])
    place = np.zeros((welded.max(initial=-1) + 1, 3))
    place[welded] = mesh.vertices
    return SharpEdges(place[sides[pair[found, 0]]], middle, part[one])


def _widest(edge: NDArray[np.intp], normals: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """For each edge of several faces the least cosine between their normals, and the rows of the
    two; the rows (m,) of one edge follow one another."""
    rows = [np.flatnonzero(edge[step:] == edge[:-step]) for step in range(1, _MOST_AT_AN_EDGE)]
    one = np.concatenate(rows)
    other = np.concatenate([row + step for step, row in enumerate(rows, 1)])
    cosine = dot(normals[one], normals[other])
    order = np.lexsort((cosine, edge[one]))
    first = np.ones(len(order), np.bool_)
    first[1:] = edge[one[order[1:]]] != edge[one[order[:-1]]]
    chosen = order[first]
    return cosine[chosen], np.stack([one[chosen], other[chosen]], axis=1)


def sharp_points(
    edges: SharpEdges,
    is_free: Callable[[Floats, NDArray[np.uint8]], NDArray[np.bool_]],
    count: int,
    surface: SurfacePoints,
    *,
    rng: np.random.Generator,
) -> SurfacePoints:
    """`count` points uniform by length over the visible edges; `face` says which edge each is on.

    Where hardly any can be seen, those that are found come again; where none is there or can be
    seen, points of `surface` take their place, whose `face` is then a face's.

    Args:
        edges: as posed.
        is_free: whether points (n, 3) in front of their parts (n,) are free.
        surface: visible, more than none.
    """
    length = norm(edges.ends[:, 1] - edges.ends[:, 0])
    kept: list[tuple[Floats, NDArray[np.intp]]] = []
    have = 0
    for _ in range(_ROUNDS if length.any() else 0):
        draw = 2 * (count - have) + 64
        edge, share = pick_by_weight(length, rng.random(draw)), rng.random((draw, 1))
        points = edges.ends[edge, 0] * (1.0 - share) + edges.ends[edge, 1] * share
        seen = is_free(points + OFFSET * edges.normals[edge], edges.part[edge])
        kept.append((points[seen], edge[seen]))
        have += int(seen.sum())
        if have >= count:
            break
    if have == 0:
        again = np.arange(count) % len(surface.points)
        return SurfacePoints(
            surface.points[again], surface.normals[again], surface.part[again], surface.face[again]
        )
    chosen = np.arange(count) % have
    edge = np.concatenate([e for _, e in kept])[chosen]
    points = np.concatenate([p for p, _ in kept])[chosen]
    return SurfacePoints(points, edges.normals[edge], edges.part[edge], edge)
