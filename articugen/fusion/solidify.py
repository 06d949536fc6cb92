"""From a triangle soup to solids: which faces are sheets, which way the others look.

Real models are soups: every triangle twice, arbitrary winding, panels without thickness. Fusion
knows inside from outside by visibility, and a sheet without thickness has no inside. So each part
is examined alone, from all around: a face that is seen from both sides is a sheet and gets a
thickness; one that is seen from one side looks that way; one that is never seen is left as it is.
A part alone, so that the answer does not change with its pose.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bools, Bytes, Floats, Indices, Ints
from articugen.core.geometry import (
    area_vectors,
    cross,
    points_in_triangles,
    spread_evenly,
    unit_normals,
)
from articugen.core.jit import helper, kernel, root
from articugen.core.portable import arctan2, dot, norm
from articugen.core.records import DepthMaps, LabelledMesh

NO_AREA = 1e-12  # unit frame; faces have more

SAMPLE_AREA = 0.02**2
MOST_SAMPLES = 16
SHEET_SHARE = 1.0 / 3.0
"""A face is a sheet where at least this share of its samples is seen free on both sides; one of a
closed piece only where none of its samples has depth behind it."""

FINE_FACES = 20_000
"""Faces of a part from which on its small ones are asked together, see `probes`."""

SMALL_AREA, TOGETHER = SAMPLE_AREA / 8.0, 0.01
"""The largest of the small faces, and how far those reach that are asked together; unit frame."""

MOST_AT_AN_EDGE = 8
"""Of more faces than these at one edge, only neighbours in their order are examined."""

LONGEST_MITRE = 2.0
"""Most that a corner of a bent sheet is lifted, in thicknesses of the sheet."""

SMOOTH_COSINE = np.sqrt(0.75)
"""Sheets that meet at less than 30 degrees share their edge; steeper ones are walled on it."""


@dataclass(frozen=True, eq=False)
class Probes:
    """Sample points on faces, one offset to each side: `points` (2, n, 3), `face` (n,).

    `speaker` (F,): the face whose samples speak for each one; mostly itself.
    """

    points: Floats
    face: Indices
    speaker: Indices


def welded(vertices: Floats) -> Indices:
    """Return (V,) the same number for vertices at the same place (within 1e-6 of the unit
    frame)."""
    return np.unique(_key(*np.round(vertices * 2.0**20).astype(np.int64).T), return_inverse=True)[1]


def _key(*columns: Ints) -> Ints:
    """Return (n,) a number for each row of `columns`, in their order: fast to sort."""
    key, size = np.zeros(len(columns[0]), np.int64), 1
    for column in columns:
        from_0 = column - column.min(initial=0)
        width = int(from_0.max(initial=0)) + 1
        if size * width >= 2**63:
            key = np.unique(key, return_inverse=True)[1]
            size = len(key) + 1
        key, size = key * width + from_0, size * width
    return key


def unrepeated(mesh: LabelledMesh) -> Indices:
    """Return the first of each set of coincident faces, whatever their winding; none without
    area."""
    corners = np.sort(welded(mesh.vertices)[mesh.faces], axis=1)
    solid = (corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2])
    key = _key(*corners.T, mesh.part_of_face.astype(np.int64))
    first = np.sort(np.unique(key[solid], return_index=True)[1])
    keep = np.flatnonzero(solid)[first]
    areas = face_areas(mesh.vertices, mesh.faces[keep])
    return keep[areas > NO_AREA]


def origins(mesh: LabelledMesh, origin: Indices, soup: LabelledMesh) -> Indices:
    """Return (F,) the faces of `soup` whose looks those of `mesh` have: their `origin`, or where
    that coincides with others, the first of them that looks the same way."""
    corners = np.sort(welded(soup.vertices)[soup.faces], axis=1)
    _, first, which = np.unique(_key(*corners.T), return_index=True, return_inverse=True)
    normals = face_normals(soup.vertices, soup.faces)
    other = np.flatnonzero(dot(normals, normals[first[which]]) < 0.0)[::-1]
    reverse = first.copy()
    reverse[which[other]] = other  # of several the last one written, which is the first
    turned = dot(face_normals(mesh.vertices, mesh.faces), normals[first[which[origin]]]) < 0.0
    return np.where(turned, reverse[which[origin]], first[which[origin]])


def probes(mesh: LabelledMesh, distance: float, *, together: bool = False) -> Probes:
    """Points at `distance` from both sides of every face: side 0 along its normal, side 1 against.

    With `together` one face speaks for small ones that lie around it, where there are very many.

    One point for each 0.02 x 0.02 of area, 1 to 16 a face, spread by the R2 sequence (Roberts
    2018); the first is the centroid.
    """
    areas = face_areas(mesh.vertices, mesh.faces)
    counts = np.clip(np.ceil(areas / SAMPLE_AREA), 1, MOST_SAMPLES).astype(np.intp)
    normals = face_normals(mesh.vertices, mesh.faces)
    speaker = np.arange(len(counts))
    if together and len(counts) >= FINE_FACES:
        small = np.flatnonzero(areas < SMALL_AREA)
        # in one cell, a fifth as deep along the normal, and facing alike within some 15 degrees
        centers = mesh.vertices[mesh.faces[small]].mean(axis=1)
        columns = [
            *np.floor(centers / TOGETHER).T,
            *np.round(4.0 * normals[small]).T,
            np.floor(dot(centers, normals[small]) / (0.2 * TOGETHER)),
        ]
        key = _key(*(column.astype(np.int64) for column in columns))
        first, which = np.unique(key, return_index=True, return_inverse=True)[1:]
        speaker[small] = small[first[which.reshape(-1)]]
        counts[speaker != np.arange(len(counts))] = 0
    face = np.repeat(np.arange(len(counts)), counts)
    rank = np.arange(len(face)) - np.repeat(np.cumsum(counts) - counts, counts)
    a, b = (np.where(rank, at, 1.0 / 3.0)[:, None] for at in spread_evenly(rank))
    points = points_in_triangles(mesh.vertices[mesh.faces[face]], a, b)
    away = distance * normals[face]
    return Probes(np.stack([points + away, points - away]), face, speaker)


def shown_sides(mesh: LabelledMesh, maps: DepthMaps) -> Indices:
    """Return (2, F) the number of pixels in which each face is seen from the side of its normal,
    and from the other.

    Zeros where the maps do not say which face is seen.
    """
    shown = np.zeros((2, len(mesh.faces)), np.intp)
    if maps.face is None:
        return shown
    normals = face_normals(mesh.vertices, mesh.faces)
    _count_sides(maps.face, normals, maps.views.T_camera_world[:, 2, :3], shown)
    return shown


@kernel
def _count_sides(maps, normals, ways, shown):
    for k in range(maps.shape[0]):
        x, y, z = ways[k, 0], ways[k, 1], ways[k, 2]
        for i in range(maps.shape[1]):
            for j in range(maps.shape[2]):
                face = maps[k, i, j]
                if face >= 0:
                    f = np.uintp(face)  # looking along the normal, a camera sees the back
                    away = normals[f, 0] * x + normals[f, 1] * y + normals[f, 2] * z > 0.0
                    shown[1 if away else 0, f] += 1


def solidified(
    mesh: LabelledMesh, where: Probes, free: Bools, shown: Indices, thickness: float, solid: Bools
) -> tuple[LabelledMesh, Bools, Indices]:
    """Return the mesh with its sheets thickened and its faces turned outwards.

    Args:
        mesh: what `where` was made from.
        free: (2, n) whether the point on each side of each probe is seen free.
        shown: (2, F) how many pixels show each face from either side: a large face may be seen
            between its probes only.
        thickness: given to sheets, half on each side.
        solid: (F,) which faces are those of closed pieces, see `closed_piece`.

    Returns:
        The mesh, and for each of its faces whether it can be seen at all, and which it was.
    """
    count = np.bincount(where.face, minlength=len(mesh.faces))
    share = [np.bincount(where.face, weights=w, minlength=len(mesh.faces)) / np.maximum(count, 1)
             for w in (free[0], free[1], free[0] & free[1])]  # fmt: skip
    share = [of_face[where.speaker] for of_face in share]
    # a closed piece's winding can be trusted, nobody sees its backs, and what has depth is no sheet
    sheet = (share[2] >= SHEET_SHARE) & ~(solid & (share[1] < 1.0))
    if thickness <= 0.0:
        sheet[:] = False
    probed = (share[0] > 0.0) | (share[1] > 0.0)
    turned = np.where(probed, share[1] > share[0], shown[1] > shown[0]) & ~solid
    faces = np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces)
    is_seen = (share[0] > 0.0) | (shown[0] > 0) | (((share[1] > 0.0) | (shown[1] > 0)) & ~solid)
    kept = LabelledMesh(mesh.vertices, faces[~sheet], mesh.part_of_face[~sheet])
    slabs, of_sheet = _slabs(mesh.vertices, faces[sheet], mesh.part_of_face[sheet], thickness)
    is_seen = np.concatenate([is_seen[~sheet], np.ones(len(slabs.faces), np.bool_)])
    origin = np.concatenate([np.flatnonzero(~sheet), np.flatnonzero(sheet)[of_sheet]])
    return LabelledMesh.joined([kept, slabs]), is_seen, origin


def _slabs(
    vertices: Floats, faces: NDArray[np.int32], part_of_face: Bytes, thickness: float
) -> tuple[LabelledMesh, Indices]:
    """Return each face as a slab: two caps, and walls on the edges where the sheet ends or folds;
    and which face each of its faces is of.

    Where the sheet goes on over an edge, smoothly, the slabs on both sides share the edge's lifted
    ends (a mitre joint): along a bent sheet there is no crack to look into it through.
    """
    normals = face_normals(vertices, faces)
    pairs = _smooth_pairs(welded(vertices)[faces], normals)
    ways = _mitres(vertices[faces], normals, pairs)
    lifted = vertices[faces][:, None] + np.array([0.5, -0.5])[None, :, None, None] * (
        thickness * ways[:, None]
    )
    first = 6 * np.arange(len(faces))[:, None]  # each face has six vertices of its own
    top, bottom = np.array([0, 1, 2]), np.array([5, 4, 3])
    caps = np.concatenate([first + top, first + bottom])
    continued = np.zeros((len(faces), 3), np.bool_)
    continued[pairs[:, 0], pairs[:, 1]] = True
    walls, owner = [], []
    for edge, (a, b) in enumerate(((0, 1), (1, 2), (2, 0))):
        ends = np.flatnonzero(~continued[:, edge])
        for corners_of_half in ((a, 3 + a, 3 + b), (a, 3 + b, b)):
            walls.append(first[ends] + np.array(corners_of_half))
            owner.append(ends)
    all_faces = np.concatenate([caps, *walls]) if len(faces) else np.zeros((0, 3), np.intp)
    source = np.concatenate([np.arange(len(faces))] * 2 + owner)
    slabs = LabelledMesh(lifted.reshape(-1, 3), all_faces.astype(np.int32), part_of_face[source])
    return slabs, source


def _smooth_pairs(weld: Indices, normals: Floats) -> Indices:
    """Rows (f, e, g, d): face g goes on smoothly with its edge d over edge e of face f, and the
    other way about; edges 0, 1, 2 run from the corner of that number to the next.

    Args:
        weld: (F, 3) a number for the place of each corner.
    """
    ends = np.stack([weld, np.roll(weld, -1, axis=1)], axis=2).reshape(-1, 2)
    ends = np.sort(ends, axis=1)
    key = ends[:, 0] * (int(weld.max(initial=0)) + 1) + ends[:, 1]
    order = np.argsort(key, kind="stable")
    pairs = [np.zeros((0, 2), np.intp)]
    for step in range(1, MOST_AT_AN_EDGE):  # each edge with the next ones that lie in its place
        same = np.flatnonzero(key[order[step:]] == key[order[: len(order[step:])]])
        if len(same) == 0:
            break
        pairs.append(np.stack([order[same], order[same + step]], axis=1))
    one, other = np.concatenate(pairs).T
    smooth = np.abs(dot(normals[one // 3], normals[other // 3])) > SMOOTH_COSINE
    one, other = one[smooth & (one // 3 != other // 3)], other[smooth & (one // 3 != other // 3)]
    rows = np.stack([one // 3, one % 3, other // 3, other % 3], axis=1)
    return np.concatenate([rows, rows[:, [2, 3, 0, 1]]])


def _mitres(corners: Floats, normals: Floats, pairs: Indices) -> Floats:
    """Return (F, 3, 3) the direction of each corner of a face as the face is lifted by 1 along its
    normal.

    The same place, or the opposite one, for corners that `_smooth_pairs` joins: along the mean of
    the normals there, weighted by the faces' angles (Thuermer and Wuethrich 1998), and further the
    more it leans, by no more than `LONGEST_MITRE`.
    """
    sides = np.roll(corners, -1, axis=1) - corners
    back = -np.roll(sides, 1, axis=1)
    angle = arctan2(norm(cross(sides, back)), dot(sides, back))
    alike = dot(normals[pairs[:, 0]], normals[pairs[:, 2]])
    group, side = _groups(len(normals), pairs, alike)
    normal = np.repeat(normals, 3, axis=0)
    mean = np.zeros((3 * len(normals), 3))
    np.add.at(mean, group, (side * angle.reshape(-1))[:, None] * normal)
    mean = side[:, None] * mean[group]
    length = norm(mean)
    along = dot(mean, normal) / np.maximum(length, 1e-30)
    leans = along > 1.0 / LONGEST_MITRE  # or faces that cannot be told up from down meet here
    ways = mean / np.maximum(length * np.maximum(along, 1e-30), 1e-30)[:, None]
    return np.where(leans[:, None], ways, normal).reshape(-1, 3, 3)


@kernel
def _groups(count, pairs, alike):
    """Find for each corner the first one joined to it, and its side: -1 if wound otherwise; faces
    of a pair are wound otherwise where the cosine of their normals, `alike`, is negative."""
    parent = np.empty(3 * count, np.int64)
    side = np.empty(3 * count)
    for c in range(3 * count):
        parent[c], side[c] = c, 1.0
    for n in range(pairs.shape[0]):
        f, e, g, d = pairs[n, 0], pairs[n, 1], pairs[n, 2], pairs[n, 3]
        turn = -1.0 if alike[n] < 0.0 else 1.0
        # edges of faces wound alike run against each other
        first, last = (d, (d + 1) % 3) if turn < 0.0 else ((d + 1) % 3, d)
        _join(parent, side, 3 * f + e, 3 * g + first, turn)
        _join(parent, side, 3 * f + (e + 1) % 3, 3 * g + last, turn)
    for c in range(3 * count):
        _settle(parent, side, c)
    return parent, side


@helper
def _join(parent, side, a, b, turn):
    a_root, b_root = _settle(parent, side, a), _settle(parent, side, b)
    if a_root != b_root:
        low, high = min(a_root, b_root), max(a_root, b_root)
        side[high] = turn * side[a] * side[b]
        parent[high] = low


@helper
def _settle(parent, side, c):
    """Return the root of corner `c` and make it its parent; its side is then that towards the
    root."""
    root, turn = c, 1.0
    while parent[root] != root:
        turn *= side[root]
        root = parent[root]
    while parent[c] != root and parent[c] != c:
        onward, side_here = parent[c], side[c]
        parent[c], side[c] = root, turn
        turn *= side_here
        c = onward
    return root


def closed_piece(mesh: LabelledMesh) -> Ints:
    """Return (F,) a number for the closed piece that each face belongs to, -1 where it belongs to
    none.

    Faces that hang together by corners are a piece. It is closed where along each of its edges as
    many faces run one way as the other, and its volume is positive. From outside, only fronts are
    seen of it.
    """
    faces = welded(mesh.vertices)[mesh.faces]
    if not len(faces):
        return np.zeros(0, np.int64)
    count = int(faces.max()) + 1
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    low, high = edges.min(axis=1), edges.max(axis=1)
    way = np.sign(edges[:, 1] - edges[:, 0])
    which = np.unique(low * count + high, return_inverse=True)[1]
    paired = np.bincount(which, weights=way)[which] == 0.0
    piece = _pieces(faces.astype(np.int64), count)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    volume = np.bincount(piece, weights=dot(a, cross(b, c)), minlength=count)
    open_edges = np.bincount(np.repeat(piece, 3), weights=~paired, minlength=count)
    return np.where((open_edges[piece] == 0) & (volume[piece] > 0.0), piece, -1)


@kernel
def _pieces(faces, count):
    """Return (F,) a number for each face, the same for faces that hang together by corners."""
    parent = np.empty(count, np.int64)
    for c in range(count):
        parent[c] = c
    for f in range(faces.shape[0]):
        for corner in range(1, 3):
            a, b = root(parent, faces[f, 0]), root(parent, faces[f, corner])
            parent[max(a, b)] = min(a, b)
    piece = np.empty(faces.shape[0], np.int64)
    for f in range(faces.shape[0]):
        piece[f] = root(parent, faces[f, 0])
    return piece


def face_normals(vertices: Floats, faces: NDArray[np.int32]) -> Floats:
    """Return (F, 3) unit normals by the right-hand rule of each face's winding."""
    return unit_normals(vertices[faces])


def face_areas(vertices: Floats, faces: NDArray[np.int32]) -> Floats:
    return 0.5 * norm(area_vectors(vertices[faces]))
