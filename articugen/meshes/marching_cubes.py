"""Marching cubes: the zero level of a sampled grid as a closed triangle mesh, in numpy.

After Lorensen and Cline (1987). What joins the crossed edges on a face of a cell follows from the
signs at its four corners alone (Montani, Scateni and Scopigno 1994: where it is ambiguous, inside
corners are kept apart), so neighbouring cells agree, and the mesh is closed whatever the signs.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bools, Ints
from articugen.core.records import Mesh

_Edge = tuple[int, int]
_Triangle = tuple[_Edge, _Edge, _Edge]

_STEPS = (4, 2, 1)
"""A corner of a cell is a number from 0 to 7; this much of it says that it is the upper one along
x, y and z."""

_EDGES: list[_Edge] = [(c, c + step) for step in _STEPS for c in range(8) if not c & step]


def zero_level(field: NDArray[np.floating]) -> Mesh:
    """Return the surface field = 0 of a grid (R, R, R), unit frame, faces outwards; inside is above
    0.

    Samples are at the voxel centres (i + 0.5) / R - 0.5, indexed [x, y, z]; between two of them the
    field counts as linear. Nothing is inside beyond the grid: there the surface closes up to half a
    voxel outside the outermost samples. A grid without any inside gives an empty mesh.
    """
    inside = field > 0.0
    if not inside.any():
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    along_x_y = np.any(inside, axis=2)
    lines = np.any(along_x_y, axis=1), np.any(along_x_y, axis=0), np.any(inside, axis=(0, 1))
    there = [np.flatnonzero(line)[[0, -1]].tolist() for line in lines]
    box, border = tuple(slice(max(low - 1, 0), high + 2) for low, high in there), 0.0  # and around
    if any(side.start == 0 or side.stop > len(field) for side in box):
        border = max(float(field.max()), -float(field.min()), 1.0)
    padded = np.pad(field[box], 1, constant_values=-border)
    _, Y, Z = padded.shape
    strides = np.array([Y * Z, Z, 1])
    keys, faces = np.unique(_crossed_edges(padded > 0.0, strides), return_inverse=True)
    low, axis = np.divmod(keys, 3)  # the lower sample of each crossed edge, and its direction
    first, second = (padded.ravel()[at].astype(np.float64) for at in (low, low + strides[axis]))
    position = np.stack(np.unravel_index(low, padded.shape), 1).astype(np.float64)
    position += [side.start for side in box]
    position[np.arange(len(axis)), axis] += first / (first - second)
    return Mesh((position - 0.5) / len(field) - 0.5, faces.reshape(-1, 3).astype(np.int32))


def _crossed_edges(inside: Bools, strides: Ints) -> Ints:
    """Return (F, 3): the edge that each corner of each triangle lies on, 3 * its lower sample +
    axis."""
    corners = np.array(list(itertools.product((0, 1), repeat=3)))
    X, Y, Z = (n - 1 for n in inside.shape)
    case = np.zeros((X, Y, Z), np.uint8)
    for corner, (x, y, z) in enumerate(corners):
        case |= inside[x : X + x, y : Y + y, z : Z + z] * np.uint8(1 << corner)
    cells = np.argwhere((case > 0) & (case < 255))
    triangles = _CASES[case[tuple(cells.T)]]
    there = triangles[..., 0] >= 0
    first = np.repeat(cells @ strides, there.sum(1))  # of each triangle's cell, the lowest sample
    lower = corners[[corner for corner, _ in _EDGES]] @ strides
    key = 3 * lower + np.repeat(np.arange(3), 4)
    return 3 * first[:, None] + key[triangles[there]]


def _loops(case: int, faces: Sequence[Sequence[int]]) -> list[list[_Edge]]:
    """Return the closed lines in which a surface crosses the faces of a cell, each once around; bit
    c of `case` says whether corner c is inside."""

    def inside(corner: int) -> bool:
        return bool(case >> corner & 1)

    following: dict[_Edge, _Edge] = {}
    for ring, k in itertools.product(faces, range(4)):
        a, b, c, d = (*ring[k:], *ring[:k])
        if not inside(a) and inside(b):  # a line starts here; it ends after the last inside corner
            last, beyond = (b, c) if not inside(c) else (c, d) if not inside(d) else (d, a)
            following[_edge(a, b)] = _edge(last, beyond)
    loops = []
    while following:
        edge, loop = next(iter(following)), []
        while edge in following:
            loop.append(edge)
            edge = following.pop(edge)
        loops.append(loop)
    return loops


def _edge(a: int, b: int) -> _Edge:
    return min(a, b), max(a, b)


def _triangles(loop: Sequence[_Edge], faces: Sequence[Sequence[int]]) -> list[_Triangle] | None:
    """Return a loop as triangles without a chord in a face, as the next cell may have; or None."""
    if len(loop) == 2:
        return []
    for k in range(1, len(loop) - 1):
        chords = [(loop[0], loop[k])] * (k > 1) + [(loop[k], loop[-1])] * (k < len(loop) - 2)
        if any({*a, *b} <= set(ring) for a, b in chords for ring in faces):
            continue
        before, after = _triangles(loop[: k + 1], faces), _triangles(loop[k:], faces)
        if before is not None and after is not None:
            return [(loop[0], loop[k], loop[-1]), *before, *after]
    return None


def _table() -> Ints:
    """Return (256, 5, 3) the edges at the corners of each case's triangles, -1 for none."""
    faces, table = [], np.full((256, 5, 3), -1)
    for axis, step in enumerate(_STEPS):  # corners counter-clockwise as seen from outside
        one, two = _STEPS[(axis + 1) % 3], _STEPS[(axis + 2) % 3]
        lower = [0, one, one + two, two]
        faces += [lower[::-1], [corner + step for corner in lower]]
    for case in range(256):
        for_each_loop = (_triangles(loop, faces) or [] for loop in _loops(case, faces))
        for n, triangle in enumerate(itertools.chain(*for_each_loop)):
            table[case, n] = [_EDGES.index(edge) for edge in triangle]
    return table


_CASES = _table()
