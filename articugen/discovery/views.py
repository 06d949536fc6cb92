"""What depth cameras see of an object's poses, and through which places they see."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from articugen.core.arrays import Bools, Floats
from articugen.core.geometry import apply, look_along

PIXELS = 96
"""Along the longer edge of what a camera sees; fewer where a cloud has few points: most pixels
should have one in them or beside them."""

_BEFORE = 0.015  # what lies so far before the nearest that is seen is free, in the cube


@dataclass(frozen=True, eq=False)
class Sight:
    """Images of K cameras that point at the middle of their clouds. A pixel has the nearest depth
    that it or one beside it sees, infinity where they see nothing of the object.

    Attributes:
        T: (K, 4, 4) from the clouds' frame into the cameras'.
        low, pixel: (K, 2) the images' corners and (K, 1) their pixels' edges, at depth 1.
        depth: (K, PIXELS + 2, PIXELS + 2), with a border of nothing around each.
    """

    T: Floats
    low: Floats
    pixel: Floats
    depth: Floats

    @staticmethod
    def of(clouds: Sequence[Floats], eyes: Floats) -> "Sight":
        """Return those of clouds (n_k, 3), seen from `eyes` (K, 3)."""
        images = [_image(cloud, eye) for cloud, eye in zip(clouds, eyes, strict=True)]
        return Sight(*(np.array(values) for values in zip(*images, strict=True)))

    def __getitem__(self, which: Any) -> "Sight":
        return Sight(*(values[which] for values in vars(self).values()))

    def free(self, points: Floats) -> Bools:
        """Return (K, n) where each camera sees through, of points (n, 3) or of (K, n, 3)."""
        of_each = np.broadcast_to(points, (len(self.T), *points.shape[-2:]))
        free = np.empty(of_each.shape[:2], np.bool_)
        for k, (cloud, T) in enumerate(zip(of_each, self.T, strict=True)):
            at, far = _projected(T, cloud)
            pixel = _pixels(at, self.low[k], self.pixel[k])
            free[k] = self.depth[k][pixel] > far + _BEFORE
        return free


def _image(cloud: Floats, eye: Floats) -> tuple[Floats, ...]:
    """Return the attributes of one camera."""
    T = look_along(cloud.mean(0) - eye, eye)
    at, far = _projected(T, cloud)
    low, edge = at.min(0), float(np.ptp(at, axis=0).max())
    pixel = np.array([1.001 * max(edge, 1e-9) / np.clip(1.5 * np.sqrt(len(cloud)), 16, PIXELS)])
    nearest = np.full((PIXELS + 2, PIXELS + 2), np.inf)
    np.minimum.at(nearest, _pixels(at, low, pixel), far)
    depth = nearest.copy()
    for i, j in np.ndindex(3, 3):
        depth = np.minimum(depth, np.roll(nearest, (i - 1, j - 1), (0, 1)))
    return T, low, pixel, depth


def _projected(T: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Return (n, 2) where points are in an image at depth 1, and (n,) their depth."""
    there = apply(T, points)
    far = np.maximum(there[:, 2], 1e-9)
    return there[:, :2] / far[:, None], far


def _pixels(at: Floats, low: Floats, pixel: Floats) -> tuple[Any, ...]:
    """Return the pixels of places in an image; what is outside counts to the border."""
    return tuple(np.clip(np.floor((at - low) / pixel) + 1, 0, PIXELS + 1).astype(np.intp).T)
