"""Free space that no view sees but that is open to the outside: the rule `reachable`.

Seen from outside, the far corners of an open drawer are as dark as solid wood. The rule `reachable`
also calls a point outside where a straight line leads to it from a voxel that a flood from outside
has reached. The flood runs over voxels that no face touches, so that it passes openings of two
voxels and more and never one that is narrower than a voxel; `recipe.Fusion.opening` is two voxels.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bools, Bytes, Floats
from articugen.core.geometry import bounds, invert_rigid
from articugen.core.jit import helper, kernel
from articugen.core.records import LabelledMesh
from articugen.meshes.bvh import Bvh, meets

DRY, WALL, WET, SOLID = 0, 1, 2, 3

_ROUNDING = 1e-9
"""In voxels: a face in the very plane between two layers of them must mark at least one."""


@dataclass(frozen=True, eq=False)
class Flood:
    """Cells that a flood from outside reaches.

    Attributes:
        state: (n, n, n) uint8 over the unit cube: DRY is not reached, WALL touched by a face, WET
            reached; SOLID is dry and known to lie in closed pieces, see `field.own_solid`.
        bvh, to_part: of the posed mesh, as in `fusion.FusedField`.
    """

    state: Bytes
    bvh: Bvh
    to_part: NDArray[np.float32]

    def around(self, points: NDArray[np.floating]) -> Bytes:
        """Return (n,) the state of the voxel of each of `points` (n, 3). In a reached one no face
        is between a point and its centre, so that it is free, whatever the views see."""
        return _around(np.ascontiguousarray(points, np.float32), self.state)

    def reaches(self, points: NDArray[np.floating]) -> Bools:
        """Return (n,) which of the unseen `points` (n, 3) the flood gets to."""
        flat = np.ascontiguousarray(points, np.float32)
        return _reaches(flat, self.state, self.to_part, self.bvh)


def touched(mesh: LabelledMesh, resolution: int) -> Bytes:
    """Return (resolution,) * 3 uint8 over the unit cube: 1 in the voxels that a face touches."""
    state = np.zeros((resolution,) * 3, np.uint8)
    first = np.zeros(3, np.int64)
    mark(state, first, resolution, (mesh.vertices[mesh.faces] + 0.5) * resolution)
    return state


def flood(mesh: LabelledMesh, resolution: int, bvh: Bvh, part_motion: Floats) -> Flood:
    """Flood the voxels of the cube that no face touches, `resolution` along an edge, from outside.

    Args:
        bvh, part_motion: of the posed mesh.
    """
    state = touched(mesh, resolution)
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    low, high = (bounds(corners) + 0.5) * len(state) if len(corners) else np.zeros((2, 3))
    first = np.clip(low.astype(int), 0, len(state) - 1)
    last = np.clip(high.astype(int), 0, len(state) - 1)
    box = tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))
    flooded = np.full(state.shape, WET, np.uint8)  # nothing is outside the mesh's box
    a, b, c = state[box].shape
    padded = np.full((a + 2, b + 2, c + 2), np.uint8(WALL))  # so that no step leaves the array
    padded[1:-1, 1:-1, 1:-1] = state[box]
    _fill(padded.reshape(-1), a, b, c)
    flooded[box] = padded[1:-1, 1:-1, 1:-1]
    to_part = np.ascontiguousarray(invert_rigid(part_motion)[:, :3], np.float32)
    return Flood(flooded, bvh, to_part)


@kernel
def mark(state, first, n, corners):
    """Set the voxels that overlap a triangle: its box, its plane, its three shadows along the axes.

    The test of Schwarz and Seidel 2010, "Fast parallel surface and solid voxelization on GPUs".

    Args:
        state: (a, b, c) uint8: a box of a lattice of n^3 voxels that begins at voxel `first`.
        corners: (F, 3, 3) in voxels of the lattice; the part of them in the lattice lies in the
            box.
    """
    for f in range(corners.shape[0]):
        ax, ay, az = corners[f, 0, 0], corners[f, 0, 1], corners[f, 0, 2]
        bx, by, bz = corners[f, 1, 0], corners[f, 1, 1], corners[f, 1, 2]
        cx, cy, cz = corners[f, 2, 0], corners[f, 2, 1], corners[f, 2, 2]
        x = (by - ay) * (cz - az) - (bz - az) * (cy - ay)  # the normal
        y = (bz - az) * (cx - ax) - (bx - ax) * (cz - az)
        z = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        half = (0.5 + _ROUNDING) * (abs(x) + abs(y) + abs(z)) + _ROUNDING
        offset = x * ax + y * ay + z * az
        low_i, end_i = _extent(ax, bx, cx, n)
        low_j, end_j = _extent(ay, by, cy, n)
        low_k, end_k = _extent(az, bz, cz, n)
        for i in range(low_i, end_i):
            for j in range(low_j, end_j):
                for k in range(low_k, end_k):
                    at = x * (i + 0.5) + y * (j + 0.5) + z * (k + 0.5)
                    u, v, w = i - first[0], j - first[1], k - first[2]
                    if abs(at - offset) > half or state[u, v, w] == WALL:
                        continue
                    if (
                        _shadows_meet(ax, ay, bx, by, cx, cy, z, i, j)
                        and _shadows_meet(ay, az, by, bz, cy, cz, x, j, k)
                        and _shadows_meet(az, ax, bz, bx, cz, cx, y, k, i)
                    ):
                        state[u, v, w] = WALL


@helper
def _extent(a, b, c, n):
    """Return the first of n voxels along an axis that three coordinates span, and the end."""
    low, high = np.floor(min(a, b, c)), np.floor(max(a, b, c))
    return max(int(low), 0), min(int(high), n - 1) + 1


@helper
def _shadows_meet(au, av, bu, bv, cu, cv, turn, i, j):
    """Return whether a triangle's and a voxel's shadow meet; `turn`: the normal there."""
    sign = 1.0 if turn >= 0.0 else -1.0
    return (
        _within(au, av, bu, bv, sign, i, j)
        and _within(bu, bv, cu, cv, sign, i, j)
        and _within(cu, cv, au, av, sign, i, j)
    )


@helper
def _within(pu, pv, qu, qv, sign, i, j):
    """Return whether some of the square (i, j) lies on the inner side of the edge from p to q."""
    nu, nv = -(qv - pv) * sign, (qu - pu) * sign
    reach = max(nu, 0.0) + max(nv, 0.0)  # of its corner furthest to the inside
    return not nu * (i - pu) + nv * (j - pv) + reach < 0.0


@kernel
def _fill(flat, a, b, c):
    """Flood a box of a x b x c voxels, with one more around it."""
    row, plane = c + 2, (b + 2) * (c + 2)
    waiting = np.empty(flat.shape[0], np.int32)
    count = 0
    for i in range(1, a + 1):
        for j in range(1, b + 1):
            inner = 1 < i < a and 1 < j < b
            for k in range(1, c + 1, c - 1 if inner and c > 1 else 1):
                at = i * plane + j * row + k
                if flat[at] == DRY:
                    flat[at] = WET
                    waiting[count] = at
                    count += 1
    while count > 0:
        count -= 1
        at = waiting[count]
        for step in (-plane, -row, -1, 1, row, plane):
            if flat[at + step] == DRY:
                flat[at + step] = WET
                waiting[count] = at + step
                count += 1


@kernel
def _around(points, state):
    n = state.shape[0]
    around = np.empty(points.shape[0], np.uint8)
    for index in range(points.shape[0]):
        i = min(max(int((points[index, 0] + 0.5) * n), 0), n - 1)
        j = min(max(int((points[index, 1] + 0.5) * n), 0), n - 1)
        k = min(max(int((points[index, 2] + 0.5) * n), 0), n - 1)
        around[index] = state[i, j, k]
    return around


@kernel
def _reaches(points, state, to_part, bvh):
    n = state.shape[0]
    reached = np.zeros(points.shape[0], np.bool_)
    h = bvh
    for index in range(points.shape[0]):
        p = (points[index, 0], points[index, 1], points[index, 2])
        i = min(max(int((p[0] + 0.5) * n), 0), n - 1)
        j = min(max(int((p[1] + 0.5) * n), 0), n - 1)
        k = min(max(int((p[2] + 0.5) * n), 0), n - 1)
        if state[i, j, k] == WET:  # no face is between it and the voxel's centre
            reached[index] = True
            continue
        for a in range(max(i - 1, 0), min(i + 2, n)):
            for b in range(max(j - 1, 0), min(j + 2, n)):
                for c in range(max(k - 1, 0), min(k + 2, n)):
                    if reached[index] or state[a, b, c] != WET:
                        continue
                    way = (
                        np.float32((a + 0.5) / n - 0.5) - p[0],
                        np.float32((b + 0.5) / n - 0.5) - p[1],
                        np.float32((c + 0.5) / n - 0.5) - p[2],
                    )
                    reached[index] = not meets(
                        p, way, np.float32(1.0), to_part,
                        h.box, h.skip, h.leaf, h.triangles, h.roots,
                    )  # fmt: skip
    return reached
