"""Which points lie near others: exact, by sorting the points into cells.

`Sorted` answers thousands of questions about points of the unit cube, `Cells` is for kernels that
walk around points of any box. Cells along z lie in one piece, so that a query examines a few
columns; `Sorted` has about three times as many as points, of which a surface leaves most empty.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Floats, Ints
from articugen.core.jit import helper, inlined, kernel

_ROUNDING = 1e-9  # cells are chosen that much more generously; what is in them is compared exactly


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


def by_cell(points: Floats) -> Sorted:
    """`points` (m, 3), sorted once for however many questions."""
    cells = max(1, int(1.5 * len(points) ** (1.0 / 3.0)))
    x, y, z = np.clip(((points + 0.5) * cells).astype(np.int64), 0, cells - 1).T
    number, start = _sorted((x * cells + y) * cells + z, cells**3)
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


@helper
def _off(cell, cells, at):  # pragma: no cover - compiled
    """The squared distance of a coordinate from a slab of cells, and rather less; 0 inside."""
    low = cell / cells - 0.5
    gap = max(low - at, at - (low + 1.0 / cells)) - _ROUNDING
    return gap * gap if gap > 0.0 else 0.0


@inlined
def _nearest(points, first, last, query, most):  # pragma: no cover - compiled
    """Return (i, d): nearest of points[first:last], its squared distance; (-1, most) if too far."""
    found, least = -1, most
    for i in range(first, last):
        n = np.uintp(i)  # unsigned: numba does not ask whether to count from the end
        x, y, z = points[n, 0] - query[0], points[n, 1] - query[1], points[n, 2] - query[2]
        d = x * x + y * y + z * z
        if d < least or (d == least and found < 0):
            found, least = i, d
    return found, least


@kernel
def _sorted(cell, count):  # pragma: no cover - compiled
    """Return the numbers of points by their `cell` (m,), and where each of `count` cells begins."""
    start = np.zeros(count + 1, np.int32)
    for i in range(len(cell)):
        start[cell[i] + 1] += 1
    for j in range(count):
        start[j + 1] += start[j]
    free, number = start.copy(), np.empty(len(cell), np.int64)
    for i in range(len(cell)):
        number[free[cell[i]]] = i
        free[cell[i]] += 1
    return number, start


MOST_CELLS = 128  # along one axis; a grid that fine takes 16 MiB


class Cells(NamedTuple):
    """A grid of cubes over the box of some points.

    Attributes:
        low: the box's lower corner.
        side: of a cube.
        shape: how many cubes along each axis.
        first: cube c, counted with z fastest, holds points first[c] to first[c + 1] of `order`.
        order: (n,) the points' indices, cube by cube.
    """

    low: tuple[float, float, float]
    side: float
    shape: tuple[int, int, int]
    first: NDArray[np.int32]
    order: Ints


def cells_of(points: Floats, side: float) -> Cells:
    """The `points` (n, 3) in cubes of this side, or larger ones if there would be too many."""
    low, high = points.min(axis=0), points.max(axis=0)
    side = max(side, float((high - low).max()) / (MOST_CELLS - 1))
    shape = ((high - low) / side).astype(np.int64) + 1
    x, y, z = ((points - low) / side).astype(np.int64).T
    cell = (x * shape[1] + y) * shape[2] + z
    order, first = _sorted(cell, int(shape.prod()))
    corner, cubes = (float(low[0]), float(low[1]), float(low[2])), tuple(int(n) for n in shape)
    return Cells(corner, side, cubes, first, order)  # type: ignore[arg-type]


@helper
def reached(cells, axis, at, reach):
    """Return where the cubes within `reach` of the coordinate `at` begin and end along an axis."""
    first = int(np.floor((at - reach - cells.low[axis]) / cells.side))
    last = int(np.floor((at + reach - cells.low[axis]) / cells.side))
    begin = min(max(first, 0), cells.shape[axis])
    return begin, max(min(last + 1, cells.shape[axis]), begin)


@helper
def near(cells, points, at, reach, found):
    """Write the indices of the points within `reach` of `at` to `found` (n,); how many they are."""
    x, y, z = at[0], at[1], at[2]
    order, first = cells.order, cells.first
    x_low, x_end = reached(cells, 0, x, reach)
    y_low, y_end = reached(cells, 1, y, reach)
    z_low, z_end = reached(cells, 2, z, reach)
    count = 0
    for i in range(x_low, x_end):
        for j in range(y_low, y_end):
            row = (i * cells.shape[1] + j) * cells.shape[2]
            for n in range(first[row + z_low], first[row + z_end]):
                k = order[n]
                dx, dy, dz = points[k, 0] - x, points[k, 1] - y, points[k, 2] - z
                if dx**2 + dy**2 + dz**2 < reach * reach:
                    found[count] = k
                    count += 1
    return count
