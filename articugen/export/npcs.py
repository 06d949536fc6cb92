"""NPCS and A-NCSH: depth views with, for each point, its place in the part's rest pose.

hdf5/<category>/<object>/<state>/<camera>.h5 with gt_points/<part> in the camera's frame and
gt_coords/<part> in the rest pose; pickle/ with what normalises each part; splits/ with the lists.
"""

import pickle

import numpy as np

from articugen.export.cameras import camera_count, seen
from articugen.export.formats import Format, Item, LeftOut
from articugen.export.hdf5 import packed
from articugen.export.items import canonical, file_name, of_objects
from articugen.export.labels import need
from articugen.export.target import Target
from articugen.geometry import apply, bounds, invert_rigid
from articugen.records import Floats
from articugen.store.dataset import DataSet
from articugen.store.rows import Row

_SHARE = "all"
"""Their folder names in splits/<category>/ tell how much of the data a list has."""


def _write(item: Item, target: Target) -> None:
    need(item.rows[0], "partial", 1)
    _boxes(item.rows)
    for row in item.rows:
        for camera, name in enumerate(_files(row)):
            points, part = seen(row, camera)
            cloud = row.partial.points[camera].astype(np.float64)
            arrays = {}
            for k, own in enumerate(row.parts):
                mine = part == k
                arrays[f"gt_points/{k}"] = points[mine]
                rest = apply(invert_rigid(own.motion), cloud[mine])
                arrays[f"gt_coords/{k}"] = rest.astype(np.float32)
            target.write(name, packed(arrays))


def _files(row: Row) -> list[str]:
    folder = f"hdf5/{file_name(row.category)}/{file_name(row.object_id)}/{row.state_index:04d}"
    return [f"{folder}/{camera}.h5" for camera in range(camera_count(row))]


def _finish(data: DataSet, target: Target) -> None:
    factors: dict[str, list[float]] = {}
    corners: dict[str, list[list[Floats]]] = {}
    category = file_name(data.category)
    files: dict[str, list[str]] = {split: [] for split in data.splits}
    for name, rows in data.by_object():
        if target.done[f"{rows[0].split}/{file_name(name)}"].left_out:
            continue
        files[rows[0].split] += [file for row in rows for file in _files(row)]
        boxes = _boxes(rows)
        factors[file_name(name)] = [1.0 / float(np.linalg.norm(b[1] - b[0])) for b in boxes]
        corners[file_name(name)] = [[b[0][None], b[1][None]] for b in boxes]
    target.write(f"pickle/{category}.pkl", pickle.dumps(factors))
    target.write(f"pickle/{category}_corners.pkl", pickle.dumps(corners))
    for split, names in files.items():
        lines = "".join(f"{name}\n" for name in names)
        target.write(f"splits/{category}/{_SHARE}/{file_name(split)}.txt", lines.encode())


def _boxes(rows: DataSet) -> list[Floats]:
    """(2, 3) of the whole object and of each part in the rest pose, by their surface points.

    A part that hides in the canonical pose is measured by all poses.

    Raises:
        LeftOut: one hides in all of them.
    """
    row = canonical(rows)
    parts = [
        np.concatenate([
            apply(invert_rigid(r.parts[k].motion), r.surface.points[r.surface.part == k])
            for r in ([row] if (row.surface.part == k).any() else rows)
        ])
        for k in range(len(row.parts))
    ]  # fmt: skip
    hidden = [k for k, points in enumerate(parts) if not len(points)]
    if hidden:
        raise LeftOut(
            f"{row.object_id}: part {hidden[0]} has no surface points, so that nothing tells its "
            "size; leave the object out of the data"
        )
    return [bounds(np.concatenate(parts)), *map(bounds, parts)]


FORMAT = Format(
    "NPCS, A-NCSH: depth views with rest-pose coordinates of each point, HDF5 a view",
    of_objects,
    _write,
    _finish,
)
