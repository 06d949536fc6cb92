"""Bounding boxes around boxes: whether a ray leaves a part without meeting any of its faces.

One tree a part, built once in the canonical pose; a ray is taken to the part instead of the part to
the ray, so that no pose needs a new tree. Nodes lie in depth-first order with skip links
(Smits 1998, "Efficiency issues for ray tracing"): the walk needs no stack.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from articugen.core import portable
from articugen.core.arrays import Floats
from articugen.core.geometry import unit_normals
from articugen.core.jit import cross, dot, helper, inlined, kernel, minus

LEAF_FACES = 4


class Bvh(NamedTuple):
    """The trees of all parts, one after the other. N nodes, F faces.

    Attributes:
        box: (N, 6) float32: lower and upper corner.
        skip: (N,) int32: the node to go on with where the ray misses the box.
        leaf: (N, 2) int32: the first face of a leaf and how many; (0, 0) for an inner node.
        triangles: (F, 16) float32: the faces in the order of the leaves, see `triangle_table`.
        roots: (P + 1,) int32: part k has the nodes roots[k] to roots[k + 1] - 1.
    """

    box: Any
    skip: Any
    leaf: Any
    triangles: Any
    roots: Any


def triangle_table(corners: Floats) -> NDArray[np.float32]:
    """Return (F, 16) float32, one cache line a face: unit normal, offset, three corners; (F, 3,
    3)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normals = unit_normals(corners)
    table = np.zeros((len(corners), 16), np.float32)
    table[:, :3], table[:, 3] = normals, portable.dot(normals, (a + b + c) / 3.0)
    table[:, 4:13] = corners.reshape(-1, 9)
    return table


def tree_of(corners: Floats) -> Bvh:
    """Return the tree of one part over its faces' corners (F, 3, 3), in the canonical pose."""
    faces = np.ascontiguousarray(corners)
    order, box, skip, leaf, count = ordered(faces)
    roots = np.array([0, count], np.int32)
    return Bvh(box[:count], skip[:count], leaf[:count], triangle_table(faces[order]), roots)


def joined_trees(trees: Sequence[Bvh]) -> Bvh:
    """Return the trees of several parts, one after the other."""
    first_node = np.cumsum([0, *(len(tree.skip) for tree in trees)])
    first_face = np.cumsum([0, *(len(tree.triangles) for tree in trees)])
    leaves = [np.array(tree.leaf) for tree in trees]
    for leaf, first in zip(leaves, first_face, strict=False):
        leaf[:, 0] += np.where(leaf[:, 1] > 0, first, 0).astype(np.int32)
    skips = [tree.skip + np.int32(n) for tree, n in zip(trees, first_node, strict=False)]
    return Bvh(
        np.concatenate([tree.box for tree in trees]),
        np.concatenate(skips),
        np.concatenate(leaves),
        np.concatenate([tree.triangles for tree in trees]),
        first_node.astype(np.int32),
    )


@kernel
def ordered(corners):
    """Split at the middle of the longer side of the centres' box until few faces are left.

    The order of the faces; of room for the largest tree the box, skip and leaf of each node, and
    how many nodes there are.
    """
    F = corners.shape[0]
    centers = np.empty((F, 3))
    order = np.empty(F, np.int64)
    for f in range(F):
        order[f] = f
        for axis in range(3):
            total = corners[f, 0, axis] + corners[f, 1, axis] + corners[f, 2, axis]
            centers[f, axis] = total / 3.0
    most = max(2 * F, 1)
    box = np.zeros((most, 6), np.float32)
    right = np.empty(most, np.int64)
    skip = np.empty(most, np.int32)
    leaf = np.zeros((most, 2), np.int32)
    waiting = np.empty((most, 3), np.int64)  # faces, and the parent that this is the right child of
    waiting[0, 0], waiting[0, 1], waiting[0, 2] = 0, F, -1
    left = 1 if F > 0 else 0
    count = 0
    while left > 0:
        left -= 1
        low, high, parent = waiting[left, 0], waiting[left, 1], waiting[left, 2]
        node = count
        count += 1
        right[node] = -1
        if parent >= 0:
            right[parent] = node
        axis, middle = _measure(corners, centers, order, low, high, box, node)
        if high - low <= LEAF_FACES:
            leaf[node, 0] = low
            leaf[node, 1] = high - low
            continue
        cut = low
        for n in range(low, high):
            f = order[n]
            if centers[f, axis] < middle:
                order[n], order[cut] = order[cut], f
                cut += 1
        if cut in (low, high):  # all centres in one place
            cut = (low + high) // 2
        waiting[left, 0], waiting[left, 1], waiting[left, 2] = cut, high, node
        waiting[left + 1, 0], waiting[left + 1, 1], waiting[left + 1, 2] = low, cut, -1
        left += 2
    skip[0] = count
    for node in range(count):
        if right[node] >= 0:
            skip[node + 1] = right[node]
            skip[right[node]] = skip[node]
    return order, box, skip, leaf, count


@helper
def _measure(corners, centers, order, low, high, box, node):
    """Set the node's box; return the longest axis of its centres' box and the middle along it."""
    longest, middle, widest = 0, 0.0, -1.0
    for axis in range(3):
        first, last, lower, upper = np.inf, -np.inf, np.inf, -np.inf
        for n in range(low, high):
            f = order[n]
            first = min(first, centers[f, axis])
            last = max(last, centers[f, axis])
            for corner in range(3):
                lower = min(lower, corners[f, corner, axis])
                upper = max(upper, corners[f, corner, axis])
        box[node, axis] = lower - 1e-6  # single precision must not lose what lies on the border
        box[node, axis + 3] = upper + 1e-6
        if last - first > widest:
            longest, middle, widest = axis, (first + last) / 2.0, last - first
    return longest, middle


@helper
def misses(corners, f, box, node):  # pragma: no cover - compiled
    """Return whether the box of a face, of all corners (F, 3, 3), does not reach that of a node."""
    apart = False
    for axis in range(3):
        a, b, c = corners[f, 0, axis], corners[f, 1, axis], corners[f, 2, axis]
        apart |= min(a, b, c) > box[node, axis + 3] or max(a, b, c) < box[node, axis]
    return apart


@helper
def meets(p, w, reach, to_part, box, skip, leaf, triangles, roots):
    """Return whether the way from `p` to `p + reach * w` meets any face of any part.

    Args:
        p, w: tuples of three float32.
        reach: float32; inf for a ray without end.
        to_part: (P, 3, 4) float32: from the current pose to each part's canonical pose.
        box, skip, leaf, triangles, roots: the `Bvh`.
    """
    for part in range(roots.shape[0] - 1):
        T = to_part[part]
        q = (
            T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3],
            T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3],
            T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3],
        )
        d = (
            T[0, 0] * w[0] + T[0, 1] * w[1] + T[0, 2] * w[2],
            T[1, 0] * w[0] + T[1, 1] * w[1] + T[1, 2] * w[2],
            T[2, 0] * w[0] + T[2, 1] * w[1] + T[2, 2] * w[2],
        )
        inverse = (_inverse(d[0]), _inverse(d[1]), _inverse(d[2]))
        node, end = roots[part], roots[part + 1]
        while node < end:
            n = np.uintp(node)  # unsigned: numba does not ask whether to count from the end
            low, high = (box[n, 0], box[n, 1], box[n, 2]), (box[n, 3], box[n, 4], box[n, 5])
            if not _enters(q, inverse, reach, low, high):
                node = skip[n]
                continue
            for f in range(leaf[n, 0], leaf[n, 0] + leaf[n, 1]):
                t = np.uintp(f)
                plane = (triangles[t, 0], triangles[t, 1], triangles[t, 2], triangles[t, 3])
                ahead = -in_front(q, d, plane)
                if 0.0 <= ahead <= reach and line_meets(
                    q, d,
                    (triangles[t, 4], triangles[t, 5], triangles[t, 6]),
                    (triangles[t, 7], triangles[t, 8], triangles[t, 9]),
                    (triangles[t, 10], triangles[t, 11], triangles[t, 12]),
                ):  # fmt: skip
                    return True
            node += 1
    return False


@inlined
def _inverse(x):
    return np.float32(1.0) / x if abs(x) > 1e-20 else np.float32(1e20)


@helper
def _enters(q, inverse, reach, low, high):
    """Return whether the ray from `q` enters a box before `reach`; numbers only, see `_judge`."""
    ax, bx = (low[0] - q[0]) * inverse[0], (high[0] - q[0]) * inverse[0]
    ay, by = (low[1] - q[1]) * inverse[1], (high[1] - q[1]) * inverse[1]
    az, bz = (low[2] - q[2]) * inverse[2], (high[2] - q[2]) * inverse[2]
    near = max(min(ax, bx), min(ay, by), min(az, bz), np.float32(0.0))
    far = min(max(ax, bx), max(ay, by), max(az, bz), reach)
    return near <= far


@helper
def in_front(p, w, plane):
    """Return how far `p` lies in front of a face's `plane`, normal and offset as in the
    `triangle_table`, along the direction `w` to the camera."""
    slope = dot(plane, w)
    if slope == 0.0:
        slope = np.float32(1e-12)
    return (dot(plane, p) - plane[3]) / slope


@helper
def behind(p, w, plane):
    """Return whether `p` lies behind a face's plane, seen from the direction `w`: `in_front` <=
    0."""
    return (dot(plane, p) - plane[3]) * dot(plane, w) <= 0.0


@helper
def line_meets(p, w, a, b, c):
    """Return whether the line through `p` along `w` passes through the triangle a, b, c, either way
    round.

    Signs of the volumes that the line spans with each edge; the two faces at an edge compute the
    same number with opposite sign, so no line slips between them.
    """
    a, b, c = minus(a, p), minus(b, p), minus(c, p)
    ab, bc, ca = dot(w, cross(a, b)), dot(w, cross(b, c)), dot(w, cross(c, a))
    return (ab >= 0.0 and bc >= 0.0 and ca >= 0.0) or (ab <= 0.0 and bc <= 0.0 and ca <= 0.0)
