"""The default depth backend: a two-sided z-buffer in numba.

Coverage is decided in exact integer arithmetic on vertices snapped to 1/4096 pixel with a top-left
fill rule, so that neighbouring triangles neither overlap nor leave cracks. Depth is the plane of
the unsnapped triangle at the pixel's centre.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from articugen.records import DepthMaps, LabelledMesh, Views

SUBPIXEL_BITS = 12
SUBPIXELS = 1 << SUBPIXEL_BITS
LARGEST_PIXEL = 1 << 15
"""Vertices may project this far outside the image; products then still fit in 63 bits."""


def render(
    mesh: LabelledMesh,
    views: Views,
    *,
    onto: DepthMaps | None = None,
    first_face: int = 0,
    scratch: DepthMaps | None = None,
) -> DepthMaps:
    """The depth maps of `mesh` from `views`, with the face seen at each pixel.

    Args:
        mesh: unit frame.
        views: the cameras; every vertex must lie in front of every pinhole camera.
        onto: maps of other faces from the same views, drawn over in a copy.
        first_face: face f of `mesh` is written as `first_face + f`.
        scratch: maps of the same views to draw into, whose content is lost; fresh memory costs as
            much as the drawing.

    Raises:
        ValueError: a vertex lies behind a pinhole camera or far outside the image.
    """
    maps = scratch or empty_maps(views)
    assert maps.face is not None
    if onto is None:
        maps.depth.fill(np.inf)
        maps.face.fill(-1)
    else:
        assert onto.face is not None
        np.copyto(maps.depth, onto.depth)
        np.copyto(maps.face, onto.face)
    draw(mesh.vertices, mesh.faces, views, maps.depth, maps.face, first_face=first_face)
    return maps


def empty_maps(views: Views) -> DepthMaps:
    """Maps of `views` with nothing drawn yet, not even emptiness."""
    shape = (len(views), views.height, views.width)
    return DepthMaps(np.empty(shape, np.float32), np.empty(shape, np.int32), views)


def draw(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int32],
    views: Views,
    depth: NDArray[np.float32],
    face: NDArray[np.int32],
    *,
    first_face: int,
) -> None:
    """Draw triangles over existing maps, in place; face f is written as `first_face + f`.

    Args:
        vertices, faces: (V, 3) unit frame, (F, 3).
        depth, face: (K, H, W), as in `DepthMaps`.

    Raises:
        ValueError: as `render`.
    """
    pinhole = views.projection == "pinhole"
    if pinhole:
        z = vertices @ views.T_camera_world[:, 2, :3].T + views.T_camera_world[:, 2, 3]
        if z.min(initial=np.inf) <= 1e-6:
            raise ValueError("a vertex lies behind a pinhole camera: move the camera back")
    intrinsics = np.stack([views.fx, views.fy, views.cx, views.cy], axis=1)
    inside = _draw_all(
        vertices, faces, views.T_camera_world, intrinsics, pinhole, depth, face, first_face
    )
    if not inside:
        raise ValueError(f"a vertex projects more than {LARGEST_PIXEL} pixels outside the image")


@njit(cache=True, nogil=True)
def _draw_all(vertices, faces, T, intrinsics, pinhole, depth, face, first_face):
    V = vertices.shape[0]
    X = np.empty(V, np.int64)
    Y = np.empty(V, np.int64)
    uvk = np.empty((V, 3), np.float64)
    for k in range(T.shape[0]):
        if not _project(vertices, T[k], intrinsics[k], pinhole, X, Y, uvk):
            return False
        if pinhole:
            _to_key(depth[k])
        for f in range(faces.shape[0]):
            _draw_triangle(
                faces[f, 0], faces[f, 1], faces[f, 2], X, Y, uvk, depth[k], face[k], first_face + f
            )
        if pinhole:
            _from_key(depth[k])
    return True


@njit(cache=True, nogil=True)
def _project(vertices, T, intrinsics, pinhole, X, Y, uvk):
    """Image coordinates, snapped and exact, and the depth key, which is linear in the image.

    The key is z for an orthographic camera and -1/z for a pinhole: smaller is nearer in both.
    """
    fx, fy, cx, cy = intrinsics
    limit = LARGEST_PIXEL
    for i in range(vertices.shape[0]):
        px, py, pz = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        w = 1.0 / z if pinhole else 1.0
        u = fx * x * w + cx
        v = fy * y * w + cy
        if not (abs(u) < limit and abs(v) < limit):
            return False
        uvk[i, 0] = u
        uvk[i, 1] = v
        uvk[i, 2] = -w if pinhole else z
        X[i] = np.int64(np.floor(u * SUBPIXELS + 0.5))
        Y[i] = np.int64(np.floor(v * SUBPIXELS + 0.5))
    return True


@njit(cache=True, nogil=True)
def _to_key(depth):
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            z = depth[i, j]
            depth[i, j] = -1.0 / z if z < np.inf else 0.0


@njit(cache=True, nogil=True)
def _from_key(depth):
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            key = depth[i, j]
            depth[i, j] = -1.0 / key if key < 0.0 else np.inf


@njit(cache=True, nogil=True, inline="always")
def _first_pixel(x, half):
    """The first pixel whose centre is not before the subpixel coordinate x."""
    return (x - half + SUBPIXELS - 1) >> SUBPIXEL_BITS


@njit(cache=True, nogil=True, inline="always")
def _last_pixel(x, half):
    return (x - half) >> SUBPIXEL_BITS


@njit(cache=True, nogil=True)
def _draw_triangle(a, b, c, X, Y, uvk, depth, face, label):
    H, W = depth.shape
    area = (X[b] - X[a]) * (Y[c] - Y[a]) - (X[c] - X[a]) * (Y[b] - Y[a])
    if area == 0:
        return
    if area < 0:  # seen from behind: the same triangle the other way round
        b, c = c, b
    half = SUBPIXELS // 2
    y_low = min(Y[a], Y[b], Y[c])
    y_high = max(Y[a], Y[b], Y[c])
    first = max(_first_pixel(y_low, half), 0)
    last = min(_last_pixel(y_high, half), H - 1)
    x_low = min(X[a], X[b], X[c])
    x_high = max(X[a], X[b], X[c])
    left = max(_first_pixel(x_low, half), 0)
    right = min(_last_pixel(x_high, half), W - 1)
    if first > last or left > right:
        return

    # the plane of the depth key, k = k0 + ku * u + kv * v, from the exact vertices
    u1, v1, k1 = uvk[b, 0] - uvk[a, 0], uvk[b, 1] - uvk[a, 1], uvk[b, 2] - uvk[a, 2]
    u2, v2, k2 = uvk[c, 0] - uvk[a, 0], uvk[c, 1] - uvk[a, 1], uvk[c, 2] - uvk[a, 2]
    det = u1 * v2 - u2 * v1
    if det == 0.0:
        return
    ku = (k1 * v2 - k2 * v1) / det
    kv = (u1 * k2 - u2 * k1) / det
    k_low = min(uvk[a, 2], uvk[b, 2], uvk[c, 2])
    k_high = max(uvk[a, 2], uvk[b, 2], uvk[c, 2])

    # edge functions E = A x + B y + C >= 0 inside, with the top-left rule as a bias of one unit
    A0, B0, C0 = _edge(X[a], Y[a], X[b], Y[b])
    A1, B1, C1 = _edge(X[b], Y[b], X[c], Y[c])
    A2, B2, C2 = _edge(X[c], Y[c], X[a], Y[a])
    r0, r1, r2 = _per_step(A0), _per_step(A1), _per_step(A2)
    for i in range(first, last + 1):
        y = i * SUBPIXELS + half
        j0, j1 = _span(A0, B0 * y + C0, r0, left, right, half)
        j0, j1 = _span(A1, B1 * y + C1, r1, j0, j1, half)
        j0, j1 = _span(A2, B2 * y + C2, r2, j0, j1, half)
        base = uvk[a, 2] + kv * (i + 0.5 - uvk[a, 1]) + ku * (0.5 - uvk[a, 0])
        for j in range(j0, j1 + 1):
            key = np.float32(min(max(base + ku * j, k_low), k_high))
            if key < depth[i, j]:
                depth[i, j] = key
                face[i, j] = label


@njit(cache=True, nogil=True, inline="always")
def _edge(xa, ya, xb, yb):
    A = ya - yb
    B = xb - xa
    C = xa * yb - ya * xb
    # inside is E >= 0; of two triangles at an edge the one that has it on top or left owns it
    if not (A > 0 or (A == 0 and B > 0)):
        C -= 1
    return A, B, C


@njit(cache=True, nogil=True, inline="always")
def _per_step(A):
    return 1.0 / (A * SUBPIXELS) if A != 0 else 0.0


@njit(cache=True, nogil=True, inline="always")
def _span(A, rest, per_step, j0, j1, half):
    """The pixels j in [j0, j1] with A * (j * SUBPIXELS + half) + rest >= 0.

    `per_step` is 1 / (A * SUBPIXELS), which gives the pixel to within one; integers decide.
    """
    value = A * half + rest
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
