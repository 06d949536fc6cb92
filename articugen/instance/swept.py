"""The box that points sweep in many poses, without moving every point to every pose.

The points are sorted into cells. The corners of a cell's own box bound where its points can get to,
so that only the few cells that may hold the utmost point are looked into: the numbers are those of
moving all points.
"""

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.geometry import bounds
from articugen.core.jit import kernel
from articugen.core.records import LabelledMesh

_CELLS = 24  # along an edge of the points' box
_ROUNDING = 1e-12  # of a bound, relative to the largest number in it: points as near are examined


def swept_box(mesh: LabelledMesh, motions: Floats) -> Floats:
    """Return the box (2, 3) of the mesh's faces in all poses; `motions` (N, P, 4, 4)."""
    boxes = []
    for part in np.unique(mesh.part_of_face):
        used = np.zeros(len(mesh.vertices), np.bool_)
        used[mesh.faces[mesh.part_of_face == part]] = True
        poses = np.unique(np.ascontiguousarray(motions[:, part]).reshape(len(motions), 16), axis=0)
        points = mesh.vertices[used]
        low, high = bounds(points)
        at = ((points - low) * (_CELLS * 0.999 / np.maximum(high - low, 1e-300))).astype(np.intp)
        key = (at[:, 0] * _CELLS + at[:, 1]) * _CELLS + at[:, 2]
        order = np.argsort(key, kind="stable")
        points, key = points[order], key[order]
        first = np.flatnonzero(np.diff(key, prepend=-1))
        utmost = np.minimum.reduceat(points, first), np.maximum.reduceat(points, first)
        cells = np.append(first, len(points)), np.stack(utmost, axis=1)
        boxes.append(_swept(points, *cells, poses.reshape(-1, 4, 4)))
    lower, upper = np.moveaxis(np.array(boxes), 1, 0)
    return np.stack([lower.min(axis=0), upper.max(axis=0)])


@kernel
def _swept(points, first, boxes, poses):
    """Return (2, 3) the utmost coordinates of the points in all poses (N, 4, 4)."""
    box = np.empty((2, 3))
    for row in range(3):
        box[0, row], box[1, row] = np.inf, -np.inf
    count = boxes.shape[0]
    least, most = np.empty(count), np.empty(count)
    for k in range(poses.shape[0]):
        for row in range(3):
            a, b, c, d = poses[k, row, 0], poses[k, row, 1], poses[k, row, 2], poses[k, row, 3]
            size, least_most, most_least = abs(d), np.inf, -np.inf
            for n in range(count):
                low = high = d
                for axis in range(3):
                    t = poses[k, row, axis]
                    u, v = t * boxes[n, 0, axis], t * boxes[n, 1, axis]
                    low += min(u, v)
                    high += max(u, v)
                    size = max(size, abs(u), abs(v))
                least[n], most[n] = low, high
                least_most, most_least = min(least_most, high), max(most_least, low)
            slack = _ROUNDING * size + 1e-300
            # some point is as low, and as high; cells that cannot go beyond are not looked into
            lowest = min(least_most + slack, box[0, row])
            highest = max(most_least - slack, box[1, row])
            for n in range(count):
                if least[n] - slack < lowest or most[n] + slack > highest:
                    for i in range(first[n], first[n + 1]):
                        at = a * points[i, 0] + b * points[i, 1] + c * points[i, 2] + d
                        box[0, row] = min(box[0, row], at)
                        box[1, row] = max(box[1, row], at)
    return box
