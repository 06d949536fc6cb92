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
from articugen.inspection.light import Cloud

Array = NDArray[np.float64]

NEIGHBOURS = 14
"""The spacing of the points, and how far a disc must reach so that random gaps between them close,
is judged by the distance to the neighbour of this rank: about 2.1 spacings on a plane."""

SAME_FACE = np.cos(np.radians(25.0))
"""Normals that differ by less belong to one face, others to two that meet in an edge."""


@dataclass(frozen=True, eq=False)
class Sample:
    """Points on a surface, uniform over it: `points` (n, 3), unit `normals` (n, 3), `part` (n,)."""

    points: Array
    normals: Array
    part: NDArray[np.uint8]

    def moved(self, T_part: Array) -> "Sample":
        """Each part's points moved by its own rigid motion; `T_part` (P, 4, 4)."""
        points = _turned(T_part, self.points, self.part) + T_part[self.part, :3, 3]
        return Sample(points, _turned(T_part, self.normals, self.part), self.part)

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
        trim: (n, 4) a direction in its plane and how far it goes that way.
    """

    points: Array
    normals: Array
    part: NDArray[np.uint8]
    spacing: Array
    radius: Array
    clip_ends: NDArray[np.int64]
    clip: NDArray[np.int32]
    trim: Array

    @property
    def cloud(self) -> Cloud:
        return Cloud(self.points, self.normals, self.spacing**2)

    def moved(self, T_part: Array) -> "Surfels":
        """Each part's discs moved by its own rigid motion; `T_part` (P, 4, 4).

        A disc's edges depend on discs of its own part only, so they move with it.
        """
        trim = self.trim.copy()
        trim[:, :3] = _turned(T_part, self.trim[:, :3], self.part)
        return replace(
            self,
            points=_turned(T_part, self.points, self.part) + T_part[self.part, :3, 3],
            normals=_turned(T_part, self.normals, self.part),
            trim=trim,
        )


def _turned(T_part: Array, vectors: Array, part: NDArray[np.uint8]) -> Array:
    """`vectors` (n, 3), each turned by the rotation of its part's `T_part` (P, 4, 4)."""
    return np.einsum("nij,nj->ni", T_part[part, :3, :3], vectors)


def surfels(samples: Sequence[Sample]) -> Surfels:
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
    radius, ends, clip, trim = _outline(points, normals, part, local, cells, NEIGHBOURS)
    return Surfels(points, normals, part, local, radius, ends, clip, trim)


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
        discs.trim,
        np.concatenate([discs.normals, values], axis=1),
        np.flatnonzero(facing)[np.argsort(z[facing, 0])],
        np.clip(box, 0, camera.size).astype(np.int64),
        camera.rays,
        camera.eye,
        discs.spacing,
    )
    _close(depth, blended)
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
def _outline(points, normals, part, spacing, cells, rank):
    """The radius of each disc, and the neighbours across a convex edge, in one list.

    The radius is the distance to the neighbour of the given rank on the same face, or two spacings
    where so many are not there. Neighbour j bounds disc i where each lies behind the other and the
    face of i does not go on beyond j; one neighbour a plane is enough. A disc that nothing bounds
    is trimmed to its face.
    """
    radius = 2.0 * spacing
    trim = np.zeros((len(points), 4))
    trim[:, 3] = np.inf
    ends = np.zeros((len(points), 2), np.int64)
    clip = [np.int32(0) for _ in range(0)]
    found = np.empty(len(points), np.int64)
    others = np.empty(len(points), np.int32)
    face = np.empty(len(points), np.int32)
    distance = np.empty(len(points))
    for i in range(len(points)):
        reach, slack = 3.0 * spacing[i], 0.15 * spacing[i]
        behind = before = level = 0
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
            elif ahead >= 0.0 and away < reach:
                before += 1
        if level > rank:
            radius[i] = min(np.partition(distance[:level], rank)[rank], reach)
        ends[i] = len(clip)
        for j in others[:behind]:
            gap = -_ahead(points[i], points[j], normals[j])
            if (
                0.0 < gap < radius[i]
                and not _is_known(points, normals, clip, ends[i, 0], j, slack)
                and not _goes_on(points, face[:level], points[j], normals[j], reach, slack)
            ):
                clip.append(j)
        ends[i, 1] = len(clip)
        if ends[i, 0] == ends[i, 1] and before == 0:
            _trim(points, i, face[:level], radius[i], 0.25 * spacing[i], trim)
    return radius, ends, np.array(clip, dtype=np.int32), trim


@numba.njit(cache=True, nogil=True)
def _trim(points, i, face, radius, margin, trim):
    """Where the points of a face lie on one side of disc i, it ends a little beyond the last."""
    away = np.zeros(3)
    count = 0
    for k in face:
        if _squared(points[i], points[k]) < radius * radius:
            away += points[i] - points[k]
            count += 1
    length = np.sqrt(_dot(away, away))
    if length < 0.3 * radius * count:
        return
    away /= length
    last = 0.0
    for k in face:
        if _squared(points[i], points[k]) < radius * radius:
            last = max(last, _ahead(points[k], points[i], away))
    trim[i, :3] = away
    trim[i, 3] = last + margin


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
def _splat(points, normals, radius, clip_ends, clip, trim, values, order, box, rays, eye, spacing):
    """Two passes: the nearest depth of each pixel, then the mean of the discs at that depth.

    The discs from near to far, so that those behind others are known to be in the second pass.
    """
    depth = np.full(rays.shape[:2], np.inf)
    weight = np.full(rays.shape[:2], 1e-30)
    blended = np.zeros((*rays.shape[:2], values.shape[1]))
    at = np.empty(3)
    is_seen = np.zeros(len(points), np.bool_)
    for final in (False, True):
        for i in order:
            if final and not is_seen[i]:
                continue
            offset = _ahead(points[i], eye, normals[i])
            planes = clip[clip_ends[i, 0] : clip_ends[i, 1]]
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
                        or _ahead(at, points[i], trim[i, :3]) > trim[i, 3]
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
def _close(depth, values):
    """Fill, from the pixels around it, each pixel where nothing is but around which something is.

    Of a random covering a few gaps stay open; what is outside the object has more company.
    """
    was = depth.copy()
    for row in range(1, depth.shape[0] - 1):
        for column in range(1, depth.shape[1] - 1):
            if was[row, column] < np.inf:
                continue
            count = 0
            for i in range(row - 1, row + 2):
                for j in range(column - 1, column + 2):
                    count += was[i, j] < np.inf
            if count < 5:
                continue
            depth[row, column], values[row, column] = 0.0, 0.0
            for i in range(row - 1, row + 2):
                for j in range(column - 1, column + 2):
                    if was[i, j] < np.inf:
                        depth[row, column] += was[i, j] / count
                        values[row, column] += values[i, j] / count
