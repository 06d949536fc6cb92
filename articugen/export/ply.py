"""PLY: the surface points of every instance, for any viewer, with normals, parts and colours: the
model's where they are stored, else those of parts."""

import numpy as np

from articugen.core.colours import PALETTE
from articugen.export.formats import Format
from articugen.export.items import Item, of_instances
from articugen.export.target import Files

_PROPERTIES = (
    ("float", "<f4", ("x", "y", "z", "nx", "ny", "nz")),
    ("uchar", "u1", ("red", "green", "blue", "part")),
)


def _write(item: Item, target: Files) -> None:
    (row,) = item.rows
    kinds = [(name, kind) for _, kind, names in _PROPERTIES for name in names]
    table = np.empty(len(row.surface), kinds)
    columns = np.concatenate([row.surface.points, row.surface.normals], axis=1).T
    part = row.surface.part
    colours = row.surface.color if "surface_color" in row.fields else PALETTE[part]
    for (name, _), column in zip(kinds, [*columns, *colours.T, part], strict=True):
        table[name] = column
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment articugen, unit frame: z up, in [-0.5, 0.5]; part 0 is the fixed one",
        f"element vertex {len(table)}",
        *(f"property {word} {name}" for word, _, names in _PROPERTIES for name in names),
        "end_header\n",
    ]
    target.write(f"{item.key}.ply", "\n".join(header).encode() + table.tobytes())


FORMAT = Format("surface points of each instance with normals and parts", of_instances, _write)
