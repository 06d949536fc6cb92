"""Pictures of labelled surface points: each point is drawn as a small lit disc (a surfel).

A shard holds points with normals, not triangles, so the picture shows just what was stored.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

from articugen.geometry import apply
from articugen.inspection.camera import Camera
from articugen.inspection.cells import cells_of, near
from articugen.inspection.light import SurfaceCloud

Array = NDArray[np.float64]

NEIGHBOURS = 14
"""The spacing of the points, and how far a disc must reach so that random gaps between them close,
is judged by the distance to the neighbour of this rank: about 2.1 spacings on a plane."""

DIRECTIONS = 8
"""In so many directions it is asked where the face of a disc ends."""

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
        """Each part's points moved by its own rigid motion; `T_part` (P, 4, 4)."""
        points = _turned(T_part, self.points, self.part) + T_part[self.part, :3, 3]
        return OrientedPoints(points, _turned(T_part, self.normals, self.part), self.part)

    def spacing(self) -> float:
        """The side of the square that each point stands for."""
        rank = min(NEIGHBOURS, len(self.points) - 1)
        asked = np.linspace(0, len(self.points) - 1, min(64, len(self.points))).astype(np.int64)
        # On a plane, rank = pi * distance^2 / spacing^2.
        away = _distance_of_rank(self.points, self.normals, self.part, asked, rank)
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
        """Each part's discs moved by its own rigid motion; `T_part` (P, 4, 4).

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
    """A unit direction at right angles to each of `normals` (n, 3)."""
    least = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    across = np.cross(normals, least)
    return across / np.linalg.norm(across, axis=1, keepdims=True)


def draw(discs: Surfels, values: Array, camera: Camera) -> tuple[Array, Array, Array]:
    """The discs as a camera sees them.

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
    depth, blended = _splat(
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
        camera.rays,
        camera.eye,
        discs.spacing,
    )
    for _ in range(2):
        _close(depth, blended, 2.0 * float(np.median(discs.spacing)))
    length = np.linalg.norm(blended[..., :3], axis=-1, keepdims=True)
    return depth, blended[..., :3] / np.maximum(length, 1e-12), blended[..., 3:]


@numba.njit(cache=True, nogil=True)
def _distance_of_rank(points, normals, part, asked, rank):
    """From each point asked for, to its neighbour of this rank on the same side of its part."""
    found = np.empty(len(asked))
    squared = np.empty(len(points))
    for s, i in enumerate(asked):
        for j in range(len(points)):
            alike = part[j] == part[i] and _dot(normals[i], normals[j]) > SAME_FACE
            squared[j] = _squared(points[i], points[j]) if alike else 3.0
        found[s] = np.sqrt(np.partition(squared, rank)[rank])
    return found


@numba.njit(cache=True, nogil=True)
def _covers(points, normals, part, source, sources, cells, reach):
    """How many of the samples cover the surface at each point, (n,).

    If m of them do, two points from there are of one sample with probability 1 / m, so pairs that
    are tell m, however small the face is (as equal birthdays tell the length of the year).
    """
    covers = np.empty(len(points))
    found = np.empty(len(points), np.int64)
    count = np.empty(sources)
    for i in range(len(points)):
        count[:] = 0.0
        for j in found[: near(cells, points, points[i], reach, found)]:
            if part[j] == part[i] and _dot(normals[i], normals[j]) > SAME_FACE:
                count[source[j]] += 1.0
        total, alike = count.sum(), (count * (count - 1.0)).sum()
        covers[i] = min(max(total * (total - 1.0) / max(alike, 1.0), 1.0), sources)
    return covers


@numba.njit(cache=True, nogil=True)
def _outline(points, normals, across, part, spacing, cells, rank):
    """The radius of each disc, the neighbours across a convex edge in one list, and its reach.

    The radius is the distance to the neighbour of the given rank on the same face, or two spacings
    where so many are not there. Neighbour j bounds disc i where each lies behind the other and the
    face of i does not go on beyond j; one neighbour a plane is enough. In no direction does a disc
    go on far beyond the last point of its face: where a face ends at a plate too thin to be told
    from it, or beside one that nobody sees, nothing else would keep the disc from sticking out.
    """
    radius = 2.0 * spacing
    reaches = np.empty((len(points), DIRECTIONS))
    ends = np.zeros((len(points), 2), np.int64)
    clip = [np.int32(0) for _ in range(0)]
    found = np.empty(len(points), np.int64)
    others = np.empty(len(points), np.int32)
    face = np.empty(len(points), np.int32)
    distance = np.empty(len(points))
    for i in range(len(points)):
        reach, slack = 3.0 * spacing[i], 0.15 * spacing[i]
        behind = level = 0
        for j in found[: near(cells, points, points[i], 1.5 * reach, found)]:
            if part[j] != part[i]:
                continue
            away = np.sqrt(_squared(points[i], points[j]))
            ahead = _ahead(points[j], points[i], normals[i])
            alike = _dot(normals[i], normals[j]) > SAME_FACE
            if alike and abs(ahead) < slack:
                face[level] = j
                distance[level] = away
                level += 1
            elif not alike and -2.0 * spacing[i] < ahead < 0.0:
                others[behind] = j
                behind += 1
        if level > rank:
            radius[i] = min(np.partition(distance[:level], rank)[rank], reach)
        ends[i] = len(clip)
        for j in others[:behind]:
            gap = -_ahead(points[i], points[j], normals[j])
            below = _ahead(points[j], points[i], normals[i])
            wide = np.sqrt(reach * reach + below * below)  # as much of i's plane for any depth
            if (
                0.0 < gap < radius[i]
                and not _is_known(points, normals, clip, ends[i, 0], j, slack)
                and not _goes_on(points, face[:level], points[j], normals[j], wide, slack)
            ):
                clip.append(j)
        ends[i, 1] = len(clip)
        bounding = clip[ends[i, 0] :]
        for k in range(DIRECTIONS):
            way = _direction(across[i], normals[i], k)
            if _is_bounded(normals, bounding, way):
                reaches[i, k] = np.inf
            else:
                last = _last(points, i, face[:level], radius[i], way)
                reaches[i, k] = last + BEYOND * spacing[i]
    return radius, ends, np.array(clip, dtype=np.int32), reaches


@numba.njit(cache=True, nogil=True)
def _direction(across, normal, k):
    """The k-th of DIRECTIONS even directions in a disc's plane, from `across` on."""
    turn = 2.0 * np.pi * k / DIRECTIONS
    c, s = np.cos(turn), np.sin(turn)
    way = np.empty(3)
    way[0] = c * across[0] + s * (normal[1] * across[2] - normal[2] * across[1])
    way[1] = c * across[1] + s * (normal[2] * across[0] - normal[0] * across[2])
    way[2] = c * across[2] + s * (normal[0] * across[1] - normal[1] * across[0])
    return way


@numba.njit(cache=True, nogil=True)
def _is_bounded(normals, planes, way):
    """Whether one of the planes ends what goes this way."""
    for j in planes:  # noqa: SIM110 (numba compiles no any)
        if _dot(normals[j], way) > 0.7:
            return True
    return False


@numba.njit(cache=True, nogil=True)
def _last(points, i, face, radius, way):
    """How far the points of a face within `radius` of point i reach this way."""
    last = 0.0
    for j in face:
        if _squared(points[i], points[j]) < radius * radius:
            last = max(last, _ahead(points[j], points[i], way))
    return last


@numba.njit(cache=True, nogil=True)
def _is_beyond(at, center, ways, reach):
    for k in range(DIRECTIONS):  # noqa: SIM110 (numba compiles no any)
        if _ahead(at, center, ways[k]) > reach[k]:
            return True
    return False


@numba.njit(cache=True, nogil=True)
def _is_known(points, normals, planes, first, j, slack):
    """Whether one of `planes`, from the given one on, is the plane of j."""
    for place in range(first, len(planes)):
        k = planes[place]
        level = abs(_ahead(points[j], points[k], normals[k])) < slack
        if level and _dot(normals[j], normals[k]) > 0.99:
            return True
    return False


@numba.njit(cache=True, nogil=True)
def _goes_on(points, face, origin, normal, near, slack):
    """Whether a face goes on in front of a plane, nearby."""
    for k in face:
        if _squared(points[k], origin) < near * near and _ahead(points[k], origin, normal) > slack:
            return True
    return False


@numba.njit(cache=True, nogil=True)
def _squared(a, b):
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


@numba.njit(cache=True, nogil=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(cache=True, nogil=True)
def _ahead(point, origin, normal):
    """How far `point` lies in front of the plane through `origin`."""
    return (
        (point[0] - origin[0]) * normal[0]
        + (point[1] - origin[1]) * normal[1]
        + (point[2] - origin[2]) * normal[2]
    )


@numba.njit(cache=True, nogil=True)
def _splat(
    points, normals, radius, clip_ends, clip, across, reach, values, order, box, rays, eye, spacing
):
    """Two passes: the nearest depth of each pixel, then the mean of the discs at that depth.

    The discs from near to far, so that those behind others are known to be in the second pass.
    """
    depth = np.full(rays.shape[:2], np.inf)
    weight = np.full(rays.shape[:2], 1e-30)
    blended = np.zeros((*rays.shape[:2], values.shape[1]))
    at = np.empty(3)
    ways = np.empty((DIRECTIONS, 3))
    is_seen = np.zeros(len(points), np.bool_)
    for final in (False, True):
        for i in order:
            if final and not is_seen[i]:
                continue
            offset = _ahead(points[i], eye, normals[i])
            planes = clip[clip_ends[i, 0] : clip_ends[i, 1]]
            for k in range(DIRECTIONS):
                ways[k] = _direction(across[i], normals[i], k)
            gap = 0.1 * spacing[i]  # so that faces that meet leave no crack
            for row in range(box[i, 1, 0], box[i, 1, 1]):
                for column in range(box[i, 0, 0], box[i, 0, 1]):
                    ray = rays[row, column]
                    slope = min(_dot(ray, normals[i]), -1e-3)
                    t = offset / slope
                    if t > depth[row, column] + spacing[i]:
                        continue
                    is_seen[i] = True
                    for k in range(3):
                        at[k] = eye[k] + t * ray[k]
                    squared = _squared(at, points[i])
                    if (
                        squared > radius[i] * radius[i]
                        or _is_beyond(at, points[i], ways, reach[i])
                        or _is_cut(points, normals, planes, at, gap)
                    ):
                        continue
                    if final:
                        w = np.exp(-4.0 * squared / (spacing[i] * spacing[i])) + 1e-12
                        weight[row, column] += w
                        for k in range(values.shape[1]):
                            blended[row, column, k] += w * values[i, k]
                    else:
                        depth[row, column] = min(t, depth[row, column])
    return depth, blended / weight.reshape((*weight.shape, 1))


@numba.njit(cache=True, nogil=True)
def _is_cut(points, normals, planes, at, gap):
    for j in planes:  # noqa: SIM110 (numba compiles no any)
        if _ahead(at, points[j], normals[j]) > gap:
            return True
    return False


@numba.njit(cache=True, nogil=True)
def _close(depth, values, step):
    """Fill each pixel that lies behind most of those around it, by more than `step`, from them.

    Of a random covering a few gaps stay open, through which one sees what lies behind or nothing;
    beside an object's outline, nearer pixels are in the minority.
    """
    was, before = depth.copy(), values.copy()
    total = np.empty(values.shape[2])
    for row in range(2, depth.shape[0] - 2):
        for column in range(2, depth.shape[1] - 2):
            count, away = 0, 0.0
            total[:] = 0.0
            for i in range(row - 2, row + 3):
                for j in range(column - 2, column + 3):
                    if was[i, j] < was[row, column] - step:
                        count += 1
                        away += was[i, j]
                        total += before[i, j]
            if count >= MOST_AROUND:
                depth[row, column], values[row, column] = away / count, total / count
