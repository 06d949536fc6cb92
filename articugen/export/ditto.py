"""Ditto's scenes: an object before and after one joint moved, seen by depth cameras.

<split>/scenes/<object>_<state>_<state>.npz for each two neighbouring states between which one joint
alone moves, by `LEAST_STEP` of its range at least. Their occupancy is of two parts then, as in
their data of several joints: what stays, and what moves.
"""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bools, Bytes
from articugen.core.errors import InvalidArgument
from articugen.core.geometry import apply, invert_rigid
from articugen.core.recipe import LEAST_STEP
from articugen.export.formats import Format
from articugen.export.items import Item, LeftOut, file_name, of_objects
from articugen.export.labels import need
from articugen.export.target import Files
from articugen.store.rows import Row


def _write(item: Item, target: Files) -> None:
    if "Shape2Motion" in str(target.folder.resolve()):
        raise InvalidArgument(
            f"{target.folder}: Ditto's loader counts parts otherwise where a path has Shape2Motion "
            "in it; choose another folder"
        )
    rows = list(item.rows)
    first = rows[0]
    if len(rows) < 2:
        raise LeftOut(f"{first.object_id}: one state; Ditto's scenes are of two")
    need(first, "partial", 1)
    split, name = file_name(first.split), file_name(first.object_id)
    pairs = [(a, b, j) for a, b in pairwise(rows) if (j := _moved(a, b)) is not None]
    if not pairs:
        raise LeftOut(
            f"{first.object_id}: in no two neighbouring states one joint alone moves, by "
            f"{LEAST_STEP:g} of its range, as in Ditto's scenes; make the data with "
            "articulation.one_at_a_time"
        )
    for start, end, j in pairs:
        scene = f"{name}_{start.state_index:04d}_{end.state_index:04d}"
        target.write_arrays(f"{split}/scenes/{scene}.npz", _scene(start, end, j))


def _moved(start: Row, end: Row) -> int | None:
    """Return the joint whose state alone differs, to the last digit, and by enough; or None."""
    both = list(zip(start.joints, end.joints, strict=True))
    moved = [j for j, (a, b) in enumerate(both) if a.state_unit != b.state_unit]
    if len(moved) != 1:
        return None
    a, b = both[moved[0]]
    is_far = abs(b.state_unit - a.state_unit) >= LEAST_STEP * (a.upper_unit - a.lower_unit)
    return moved[0] if is_far else None


def _scene(start: Row, end: Row, j: int) -> dict[str, NDArray]:
    joint = start.joints[j]
    both = zip(start.parts, end.parts, strict=True)
    moving = np.array([not np.array_equal(a.motion, b.motion) for a, b in both])
    axis = np.asarray(joint.axis)
    fields: dict[str, NDArray] = {
        "screw_axis": axis,
        "screw_moment": np.cross(joint.pivot, axis),
        "joint_type": np.array(0 if joint.kind == "revolute" else 1),
        "joint_index": np.array(1),
        "state_start": np.array(joint.state_unit),
        "state_end": np.array(end.joints[j].state_unit),
    }
    for word, other, here, there in (("start", "end", start, end), ("end", "start", end, start)):
        cloud = here.partial.points.reshape(-1, 3)
        part = here.partial.part.reshape(-1)
        label = np.concatenate([here.uniform.label, here.near.label])
        fields |= {
            f"pc_{word}": cloud,
            f"pc_{word}_{other}": _carried(cloud, part, here, there, moving),
            f"pc_seg_{word}": moving[part],
            f"{word}_p_occ": np.concatenate([here.uniform.points, here.near.points]),
            f"{word}_occ_list": np.stack(
                [np.isin(label, 1 + np.flatnonzero(of)) for of in (~moving, moving)]
            ),
            f"{word}_occ_density": np.ones((len(label), 1)),
        }
    return fields


def _carried(
    cloud: NDArray[np.float32], part: Bytes, here: Row, there: Row, moving: Bools
) -> NDArray[np.float32]:
    """Return points of `cloud` (n, 3), each with its part, where they are in the other state."""
    moved = cloud.copy()
    for k in np.flatnonzero(moving):
        T = there.parts[k].motion @ invert_rigid(here.parts[k].motion)
        moved[part == k] = apply(T, cloud[part == k])
    return moved


FORMAT = Format(
    "Ditto: scenes of an object before and after a joint moved, clouds and occupancy",
    of_objects,
    _write,
)
