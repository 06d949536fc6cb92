"""Watertight meshes with fewer faces, for flat walls need no triangle a voxel; convex hulls."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import manifold3d
import numpy as np

from articugen.core.arrays import Floats
from articugen.core.colours import rgb
from articugen.core.records import Mesh
from articugen.meshes.painting import looks

_EVEN = 2.0**22  # places along an edge of the unit frame: what touches but for rounding touches
_TRIES = 24  # of grids that are so many times coarser: on another, other corners coincide


def manifold(mesh: Mesh) -> manifold3d.Manifold:
    """Return a watertight mesh as manifold3d has it; its status says whether it is one."""
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces, dtype=np.uint64)
    return manifold3d.Manifold(manifold3d.Mesh64(vertices, faces))


def shells(closed: Iterable[Mesh]) -> list[manifold3d.Manifold]:
    """Return the shells of closed meshes, the largest first: of one mesh, too, they may overlap."""
    every = (shell for mesh in closed for shell in manifold(mesh).decompose())
    return sorted((s for s in every if s.volume() > 0.0), key=lambda shell: -shell.volume())


def united(closed: Sequence[Mesh]) -> Mesh | None:
    """Return the mesh of the space that closed meshes fill, unit frame; None where faces of it
    cross or corners coincide, or where one of the meshes has several colours, which faces in one
    plane may lose."""
    from articugen.meshes.crossings import crossings  # noqa: PLC0415 - compiles; hulls need none

    if any(mesh.colours is not None and np.ptp(mesh.colours, axis=0).any() for mesh in closed):
        return None
    for grid in _EVEN / np.arange(1, _TRIES + 1):
        even = [replace(mesh, vertices=np.round(mesh.vertices * grid) / grid) for mesh in closed]
        union = manifold3d.Manifold.batch_boolean(shells(even), manifold3d.OpType.Add)
        mesh = mesh_of(union.simplify(1.0 / grid))
        apart = len(np.unique(np.round(mesh.vertices * _EVEN), axis=0)) == len(mesh.vertices)
        if apart and not len(crossings(mesh.triangles, 1)):
            return mesh
    return None


def mesh_of(solid: manifold3d.Manifold) -> Mesh:
    """Return the faces of what manifold3d has."""
    mesh64 = solid.to_mesh64()
    return Mesh(mesh64.vert_properties[:, :3], mesh64.tri_verts.astype(np.int32))


def simpler(mesh: Mesh, tolerance: float) -> Mesh:
    """Return a watertight mesh that lies within about `tolerance` of a watertight `mesh`, as do the
    borders of its colours."""
    if mesh.colours is None or not len(mesh.faces):
        solid = manifold(mesh)
        watertight = solid.status() == manifold3d.Error.NoError
        return mesh_of(solid.simplify(tolerance)) if watertight else mesh
    groups = looks(mesh)
    faces = mesh.faces[np.concatenate([look.faces for look in groups])].astype(np.uint64)
    ends = 3 * np.cumsum([0, *(len(look.faces) for look in groups)])
    first = manifold3d.Manifold.reserve_ids(len(groups))  # borders of what differs in them stay
    ids = np.arange(first, first + len(groups), dtype=np.uint32)
    runs = {"run_index": ends.astype(np.uint64), "run_original_id": ids}
    solid = manifold3d.Manifold(manifold3d.Mesh64(np.array(mesh.vertices), faces, **runs))
    if solid.status() != manifold3d.Error.NoError:
        return mesh
    solid = solid.simplify(tolerance)
    mesh64, palette = solid.to_mesh64(), np.array([rgb(look.colour) for look in groups], np.uint8)
    of_run = palette[np.array(mesh64.run_original_id) - first]
    return replace(mesh_of(solid), colours=np.repeat(of_run, np.diff(mesh64.run_index) // 3, 0))


def hull(points: Floats) -> Mesh:
    """Return the convex hull of points (n, 3); of flat ones a mesh without faces."""
    return mesh_of(manifold3d.Manifold.hull_points(points))
