"""The layout of PPD's own release: what its loader and its evaluation read.

data/sample/<class>/<object>/<pose>/ with points, surface, motion and a posed mesh a part; lists of
splits. A joint moves its part from the base, as all of theirs do: chains are left out.
"""

from itertools import chain

import numpy as np
from numpy.typing import NDArray

from articugen.core.geometry import apply, voxel_centres
from articugen.export.formats import Format
from articugen.export.items import Item, LeftOut, canonical, file_name, of_objects
from articugen.export.labels import grid, need, part_values
from articugen.export.parts import part_solids
from articugen.export.target import Files, Target
from articugen.meshes.model_text import obj_text
from articugen.store.dataset import DataSet
from articugen.store.rows import Row

_RESOLUTIONS = (16, 32)
_POINTS = 4096
_MOST_JOINTS = 7
_PRIMITIVES = {"revolute": "rotation", "prismatic": "translation"}
_TAIL = "sample_wise_normalize"


def _write(item: Item, target: Files) -> None:
    _check(canonical(item.rows))
    solids = part_solids(item.rows, target.options)
    for row in item.rows:
        folder = f"data/sample/{_pose(row)}"
        for resolution in _RESOLUTIONS:
            lattice = (voxel_centres(resolution) + 0.5) * 256.0 - 0.5
            values = part_values(grid(row, resolution), target.options).reshape(-1, 1)
            name = f"{folder}/points_values_whole_shape_{_TAIL}_{resolution}.npz"
            target.write_arrays(name, {"points": lattice.astype(np.float32), "values": values})
        surface = {"points": row.surface.points, "normals": row.surface.normals}
        target.write_arrays(f"{folder}/surface_points_whole_shape_{_TAIL}.npz", surface)
        target.write_arrays(f"{folder}/motion_param_{_TAIL}.npz", _motion(row))
        for part, (mesh, _) in enumerate(solids):
            posed = apply(row.parts[part].motion, mesh.vertices)
            text = obj_text([(posed, mesh.faces)])
            target.write(f"{folder}/surface_mesh_{_TAIL}_{part}.obj", text.encode())


def _check(row: Row) -> None:
    need(row, "surface", _POINTS)
    chained = [joint for joint in row.joints if joint.parent]
    if chained:
        raise LeftOut(
            f"{row.object_id}: a joint hangs on another ({chained[0].name or chained[0].part}), "
            "which PPD's release cannot say"
        )
    if len(row.joints) > _MOST_JOINTS:
        raise LeftOut(
            f"{row.object_id}: {len(row.joints)} joints; PPD's release has {_MOST_JOINTS}"
        )


def _motion(row: Row) -> dict[str, NDArray]:
    fields: dict[str, NDArray] = {}
    for kind, word in _PRIMITIVES.items():
        joints = [joint for joint in row.joints if joint.kind == kind]
        fields[f"{word}_primitives_num"] = np.array(len(joints))
        for i, joint in enumerate(joints):
            fields[f"{word}_anchor_point_{i}"] = np.asarray(joint.pivot)
            fields[f"{word}_direction_{i}"] = np.asarray(joint.axis)
            fields[f"{word}_amount_{i}"] = np.array([joint.state_unit])
            fields[f"{word}_amount_min_{i}"] = np.array([joint.lower_unit])
            fields[f"{word}_amount_max_{i}"] = np.array([joint.upper_unit])
    return fields


def _pose(row: Row) -> str:
    """<class>/<object>/<pose>, as the lists name it."""
    return f"{file_name(row.category)}/{file_name(row.object_id)}/{row.state_index:04d}"


def _finish(data: DataSet, target: Target) -> None:
    written: dict[str, list[list[str]]] = {split: [] for split in data.splits}
    for item in of_objects(data):
        if not target.done[item.key].left_out:
            written[item.rows[0].split].append([_pose(row) for row in item.rows])
    train = written.get("train", [])
    written.setdefault("val", train[: -(-len(train) // 10)])  # a part of train, as theirs is
    lists = {split: list(chain(*objects)) for split, objects in written.items()}
    lists["all"] = [pose for split in data.splits for pose in lists[split]]
    for name, poses in lists.items():
        target.write_lines(f"data/list/{file_name(name)}.lst", poses)


FORMAT = Format(
    "the PPD authors' release: points, surface, motion, posed part meshes, lists",
    of_objects,
    _write,
    _finish,
    takes=("occupancy", "resolution", "from_grids"),
)
