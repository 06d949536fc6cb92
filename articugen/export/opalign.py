"""OP-Align: single depth views with part poses and joints, one .npz a view.

<category>/<split>/<object>/<state>/input_2/<camera>.npz. Points have the colours of the nearest
surface points, grey where none are stored. Their loader unpickles the one dict that an .npz holds;
nothing but arrays is in it.
"""

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Floats
from articugen.core.geometry import apply
from articugen.export.formats import Format
from articugen.export.items import Item, file_name, of_objects
from articugen.export.labels import need, seen
from articugen.export.parts import part_boxes
from articugen.export.target import Files
from articugen.meshes.distances import nearest
from articugen.store.rows import Row

_GREY = 0.5


def _write(item: Item, target: Files) -> None:
    need(item.rows[0], "partial", 1)
    boxes = part_boxes(item.rows)
    for row in item.rows:
        folder = f"{file_name(row.category)}/{file_name(row.split)}/{file_name(row.object_id)}"
        for camera in range(len(row.partial.part)):
            name = f"{folder}/{row.state_index:04d}/input_2/{camera:02d}.npz"
            target.write_arrays(name, {"arr_0": np.array(_view(row, camera, boxes), dtype=object)})


def _view(row: Row, camera: int, boxes: Floats) -> dict[str, NDArray]:
    T_camera_unit = row.partial.T_camera_world[camera]
    points, part = seen(row, camera)
    return {
        "pc": points,
        "color": _colours(row, camera),
        "detection": np.ones(len(points), np.bool_),
        "segmentation": part.astype(np.int64) + 1,
        "part": np.stack([
            np.concatenate([
                (T := T_camera_unit @ here.motion)[:3, :3].ravel(),
                apply(T, box.mean(axis=0)),
                box[1] - box[0],
            ])
            for here, box in zip(row.parts, boxes, strict=True)
        ]),
        "joint": np.stack([
            np.concatenate([apply(T_camera_unit, j.pivot), T_camera_unit[:3, :3] @ j.axis])
            for j in row.joints
        ]),
    }  # fmt: skip


def _colours(row: Row, camera: int) -> NDArray[np.float32]:
    """Return (M, 3) sRGB, from 0 to 1, of the points that a camera sees."""
    points = row.partial.points[camera]
    if "surface_color" not in row.fields:
        return np.full(points.shape, _GREY, np.float32)
    triangles = np.repeat(row.surface.points[:, None].astype(np.float64), 3, axis=1)  # each a point
    near = nearest(points.astype(np.float64), triangles)[1]
    return (row.surface.color[near] / 255.0).astype(np.float32)


FORMAT = Format("OP-Align: single depth views with part poses and joints", of_objects, _write)
