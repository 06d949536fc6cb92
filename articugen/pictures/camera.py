"""A pinhole camera that an object fills the picture of."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.geometry import apply, invert_rigid, look_along


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera: `T_camera_world` (4, 4), focal length and principal point in pixels.

    Axes as in `records.Views`; images are `size` pixels wide and high.
    """

    T_camera_world: Floats
    focal: float
    cx: float
    cy: float
    size: int

    @cached_property
    def rays(self) -> Floats:
        """(size, size, 3) world directions through the pixels' centres, of unit depth."""
        at = np.arange(self.size) + 0.5
        x, y = np.meshgrid((at - self.cx) / self.focal, (at - self.cy) / self.focal)
        T_world_camera = invert_rigid(self.T_camera_world)
        return apply(T_world_camera, np.stack([x, y, np.ones_like(x)], axis=-1)) - self.eye

    @property
    def eye(self) -> Floats:
        return -self.T_camera_world[:3, :3].T @ self.T_camera_world[:3, 3]


def direction(azimuth: float, elevation: float) -> Floats:
    """Return (3,) the unit vector that points there; rad."""
    flat = np.cos(elevation)
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def framed(points: Floats, azimuth: float, elevation: float, size: int, *, fill: float) -> Camera:
    """Return the camera at `azimuth`, `elevation` (rad) whose square image `points` (n, 3) fill.

    `fill` is the fraction of the width or height that their box takes, the larger of the two.
    """
    toward_eye = direction(azimuth, elevation)
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    away = max(3.5, 2.0 * np.ptp(points, axis=0).max())  # before all of them, however far they lie
    T_camera_world = look_along(-toward_eye, middle + away * toward_eye)
    in_camera = apply(T_camera_world, points)
    flat = in_camera[:, :2] / in_camera[:, 2:]
    low, high = flat.min(axis=0), flat.max(axis=0)
    focal = fill * size / (high - low).max()
    cx, cy = 0.5 * size - focal * 0.5 * (low + high)
    return Camera(T_camera_world, focal, cx, cy, size)
