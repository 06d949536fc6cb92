"""The numba kernels of fusion: what one view says of one point, and how the views add up.

`Scene` bundles what the kernels read; see `fusion.FusedField` for where it comes from.
"""

from typing import Any, NamedTuple

import numpy as np

from articugen.core.jit import dot, helper, inlined, kernel, vector
from articugen.meshes.bvh import behind, in_front, line_meets, meets

UNSEEN = np.float32(1e9)  # signed distance where a view sees nothing behind the point
ENDLESS = np.float32(np.inf)

_HIDDEN, _FREE = 0, 1

BLOCK = 2048  # points that are projected at a time: their coordinates stay in the first-level cache
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
        triangles: (F, 16) as posed, see `bvh.triangle_table`.
        bvh: of each part in its canonical pose.
        to_part: (P, 3, 4) from the current pose to each part's canonical pose.
        pixel: the width of a pixel at the object, unit frame.
        thin: see `thin.ThinVoxels`.
    """

    depth: Any
    face: Any
    cameras: Any
    intrinsics: Any
    eyes: Any
    pinhole: Any
    triangles: Any
    bvh: Any
    to_part: Any
    pixel: Any
    thin: Any


@kernel
def is_free(points, which, scene, end_view):
    """Return (m,) which of points[which] at least one view before `end_view` sees free; a point is
    done with at the first.

    View by view over the points that are left, which stay packed: a view's map stays in the cache.
    A block is projected, then the faces around its points are read, then judged: three short loops,
    of which the first is vectorised and the second waits for memory many times at once.
    """
    n = which.shape[0]
    free = np.zeros(n, np.bool_)
    x, y, z = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    for i in range(n):
        x[i], y[i], z[i] = points[which[i], 0], points[which[i], 1], points[which[i], 2]
    index = np.arange(n)
    u, v = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    depth = np.empty(BLOCK, np.float32)
    at, around = np.empty(BLOCK, np.int32), np.empty((BLOCK, 4), np.int32)
    verdict = np.empty(BLOCK, np.uint8)
    left = n
    # arrays out of the tuple once, not at every point: each time counts its references
    triangles, bvh, to_part = scene.triangles, scene.bvh, scene.to_part
    thin = scene.thin
    pinhole, pixel, by_depth = scene.pinhole, scene.pixel, scene.face.shape[1] == 0
    for k in range(end_view):
        camera = _camera(k, scene)
        face_map, depth_map = _maps(k, scene)
        kept = 0
        for first in range(0, left, BLOCK):
            block = slice(first, min(first + BLOCK, left))
            bx, by, bz, origin = x[block], y[block], z[block], index[block]
            _project(bx, by, bz, camera, pinhole, u, v, depth)
            if by_depth:
                for i in range(bx.shape[0]):
                    gap = _gap_by_depth(u[i], v[i], depth[i], depth_map, pixel)
                    verdict[i] = _FREE if gap > 0.0 else _HIDDEN
            else:
                _read_around(u, v, bx.shape[0], face_map, at, around)
                _judge(bx, by, bz, around, camera, pinhole, triangles, bvh, to_part, thin, verdict)
            seen_free = 0
            for i in range(bx.shape[0]):
                seen_free += verdict[i]
            if seen_free == 0 and kept == first:  # all stay, where they are
                kept += bx.shape[0]
                continue
            for i in range(bx.shape[0]):
                if verdict[i] == _FREE:
                    free[origin[i]] = True
                else:
                    x[kept], y[kept], z[kept] = bx[i], by[i], bz[i]
                    index[kept] = origin[i]
                    kept += 1
        left = kept
    return free


@helper
def _judge(x, y, z, around, camera, pinhole, triangles, bvh, to_part, thin, verdict):
    """Judge points by one view, given the faces at the four pixels around each.

    _HIDDEN where all four show one face and the point is behind it; _FREE where it is behind none
    of them and nothing thin is near; else the ray itself is followed. Only numbers are handed
    on: an array handed to a function costs numba two atomic counts, here at every look.
    """
    bits, n = thin.bits, thin.resolution
    rows, columns, eighths = (
        np.uintp(bits.shape[0]), np.uintp(bits.shape[1]), np.uintp(bits.shape[2])
    )  # fmt: skip
    first = (thin.first[0], thin.first[1], thin.first[2])
    for i in range(x.shape[0]):
        p = (x[i], y[i], z[i])
        f = around[i, 0]
        same = (f == around[i, 1]) & (f == around[i, 2]) & (f == around[i, 3])
        w = _towards_camera(p, camera[4], pinhole)
        looks = 1 if same else 4
        doubt = crossed = False
        for q in range(looks):
            f = around[i, q]
            if f < 0 or (q > 0 and f == around[i, q - 1]) or (q > 1 and f == around[i, q - 2]):
                continue
            t = np.uintp(f)  # unsigned: numba does not ask whether to count from the end
            plane = (triangles[t, 0], triangles[t, 1], triangles[t, 2], triangles[t, 3])
            if behind(p, w, plane):
                doubt = True
                if same or line_meets(
                    p, w,
                    (triangles[t, 4], triangles[t, 5], triangles[t, 6]),
                    (triangles[t, 7], triangles[t, 8], triangles[t, 9]),
                    (triangles[t, 10], triangles[t, 11], triangles[t, 12]),
                ):  # fmt: skip
                    crossed = True
                    break
        if crossed:
            verdict[i] = _HIDDEN
            continue
        if not doubt:
            a, b = _voxel(p[0], n, first[0]), _voxel(p[1], n, first[1])
            c = _voxel(p[2], n, first[2])
            byte = c >> np.uintp(3)
            if a < rows and b < columns and byte < eighths:
                doubt = (bits[a, b, byte] >> (c & np.uintp(7))) & 1 == 1
        if not doubt:
            verdict[i] = _FREE
        else:  # none of what shows is in the way: what shows at no pixel's centre may still be
            verdict[i] = _FREE if _leaves(p, w, bvh, to_part) else _HIDDEN


@inlined
def _voxel(x, n, first):
    """Along one axis, counted from `first`; before it the number is larger than any."""
    return np.uintp(min(max(np.int64((x + np.float32(0.5)) * n), 0), n - 1) - first)


@kernel
def in_box(points, which, T, box):
    """Return those of `which`, indices into `points` (n, 3), that T (4, 4) takes into the box (2,
    3), and where it takes them (m, 3)."""
    a, b, c, d = vector(T, 0), vector(T, 1), vector(T, 2), (T[0, 3], T[1, 3], T[2, 3])
    low, high = vector(box, 0), vector(box, 1)
    hits, moved = np.empty(which.shape[0], np.int64), np.empty((which.shape[0], 3))
    count = np.uintp(0)
    for n in range(which.shape[0]):
        i = which[n]
        p = vector(points, i)
        x, y, z = dot(a, p) + d[0], dot(b, p) + d[1], dot(c, p) + d[2]
        hits[count] = i
        moved[count, 0], moved[count, 1], moved[count, 2] = x, y, z
        inside = (low[0] < x) & (x < high[0]) & (low[1] < y) & (y < high[1])  # without a branch
        count += np.uintp(inside & (low[2] < z) & (z < high[2]))
    return hits[:count], moved[:count]


@kernel
def value(points, scene, truncation, mean):
    """Return (n,) the truncated signed distances of the views, averaged as `fusion` says."""
    n = points.shape[0]
    x, y, z = points[:, 0].copy(), points[:, 1].copy(), points[:, 2].copy()
    u, v, depth = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    at, around = np.empty(n, np.int32), np.empty((n, 4), np.int32)
    verdict = np.empty(n, np.uint8)
    total = np.zeros((n, 2))  # of the views that see the point free, and that it lies close behind
    views = np.zeros((n, 2))
    triangles, bvh, to_part = scene.triangles, scene.bvh, scene.to_part
    thin = scene.thin
    pinhole, pixel, by_depth = scene.pinhole, scene.pixel, scene.face.shape[1] == 0
    for k in range(scene.cameras.shape[0]):
        camera = _camera(k, scene)
        face_map, depth_map = _maps(k, scene)
        _project(x, y, z, camera, pinhole, u, v, depth)
        if not by_depth:
            _read_around(u, v, n, face_map, at, around)
            _judge(x, y, z, around, camera, pinhole, triangles, bvh, to_part, thin, verdict)
        for i in range(n):
            if by_depth:
                s = _gap_by_depth(u[i], v[i], depth[i], depth_map, pixel)
                free = s > 0.0
            else:
                p = (x[i], y[i], z[i])
                shown = (around[i, 0], around[i, 1], around[i, 2], around[i, 3])
                free = verdict[i] == _FREE
                s = _distance(p, shown, camera, pinhole, triangles, free)
            if free:
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


@inlined
def _camera(k, scene):
    """Return one view's numbers as tuples, which cost nothing to pass: three rows, lens, eye."""
    c, i, e = scene.cameras, scene.intrinsics, scene.eyes
    return (
        (c[k, 0, 0], c[k, 0, 1], c[k, 0, 2], c[k, 0, 3]),
        (c[k, 1, 0], c[k, 1, 1], c[k, 1, 2], c[k, 1, 3]),
        (c[k, 2, 0], c[k, 2, 1], c[k, 2, 2], c[k, 2, 3]),
        (i[k, 0], i[k, 1], i[k, 2], i[k, 3]),
        (e[k, 0], e[k, 1], e[k, 2]),
    )


@inlined
def _maps(k, scene):
    by_depth = scene.face.shape[1] == 0
    return scene.face[0 if by_depth else k], scene.depth[k if by_depth else 0]


@helper
def _project(x, y, z, camera, pinhole, u, v, depth):
    """Compute where points fall between pixel centres: pixel (i, j) is at (u, v) = (j, i) here."""
    a, b, c, lens, _ = camera
    fx, fy = lens[0], lens[1]
    cx, cy = lens[2] - np.float32(0.5), lens[3] - np.float32(0.5)
    for n in range(x.shape[0]):
        right = a[0] * x[n] + a[1] * y[n] + a[2] * z[n] + a[3]
        down = b[0] * x[n] + b[1] * y[n] + b[2] * z[n] + b[3]
        ahead = c[0] * x[n] + c[1] * y[n] + c[2] * z[n] + c[3]
        w = np.float32(1.0) / ahead if pinhole else np.float32(1.0)
        u[n] = fx * right * w + cx
        v[n] = fy * down * w + cy
        depth[n] = ahead


@helper
def _read_around(u, v, count, face_map, at, around):
    """Return the faces at the four pixels around each (u, v); -1 outside the image."""
    height, width = face_map.shape
    last_u, last_v = np.float32(width - 1), np.float32(height - 1)
    for n in range(count):
        inside = (u[n] >= 0.0) & (v[n] >= 0.0) & (u[n] < last_u) & (v[n] < last_v)
        at[n] = np.int32(v[n]) * width + np.int32(u[n]) if inside else -1
    right, below = np.uintp(1), np.uintp(width)
    flat = face_map.reshape(-1)
    for n in range(count):
        if at[n] < 0:
            around[n, 0], around[n, 1], around[n, 2], around[n, 3] = -1, -1, -1, -1
        else:  # unsigned: numba does not ask whether to count from the end
            i = np.uintp(at[n])
            around[n, 0], around[n, 1] = flat[i], flat[i + right]
            around[n, 2], around[n, 3] = flat[i + below], flat[i + below + right]


@helper
def _leaves(p, w, bvh, to_part):
    """Return whether the ray from `p` towards the camera, `w`, meets nothing on its way."""
    h = bvh
    return not meets(p, w, ENDLESS, to_part, h.box, h.skip, h.leaf, h.triangles, h.roots)


@helper
def _distance(p, shown, camera, pinhole, triangles, free):
    """Return how far in front of the surface a view sees the point, given whether it sees it free.

    To the nearest of the four faces on that side.
    """
    nearest = UNSEEN if free else -UNSEEN
    w = _towards_camera(p, camera[4], pinhole)
    for f in shown:
        if f >= 0:
            plane = (triangles[f, 0], triangles[f, 1], triangles[f, 2], triangles[f, 3])
            s = in_front(p, w, plane)
            if free and s > 0.0:
                nearest = min(nearest, s)
            elif not free and s <= 0.0:
                nearest = max(nearest, s)
    return nearest


@inlined
def _towards_camera(p, eye, pinhole):
    if not pinhole:
        return eye
    x, y, z = eye[0] - p[0], eye[1] - p[1], eye[2] - p[2]
    scale = np.float32(1.0) / np.sqrt(x * x + y * y + z * z)
    return x * scale, y * scale, z * scale


@helper
def _gap_by_depth(u, v, z, depth_map, pixel):
    """Return how far in front of four depths, at (u, v) among them, along the optical axis.

    One smooth surface is interpolated; across a silhouette the four must agree: else nan, no say.
    """
    height, width = depth_map.shape
    if not (u >= 0.0 and v >= 0.0 and u < width - 1 and v < height - 1):
        return UNSEEN
    i, j = np.int64(v), np.int64(u)
    a, b = u - np.float32(j), v - np.float32(i)
    d0, d1 = depth_map[i, j], depth_map[i, j + 1]
    d2, d3 = depth_map[i + 1, j], depth_map[i + 1, j + 1]
    low = min(d0, d1, d2, d3)
    high = max(d0, d1, d2, d3)
    if high - low < SMOOTH_STEP * pixel:
        one = np.float32(1.0)
        return (one - b) * ((one - a) * d0 + a * d1) + b * ((one - a) * d2 + a * d3) - z
    if low > z:
        return min(low - z, UNSEEN)
    if high <= z:
        return high - z
    return np.float32(np.nan)
