"""Particulate: an object's surface in its rest pose, with parts, joints and their ranges.

train/<object>.npz as its cached training points: it articulates them itself. The object is scaled
until its longest edge, in the rest pose, is 1. Points of sharp edges follow those of the surface,
where shards hold them; where they do not, its loader draws all from the surface.
"""

import numpy as np
from numpy.typing import NDArray

from articugen.export.formats import Format, Item
from articugen.export.items import canonical, file_name, of_objects
from articugen.export.target import Target
from articugen.geometry import bounds
from articugen.store.rows import Row


def _write(item: Item, target: Target) -> None:
    row = canonical(item.rows)
    name = f"{file_name(row.split)}/{file_name(row.object_id)}.npz"
    target.write_arrays(name, _arrays(row))


def _arrays(row: Row) -> dict[str, NDArray]:
    box = bounds(row.surface.points.astype(np.float64))
    middle, scale = box.mean(axis=0), 1.0 / float((box[1] - box[0]).max())
    P = len(row.parts)
    axes, ranges = np.zeros((P, 12), np.float32), np.zeros((P, 4), np.float32)
    for joint in row.joints:
        point = (np.asarray(joint.pivot) - middle) * scale
        plucker = np.concatenate([joint.axis, np.cross(joint.axis, point)])
        if joint.kind == "revolute":
            axes[joint.part, :6] = plucker
            ranges[joint.part, :2] = joint.lower, joint.upper
        else:
            axes[joint.part, 6:] = plucker
            ranges[joint.part, 2:] = joint.lower_unit * scale, joint.upper_unit * scale
    groups = [row.surface, *([row.sharp] if "sharp_points" in row.fields else [])]
    points = np.concatenate([group.points for group in groups])
    return {
        "points": ((points - middle) * scale).astype(np.float32),
        "normals": np.concatenate([group.normals for group in groups]),
        "point_to_bone": np.concatenate([group.part for group in groups]).astype(np.int32),
        "point_from_sharp": np.arange(len(points)) >= len(row.surface),
        "bone_structure": np.array([[j.parent, j.part] for j in row.joints], np.int32),
        "link_axes_plucker": axes,
        "link_range": ranges,
    }


FORMAT = Format(
    "Particulate: an object's rest-pose surface with parts, Pluecker axes and ranges",
    of_objects,
    _write,
)
