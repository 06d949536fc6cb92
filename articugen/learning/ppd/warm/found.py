"""What moves in the training objects: found by `articugen.discovery`, and kept beside the runs."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from articugen.core.errors import InvalidArgument, InvalidCheckpoint, UnfitData
from articugen.core.files import make_folder
from articugen.core.processes import Crew
from articugen.core.records import JointKind, dequantize
from articugen.discovery import KINDS, Directions, Discovery, FoundJoint, discover
from articugen.learning.sealed import read_arrays, write_arrays

if TYPE_CHECKING:  # imports torch, which workers that look for joints have no use for
    from articugen.learning.data.split import PackedSplit

FORMAT = "articugen joints 7"
"""Of the files that keep what was found; to be raised when something else would be found."""

FOLDER = "joints"
"""Holds a file for each object, beside the runs."""

MOST_POSES = 128
"""Poses of an object that are searched, which takes seconds; the others have no targets."""

LEAST_SCORE = 0.4
"""Of every joint in an object, else it says nothing."""

FEW_OBJECTS = 0.25
"""A kind of joint that a smaller share of the objects has is a mistake."""

_JOINT = ("kind", "axis", "pivot", "states", "score")

Found = list[Discovery | None]
"""Discovery of each object; None where there is none."""

Notify = Callable[[str], None]

_Clouds = tuple[NDArray[np.int16], NDArray[np.int8]]
"""An object's poses as they are stored: points and normals (K, n, 3)."""


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
    clouds = [
        (training.surface[some].cpu().numpy(), training.normals[some].cpu().numpy())
        for some in rows
    ]
    folder = beside / FOLDER
    make_folder(folder)
    discoveries = _looked_for(clouds, directions, folder, notify)
    if not any(discoveries):
        raise UnfitData(
            f"{beside}: in no training object do the poses show what moves; make the data set "
            "with more states, or set warm_start.share=0"
        )
    return discoveries, rows


def kinds_of(discoveries: Found) -> set[JointKind]:
    """Return the kinds of joints that more than a few of the objects have."""
    per_object = [{joint.kind for joint in one.joints} for one in discoveries if one]
    return {
        k
        for k in KINDS
        if sum(k in kinds for kinds in per_object) >= FEW_OBJECTS * len(per_object) > 0
    }


class _Asked(NamedTuple):
    """The poses of an object; the kinds of joints to look for, and where those point; the folder
    for what is found."""

    poses: _Clouds
    kinds: tuple[JointKind, ...]
    directions: Directions
    folder: Path

    @property
    def path(self) -> Path:
        """The file for what is found, named after what is searched."""
        axes = {str(kind): some.tolist() for kind, some in sorted(self.directions.items())}
        points, normals = self.poses
        hashed = hashlib.sha256(json.dumps([axes, self.kinds, points.shape]).encode())
        hashed.update(points.tobytes() + normals.tobytes())
        return self.folder / f"{hashed.hexdigest()[:32]}.safetensors"


def _looked_for(
    clouds: Sequence[_Clouds], directions: Directions, folder: Path, notify: Notify
) -> Found:
    """Return what is found in each object; the search is repeated where it finds nothing, or a kind
    of joint that few others have: a drawer that is shallow may as well turn a little."""
    outcomes: Found = [None] * len(clouds)

    def search(objects: Sequence[int], kinds: tuple[JointKind, ...], what: str) -> None:
        missing = {}
        for i in objects:
            task = _Asked(clouds[i], kinds, directions, folder)
            try:
                outcomes[i] = _read(read_arrays(task.path, FORMAT)["object"], clouds[i])
            except InvalidCheckpoint:  # not there, or of a disk that lost power
                missing[i] = task
        if not missing:
            return
        done = len(objects) - len(missing)
        with Crew(_look, workers=os.cpu_count() or 1, notice=notify) as crew:
            looks = crew.in_order([*missing.values()])
            for count, (i, one) in enumerate(zip(missing, looks, strict=True), done + 1):
                outcomes[i] = one
                notify(f"{what}: {count} of {len(objects)}")

    search(range(len(clouds)), KINDS, "looking for joints in the training objects")
    kinds = kinds_of(outcomes)
    if 0 < len(kinds) < len(KINDS):
        unlike = [
            i
            for i, one in enumerate(outcomes)
            if not one or {joint.kind for joint in one.joints} - kinds
        ]
        search(unlike, tuple(sorted(kinds)), "looking again where they are unlike the others")
    return outcomes


def _look(task: _Asked) -> Discovery | None:
    """Return what is found in an object, and keep it."""
    points, normals = list(_points(task.poses)), list(task.poses[1] / 127.0)
    outcome = None
    with suppress(InvalidArgument):  # nothing moves, or not as one joint would
        outcome = discover(points, normals=normals, kinds=task.kinds, directions=task.directions)
    if outcome and not (outcome.joints and min(j.score for j in outcome.joints) >= LEAST_SCORE):
        outcome = None
    write_arrays(task.path, {"object": _plain(outcome)}, FORMAT)
    return outcome


def _points(poses: _Clouds) -> NDArray[np.float64]:
    """Return (K, n, 3) the points, in the unit frame."""
    return dequantize(poses[0].view(np.uint16))


def _plain(discovery: Discovery | None) -> dict[str, Any]:
    """Return a discovery as `write_arrays` takes it."""
    if discovery is None:
        return {}
    columns = {n: np.array([getattr(joint, n) for joint in discovery.joints]) for n in _JOINT}
    return {**columns, "part": discovery.part.astype(np.uint8)}


def _read(kept: dict[str, Any], poses: _Clouds) -> Discovery | None:
    if not kept:
        return None
    joints = tuple(
        FoundJoint(JointKind(int(kind)), axis, pivot, states, float(score))
        for kind, axis, pivot, states, score in zip(*(kept[name] for name in _JOINT), strict=True)
    )
    return Discovery(joints, _points(poses)[0], kept["part"].astype(np.int64))
