"""Labels of points and voxels as other formats count them."""

import numpy as np
from numpy.typing import NDArray

from articugen.core.records import ENCLOSED, FREE, is_material
from articugen.export.items import LeftOut, Options
from articugen.store.rows import Row


def inside(label: NDArray[np.uint8], options: Options) -> NDArray[np.bool_]:
    """Return where something is, by the chosen occupancy."""
    return label != FREE if options.occupancy == "visible" else is_material(label)


def part_values(label: NDArray[np.uint8], options: Options) -> NDArray[np.uint8]:
    """0 outside, k + 1 in part k; enclosed space, if it counts as inside, is part 0's."""
    enclosed = 1 if options.occupancy == "visible" else FREE
    return np.where(label == ENCLOSED, np.uint8(enclosed), label)


def grid(row: Row, resolution: int) -> NDArray[np.uint8]:
    """Return the labels of a stored grid.

    Raises:
        LeftOut: it is not stored.
    """
    if resolution not in row.grids:
        raise LeftOut(
            f"{row.object_id}: a grid of {resolution}^3 is not stored; make the data with "
            f"sampling.grids that has {resolution}"
        )
    return row.grids[resolution]


def need(row: Row, what: str, count: int) -> None:
    """
    Raises:
        LeftOut: fewer than `count` points of "surface", "uniform", "near" or "partial" are stored.
    """
    there = len(getattr(row, what))
    if there < count:
        raise LeftOut(
            f"{row.object_id}: {there} {what} points are stored, of which {count} are needed; make "
            f"the data with more of them"
        )
