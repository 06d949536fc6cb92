"""Particulate: an object's surface in its rest pose, with parts, joints and their ranges.

train/<object>.npz as its cached training points: it articulates them itself. A shut drawer shows no
more than its front, so the points of each part are those of the state that shows most of it,
brought back to the rest pose. The object is scaled until its longest edge is 1. Points of sharp
edges follow those of the surface; where shards hold none, its loader draws all from the surface.
"""

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Floats
from articugen.core.geometry import apply, bounds, invert_rigid
from articugen.core.seeding import generator
from articugen.export.formats import Format
from articugen.export.items import Item, canonical, file_name, of_objects
from articugen.export.labels import need
from articugen.export.target import Files
from articugen.store.dataset import DataSet

_CELLS = 16  # along the unit frame: coarse enough that the density of points does not count


def _write(item: Item, target: Files) -> None:
    row = canonical(item.rows)
    need(row, "surface", 2)
    name = f"{file_name(row.split)}/{file_name(row.object_id)}.npz"
    groups = [_rest(item.rows, "surface")]
    if "sharp_points" in row.fields:
        groups.append(_rest(item.rows, "sharp"))
    points, normals, part = map(np.concatenate, zip(*groups, strict=True))
    box = bounds(points)
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
    arrays = {
        "points": ((points - middle) * scale).astype(np.float32),
        "normals": normals.astype(np.float32),
        "point_to_bone": part,
        "point_from_sharp": np.arange(len(points)) >= len(groups[0][0]),
        "bone_structure": np.array([[j.parent, j.part] for j in row.joints], np.int32),
        "link_axes_plucker": axes,
        "link_range": ranges,
    }
    target.write_arrays(name, arrays)


def _rest(rows: DataSet, stem: str) -> tuple[Floats, Floats, NDArray[np.int32]]:
    """Points of the surface or of sharp edges, their normals and parts, in the rest pose: of each
    part those of the state in which they fill most cells. They are in no order."""
    most: dict[int, tuple[int, Floats, Floats]] = {}
    for row in rows:
        group = getattr(row, stem)
        for k, part in enumerate(row.parts):
            on_it, T = group.part == k, invert_rigid(part.motion)
            points = apply(T, group.points[on_it])
            cell = np.floor((points + 1.0) * _CELLS).astype(np.int64) @ [1, 1 << 20, 1 << 40]
            filled = len(np.unique(cell))
            if k not in most or filled > most[k][0]:
                most[k] = filled, points, group.normals[on_it] @ T[:3, :3].T
    number = np.concatenate([np.full(len(most[k][1]), k, np.int32) for k in most])
    order = generator(0, rows[0].object_id, stem, "particulate").permutation(len(number))
    points, normals = (np.concatenate([most[k][i] for k in most])[order] for i in (1, 2))
    return points, normals, number[order]


FORMAT = Format(
    "Particulate: an object's rest-pose surface with parts, Pluecker axes and ranges",
    of_objects,
    _write,
)
