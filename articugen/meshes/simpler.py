"""Watertight meshes with fewer faces, for flat walls need no triangle a voxel; convex hulls."""

import manifold3d
import numpy as np

from articugen.core.arrays import Floats
from articugen.core.records import Mesh


def simpler(mesh: Mesh, tolerance: float) -> Mesh:
    """Return a watertight mesh that lies within about `tolerance` of a watertight `mesh`."""
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces, dtype=np.uint64)
    solid = manifold3d.Manifold(manifold3d.Mesh64(vertices, faces))
    if solid.status() != manifold3d.Error.NoError:
        return mesh
    mesh64 = solid.simplify(tolerance).to_mesh64()
    return Mesh(mesh64.vert_properties[:, :3], mesh64.tri_verts.astype(np.int32))


def hull(points: Floats) -> Mesh:
    """Return the convex hull of points (n, 3); of flat ones a mesh without faces."""
    mesh64 = manifold3d.Manifold.hull_points(points).to_mesh64()
    return Mesh(mesh64.vert_properties[:, :3], mesh64.tri_verts.astype(np.int32))
