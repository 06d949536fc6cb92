"""Features that fit between pixels.

A view knows what it sees at pixel centres. Between them a bar thinner than a pixel can hide, and a
view that looks past it must not call its inside free. (A wider one shows at one of the four pixels
around any of its points: between the corners of a square there is no gap wider than its side,
whatever the direction.) Here the voxels that such features touch are marked, once for each part; a
view's word is checked there by following the ray itself.
"""

from typing import Any, NamedTuple

import numpy as np

from articugen.core.geometry import bounds
from articugen.core.jit import kernel
from articugen.core.records import LabelledMesh
from articugen.fusion.reachable import mark
from articugen.fusion.solidify import face_normals, probes
from articugen.meshes.bvh import Bvh, meets

_BENEATH = 1e-4
"""How deep behind a face the search for its other side begins, unit frame; but no deeper than an
eighth of a pixel, which of a small part seen alone is less."""

_MOST_EDGE = 320
"""Voxels along an edge of a part's box: a few megabytes as bits, 33 while they are marked. Views
of up to 300 pixels, which show the whole box, never need more; finer ones get wider voxels, which
only means that more rays are followed."""


class ThinVoxels(NamedTuple):
    """Marked voxels of a lattice over the unit cube; kept is the box around them.

    Attributes:
        bits: (a, b, c) uint8: bit m of bits[i, j, k] is the voxel (i, j, 8 k + m) of the box.
        first: (3,) int64: the lattice's number of the box's first voxel.
        resolution: of the lattice: voxels along an edge of the unit cube.
    """

    bits: Any
    first: Any
    resolution: int


NOTHING = ThinVoxels(np.zeros((0, 0, 0), np.uint8), np.zeros(3, np.int64), 1)


def thin_voxels(mesh: LabelledMesh, width: float, bvh: Bvh) -> ThinVoxels:
    """Return the voxels that are touched by a face which has another within `width` behind it;
    `NOTHING` if there is none. A voxel is `width` wide, or so that the part's box has `_MOST_EDGE`.

    Args:
        mesh: faces outwards.
        width: of a pixel, unit frame.
        bvh: of the mesh as one part, where it is.
    """
    where = probes(mesh, min(_BENEATH, width / 8.0))
    inwards = -face_normals(mesh.vertices, mesh.faces)[where.face]
    has_other_side = way_meets(
        where.points[1].astype(np.float32), inwards.astype(np.float32), np.float32(width), bvh
    )
    thin = np.bincount(where.face, weights=has_other_side, minlength=len(mesh.faces)) > 0
    if not thin.any():
        return NOTHING
    corners = mesh.vertices[mesh.faces[thin]]
    box = bounds(corners.reshape(-1, 3))
    edge = float(np.max(box[1] - box[0]))
    resolution = max(4, round(1.0 / max(width, edge / (_MOST_EDGE - 2))))
    first, last = np.clip(np.floor((box + 0.5) * resolution), 0, resolution - 1).astype(np.int64)
    state = np.zeros(last - first + 1, np.uint8)
    mark(state, first, resolution, (corners + 0.5) * resolution)
    return ThinVoxels(np.packbits(state, axis=2, bitorder="little"), first, resolution)


@kernel
def way_meets(points, ways, reach, bvh):
    """Return (n,) whether a face lies within `reach` of each point on its way."""
    unmoved = np.zeros((1, 3, 4), np.float32)
    for axis in range(3):
        unmoved[0, axis, axis] = 1.0
    h = bvh
    met = np.zeros(points.shape[0], np.bool_)
    for i in range(points.shape[0]):
        p = (points[i, 0], points[i, 1], points[i, 2])
        w = (ways[i, 0], ways[i, 1], ways[i, 2])
        met[i] = meets(p, w, reach, unmoved, h.box, h.skip, h.leaf, h.triangles, h.roots)
    return met
