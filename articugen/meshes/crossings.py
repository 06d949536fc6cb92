"""Faces of a mesh that go through one another."""

import numpy as np

from articugen.core.arrays import Floats, Ints
from articugen.core.jit import between, cross, dot, helper, kernel, minus, plane_of, vector
from articugen.meshes.bvh import misses, ordered

_CLEAR = 1e-6
"""Unit frame: how far past a plane and inside of edges a crossing must be, or it is a touch."""


def crossings(corners: Floats, most: int) -> Ints:
    """Return (n, 2) pairs of faces that cross, at most `most`, of the faces' corners (F, 3, 3).

    Two cross where an edge of one goes through the inside of the other: neighbours, faces that
    touch and faces in one plane do not.
    """
    corners = np.ascontiguousarray(corners, np.float64)
    order, box, skip, leaf, count = ordered(corners)
    return order[_pairs(corners[order], box, skip, leaf, count, most)]


@kernel
def _pairs(corners, box, skip, leaf, nodes, most):
    pairs = np.empty((most, 2), np.int64)
    count = 0
    for f in range(corners.shape[0]):
        node = 0
        while node < nodes and count < most:
            if misses(corners, f, box, node):
                node = skip[node]
                continue
            for g in range(max(leaf[node, 0], f + 1), leaf[node, 0] + leaf[node, 1]):
                if count < most and (_pierces(corners, f, g) or _pierces(corners, g, f)):
                    pairs[count, 0], pairs[count, 1] = f, g
                    count += 1
            node += 1
    return pairs[:count]


@helper
def _pierces(corners, f, g):
    """Return whether an edge of face `f` goes through the inside of face `g`."""
    a, (normal, _) = vector(corners[g], 0), plane_of(corners, g)
    for e in range(3):
        p, q = vector(corners[f], e), vector(corners[f], (e + 1) % 3)
        here, there = dot(normal, minus(p, a)), dot(normal, minus(q, a))
        if here * there >= 0.0 or min(abs(here), abs(there)) < _CLEAR:
            continue
        at = between(p, q, here, there)
        inside = True
        for k in range(3):
            start = vector(corners[g], k)
            edge = minus(vector(corners[g], (k + 1) % 3), start)
            width = dot(cross(edge, minus(at, start)), normal)
            inside &= width > _CLEAR * np.sqrt(dot(edge, edge))
        if inside:
            return True
    return False
