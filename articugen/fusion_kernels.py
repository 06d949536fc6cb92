"""The numba kernels of fusion: what one view says of one point, and how the views add up.

`Scene` bundles what the kernels read; see `fusion.Field` for where it comes from.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

UNSEEN = np.float32(1e9)
"""Signed distance where a view sees nothing behind the point."""

SMOOTH_STEP = np.float32(4.0)
"""Without face ids: depths that differ by less than this many pixels' width are one surface."""


class Scene(NamedTuple):
    """Depth maps and faces as the kernels read them; float32 and int32 arrays.

    Attributes:
        depth: (K, H, W), or empty where `face` is known.
        face: (K, H, W), or empty where only depth is known.
        cameras: (K, 3, 4) world to camera.
        intrinsics: (K, 4) fx, fy, cx, cy.
        eyes: (K, 3) the eye (pinhole), or the unit direction to the camera (orthographic).
        pinhole: whether the cameras are pinholes.
        triangles: (F, 16) unit normal, offset, three corners, padding.
        start, neighbours: the faces that share a corner with face f are
            `neighbours[start[f] : start[f + 1]]`.
        pixel: the width of a pixel at the object, unit frame.
    """

    depth: Any
    face: Any
    cameras: Any
    intrinsics: Any
    eyes: Any
    pinhole: Any
    triangles: Any
    start: Any
    neighbours: Any
    pixel: Any


@njit(cache=True, nogil=True)
def is_free(points, scene):
    """(n,) which points at least one view sees free; a point is done with at the first."""
    free = np.zeros(points.shape[0], np.bool_)
    waiting = np.arange(points.shape[0])
    left = points.shape[0]
    w = np.empty(3, np.float32)
    for k in range(scene.cameras.shape[0]):
        kept = 0
        for n in range(left):
            index = waiting[n]
            if _look(points[index], w, k, scene) > 0.0:
                free[index] = True
            else:
                waiting[kept] = index
                kept += 1
        left = kept
    return free


@njit(cache=True, nogil=True)
def value(points, scene, truncation, mean):
    """(n,) the truncated signed distances of the views, averaged as `fusion` says."""
    n = points.shape[0]
    total = np.zeros((n, 2))  # of the views that see the point free, and that it lies close behind
    views = np.zeros((n, 2))
    w = np.empty(3, np.float32)
    for k in range(scene.cameras.shape[0]):
        for i in range(n):
            s = _look(points[i], w, k, scene)
            if s > 0.0:
                total[i, 0] += min(np.float64(s), truncation)
                views[i, 0] += 1.0
            elif s >= -truncation:
                total[i, 1] += s
                views[i, 1] += 1.0
    result = np.empty(n)
    for i in range(n):
        if mean and views[i, 0] + views[i, 1] > 0.0:
            result[i] = (total[i, 0] + total[i, 1]) / (views[i, 0] + views[i, 1])
        elif views[i, 0] > 0.0:
            result[i] = total[i, 0] / views[i, 0]
        elif views[i, 1] > 0.0:
            result[i] = total[i, 1] / views[i, 1]
        else:
            result[i] = -truncation
    return result


@njit(cache=True, nogil=True)
def _look(p, w, k, scene):
    """What view `k` says of `p`: how far in front of the surface it lies, nan for no say.

    `w` is scratch for the direction from the point to the camera.
    """
    T = scene.cameras[k]
    x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
    y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
    z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
    if scene.pinhole:
        x /= z
        y /= z
    # pixel centres lie at + 0.5: the four around the projection are (i, j) .. (i + 1, j + 1)
    u = scene.intrinsics[k, 0] * x + scene.intrinsics[k, 2] - np.float32(0.5)
    v = scene.intrinsics[k, 1] * y + scene.intrinsics[k, 3] - np.float32(0.5)
    by_depth = scene.face.shape[0] == 0
    H, W = scene.depth.shape[1:] if by_depth else scene.face.shape[1:]
    if not (u >= 0.0 and v >= 0.0 and u < W - 1 and v < H - 1):
        return UNSEEN
    j = np.int64(u)
    i = np.int64(v)
    if by_depth:
        return _by_depth(scene.depth[k], i, j, u - j, v - i, z, SMOOTH_STEP * scene.pixel)
    face = scene.face[k]
    f0, f1, f2, f3 = face[i, j], face[i, j + 1], face[i + 1, j], face[i + 1, j + 1]
    if f0 < 0 and f1 < 0 and f2 < 0 and f3 < 0:
        return UNSEEN
    _towards_camera(p, scene.eyes[k], scene.pinhole, w)
    if f0 == f1 and f0 == f2 and f0 == f3:
        return _in_front(p, w, scene.triangles[f0])
    return _weigh(p, w, (f0, f1, f2, f3), scene)


@njit(cache=True, nogil=True, inline="always")
def _towards_camera(p, eye, pinhole, w):
    if not pinhole:
        w[0], w[1], w[2] = eye[0], eye[1], eye[2]
        return
    w[0], w[1], w[2] = eye[0] - p[0], eye[1] - p[1], eye[2] - p[2]
    scale = np.float32(1.0) / np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    w[0] *= scale
    w[1] *= scale
    w[2] *= scale


@njit(cache=True, nogil=True)
def _weigh(p, w, shown, scene):
    """The say of four pixels that show different faces."""
    nearest = UNSEEN
    farthest = -UNSEEN
    for f in shown:
        s = _in_front(p, w, scene.triangles[f]) if f >= 0 else UNSEEN
        nearest = min(nearest, s)
        farthest = max(farthest, s)
    if nearest > 0.0:  # in front of all
        return nearest
    if farthest <= 0.0:  # behind all
        return farthest
    held = np.float32(np.nan)
    for f in shown:
        if f >= 0 and _ray_meets(p, w, scene.triangles[f]):
            s = _in_front(p, w, scene.triangles[f])
            if s <= 0.0:
                return s
            if not held <= s:
                held = s
    # further in front than two pixels' width: beside an edge, and what passes between the pixels
    # may belong to something else
    if not held < np.float32(2.0) * scene.pixel:
        return np.float32(np.nan)
    # `p` is in front of a face that its ray meets and behind others that it misses: a face smaller
    # than a pixel may still hide it, and such a face hangs on one of those
    for f in shown:
        if f >= 0 and _in_front(p, w, scene.triangles[f]) <= 0.0:
            for n in range(scene.start[f], scene.start[f + 1]):
                near = scene.triangles[scene.neighbours[n]]
                if _in_front(p, w, near) <= 0.0 and _ray_meets(p, w, near):
                    return np.float32(np.nan)
    return held


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


@njit(cache=True, nogil=True)
def _by_depth(depth, i, j, a, b, z, step):
    """The say of four depths alone, at (a, b) between them: along the optical axis.

    One smooth surface is interpolated; across a silhouette the four must agree, or have no say.
    """
    d0, d1, d2, d3 = depth[i, j], depth[i, j + 1], depth[i + 1, j], depth[i + 1, j + 1]
    low = min(min(d0, d1), min(d2, d3))
    high = max(max(d0, d1), max(d2, d3))
    if high - low < step:
        one = np.float32(1.0)
        return (one - b) * ((one - a) * d0 + a * d1) + b * ((one - a) * d2 + a * d3) - z
    if low > z:
        return min(low - z, UNSEEN)
    if high <= z:
        return high - z
    return np.float32(np.nan)
