"""Where the cameras stand: spread over the sphere for fusion, at random for partial clouds."""

from functools import lru_cache

import numpy as np

from articugen.core.arrays import Floats, Indices
from articugen.core.geometry import box_corners, fibonacci_sphere, look_along
from articugen.core.portable import cos, dot, norm, sin, turned
from articugen.core.recipe import ViewSettings
from articugen.core.records import Views

MARGIN = 2.0  # pixels between the object and the image's border: what projects outside is seen free
PINHOLE_DISTANCE = 1.5
"""Distance of pinhole cameras from the centre of the box, in the unit frame. Occupancy Networks'
1.0 leaves parts of a cube's faces outside the image; from 1.3 on nothing is lost."""


FIELD_OF_VIEW = np.radians(40.0)  # of the cameras of images, from edge to edge


def spread_order(directions: Floats) -> Indices:
    """Return an order of unit directions (K, 3) in which each is as far as can be from those before
    it.

    Views that come early then look from all around, so that most free points are seen free by one
    of the first few.
    """
    order = np.zeros(len(directions), np.intp)
    nearest = dot(directions, directions[0])
    for n in range(1, len(directions)):
        order[n] = np.argmin(nearest)
        nearest = np.maximum(nearest, dot(directions, directions[order[n]]))
    return order


def fusion_views(settings: ViewSettings, box: Floats) -> Views:
    """`settings.count` views evenly over the sphere, each fitted to the corners of `box`.

    Args:
        box: (2, 3) lower and upper corner, unit frame, of all that will be drawn.
    """
    directions = _all_around(settings.count)
    center = box.mean(axis=0)
    back = 0.0 if settings.projection == "orthographic" else PINHOLE_DISTANCE
    T = look_along(directions, center - back * directions)
    return fitted(settings.projection, T, box, settings.resolution, settings.resolution)


@lru_cache
def _all_around(count: int) -> Floats:
    """Return (count, 3) unit directions evenly over the sphere, in `spread_order`."""
    directions = fibonacci_sphere(count)
    directions = directions[spread_order(directions)]
    directions.setflags(write=False)
    return directions


def fitted(projection: str, T_camera_world: Floats, box: Floats, w: int, h: int) -> Views:
    """Views from the given cameras whose images the box (2, 3) just fills, `MARGIN` left free."""
    rotation, offset = T_camera_world[:, None, :3, :3], T_camera_world[:, None, :3, 3]
    x, y, z = np.moveaxis(turned(rotation, box_corners(box)) + offset, -1, 0)
    if projection == "pinhole":
        x, y = x / z, y / z
    fx, cx = _fit(x, w)
    fy, cy = _fit(y, h)
    return Views(projection, T_camera_world, fx, fy, cx, cy, w, h)  # type: ignore[arg-type]


def _fit(x: Floats, size: int) -> tuple[Floats, Floats]:
    low, high = x.min(axis=1), x.max(axis=1)
    focal = (size - 2.0 * MARGIN) / np.maximum(high - low, 1e-6)
    return focal, size / 2.0 - focal * (low + high) / 2.0


def random_pinhole_views(
    count: int, resolution: int, box: Floats, *, rng: np.random.Generator
) -> Views:
    """`count` pinhole cameras that see the box from random sides, as a depth camera would.

    Directions are uniform over the sphere, distances from the centre uniform in 1.2 to 2.0 of the
    unit frame; the field of view is just wide enough for the box.
    """
    center = box.mean(axis=0)
    directions = rng.normal(size=(count, 3))
    directions /= norm(directions)[:, None]
    distances = rng.uniform(1.2, 2.0, size=count)
    T = look_along(-directions, center + distances[:, None] * directions)
    return fitted("pinhole", T, box, resolution, resolution)


def plain_pinhole_views(
    count: int,
    resolution: int,
    box: Floats,
    *,
    rng: np.random.Generator,
    nearest: float = 1.0,
    still: Floats | None = None,
) -> Views:
    """`count` pinhole cameras alike, as image-based learners take them: square pixels, the optical
    axis through the middle of the image, `FIELD_OF_VIEW` wide.

    Directions are uniform over the upper half of the sphere around what they aim at: the middle of
    the box. With a point `still` (3,) it is a point uniform in the middle half of the box or, for
    those that would not see it, `still`. Distances are uniform from `nearest` to 1.2 times where
    the sphere around the box just fits the image.
    """
    center = box.mean(axis=0)
    directions = rng.normal(size=(count, 3))
    directions /= norm(directions)[:, None]
    directions[:, 2] = np.abs(directions[:, 2])
    fitting = 0.5 * float(norm(box[1] - box[0])) / float(sin(0.5 * FIELD_OF_VIEW))
    distances = fitting * rng.uniform(nearest, 1.2, size=count)
    if still is not None:
        center = center + rng.uniform(-0.25, 0.25, size=(count, 3)) * (box[1] - box[0])
        to_it = still - (center + distances[:, None] * directions)
        least = norm(to_it) * float(cos(0.5 * FIELD_OF_VIEW))
        center = np.where((dot(to_it, -directions) > least)[:, None], center, still)
    T = look_along(-directions, center + distances[:, None] * directions)
    focal = np.full(
        count, 0.5 * resolution * float(cos(0.5 * FIELD_OF_VIEW) / sin(0.5 * FIELD_OF_VIEW))
    )
    middle = np.full(count, 0.5 * resolution)
    return Views("pinhole", T, focal, focal, middle, middle, resolution, resolution)
