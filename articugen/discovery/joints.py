"""The joints and parts of an object, as found."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Ints
from articugen.core.records import Floats, JointKind, Normalization
from articugen.discovery import kernels
from articugen.discovery.clouds import Cells, Surface
from articugen.discovery.search import Candidate, motions

_STAYS = 0.1  # by so much a joint must bring a point nearer to the poses than it is if it stays
_SURE = 0.2  # by so much the next part is farther, where a point is sure of its own


@dataclass(frozen=True, eq=False)
class FoundJoint:
    """A joint, in the frame of the clouds.

    Attributes:
        kind: REVOLUTE or PRISMATIC.
        axis: (3,) unit direction, such that the mean of `states` is not negative.
        pivot: (3,) a point on the axis, beside its part; of a slide, the middle of the part.
        states: (K,) of each pose, radians or lengths, 0 in the reference; NaN: too little is seen.
        score: which share of the part's points, where they have left, land on something new.
        parent: the part that it hangs on, 0 for the fixed one; with its part moves its axis.
    """

    kind: JointKind
    axis: Floats
    pivot: Floats
    states: Floats
    score: float
    parent: int = 0


@dataclass(frozen=True, eq=False)
class Joints:
    """The `joints` of an object, parents before children, then that with most points first; j + 1
    is the part that j moves."""

    joints: tuple[FoundJoint, ...]

    def motion(self, pose: int) -> Floats:
        """Return (P, 4, 4) the rigid motion of each part from the reference (pose 0 but where one
        camera sees) to another; part 0 has the identity. A point of part k at x there is at
        `motion(pose)[k]` x in that pose."""
        T = np.tile(np.eye(4), (len(self.joints) + 1, 1, 1))
        for j, joint in enumerate(self.joints):
            which = joint.kind == JointKind.REVOLUTE, joint.axis, joint.pivot, joint.states[[pose]]
            T[j + 1, :3] = motions(Candidate(*which))[0]
            T[j + 1] = T[joint.parent] @ T[j + 1]
        return T


@dataclass(frozen=True, eq=False)
class Discovery(Joints):
    """Joints and parts of an object, as found.

    Attributes:
        points: (n, 3) of pose 0, or of the `reference` that stands for it, as given.
        part: (n,) 0 for what stays, j + 1 for what joint j moves.
    """

    points: Floats
    part: Ints
    reference: int = 0


def labels(cost: Floats, cloud: Floats, near: float) -> Ints:
    """Return (n,) the part of each point, what stays or what joint j moves (j + 1).

    Args:
        cost: (1 + J, n) how far each leaves it from the poses, in shares of `near`; where that is
            a tie, a point goes with most of its neighbours that are sure.
        cloud: (n, 3) the points.
    """
    cost = cost + _STAYS * (np.arange(len(cost)) > 0)[:, None]
    best = cost.argmin(0)
    ranked = np.sort(cost, axis=0)
    sure = ranked[1:].min(0, initial=np.inf) - ranked[0] >= _SURE
    return np.where(sure, best, _as_neighbours(cloud, best, sure, len(cost), near))


def _as_neighbours(
    cloud: Floats, label: Ints, sure: NDArray[np.bool_], count: int, near: float
) -> Ints:
    if not sure.any():
        return label
    cells = Cells.of([Surface.bare(cloud[sure])])
    sorted_label = label[sure][cells.order]
    at = cells.points, cells.starts, 2 * near, False
    votes = [kernels.about(cloud, (sorted_label == k) * 1.0, *at)[:, 1] for k in range(count)]
    return np.where(np.sum(votes, axis=0) > 0, np.argmax(votes, axis=0), label)


def by_size(part: Ints, parents: Sequence[int]) -> tuple[list[int], Ints]:
    """Return which joints move anything, those on the fixed part first, then those with most
    points; and the parts numbered accordingly; `parents` are the parts that they hang on."""
    count = len(parents)
    sizes = [int((part == j + 1).sum()) for j in range(count)]
    depth = [0] * (count + 1)
    for j, parent in enumerate(parents):  # parents come before their children
        depth[j + 1] = depth[parent] + 1
    order = sorted(range(count), key=lambda j: (depth[j + 1], -sizes[j]))
    order = [j for j in order if sizes[j]]
    number = np.zeros(count + 1, np.int64)
    number[[j + 1 for j in order]] = 1 + np.arange(len(order))
    return order, number[part]


def found_joint(
    frame: Normalization, joint: Candidate, states: Floats, middle: Floats, score: float
) -> FoundJoint:
    """Return a joint in the clouds' frame, with the `states` (K,) of all poses and the pivot beside
    the `middle` (3,) of its part."""
    sign = -1.0 if np.nanmean(states) < 0.0 else 1.0
    pivot = middle
    if joint.turns:
        pivot = joint.pivot + ((middle - joint.pivot) @ joint.axis) * joint.axis
    return FoundJoint(
        kind=joint.kind,
        axis=sign * joint.axis,
        pivot=frame.to_world(pivot),
        states=sign * states * (1.0 if joint.turns else frame.scale),
        score=score,
    )
