"""Depth maps become a field that is evaluated where it is asked.

`parts` judges the solid that each part is, with `solidify`, which makes solids of triangle soups;
`field` fuses depth maps; `kernels`, `bvh`, `reachable`, `thin` and `winding` are what it asks;
`isosurface` draws its zero level.
"""

from articugen.fusion.collision import Colliding as Colliding
from articugen.fusion.collision import too_deep as too_deep
from articugen.fusion.distance import distances as distances
from articugen.fusion.ends import own_ends as own_ends
from articugen.fusion.ends import posed_ends as posed_ends
from articugen.fusion.field import SOLIDS as SOLIDS
from articugen.fusion.field import OwnSolid as OwnSolid
from articugen.fusion.field import PosedFields as PosedFields
from articugen.fusion.field import PosedSolids as PosedSolids
from articugen.fusion.field import fuse as fuse
from articugen.fusion.field import pixel_width as pixel_width
from articugen.fusion.parts import SolidPart as SolidPart
from articugen.fusion.parts import seen_alone as seen_alone
from articugen.fusion.parts import solid_part as solid_part
from articugen.fusion.reachable import touched as touched
from articugen.fusion.solidify import NO_AREA as NO_AREA
from articugen.fusion.solidify import closed_piece as closed_piece
from articugen.fusion.solidify import face_areas as face_areas
from articugen.fusion.solidify import face_normals as face_normals
from articugen.fusion.solidify import origins as origins
from articugen.fusion.solidify import welded as welded
from articugen.fusion.thin import way_meets as way_meets
from articugen.fusion.winding import closed_pieces as closed_pieces
from articugen.fusion.winding import surely_inside as surely_inside
