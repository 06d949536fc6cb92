"""What depth cameras see, in their own frames."""

import numpy as np
from numpy.typing import NDArray

from articugen.core.geometry import apply
from articugen.store.rows import Row


def seen(row: Row, camera: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """(points (M, 3) in the camera's frame, x right, y down, z forward; the part (M,) of each)."""
    T_camera_unit = row.partial.T_camera_world[camera]
    points = apply(T_camera_unit, row.partial.points[camera].astype(np.float64))
    return points.astype(np.float32), row.partial.part[camera]


def camera_count(row: Row) -> int:
    return len(row.partial.T_camera_world)
