"""Depth maps to an implicit field that is evaluated where it is asked, not on a dense grid.

Volumetric fusion (Curless and Levoy 1996) averages, over the views, the truncated signed distance
along the ray from a point to the depth map. Read at whole pixels, that swells or erodes every thin
part. Here each view is read exactly: the maps say which face is seen at each pixel, so the distance
to a face's plane is known at the point's own sub-pixel position. Where the four pixels around it
disagree and no face among theirs settles it, the ray itself is followed through the faces. Maps
from a backend without faces are interpolated instead, which is less exact.

Rules (`recipe.Fusion.rule`):
    seen: a point is outside where at least one view sees it free. Its value is the mean truncated
        distance over the views that see it free; inside, over the views that it lies close behind.
    reachable: as `seen`, and outside is also what reachable.py finds open to the outside. It has
        the value of the views that it lies behind, with the sign turned.
    mean: the value is the plain mean over the views that see the point free or close behind, as in
        Occupancy Networks' preparation; outside where that is positive.
In all three, a point that no view sees, or only from further behind than the truncation, is inside.
    rigid: a point is inside where the own solid of some part holds it, see `OwnSolid`. The posed
        object is not examined.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bools, Bytes, Floats, Indices
from articugen.core.geometry import apply, bounds, box_corners, invert_rigid
from articugen.core.portable import turned
from articugen.core.recipe import Fusion
from articugen.core.records import ENCLOSED, FREE, DepthMaps, LabelledMesh, Views
from articugen.fusion import kernels
from articugen.fusion.reachable import DRY, SOLID, WET, Flood, flood
from articugen.fusion.thin import NOTHING, ThinVoxels
from articugen.fusion.winding import ClosedPieces, surely_inside
from articugen.meshes.bvh import Bvh, tree_of, triangle_table

_NO_DEPTH = np.zeros((1, 0, 0), np.float32)
_NO_FACES = np.zeros((1, 0, 0), np.int32)

SOLIDS = ("material", "visible")
"""What a mesh of a whole object is of: the parts' material, or that and the space that no view
sees."""

GLANCES = 5
"""Number of views that see most of what is free: they look from all around, see
`views.spread_order`."""


@dataclass(frozen=True, eq=False)
class FusedField:
    """The fused field of one set of depth maps.

    Attributes:
        maps: the face seen at each pixel; from backends without faces, the depth.
        triangles: (F, 16) float32 of the faces as posed, see `bvh.triangle_table`.
        bvh: of each part in its canonical pose.
        part_motion: (P, 4, 4) of each part from its canonical pose.
        settings: rule and truncation.
        flood: for the rule `reachable`.
        thin: where views are checked.
    """

    maps: DepthMaps
    triangles: NDArray[np.float32]
    bvh: Bvh
    part_motion: Floats
    settings: Fusion
    flood: Flood | None = None
    thin: ThinVoxels = NOTHING

    def is_free(self, points: NDArray[np.floating], which: Indices | None = None) -> Bools:
        """Return (n,) which of `points` (n, 3), unit frame, lie outside; of points[which] if given.

        With the rule `seen` much cheaper than `value`: the first view that sees it free settles a
        point.
        """
        which = np.arange(len(points)) if which is None else which
        if self.settings.rule == "mean":
            return self.value(points[which]) > 0.0
        if self.flood is None:
            return self.is_seen_free(points, which)
        free = self.flood.around(points[which]) == WET  # most of what is, without asking a view
        rest = np.flatnonzero(~free)
        free[rest] = self.is_seen_free(points, which[rest])
        unseen = rest[~free[rest]]
        free[unseen] = self.flood.reaches(points[which[unseen]])
        return free

    def is_seen_free(
        self,
        points: NDArray[np.floating],
        which: Indices | None = None,
        *,
        views: int | None = None,
    ) -> Bools:
        """Return which of `points` (n, 3), or of points[which], at least one of the first `views`
        views, or of all, sees free."""
        which = np.arange(len(points)) if which is None else which
        flat = np.ascontiguousarray(points, np.float32)
        every = len(self.maps.views)
        return kernels.is_free(flat, which, self._scene, min(views or every, every))

    def value(self, points: NDArray[np.floating]) -> Floats:
        """Return the field at `points` (n, 3): (n,) in [-truncation, truncation], negative inside.

        Distances are along the rays, in the unit frame.
        """
        flat = np.ascontiguousarray(points, np.float32)
        mean = self.settings.rule == "mean"
        value = kernels.value(flat, self._scene, self.settings.truncation, mean)
        if self.flood is not None:
            unseen = np.flatnonzero(value <= 0.0)
            reached = unseen[self.flood.reaches(flat[unseen])]
            value[reached] = np.maximum(-value[reached], 1e-9)
        return value

    @cached_property
    def _scene(self) -> kernels.Scene:
        views = self.maps.views
        T, pinhole = views.T_camera_world, views.projection == "pinhole"
        eyes = -turned(np.swapaxes(T[:, :3, :3], 1, 2), T[:, :3, 3]) if pinhole else -T[:, 2, :3]
        return kernels.Scene(
            depth=_NO_DEPTH if self.maps.depth is None else self.maps.depth,
            face=_NO_FACES if self.maps.face is None else self.maps.face,
            cameras=np.ascontiguousarray(T[:, :3], np.float32),
            intrinsics=views.intrinsics.astype(np.float32),
            eyes=np.ascontiguousarray(eyes, np.float32),
            pinhole=pinhole,
            triangles=self.triangles,
            bvh=self.bvh,
            to_part=np.ascontiguousarray(invert_rigid(self.part_motion)[:, :3], np.float32),
            pixel=np.float32(pixel_width(views)),
            thin=self.thin,
        )


def pixel_width(views: Views) -> float:
    """Return how wide the widest pixel of any view is at the middle of the unit frame."""
    away = np.abs(views.T_camera_world[:, 2, 3]) if views.projection == "pinhole" else 1.0
    return float(np.max(away / np.minimum(views.fx, views.fy)))


@dataclass(frozen=True, eq=False)
class OwnSolid:
    """A part seen alone, in its canonical pose: its material.

    Attributes:
        field: of its own views, and the space open to them: the dark corners of a deep shelf are no
            material, whatever the rule.
        box: (2, 3) that holds it.
        closed: its closed pieces: what they wind around no view can see.
    """

    field: FusedField
    box: Floats
    closed: ClosedPieces | None = None

    def holds(self, points: NDArray[np.floating], *, glance: bool = False) -> Bools:
        """Return (n,) which of `points` (n, 3), unit frame, in the canonical pose, it holds.

        Args:
            glance: take the word of a few views for what they see free, before anything else:
                cheaper where that is most.
        """
        if self.closed is None:
            return ~self.field.is_free(points)
        inside, left = np.zeros(len(points), np.bool_), np.arange(len(points))
        if self.field.flood is not None:
            state = self.field.flood.around(points)
            inside, left = state == SOLID, np.flatnonzero(state < WET)
        if glance:
            left = left[~self.field.is_seen_free(points, left, views=GLANCES)]
        sure = surely_inside(points[left], self.closed)
        rest = left[~sure]
        inside[left[sure]] = True
        inside[rest] = ~self.field.is_free(points, rest)
        return inside


@dataclass(frozen=True, eq=False)
class PosedSolids:
    """The own solids of all parts, each moved rigidly to where it is: the material.

    Attributes:
        own: of each part, part 0 first.
        part_motion: (P, 4, 4) from the canonical pose, unit frame.
        settings: of all of them.
    """

    own: Sequence[OwnSolid]
    part_motion: Floats
    settings: Fusion

    def box(self, part: int) -> Floats:
        """Return (2, 3) what holds the part."""
        return bounds(apply(self.part_motion[part], box_corners(self.own[part].box)))

    def holds(
        self, part: int, points: NDArray[np.float32], which: Indices, *, glance: bool = False
    ) -> Indices:
        """Return those of `which`, indices into `points` (n, 3), that the part's own solid
        holds."""
        solid, to_canonical = self.own[part], invert_rigid(self.part_motion[part])
        near, there = kernels.in_box(points, which, to_canonical, solid.box)
        return near[solid.holds(there, glance=glance)]

    def labels(self, points: NDArray[np.floating]) -> Bytes:
        """Return (n,) k + 1 in the material of part k, else FREE, for `points` (n, 3).

        Where own solids overlap, the first moving part counts, and part 0 last.
        """
        points = np.ascontiguousarray(points, np.float32)
        label = np.full(len(points), FREE, np.uint8)
        for part in (*range(1, len(self.own)), 0):
            label[self.holds(part, points, np.flatnonzero(label == FREE))] = part + 1
        return label

    def is_free(self, points: NDArray[np.floating], which: Indices | None = None) -> Bools:
        """Return which of `points` (n, 3), or of points[which], no part's own solid holds."""
        queries = np.ascontiguousarray(points if which is None else points[which], np.float32)
        free = np.ones(len(queries), np.bool_)
        for part in range(len(self.own)):
            free[self.holds(part, queries, np.flatnonzero(free), glance=True)] = False
        return free

    def surely_holds(self, points: NDArray[np.floating], part: Bytes) -> Bools:
        """Return (n,) whether closed pieces of the part (n,) of each of `points` (n, 3) wind around
        it."""
        inside = np.zeros(len(points), np.bool_)
        for k, T in enumerate(invert_rigid(self.part_motion)):
            closed = self.own[k].closed
            if closed is not None:
                indices = np.flatnonzero(part == k)
                inside[indices] = surely_inside(apply(T, points[indices]), closed)
        return inside


@dataclass(frozen=True, eq=False)
class PosedFields:
    """Fields of a posed object: inside or outside, and the material of its parts, which labels it.

    Attributes:
        whole: the field of all parts together, posed; with the rule `rigid` the material itself.
        material: what the parts' own solids hold.
    """

    whole: FusedField | PosedSolids
    material: PosedSolids

    @property
    def part_motion(self) -> Floats:
        return self.material.part_motion

    def solid(self, of: str) -> FusedField | PosedSolids:
        """Return the field of one of `SOLIDS`."""
        return self.material if of == "material" else self.whole

    def labels(self, points: NDArray[np.floating]) -> Bytes:
        """Return (n,) FREE, k + 1 in the material of part k, ENCLOSED where no view sees free what
        no part's own solid holds; for `points` (n, 3)."""
        points = np.ascontiguousarray(points, np.float32)
        return self.with_enclosed(points, self.material.labels(points))

    def is_free_before(self, points: NDArray[np.floating], part: Bytes) -> Bools:
        """Return (n,) which of `points` (n, 3), each right in front of a face of its `part` (n,),
        are free. Other pieces of the part often cover it: at what they wind around no view need
        look, and none may read past their corners between its pixels."""
        points = np.ascontiguousarray(points, np.float32)
        if isinstance(self.whole, PosedSolids):
            return self.whole.is_free(points)
        free = ~self.material.surely_holds(points, part)
        indices = np.flatnonzero(free)
        free[indices] = self.whole.is_free(points, indices)
        return free

    def with_enclosed(self, points: NDArray[np.float32], label: Bytes) -> Bytes:
        """`label`, the material at `points` (n, 3), with ENCLOSED set where that is."""
        if isinstance(self.whole, FusedField):
            rest = np.flatnonzero(label == FREE)
            label[rest[~self.whole.is_free(points, rest)]] = ENCLOSED
        return label


def fuse(
    maps: DepthMaps,
    mesh: LabelledMesh,
    settings: Fusion,
    *,
    bvh: Bvh | None = None,
    part_motion: Floats | None = None,
    thin: ThinVoxels = NOTHING,
) -> FusedField:
    """Return the field of `maps`, which show the faces of `mesh`.

    Args:
        bvh, part_motion: of the mesh's parts in the canonical pose, and how they moved from
            there; without them the mesh is taken as it is.
        thin: see `thin.thin_voxels`.
    """
    if maps.face is not None:
        maps = replace(maps, depth=None)  # the faces' planes say more, and depths take much room
    corners = mesh.vertices[mesh.faces]
    if bvh is None or part_motion is None:
        part_motion = np.eye(4)[None]
        bvh = tree_of(corners)
    table = triangle_table(corners)
    field = FusedField(maps, table, bvh, part_motion, settings, None, thin)
    return flooded(field, mesh) if settings.rule == "reachable" else field


def own_solid(field: FusedField, box: Floats, closed: ClosedPieces | None) -> OwnSolid:
    """Return it with the voxels marked in which nothing need be asked: no face touches them, and
    closed pieces wind around their centres."""
    if field.flood is not None and closed is not None:
        state = field.flood.state.copy()
        dry = np.argwhere(state == DRY)
        solid = dry[surely_inside((dry + 0.5) / len(state) - 0.5, closed)]
        state[tuple(solid.T)] = SOLID
        field = replace(field, flood=replace(field.flood, state=state))
    return OwnSolid(field, box, closed)


def flooded(field: FusedField, mesh: LabelledMesh) -> FusedField:
    """Return the field of `mesh` by the rule `reachable`; with the rule `mean` as it is."""
    if field.settings.rule == "mean" or field.flood is not None:
        return field
    resolution = max(4, round(2.0 / field.settings.opening))  # an opening is two voxels wide
    return replace(field, flood=flood(mesh, resolution, field.bvh, field.part_motion))
