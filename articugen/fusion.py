"""Depth maps to an implicit field that is evaluated where it is asked, not on a dense grid.

Volumetric fusion (Curless and Levoy 1996) averages, over the views, the truncated signed distance
along the ray from a point to the depth map. Read at whole pixels, that swells or erodes every thin
part. Here each view is read exactly: the maps say which face is seen at each pixel, so the distance
to a face's plane is known at the point's own sub-pixel position. Where the four pixels around it
disagree, the face whose triangle holds the position decides, and its neighbours too small to be
seen at a pixel's centre are asked. A view in which nothing is certain has no say.

Rules (`recipe.Fusion.rule`):
    seen: a point is outside where at least one view sees it free. Its value is the mean truncated
        distance over the views that see it free; inside, over the views that it lies close behind.
    mean: the value is the plain mean over the views that see the point free or close behind, as in
        Occupancy Networks' preparation; outside where that is positive.
In both, a point that no view sees, or only from further behind than the truncation, is inside.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from articugen.geometry import apply, invert_rigid
from articugen.records import FREE, DepthMaps, LabelledMesh

_UNSEEN = np.float32(1e9)
"""Signed distance where a view sees nothing behind the point."""

REACH_PIXELS = 2.0
"""In front of a face by more than this, beside an edge, a view has no say: what passes between the
pixels there may belong to something else."""


class Neighbours(NamedTuple):
    """The faces that share a corner with face f: `faces[start[f] : start[f + 1]]`."""

    start: NDArray[np.int32]
    faces: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Field:
    """The fused field of one set of depth maps.

    Attributes:
        maps: with the face seen at each pixel.
        triangles: (F, 16) float32, see `triangle_table`.
        neighbours: of each face.
    """

    maps: DepthMaps
    triangles: NDArray[np.float32]
    neighbours: Neighbours

    def is_free(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Which of `points` (n, 3), unit frame, at least one view sees free: (n,).

        Much cheaper than `value`: a point is settled by the first view that sees it free.
        """
        return _is_free(np.ascontiguousarray(points, np.float32), *self._kernel_arguments())

    def value(
        self,
        points: NDArray[np.floating],
        *,
        truncation: float,
        rule: Literal["seen", "mean"] = "seen",
    ) -> NDArray[np.float64]:
        """The field at `points` (n, 3): (n,) in [-truncation, truncation], negative inside.

        Distances are along the rays, in the unit frame.
        """
        flat = np.ascontiguousarray(points, np.float32)
        return _value(flat, *self._kernel_arguments(), truncation, rule == "mean")

    def _kernel_arguments(self):
        """Cameras in single precision: world-to-image rows, intrinsics, and the eye (pinhole) or
        the direction to it (orthographic)."""
        views = self.maps.views
        T, pinhole = views.T_camera_world, views.projection == "pinhole"
        intrinsics = np.stack([views.fx, views.fy, views.cx, views.cy], axis=1)
        eyes = -np.einsum("kji,kj->ki", T[:, :3, :3], T[:, :3, 3]) if pinhole else -T[:, 2, :3]
        away = np.abs(T[:, 2, 3]) if pinhole else 1.0
        reach = REACH_PIXELS * float(np.max(away / np.minimum(views.fx, views.fy)))
        return (
            self.maps.face,
            np.ascontiguousarray(T[:, :3], np.float32),
            intrinsics.astype(np.float32),
            np.ascontiguousarray(eyes, np.float32),
            pinhole,
            self.triangles,
            self.neighbours.start,
            self.neighbours.faces,
            np.float32(reach),
        )


@dataclass(frozen=True, eq=False)
class PosedFields:
    """The field of a posed object, and the fields of its parts alone, which label its inside.

    Attributes:
        whole: the field of all parts together, posed.
        own: for parts 1, 2, ... the field of the part alone in the canonical pose.
        part_motion: (P, 4, 4) from the canonical pose, unit frame.
    """

    whole: Field
    own: Sequence[Field]
    part_motion: NDArray[np.float64]

    def labels(self, points: NDArray[np.floating]) -> NDArray[np.uint8]:
        """(n,) 0 where free, k + 1 inside part k, for `points` (n, 3)."""
        label = np.where(self.whole.is_free(points), FREE, FREE + 1).astype(np.uint8)
        inside = np.flatnonzero(label)
        label[inside] += self.part_of_inside(points[inside])
        return label

    def part_of_inside(self, points: NDArray[np.floating]) -> NDArray[np.uint8]:
        """(n,) the part of points that are inside: the first moving part whose own solid holds the
        point; part 0 holds the rest, and with it what the parts enclose together."""
        part = np.zeros(len(points), np.uint8)
        open_points = np.arange(len(points))
        for k, field in enumerate(self.own, start=1):
            canonical = apply(invert_rigid(self.part_motion[k]), points[open_points])
            held = ~field.is_free(canonical)
            part[open_points[held]] = k
            open_points = open_points[~held]
        return part


def fuse(maps: DepthMaps, mesh: LabelledMesh, neighbours: Neighbours | None = None) -> Field:
    """The field of `maps`, which show the faces of `mesh`.

    Args:
        neighbours: of the mesh's faces, where they are known already: poses do not change them.

    Raises:
        ValueError: the maps do not say which face is seen.
    """
    if maps.face is None:
        raise ValueError("fusion needs to know the face seen at each pixel; see with_faces")
    return Field(maps, triangle_table(mesh), neighbours or face_neighbours(mesh))


def triangle_table(mesh: LabelledMesh) -> NDArray[np.float32]:
    """(F, 16) float32, one cache line a face: unit normal, offset, three corners, padding."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    table = np.zeros((len(corners), 16), np.float32)
    table[:, :3] = normals
    table[:, 3] = np.einsum("fi,fi->f", normals, corners.mean(axis=1))
    table[:, 4:13] = corners.reshape(-1, 9)
    return table


def face_neighbours(mesh: LabelledMesh) -> Neighbours:
    """For each face the others of its part that have a corner in the same place (to 1e-6)."""
    places = np.column_stack(
        [
            np.round(mesh.vertices[mesh.faces].reshape(-1, 3) * 2.0**20).astype(np.int64),
            np.repeat(mesh.part_of_face, 3),
        ]
    )
    place = np.unique(places, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.argsort(place, kind="stable")
    start = np.searchsorted(place[order], np.arange(place.max(initial=-1) + 2))
    return Neighbours(*_neighbours(place.reshape(-1, 3), start, order // 3))


@njit(cache=True, nogil=True)
def _neighbours(place, first, face_at):
    F = place.shape[0]
    start = np.zeros(F + 1, np.int32)
    faces = np.empty(0, np.int32)
    for fill in range(2):
        count = 0
        listed_for = np.full(F, -1, np.int32)
        for f in range(F):
            listed_for[f] = f
            for corner in range(3):
                at = place[f, corner]
                for n in range(first[at], first[at + 1]):
                    other = face_at[n]
                    if listed_for[other] != f:
                        listed_for[other] = f
                        if fill:
                            faces[count] = other
                        count += 1
            start[f + 1] = count
        if not fill:
            faces = np.empty(count, np.int32)
    return start, faces


@njit(cache=True, nogil=True, inline="always")
def _in_front(p, w, triangle):
    """How far `p` lies in front of the triangle's plane, along the direction `w` to the camera."""
    gap = triangle[0] * p[0] + triangle[1] * p[1] + triangle[2] * p[2] - triangle[3]
    slope = triangle[0] * w[0] + triangle[1] * w[1] + triangle[2] * w[2]
    if slope == 0.0:
        slope = np.float32(1e-12)
    return gap / slope


@njit(cache=True, nogil=True)
def _ray_meets(p, w, triangle):
    """Whether the line through `p` along `w` passes through the triangle, either way round.

    Signs of the volumes that the line spans with each edge; the two triangles at an edge compute
    the same number with opposite sign, so no line slips between them.
    """
    ax, ay, az = triangle[4] - p[0], triangle[5] - p[1], triangle[6] - p[2]
    bx, by, bz = triangle[7] - p[0], triangle[8] - p[1], triangle[9] - p[2]
    cx, cy, cz = triangle[10] - p[0], triangle[11] - p[1], triangle[12] - p[2]
    ab = w[0] * (ay * bz - az * by) + w[1] * (az * bx - ax * bz) + w[2] * (ax * by - ay * bx)
    bc = w[0] * (by * cz - bz * cy) + w[1] * (bz * cx - bx * cz) + w[2] * (bx * cy - by * cx)
    ca = w[0] * (cy * az - cz * ay) + w[1] * (cz * ax - cx * az) + w[2] * (cx * ay - cy * ax)
    return (ab >= 0.0 and bc >= 0.0 and ca >= 0.0) or (ab <= 0.0 and bc <= 0.0 and ca <= 0.0)


@njit(cache=True, nogil=True, inline="always")
def _look(p, w, face, T, intrinsics, eye, pinhole, triangles, start, neighbours, reach):
    """What one view says of `p`: how far in front of the surface it lies, nan for no say.

    `w` is scratch for the direction from the point to the camera.
    """
    x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
    y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
    if pinhole:
        z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
        x /= z
        y /= z
    # pixel centres lie at + 0.5: the four around the projection are (i, j) .. (i + 1, j + 1)
    u = intrinsics[0] * x + intrinsics[2] - np.float32(0.5)
    v = intrinsics[1] * y + intrinsics[3] - np.float32(0.5)
    H, W = face.shape
    if not (u >= 0.0 and v >= 0.0 and u < W - 1 and v < H - 1):
        return _UNSEEN
    j = np.int64(u)
    i = np.int64(v)
    f0, f1, f2, f3 = face[i, j], face[i, j + 1], face[i + 1, j], face[i + 1, j + 1]
    if f0 < 0 and f1 < 0 and f2 < 0 and f3 < 0:
        return _UNSEEN
    if pinhole:
        length = np.float32(0.0)
        for axis in range(3):
            w[axis] = eye[axis] - p[axis]
            length += w[axis] * w[axis]
        scale = np.float32(1.0) / np.sqrt(length)
        for axis in range(3):
            w[axis] *= scale
    else:
        for axis in range(3):
            w[axis] = eye[axis]
    if f0 == f1 and f0 == f2 and f0 == f3:
        return _in_front(p, w, triangles[f0])
    return _weigh(p, w, f0, f1, f2, f3, triangles, start, neighbours, reach)


@njit(cache=True, nogil=True)
def _weigh(p, w, f0, f1, f2, f3, triangles, start, neighbours, reach):
    """The say of four pixels that show different faces."""
    nearest = _UNSEEN
    farthest = -_UNSEEN
    for f in (f0, f1, f2, f3):
        s = _in_front(p, w, triangles[f]) if f >= 0 else _UNSEEN
        nearest = min(nearest, s)
        farthest = max(farthest, s)
    if nearest > 0.0:  # in front of all
        return nearest
    if farthest <= 0.0:  # behind all
        return farthest
    held = np.float32(np.nan)
    for f in (f0, f1, f2, f3):
        if f >= 0 and _ray_meets(p, w, triangles[f]):
            s = _in_front(p, w, triangles[f])
            if s <= 0.0:
                return s
            if not held <= s:
                held = s
    if not held < reach:
        return np.float32(np.nan)
    # `p` is in front of a face that its ray meets and behind others that it misses: a face smaller
    # than a pixel may still hide it, and such a face hangs on one of those
    for f in (f0, f1, f2, f3):
        if f >= 0 and _in_front(p, w, triangles[f]) <= 0.0:
            for n in range(start[f], start[f + 1]):
                near = triangles[neighbours[n]]
                if _in_front(p, w, near) <= 0.0 and _ray_meets(p, w, near):
                    return np.float32(np.nan)
    return held


@njit(cache=True, nogil=True)
def _is_free(
    points, face, T, intrinsics, eyes, pinhole, triangles, start, neighbours, reach
):  # fmt: skip
    free = np.zeros(points.shape[0], np.bool_)
    waiting = np.arange(points.shape[0])
    left = points.shape[0]
    w = np.empty(3, np.float32)
    for k in range(face.shape[0]):
        kept = 0
        for n in range(left):
            index = waiting[n]
            s = _look(
                points[index], w, face[k], T[k], intrinsics[k], eyes[k], pinhole,
                triangles, start, neighbours, reach,
            )  # fmt: skip
            if s > 0.0:
                free[index] = True
            else:
                waiting[kept] = index
                kept += 1
        left = kept
    return free


@njit(cache=True, nogil=True)
def _value(
    points, face, T, intrinsics, eyes, pinhole, triangles, start, neighbours, reach,
    truncation, mean,
):  # fmt: skip
    n = points.shape[0]
    total = np.zeros((n, 2))  # of the views that see the point free, and that it lies close behind
    views = np.zeros((n, 2))
    w = np.empty(3, np.float32)
    for k in range(face.shape[0]):
        for i in range(n):
            s = _look(
                points[i], w, face[k], T[k], intrinsics[k], eyes[k], pinhole,
                triangles, start, neighbours, reach,
            )  # fmt: skip
            if s > 0.0:
                total[i, 0] += min(np.float64(s), truncation)
                views[i, 0] += 1.0
            elif s >= -truncation:
                total[i, 1] += s
                views[i, 1] += 1.0
    value = np.empty(n)
    for i in range(n):
        if mean and views[i, 0] + views[i, 1] > 0.0:
            value[i] = (total[i, 0] + total[i, 1]) / (views[i, 0] + views[i, 1])
        elif views[i, 0] > 0.0:
            value[i] = total[i, 0] / views[i, 0]
        elif views[i, 1] > 0.0:
            value[i] = total[i, 1] / views[i, 1]
        else:
            value[i] = -truncation
    return value
