"""Features that fit between pixels.

A view knows what it sees at pixel centres. Between them a bar thinner than a pixel can hide, and a
view that looks past it must not call its inside free. (A wider one shows at one of the four pixels
around any of its points: between the corners of a square there is no gap wider than its side,
whatever the direction.) Here the voxels that such features touch are marked, once for each part; a
view's word is checked there by following the ray itself.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from articugen.hierarchy import Hierarchy, meets
from articugen.reachable import walls
from articugen.records import LabelledMesh
from articugen.sheets import face_normals, probes

_BENEATH = 1e-4
"""How deep behind a face the search for its other side begins, unit frame."""

NOTHING = np.zeros((1, 1, 1), np.uint8)


def slender_voxels(mesh: LabelledMesh, width: float, hierarchy: Hierarchy) -> NDArray[np.uint8]:
    """(n, n, n) uint8 over the unit cube: 1 where a face that has another within `width` behind it
    touches the voxel, which is `width` wide; `NOTHING` if there is none.

    Args:
        mesh: faces outwards.
        width: of a pixel, unit frame.
        hierarchy: of the mesh as one part, where it is.
    """
    where = probes(mesh, _BENEATH)
    inwards = -face_normals(mesh.vertices, mesh.faces)[where.face]
    has_other_side = _meet(
        where.points[1].astype(np.float32), inwards.astype(np.float32), np.float32(width), hierarchy
    )
    thin = np.bincount(where.face, weights=has_other_side, minlength=len(mesh.faces)) > 0
    if not thin.any():
        return NOTHING
    return walls(
        LabelledMesh(mesh.vertices, mesh.faces[thin], mesh.part_of_face[thin]), 2.0 * width
    )


@njit(cache=True, nogil=True)
def _meet(points, ways, reach, hierarchy):
    """(n,) whether a face lies within `reach` of each point on its way."""
    unmoved = np.zeros((1, 3, 4), np.float32)
    for axis in range(3):
        unmoved[0, axis, axis] = 1.0
    h = hierarchy
    met = np.zeros(points.shape[0], np.bool_)
    for i in range(points.shape[0]):
        p = (points[i, 0], points[i, 1], points[i, 2])
        w = (ways[i, 0], ways[i, 1], ways[i, 2])
        met[i] = meets(p, w, reach, unmoved, h.box, h.skip, h.leaf, h.triangles, h.roots)
    return met
