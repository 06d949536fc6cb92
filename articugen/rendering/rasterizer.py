"""The default depth backend: a two-sided z-buffer in numba.

Coverage is decided in exact integer arithmetic on vertices snapped to 1/4096 pixel with a top-left
fill rule, so that neighbouring triangles neither overlap nor leave cracks. Depth is the plane of
the unsnapped triangle at the pixel's centre.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from articugen.geometry import apply
from articugen.jit import helper, inlined, kernel
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
    draw(mesh, views, closed, depth, face)
    return DepthMaps(depth if keep_depth else None, face, views)


@dataclass(frozen=True, eq=False)
class Below:
    """Maps to draw over. K views.

    Attributes:
        depth, face: (K, H, W), or (0, 0, 0) for none.
        drawn: (K, 4) first row, end, first column, end of the rectangle that was drawn over last,
            which is first made as it was, and then set to what is drawn over now.
    """

    depth: NDArray[np.float32]
    face: NDArray[np.int32]
    drawn: NDArray[np.int64]


_NOTHING = Below(
    np.zeros((0, 0, 0), np.float32), np.zeros((0, 0, 0), np.int32), np.zeros((0, 4), np.int64)
)


def draw(
    mesh: LabelledMesh,
    views: Views,
    closed: NDArray[np.bool_],
    depth: NDArray[np.float32],
    face: NDArray[np.int32],
    *,
    first_face: int = 0,
    below: Below = _NOTHING,
) -> None:
    """Draw `mesh` into `face` (K, H, W), where face f of it is `first_face + f`.

    Args:
        mesh, views, closed: as for `render`.
        depth: (K, H, W), or (1, H, W) where the depth is not wanted.
        below: what `face` shows already.

    Raises:
        ValueError: as `render`.
    """
    pinhole = views.projection == "pinhole"
    if pinhole:
        nearest = (apply(T, mesh.vertices)[:, 2].min(initial=np.inf) for T in views.T_camera_world)
        if any(z <= 1e-6 for z in nearest):
            raise ValueError("a vertex lies behind a pinhole camera: move the camera back")
    intrinsics = np.stack([views.fx, views.fy, views.cx, views.cy], axis=1)
    if not _draw(
        mesh.vertices, mesh.faces, closed, views.T_camera_world, intrinsics, pinhole,
        first_face, depth, face, below.depth, below.face, below.drawn,
    ):  # fmt: skip
        raise ValueError(f"a vertex projects more than {LARGEST_PIXEL} pixels outside the image")


@kernel
def _draw(
    vertices, faces, closed, T, intrinsics, pinhole, first_face, depth, face, below, face_below,
    drawn,
):  # fmt: skip
    """Draw all views; whether no vertex falls too far outside. See `draw` and `Below`.

    One kernel, with maps below or without: what it is made of takes seconds to compile.
    """
    snapped = np.empty((vertices.shape[0], 2), np.int32)
    image = np.empty((vertices.shape[0], 3), np.float64)
    height, width = face.shape[1], face.shape[2]
    over = below.shape[0] > 0
    for k in range(T.shape[0]):
        view = depth[k % depth.shape[0]]  # one for all views, or each its own
        if over:
            _copy(face_below[k], face[k], (drawn[k, 0], drawn[k, 1], drawn[k, 2], drawn[k, 3]))
            drawn[k, 0] = drawn[k, 1] = drawn[k, 2] = drawn[k, 3] = 0
            if vertices.shape[0] == 0:
                continue
        camera = (intrinsics[k, 0], intrinsics[k, 1], intrinsics[k, 2], intrinsics[k, 3])
        if not _project(vertices, T[k], camera, pinhole, snapped, image):
            return False
        if over:  # only this rectangle of `view` is ever set
            box = _rectangle(image, height, width)
            drawn[k, 0], drawn[k, 1], drawn[k, 2], drawn[k, 3] = box
            _copy(below[k], view, box)
            if pinhole:
                _to_key(view, box)
        else:
            view[:] = np.float32(0.0) if pinhole else np.float32(np.inf)
        _draw_view(faces, closed, snapped, image, view, face[k], first_face)
        if pinhole and not over:
            _from_key(view)
    return True


@helper
def _copy(source, target, rectangle):
    """Row by row in flat, unsigned numbers, which become plain copies of memory."""
    top, bottom, left, right = rectangle
    flat_source, flat_target = source.reshape(-1), target.reshape(-1)
    for i in range(top, bottom):
        start = np.uintp(i * source.shape[1] + left)
        for n in range(right - left):
            flat_target[start + np.uintp(n)] = flat_source[start + np.uintp(n)]


@helper
def _rectangle(image, height, width):
    """The rows and columns, ends excluded, that hold the projected vertices; there are some."""
    low_u = low_v = np.inf
    high_u = high_v = -np.inf
    for i in range(image.shape[0]):
        u, v = image[i, 0], image[i, 1]
        low_u, high_u = min(low_u, u), max(high_u, u)
        low_v, high_v = min(low_v, v), max(high_v, v)
    top, left = max(int(np.floor(low_v)) - 1, 0), max(int(np.floor(low_u)) - 1, 0)
    bottom, right = min(int(high_v) + 2, height), min(int(high_u) + 2, width)
    return top, max(bottom, top), left, max(right, left)


@helper
def _project(vertices, T, camera, pinhole, snapped, image):
    """Image coordinates, snapped and exact, and the depth key, which is linear in the image.

    The key is z for an orthographic camera and -1/z for a pinhole: smaller is nearer in both.
    False where a vertex falls too far outside the image.
    """
    fx, fy, cx, cy = camera
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


@helper
def _to_key(depth, rectangle):
    """Turn pinhole depths into keys within the rows and columns of `rectangle`, ends excluded."""
    top, bottom, left, right = rectangle
    for i in range(top, bottom):
        for j in range(left, right):
            depth[i, j] = np.float32(-1.0) / depth[i, j]


@helper
def _from_key(depth):
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            key = depth[i, j]
            depth[i, j] = -1.0 / key if key < 0.0 else np.inf


@helper
def _draw_view(  # noqa: PLR0912, PLR0915 - one loop: a call for each face would cost as much as it
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


@helper
def _pixels(a, b, c, size):
    """The first and the last pixel whose centres lie between three subpixel coordinates."""
    half = SUBPIXELS // 2
    first = (min(a, b, c) - half + SUBPIXELS - 1) >> SUBPIXEL_BITS
    last = (max(a, b, c) - half) >> SUBPIXEL_BITS
    return max(first, 0), min(last, size - 1)


@helper
def _slopes(a, b, c):
    """How the depth key changes with u and v, from the exact vertices; and 0 if it has no say."""
    u1, v1, k1 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    u2, v2, k2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    det = u1 * v2 - u2 * v1
    if det == 0.0:
        return 0.0, 0.0, 0.0
    return det, (k1 * v2 - k2 * v1) / det, (u1 * k2 - u2 * k1) / det


@helper
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


@inlined
def _per_step(A):
    return 1.0 / (A * SUBPIXELS) if A != 0 else 0.0


@helper
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
