"""Which points lie near others: exact, by sorting the points into cells.

Cells along z lie in one piece, so that a query examines a few columns of them; there are about
three times as many as points, of which a surface leaves most empty.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from articugen.core.jit import helper, inlined, kernel

_ROUNDING = 1e-9
"""Cells are chosen that much more generously; what is in them is compared exactly."""


class Sorted(NamedTuple):
    """Points in the order of their cells.

    Attributes:
        points: (m, 3).
        number: (m,) their places before they were sorted.
        start: (cells^3 + 1,) where each cell's begin.
        cells: along an edge of the unit cube.
    """

    points: Any
    number: Any
    start: Any
    cells: int


def by_cell(points: NDArray[np.float64]) -> Sorted:
    """`points` (m, 3), sorted once for however many questions."""
    cells = max(1, int(1.5 * len(points) ** (1.0 / 3.0)))
    number, start = _by_cell(points, cells)
    return Sorted(points[number], number, start, cells)


@kernel
def any_within(among, queries, radius):  # pragma: no cover - compiled
    """Return (n,) whether any of the `Sorted` points lies within `radius` of each query (n, 3)."""
    held, start, cells = among.points, among.start, among.cells
    found = np.zeros(len(queries), np.bool_)
    most, reach = radius * radius, radius + _ROUNDING
    for k in range(len(queries)):
        query = (queries[k, 0], queries[k, 1], queries[k, 2])
        own = _cell_of(query, cells)
        if _nearest(held, start[own], start[own + 1], query, most)[0] >= 0:
            found[k] = True
            continue
        low, high = _cell(query[2] - reach, cells), _cell(query[2] + reach, cells)
        for x in range(_cell(query[0] - reach, cells), _cell(query[0] + reach, cells) + 1):
            off = _off(x, cells, query[0])
            for y in range(_cell(query[1] - reach, cells), _cell(query[1] + reach, cells) + 1):
                if off + _off(y, cells, query[1]) > most:
                    continue
                column = (x * cells + y) * cells
                first, last = start[column + low], start[column + high + 1]
                if _nearest(held, first, last, query, most)[0] >= 0:
                    found[k] = True
                    break
            if found[k]:
                break
    return found


@kernel
def nearest_within(among, queries, radius):  # pragma: no cover - compiled
    """Return (n,) which of the `Sorted` points, by their places before, is nearest to each query
    (n, 3) within `radius`, or -1; of several equally near one."""
    held, number, start, cells = among.points, among.number, among.start, among.cells
    found = np.full(len(queries), -1, np.int64)
    reach = radius + _ROUNDING
    for k in range(len(queries)):
        query, best = (queries[k, 0], queries[k, 1], queries[k, 2]), radius * radius
        low, high = _cell(query[2] - reach, cells), _cell(query[2] + reach, cells)
        for x in range(_cell(query[0] - reach, cells), _cell(query[0] + reach, cells) + 1):
            off = _off(x, cells, query[0])
            for y in range(_cell(query[1] - reach, cells), _cell(query[1] + reach, cells) + 1):
                if off + _off(y, cells, query[1]) > best:
                    continue
                column = (x * cells + y) * cells
                first, last = start[column + low], start[column + high + 1]
                i, d = _nearest(held, first, last, query, best)
                if i >= 0 and (d < best or found[k] < 0):
                    best, found[k] = d, number[i]
    return found


@helper
def _cell(at, cells):  # pragma: no cover - compiled
    """Return the cell along an axis that holds a coordinate, or the outermost."""
    return min(max(int((at + 0.5) * cells), 0), cells - 1)


@helper
def _cell_of(point, cells):  # pragma: no cover - compiled
    x, y, z = _cell(point[0], cells), _cell(point[1], cells), _cell(point[2], cells)
    return (x * cells + y) * cells + z


@kernel
def _by_cell(points, cells):  # pragma: no cover - compiled
    """The numbers of the points (m, 3) in the order of their cells, and where each cell's begin."""
    start = np.zeros(cells**3 + 1, np.int32)
    cell = np.empty(len(points), np.int32)
    for i in range(len(points)):
        cell[i] = _cell_of((points[i, 0], points[i, 1], points[i, 2]), cells)
        start[cell[i] + 1] += 1
    for j in range(cells**3):
        start[j + 1] += start[j]
    free, number = start.copy(), np.empty(len(points), np.int64)
    for i in range(len(points)):
        number[free[cell[i]]] = i
        free[cell[i]] += 1
    return number, start


@helper
def _off(cell, cells, at):  # pragma: no cover - compiled
    """The squared distance of a coordinate from a slab of cells, and rather less; 0 inside."""
    low = cell / cells - 0.5
    gap = max(low - at, at - (low + 1.0 / cells)) - _ROUNDING
    return gap * gap if gap > 0.0 else 0.0


@inlined
def _nearest(points, first, last, query, most):  # pragma: no cover - compiled
    """Return (i, d): which of points[first:last] is nearest, and its squared distance; (-1, most)
    where none is within the root of `most`."""
    found, least = -1, most
    for i in range(first, last):
        n = np.uintp(i)  # unsigned: numba does not ask whether to count from the end
        x, y, z = points[n, 0] - query[0], points[n, 1] - query[1], points[n, 2] - query[2]
        d = x * x + y * y + z * z
        if d < least or (d == least and found < 0):
            found, least = i, d
    return found, least
