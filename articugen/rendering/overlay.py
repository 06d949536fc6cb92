"""Moving faces drawn over fixed ones, again and again, with the numba rasterizer.

Only the rectangle that the moving faces can touch is read and restored, and only the faces seen are
kept: with the faces' planes they say the depth more exactly than a depth map.
"""

import numpy as np

from articugen.core.arrays import Bools
from articugen.core.records import DepthMaps, LabelledMesh
from articugen.rendering.rasterizer import Below, draw


class Overlay:
    """The faces seen when others are drawn over those that stay where they are."""

    def __init__(self, fixed: DepthMaps) -> None:
        """`fixed`: depth and faces of what does not move."""
        assert fixed.depth is not None
        assert fixed.face is not None
        self._views = fixed.views
        self._below = Below(fixed.depth, fixed.face, np.zeros((len(fixed.views), 4), np.int64))
        self._face = fixed.face.copy()

    def draw(self, mesh: LabelledMesh, *, closed: Bools, first_face: int) -> DepthMaps:
        """Draw a mesh and return the faces seen, valid until the next call; face f of `mesh` is
        `first_face + f`.

        Args:
            mesh, closed: as for `rasterizer.render`.

        Raises:
            ValueError: as `rasterizer.render`.
        """
        depth = np.empty((1, *self._face.shape[1:]), np.float32)
        draw(mesh, self._views, closed, depth, self._face, first_face=first_face, below=self._below)
        return DepthMaps(None, self._face, self._views)
