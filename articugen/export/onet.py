"""Occupancy Networks' layout, which ConvONet, NSD and many others read as well.

<category>/<object>_<state>/{pointcloud,points}.npz and <category>/{train,val,test}.lst. Floats are
32 bits where the originals have 16: labels are exact at the points as they are stored.
"""

import numpy as np

from articugen.export.formats import Format
from articugen.export.items import Item, file_name, instance_name, of_instances
from articugen.export.labels import inside
from articugen.export.target import Files, Target
from articugen.store.dataset import DataSet


def _write(item: Item, target: Files) -> None:
    (row,) = item.rows
    folder = f"{file_name(row.category)}/{instance_name(row)}"
    frame = {"loc": row.center, "scale": np.float64(row.scale)}
    cloud = {"points": row.surface.points, "normals": row.surface.normals}
    target.write_arrays(f"{folder}/pointcloud.npz", {**cloud, **frame})
    occupied = np.packbits(inside(row.uniform.label, target.options))
    points = {"points": row.uniform.points, "occupancies": occupied}
    target.write_arrays(f"{folder}/points.npz", {**points, **frame})


def _finish(data: DataSet, target: Target) -> None:
    lists = {split: [instance_name(row) for row in data.split(split)] for split in data.splits}
    if "train" in lists:  # a tenth of its objects, which stay in it, as in PPD's release
        train = data.split("train")
        some = train.of(*train.objects[: -(-len(train.objects) // 10)])
        lists.setdefault("val", [instance_name(row) for row in some])
    for split, names in lists.items():
        text = "\n".join(names)  # an empty line at the end is one more object to their loaders
        target.write(f"{file_name(data.category)}/{file_name(split)}.lst", text.encode())


FORMAT = Format(
    "Occupancy Networks, ConvONet, NSD: pointcloud.npz, points.npz, lists of splits",
    of_instances,
    _write,
    _finish,
    takes=("occupancy",),
)
