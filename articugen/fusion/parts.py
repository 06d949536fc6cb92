"""The solid that each part is, judged by how the part is seen when it stands alone.

Faces alone do not say what is solid: sheets have no thickness, and many models turn faces either
way. So each part is examined alone, its sheets are thickened and its faces turned outwards, and
what its views and its closed pieces say together is its material.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from articugen.core.arrays import Bools, Floats, Indices, Ints
from articugen.core.geometry import bounds
from articugen.core.portable import norm
from articugen.core.recipe import Fusion
from articugen.core.records import DepthMaps, LabelledMesh
from articugen.fusion import solidify
from articugen.fusion.field import FusedField, OwnSolid, flooded, fuse, own_solid, pixel_width
from articugen.fusion.thin import thin_voxels, way_meets
from articugen.fusion.winding import ClosedPieces, closed_pieces
from articugen.meshes.bvh import Bvh, tree_of

Render = Callable[[LabelledMesh, Floats], DepthMaps]
"""Renders a mesh alone from all around, given also the box (2, 3) that it fills."""


@dataclass(frozen=True, eq=False)
class SolidPart:
    """The surface of one part alone in the canonical pose.

    Attributes:
        mesh: its sheets thickened, its faces turned outwards.
        seen: (F,) which of its faces can be seen.
        closed: (F,) which are those of closed pieces.
        origin: (F,) which face of the soup each was, see `solidify.origins`.
        tree, box: of its faces, and what holds them, (2, 3).
        pieces: the closed ones; None where the recipe's rule takes the views' word alone.
        judged_by: the field that says so; None where sheets have become slabs, which it knows not.
        slit: the area before sheets of what was seen open and lost width, or is no more, as they
            became slabs: it was narrower than those are thick.
    """

    mesh: LabelledMesh
    seen: Bools
    closed: Bools
    origin: Indices
    tree: Bvh
    box: Floats
    pieces: ClosedPieces | None
    judged_by: FusedField | None
    slit: float = 0.0


def solid_part(soup: LabelledMesh, settings: Fusion, render: Render) -> SolidPart:
    """Thicken the sheets of one part and turn its faces outwards, by how it is seen alone.

    Args:
        soup: the part's faces in the canonical pose, unit frame, as the model has them.
    """
    keep = solidify.unrepeated(soup)
    soup = LabelledMesh(soup.vertices, soup.faces[keep], soup.part_of_face[keep]).compact()
    piece, box = solidify.closed_piece(soup), _box(soup)
    field = fuse(render(soup, box), soup, settings)
    pieces, closed = _closed_pieces(soup, piece, settings, field.bvh), piece >= 0
    alone = OwnSolid(field, box, pieces)
    thickness = settings.sheet_thickness
    where = solidify.probes(soup, max(thickness, 1e-3) / 3.0, together=True)
    free = np.stack([~alone.holds(where.points[0]), np.zeros(len(where.face), np.bool_)])
    # of a closed piece, what no other face lies before is inside, whatever the views make of it
    outwards = solidify.face_normals(soup.vertices, soup.faces)[where.face].astype(np.float32)
    way = 0.99 * 0.5 * norm(where.points[0] - where.points[1]).max(initial=0.0)
    inner = where.points[1].astype(np.float32)
    covered = way_meets(inner, outwards, np.float32(way), field.bvh)
    probes = np.flatnonzero(~closed[where.face] | covered)
    free[1, probes] = ~alone.holds(where.points[1][probes])
    shown = solidify.shown_sides(soup, field.maps)
    mesh, is_seen, origin = solidify.solidified(soup, where, free, shown, thickness, closed)
    origin = keep[origin]
    if np.array_equal(mesh.faces, soup.faces):
        return SolidPart(mesh, is_seen, closed, origin, field.bvh, box, pieces, field)
    slit = _slit(soup, where, free.all(axis=0) & ~closed[where.face], thickness, field.bvh)
    tree, piece = tree_of(mesh.vertices[mesh.faces]), solidify.closed_piece(mesh)
    pieces, closed = _closed_pieces(mesh, piece, settings, tree), piece >= 0
    if len(mesh.faces) == len(soup.faces):
        return SolidPart(mesh, is_seen, closed, origin, tree, box, pieces, field)
    return SolidPart(mesh, is_seen, closed, origin, tree, _box(mesh), pieces, None, slit)


def seen_alone(
    part: SolidPart, settings: Fusion, render: Render, maps: DepthMaps | None = None
) -> OwnSolid:
    """Return the own solid of `part` by `maps` of it alone; without any by those that it was judged
    by, or else by rendered ones."""
    field = part.judged_by if maps is None else None
    if field is None:
        maps = render(part.mesh, part.box) if maps is None else maps
        field = fuse(maps, part.mesh, settings, bvh=part.tree, part_motion=np.eye(4)[None])
    thin = thin_voxels(part.mesh, pixel_width(field.maps.views), field.bvh)
    flood = flooded(part.judged_by or field, part.mesh).flood
    return own_solid(replace(field, thin=thin, flood=flood), part.box, part.pieces)


def _slit(
    mesh: LabelledMesh, where: solidify.Probes, sheet: Bools, thickness: float, tree: Bvh
) -> float:
    """Compute `SolidPart.slit`: of those probes that are of a `sheet`, seen free on both sides,
    the area of which another face lies before them, nearer than `thickness`."""
    probes = np.flatnonzero(sheet)
    normals = solidify.face_normals(mesh.vertices, mesh.faces)[where.face[probes]]
    reach = np.float32(thickness - 0.5 * norm(where.points[0] - where.points[1]).max(initial=0.0))
    narrow = np.zeros(len(probes), np.bool_)
    for points, way in ((where.points[0], normals), (where.points[1], -normals)):
        narrow |= way_meets(points[probes].astype(np.float32), way.astype(np.float32), reach, tree)
    face = where.face[probes[narrow]]
    count = np.bincount(where.face, minlength=len(mesh.faces))
    return float((solidify.face_areas(mesh.vertices, mesh.faces)[face] / count[face]).sum())


def _box(mesh: LabelledMesh) -> Floats:
    """Return (2, 3) of its faces."""
    return bounds(mesh.vertices[mesh.faces].reshape(-1, 3)) if len(mesh.faces) else np.zeros((2, 3))


def _closed_pieces(
    mesh: LabelledMesh, piece: Ints, settings: Fusion, tree: Bvh
) -> ClosedPieces | None:
    """Find `SolidPart.pieces`."""
    return None if settings.rule == "mean" else closed_pieces(mesh, piece, tree)
