"""NPCS and A-NCSH: depth views with, for each point, its place in the part's rest pose.

hdf5/<category>/<object>/<state>/<camera>.h5 with gt_points/<part> in the camera's frame and
gt_coords/<part> in the rest pose; pickle/ with what normalises each part; splits/ with the lists;
render/ with the names of objects and views, urdf/ with joints, from which its loader takes these.
"""

import pickle

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Floats
from articugen.core.geometry import apply, bounds, box_corners, invert_rigid
from articugen.export.formats import Format
from articugen.export.hdf5 import packed
from articugen.export.items import Item, canonical, file_name, of_objects
from articugen.export.labels import need, seen
from articugen.export.parts import part_boxes
from articugen.export.target import Files, Target
from articugen.meshes.model_text import Joint, Visual, obj_text, urdf_text
from articugen.store.dataset import DataSet
from articugen.store.rows import Row

_SHARE = "all"  # their folder names in splits/<category>/ say how much of the data a list has
_GREY = np.full((1, 1, 3), 128, np.uint8)
"""Its loader wants a picture of every view; shards hold no colours of points."""

_FACES = [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4],
          [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5]]  # fmt: skip
"""Of `box_corners`, outwards."""


def _write(item: Item, target: Files) -> None:
    need(item.rows[0], "partial", 1)
    rest, boxes = canonical(item.rows), part_boxes(item.rows)
    place = _place(rest)
    for name, text in _model(rest, boxes).items():
        target.write(f"urdf/{place}/{name}", text.encode())
    for row in item.rows:
        views = map(str, range(len(row.partial.part)))
        target.write_lines(f"render/{place}/{row.state_index:04d}/all.txt", views)
        for camera, name in enumerate(_files(row)):
            points, part = seen(row, camera)
            cloud = row.partial.points[camera].astype(np.float64)
            arrays: dict[str, NDArray] = {"rgb": _GREY}
            for k, T in enumerate(invert_rigid(np.stack([p.motion for p in row.parts]))):
                on_it = part == k
                arrays[f"gt_points/{k}"] = points[on_it]
                arrays[f"gt_coords/{k}"] = apply(T, cloud[on_it]).astype(np.float32)
            target.write(name, packed(arrays))


def _place(row: Row) -> str:
    return f"{file_name(row.category)}/{file_name(row.object_id)}"


def _files(row: Row) -> list[str]:
    folder = f"hdf5/{_place(row)}/{row.state_index:04d}"
    return [f"{folder}/{camera}.h5" for camera in range(len(row.partial.part))]


def _model(rest: Row, boxes: Floats) -> dict[str, str]:
    """Texts by file name: syn.urdf in the unit frame, and the box of each part. Its loader counts
    these, and takes a joint's place from where its part's visual stands."""
    links = ["base_link", *(str(joint.part) for joint in rest.joints)]
    pivots = [np.zeros(3), *(joint.pivot for joint in rest.joints)]
    visuals = {
        link: [Visual(f"{k}.obj", -pivot, rpy=(0, 0, 0))]
        for k, (link, pivot) in enumerate(zip(links, pivots, strict=True))
    }
    joints = [
        Joint(
            name=f"{joint.parent}_{joint.part}",
            kind=joint.kind,
            parent=links[joint.parent],
            child=links[joint.part],
            origin=joint.pivot - pivots[joint.parent],
            axis=joint.axis,
            lower=joint.lower_unit,
            upper=joint.upper_unit,
        )
        for joint in rest.joints
    ]
    meshes = {
        f"{k}.obj": obj_text([(box_corners(box), np.array(_FACES))]) for k, box in enumerate(boxes)
    }
    return {"syn.urdf": urdf_text(file_name(rest.object_id), visuals, joints), **meshes}


def _finish(data: DataSet, target: Target) -> None:
    factors: dict[str, list[float]] = {}
    corners: dict[str, list[list[Floats]]] = {}
    category = file_name(data.category)
    files: dict[str, list[str]] = {split: [] for split in data.splits}
    for item in of_objects(data):
        if target.done[item.key].left_out:
            continue
        files[item.rows[0].split] += [file for row in item.rows for file in _files(row)]
        parts, name = part_boxes(item.rows), file_name(item.rows[0].object_id)
        boxes = [bounds(parts.reshape(-1, 3)), *parts]  # the whole object's first
        factors[name] = [1.0 / float(np.linalg.norm(b[1] - b[0])) for b in boxes]
        corners[name] = [[b[0][None], b[1][None]] for b in boxes]
    target.write(f"pickle/{category}.pkl", pickle.dumps(factors))
    target.write(f"pickle/{category}_corners.pkl", pickle.dumps(corners))
    for split, names in files.items():
        target.write_lines(f"splits/{category}/{_SHARE}/{file_name(split)}.txt", names)


FORMAT = Format(
    "NPCS, A-NCSH: depth views with rest-pose coordinates of each point, HDF5 a view",
    of_objects,
    _write,
    _finish,
)
