"""Pictures of labelled surface points: each point is drawn as a small lit disc (a surfel).

A shard holds points with normals, not triangles, so the picture shows just what was stored.
"""

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from articugen.geometry import apply, look_along

Array = NDArray[np.float64]

NEIGHBOURS = 14
"""The spacing of the points, and how far a disc must reach so that random gaps between them close,
is judged by the distance to the neighbour of this rank: about 2.1 spacings on a plane."""

SAME_FACE = np.cos(np.radians(25.0))
"""Normals that differ by less belong to one face, others to two that meet in an edge."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera: `T_camera_world` (4, 4), focal length and principal point in pixels.

    Axes as in `records.Views`; images are `size` pixels wide and high.
    """

    T_camera_world: Array
    focal: float
    cx: float
    cy: float
    size: int

    def rays(self) -> Array:
        """(size, size, 3) world directions through the pixels' centres, of unit depth."""
        at = np.arange(self.size) + 0.5
        x, y = np.meshgrid((at - self.cx) / self.focal, (at - self.cy) / self.focal)
        return np.stack([x, y, np.ones_like(x)], axis=-1) @ self.T_camera_world[:3, :3]

    @property
    def eye(self) -> Array:
        return -self.T_camera_world[:3, :3].T @ self.T_camera_world[:3, 3]


def framed(points: Array, azimuth: float, elevation: float, size: int, *, fill: float) -> Camera:
    """The camera at `azimuth`, `elevation` (rad) whose square image `points` (n, 3) fill.

    `fill` is the fraction of the width or height that their box takes, the larger of the two.
    """
    toward_eye = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    T_camera_world = look_along(-toward_eye, middle + 3.5 * toward_eye)
    seen = apply(T_camera_world, points)
    flat = seen[:, :2] / seen[:, 2:]
    low, high = flat.min(axis=0), flat.max(axis=0)
    focal = fill * size / (high - low).max()
    cx, cy = 0.5 * size - focal * 0.5 * (low + high)
    return Camera(T_camera_world, focal, cx, cy, size)


@dataclass(frozen=True, eq=False)
class Surfels:
    """Oriented discs.

    Attributes:
        points, normals: (n, 3), unit frame.
        spacing: the side of the square that each point stands for.
        radius: (n,) of the discs.
        light: (n,) how much of the sky a point sees, from 0 to 1.
        clip_ends: (n, 2) where each disc's part of `clip` begins and ends.
        clip: for every disc the neighbours across a convex edge; it ends at their planes.
        trim: (n, 4) a direction in its plane and how far it goes that way.
    """

    points: Array
    normals: Array
    spacing: float
    radius: Array
    light: Array
    clip_ends: NDArray[np.int64]
    clip: NDArray[np.int32]
    trim: Array


def surfels(points: Array, normals: Array, part: NDArray[np.uint8]) -> Surfels:
    """Discs for `points` (n, 3) that lie on a surface uniformly, with unit `normals` (n, 3)."""
    points, normals = np.ascontiguousarray(points), np.ascontiguousarray(normals)
    rank = min(NEIGHBOURS, len(points) - 1)
    sample = np.linspace(0, len(points) - 1, min(256, len(points))).astype(np.int64)
    # rank = pi * distance^2 / spacing^2 on a plane.
    spacing = float(np.median(_distance_of_rank(points, sample, rank)) * np.sqrt(np.pi / rank))
    light = 1.0 - _occlusion(points, normals, points, normals, spacing * spacing)
    reach, slack = 6.0 * spacing, 0.15 * spacing
    radius, ends, clip, trim = _outline(points, normals, part, reach, slack, NEIGHBOURS)
    return Surfels(points, normals, spacing, radius, light, ends, clip, trim)


def occlusion_at(receivers: Array, normals: Array, discs: Surfels) -> Array:
    """How much of the sky the discs hide from `receivers` (m, 3) that face `normals`: (m,)."""
    return _occlusion(receivers, normals, discs.points, discs.normals, discs.spacing**2)


def draw(discs: Surfels, values: Array, camera: Camera) -> tuple[Array, Array, Array]:
    """The discs as a camera sees them.

    Args:
        values: (n, C) what to interpolate between the discs, for instance colours.

    Returns:
        Depth (H, W), inf where nothing is; unit normals (H, W, 3); values (H, W, C).
    """
    facing = np.einsum("ij,ij->i", camera.eye - discs.points, discs.normals) > 0.0
    x, y, z = apply(camera.T_camera_world, discs.points).T
    box = np.stack(
        [
            _ends(x, z, discs.radius, camera.focal, camera.cx, camera.size),
            _ends(y, z, discs.radius, camera.focal, camera.cy, camera.size),
        ],
        axis=1,
    )
    depth, blended = _splat(
        discs.points,
        discs.normals,
        discs.radius,
        discs.clip_ends,
        discs.clip,
        discs.trim,
        np.concatenate([discs.normals, values], axis=1),
        facing,
        box,
        camera.rays(),
        camera.eye,
        discs.spacing,
    )
    length = np.linalg.norm(blended[..., :3], axis=-1, keepdims=True)
    return depth, blended[..., :3] / np.maximum(length, 1e-12), blended[..., 3:]


def _ends(
    x: Array, z: Array, radius: Array, focal: float, c: float, size: int
) -> NDArray[np.int64]:
    """(n, 2) the first column (or row) and one past the last that discs can touch."""
    middle, reach = focal * x / z + c, focal * radius / (z - radius)
    ends = np.stack([np.floor(middle - reach), np.ceil(middle + reach) + 1], axis=1)
    return np.clip(ends, 0, size).astype(np.int64)


@numba.njit(cache=True, nogil=True)
def _distance_of_rank(points, sample, rank):
    found = np.empty(len(sample))
    squared = np.empty(len(points))
    for s in range(len(sample)):
        for j in range(len(points)):
            squared[j] = ((points[j] - points[sample[s]]) ** 2).sum()
        found[s] = np.sqrt(np.partition(squared, rank)[rank])
    return found


@numba.njit(cache=True, nogil=True)
def _occlusion(at, facing, points, normals, area):
    """Bunnell 2005, "Dynamic ambient occlusion and indirect lighting": sums of form factors.

    Every second disc, with twice its area, stands for all of them.
    """
    area = 2.0 * area
    hidden = np.empty(len(at))
    for i in range(len(at)):
        total = 0.0
        for j in range(0, len(points), 2):
            x = points[j, 0] - at[i, 0]
            y = points[j, 1] - at[i, 1]
            z = points[j, 2] - at[i, 2]
            above = x * facing[i, 0] + y * facing[i, 1] + z * facing[i, 2]
            toward = -(x * normals[j, 0] + y * normals[j, 1] + z * normals[j, 2])
            if above > 0.0 and toward > 0.0:
                squared = x * x + y * y + z * z
                total += area * above * toward / (squared * (np.pi * squared + area))
        hidden[i] = min(total, 1.0)
    return hidden


@numba.njit(cache=True, nogil=True)
def _outline(points, normals, part, reach, slack, rank):
    """The radius of each disc, and the neighbours across a convex edge, in one list.

    The radius is the distance to the neighbour of the given rank on the same face, or a third of
    the reach where so many are not there. Neighbour j bounds disc i where each lies behind the
    other and the face of i does not go on beyond j; one neighbour a plane is enough. A disc that
    nothing bounds is trimmed to its face.
    """
    radius = np.full(len(points), reach / 3.0)
    trim = np.zeros((len(points), 4))
    trim[:, 3] = np.inf
    ends = np.zeros((len(points), 2), np.int64)
    found = [np.int32(0) for _ in range(0)]
    others = np.empty(len(points), np.int32)
    face = np.empty(len(points), np.int32)
    distance = np.empty(len(points))
    order = np.argsort(points[:, 0])
    first = 0
    for i in order:
        while points[order[first], 0] < points[i, 0] - reach:
            first += 1
        behind = before = level = 0
        for j in order[first:]:
            if points[j, 0] > points[i, 0] + reach:
                break
            away = np.sqrt(_squared(points[i], points[j]))
            if part[j] != part[i] or away > reach:
                continue
            ahead = _ahead(points[j], points[i], normals[i])
            alike = _dot(normals[i], normals[j]) > SAME_FACE
            if alike and abs(ahead) < slack:
                face[level] = j
                distance[level] = away
                level += 1
            elif not alike and -reach / 3.0 < ahead < 0.0:
                others[behind] = j
                behind += 1
            elif not alike and ahead >= 0.0 and away < 0.5 * reach:
                before += 1
        if level > rank:
            radius[i] = min(np.partition(distance[:level], rank)[rank], 0.5 * reach)
        ends[i] = len(found)
        for j in others[:behind]:
            gap = -_ahead(points[i], points[j], normals[j])
            if (
                0.0 < gap < radius[i]
                and not _is_known(points, normals, found[ends[i, 0] :], j, slack)
                and not _goes_on(points, face[:level], points[j], normals[j], 0.5 * reach, slack)
            ):
                found.append(j)
        ends[i, 1] = len(found)
        if ends[i, 0] == ends[i, 1] and before == 0:
            _trim(points, i, face[:level], radius[i], 0.25 * reach / 6.0, trim)
    return radius, ends, np.array(found, dtype=np.int32), trim


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
def _is_known(points, normals, planes, j, slack):
    """Whether one of `planes` is the plane of j."""
    for k in planes:
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
def _splat(points, normals, radius, clip_ends, clip, trim, values, facing, box, rays, eye, spacing):
    """Two passes: the nearest depth of each pixel, then the mean of the discs at that depth."""
    depth = np.full(rays.shape[:2], np.inf)
    weight = np.full(rays.shape[:2], 1e-30)
    blended = np.zeros((*rays.shape[:2], values.shape[1]))
    at = np.empty(3)
    gap = 0.1 * spacing  # so that faces that meet leave no crack
    for final in (False, True):
        for i in np.flatnonzero(facing):
            offset = _ahead(points[i], eye, normals[i])
            planes = clip[clip_ends[i, 0] : clip_ends[i, 1]]
            for row in range(box[i, 1, 0], box[i, 1, 1]):
                for column in range(box[i, 0, 0], box[i, 0, 1]):
                    ray = rays[row, column]
                    slope = min(_dot(ray, normals[i]), -1e-3)
                    t = offset / slope
                    if t > depth[row, column] + (spacing if final else 0.0):
                        continue
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
                        w = np.exp(-4.0 * squared / (spacing * spacing)) + 1e-12
                        weight[row, column] += w
                        for k in range(values.shape[1]):
                            blended[row, column, k] += w * values[i, k]
                    else:
                        depth[row, column] = t
    return depth, blended / weight.reshape((*weight.shape, 1))


@numba.njit(cache=True, nogil=True)
def _is_cut(points, normals, planes, at, gap):
    for j in planes:  # noqa: SIM110 (numba compiles no any)
        if _ahead(at, points[j], normals[j]) > gap:
            return True
    return False
