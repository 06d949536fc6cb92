"""Watertight meshes with fewer faces, for flat walls need no triangle a voxel; convex hulls."""

from dataclasses import replace

import manifold3d
import numpy as np

from articugen.core.arrays import Floats
from articugen.core.records import Mesh
from articugen.meshes.painting import Coloured, by_colour


def manifold(mesh: Mesh) -> manifold3d.Manifold:
    """Return a watertight mesh as manifold3d has it; its status says whether it is one."""
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces, dtype=np.uint64)
    return manifold3d.Manifold(manifold3d.Mesh64(vertices, faces))


def mesh_of(solid: manifold3d.Manifold) -> Mesh:
    """Return the faces of what manifold3d has."""
    mesh64 = solid.to_mesh64()
    return Mesh(mesh64.vert_properties[:, :3], mesh64.tri_verts.astype(np.int32))


def simpler(mesh: Mesh, tolerance: float) -> Mesh:
    """Return a watertight mesh that lies within about `tolerance` of a watertight `mesh`, as do the
    borders of its colours."""
    groups = by_colour(mesh)
    first = manifold3d.Manifold.reserve_ids(len(groups)) if groups else 0
    solid = _with_borders(mesh, groups, first) if groups else manifold(mesh)
    if solid.status() != manifold3d.Error.NoError:
        return mesh
    solid = solid.simplify(tolerance)
    less, runs = mesh_of(solid), solid.to_mesh64()
    if not groups:
        return less
    rgb = np.array([group.rgb for group in groups], np.uint8)[
        np.array(runs.run_original_id) - first
    ]
    return replace(less, colours=np.repeat(rgb, np.diff(runs.run_index) // 3, axis=0))


def _with_borders(mesh: Mesh, groups: list[Coloured], first: int) -> manifold3d.Manifold:
    """Return a mesh as manifold3d has it, which keeps the borders of what differs in its id: the
    colours, from `first` on."""
    ends = 3 * np.cumsum([0, *(len(group.faces) for group in groups)])
    faces = mesh.faces[np.concatenate([group.faces for group in groups])]
    mesh64 = manifold3d.Mesh64(
        np.array(mesh.vertices), faces.astype(np.uint64), run_index=ends.astype(np.uint64),
        run_original_id=np.arange(first, first + len(groups), dtype=np.uint32),
    )  # fmt: skip
    return manifold3d.Manifold(mesh64)


def hull(points: Floats) -> Mesh:
    """Return the convex hull of points (n, 3); of flat ones a mesh without faces."""
    return mesh_of(manifold3d.Manifold.hull_points(points))
