"""Depth maps become a field that is evaluated where it is asked.

`parts` judges the solid that each part is, with `solidify`, which makes solids of triangle soups;
`field` fuses depth maps; `kernels`, `bvh`, `reachable`, `thin` and `winding` are what it asks;
`isosurface` draws its zero level.
"""

from articugen.fusion.collision import Colliding, too_deep
from articugen.fusion.distance import distances
from articugen.fusion.ends import own_ends, posed_ends
from articugen.fusion.field import (
    SOLIDS,
    OwnSolid,
    PosedFields,
    PosedSolids,
    fuse,
    pixel_width,
)
from articugen.fusion.parts import SolidPart, seen_alone, seen_by, solid_part
from articugen.fusion.reachable import touched
from articugen.fusion.solidify import closed_piece, face_areas, face_normals, origins, welded
from articugen.fusion.thin import way_meets
from articugen.fusion.winding import closed_pieces, surely_inside
from articugen.meshes.bvh import Bvh
from articugen.meshes.bvh import joined as joined_bvh

__all__ = [
    "SOLIDS",
    "Bvh",
    "Colliding",
    "OwnSolid",
    "PosedFields",
    "PosedSolids",
    "SolidPart",
    "closed_piece",
    "closed_pieces",
    "distances",
    "face_areas",
    "face_normals",
    "fuse",
    "joined_bvh",
    "origins",
    "own_ends",
    "pixel_width",
    "posed_ends",
    "seen_alone",
    "seen_by",
    "solid_part",
    "surely_inside",
    "too_deep",
    "touched",
    "way_meets",
    "welded",
]
