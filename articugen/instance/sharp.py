"""Sharp edges: where the faces of a surface turn by more than an angle, and points along them.

What uniform points miss: an edge has no area. Dora (Chen et al. 2025) and learners after it take
half of their points there.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from articugen.core.arrays import Bools, Bytes, Floats, Indices
from articugen.core.geometry import apply, area_vectors, cross, pick_by_weight
from articugen.core.portable import cos, dot, norm, turned
from articugen.core.records import LabelledMesh
from articugen.instance.sampling import SurfacePoints

OFFSET = 2e-4
"""A point on an edge is visible where the point this far in front of it, half-way between its
faces, is seen free."""

_ROUNDS = 8
_STEPS = range(1, 8)
"""From one face at an edge to those that it is compared with, where they are wound in no order."""

_SAME = 1e6  # faces whose direction from an edge differs by less than one part in this coincide


@dataclass(frozen=True, eq=False)
class SharpEdges:
    """Edges in the canonical pose: `ends` (n, 2, 3), the `normals` (n, 3) half-way between those of
    their faces, `part` (n,)."""

    ends: Floats
    normals: Floats
    part: Bytes

    def moved(self, part_motion: Floats) -> "SharpEdges":
        """With each part moved by its own motion (P, 4, 4)."""
        T = part_motion[self.part]
        normals = turned(T[:, :3, :3], self.normals)
        return SharpEdges(apply(T[:, None], self.ends), normals, self.part)


def sharp_edges(mesh: LabelledMesh, degrees: float) -> SharpEdges:
    """Return the edges at which two faces of one part turn by `degrees` or more.

    Vertices in one place are one vertex: soups have an own corner for each face. Of more than two
    faces at an edge those two count that face each other across the space before them, as one
    goes around the edge, and of several such pairs the one that turns most; what is in the solid
    or between touching solids does not. An edge of one face alone is none.
    """
    across = area_vectors(mesh.vertices[mesh.faces])
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
    place = np.zeros((welded.max(initial=-1) + 1, 3))
    place[welded] = mesh.vertices
    apex = faces[face].sum(axis=1) - sides.sum(axis=1)
    pairs = _facing(edge, normals[face], place[sides], place[apex])
    best, pair = _widest(edge, normals[face], pairs)
    edges = np.flatnonzero(best <= cos(np.radians(degrees)) + 1e-9)
    one, other = face[pair[edges, 0]], face[pair[edges, 1]]
    middle = normals[one] + normals[other]
    size = norm(middle)
    folded = size < 1e-6  # back to back: the rim of a plate without thickness
    middle = np.where(folded[:, None], normals[one], middle / np.maximum(size, 1e-6)[:, None])
    return SharpEdges(place[sides[pair[edges, 0]]], middle, part[one])


def _facing(edge: Indices, normals: Floats, ends: Floats, apex: Floats) -> Indices:
    """Return (m, 2) the rows of faces between which there is space before both, in the order around
    their edge; of edges where no two are wound so, each two. The rows (n,) of an edge follow one
    another; `ends` (n, 2, 3) and `apex` (n, 3) are the corners of their faces."""
    first = np.searchsorted(edge, edge)
    along, out = ends[:, 1] - ends[:, 0], apex - ends[:, 0]
    across = cross(normals[first], along)  # in the plane of the edge's first face
    x, y = dot(out, across), dot(out, normals[first]) * norm(along)
    size = np.maximum(np.abs(x) + np.abs(y), np.finfo(float).tiny)
    quarters = np.where(y < 0.0, 3.0 + x / size, 1.0 - x / size)  # rises with the angle, to 4
    angle = np.round(quarters * _SAME) % (4.0 * _SAME)
    ahead = dot(normals, cross(along, out)) > 0.0  # whether it looks on around the edge, or back
    order = np.lexsort((ahead, angle, edge))  # of two that coincide, the space between is none
    last = np.append(edge[1:] != edge[:-1], True)[: len(edge)]
    after = order[np.where(last, first, np.arange(len(edge)) + 1)]
    facing = ahead[order] & ~ahead[after]
    pairs = np.sort(np.stack([order, after], axis=1)[facing], axis=1)
    alike = ~np.isin(edge, edge[pairs[:, 0]])
    rows = [np.flatnonzero(alike[step:] & (edge[step:] == edge[:-step])) for step in _STEPS]
    return np.concatenate(
        [pairs, *(np.stack([r, r + k], axis=1) for r, k in zip(rows, _STEPS, strict=True))]
    )


def _widest(edge: Indices, normals: Floats, pairs: Indices) -> tuple[Floats, Indices]:
    """Return for each edge the least cosine between the normals of its pairs of rows, and that
    pair."""
    one, other = pairs.T
    cosine = dot(normals[one], normals[other])
    order = np.lexsort((cosine, edge[one]))
    first = np.ones(len(order), np.bool_)
    first[1:] = edge[one[order[1:]]] != edge[one[order[:-1]]]
    chosen = order[first]
    return cosine[chosen], pairs[chosen]


def sharp_points(
    edges: SharpEdges,
    is_free: Callable[[Floats, Bytes], Bools],
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
    kept: list[tuple[Floats, Indices]] = []
    have = 0
    for _ in range(_ROUNDS if length.any() else 0):
        draw = 2 * (count - have) + 64
        edge, share = pick_by_weight(length, rng.random(draw)), rng.random((draw, 1))
        points = edges.ends[edge, 0] * (1.0 - share) + edges.ends[edge, 1] * share
        is_seen = is_free(points + OFFSET * edges.normals[edge], edges.part[edge])
        kept.append((points[is_seen], edge[is_seen]))
        have += int(is_seen.sum())
        if have >= count:
            break
    if have == 0:
        again = np.arange(count) % len(surface.points)
        return SurfacePoints(**{name: values[again] for name, values in vars(surface).items()})
    chosen = np.arange(count) % have
    edge = np.concatenate([e for _, e in kept])[chosen]
    points = np.concatenate([p for p, _ in kept])[chosen]
    return SurfacePoints(points, edges.normals[edge], edges.part[edge], edge)
