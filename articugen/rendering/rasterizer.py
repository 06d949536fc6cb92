"""The default depth backend: a two-sided z-buffer in numba.

Coverage is decided in exact integer arithmetic on vertices snapped to 1/4096 pixel with a top-left
fill rule, so that neighbouring triangles neither overlap nor leave cracks. Depth is the plane of
the unsnapped triangle at the pixel's centre.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bools, Ints
from articugen.core.geometry import apply
from articugen.core.jit import helper, inlined, kernel
from articugen.core.records import DepthMaps, LabelledMesh, Views

SUBPIXEL_BITS = 12
SUBPIXELS = 1 << SUBPIXEL_BITS
FEW_PIXELS = 32
"""In the box around a triangle: each centre is asked, which is cheaper than the ends of rows."""
LARGEST_PIXEL = 1 << 15
"""Vertices may project this far outside the image; products then still fit in 63 bits."""


def render(
    mesh: LabelledMesh, views: Views, *, closed: Bools | None = None, keep_depth: bool = True
) -> DepthMaps:
    """Return the depth maps of `mesh` from `views`, with the face seen at each pixel.

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
    drawn: Ints


_NOTHING = Below(
    np.zeros((0, 0, 0), np.float32), np.zeros((0, 0, 0), np.int32), np.zeros((0, 4), np.int64)
)


def draw(
    mesh: LabelledMesh,
    views: Views,
    closed: Bools,
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
    if not _draw(
        mesh.vertices, mesh.faces, closed, views.T_camera_world, views.intrinsics, pinhole,
        first_face, depth, face, below.depth, below.face, below.drawn,
    ):  # fmt: skip
        raise ValueError(f"a vertex projects more than {LARGEST_PIXEL} pixels outside the image")


class Overlay:
    """The faces seen when others are drawn over those that stay where they are, again and again.

    Only the rectangle that the moving faces can touch is read and restored, and only the faces seen
    are kept: with the faces' planes they say the depth more exactly than a depth map.
    """

    def __init__(self, fixed: DepthMaps) -> None:
        """`fixed`: depth and faces of what does not move."""
        assert fixed.depth is not None
        assert fixed.face is not None
        self._views = fixed.views
        self._below = Below(fixed.depth, fixed.face, np.zeros((len(fixed.views), 4), np.int64))
        self._face = fixed.face.copy()

    def draw(self, mesh: LabelledMesh, *, closed: Bools, first_face: int) -> DepthMaps:
        """Draw a mesh, see `core.backends.Overlay`; `closed` and ValueError as in `render`."""
        depth = np.empty((1, *self._face.shape[1:]), np.float32)
        draw(mesh, self._views, closed, depth, self._face, first_face=first_face, below=self._below)
        return DepthMaps(None, self._face, self._views)


@kernel
def _draw(
    vertices, faces, closed, T, intrinsics, pinhole, first_face, depth, face, below, face_below,
    drawn,
):  # fmt: skip
    """Draw all views; whether no vertex falls too far outside. See `draw` and `Below`.

    One kernel, with maps below or without: what it is made of takes seconds to compile.
    """
    n = vertices.shape[0]
    x, y, z = np.empty(n, np.float64), np.empty(n, np.float64), np.empty(n, np.float64)
    for i in range(n):
        x[i], y[i], z[i] = vertices[i, 0], vertices[i, 1], vertices[i, 2]
    u, v, centres = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32)
    kept = np.empty(faces.shape[0], np.int32)
    height, width = face.shape[1], face.shape[2]
    over = below.shape[0] > 0
    for k in range(T.shape[0]):
        view = depth[k % depth.shape[0]]  # one for all views, or each its own
        if over:
            _copy(face_below[k], face[k], (drawn[k, 0], drawn[k, 1], drawn[k, 2], drawn[k, 3]))
            drawn[k, 0] = drawn[k, 1] = drawn[k, 2] = drawn[k, 3] = 0
            if n == 0:
                continue
        camera = _camera(T[k], intrinsics[k])
        if not _project(x, y, z, camera, pinhole, width, height, u, v, centres):
            return False
        if over:  # only this rectangle of `view` is ever set
            box = _rectangle(u, v, height, width)
            drawn[k, 0], drawn[k, 1], drawn[k, 2], drawn[k, 3] = box
            _copy(below[k], view, box)
            if pinhole:
                _invert(view, box)
        else:
            view[:] = np.float32(-0.0) if pinhole else np.float32(np.inf)
        count = _around_a_centre(faces, centres, kept)
        _draw_view(
            kept, count, faces, closed, vertices, camera, pinhole, u, v, view, face[k], first_face
        )
        if pinhole and not over:
            _invert(view, (0, height, 0, width))
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
def _rectangle(u, v, height, width):
    """Return rows and columns, ends excluded, that hold the snapped vertices; there are some."""
    low_u, high_u = u[0], u[0]
    low_v, high_v = v[0], v[0]
    for i in range(u.shape[0]):
        low_u, high_u = min(low_u, u[i]), max(high_u, u[i])
        low_v, high_v = min(low_v, v[i]), max(high_v, v[i])
    top, left = max((low_v >> SUBPIXEL_BITS) - 1, 0), max((low_u >> SUBPIXEL_BITS) - 1, 0)
    bottom = min((high_v >> SUBPIXEL_BITS) + 2, height)
    right = min((high_u >> SUBPIXEL_BITS) + 2, width)
    return top, max(bottom, top), left, max(right, left)


@helper
def _camera(T, lens):
    """Return one view's numbers as tuples: three rows and the lens."""
    return (
        (T[0, 0], T[0, 1], T[0, 2], T[0, 3]),
        (T[1, 0], T[1, 1], T[1, 2], T[1, 3]),
        (T[2, 0], T[2, 1], T[2, 2], T[2, 3]),
        (lens[0], lens[1], lens[2], lens[3]),
    )


@helper
def _project(x, y, z, camera, pinhole, width, height, u, v, centres):
    """Return where vertices fall, in subpixels, and between which pixels' centres, see `_between`.

    False where a vertex falls too far outside the image. Nothing else is kept: `_on_image` makes
    the rest again for the few faces that need it, and so short a loop is vectorised.
    """
    limit, half = np.float64(LARGEST_PIXEL), np.int32(SUBPIXELS // 2)
    last_u, last_v = np.int32(2 * width - 1), np.int32(2 * height - 1)
    outside = 0
    for i in range(x.shape[0]):
        p = (x[i], y[i], z[i])
        at_u, at_v, _ = _on_image(p, camera, pinhole)
        outside += (not abs(at_u) < limit) | (not abs(at_v) < limit)
        su = np.int32(np.floor(at_u * SUBPIXELS + 0.5))
        sv = np.int32(np.floor(at_v * SUBPIXELS + 0.5))
        u[i], v[i] = su, sv
        column, row = _between(su, half, last_u), _between(sv, half, last_v)
        centres[i] = np.int32((column << np.int32(16)) | (row & np.int32(0xFFFF)))
    return outside == 0


@helper
def _between(at, half, last):
    """Return 2 i on the centre of pixel i, 2 i + 1 between two; -1 or `last` beyond the image."""
    bits = np.int32(SUBPIXEL_BITS)
    place = ((at + half - np.int32(1)) >> bits) + ((at - half) >> bits)
    return min(max(place, np.int32(-1)), last)


@helper
def _around_a_centre(faces, centres, kept):
    """Into `kept` the faces whose box holds the centre of a pixel, and how many they are: of a
    finely cut model few. The others' corners lie in one place between two rows or columns, or on
    one line through centres, where they have no area."""
    hits = 0
    for f in range(faces.shape[0]):
        a = centres[np.uintp(faces[f, 0])]
        unlike = (a ^ centres[np.uintp(faces[f, 1])]) | (a ^ centres[np.uintp(faces[f, 2])])
        kept[np.uintp(hits)] = f
        hits += ((unlike & 0xFFFF) != 0) & ((unlike >> 16) != 0)
    return hits


@helper
def _on_image(p, camera, pinhole):
    """Return the image coordinates of `p`, not snapped, and its depth key, which is linear in the
    image.

    The key is z for an orthographic camera and -1/z for a pinhole: smaller is nearer in both.
    """
    a, b, c, lens = camera
    x = a[0] * p[0] + a[1] * p[1] + a[2] * p[2] + a[3]
    y = b[0] * p[0] + b[1] * p[1] + b[2] * p[2] + b[3]
    z = c[0] * p[0] + c[1] * p[1] + c[2] * p[2] + c[3]
    w = 1.0 / z if pinhole else 1.0
    return lens[0] * x * w + lens[2], lens[1] * y * w + lens[3], -w if pinhole else z


@helper
def _invert(depth, rectangle):
    """Turn pinhole depths into keys, or keys into depths, within the rows and columns of
    `rectangle`, ends excluded. The key of nothing, which is at inf, is -0."""
    top, bottom, left, right = rectangle
    for i in range(top, bottom):
        for j in range(left, right):
            depth[i, j] = np.float32(-1.0) / depth[i, j]


@helper
def _draw_view(  # noqa: PLR0912, PLR0915 - one loop: a call for each face would cost as much as it
    kept, count, faces, closed, vertices, camera, pinhole, u, v, depth, face, first_face
):
    """Draw the first `count` faces in `kept` over one view's map of depth keys, naming face f
    `first_face + f`.

    Helpers get numbers, not arrays, each of which would cost two atomic counts at every face.
    """
    height, width = depth.shape
    flat_depth, flat_face = depth.reshape(-1), face.reshape(-1)
    half = SUBPIXELS // 2
    for n in range(count):
        f = np.uintp(kept[n])
        number = np.int32(first_face + kept[n])
        ia, ib, ic = np.uintp(faces[f, 0]), np.uintp(faces[f, 1]), np.uintp(faces[f, 2])
        a = (np.int64(u[ia]), np.int64(v[ia]))
        b = (np.int64(u[ib]), np.int64(v[ib]))
        c = (np.int64(u[ic]), np.int64(v[ic]))
        area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
        if area == 0 or (area > 0 and closed[f]):  # positive: seen from behind, as v points down
            continue
        first, last = _pixels(a[1], b[1], c[1], height)
        left, right = _pixels(a[0], b[0], c[0], width)
        if first > last or left > right:
            continue
        if area < 0:  # the same triangle the other way round
            b, c, ib, ic = c, b, ic, ib
        p = (vertices[ia, 0], vertices[ia, 1], vertices[ia, 2])
        q = (vertices[ib, 0], vertices[ib, 1], vertices[ib, 2])
        r = (vertices[ic, 0], vertices[ic, 1], vertices[ic, 2])
        ka = _on_image(p, camera, pinhole)[2]
        kb = _on_image(q, camera, pinhole)[2]
        kc = _on_image(r, camera, pinhole)[2]
        k_low, k_high = min(ka, kb, kc), max(ka, kb, kc)
        few = (last - first + 1) * (right - left + 1) <= FEW_PIXELS
        nearest = np.float32(k_low)
        if few:
            shown = 0
            for i in range(first, last + 1):
                start = i * width
                for j in range(left, right + 1):
                    shown += nearest < flat_depth[np.uintp(start + j)]
            if shown == 0:
                continue
        pa = _on_image(p, camera, pinhole)
        pb = _on_image(q, camera, pinhole)
        pc = _on_image(r, camera, pinhole)
        A0, B0, C0 = _edge(a, b)
        A1, B1, C1 = _edge(b, c)
        A2, B2, C2 = _edge(c, a)
        if few:
            known = False
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
                            flat_face[at] = number
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
                    flat_face[at] = number


@helper
def _pixels(a, b, c, size):
    """Return the first and the last pixel whose centres lie between three subpixel coordinates."""
    half = SUBPIXELS // 2
    first = (min(a, b, c) - half + SUBPIXELS - 1) >> SUBPIXEL_BITS
    last = (max(a, b, c) - half) >> SUBPIXEL_BITS
    return max(first, 0), min(last, size - 1)


@helper
def _slopes(a, b, c):
    """Return how the depth key changes with u and v, from the exact vertices; 0 if it has no
    effect."""
    u1, v1, k1 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    u2, v2, k2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    det = u1 * v2 - u2 * v1
    if det == 0.0:
        return 0.0, 0.0, 0.0
    return det, (k1 * v2 - k2 * v1) / det, (u1 * k2 - u2 * k1) / det


@helper
def _edge(a, b):
    """Return an edge's function A x + B y + C, not negative inside.

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
    """Return the pixels j in [j0, j1] with A * (j * SUBPIXELS + SUBPIXELS / 2) + rest >= 0.

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
