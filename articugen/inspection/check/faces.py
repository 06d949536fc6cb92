"""Triangles of one part: what is open, twofold, turned around, or goes through something else."""

from dataclasses import dataclass

import numpy as np

from articugen import fusion
from articugen.core.arrays import Bools, Floats, Ints
from articugen.core.records import LabelledMesh
from articugen.meshes.bvh import tree_of
from articugen.meshes.crossings import crossings

MOST_CROSSINGS = 1000
_NO_AREA = 1e-12  # unit frame
BENEATH = 1e-4  # unit frame: depth under a face at which it is decided what is there


@dataclass(frozen=True)
class Faces:
    """Numbers of the faces of a part, as its file has them; coincident corners are one.

    Attributes:
        triangles: how many, with those that have no area.
        flat: those that have no area, whose edges count all the same.
        two_sided: share of faces that coincide with one of opposite winding.
        repeated: faces that only repeat another, with its winding.
        open_edges: edges of a single face, coincident faces counting once: 0 where it is closed.
        crowded_edges: edges of three faces and more (not manifold).
        turned_edges: edges whose two faces disagree about the outside.
        flipped_pieces: closed pieces that are inside out; walls of cavities are not.
        crossings: pairs of faces that go through one another; the count ends at 1,000.
    """

    triangles: int
    flat: int
    two_sided: float
    repeated: int
    open_edges: int
    crowded_edges: int
    turned_edges: int
    flipped_pieces: int
    crossings: int

    @property
    def is_closed(self) -> bool:
        return self.triangles > self.flat and not self.open_edges


class Soup:
    """Faces of a part, unit frame, and the solid that they wind around.

    Attributes:
        single: one of each set of coincident faces; none without area.
    """

    def __init__(self, mesh: LabelledMesh) -> None:
        corners = fusion.welded(mesh.vertices)[mesh.faces]
        a, b, c = np.sort(corners, axis=1).T
        some = (a != b) & (b != c)
        solid = some & (fusion.face_areas(mesh.vertices, mesh.faces) > _NO_AREA)
        kept = self._all = LabelledMesh(mesh.vertices, mesh.faces[solid], mesh.part_of_face[solid])
        self._flat = int((~solid).sum())
        key = np.stack([a, b, c], 1)[some]
        _, first, which = np.unique(key, axis=0, return_index=True, return_inverse=True)
        x, y, z = corners[some].T
        odd = np.sign(x - y) * np.sign(y - z) * np.sign(z - x) > 0
        ways = np.stack([np.bincount(which.ravel(), odd == way, len(first)) for way in (0, 1)])
        self._twofold = (ways[0] > 0) & (ways[1] > 0)
        self._repeats = int(np.maximum(ways - 1, 0).sum())
        self._share = float(self._twofold[which].mean()) if len(which) else 0.0
        self._corners, number = corners[some][first], np.flatnonzero(some)[first]
        self._has_area = solid[number]
        number = number[self._has_area]
        self.single = LabelledMesh(mesh.vertices, mesh.faces[number], mesh.part_of_face[number])
        faces = kept.vertices[kept.faces]
        self._solid = fusion.closed_pieces(kept, np.zeros(len(faces), np.intp), tree_of(faces))

    def winds_around(self, points: Floats) -> Bools:
        """Return (n,) whether the faces, as they are wound, wind around points (n, 3)."""
        if self._solid is None:
            return np.zeros(len(points), np.bool_)
        return fusion.surely_inside(points, self._solid)

    def counted(self) -> Faces:
        """Count what is amiss."""
        shared, turned = self._edges()
        return Faces(
            triangles=len(self._all.faces) + self._flat,
            flat=self._flat,
            two_sided=self._share,
            repeated=self._repeats,
            open_edges=int((shared == 1).sum()),
            crowded_edges=int((shared > 2).sum()),
            turned_edges=turned,
            flipped_pieces=self._flipped(),
            crossings=len(crossings(self.single.vertices[self.single.faces], MOST_CROSSINGS)),
        )

    def _edges(self) -> tuple[Ints, int]:
        """Return how many faces each edge has, and at how many edges two are wound unlike."""
        ends = np.stack([self._corners, np.roll(self._corners, -1, axis=1)], 2).reshape(-1, 2)
        low, high = ends.min(axis=1), ends.max(axis=1)
        key = low * (int(high.max(initial=0)) + 1) + high
        _, which, shared = np.unique(key, return_inverse=True, return_counts=True)
        runs = np.bincount(which, np.where(ends[:, 0] == low, 1, -1), len(shared))
        either = np.bincount(which, np.repeat(self._twofold, 3), len(shared))  # way is as good
        return shared, int(((shared == 2) & (runs != 0) & (either == 0)).sum())

    def _flipped(self) -> int:
        """Count the closed pieces turned inwards around whose inside the faces wind all the same:
        about the inside of a cavity's wall they do not."""
        mesh = self.single
        mirrored = LabelledMesh(mesh.vertices, mesh.faces[:, ::-1], mesh.part_of_face)
        piece = np.where(self._twofold[self._has_area], -1, fusion.closed_piece(mirrored))
        largest = np.argsort(-fusion.face_areas(mesh.vertices, mesh.faces), kind="stable")
        pieces, first = np.unique(piece[largest], return_index=True)
        faces = mesh.faces[largest[first[pieces >= 0]]]
        inwards = fusion.face_normals(mesh.vertices, faces)
        middle = mesh.vertices[faces].mean(axis=1)
        return int(self.winds_around(middle + BENEATH * inwards).sum())
