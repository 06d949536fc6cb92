"""Occupancy Networks' layout, which ConvONet, NSD and many others read as well.

<category>/<object>_<state>/{pointcloud,points}.npz and <category>/{train,test}.lst. float32 where
the originals have float16: labels are exact at the points as they are stored.
"""

import numpy as np

from articugen.export.formats import Format, Item
from articugen.export.items import file_name, instance_name, of_instances
from articugen.export.labels import inside
from articugen.export.target import Target
from articugen.store.dataset import DataSet


def _write(item: Item, target: Target) -> None:
    (row,) = item.rows
    folder = f"{file_name(row.category)}/{instance_name(row)}"
    frame = {"loc": row.center, "scale": np.float64(row.scale)}
    cloud = {"points": row.surface.points, "normals": row.surface.normals}
    target.write_arrays(f"{folder}/pointcloud.npz", {**cloud, **frame})
    occupied = np.packbits(inside(row.uniform.label, target.options))
    points = {"points": row.uniform.points, "occupancies": occupied}
    target.write_arrays(f"{folder}/points.npz", {**points, **frame})


def _finish(data: DataSet, target: Target) -> None:
    category = file_name(data.category)
    for split in data.splits:
        names = (instance_name(row) for row in data.split(split))
        there = (name for name in names if not target.done[f"{split}/{name}"].left_out)
        lines = "".join(f"{name}\n" for name in there)
        target.write(f"{category}/{file_name(split)}.lst", lines.encode())


FORMAT = Format(
    "Occupancy Networks, ConvONet, NSD: pointcloud.npz, points.npz, lists of splits",
    of_instances,
    _write,
    _finish,
    takes=("occupancy",),
)
