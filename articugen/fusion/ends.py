"""Where material ends: the faces of parts, less what of them lies buried in material.

Boards run into one another, and a face with material on both of its sides ends nothing. Faces are
cut where others reach through them or end on them, so that a piece is buried whole or not at all.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bools, Bytes
from articugen.core.jit import between, cross, dot, helper, kernel, minus, plane_of, vector
from articugen.core.records import LabelledMesh
from articugen.fusion.field import PosedSolids
from articugen.fusion.solidify import probes
from articugen.meshes.bvh import Bvh, misses, ordered, tree_of

IsBuried = Callable[[NDArray[np.float32], Bytes], Bools]

_BESIDE = 1e-4  # unit frame: how far from a face it is asked what is there, as of surface points
_CLEAR = 1e-6  # unit frame: what reaches no further past a plane or an edge only touches it
_MOST_PIECES, _SPARE = 256, 1 << 14
"""Of a face, and of all besides two each: what is not cut further may be buried in part, and stays.
"""


def own_ends(mesh: LabelledMesh, solids: PosedSolids) -> LabelledMesh:
    """Return where the material of each part alone ends, of all faces of the parts (outwards)."""

    def buried(points: NDArray[np.float32], part: Bytes) -> Bools:
        inside = np.zeros(points.shape[:2], np.bool_)
        for k in range(len(solids.own)):
            for side in (0, 1):
                inside[side, solids.holds(k, points[side], np.flatnonzero(part == k))] = True
        return inside[0] & inside[1]

    return _bared(mesh, True, buried)


def posed_ends(ends: LabelledMesh, solids: PosedSolids) -> Bvh:
    """Return where the material of all parts together ends, of the `own_ends` in the canonical
    pose."""
    posed = ends.moved(solids.part_motion)
    corners = posed.vertices[posed.faces]
    low, high = corners.min(axis=1) - _BESIDE, corners.max(axis=1) + _BESIDE
    beside = np.zeros(len(corners), np.bool_)
    for k in range(len(solids.own)):
        box = solids.box(k)
        meets = (low <= box[1]).all(axis=1) & (high >= box[0]).all(axis=1)
        beside |= meets & (posed.part_of_face != k)

    def buried(points: NDArray[np.float32], part: Bytes) -> Bools:
        inside = np.zeros(len(part), np.bool_)
        for k in range(len(solids.own)):
            inside[solids.holds(k, points[0], np.flatnonzero(~inside & (part != k)))] = True
        return inside

    some = LabelledMesh(posed.vertices, posed.faces[beside], posed.part_of_face[beside])
    left = _bared(some, False, buried)
    return tree_of(np.concatenate([corners[~beside], left.vertices[left.faces]]))


def _bared(mesh: LabelledMesh, within: bool, buried: IsBuried) -> LabelledMesh:
    """Return the faces without the pieces that are buried, where all samples say so.

    Args:
        within: cut faces by those of their own part; else by those of others.
        buried: says so of points (2, n, 3) before and behind faces of the parts (n,).
    """
    corners = mesh.vertices[mesh.faces]
    order, box, skip, leaf, nodes = ordered(corners)
    pieces, face = _cut(corners[order], mesh.part_of_face[order], within, box, skip, leaf, nodes)
    face = order[face]
    cut = LabelledMesh(
        pieces.reshape(-1, 3),
        np.arange(3 * len(pieces), dtype=np.int32).reshape(-1, 3),
        mesh.part_of_face[face],
    )
    where = probes(cut, _BESIDE)
    inside = buried(where.points.astype(np.float32), cut.part_of_face[where.face])
    count = np.bincount(where.face, minlength=len(pieces))
    gone = np.bincount(where.face, inside, len(pieces)) == count
    whole = np.bincount(face, gone, len(mesh.faces)) == 0.0
    left = ~gone & ~whole[face]
    return LabelledMesh.joined([
        LabelledMesh(mesh.vertices, mesh.faces[whole], mesh.part_of_face[whole]).compact(),
        LabelledMesh(cut.vertices, cut.faces[left], cut.part_of_face[left]).compact(),
    ])  # fmt: skip


@kernel
def _cut(corners, part, within, box, skip, leaf, nodes):
    """Return the pieces (N, 3, 3) of faces (F, 3, 3), and the face (N,) of each: cut by the planes
    of faces that reach through them or end on them, along where they do."""
    F = corners.shape[0]
    pieces = np.empty((2 * F + _SPARE, 3, 3))
    face = np.empty(2 * F + _SPARE, np.int64)
    first = 0
    for f in range(F):
        most = min(first + _MOST_PIECES, pieces.shape[0] - F + f) - 2
        _put(pieces, first, vector(corners[f], 0), vector(corners[f], 1), vector(corners[f], 2))
        end = first + 1
        normal, offset = plane_of(corners, f)
        node = 0
        while node < nodes:
            if misses(corners, f, box, node):
                node = skip[node]
                continue
            for g in range(leaf[node, 0], leaf[node, 0] + leaf[node, 1]):
                if g == f or (part[f] == part[g]) != within:
                    continue
                met, start, stop = _seam(corners, g, normal, offset)
                across, level = plane_of(corners, g)
                for n in range(first, end if met == 2 else first):
                    if end < most and _runs_through(pieces, n, normal, across, level, start, stop):
                        end = _split(pieces, n, end, across, level)
            node += 1
        for n in range(first, end):
            face[n] = f
        first = end
    return pieces[:first].copy(), face[:first].copy()


@helper
def _seam(corners, g, normal, offset):
    """Return in how many points, and which, the edges of a face meet a plane: two where it reaches
    through it or ends on it; none where it lies in it."""
    start = stop = vector(corners[g], 0)
    met = on = 0
    for k in range(3):
        p, q = vector(corners[g], k), vector(corners[g], (k + 1) % 3)
        here, there = dot(normal, p) - offset, dot(normal, q) - offset
        lies = abs(here) <= _CLEAR
        on += lies
        if lies or (here * there < 0.0 and abs(there) > _CLEAR):
            at = p if lies else between(p, q, here, there)
            start, stop = stop if met else at, at
            met += 1
    return met if on < 3 else 0, start, stop


@helper
def _runs_through(pieces, n, normal, across, level, start, stop):
    """Return whether a piece, of that `normal`, lies on both sides of the plane (across, level),
    and the way in it from `start` to `stop` runs through the piece."""
    low, high, first, last = np.inf, -np.inf, 0.0, 1.0
    for k in range(3):
        p, q = vector(pieces[n], k), vector(pieces[n], (k + 1) % 3)
        height = dot(across, p) - level
        low, high = min(low, height), max(high, height)
        inwards = cross(normal, minus(q, p))
        here, there = dot(inwards, minus(start, p)), dot(inwards, minus(stop, p))
        if here < 0.0 and there < 0.0:
            return False
        if here * there < 0.0:
            t = here / (here - there)
            first, last = (max(first, t), last) if here < 0.0 else (first, min(last, t))
    way = minus(stop, start)
    runs = (last - first) * np.sqrt(dot(way, way)) > _CLEAR
    return runs and low < -_CLEAR and high > _CLEAR


@helper
def _split(pieces, n, end, across, level):
    """Split piece `n` at a plane that it lies on both sides of; what it becomes besides comes last.
    Return the new end."""
    a, b, c = vector(pieces[n], 0), vector(pieces[n], 1), vector(pieces[n], 2)
    x, y, z = dot(across, a) - level, dot(across, b) - level, dot(across, c) - level
    for _ in range(2):  # until `a` is on the plane, or else alone on its side of it
        through = min(abs(x), abs(y), abs(z)) <= _CLEAR
        if (abs(x) > _CLEAR) if through else (x * y > 0.0 or x * z > 0.0):
            a, b, c, x, y, z = b, c, a, y, z, x
    if abs(x) <= _CLEAR:
        middle = between(b, c, y, z)
        _put(pieces, n, a, b, middle)
        _put(pieces, end, a, middle, c)
        return end + 1
    left, right = between(a, b, x, y), between(a, c, x, z)
    _put(pieces, n, a, left, right)
    _put(pieces, end, left, b, c)
    _put(pieces, end + 1, left, c, right)
    return end + 2


@helper
def _put(pieces, n, a, b, c):
    for axis in range(3):
        pieces[n, 0, axis], pieces[n, 1, axis], pieces[n, 2, axis] = a[axis], b[axis], c[axis]
