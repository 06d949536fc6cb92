"""Watertight meshes with fewer faces, for flat walls need no triangle a voxel; convex hulls."""

import manifold3d
import numpy as np

from articugen.core.arrays import Floats
from articugen.core.records import Mesh


def manifold(mesh: Mesh) -> manifold3d.Manifold:
    """Return a watertight mesh as manifold3d has it; its status says whether it is one."""
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces, dtype=np.uint64)
    return manifold3d.Manifold(manifold3d.Mesh64(vertices, faces))


def mesh_of(solid: manifold3d.Manifold) -> Mesh:
    """Return the faces of what manifold3d has."""
    mesh64 = solid.to_mesh64()
    return Mesh(mesh64.vert_properties[:, :3], mesh64.tri_verts.astype(np.int32))


def simpler(mesh: Mesh, tolerance: float) -> Mesh:
    """Return a watertight mesh that lies within about `tolerance` of a watertight `mesh`."""
    solid = manifold(mesh)
    watertight = solid.status() == manifold3d.Error.NoError
    return mesh_of(solid.simplify(tolerance)) if watertight else mesh


def hull(points: Floats) -> Mesh:
    """Return the convex hull of points (n, 3); of flat ones a mesh without faces."""
    return mesh_of(manifold3d.Manifold.hull_points(points))
