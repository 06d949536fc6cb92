"""Labels of points and voxels as other formats count them, and what depth cameras see."""

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bools, Bytes
from articugen.core.geometry import apply
from articugen.core.records import ENCLOSED, FREE, is_material
from articugen.export.items import LeftOut, Options
from articugen.store.rows import Row


def inside(label: Bytes, options: Options) -> Bools:
    """Return where something is, by the chosen occupancy."""
    return label != FREE if options.occupancy == "visible" else is_material(label)


def part_values(label: Bytes, options: Options) -> Bytes:
    """0 outside, k + 1 in part k; enclosed space, if it counts as inside, is part 0's."""
    enclosed = 1 if options.occupancy == "visible" else FREE
    return np.where(label == ENCLOSED, np.uint8(enclosed), label)


def grid(row: Row, resolution: int) -> Bytes:
    """Return the labels of a stored grid; LeftOut where it is not stored."""
    if resolution not in row.grids:
        raise LeftOut(
            f"{row.object_id}: a grid of {resolution}^3 is not stored; make the data with "
            f"sampling.grids that has {resolution}"
        )
    return row.grids[resolution]


def need(row: Row, what: str, count: int) -> None:
    """Raise LeftOut for fewer than `count` stored points of surface, uniform, near or partial."""
    there = len(getattr(row, what))
    if there < count:
        raise LeftOut(
            f"{row.object_id}: {there} {what} points are stored, of which {count} are needed; make "
            f"the data with more of them"
        )


def seen(row: Row, camera: int) -> tuple[NDArray[np.float32], Bytes]:
    """Return (points (M, 3) in the camera's frame, x right, y down, z forward; the part (M,) of
    each)."""
    points = row.partial.points[camera].astype(np.float64)
    points = apply(row.partial.T_camera_world[camera], points)
    return points.astype(np.float32), row.partial.part[camera]
