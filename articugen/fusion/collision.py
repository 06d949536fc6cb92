"""How deep the parts of a posed object are in one another.

Points on the surface of each part are asked of every other part's own solid; how far one that is
held there lies from that part's faces is how deep it is. Two parts that only touch are 0 deep in
one another, whatever their surfaces share.
"""

from dataclasses import dataclass

import numpy as np

from articugen.core.arrays import Bools, Floats
from articugen.core.geometry import apply, points_on_triangles
from articugen.core.records import LabelledMesh
from articugen.fusion.distance import distances
from articugen.fusion.field import PosedSolids
from articugen.meshes.bvh import Bvh

POINTS = 2048  # on each part, besides its vertices, of which so many at most are asked
DEEPEST = 0.5  # depths are told up to this


@dataclass(frozen=True, eq=False)
class Colliding:
    """The parts of an object as they are asked, in the canonical pose.

    Attributes:
        points: of each part (n, 3).
        faces: the trees of all parts.
    """

    points: tuple[Floats, ...]
    faces: Bvh

    @staticmethod
    def of(mesh: LabelledMesh, faces: Bvh, *, rng: np.random.Generator) -> "Colliding":
        """Points on the faces of `mesh`, all parts in the canonical pose."""
        parts = [mesh.part(part) for part in range(len(faces.roots) - 1)]
        return Colliding(tuple(_points_on(part, rng) for part in parts), faces)

    def depths(self, solids: PosedSolids, *, pairs: Bools | None = None) -> Floats:
        """Return (P, P) how deep points of part i are in part j, both posed; 0 on the diagonal.

        Args:
            pairs: (P, P) those to examine, all by default; the others have 0.
        """
        P = len(self.points)
        pairs = ~np.eye(P, dtype=np.bool_) if pairs is None else pairs
        out = np.zeros((P, P))
        for i, j in np.argwhere(pairs):
            posed = apply(solids.part_motion[i], self.points[i])
            probes = np.ascontiguousarray(posed, np.float32)
            inside = solids.holds(j, probes, np.arange(len(probes)))
            far = distances(posed[inside], self.faces, solids.part_motion, DEEPEST, part=j)
            out[i, j] = float(far.max(initial=0.0))
        return out


def _points_on(part: LabelledMesh, rng: np.random.Generator) -> Floats:
    if not len(part.faces):
        return np.zeros((0, 3))
    drawn, _ = points_on_triangles(part.vertices[part.faces], POINTS, rng=rng)
    step = len(part.vertices) // POINTS + 1
    return np.concatenate([drawn, part.vertices[::step]])


def too_deep(depths: Floats, canonical: Floats, bound: float) -> bool:
    """Return whether parts are deeper in one another than `bound`, both (P, P): a pair that is so
    in the canonical pose, as hinges often are, only where it is deeper by that."""
    return bool((depths > canonical + bound).any())
