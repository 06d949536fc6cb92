"""Pictures of labelled surface points: each point is drawn as a small lit disc (a surfel).

A shard holds points with normals, not triangles, so the picture shows just what was stored.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from articugen.core.geometry import apply
from articugen.core.jit import helper, kernel
from articugen.pictures.camera import Camera
from articugen.pictures.cells import cells_of, near
from articugen.pictures.light import SurfaceCloud

Array = NDArray[np.float64]

NEIGHBOURS = 14
"""The spacing of the points, and how far a disc must reach so that random gaps between them close,
is judged by the distance to the neighbour of this rank: about 2.1 spacings on a plane."""

DIRECTIONS = 8
"""In so many directions it is asked where the face of a disc ends."""

_ANGLES = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
_TURNS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)

BEYOND = 0.4
"""The edge of a face lies beyond its last point, by so many spacings as a rule."""

MOST_AROUND = 15
"""A pixel lies in a gap where so many of the 24 around it are nearer."""

SAME_FACE = np.cos(np.radians(25.0))
"""Normals that differ by less belong to one face, others to two that meet in an edge."""


@dataclass(frozen=True, eq=False)
class OrientedPoints:
    """Points on a surface, uniform over it: `points` (n, 3), unit `normals` (n, 3), `part` (n,)."""

    points: Array
    normals: Array
    part: NDArray[np.uint8]

    def moved(self, T_part: Array) -> "OrientedPoints":
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

    points: Array
    normals: Array
    part: NDArray[np.uint8]
    spacing: Array
    radius: Array
    clip_ends: NDArray[np.int64]
    clip: NDArray[np.int32]
    across: Array
    reach: Array

    @property
    def cloud(self) -> SurfaceCloud:
        return SurfaceCloud(self.points, self.normals, self.spacing**2)

    def moved(self, T_part: Array) -> "Surfels":
        """Return each part's discs moved by its own rigid motion; `T_part` (P, 4, 4).

        A disc's edges depend on discs of its own part only, so they move with it.
        """
        return replace(
            self,
            points=_turned(T_part, self.points, self.part) + T_part[self.part, :3, 3],
            normals=_turned(T_part, self.normals, self.part),
            across=_turned(T_part, self.across, self.part),
        )


def _turned(T_part: Array, vectors: Array, part: NDArray[np.uint8]) -> Array:
    """`vectors` (n, 3), each turned by the rotation of its part's `T_part` (P, 4, 4)."""
    return np.einsum("nij,nj->ni", T_part[part, :3, :3], vectors)


def surfels(samples: Sequence[OrientedPoints]) -> Surfels:
    """Discs for some samples of one surface, each uniform over as much of it as it covers."""
    spacing = float(np.median([sample.spacing() for sample in samples]))
    points = np.concatenate([sample.points for sample in samples])
    normals = np.concatenate([sample.normals for sample in samples])
    part = np.concatenate([sample.part for sample in samples])
    source = np.repeat(np.arange(len(samples)), [len(sample.points) for sample in samples])
    order = cells_of(points, spacing).order  # neighbours in space are neighbours in memory
    points, normals, part, source = points[order], normals[order], part[order], source[order]
    cells = cells_of(points, spacing)
    covers = _covers(points, normals, part, source, len(samples), cells, spacing)
    local = spacing / np.sqrt(covers)
    cells = cells_of(points, 3.0 * float(np.median(local)))
    across = _across(normals)
    radius, ends, clip, reach = _outline(points, normals, across, part, local, cells, NEIGHBOURS)
    return Surfels(points, normals, part, local, radius, ends, clip, across, reach)


def _across(normals: Array) -> Array:
    """Return a unit direction at right angles to each of `normals` (n, 3)."""
    least = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    across = np.cross(normals, least)
    return across / np.linalg.norm(across, axis=1, keepdims=True)


def draw(discs: Surfels, values: Array, camera: Camera) -> tuple[Array, Array, Array]:
    """Return the discs as a camera sees them.

    Args:
        values: (n, C) what to interpolate between the discs, for instance colours.

    Returns:
        Depth (H, W), inf where nothing is; unit normals (H, W, 3); values (H, W, C).
    """
    facing = ((camera.eye - discs.points) * discs.normals).sum(axis=1) > 0.0
    center = apply(camera.T_camera_world, discs.points)
    normals = apply(camera.T_camera_world, discs.points + discs.normals) - center
    extent = discs.radius[:, None] * np.sqrt(np.maximum(1.0 - normals**2, 0.0))
    # |(x + dx) / (z + dz) - x / z| where |dx|, |dz| are at most the extents.
    z, nearest = center[:, 2:], (center - extent)[:, 2:]
    flat = center[:, :2] / z
    reach = camera.focal * (extent[:, :2] + np.abs(flat) * extent[:, 2:]) / nearest
    middle = camera.focal * flat + (camera.cx, camera.cy)
    box = np.stack([np.floor(middle - reach), np.ceil(middle + reach) + 1], axis=2)
    size, rays = (camera.size, camera.size), camera.rays
    depth, weight = np.full(size, np.inf), np.full(size, 1e-30)
    blended = np.zeros((*size, 3 + values.shape[1]))
    _splat(
        discs.points,
        discs.normals,
        discs.radius,
        discs.clip_ends,
        discs.clip,
        discs.across,
        discs.reach,
        np.concatenate([discs.normals, values], axis=1),
        np.flatnonzero(facing)[np.argsort(z[facing, 0])],
        np.clip(box, 0, camera.size).astype(np.int64),
        np.stack([rays[0, 0], rays[0, 1] - rays[0, 0], rays[1, 0] - rays[0, 0]]),
        camera.eye,
        discs.spacing,
        depth,
        blended,
        weight,
    )
    blended /= weight[..., None]
    for _ in range(2):
        _close(depth, blended, 2.0 * float(np.median(discs.spacing)))
    length = np.linalg.norm(blended[..., :3], axis=-1, keepdims=True)
    return depth, blended[..., :3] / np.maximum(length, 1e-12), blended[..., 3:]


@kernel
def _distance_of_rank(points, normals, part, asked, rank):
    """From each point asked for, to its neighbour of this rank on the same side of its part."""
    distances = np.empty(len(asked))
    nearest = np.empty(rank + 1)
    for s in range(len(asked)):
        i = asked[s]
        at, normal = _row(points, i), _row(normals, i)
        nearest[:] = 3.0
        for j in range(len(points)):
            squared = _squared(at, _row(points, j))
            if (
                squared < nearest[rank]
                and part[j] == part[i]
                and _dot(normal, _row(normals, j)) > SAME_FACE
            ):
                _insert(nearest, squared)
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
    are tell m, however small the face is (as equal birthdays tell the length of the year).
    """
    covers = np.empty(len(points))
    found = np.empty(len(points), np.int64)
    count = np.empty(sources)
    for i in range(len(points)):
        for s in range(sources):
            count[s] = 0.0
        normal = _row(normals, i)
        for n in range(near(cells, points, _row(points, i), reach, found)):
            j = found[n]
            if part[j] == part[i] and _dot(normal, _row(normals, j)) > SAME_FACE:
                count[source[j]] += 1.0
        total = alike = 0.0
        for s in range(sources):
            total += count[s]
            alike += count[s] * (count[s] - 1.0)
        covers[i] = min(max(total * (total - 1.0) / max(alike, 1.0), 1.0), sources)
    return covers


@kernel
def _outline(points, normals, across, part, spacing, cells, rank):
    """The radius of each disc, the neighbours across a convex edge in one list, and its reach.

    The radius is the distance to the neighbour of the given rank on the same face, or two spacings
    where so many are not there. Neighbour j bounds disc i where each lies behind the other and the
    face of i does not go on beyond j; one neighbour a plane is enough. In no direction does a disc
    go on far beyond the last point of its face: where a face ends at a plate too thin to be told
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
        at, normal, side = _row(points, i), _row(normals, i), _row(across, i)
        radius[i] = 2.0 * spacing[i]
        reach, slack = 3.0 * spacing[i], 0.15 * spacing[i]
        behind = level = 0
        nearest[:] = np.inf
        for n in range(near(cells, points, at, 1.5 * reach, neighbours)):
            j = neighbours[n]
            if part[j] != part[i]:
                continue
            ahead = _ahead(_row(points, j), at, normal)
            alike = _dot(normal, _row(normals, j)) > SAME_FACE
            if alike and abs(ahead) < slack:
                face[level] = j
                level += 1
                squared = _squared(at, _row(points, j))
                if squared < nearest[rank]:
                    _insert(nearest, squared)
            elif not alike and -2.0 * spacing[i] < ahead < 0.0:
                others[behind] = j
                behind += 1
        if level > rank:
            radius[i] = min(np.sqrt(nearest[rank]), reach)
        ends[i, 0] = clipped
        for n in range(behind):
            j = others[n]
            bound, facing = _row(points, j), _row(normals, j)
            gap = -_ahead(at, bound, facing)
            below = _ahead(bound, at, normal)
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
        up = _cross(normal, side)
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
def _row(vectors, i):
    """Three numbers, which cost nothing to hand on."""
    return vectors[i, 0], vectors[i, 1], vectors[i, 2]


@helper
def _direction(across, up, k):
    """The k-th of DIRECTIONS even directions in a disc's plane, from `across` towards `up`."""
    c, s = _TURNS[k, 0], _TURNS[k, 1]
    return c * across[0] + s * up[0], c * across[1] + s * up[1], c * across[2] + s * up[2]


@helper
def _is_bounded(normals, planes, first, end, way):
    """Return whether one of the planes ends what goes this way."""
    for n in range(first, end):  # noqa: SIM110 (numba compiles no any)
        if _dot(_row(normals, planes[n]), way) > 0.7:
            return True
    return False


@helper
def _last(points, face, count, center, radius, way):
    """Return how far the points of a face within `radius` of `center` reach this way."""
    last = 0.0
    for n in range(count):
        point = _row(points, face[n])
        if _squared(center, point) < radius * radius:
            last = max(last, _ahead(point, center, way))
    return last


@helper
def _is_known(points, normals, planes, first, end, at, normal, slack):
    """Return whether one of the planes is that through `at`."""
    for n in range(first, end):
        k = planes[n]
        facing = _row(normals, k)
        if abs(_ahead(at, _row(points, k), facing)) < slack and _dot(normal, facing) > 0.99:
            return True
    return False


@helper
def _goes_on(points, face, count, origin, normal, near, slack):
    """Return whether a face goes on in front of a plane, nearby."""
    for n in range(count):
        point = _row(points, face[n])
        if _squared(point, origin) < near * near and _ahead(point, origin, normal) > slack:
            return True
    return False


@helper
def _squared(a, b):
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


@helper
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@helper
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@helper
def _ahead(point, origin, normal):
    """Return how far `point` lies in front of the plane through `origin`."""
    return (
        (point[0] - origin[0]) * normal[0]
        + (point[1] - origin[1]) * normal[1]
        + (point[2] - origin[2]) * normal[2]
    )


@kernel
def _splat(
    points, normals, radius, clip_ends, clip, across, reach, values, order, box, basis, eye,
    spacing, depth, blended, weight,
):  # fmt: skip
    """Two passes: the nearest depth of each pixel, then the sum of the discs at that depth, and of
    their weights.

    The discs from near to far, so that those behind others are known to be in the second pass. A
    ray is basis[0] + column * basis[1] + row * basis[2], and so are its parts along a disc's axes.
    """
    is_seen = np.zeros(len(points), np.bool_)
    origin = (eye[0], eye[1], eye[2])
    for final in (False, True):
        for n in range(len(order)):
            i = order[n]
            if final and not is_seen[i]:
                continue
            center, normal, side = _row(points, i), _row(normals, i), _row(across, i)
            up = _cross(normal, side)
            offset = _ahead(center, origin, normal)
            a_eye, b_eye = _ahead(origin, center, side), _ahead(origin, center, up)
            slope_0, slope_u, slope_v = _along(basis, normal)
            a_0, a_u, a_v = _along(basis, side)
            b_0, b_u, b_v = _along(basis, up)
            within = radius[i] * radius[i]
            first, end = clip_ends[i, 0], clip_ends[i, 1]
            gap = 0.1 * spacing[i]  # so that faces that meet leave no crack
            for row in range(box[i, 1, 0], box[i, 1, 1]):
                for column in range(box[i, 0, 0], box[i, 0, 1]):
                    slope = slope_0 + column * slope_u + row * slope_v
                    t = offset / min(slope, -1e-3)
                    a = a_eye + t * (a_0 + column * a_u + row * a_v)
                    b = b_eye + t * (b_0 + column * b_u + row * b_v)
                    squared = a * a + b * b
                    if (
                        squared > within
                        or t > depth[row, column] + spacing[i]
                        or _is_beyond(a, b, reach, i)
                    ):
                        continue
                    is_seen[i] = True
                    if first < end:
                        at = (
                            center[0] + a * side[0] + b * up[0],
                            center[1] + a * side[1] + b * up[1],
                            center[2] + a * side[2] + b * up[2],
                        )
                        if _is_cut(points, normals, clip, first, end, at, gap):
                            continue
                    if final:
                        w = np.exp(-4.0 * squared / (spacing[i] * spacing[i])) + 1e-12
                        weight[row, column] += w
                        for k in range(values.shape[1]):
                            blended[row, column, k] += w * values[i, k]
                    else:
                        depth[row, column] = min(t, depth[row, column])


@helper
def _along(basis, way):
    """Return how far the three vectors (3, 3) reach this way."""
    return _dot(_row(basis, 0), way), _dot(_row(basis, 1), way), _dot(_row(basis, 2), way)


@helper
def _is_beyond(a, b, reach, i):
    """Whether a place `a` along a disc's `across` and `b` along the other axis is out of reach."""
    for k in range(DIRECTIONS):  # noqa: SIM110 (numba compiles no any)
        if _TURNS[k, 0] * a + _TURNS[k, 1] * b > reach[i, k]:
            return True
    return False


@helper
def _is_cut(points, normals, planes, first, end, at, gap):
    for n in range(first, end):
        j = planes[n]
        if _ahead(at, _row(points, j), _row(normals, j)) > gap:
            return True
    return False


@kernel
def _close(depth, values, step):
    """Fill each pixel that lies behind most of those around it, by more than `step`, from them.

    Of a random covering a few gaps stay open, through which one sees what lies behind or nothing;
    beside an object's outline, nearer pixels are in the minority.
    """
    was, before = depth.copy(), values.copy()
    for row in range(2, depth.shape[0] - 2):
        for column in range(2, depth.shape[1] - 2):
            border = was[row, column] - step
            count, away = 0, 0.0
            for i in range(row - 2, row + 3):
                for j in range(column - 2, column + 3):
                    if was[i, j] < border:
                        count += 1
                        away += was[i, j]
            if count < MOST_AROUND:
                continue
            depth[row, column] = away / count
            for k in range(values.shape[2]):
                total = 0.0
                for i in range(row - 2, row + 3):
                    for j in range(column - 2, column + 3):
                        if was[i, j] < border:
                            total += before[i, j, k]
                values[row, column, k] = total / count
