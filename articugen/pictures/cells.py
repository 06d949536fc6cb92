"""Points in the cells of a grid, so that those near a place are found without looking at all."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from articugen.core.jit import helper

Array = NDArray[np.float64]

MOST_CELLS = 128
"""Along one axis; a grid that fine takes 16 MiB."""


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
    first: NDArray[np.int64]
    order: NDArray[np.int64]


def cells_of(points: Array, side: float) -> Cells:
    """The `points` (n, 3) in cubes of this side, or larger ones if there would be too many."""
    low, high = points.min(axis=0), points.max(axis=0)
    side = max(side, float((high - low).max()) / (MOST_CELLS - 1))
    shape = ((high - low) / side).astype(np.int64) + 1
    x, y, z = ((points - low) / side).astype(np.int64).T
    cell = (x * shape[1] + y) * shape[2] + z
    first = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=int(shape.prod())))])
    corner, cubes = (float(low[0]), float(low[1]), float(low[2])), tuple(int(n) for n in shape)
    return Cells(corner, side, cubes, first, np.argsort(cell, kind="stable"))  # type: ignore[arg-type]


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
