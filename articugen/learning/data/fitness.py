"""What makes a data set unfit to learn from: one sentence each, before training starts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from articugen.core.errors import UnfitData
from articugen.core.records import is_material
from articugen.store.manifest import Manifest
from articugen.store.shards import Shard, open_shard

if TYPE_CHECKING:
    from articugen.learning.data.batch import BatchSpec

COS_30 = math.cos(math.radians(30.0))

SAME = 1e-6
"""Numbers of the unit frame that differ by less are the same."""


def check_shard(shard: Shard, spec: BatchSpec, resolutions: Sequence[int]) -> None:
    """Raise UnfitData where something is not there that the learner must be given."""
    path = shard.path
    _check_joints(shard, spec.joints)
    _check_frame(shard)
    if (spec.poses or spec.varying_points) and not spec.finds_objects:
        _check_poses(shard)
    if spec.partial and 0 in shard.fields["partial_points"]:
        raise UnfitData(
            f"{path}: has no partial clouds; set sampling.partial_views and make the data set again"
        )
    for name in ("surface_points", "uniform_points", "near_points"):
        have, count = shard.fields[name][1], getattr(spec, name)
        if have < count:
            raise UnfitData(
                f"{path}: has {have} {name} an instance, the recipe asks for {count}; "
                "make the data set with more, or lower data in the training recipe"
            )
    for resolution in resolutions:
        if f"occupancy_{resolution}" not in shard.fields:
            raise UnfitData(
                f"{path}: has no occupancy_{resolution}; add {resolution} to sampling.grids and "
                "make the data set again"
            )


def _check_joints(shard: Shard, joints: tuple[int, int] | None) -> None:
    """Check that every joint has a candidate of its kind."""
    if joints is None:
        return
    kind = shard.read("joint_kind")
    if not kind.size:
        raise UnfitData(f"{shard.path}: has no joint; what never moves teaches no parts")
    have = [int((kind == number).sum(1).max()) for number in (1, 2)]
    if any(has > most for has, most in zip(have, joints, strict=True)):
        raise UnfitData(
            f"{shard.path}: an object has {have[0]} revolute and {have[1]} prismatic joints, the "
            f"recipe's model {joints[0]} and {joints[1]} such parts; take one with more"
        )


def _check_frame(shard: Shard) -> None:
    """Check that all poses of an object lie in one unit frame, in which its fixed part stays where
    it is."""
    names, scale = np.array(shard.object_ids()), shard.read("scale")
    frame = np.concatenate([shard.read("center") / scale[:, None], np.log(scale)[:, None]], 1)
    moved = np.abs(shard.read("part_motion")[:, 0] - np.eye(4)).max(axis=(1, 2)) > SAME
    for name in dict.fromkeys(names.tolist()):
        if np.ptp(frame[names == name], axis=0).max() > SAME or moved[names == name].any():
            raise UnfitData(
                f"{shard.path}: the poses of {name} share no frame: center, scale or the place of "
                "the fixed part differ between them; normalise each object once for all its poses "
                "and make the shard again"
            )


def check_fixed_part(shard: Shard, names: NDArray[Any], grid: NDArray[np.uint8]) -> None:
    """Raise UnfitData where most of an object's fixed part is gone in another of its poses.

    A pose whose grid is empty, as a coarse one of thin parts can be, says nothing, nor do shards of
    format 1, where enclosed space, which a door opens, bears the fixed part's label.

    Args:
        names: (N,) the objects.
        grid: (N, R, R, R) labels as they are stored.
    """
    if shard.attributes["schema_version"] == 1:
        return
    for name in dict.fromkeys(names.tolist()):
        poses = grid[names == name].reshape((names == name).sum(), -1)
        poses = poses[poses.any(axis=1)]
        fixed = np.flatnonzero(poses[:1] == 1)
        if fixed.size and is_material(poses[:, fixed]).mean(axis=1).min() < 0.5:
            raise UnfitData(
                f"{shard.path}: the poses of {name} share no frame: most of its fixed part is not "
                "where it was in the first; normalise each object once for all its poses and make "
                "the shard again"
            )


def check_varies(path: Path, names: NDArray[Any], varying: Sequence[NDArray[np.bool_]]) -> None:
    """Raise UnfitData where no cell of an object differs between its poses.

    Args:
        names: (N,) the objects.
        varying: for each instance a mask (R, R, R).
    """
    for name, mask in zip(names.tolist(), varying, strict=True):
        if not mask.any():
            raise UnfitData(
                f"{path}: no cell of occupancy_{len(mask)} differs between the poses of {name}; "
                "make the data set again with wider joint ranges, or set data.varying_points to 0"
            )


def training_objects(folders: Sequence[Path]) -> list[int]:
    """Return how many objects of each data set are for training."""
    manifests = map(Manifest.read, folders)
    return [sum(o.key.split == "train" for o in m.objects) for m in manifests]


def lying_otherwise(folder: Path) -> list[str]:
    """Return the training objects none of whose joints goes along one of the same kind, whatever
    its sense, of half of the other training objects.

    It may be what they are, as a machine that is loaded from above; or they lie in another frame.
    """
    manifest, along = Manifest.read(folder), {}
    for name in sorted({o.shard for o in manifest.objects if o.key.split == "train"}):
        with open_shard(folder / name) as shard:
            canonical = int(shard.read("state_index").argmin())
            kind, axis = (shard.read(n, canonical) for n in ("joint_kind", "joint_axis"))
            along[shard.object_ids()[canonical]] = kind, axis
    return apart(along)


def apart(along: Mapping[str, tuple[NDArray[np.uint8], NDArray[np.float64]]]) -> list[str]:
    """Return, of objects with kinds (J,) and unit directions (J, 3) of their joints, those that
    have no direction, within 30 degrees, with half of the others in common; what has no joint is
    left out."""
    along, groups = {name: joints for name, joints in along.items() if len(joints[0])}, []
    for name, (kind, axis) in along.items():
        same = [
            bool(((np.abs(axis @ to.T) > COS_30) & (kind[:, None] == of)).any())
            for other, (of, to) in along.items()
            if other != name
        ]
        if same and 2 * sum(same) < len(same):
            groups.append(name)
    return groups


def _check_poses(shard: Shard) -> None:
    """Check that each object is there in several poses."""
    names, count = np.unique(shard.object_ids(), return_counts=True)
    if count.min() < 2:
        raise UnfitData(
            f"{shard.path}: holds one pose of {names[count.argmin()]}, the recipe compares poses "
            "of each object; make the data set with more (generate --states), or use a recipe "
            "with data.varying_points 0 and without a warm start"
        )
