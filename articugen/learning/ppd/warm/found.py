"""What moves in the training objects: found by `articugen.discovery`, and kept beside the runs."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from articugen.core.errors import InvalidArgument, InvalidCheckpoint, UnfitData
from articugen.core.files import make_folder
from articugen.core.processes import Crew
from articugen.core.records import JointKind
from articugen.discovery import KINDS, Directions, Discovery, FoundJoint, discover
from articugen.learning.data.split import PackedSplit, unpacked
from articugen.learning.tensors import read_tensors, write_tensors

FORMAT = "articugen joints 6"
"""Of the files that keep what was found; to be raised when something else would be found."""

MOST_POSES = 128
"""Of an object that are looked at, which takes seconds; the others have nothing to aim at."""

LEAST_SCORE = 0.4
"""Of every joint in an object, else it says nothing."""

FEW_OBJECTS = 0.25
"""A kind of joint that a smaller share of the objects has is a mistake."""

_JOINT = ("kind", "axis", "pivot", "states", "score")

Found = list[Discovery | None]
"""What was found in each object; None where that cannot be told."""

Tell = Callable[[str], None]


def discovered(
    training: PackedSplit,
    beside: Path,
    directions: Directions,
    tell: Tell = lambda _: None,
) -> tuple[Found, list[NDArray[np.intp]]]:
    """What moves in each object, and the instances that are its poses, at most `MOST_POSES`.

    It is kept in a file `beside` the run, named after what is looked at: several seeds ask for it.
    Until all are looked at each object has a file of its own, so that a run that was killed goes on
    with the others.

    Args:
        training: with normals.
        directions: where joints of each kind point, as for `discover`.
        tell: called with a sentence for each object.

    Raises:
        UnfitData: in no object anything is found.
        InvalidCheckpoint: the file is damaged.
    """
    names = list(dict.fromkeys(training.object_id.tolist()))
    rows = [training.poses_of(name)[:MOST_POSES] for name in names]
    clouds = [_Clouds.of(training, mine) for mine in rows]
    path = beside / f"joints-{_digest(clouds, directions)}.safetensors"
    if path.is_file():
        kept = read_tensors(path, FORMAT)["objects"]
        return [_read(kept[str(i)], cloud) for i, cloud in enumerate(clouds)], rows
    looked = beside / f".{path.stem}"
    make_folder(looked)
    found = _looked_for(clouds, directions, looked, tell)
    if not any(found):
        raise UnfitData(
            f"{beside}: the poses of no training object tell what moves in it; make the data set "
            "with more states, or set warm_start.share=0"
        )
    write_tensors(path, {"objects": {str(i): _plain(x) for i, x in enumerate(found)}}, FORMAT)
    shutil.rmtree(looked, ignore_errors=True)
    return found, rows


def kinds_of(found: Found) -> set[JointKind]:
    """Return the kinds of joints that more than a few of the objects have."""
    own = [{joint.kind for joint in each.joints} for each in found if each]
    return {k for k in KINDS if sum(k in kinds for kinds in own) >= FEW_OBJECTS * len(own) > 0}


@dataclass(frozen=True)
class _Clouds:
    """An object's poses as they are stored: `points` and `normals` (K, n, 3)."""

    points: NDArray[np.int16]
    normals: NDArray[np.int8]

    @staticmethod
    def of(split: PackedSplit, rows: NDArray[np.intp]) -> _Clouds:
        at = torch.from_numpy(rows)
        return _Clouds(split.surface[at].cpu().numpy(), split.normals[at].cpu().numpy())

    def unpacked(self) -> NDArray[np.float64]:
        """Return (K, n, 3) the points, in the unit frame."""
        return unpacked(torch.from_numpy(self.points)).double().numpy()


@dataclass(frozen=True)
class _Asked:
    """The poses of an object; the kinds of joints to look for, and where those point; the file for
    what is found."""

    poses: _Clouds
    kinds: tuple[JointKind, ...]
    directions: Directions
    path: Path


def _looked_for(
    clouds: Sequence[_Clouds], directions: Directions, folder: Path, tell: Tell
) -> Found:
    """What is found in each object; again where it is nothing, or a kind of joint that few others
    have: a drawer that is shallow may as well turn a little."""

    def asked(i: int, kinds: tuple[JointKind, ...]) -> _Asked:
        path = folder / f"{i}-{'-'.join(map(str, kinds))}.safetensors"
        return _Asked(clouds[i], kinds, directions, path)

    found: Found = []
    with Crew(_look, workers=os.cpu_count() or 1) as crew:
        for each in crew.in_order([asked(i, KINDS) for i in range(len(clouds))]):
            found.append(each)
            tell(f"looking for joints in the training objects: {len(found)} of {len(clouds)}")
        kinds = kinds_of(found)
        again = [
            i
            for i, each in enumerate(found)
            if not each or {joint.kind for joint in each.joints} - kinds
        ]
        if 0 < len(kinds) < len(KINDS):
            looks = crew.in_order([asked(i, tuple(sorted(kinds))) for i in again])
            for n, (i, each) in enumerate(zip(again, looks, strict=True), 1):
                found[i] = each
                tell(f"looking again where they are unlike the others: {n} of {len(again)}")
    return found


def _look(asked: _Asked) -> Discovery | None:
    """What is found in an object, or was found there before this run was killed."""
    with suppress(InvalidCheckpoint):  # not there, or of a disk that lost power
        return _read(read_tensors(asked.path, FORMAT)["object"], asked.poses)
    points, normals = list(asked.poses.unpacked()), list(asked.poses.normals / 127.0)
    found = None
    with suppress(InvalidArgument):  # nothing moves, or not as one joint would
        found = discover(points, normals=normals, kinds=asked.kinds, directions=asked.directions)
    if found and not (found.joints and min(j.score for j in found.joints) >= LEAST_SCORE):
        found = None
    write_tensors(asked.path, {"object": _plain(found)}, FORMAT)
    return found


def _digest(clouds: Sequence[_Clouds], directions: Directions) -> str:
    said = {str(kind): each.tolist() for kind, each in sorted(directions.items())}
    hashed = hashlib.sha256(json.dumps(said).encode())
    for cloud in clouds:
        hashed.update(f"{cloud.points.shape}".encode())
        hashed.update(cloud.points.tobytes() + cloud.normals.tobytes())
    return hashed.hexdigest()[:16]


def _plain(found: Discovery | None) -> dict[str, Any]:
    """As `write_tensors` wants it."""
    if found is None:
        return {}
    columns = {n: np.array([getattr(joint, n) for joint in found.joints]) for n in _JOINT}
    columns["part"] = found.part.astype(np.uint8)
    return {name: torch.from_numpy(column) for name, column in columns.items()}


def _read(kept: dict[str, Any], poses: _Clouds) -> Discovery | None:
    if not kept:
        return None
    joints = tuple(
        FoundJoint(JointKind(int(kind)), axis, pivot, states, float(score))
        for kind, axis, pivot, states, score in zip(
            *(kept[name].numpy() for name in _JOINT), strict=True
        )
    )
    return Discovery(joints, poses.unpacked()[0], kept["part"].numpy().astype(np.int64))
