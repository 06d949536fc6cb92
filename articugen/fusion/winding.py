"""What surely lies inside: the winding number about the closed pieces of a part.

Whatever way a ray leaves a point around which a closed surface winds, it meets a face, so that no
view can see the point free. One ray's signed crossings give the winding number, where a hundred
views would have to be asked; and a corner that hides between the pixels of a view is not missed.
Where a ray passes an edge within rounding another is sent; where all do, or where the point is as
close to a face, the answer is unknown.

Most pieces are convex: boxes, bars, keys, feet. A point behind all planes of one is inside it,
and no ray need be sent through it.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bools, Ints
from articugen.core.jit import cross, dot, helper, inlined, kernel, minus
from articugen.core.records import LabelledMesh
from articugen.fusion.solidify import face_normals
from articugen.meshes.bvh import Bvh, _enters, _inverse, ordered, tree_of

_AHEAD, _ASIDE = 0.9837, (0.1371, 0.0913, 0.1159)
"""A ray goes along one axis, the one that leaves the pieces' box soonest before the next two, and
so much along the others: it is in line with nothing that models are built along."""

_CLEAR = 2e-6
"""Unit frame: how far from edges and from its start a crossing must be to count; corners closer
than half of that are one in `solidify.welded`."""

_DOUBT = 1 << 30

_MOST_FACES = 256  # of a convex piece: of more faces a ray meets only a few
_FLAT, _NEAR = 1e-6, 1e-5
"""Unit frame: no corner of a convex piece lies further than the first in front of any of its faces;
points closer than the second to one are decided by rays through all pieces."""


class ClosedPieces(NamedTuple):
    """The closed pieces of one part in its canonical pose. C convex ones with Q planes in all.

    Attributes:
        every: the faces of all pieces.
        others: of those that are not convex.
        box, skip, leaf: of a tree over the convex ones, see `Bvh`; its boxes are wider by `_NEAR`.
        piece: (C,) the convex pieces in the order of the leaves.
        first_plane: (C + 1,): piece c has the planes first_plane[c] to first_plane[c + 1] - 1.
        planes: (Q, 4) outward unit normal and offset, no two of a piece alike.
    """

    every: Bvh
    others: Bvh
    box: Any
    skip: Any
    leaf: Any
    piece: Any
    first_plane: Any
    planes: Any


def closed_pieces(mesh: LabelledMesh, piece: Ints, tree: Bvh) -> ClosedPieces | None:
    """Return the closed pieces of `mesh`, for `surely_inside`; None if there is none.

    Args:
        piece: (F,) which of them each face belongs to, see `solidify.closed_piece`.
        tree: of all faces, which serves again where all are closed.
    """
    closed = np.flatnonzero(piece >= 0)
    if not len(closed):
        return None
    order = closed[np.argsort(piece[closed], kind="stable")]
    first = np.flatnonzero(np.diff(piece[order], prepend=-1, append=-1))
    faces = mesh.faces[order]
    corners = mesh.vertices[faces]
    planes, counts = _planes(corners, face_normals(mesh.vertices, faces), first)
    convex = counts > 0
    of_convex = np.repeat(convex, np.diff(first))
    low = np.minimum.reduceat(corners.min(axis=1), first[:-1])[convex] - _NEAR
    high = np.maximum.reduceat(corners.max(axis=1), first[:-1])[convex] + _NEAR
    leaves, box, skip, leaf, nodes = ordered(np.stack([low, high, high], axis=1))
    return ClosedPieces(
        tree if len(closed) == len(piece) else tree_of(corners),
        tree_of(corners[~of_convex]),
        box[:nodes],
        skip[:nodes],
        leaf[:nodes],
        leaves,
        np.concatenate([[0], np.cumsum(counts[convex])]),
        planes,
    )


@kernel
def _planes(corners, normals, first):
    """Return the planes of the convex pieces, one after the other, and how many each piece has:
    none where it is not convex. Piece k has the faces first[k] to first[k + 1] - 1."""
    planes = np.empty((corners.shape[0], 4))
    counts = np.zeros(first.shape[0] - 1, np.int64)
    end = 0
    for k in range(counts.shape[0]):
        stop = end
        if first[k + 1] - first[k] > _MOST_FACES:
            continue
        for f in range(first[k], first[k + 1]):
            x, y, z = normals[f, 0], normals[f, 1], normals[f, 2]
            offset = x * corners[f, 0, 0] + y * corners[f, 0, 1] + z * corners[f, 0, 2]
            if _farthest(corners, first[k], first[k + 1], x, y, z) - offset > _FLAT:
                end = stop
                break
            known = False
            for q in range(stop, end):
                apart = max(abs(planes[q, 0] - x), abs(planes[q, 1] - y), abs(planes[q, 2] - z))
                known |= max(apart, abs(planes[q, 3] - offset)) < _FLAT
            if not known:
                planes[end, 0], planes[end, 1], planes[end, 2], planes[end, 3] = x, y, z, offset
                end += 1
        counts[k] = end - stop
    return planes[:end].copy(), counts


@helper
def _farthest(corners, first, end, x, y, z):
    """Return how far the corners of some faces reach along a direction."""
    farthest = -np.inf
    for f in range(first, end):
        for corner in range(3):
            p = corners[f, corner]
            farthest = max(farthest, x * p[0] + y * p[1] + z * p[2])
    return farthest


def surely_inside(points: NDArray[np.floating], closed: ClosedPieces) -> Bools:
    """Return (n,) which of `points` (n, 3) closed pieces surely wind around."""
    return _surely_inside(np.ascontiguousarray(points, np.float64), closed)


@kernel
def _surely_inside(points, closed):
    box, skip, leaf, whole = closed.box, closed.skip, closed.leaf, closed.every.box
    piece, first_plane, planes = closed.piece, closed.first_plane, closed.planes
    inside = np.zeros(points.shape[0], np.bool_)
    for i in range(points.shape[0]):
        p = (points[i, 0], points[i, 1], points[i, 2])
        count = _convex_around(p, box, skip, leaf, piece, first_plane, planes)
        tree = closed.every if count == _DOUBT else closed.others
        turns = _turns(p, whole, tree.box, tree.skip, tree.leaf, tree.triangles)
        if turns != _DOUBT:
            inside[i] = turns != 0 if count == _DOUBT else turns + count != 0
    return inside


@helper
def _convex_around(p, box, skip, leaf, piece, first_plane, planes):
    """Return how many convex pieces hold `p`; `_DOUBT` where it is near a plane of one."""
    count = node = 0
    doubt = False
    while node < skip.shape[0]:
        n = np.uintp(node)  # unsigned: numba does not ask whether to count from the end
        within = (box[n, 0] < p[0]) & (p[0] < box[n, 3]) & (box[n, 1] < p[1])
        if not (within & (p[1] < box[n, 4]) & (box[n, 2] < p[2]) & (p[2] < box[n, 5])):
            node = skip[n]
            continue
        for c in range(leaf[n, 0], leaf[n, 0] + leaf[n, 1]):
            k = np.uintp(piece[np.uintp(c)])
            most = -np.inf
            for q in range(first_plane[k], first_plane[k + np.uintp(1)]):
                t = np.uintp(q)
                ahead = planes[t, 0] * p[0] + planes[t, 1] * p[1] + planes[t, 2] * p[2]
                most = max(most, ahead - planes[t, 3])
                if most > _NEAR:
                    break
            count += most < -_NEAR
            doubt |= abs(most) <= _NEAR
        node += 1
    return _DOUBT if doubt else count


@helper
def _turns(p, whole, box, skip, leaf, triangles):
    """Return how often the faces of a tree wind around `p`; `_DOUBT` where no ray decides. `whole`
    has the box around all pieces first: the ways of rays do not hang on which of them are
    convex."""
    x = _outwards(p[0], np.float64(whole[0, 0]), np.float64(whole[0, 3]))
    y = _outwards(p[1], np.float64(whole[0, 1]), np.float64(whole[0, 4]))
    z = _outwards(p[2], np.float64(whole[0, 2]), np.float64(whole[0, 5]))
    least = min(abs(x), abs(y), abs(z))
    if least == 0.0:
        return 0
    soonest = 0 if abs(x) == least else (1 if abs(y) == least else 2)
    for more in range(3):
        axis = (soonest + more) % 3
        w = (
            np.copysign(_AHEAD if axis == 0 else _ASIDE[0], x),
            np.copysign(_AHEAD if axis == 1 else _ASIDE[1], y),
            np.copysign(_AHEAD if axis == 2 else _ASIDE[2], z),
        )
        turns = _crossed(p, w, box, skip, leaf, triangles)
        if turns != _DOUBT:
            return turns
    return _DOUBT


@inlined
def _outwards(x, low, high):
    """Return how far it is to the nearer end, negative where that is the lower; 0 where outside."""
    if x <= low or x >= high:
        return 0.0
    return high - x if high - x < x - low else low - x


@helper
def _crossed(p, w, box, skip, leaf, triangles):
    """Return how often more the ray from `p` along `w` leaves than enters; or `_DOUBT`."""
    start = (np.float32(p[0]), np.float32(p[1]), np.float32(p[2]))
    inverse = (
        _inverse(np.float32(w[0])), _inverse(np.float32(w[1])), _inverse(np.float32(w[2]))
    )  # fmt: skip
    endless = np.float32(np.inf)
    turns = node = 0
    while node < skip.shape[0]:
        n = np.uintp(node)  # unsigned: numba does not ask whether to count from the end
        low, high = (box[n, 0], box[n, 1], box[n, 2]), (box[n, 3], box[n, 4], box[n, 5])
        if not _enters(start, inverse, endless, low, high):
            node = skip[n]
            continue
        for f in range(leaf[n, 0], leaf[n, 0] + leaf[n, 1]):
            t = np.uintp(f)
            plane = (triangles[t, 0], triangles[t, 1], triangles[t, 2], triangles[t, 3])
            crossing = _crossing(
                p, w, plane,
                (triangles[t, 4], triangles[t, 5], triangles[t, 6]),
                (triangles[t, 7], triangles[t, 8], triangles[t, 9]),
                (triangles[t, 10], triangles[t, 11], triangles[t, 12]),
            )  # fmt: skip
            if crossing == _DOUBT:
                return _DOUBT
            turns += crossing
        node += 1
    return turns


@helper
def _crossing(p, w, plane, a, b, c):
    """1 where the ray leaves through the front of a face, -1 where it enters, 0; or `_DOUBT`.

    The volumes that the ray spans with each edge, in double precision, over the edge's length are
    how far it passes from the edge, or less.
    """
    a, b, c = minus(a, p), minus(b, p), minus(c, p)
    ab, bc, ca = dot(w, cross(a, b)), dot(w, cross(b, c)), dot(w, cross(c, a))
    u, v = minus(a, b), minus(c, b)
    clear = _CLEAR * (abs(u[0]) + abs(u[1]) + abs(u[2]) + abs(v[0]) + abs(v[1]) + abs(v[2]))
    if (ab < -clear or bc < -clear or ca < -clear) and (ab > clear or bc > clear or ca > clear):
        return 0
    gap, slope = dot(plane, a), dot(plane, w)  # to the plane along its normal; how fast it nears
    if abs(gap) > _CLEAR and gap * slope < 0.0:
        return 0  # behind the start
    if abs(gap) <= _CLEAR or min(abs(ab), abs(bc), abs(ca)) <= clear:
        return _DOUBT
    return 1 if slope > 0.0 else -1
