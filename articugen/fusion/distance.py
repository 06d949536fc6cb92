"""How far points are from faces: exact distances to triangles, through the trees of `bvh`."""

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Floats
from articugen.core.geometry import invert_rigid
from articugen.core.jit import helper, kernel
from articugen.meshes.bvh import Bvh
from articugen.meshes.distances import to_box, to_triangle


def distances(
    points: NDArray[np.floating],
    faces: Bvh,
    part_motion: Floats,
    most: float,
    *,
    part: int | None = None,
) -> Floats:
    """Return (n,) the distance of `points` (n, 3) to the nearest face, at most `most`; unit frame.

    Args:
        faces: of each part in its canonical pose.
        part_motion: (P, 4, 4) of each part from there.
        part: to the faces of this part alone.
    """
    to_part = np.ascontiguousarray(invert_rigid(part_motion)[:, :3])
    first, end = (0, len(to_part)) if part is None else (part, part + 1)
    queries = np.ascontiguousarray(points, np.float64)
    return _distances(queries, to_part, first, end, most, faces)


@kernel
def _distances(points, to_part, first, end, most, faces):
    out = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        best = most * most
        for part in range(first, end):
            T = to_part[part]
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            q = (
                T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
                T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
                T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
            )
            best = _nearer(q, best, faces.box, faces.skip, faces.leaf, faces.triangles,
                           faces.roots[part], faces.roots[part + 1])  # fmt: skip
        out[i] = np.sqrt(best)
    return out


@helper
def _nearer(q, best, box, skip, leaf, triangles, node, end):
    """Return the squared distance of `q` to the faces of nodes `node` to `end`, or `best`."""
    while node < end:
        if to_box(q, box, node) >= best:
            node = skip[node]
            continue
        for f in range(leaf[node, 0], leaf[node, 0] + leaf[node, 1]):
            best = min(best, _to_triangle(q, triangles, f))
        node += 1
    return best


@helper
def _to_triangle(q, triangles, f):
    """Return the squared distance of `q` to face `f`."""
    a = (float(triangles[f, 4]), float(triangles[f, 5]), float(triangles[f, 6]))
    b = (float(triangles[f, 7]), float(triangles[f, 8]), float(triangles[f, 9]))
    c = (float(triangles[f, 10]), float(triangles[f, 11]), float(triangles[f, 12]))
    return to_triangle(q, a, b, c)
