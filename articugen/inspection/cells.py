"""Points in the cells of a grid, so that those near a place are found without looking at all."""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOST_CELLS = 128
"""Along one axis; a grid that fine takes 16 MiB."""


class Cells(NamedTuple):
    """A grid of cubes over the box of some points.

    Attributes:
        low: (3,) the box's lower corner.
        side: of a cube.
        shape: (3,) how many cubes.
        first: cube c, counted with z fastest, holds points first[c] to first[c + 1] of `order`.
        order: (n,) the points' indices, cube by cube.
    """

    low: Array
    side: float
    shape: NDArray[np.int64]
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
    return Cells(low, side, shape, first, np.argsort(cell, kind="stable"))


@numba.njit(cache=True, nogil=True)
def reached(cells, at, reach, low, high):
    """Write to `low` and `high` (3,) where the cubes within `reach` of `at` begin and end."""
    for k in range(3):
        first = int(np.floor((at[k] - reach - cells.low[k]) / cells.side))
        last = int(np.floor((at[k] + reach - cells.low[k]) / cells.side))
        low[k] = min(max(first, 0), cells.shape[k])
        high[k] = max(min(last + 1, cells.shape[k]), low[k])


@numba.njit(cache=True, nogil=True)
def row_of(cells, x, y, low, high):
    """Where the points of cubes (x, y, low) to (x, y, high - 1) begin and end in `order`."""
    row = (x * cells.shape[1] + y) * cells.shape[2]
    return cells.first[row + low], cells.first[row + high]


@numba.njit(cache=True, nogil=True)
def near(cells, points, at, reach, found):
    """Write the indices of the points within `reach` of `at` to `found` (n,); how many they are."""
    count = 0
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    reached(cells, at, reach, low, high)
    for x in range(low[0], high[0]):
        for y in range(low[1], high[1]):
            first, last = row_of(cells, x, y, low[2], high[2])
            for j in cells.order[first:last]:
                squared = (
                    (points[j, 0] - at[0]) ** 2
                    + (points[j, 1] - at[1]) ** 2
                    + (points[j, 2] - at[2]) ** 2
                )
                if squared < reach * reach:
                    found[count] = j
                    count += 1
    return count
