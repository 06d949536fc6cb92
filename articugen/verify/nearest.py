"""Which points lie near others: exact, by sorting the points into cells.

Cells along z lie in one piece, so that a query looks at a few columns of them; there are about
three times as many as points, of which a surface leaves most empty.
"""

import numpy as np

from articugen.jit import helper, kernel

_ROUNDING = 1e-9
"""Cells are chosen that much more generously; what is in them is compared exactly."""


@kernel
def any_within(points, queries, radius):  # pragma: no cover - compiled
    """(n,) whether any of `points` (m, 3) lies within `radius` of each query (n, 3)."""
    found = np.zeros(len(queries), np.bool_)
    if len(queries) == 0 or len(points) == 0:
        return found
    cells = _fitting(len(points), radius)
    start, order = _by_cell(points, cells)
    held = points[order]
    most, reach = radius * radius, radius + _ROUNDING
    for k in range(len(queries)):
        query = queries[k]
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
def nearest_within(points, queries, radius):  # pragma: no cover - compiled
    """(n,) the index of the one of `points` (m, 3) nearest to each query (n, 3) within `radius`, or
    -1; of several equally near one."""
    found = np.full(len(queries), -1, np.int64)
    if len(queries) == 0 or len(points) == 0:
        return found
    cells = _fitting(len(points), radius)
    start, order = _by_cell(points, cells)
    held, reach = points[order], radius + _ROUNDING
    for k in range(len(queries)):
        query, best = queries[k], radius * radius
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
                    best, found[k] = d, order[i]
    return found


@helper
def _fitting(count, radius):  # pragma: no cover - compiled
    """Cells along an edge of the unit cube, for so many points: none narrower than half a radius,
    which would only be more to look at."""
    return max(1, min(int(1.5 * count ** (1.0 / 3.0)), int(2.0 / radius)))


@helper
def _cell(at, cells):  # pragma: no cover - compiled
    """The cell along an axis that holds a coordinate, or the outermost."""
    return min(max(int((at + 0.5) * cells), 0), cells - 1)


@helper
def _cell_of(point, cells):  # pragma: no cover - compiled
    x, y, z = _cell(point[0], cells), _cell(point[1], cells), _cell(point[2], cells)
    return (x * cells + y) * cells + z


@helper
def _by_cell(points, cells):  # pragma: no cover - compiled
    """The numbers of the points (m, 3) in the order of their cells, and where each cell's begin."""
    start = np.zeros(cells**3 + 1, np.int32)
    cell = np.empty(len(points), np.int32)
    for i in range(len(points)):
        cell[i] = _cell_of(points[i], cells)
        start[cell[i] + 1] += 1
    for j in range(cells**3):
        start[j + 1] += start[j]
    free, order = start.copy(), np.empty(len(points), np.int64)
    for i in range(len(points)):
        order[free[cell[i]]] = i
        free[cell[i]] += 1
    return start, order


@helper
def _off(cell, cells, at):  # pragma: no cover - compiled
    """The squared distance of a coordinate from a slab of cells, and rather less; 0 inside."""
    low = cell / cells - 0.5
    gap = max(low - at, at - (low + 1.0 / cells)) - _ROUNDING
    return gap * gap if gap > 0.0 else 0.0


@helper
def _nearest(points, first, last, query, most):  # pragma: no cover - compiled
    """(i, d): which of points[first:last] is nearest, and its squared distance; (-1, most) where
    none is within the root of `most`."""
    found = -1
    for i in range(first, last):
        d = 0.0
        for axis in range(3):
            d += (points[i, axis] - query[axis]) ** 2
        if d < most or (d == most and found < 0):
            found, most = i, d
    return found, most
