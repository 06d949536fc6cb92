"""Joints on moving parts: seen from a moving part, what hangs on it moves as on a fixed one."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from articugen.core.arrays import Bools, Floats, Ints
from articugen.core.errors import InvalidArgument
from articugen.core.geometry import invert_rigid
from articugen.core.records import JointKind
from articugen.discovery.clouds import Change, Surface, change, surfaces_of
from articugen.discovery.discover import KINDS, complete, in_clouds, parted, score, searched
from articugen.discovery.joints import Discovery, FoundJoint, Joints
from articugen.discovery.search import motions

# Shares of the poses:
_FOLLOWS = 0.6  # a point that a joint moves lies on something in so many
_OPEN = 0.7  # one is open that no joint lays on something in so many
# Of all points that have left pose 0, in all poses:
_MANY = 0.1  # chains are looked for where so many are open
_WORTH, _OF_OPEN = 0.05, 0.33  # a joint on a moving part explains so much more, and of these
_NEEDED = 0.02  # a joint without which as much is explained, but for so little, is needless

_FEWEST, _OTHERS = 40, 7  # points of pose 0, of some 8,000, that a joint moves; other poses


def discover_chains(
    poses: Sequence[Any],
    *,
    normals: Sequence[Any] | None = None,
    kinds: Collection[JointKind] = KINDS,
) -> Discovery:
    """Find joints as `discover` does and, where these leave much unexplained, those that hang on
    moving parts.

    Args:
        poses, normals, kinds: as for `discover`.

    Raises:
        InvalidArgument: as `discover` does.
    """
    diff = change(poses, normals)
    surfaces = surfaces_of(poses, normals)
    plain = complete(diff, searched(diff, kinds), surfaces[0])
    joints, options, frontier = [*plain.joints], list[FoundJoint](), range(len(plain.joints))
    while frontier and (is_open := _open(diff, joints)).any():
        motion = invert_rigid(_motion(joints))
        for j in frontier:
            back = motion[:, j + 1, :3]
            beside = [surface.moved(T) for surface, T in zip(surfaces, back, strict=True)]
            hung = _beside(beside, kinds, is_open)
            options += [replace(joint, parent=j + 1) for joint in hung]
        gains = [_explained(diff, [*joints, one]) - _explained(diff, joints) for one in options]
        if max(gains, default=0.0) < max(_WORTH, _OF_OPEN * is_open.sum() / diff.movers.sum()):
            break
        joints.append(options.pop(int(np.argmax(gains))))
        frontier = [len(joints) - 1]
    if len(joints) == len(plain.joints):
        return plain
    return _finished(diff, _needed(diff, joints), surfaces[0]) or plain


def _beside(
    poses: Sequence[Surface], kinds: Collection[JointKind], among: Bools
) -> list[FoundJoint]:
    """Return the joints of some of pose 0's points, `among` (n,), on a part from which these poses
    are seen."""
    normals = [pose.normals for pose in poses] if poses[0].signed else None
    try:
        diff = change([pose.points for pose in poses], normals)
    except InvalidArgument:  # too little stays
        return []
    diff = replace(diff, movers=diff.movers & among)
    if diff.movers.sum() < _FEWEST:
        return []
    joints, points = list[FoundJoint](), diff.start[diff.movers]
    for joint in searched(diff, kinds):
        follow = diff.poses.met(points, motions(joint), diff.near).mean(0) >= _FOLLOWS
        if follow.sum() >= _FEWEST:
            joints.append(in_clouds(diff, joint, points[follow], diff.stays))
    return joints


def _motion(joints: Sequence[FoundJoint]) -> Floats:
    """Return (K, P, 4, 4) of each part from pose 0 to each pose."""
    tree = Joints(tuple(joints))
    return np.array([tree.motion(k) for k in range(len(joints[0].states))])


def _in_cube(diff: Change, joints: Sequence[FoundJoint], poses: Ints) -> list[Floats]:
    """Return of each part (S, 3, 4), from pose 0 to some poses, in the cube."""
    T = diff.frame.rigid_to_unit(_motion(joints)[poses])
    return [np.ascontiguousarray(T[:, part, :3]) for part in range(T.shape[1])]


def _shares(diff: Change, joints: Sequence[FoundJoint]) -> Floats:
    """Return (n,) in what share of other poses a point lies on something, moved as a part does."""
    moved = _in_cube(diff, joints, np.arange(1, len(diff.others) + 1))
    return np.max([diff.others.met(diff.start, M, diff.near).mean(0) for M in moved], axis=0)


def _explained(diff: Change, joints: Sequence[FoundJoint]) -> float:
    """Return the mean of these shares over the points that have left pose 0."""
    return float(_shares(diff, joints)[diff.movers].mean())


def _open(diff: Change, joints: Sequence[FoundJoint]) -> Bools:
    """Return (n,) which points have left and follow no joint; none if these, or poses, are few."""
    is_open = diff.movers & (_shares(diff, joints) < _OPEN)
    enough = is_open.sum() > max(_MANY * diff.movers.sum(), _FEWEST) and len(diff.others) >= _OTHERS
    return is_open & enough


def _needed(diff: Change, joints: list[FoundJoint]) -> list[FoundJoint]:
    """Return the joints without those, of parts on which none hangs, that explain little which the
    others do not; those with the lowest score go first."""
    while True:
        whole = _explained(diff, joints) - _NEEDED
        without = {
            j: [replace(b, parent=b.parent - (b.parent > j + 1)) for b in joints if b is not a]
            for j, a in enumerate(joints)
            if all(b.parent != j + 1 for b in joints)
        }
        needless = [j for j, rest in without.items() if rest and _explained(diff, rest) > whole]
        if not needless:
            return joints
        joints = without[min(needless, key=lambda j: joints[j].score)]


def _finished(diff: Change, joints: list[FoundJoint], first: Surface) -> Discovery | None:
    """Return the joints, parents before children, and the parts of pose 0's points; None where a
    part on which another hangs has none."""
    moved = _in_cube(diff, joints, diff.chosen)
    order, part, parts = parted(diff, moved, first, [one.parent for one in joints])
    number = {0: 0, **{j + 1: n for n, j in enumerate(order, 1)}}
    if not all(joints[j].parent in number for j in order):
        return None
    scores = [score(diff, parts[n], moved[j + 1]) for n, j in enumerate(order, 1)]
    done = [
        replace(joints[j], parent=number[joints[j].parent], score=right)
        for j, right in zip(order, scores, strict=True)
    ]
    return Discovery(tuple(done), first.points, part)
