"""Moving faces drawn over fixed ones, again and again, with the numba rasterizer.

Only the rectangle that the moving faces can touch is read and restored, and only the faces seen are
kept: with the faces' planes they say the depth more exactly than a depth map.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from articugen.records import DepthMaps, LabelledMesh
from articugen.rendering.rasterizer import cameras, check_inside, draw_view, project, to_key


class Overlay:
    """The faces seen when others are drawn over those that stay where they are."""

    def __init__(self, fixed: DepthMaps) -> None:
        """`fixed`: depth and faces of what does not move."""
        assert fixed.depth is not None
        assert fixed.face is not None
        self._depth, self._below, self._views = fixed.depth, fixed.face, fixed.views
        self._face = fixed.face.copy()
        self._drawn = np.zeros((len(fixed.views), 4), np.int64)

    def draw(self, mesh: LabelledMesh, *, closed: NDArray[np.bool_], first_face: int) -> DepthMaps:
        """The faces seen, which hold until the next call; face f of `mesh` is `first_face + f`.

        Args:
            mesh, closed: as for `rasterizer.render`.

        Raises:
            ValueError: as `rasterizer.render`.
        """
        intrinsics, pinhole = cameras(mesh, self._views)
        inside = _draw_over(
            mesh.vertices, mesh.faces, closed, self._views.T_camera_world, intrinsics, pinhole,
            self._depth, self._below, self._face, self._drawn, first_face,
        )  # fmt: skip
        check_inside(inside)
        return DepthMaps(None, self._face, self._views)


@njit(cache=True, nogil=True)
def _draw_over(
    vertices, faces, closed, T, intrinsics, pinhole, below, face_below, face, drawn, first_face
):
    """Draw all views over `face`, a copy of `face_below` but for the rectangles `drawn`."""
    snapped = np.empty((vertices.shape[0], 2), np.int32)
    image = np.empty((vertices.shape[0], 3), np.float64)
    depth = np.empty(below.shape[1:], np.float32)  # of one view: only its rectangle is ever set
    for k in range(T.shape[0]):
        _copy(face_below[k], face[k], drawn[k])
        drawn[k] = 0
        if vertices.shape[0] == 0:
            continue
        if not project(vertices, T[k], intrinsics[k], pinhole, snapped, image):
            return False
        drawn[k] = _rectangle(image, below.shape[1], below.shape[2])
        _copy(below[k], depth, drawn[k])
        if pinhole:
            to_key(depth, drawn[k])
        draw_view(faces, closed, snapped, image, depth, face[k], first_face)
    return True


@njit(cache=True, nogil=True)
def _copy(source, target, rectangle):
    """Row by row in flat, unsigned numbers, which become plain copies of memory."""
    top, bottom, left, right = rectangle
    flat_source, flat_target = source.reshape(-1), target.reshape(-1)
    for i in range(top, bottom):
        start = np.uintp(i * source.shape[1] + left)
        for n in range(right - left):
            flat_target[start + np.uintp(n)] = flat_source[start + np.uintp(n)]


@njit(cache=True, nogil=True)
def _rectangle(image, height, width):
    """The rows and columns, ends excluded, that hold the projected vertices."""
    u, v = image[:, 0], image[:, 1]
    top, left = max(int(np.floor(v.min())) - 1, 0), max(int(np.floor(u.min())) - 1, 0)
    bottom, right = min(int(v.max()) + 2, height), min(int(u.max()) + 2, width)
    return top, max(bottom, top), left, max(right, left)
