"""The kernels of this room, called once on next to nothing: see core/compiling.py."""

import numpy as np

from articugen.core.compiling import tetrahedron
from articugen.instance.swept import swept_box


def swept() -> None:
    swept_box(tetrahedron(), np.eye(4)[None, None])
