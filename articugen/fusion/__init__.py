"""Depth maps become a field that is evaluated where it is asked.

`solidify` makes solids of triangle soups, `field` fuses their depth maps; `kernels`, `bvh`,
`reachable`, `thin` and `winding` are what it asks; `isosurface` draws its zero level.
"""

from articugen.fusion.field import (
    Field,
    OwnSolid,
    PosedFields,
    PosedSolids,
    flooded,
    fuse,
    pixel_width,
)

__all__ = ["Field", "OwnSolid", "PosedFields", "PosedSolids", "flooded", "fuse", "pixel_width"]
