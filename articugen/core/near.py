"""Which points lie near others: exact, by sorting the points into cells.

`Sorted` answers thousands of questions about points, `Cells` is for kernels that walk around them.
Cells along z lie in one piece, so that a query examines a few columns; `Sorted` has up to three
times as many as points, of which a surface leaves most empty.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bools, Floats, Indices, Ints
from articugen.core.geometry import bounds
from articugen.core.jit import helper, inlined, kernel

_ROUNDING = 1e-9  # cells are chosen that much more generously; what is in them is compared exactly
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


def cells_of(points: Floats, side: float | None = None) -> Cells:
    """Sort the `points` (n, 3) into cubes of this side, or larger ones if there would be too many;
    None makes them so large that there are some three cubes a point at most."""
    low, high = bounds(points)
    extent = float((high - low).max())
    few = max(extent, _ROUNDING) / (1.5 * len(points) ** (1.0 / 3.0))
    side = max(few if side is None else side, extent / (MOST_CELLS - 1))
    shape = ((high - low) / side).astype(np.int64) + 1
    x, y, z = (((points[:, k] - low[k]) / side).astype(np.int64) for k in range(3))
    cell = (x * shape[1] + y) * shape[2] + z
    order = np.argsort(cell, kind="stable")
    first = np.cumsum(np.bincount(cell + 1, minlength=int(shape.prod()) + 1)).astype(np.int32)
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
def near(cells, points, at, reach, indices):
    """Write the indices of the points within `reach` of `at` to `indices` (n,); how many they
    are."""
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
                    indices[count] = k
                    count += 1
    return count


_ALL = np.zeros(0, np.bool_)


class Sorted(NamedTuple):
    """Points (m, 3) in the order of their cells."""

    points: Any
    cells: Cells


def by_cell(points: Floats) -> Sorted:
    """`points` (m, 3), sorted once for however many questions."""
    if not len(points):
        cells, none = cells_of(np.zeros((1, 3)), 1.0), np.zeros(2, np.int32)
        return Sorted(points, cells._replace(first=none, order=cells.order[:0]))
    cells = cells_of(points)
    return Sorted(points[cells.order], cells)


def any_within(among: Sorted, queries: Floats, radius: float, counts: Bools | None = None) -> Bools:
    """Return (n,) whether any of the points lies within `radius` of each query (n, 3); `counts`
    (m,) which of the points, by their places before, do: by default all."""
    which = _ALL if counts is None else counts[among.cells.order]
    return _within(among, queries, radius, True, which) >= 0


def nearest_within(among: Sorted, queries: Floats, radius: float) -> Indices:
    """Return (n,) which of the points, by their places before, is nearest to each query (n, 3)
    within `radius`, or -1; of several equally near one."""
    indices = _within(among, queries, radius, False, _ALL)
    indices[indices >= 0] = among.cells.order[indices[indices >= 0]]
    return indices


@kernel
def _within(among, queries, radius, any_one, counts):  # pragma: no cover - compiled
    """Return (n,) the place among the sorted points of the nearest to each query, or of any, of
    those that count: an empty `counts` is all."""
    points, cells = among.points, among.cells
    nearest, reach = np.full(len(queries), -1, np.int64), radius + _ROUNDING
    for k in range(len(queries)):
        query, best = (queries[k, 0], queries[k, 1], queries[k, 2]), radius * radius
        x_low, x_end = reached(cells, 0, query[0], reach)
        y_low, y_end = reached(cells, 1, query[1], reach)
        z_low, z_end = reached(cells, 2, query[2], reach)
        for x in range(x_low, x_end):
            off = _off(cells, 0, x, query[0])
            for y in range(y_low, y_end):
                if off + _off(cells, 1, y, query[1]) > best:
                    continue
                row = (x * cells.shape[1] + y) * cells.shape[2]
                begin, end = cells.first[row + z_low], cells.first[row + z_end]
                i, d = _nearest(points, begin, end, query, best, counts)
                if i >= 0 and (d < best or nearest[k] < 0):
                    best, nearest[k] = d, i
                if any_one and i >= 0:
                    break
            if any_one and nearest[k] >= 0:
                break
    return nearest


@helper
def _off(cells, axis, cell, at):  # pragma: no cover - compiled
    """Return the squared distance of a coordinate from a slab of cells, and rather less; 0
    inside."""
    low = cells.low[axis] + cell * cells.side
    gap = max(low - at, at - (low + cells.side)) - _ROUNDING
    return gap * gap if gap > 0.0 else 0.0


@inlined
def _nearest(points, first, last, query, most, counts):  # pragma: no cover - compiled
    """Return (i, d): nearest of points[first:last], its squared distance; (-1, most) if too far."""
    nearest, least = -1, most
    for i in range(first, last):
        n = np.uintp(i)  # unsigned: numba does not ask whether to count from the end
        x, y, z = points[n, 0] - query[0], points[n, 1] - query[1], points[n, 2] - query[2]
        d = x * x + y * y + z * z
        if (d < least or (d == least and nearest < 0)) and (len(counts) == 0 or counts[n]):
            nearest, least = i, d
    return nearest, least
