"""The kernels of this room, called once on next to nothing: see core/compiling.py."""

import numpy as np

from articugen.core.compiling import tetrahedron, two_views
from articugen.core.recipe import Fusion
from articugen.core.records import DepthMaps
from articugen.fusion import kernels, solidify
from articugen.fusion.field import FusedField
from articugen.fusion.reachable import Flood, flood
from articugen.fusion.thin import NOTHING, way_meets
from articugen.fusion.winding import closed_pieces, surely_inside
from articugen.meshes.bvh import Bvh, tree_of

_POINT = np.zeros((1, 3))
_BOX = np.array([[-0.1, -0.1, -0.1], [0.1, 0.1, 0.1]])
_TREE = Bvh(
    np.zeros((1, 6), np.float32),
    np.ones(1, np.int32),
    np.zeros((1, 2), np.int32),
    np.zeros((1, 16), np.float32),
    np.array([0, 1], np.int32),
)


def _maps() -> DepthMaps:
    return DepthMaps(None, np.zeros((2, 4, 4), np.int32), two_views())


def views() -> None:
    field = FusedField(_maps(), _TREE.triangles, _TREE, np.eye(4)[None], Fusion(), None, NOTHING)
    field.is_seen_free(_POINT)


def rays() -> None:
    points = _POINT.astype(np.float32)
    way_meets(points, points, np.float32(1.0), _TREE)
    water = Flood(np.zeros((2, 2, 2), np.uint8), _TREE, np.zeros((1, 3, 4), np.float32))
    water.around(points)
    water.reaches(points)
    kernels.in_box(points, np.zeros(1, np.intp), np.eye(4), _BOX)


def solids() -> None:
    mesh = tetrahedron()
    where = solidify.probes(mesh, 0.01)
    shown = solidify.shown_sides(mesh, _maps())
    free = np.ones((2, len(where.face)), np.bool_)
    piece = solidify.closed_piece(mesh)
    solidify.solidified(mesh, where, free, shown, 0.01, piece >= 0)
    pieces = closed_pieces(mesh, piece, _TREE)
    assert pieces is not None
    surely_inside(_POINT, pieces)


def boxes() -> None:
    mesh = tetrahedron()
    tree_of(mesh.vertices[mesh.faces])
    flood(mesh, 8, _TREE, np.eye(4)[None])
