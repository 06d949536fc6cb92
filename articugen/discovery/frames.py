"""The directions that most of an object's faces have, however it is turned: its joints are likely
to lie along them."""

from collections.abc import Sequence

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.geometry import cross, fibonacci_sphere, norm
from articugen.discovery.clouds import Cells, Surface, spacing_of
from articugen.discovery.discover import BESIDE

_POINTS = 4000  # of all clouds
_WAYS = fibonacci_sphere(2000)[:1000]  # a half of them: signs do not count
_ALONG = np.cos(np.radians(6.0))  # normals so near to a direction have it
_LEAST, _MOST, _MORE = 200, 0.4, 1.5
"""The least number of faces along axes, share of all, and ratio to those along x, y and z."""


def frame_of_faces(surfaces: Sequence[Surface]) -> Floats:
    """Return (3, 3) the rotation that lays along x, y and z the three directions across one another
    that most faces of surfaces have; the identity where they lie there, or most faces are round."""
    count = max(_POINTS // len(surfaces), 1)
    normals = np.concatenate([_normals(surface, count) for surface in surfaces])
    often = np.array([(np.abs(normals @ way) > _ALONG).sum() for way in _WAYS])
    first = _mean(_WAYS[often.argmax()], normals)
    across = np.abs(_WAYS @ first) < np.sqrt(1.0 - _ALONG**2)
    third = cross(first, _mean(_WAYS[np.where(across, often, -1).argmax()], normals))
    third /= norm(third)
    axes = np.stack([first, cross(third, first), third])
    many, plain = ((np.abs(normals @ R).max(1) > _ALONG).sum() for R in (axes.T, np.eye(3)))
    leans = np.abs(axes).max(1).min() < BESIDE  # as joints that are taken for plain do not
    enough = max(_LEAST, _MOST * len(normals), _MORE * plain)
    return axes if leans and many > enough else np.eye(3)


def _normals(surface: Surface, count: int) -> Floats:
    """Return (m, 3) the normals of some points; where none is known, those, of either sign, of
    points that lie in a plane."""
    some = surface[:: max(len(surface) // count, 1)]
    if surface.signed:
        return some.normals
    size = 2.0 * max(float(np.ptp(surface.points, axis=0).max()), 1e-12)
    middle = surface.points.mean(0)
    points, few = ((one.points - middle) / size for one in (surface, some))
    cells = Cells.of([Surface.bare(points)])
    normals = Surface.bare(few).shaped(cells, spacing_of(points, cells)).normals
    return normals[norm(normals) > 0.5]


def _mean(way: Floats, normals: Floats) -> Floats:
    """Return the mean of a direction and of normals about it."""
    along = normals @ way
    mean = way + (np.sign(along) * (np.abs(along) > _ALONG)) @ normals
    return mean / norm(mean)
