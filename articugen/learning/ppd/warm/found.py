"""What moves in the training objects: found by `articugen.discovery`, and kept beside the runs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from articugen.core.errors import InvalidArgument, InvalidCheckpoint, UnfitData
from articugen.core.files import make_folder
from articugen.core.processes import Crew, default_jobs
from articugen.core.records import Floats, JointKind, dequantize
from articugen.discovery import KINDS, Directions, FoundJoint, Joints, discover, parts_of_surface
from articugen.learning.sealed import read_arrays, write_arrays

if TYPE_CHECKING:  # imports torch, which workers that look for joints have no use for
    from articugen.learning.data.split import PackedSplit

FORMAT = "articugen joints 9"
"""Of the files that keep what was found; to be raised when something else would be found."""

FOLDER = "joints"
"""Holds a file for each object, beside the runs."""

MOST_POSES = 128
"""Poses of an object that are searched, which takes seconds; the others have no targets."""

LEAST_SCORE = 0.4
"""Of every joint in an object, else it says nothing."""

FEW_OBJECTS = 0.25
"""A kind of joint that a smaller share of the objects has is a mistake."""

Stored = tuple[NDArray[np.int16], NDArray[np.int8]]
"""An object's poses as they are stored: points and normals (K, n, 3)."""


@dataclass(frozen=True, eq=False)
class Known(Joints):
    """The joints of a training object; `owner` (n,) are the parts of the points of all poses that
    `ownership.examined` returns."""

    owner: NDArray[np.uint8]

    @staticmethod
    def of(object_: Joints, poses: Stored) -> Known:
        motion = np.stack([object_.motion(k) for k in range(len(poses[0]))])
        return Known(object_.joints, parts_of_surface(*_clouds(poses), motion))


Found = list[Known | None]
"""What is known of each object; None where nothing is."""

Notify = Callable[[str], None]


def discovered(
    training: PackedSplit, beside: Path, directions: Directions, notify: Notify = lambda _: None
) -> tuple[Found, list[NDArray[np.intp]]]:
    """Return what moves in each object, and the instances that are its poses, at most `MOST_POSES`.

    What is found in an object is kept in a file `beside` the run, named after what is searched:
    several seeds ask for it, a run that was killed, a later window of a stream.

    Args:
        training: with normals.
        directions: where joints of each kind point, as for `discover`.
        notify: called with a sentence for each object that is searched.

    Raises:
        UnfitData: in no object anything is found.
    """
    names = list(dict.fromkeys(training.object_id.tolist()))
    rows = [training.poses_of(name)[:MOST_POSES] for name in names]
    poses = [stored(training, some) for some in rows]
    folder = beside / FOLDER
    make_folder(folder)
    discoveries = _looked_for(poses, directions, folder, notify)
    if not any(discoveries):
        raise UnfitData(
            "in no training object do the poses show joints along model.revolute or .prismatic; "
            "name others, make the data set with more states, or set warm_start.share=0"
        )
    return discoveries, rows


def stored(split: PackedSplit, rows: NDArray[np.intp]) -> Stored:
    """Return the poses `rows` of an object."""
    return split.surface[rows].cpu().numpy(), split.normals[rows].cpu().numpy()


def kinds_of(discoveries: Found) -> set[JointKind]:
    """Return the kinds of joints that more than a few of the objects have."""
    per_object = [{joint.kind for joint in one.joints} for one in discoveries if one]
    return {
        k
        for k in KINDS
        if sum(k in kinds for kinds in per_object) >= FEW_OBJECTS * len(per_object) > 0
    }


class _Asked(NamedTuple):
    """The poses of an object, where joints of each kind point, and the folder for what is found."""

    poses: Stored
    directions: Directions
    folder: Path

    @property
    def path(self) -> Path:
        """The file for what is found, named after what is searched."""
        axes = {str(kind): some.tolist() for kind, some in sorted(self.directions.items())}
        hashed = hashlib.sha256(json.dumps([axes, self.poses[0].shape]).encode())
        hashed.update(self.poses[0].tobytes() + self.poses[1].tobytes())
        return self.folder / f"{hashed.hexdigest()[:32]}.safetensors"


def _looked_for(
    objects: Sequence[Stored], directions: Directions, folder: Path, notify: Notify
) -> Found:
    """Return what is found in each object."""
    outcomes: Found = [None] * len(objects)
    missing = {}
    for i, poses in enumerate(objects):
        task = _Asked(poses, directions, folder)
        try:
            outcomes[i] = _read(read_arrays(task.path, FORMAT))
        except InvalidCheckpoint:  # not there, or of a disk that lost power
            missing[i] = task
    with Crew(_look, workers=default_jobs(), notice=notify) as crew:
        looks = crew.in_order([*missing.values()])
        before = len(objects) - len(missing)
        for count, (i, one) in enumerate(zip(missing, looks, strict=True), before + 1):
            outcomes[i] = one
            notify(f"looking for joints in the training objects: {count} of {len(objects)}")
    return outcomes


def _look(task: _Asked) -> Known | None:
    """Return what is found in an object, and keep it."""
    (points, normals), known = _clouds(task.poses), None
    with suppress(InvalidArgument):  # nothing moves, or not as one joint would
        one = discover(points, normals=normals, directions=task.directions)
        if one.joints and min(joint.score for joint in one.joints) >= LEAST_SCORE:
            known = Known.of(one, task.poses)
    joints = {str(j): vars(joint) for j, joint in enumerate(known.joints)} if known else {}
    write_arrays(task.path, {"joints": joints, **({"owner": known.owner} if known else {})}, FORMAT)
    return known


def _read(kept: dict[str, Any]) -> Known | None:
    joints = kept["joints"].values()
    joints = tuple(FoundJoint(**{**joint, "kind": JointKind(joint["kind"])}) for joint in joints)
    return Known(joints, kept["owner"]) if joints else None


def _clouds(poses: Stored) -> tuple[list[Floats], list[Floats]]:
    """Return the points (n, 3) of each pose, in the unit frame, and their normals."""
    return list(dequantize(poses[0].view(np.uint16))), list(poses[1] / 127.0)
