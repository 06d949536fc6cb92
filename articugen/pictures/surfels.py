"""Pictures of labelled surface points: each point is drawn as a small lit disc (a surfel).

A shard holds points with normals, not triangles, so the picture shows just what was stored.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bytes, Floats, Ints
from articugen.core.jit import ahead, cross, dot, helper, kernel, squared, vector
from articugen.core.near import cells_of, near
from articugen.pictures.light import SurfaceCloud

NEIGHBOURS = 14
"""The spacing of the points, and how far a disc must reach so that random gaps between them close,
is judged by the distance to the neighbour of this rank: about 2.1 spacings on a plane."""

DIRECTIONS = 8  # in so many directions it is asked where the face of a disc ends
_ANGLES = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
TURNS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)

BEYOND = 0.4  # the edge of a face lies beyond its last point, by so many spacings as a rule
SAME_FACE = np.cos(np.radians(25.0))
"""Normals that differ by less belong to one face, others to two that meet in an edge."""


@dataclass(frozen=True, eq=False)
class OrientedPoints:
    """Points on a surface, uniform over it: `points` (n, 3), unit `normals` (n, 3), `part` (n,)."""

    points: Floats
    normals: Floats
    part: Bytes

    def moved(self, T_part: Floats) -> "OrientedPoints":
        """Return each part's points moved by its own rigid motion; `T_part` (P, 4, 4)."""
        points = _turned(T_part, self.points, self.part) + T_part[self.part, :3, 3]
        return OrientedPoints(points, _turned(T_part, self.normals, self.part), self.part)

    def spacing(self) -> float:
        """Return the side of the square that each point stands for."""
        rank = min(NEIGHBOURS, len(self.points) - 1)
        indices = np.linspace(0, len(self.points) - 1, min(64, len(self.points))).astype(np.int64)
        # On a plane, rank = pi * distance^2 / spacing^2.
        away = _distance_of_rank(self.points, self.normals, self.part, indices, rank)
        return float(np.median(away) * np.sqrt(np.pi / rank))


@dataclass(frozen=True, eq=False)
class Surfels:
    """Oriented discs.

    Attributes:
        points, normals: (n, 3), unit frame.
        part: (n,).
        spacing: (n,) the side of the square that each point stands for.
        radius: (n,) of the discs.
        clip_ends: (n, 2) where each disc's part of `clip` begins and ends.
        clip: for every disc the neighbours across a convex edge; it ends at their planes.
        across: (n, 3) a unit direction in each disc's plane.
        reach: (n, DIRECTIONS) how far each goes in even directions in its plane, from `across` on:
            not beyond the last point of its face that way.
    """

    points: Floats
    normals: Floats
    part: Bytes
    spacing: Floats
    radius: Floats
    clip_ends: Ints
    clip: NDArray[np.int32]
    across: Floats
    reach: Floats

    @property
    def cloud(self) -> SurfaceCloud:
        return SurfaceCloud(self.points, self.normals, self.spacing**2)

    def moved(self, T_part: Floats) -> "Surfels":
        """Return each part's discs moved by its own rigid motion; `T_part` (P, 4, 4).

        A disc's edges depend on discs of its own part only, so they move with it.
        """
        return replace(
            self,
            points=_turned(T_part, self.points, self.part) + T_part[self.part, :3, 3],
            normals=_turned(T_part, self.normals, self.part),
            across=_turned(T_part, self.across, self.part),
        )


def _turned(T_part: Floats, vectors: Floats, part: Bytes) -> Floats:
    """`vectors` (n, 3), each turned by the rotation of its part's `T_part` (P, 4, 4)."""
    return np.einsum("nij,nj->ni", T_part[part, :3, :3], vectors)


@helper
def is_beyond(a, b, reach, i):
    """Return whether a place `a` along a disc's `across` and `b` along the other axis is out of
    reach."""
    for k in range(DIRECTIONS):  # noqa: SIM110 (numba compiles no any)
        if TURNS[k, 0] * a + TURNS[k, 1] * b > reach[i, k]:
            return True
    return False


def surfels(samples: Sequence[OrientedPoints]) -> Surfels:
    """Discs for some samples of one surface, each uniform over as much of it as it covers."""
    spacing = float(np.median([sample.spacing() for sample in samples]))
    points, normals, part = (
        np.concatenate([getattr(sample, name) for sample in samples])
        for name in ("points", "normals", "part")
    )
    source = np.repeat(np.arange(len(samples)), [len(sample.points) for sample in samples])
    order = cells_of(points, spacing).order  # neighbours in space are neighbours in memory
    points, normals, part, source = points[order], normals[order], part[order], source[order]
    cells = cells_of(points, spacing)
    covers = _covers(points, normals, part, source, len(samples), cells, spacing)
    local = spacing / np.sqrt(covers)
    cells = cells_of(points, 3.0 * float(np.median(local)))
    least = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    across = np.cross(normals, least)
    across = across / np.linalg.norm(across, axis=1, keepdims=True)
    radius, ends, clip, reach = _outline(points, normals, across, part, local, cells, NEIGHBOURS)
    return Surfels(points, normals, part, local, radius, ends, clip, across, reach)


@kernel
def _distance_of_rank(points, normals, part, wanted, rank):
    """From each point asked for, to its neighbour of this rank on the same side of its part."""
    distances = np.empty(len(wanted))
    nearest = np.empty(rank + 1)
    for s in range(len(wanted)):
        i = wanted[s]
        at, normal = vector(points, i), vector(normals, i)
        nearest[:] = 3.0
        for j in range(len(points)):
            away = squared(at, vector(points, j))
            is_alike = part[j] == part[i] and dot(normal, vector(normals, j)) > SAME_FACE
            if away < nearest[rank] and is_alike:
                _insert(nearest, away)
        distances[s] = np.sqrt(nearest[rank])
    return distances


@helper
def _insert(least, number):
    """Put a number among the least ones so far, in ascending order, in place of the largest."""
    place = len(least) - 1
    while place > 0 and least[place - 1] > number:
        least[place] = least[place - 1]
        place -= 1
    least[place] = number


@kernel
def _covers(points, normals, part, source, sources, cells, reach):
    """Return how many of the samples cover the surface at each point, (n,).

    If m of them do, two points from there are of one sample with probability 1 / m, so pairs that
    are give m, however small the face is (as equal birthdays give the length of the year).
    """
    covers = np.empty(len(points))
    counts = np.empty(len(points), np.int64)
    count = np.empty(sources)
    for i in range(len(points)):
        count[:] = 0.0
        normal = vector(normals, i)
        for n in range(near(cells, points, vector(points, i), reach, counts)):
            j = counts[n]
            if part[j] == part[i] and dot(normal, vector(normals, j)) > SAME_FACE:
                count[source[j]] += 1.0
        total = alike = 0.0
        for s in range(sources):
            total += count[s]
            alike += count[s] * (count[s] - 1.0)
        covers[i] = min(max(total * (total - 1.0) / max(alike, 1.0), 1.0), sources)
    return covers


@kernel
def _outline(points, normals, across, part, spacing, cells, rank):
    """Return the radius of each disc, the neighbours across a convex edge in one list, and its
    reach.

    The radius is the distance to the neighbour of the given rank on the same face, or two spacings
    where there are fewer. Neighbour j bounds disc i where each lies behind the other and the
    face of i does not go on beyond j; one neighbour a plane is enough. In no direction does a disc
    go on far beyond the last point of its face: where a face ends at a plate too thin to be
        distinguished
    from it, or beside one that nobody sees, nothing else would keep the disc from sticking out.
    """
    radius = np.empty(len(points))
    reaches = np.empty((len(points), DIRECTIONS))
    ends = np.empty((len(points), 2), np.int64)
    clip, clipped = np.empty(len(points), np.int32), 0
    neighbours = np.empty(len(points), np.int64)
    others = np.empty(len(points), np.int32)
    face = np.empty(len(points), np.int32)
    nearest = np.empty(rank + 1)
    for i in range(len(points)):
        at, normal, side = vector(points, i), vector(normals, i), vector(across, i)
        radius[i] = 2.0 * spacing[i]
        reach, slack = 3.0 * spacing[i], 0.15 * spacing[i]
        behind = level = 0
        nearest[:] = np.inf
        for n in range(near(cells, points, at, 1.5 * reach, neighbours)):
            j = neighbours[n]
            if part[j] != part[i]:
                continue
            before = ahead(vector(points, j), at, normal)
            alike = dot(normal, vector(normals, j)) > SAME_FACE
            if alike and abs(before) < slack:
                face[level] = j
                level += 1
                away = squared(at, vector(points, j))
                if away < nearest[rank]:
                    _insert(nearest, away)
            elif not alike and -2.0 * spacing[i] < before < 0.0:
                others[behind] = j
                behind += 1
        if level > rank:
            radius[i] = min(np.sqrt(nearest[rank]), reach)
        ends[i, 0] = clipped
        for n in range(behind):
            j = others[n]
            bound, facing = vector(points, j), vector(normals, j)
            gap = -ahead(at, bound, facing)
            below = ahead(bound, at, normal)
            wide = np.sqrt(reach * reach + below * below)  # as much of i's plane for any depth
            if (
                0.0 < gap < radius[i]
                and not _is_known(points, normals, clip, ends[i, 0], clipped, bound, facing, slack)
                and not _goes_on(points, face, level, bound, facing, wide, slack)
            ):
                if clipped == len(clip):
                    clip = _longer(clip)
                clip[clipped] = j
                clipped += 1
        ends[i, 1] = clipped
        up = cross(normal, side)
        for k in range(DIRECTIONS):
            way = _direction(side, up, k)
            reaches[i, k] = np.inf
            if not _is_bounded(normals, clip, ends[i, 0], clipped, way):
                last = _last(points, face, level, at, radius[i], way)
                reaches[i, k] = last + BEYOND * spacing[i]
    return radius, ends, clip[:clipped], reaches


@helper
def _longer(numbers):
    """Return the numbers, with room for as many more; numba's own ways take seconds to compile."""
    longer = np.empty(2 * len(numbers), np.int32)
    for n in range(len(numbers)):
        longer[n] = numbers[n]
    return longer


@helper
def _direction(across, up, k):
    """Return k-th of DIRECTIONS even directions in a disc's plane, from `across` towards `up`."""
    c, s = TURNS[k, 0], TURNS[k, 1]
    return c * across[0] + s * up[0], c * across[1] + s * up[1], c * across[2] + s * up[2]


@helper
def _is_bounded(normals, planes, first, end, way):
    """Return whether one of the planes ends what goes this way."""
    for n in range(first, end):  # noqa: SIM110 (numba compiles no any)
        if dot(vector(normals, planes[n]), way) > 0.7:
            return True
    return False


@helper
def _last(points, face, count, center, radius, way):
    """Return how far the points of a face within `radius` of `center` reach this way."""
    last = 0.0
    for n in range(count):
        point = vector(points, face[n])
        if squared(center, point) < radius * radius:
            last = max(last, ahead(point, center, way))
    return last


@helper
def _is_known(points, normals, planes, first, end, at, normal, slack):
    """Return whether one of the planes is that through `at`."""
    for n in range(first, end):
        k = planes[n]
        facing = vector(normals, k)
        if abs(ahead(at, vector(points, k), facing)) < slack and dot(normal, facing) > 0.99:
            return True
    return False


@helper
def _goes_on(points, face, count, origin, normal, near, slack):
    """Return whether a face goes on in front of a plane, nearby."""
    for n in range(count):
        point = vector(points, face[n])
        if squared(point, origin) < near * near and ahead(point, origin, normal) > slack:
            return True
    return False
