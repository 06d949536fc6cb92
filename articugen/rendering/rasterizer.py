"""The default depth backend: a two-sided z-buffer in numba.

Coverage is decided in exact integer arithmetic on vertices snapped to 1/4096 pixel with a top-left
fill rule, so that neighbouring triangles neither overlap nor leave cracks. Depth is the plane of
the unsnapped triangle at the pixel's centre.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from articugen.geometry import apply
from articugen.records import DepthMaps, LabelledMesh, Views

SUBPIXEL_BITS = 12
SUBPIXELS = 1 << SUBPIXEL_BITS
FEW_PIXELS = 32
"""In the box around a triangle: each centre is asked, which is cheaper than the ends of rows."""
LARGEST_PIXEL = 1 << 15
"""Vertices may project this far outside the image; products then still fit in 63 bits."""


def render(
    mesh: LabelledMesh,
    views: Views,
    *,
    closed: NDArray[np.bool_] | None = None,
    keep_depth: bool = True,
) -> DepthMaps:
    """The depth maps of `mesh` from `views`, with the face seen at each pixel.

    Args:
        mesh: unit frame.
        views: the cameras; every vertex must lie in front of every pinhole camera.
        closed: (F,) which faces bound closed solids, outwards: their backs cannot be seen.
        keep_depth: or only the faces are kept, at half of the memory.

    Raises:
        ValueError: a vertex lies behind a pinhole camera or far outside the image.
    """
    shape = (len(views), views.height, views.width)
    face = np.full(shape, -1, np.int32)
    depth = np.empty(shape if keep_depth else (1, *shape[1:]), np.float32)
    if closed is None:
        closed = np.zeros(len(mesh.faces), np.bool_)
    intrinsics, pinhole = cameras(mesh, views)
    inside = _draw(
        mesh.vertices, mesh.faces, closed, views.T_camera_world, intrinsics, pinhole, depth, face
    )
    check_inside(inside)
    return DepthMaps(depth if keep_depth else None, face, views)


def cameras(mesh: LabelledMesh, views: Views) -> tuple[NDArray[np.float64], bool]:
    """Rows (fx, fy, cx, cy) of the views, and whether they are pinholes.

    Raises:
        ValueError: a vertex lies behind a pinhole camera.
    """
    pinhole = views.projection == "pinhole"
    if pinhole:
        nearest = (apply(T, mesh.vertices)[:, 2].min(initial=np.inf) for T in views.T_camera_world)
        if any(z <= 1e-6 for z in nearest):
            raise ValueError("a vertex lies behind a pinhole camera: move the camera back")
    return np.stack([views.fx, views.fy, views.cx, views.cy], axis=1), pinhole


def check_inside(inside: bool) -> None:
    if not inside:
        raise ValueError(f"a vertex projects more than {LARGEST_PIXEL} pixels outside the image")


@njit(cache=True, nogil=True)
def _draw(vertices, faces, closed, T, intrinsics, pinhole, depth, face):
    snapped = np.empty((vertices.shape[0], 2), np.int32)
    image = np.empty((vertices.shape[0], 3), np.float64)
    for k in range(T.shape[0]):
        if not project(vertices, T[k], intrinsics[k], pinhole, snapped, image):
            return False
        view = depth[k % depth.shape[0]]  # one for all views, or each its own
        view[:] = 0.0 if pinhole else np.inf
        draw_view(faces, closed, snapped, image, view, face[k], 0)
        if pinhole:
            _from_key(view)
    return True


@njit(cache=True, nogil=True)
def project(vertices, T, intrinsics, pinhole, snapped, image):
    """Image coordinates, snapped and exact, and the depth key, which is linear in the image.

    The key is z for an orthographic camera and -1/z for a pinhole: smaller is nearer in both.
    False where a vertex falls too far outside the image.
    """
    fx, fy, cx, cy = intrinsics
    limit = LARGEST_PIXEL
    inside = True
    for i in range(vertices.shape[0]):
        px, py, pz = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        w = 1.0 / z if pinhole else 1.0
        u = fx * x * w + cx
        v = fy * y * w + cy
        inside &= (abs(u) < limit) & (abs(v) < limit)
        image[i, 0] = u
        image[i, 1] = v
        image[i, 2] = -w if pinhole else z
        snapped[i, 0] = np.int32(np.floor(u * SUBPIXELS + 0.5))
        snapped[i, 1] = np.int32(np.floor(v * SUBPIXELS + 0.5))
    return inside


@njit(cache=True, nogil=True)
def to_key(depth, rectangle):
    """Turn pinhole depths into keys within the rows and columns of `rectangle`, ends excluded."""
    top, bottom, left, right = rectangle
    for i in range(top, bottom):
        for j in range(left, right):
            depth[i, j] = np.float32(-1.0) / depth[i, j]


@njit(cache=True, nogil=True)
def _from_key(depth):
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            key = depth[i, j]
            depth[i, j] = -1.0 / key if key < 0.0 else np.inf


@njit(cache=True, nogil=True)
def draw_view(  # noqa: PLR0912, PLR0915 - one loop: a call for each face would cost as much as it
    faces, closed, snapped, image, depth, face, first_face
):
    """Draw triangles over one view's map of depth keys, naming face f `first_face + f`.

    Helpers get numbers, not arrays, each of which would cost two atomic counts at every face.
    """
    height, width = depth.shape
    flat_depth, flat_face = depth.reshape(-1), face.reshape(-1)
    half = SUBPIXELS // 2
    for f in range(faces.shape[0]):
        ia, ib, ic = np.uintp(faces[f, 0]), np.uintp(faces[f, 1]), np.uintp(faces[f, 2])
        a = (np.int64(snapped[ia, 0]), np.int64(snapped[ia, 1]))
        b = (np.int64(snapped[ib, 0]), np.int64(snapped[ib, 1]))
        c = (np.int64(snapped[ic, 0]), np.int64(snapped[ic, 1]))
        area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
        if area == 0 or (area > 0 and closed[f]):  # positive: seen from behind, as v points down
            continue
        first, last = _pixels(a[1], b[1], c[1], height)
        left, right = _pixels(a[0], b[0], c[0], width)
        if first > last or left > right:
            continue
        if area < 0:  # the same triangle the other way round
            b, c = c, b
        pa = (image[ia, 0], image[ia, 1], image[ia, 2])
        pb = (image[ib, 0], image[ib, 1], image[ib, 2])
        pc = (image[ic, 0], image[ic, 1], image[ic, 2])
        k_low, k_high = min(pa[2], pb[2], pc[2]), max(pa[2], pb[2], pc[2])
        A0, B0, C0 = _edge(a, b)
        A1, B1, C1 = _edge(b, c)
        A2, B2, C2 = _edge(c, a)
        if (last - first + 1) * (right - left + 1) <= FEW_PIXELS:
            nearest, known = np.float32(k_low), False
            det = ku = kv = 0.0
            x, y = left * SUBPIXELS + half, first * SUBPIXELS + half
            e0, e1, e2 = A0 * x + B0 * y + C0, A1 * x + B1 * y + C1, A2 * x + B2 * y + C2
            for i in range(first, last + 1):
                f0, f1, f2 = e0, e1, e2
                for j in range(left, right + 1):
                    at = np.uintp(i * width + j)
                    if (f0 | f1 | f2) >= 0 and nearest < flat_depth[at]:
                        if not known:  # few of the small ones need it
                            det, ku, kv = _slopes(pa, pb, pc)
                            known = True
                        base = pa[2] + kv * (i + 0.5 - pa[1]) + ku * (0.5 - pa[0])
                        key = np.float32(min(max(base + ku * j, k_low), k_high))
                        if key < flat_depth[at] and det != 0.0:
                            flat_depth[at] = key
                            flat_face[at] = first_face + f
                    f0 += A0 * SUBPIXELS
                    f1 += A1 * SUBPIXELS
                    f2 += A2 * SUBPIXELS
                e0 += B0 * SUBPIXELS
                e1 += B1 * SUBPIXELS
                e2 += B2 * SUBPIXELS
            continue
        det, ku, kv = _slopes(pa, pb, pc)
        if det == 0.0:
            continue
        r0, r1, r2 = _per_step(A0), _per_step(A1), _per_step(A2)
        for i in range(first, last + 1):
            y = i * SUBPIXELS + half
            j0, j1 = _span(A0, B0 * y + C0, r0, left, right)
            j0, j1 = _span(A1, B1 * y + C1, r1, j0, j1)
            j0, j1 = _span(A2, B2 * y + C2, r2, j0, j1)
            base = pa[2] + kv * (i + 0.5 - pa[1]) + ku * (0.5 - pa[0])
            for j in range(j0, j1 + 1):
                key = np.float32(min(max(base + ku * j, k_low), k_high))
                at = np.uintp(i * width + j)
                if key < flat_depth[at]:
                    flat_depth[at] = key
                    flat_face[at] = first_face + f


@njit(cache=True, nogil=True)
def _pixels(a, b, c, size):
    """The first and the last pixel whose centres lie between three subpixel coordinates."""
    half = SUBPIXELS // 2
    first = (min(a, b, c) - half + SUBPIXELS - 1) >> SUBPIXEL_BITS
    last = (max(a, b, c) - half) >> SUBPIXEL_BITS
    return max(first, 0), min(last, size - 1)


@njit(cache=True, nogil=True)
def _slopes(a, b, c):
    """How the depth key changes with u and v, from the exact vertices; and 0 if it has no say."""
    u1, v1, k1 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    u2, v2, k2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    det = u1 * v2 - u2 * v1
    if det == 0.0:
        return 0.0, 0.0, 0.0
    return det, (k1 * v2 - k2 * v1) / det, (u1 * k2 - u2 * k1) / det


@njit(cache=True, nogil=True)
def _edge(a, b):
    """An edge's function A x + B y + C, not negative inside.

    Of two triangles at an edge the one that has it on top or left owns the pixels on it: for the
    other one C is less by one unit.
    """
    A = a[1] - b[1]
    B = b[0] - a[0]
    C = a[0] * b[1] - b[0] * a[1]
    if not (A > 0 or (A == 0 and B > 0)):
        C -= 1
    return A, B, C


@njit(cache=True, nogil=True, inline="always")
def _per_step(A):
    return 1.0 / (A * SUBPIXELS) if A != 0 else 0.0


@njit(cache=True, nogil=True)
def _span(A, rest, per_step, j0, j1):
    """The pixels j in [j0, j1] with A * (j * SUBPIXELS + SUBPIXELS / 2) + rest >= 0.

    `per_step` is 1 / (A * SUBPIXELS), which gives the pixel to within one; integers decide.
    """
    value = A * (SUBPIXELS // 2) + rest
    step = A * SUBPIXELS
    if A > 0:
        j = np.int64(np.ceil(-value * per_step))
        if value + step * j < 0:
            j += 1
        elif value + step * (j - 1) >= 0:
            j -= 1
        j0 = max(j0, j)
    elif A < 0:
        j = np.int64(np.floor(-value * per_step))
        if value + step * j < 0:
            j -= 1
        elif value + step * (j + 1) >= 0:
            j += 1
        j1 = min(j1, j)
    elif value < 0:
        j1 = j0 - 1
    return j0, j1
