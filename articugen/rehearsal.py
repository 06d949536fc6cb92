"""Each kernel called once, on next to nothing: numba compiles it then, and keeps it on the disk.

What a part calls is handed arrays made by hand wherever it needs none that another kernel makes, so
that several processes compile different kernels at a time. A test sees to it that after this
the real work finds every kernel compiled, for just the types that it hands over.
"""

import numpy as np

from articugen.core.geometry import look_along
from articugen.core.recipe import Fusion
from articugen.core.records import DepthMaps, LabelledMesh, Views
from articugen.fusion import FusedField, kernels, solidify
from articugen.fusion.reachable import Flood, flood, touched
from articugen.fusion.thin import NOTHING, way_meets
from articugen.fusion.winding import closed_pieces, surely_inside
from articugen.inspection.report.skin import skin
from articugen.instance.swept import swept_box
from articugen.learning.ppd.cpu import sine_kernels
from articugen.learning.ppd.cpu.greatest import greatest
from articugen.learning.ppd.cpu.patches import patches
from articugen.meshes.bvh import Bvh, build
from articugen.meshes.obj_kernel import read_plain
from articugen.pictures.camera import framed
from articugen.pictures.light import SurfaceCloud, occlusion_in_detail
from articugen.pictures.surfels import OrientedPoints, draw, surfels
from articugen.rendering import rasterizer

_POINT = np.zeros((1, 3))
_BOX = np.array([[-0.1, -0.1, -0.1], [0.1, 0.1, 0.1]])
_TWO = np.ones(2)
_SIDES = np.stack([look_along(way) for way in np.eye(3)[:2]])
_VIEWS = Views("orthographic", _SIDES, _TWO, _TWO, _TWO, _TWO, 4, 4)
_MESH = LabelledMesh(
    np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32),
    np.zeros(4, np.uint8),
)
_TREE = Bvh(
    np.zeros((1, 6), np.float32),
    np.ones(1, np.int32),
    np.zeros((1, 2), np.int32),
    np.zeros((1, 16), np.float32),
    np.array([0, 1], np.int32),
)
_FACES = np.zeros((2, 4, 4), np.int32)


def views() -> None:
    maps = DepthMaps(None, _FACES, _VIEWS)
    field = FusedField(maps, _TREE.triangles, _TREE, np.eye(4)[None], Fusion(), None, NOTHING)
    field.is_seen_free(_POINT)


def rays() -> None:
    points = _POINT.astype(np.float32)
    way_meets(points, points, np.float32(1.0), _TREE)
    water = Flood(np.zeros((2, 2, 2), np.uint8), _TREE, np.zeros((1, 3, 4), np.float32))
    water.fills(points)
    water.reaches(points)
    kernels.in_box(points, np.zeros(1, np.intp), np.eye(4), _BOX)


def drawing() -> None:
    rasterizer.render(_MESH, _VIEWS, closed=np.ones(4, np.bool_))


def solids() -> None:
    where = solidify.probes(_MESH, 0.01)
    shown = solidify.shown_sides(_MESH, DepthMaps(None, _FACES, _VIEWS))
    free = np.ones((2, len(where.face)), np.bool_)
    piece = solidify.closed_piece(_MESH)
    solidify.solidified(_MESH, where, free, shown, 0.01, piece >= 0)
    pieces = closed_pieces(_MESH, piece, _TREE)
    assert pieces is not None
    surely_inside(_POINT, pieces)


def boxes() -> None:
    build(_MESH.vertices[_MESH.faces], np.zeros(4, np.uint8), 1)
    flood(touched(_MESH, 8), _MESH, _TREE, np.eye(4)[None])
    swept_box(_MESH, np.eye(4)[None, None])


def files() -> None:
    read_plain(b"v 0 0 0\nf 1 1 1\n", vertices=9, faces=9, line=99)


def discs() -> None:
    sample = OrientedPoints(np.eye(3), np.eye(3), np.zeros(3, np.uint8))
    draw(surfels([sample]), np.zeros((3, 3)), framed(np.eye(3), 0.0, 0.0, 8, fill=0.5))


def skins() -> None:
    skin(OrientedPoints(np.eye(3), np.eye(3), np.zeros(3, np.uint8)), 0.5, 0.5)


def light() -> None:
    cloud = SurfaceCloud(np.eye(3), np.eye(3), np.ones(3))
    occlusion_in_detail(np.eye(3), np.eye(3), cloud, cloud)


def networks() -> None:
    greatest(np.zeros((1, 1, 1), np.float32), np.zeros((1, 1), np.int64))
    patches(np.zeros((1, 1, 3), np.float32), 4, 4)
    P, c = 1, 4
    layers = [(P, 12, c), (P, 6, 12), (2 * P, 12, 6), (2 * P, c, 12), (2 * P, 1, c)]
    shapes = [(1, 1, 3), (1, P, c, 3), (1, P, c), (1, P, c), (1, P, 6)]
    shapes += [shape for layer in layers for shape in (layer, layer[:2])]
    given = [np.zeros(shape, np.float32) for shape in shapes]
    out = np.zeros((1, 2 * P, 1), np.float32)
    sine_kernels.forward(*given, 0, P, out)
    sine_kernels.backward(*given, 0, P, out, *given[1:])
