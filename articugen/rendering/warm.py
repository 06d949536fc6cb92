"""The kernels of this room, called once on next to nothing: see core/compiling.py."""

import numpy as np

from articugen.core.compiling import tetrahedron, two_views
from articugen.rendering import rasterizer


def drawing() -> None:
    rasterizer.render(tetrahedron(), two_views(), closed=np.ones(4, np.bool_))
