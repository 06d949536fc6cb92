"""Solids as few convex pieces: taken apart into the closed meshes that they were modelled of; cut
along faces that meet in inner corners, until the pieces' hulls hold hardly anything else; joined
where the hull of two holds hardly more than the solid. Volumes are exact (manifold3d), so walls may
be as thin as they like.
"""

import heapq
from collections.abc import Iterable, Iterator, Sequence
from itertools import count
from typing import NamedTuple

import manifold3d
import numpy as np
from manifold3d import Manifold

from articugen.core.arrays import Bools, Floats, Indices
from articugen.core.geometry import area_vectors
from articugen.core.portable import dot, norm
from articugen.core.records import Mesh
from articugen.meshes.simpler import manifold, mesh_of, shells

_CUT = 0.025  # of the solid's volume: pieces are cut until their hulls hold no more besides it
_JOINED = 0.01  # and so much more once they are joined
_MOST = 192  # cuts: curved shells could be cut for ever
_SOLIDS = 512  # closed meshes, more than which are not taken apart
_SAME = 0.97  # IoU of closed meshes with the solid that is extracted from them
_CORNERS = 64  # of a piece: more than that PhysX does not take on a GPU
_ROUGH = 0.02  # of the mean thickness, and 1e-3 of the size: finer faces only take time
_SLIVER = 1e-4  # of the volume: less is not worth a piece
_PLANES = 6  # of faces that a piece may be cut along, besides three across each axis
_INNER = 0.05  # weight of the inner corners that a cut leaves, beside that of what hulls hold
_A_PIECE = 0.002  # likewise of a piece more
_ALIKE = 0.985  # cosine between planes that differ too little to try both


class _Piece(NamedTuple):
    """A part of a solid, its hull and its volume, and how much more the hull holds."""

    solid: Manifold
    hull: Manifold
    volume: float
    excess: float


class _Pair(NamedTuple):
    """The hull of two hulls, which pieces both stand for, and what it holds besides any pieces: at
    least, while `unknown` ones are left, of which it may hold up to `most` (P,)."""

    hull: Manifold
    both: Bools
    excess: float
    unknown: list[int]
    most: Floats


def apart(mesh: Mesh, closed: Sequence[Mesh]) -> tuple[Mesh, ...]:
    """Return what a watertight `mesh` is of: the `closed` meshes that it was extracted from, each
    without those larger, if together they fill the same space; else itself."""
    solids = shells(closed) if len(closed) <= _SOLIDS else []
    union = Manifold.batch_boolean(solids, manifold3d.OpType.Add)
    if _iou(union, manifold(mesh)) < _SAME:
        return (mesh,)
    rest, before = [], Manifold()
    for solid in solids:
        rest.append(solid - before)
        before += solid
    return tuple(mesh_of(solid) for solid in rest if not solid.is_empty())


def convex_pieces(*meshes: Mesh) -> tuple[Mesh, ...]:
    """Return convex meshes of at most 64 vertices that together fill about the space of watertight
    `meshes`, and of what they enclose; of another mesh its hull, if it has one."""
    solid = _union(meshes)
    if solid.is_empty():  # they are not watertight
        hulls = [Manifold.hull_points(m.vertices) for m in meshes if len(m.vertices) > 3]
    else:
        volume = solid.volume()
        low, high = np.reshape(solid.bounding_box(), (2, 3))
        rough = min(1e-3 * (high - low).max(), _ROUGH * 2.0 * volume / solid.surface_area())
        solids = [manifold(mesh).simplify(rough) for mesh in meshes]
        hulls = _joined(_cut(solids, volume, rough), _JOINED * volume)
    pieces = (_simple(hull) for hull in hulls if not hull.is_empty())
    return tuple(mesh_of(piece) for piece in pieces if not piece.is_empty())


def agreement(pieces: Sequence[Mesh], *meshes: Mesh) -> tuple[float, list[float]]:
    """Return the IoU of convex pieces with watertight meshes, and the volumes of what these
    enclose."""
    solid = _union(meshes)
    least = 1e-6 * solid.volume()  # what rounding leaves is none
    cavities = (-shell.volume() for shell in solid.decompose())
    return _iou(_union(pieces), solid), sorted(volume for volume in cavities if volume > least)


def _union(meshes: Iterable[Mesh]) -> Manifold:
    return Manifold.batch_boolean([manifold(mesh) for mesh in meshes], manifold3d.OpType.Add)


def _iou(one: Manifold, other: Manifold) -> float:
    common = (one ^ other).volume()
    return common / max(one.volume() + other.volume() - common, 1e-300)


def _simple(hull: Manifold) -> Manifold:
    """Return a convex solid, or one within it that has few enough corners: those farthest from each
    other where the solid's box is a cube. Of a mere sliver nothing may be left."""
    corners = mesh_of(hull).vertices
    if len(corners) > _CORNERS:
        low, high = corners.min(axis=0), corners.max(axis=0)
        spread = (corners - low) / np.maximum(high - low, 1e-300)
        far, kept = np.full(len(corners), np.inf), [int(np.argmax(norm(spread - 0.5)))]
        while len(kept) < _CORNERS:
            far = np.minimum(far, norm(spread - spread[kept[-1]]))
            kept.append(int(np.argmax(far)))
        hull = Manifold.hull_points(corners[kept])
    return hull.simplify(1e-5 * hull.volume() ** (1 / 3))  # no faces without area


def _parts(*solids: Manifold, least: float) -> list[_Piece]:
    """Return what hangs together of the solids, without what has a smaller volume than `least`, as
    inner shells do, whose volumes are negative."""
    parts = []
    for solid in (one for some in solids for one in some.decompose()):
        volume = solid.volume()
        if volume > least:
            hull = solid.hull()
            parts.append(_Piece(solid, hull, volume, hull.volume() - volume))
    return parts


def _cut(solids: Sequence[Manifold], volume: float, rough: float) -> list[_Piece]:
    """Cut the piece whose hull holds most besides it, again and again, until little is left."""
    pieces, convex = _parts(*solids, least=_SLIVER * volume), []
    most = len(pieces) + _MOST
    while pieces and len(pieces) + len(convex) < most:
        if sum(piece.excess for piece in pieces + convex) < _CUT * volume:
            break
        pieces.sort(key=lambda piece: piece.excess)
        piece = pieces.pop()
        halves = _best_cut(piece.solid, volume, rough)
        pieces += halves
        if not halves and piece.excess < piece.volume:  # else it is a sliver around a hole
            convex.append(piece)
    return pieces + convex


def _best_cut(solid: Manifold, volume: float, rough: float) -> list[_Piece]:
    """Return the pieces on both sides of the best plane, by what hulls then hold besides the solid,
    and the inner corners that are left; [] where no plane cuts more than a sliver off."""
    best, least = [], np.inf
    mesh = mesh_of(solid)
    size = float(np.ptp(mesh.vertices, axis=0).max())
    for normal, offset in _planes(mesh, 2e-3 * size):
        # beside the face, or paper-thin rests of it hold together what it should part
        halves = solid.split_by_plane(tuple(normal), float(offset) + 0.1 * rough)
        halves = [half.simplify(0.2 * rough) for half in halves]
        if min(half.volume() for half in halves) > _SLIVER * volume:
            parts = _parts(*halves, least=0.1 * _SLIVER * volume)
            cost = sum(part.excess for part in parts) / volume + _A_PIECE * len(parts)
            if cost < least:
                corners = sum(_inner_edges(mesh_of(part.solid))[1].sum() for part in parts)
                cost += _INNER * corners / size
            if cost < least:
                best, least = parts, cost
    return best


def _planes(mesh: Mesh, near: float) -> Iterator[tuple[Floats, float]]:
    """Yield planes to cut a solid along, normal and offset: of faces at inner corners, and some
    across the axes."""
    ends, length, face, normals = _inner_edges(mesh)
    faces, which = np.unique(face.ravel(), return_inverse=True)
    at = np.bincount(which, weights=np.repeat(length, 2), minlength=len(faces))
    areas = norm(normals)[:, None]  # twice
    faces = faces[np.argsort(-at * np.sqrt(areas[faces, 0]), kind="stable")[:60]]
    across = normals[faces] / areas[faces]
    offset = dot(across, mesh.vertices[mesh.faces[faces, 0]])
    on = (np.abs(ends @ across.T - offset) < near).all(axis=1)  # (edges, planes)
    centers = mesh.vertices[mesh.faces].mean(axis=1)
    level = (np.abs(centers @ across.T - offset) < near) & (normals @ across.T > 0.98 * areas)
    left = np.argsort(-(length @ on) * np.sqrt(areas[:, 0] @ level), kind="stable")
    for _ in range(_PLANES):
        if len(left):
            k = left[0]
            yield across[k], offset[k]
            turn = across[left] @ across[k]
            apart = np.abs(offset[left] * np.sign(turn) - offset[k])
            left = left[(np.abs(turn) < _ALIKE) | (apart > near)]
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    for axis in np.flatnonzero(high - low > 0.1 * (high - low).max()):
        for share in (0.25, 0.5, 0.75):
            yield np.eye(3)[axis], low[axis] + share * (high - low)[axis]


def _inner_edges(mesh: Mesh) -> tuple[Floats, Floats, Indices, Floats]:
    """Return the edges along which a solid is hollow: their ends (n, 2, 3), their lengths (n,)
    times 1 - cos of their angle, and the faces on both sides (n, 2); and all faces' normals."""
    normals = area_vectors(mesh.triangles)
    unit = normals / np.maximum(norm(normals), 1e-300)[:, None]
    start, end = mesh.faces.ravel().astype(np.intp), np.roll(mesh.faces, -1, axis=1).ravel()
    key, reverse = start * len(mesh.vertices) + end, end * len(mesh.vertices) + start
    order, one = np.argsort(key), np.flatnonzero(start < end)
    other = order[np.searchsorted(key, reverse[one], sorter=order)]
    face = np.stack([one, other], axis=1) // 3
    ends = mesh.vertices[np.stack([start, end], axis=1)[one]]
    beyond = mesh.vertices[np.roll(mesh.faces, -2, axis=1).ravel()[other]]
    length = norm(ends[:, 1] - ends[:, 0]) * (1.0 - dot(*unit[face.T]))
    inner = (dot(unit[face[:, 0]], beyond - ends[:, 0]) > 0.0) & (length > 1e-9)
    return ends[inner], length[inner], face[inner], normals


def _joined(pieces: Sequence[_Piece], spare: float) -> list[Manifold]:
    """Return the pieces' hulls, two by two replaced by the hull of both while these hold no more
    than the volume `spare` of what is in no piece."""
    volumes = np.array([piece.volume for piece in pieces])
    boxes = np.array([piece.solid.bounding_box() for piece in pieces])
    work = np.array([piece.solid.num_tri() + 100 for piece in pieces])  # of a cut through each
    number = count(len(pieces))
    # hulls, the pieces that they stand for, and what they hold besides any pieces
    alive = {k: (p.hull, np.arange(len(pieces)) == k, p.excess) for k, p in enumerate(pieces)}
    # of two hulls, the least that the hull of both holds besides: that of larger ones holds more
    least: dict[tuple[int, int], float] = {}
    heap: list[tuple[float, int, int, _Pair]] = []

    def queue(i: int, j: int, pair: _Pair) -> None:
        least[i, j] = max(least[i, j], pair.excess)
        more = least[i, j] - alive[i][2] - alive[j][2]
        if more <= spare:
            heapq.heappush(heap, (more, i, j, pair))

    def consider(i: int, others: Iterable[int], within: Sequence[int] = ()) -> None:
        """Queue hull i, which holds those `within`, with each, by the least that the hull of both
        can hold besides."""
        for j in others:
            least[i, j] = max(least.get((max(k, j), min(k, j)), 0.0) for k in (*within, i))
            if least[i, j] - alive[i][2] - alive[j][2] > spare:
                continue
            hull, both = Manifold.batch_hull([alive[i][0], alive[j][0]]), alive[i][1] | alive[j][1]
            volume = volumes[both].sum()
            rest = hull.volume() - volume
            if rest < volume:  # others take long to be examined, and are rarely joined
                most = shared(hull, both)
                unknown = [int(k) for k in np.argsort(most / work, kind="stable") if most[k]]
                queue(i, j, _Pair(hull, both, rest - most.sum(), unknown, most))

    def shared(hull: Manifold, besides: Bools) -> Floats:
        """Return the most that a hull can hold of pieces, by their boxes; 0 of those `besides`."""
        box = np.array(hull.bounding_box())
        sides = np.minimum(boxes[:, 3:], box[3:]) - np.maximum(boxes[:, :3], box[:3])
        return np.where(besides, 0.0, np.minimum(volumes, np.maximum(sides, 0.0).prod(axis=1)))

    for i in alive:
        consider(i, range(i))
    while heap:
        more, i, j, pair = heapq.heappop(heap)
        if i not in alive or j not in alive or more > spare:
            continue
        if pair.unknown:
            k = pair.unknown[-1]
            excess = pair.excess + pair.most[k] - (pair.hull ^ pieces[k].solid).volume()
            queue(i, j, pair._replace(excess=excess, unknown=pair.unknown[:-1]))
            continue
        spare -= max(more, 0.0)
        del alive[i], alive[j]
        others, new = list(alive), next(number)
        alive[new] = pair.hull, pair.both, max(pair.excess, 0.0)
        consider(new, others, within=(i, j))
    return [hull for hull, _, _ in alive.values()]
