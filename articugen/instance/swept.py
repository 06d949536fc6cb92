"""The box that an object sweeps in many poses."""

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.records import LabelledMesh

_AT_ONCE = 1 << 16  # places of points: they stay in the cache


def swept_box(mesh: LabelledMesh, motions: Floats) -> Floats:
    """Return the box (2, 3) of the mesh's faces in all poses; `motions` (N, P, 4, 4)."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for part in np.unique(mesh.part_of_face):
        used = np.zeros(len(mesh.vertices), np.bool_)
        used[mesh.faces[mesh.part_of_face == part]] = True
        x, y, z = np.ascontiguousarray(mesh.vertices[used].T)
        poses = np.unique(motions[:, part].reshape(-1, 16), axis=0).reshape(-1, 4, 4)
        pieces = min(len(poses), 1 + len(poses) * len(x) // _AT_ONCE)
        for some in np.array_split(poses, pieces):
            for axis in range(3):
                a, b, c, d = some[:, axis].T[..., None]
                at = a * x + b * y + c * z + d
                low[axis], high[axis] = min(low[axis], at.min()), max(high[axis], at.max())
    return np.stack([low, high])
