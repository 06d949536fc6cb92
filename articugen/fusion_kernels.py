"""The numba kernels of fusion: what one view says of one point, and how the views add up.

`Scene` bundles what the kernels read; see `fusion.Field` for where it comes from.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from articugen.hierarchy import in_front, line_meets, meets

UNSEEN = np.float32(1e9)
"""Signed distance where a view sees nothing behind the point."""

SMOOTH_STEP = np.float32(4.0)
"""Without face ids: depths that differ by less than this many pixels' width are one surface."""


class Scene(NamedTuple):
    """Depth maps and faces as the kernels read them; float32 and int32 arrays.

    Attributes:
        depth: (K, H, W), or (1, 0, 0) where `face` is known.
        face: (K, H, W), or (1, 0, 0) where only depth is known.
        cameras: (K, 3, 4) world to camera.
        intrinsics: (K, 4) fx, fy, cx, cy.
        eyes: (K, 3) the eye (pinhole), or the unit direction to the camera (orthographic).
        pinhole: whether the cameras are pinholes.
        triangles: (F, 16) as posed, see `hierarchy.triangle_table`.
        hierarchy: of each part in its canonical pose.
        to_part: (P, 3, 4) from the pose at hand to each part's canonical pose.
        pixel: the width of a pixel at the object, unit frame.
    """

    depth: Any
    face: Any
    cameras: Any
    intrinsics: Any
    eyes: Any
    pinhole: Any
    triangles: Any
    hierarchy: Any
    to_part: Any
    pixel: Any


@njit(cache=True, nogil=True)
def is_free(points, scene):
    """(n,) which points at least one view sees free; a point is done with at the first."""
    free = np.zeros(points.shape[0], np.bool_)
    waiting = np.arange(points.shape[0])
    left = points.shape[0]
    for k in range(scene.cameras.shape[0]):
        T, face, depth, lens, eye = _view(k, scene)
        kept = 0
        for n in range(left):
            index = waiting[n]
            p = (points[index, 0], points[index, 1], points[index, 2])
            if _look(p, T, face, depth, lens, eye, scene) > 0.0:
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
    for k in range(scene.cameras.shape[0]):
        T, face, depth, lens, eye = _view(k, scene)
        for i in range(n):
            p = (points[i, 0], points[i, 1], points[i, 2])
            s = _look(p, T, face, depth, lens, eye, scene)
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


@njit(cache=True, nogil=True, inline="always")
def _view(k, scene):
    """One view's numbers as tuples, which cost nothing to pass, and its map."""
    c, i, e = scene.cameras, scene.intrinsics, scene.eyes
    T = (
        (c[k, 0, 0], c[k, 0, 1], c[k, 0, 2], c[k, 0, 3]),
        (c[k, 1, 0], c[k, 1, 1], c[k, 1, 2], c[k, 1, 3]),
        (c[k, 2, 0], c[k, 2, 1], c[k, 2, 2], c[k, 2, 3]),
    )
    by_depth = scene.face.shape[1] == 0
    face = scene.face[0 if by_depth else k]
    depth = scene.depth[k if by_depth else 0]
    return T, face, depth, (i[k, 0], i[k, 1], i[k, 2], i[k, 3]), (e[k, 0], e[k, 1], e[k, 2])


@njit(cache=True, nogil=True, inline="always")
def _row(row, p):
    return row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + row[3]


@njit(cache=True, nogil=True, inline="always")
def _look(p, T, face, depth, lens, eye, scene):
    """What a view says of `p`: how far in front of the surface it lies, nan for no say."""
    x = _row(T[0], p)
    y = _row(T[1], p)
    if scene.pinhole:
        z = _row(T[2], p)
        x /= z
        y /= z
    # pixel centres lie at + 0.5: the four around the projection are (i, j) .. (i + 1, j + 1)
    u = lens[0] * x + lens[2] - np.float32(0.5)
    v = lens[1] * y + lens[3] - np.float32(0.5)
    by_depth = face.shape[0] == 0
    H, W = depth.shape if by_depth else face.shape
    if not (u >= 0.0 and v >= 0.0 and u < W - 1 and v < H - 1):
        return UNSEEN
    j = np.int64(u)
    i = np.int64(v)
    if by_depth:
        return _by_depth(depth, i, j, u - j, v - i, _row(T[2], p), SMOOTH_STEP * scene.pixel)
    shown = (face[i, j], face[i, j + 1], face[i + 1, j], face[i + 1, j + 1])
    if shown[0] == shown[1] and shown[0] == shown[2] and shown[0] == shown[3]:
        if shown[0] < 0:
            return UNSEEN
        w = _towards_camera(p, eye, scene.pinhole)
        return in_front(p, w, scene.triangles, shown[0])
    return _weigh(p, _towards_camera(p, eye, scene.pinhole), shown, scene)


@njit(cache=True, nogil=True, inline="always")
def _towards_camera(p, eye, pinhole):
    if not pinhole:
        return eye
    x, y, z = eye[0] - p[0], eye[1] - p[1], eye[2] - p[2]
    scale = np.float32(1.0) / np.sqrt(x * x + y * y + z * z)
    return x * scale, y * scale, z * scale


@njit(cache=True, nogil=True, inline="always")
def _weigh(p, w, shown, scene):
    """The say of four pixels that show different faces."""
    nearest = UNSEEN
    farthest = -UNSEEN
    for f in shown:
        s = in_front(p, w, scene.triangles, f) if f >= 0 else UNSEEN
        nearest = min(nearest, s)
        farthest = max(farthest, s)
    if nearest > 0.0:  # in front of all
        return nearest
    if farthest <= 0.0:  # behind all
        return farthest
    for f in shown:
        if f >= 0 and line_meets(p, w, scene.triangles, f):
            s = in_front(p, w, scene.triangles, f)
            if s <= 0.0:  # behind a face that its ray meets
                return s
    # in front of some and behind others, and none of them is in the way: something that shows at
    # no pixel's centre may still be
    h = scene.hierarchy
    if meets(p, w, scene.to_part, h.box, h.skip, h.leaf, h.triangles, h.roots):
        return np.float32(np.nan)
    return _just_in_front(p, w, shown, scene.triangles)


@njit(cache=True, nogil=True)
def _just_in_front(p, w, shown, triangles):
    """How far `p` is in front of the nearest of the faces shown that it is in front of."""
    nearest = UNSEEN
    for f in shown:
        if f >= 0:
            s = in_front(p, w, triangles, f)
            if s > 0.0:
                nearest = min(nearest, s)
    return nearest


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
