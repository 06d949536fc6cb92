"""What surely lies inside: the winding number about the closed pieces of a part.

Whatever way a ray leaves a point around which a closed surface winds, it meets a face, so that no
view can see the point free. One ray's signed crossings tell the winding number, where a hundred
views would have to be asked; and a corner that hides between the pixels of a view is not missed.
Where a ray passes an edge within rounding another is sent; where all do, or where the point is as
close to a face, nothing is said.
"""

import numpy as np
from numpy.typing import NDArray

from articugen.fusion.bvh import Bvh, _enters, _inverse, build
from articugen.jit import helper, inlined, kernel
from articugen.records import LabelledMesh

_AHEAD, _ASIDE = 0.9837, (0.1371, 0.0913, 0.1159)
"""A ray goes along one axis, the one that leaves the pieces' box soonest before the next two, and
so much along the others: it is in line with nothing that models are built along."""

_CLEAR = 2e-6
"""Unit frame: how far from edges and from its start a crossing must be to count; corners closer
than half of that are one in `solidify.welded`."""

_DOUBT = 2


def pieces(mesh: LabelledMesh, closed: NDArray[np.bool_]) -> Bvh:
    """The faces of closed pieces alone, for `surely_inside`; see `solidify.closed`."""
    corners = mesh.vertices[mesh.faces[closed]]
    return build(corners, np.zeros(len(corners), np.uint8), 1)


def surely_inside(points: NDArray[np.floating], closed: Bvh) -> NDArray[np.bool_]:
    """(n,) which of `points` (n, 3) closed pieces surely wind around."""
    if not len(closed.triangles):
        return np.zeros(len(points), np.bool_)
    return _surely_inside(np.ascontiguousarray(points, np.float64), closed)


@kernel
def _surely_inside(points, closed):
    box, skip, leaf, triangles = closed.box, closed.skip, closed.leaf, closed.triangles
    low = (np.float64(box[0, 0]), np.float64(box[0, 1]), np.float64(box[0, 2]))
    high = (np.float64(box[0, 3]), np.float64(box[0, 4]), np.float64(box[0, 5]))
    inside = np.zeros(points.shape[0], np.bool_)
    for i in range(points.shape[0]):
        p = (points[i, 0], points[i, 1], points[i, 2])
        x = _outwards(p[0], low[0], high[0])
        y = _outwards(p[1], low[1], high[1])
        z = _outwards(p[2], low[2], high[2])
        least = min(abs(x), abs(y), abs(z))
        if least == 0.0:
            continue
        soonest = 0 if abs(x) == least else (1 if abs(y) == least else 2)
        for more in range(3):
            axis = (soonest + more) % 3
            w = (
                np.copysign(_AHEAD if axis == 0 else _ASIDE[0], x),
                np.copysign(_AHEAD if axis == 1 else _ASIDE[1], y),
                np.copysign(_AHEAD if axis == 2 else _ASIDE[2], z),
            )
            winds = _winds(p, w, box, skip, leaf, triangles)
            if winds != _DOUBT:
                inside[i] = winds == 1
                break
    return inside


@inlined
def _outwards(x, low, high):
    """How far it is to the nearer end, negative where that is the lower; 0 where outside."""
    if x <= low or x >= high:
        return 0.0
    return high - x if high - x < x - low else low - x


@helper
def _winds(p, w, box, skip, leaf, triangles):
    """1 where the crossings of the ray from `p` along `w` do not cancel, 0, or `_DOUBT`."""
    start = (np.float32(p[0]), np.float32(p[1]), np.float32(p[2]))
    inverse = (
        _inverse(np.float32(w[0])), _inverse(np.float32(w[1])), _inverse(np.float32(w[2]))
    )  # fmt: skip
    endless = np.float32(np.inf)
    turns = node = 0
    while node < skip.shape[0]:
        n = np.uintp(node)  # unsigned: numba does not ask whether to count from the end
        low, high = (box[n, 0], box[n, 1], box[n, 2]), (box[n, 3], box[n, 4], box[n, 5])
        if not _enters(start, inverse, endless, low, high):
            node = skip[n]
            continue
        for f in range(leaf[n, 0], leaf[n, 0] + leaf[n, 1]):
            t = np.uintp(f)
            plane = (triangles[t, 0], triangles[t, 1], triangles[t, 2], triangles[t, 3])
            crossing = _crossing(
                p, w, plane,
                (triangles[t, 4], triangles[t, 5], triangles[t, 6]),
                (triangles[t, 7], triangles[t, 8], triangles[t, 9]),
                (triangles[t, 10], triangles[t, 11], triangles[t, 12]),
            )  # fmt: skip
            if crossing == _DOUBT:
                return _DOUBT
            turns += crossing
        node += 1
    return 1 if turns != 0 else 0


@helper
def _crossing(p, w, plane, a, b, c):
    """1 where the ray leaves through the front of a face, -1 where it enters, 0; or `_DOUBT`.

    The volumes that the ray spans with each edge, in double precision, over the edge's length are
    how far it passes from the edge, or less.
    """
    ax, ay, az = a[0] - p[0], a[1] - p[1], a[2] - p[2]
    bx, by, bz = b[0] - p[0], b[1] - p[1], b[2] - p[2]
    cx, cy, cz = c[0] - p[0], c[1] - p[1], c[2] - p[2]
    ab = w[0] * (ay * bz - az * by) + w[1] * (az * bx - ax * bz) + w[2] * (ax * by - ay * bx)
    bc = w[0] * (by * cz - bz * cy) + w[1] * (bz * cx - bx * cz) + w[2] * (bx * cy - by * cx)
    ca = w[0] * (cy * az - cz * ay) + w[1] * (cz * ax - cx * az) + w[2] * (cx * ay - cy * ax)
    size = abs(ax - bx) + abs(ay - by) + abs(az - bz) + abs(cx - bx) + abs(cy - by) + abs(cz - bz)
    clear = _CLEAR * size
    if (ab < -clear or bc < -clear or ca < -clear) and (ab > clear or bc > clear or ca > clear):
        return 0
    gap = plane[0] * ax + plane[1] * ay + plane[2] * az  # to the plane along its normal
    slope = plane[0] * w[0] + plane[1] * w[1] + plane[2] * w[2]
    if abs(gap) > _CLEAR and gap * slope < 0.0:
        return 0  # behind the start
    if abs(gap) <= _CLEAR or min(abs(ab), abs(bc), abs(ca)) <= clear:
        return _DOUBT
    return 1 if slope > 0.0 else -1
