"""Bodies that joints connect, in any order and direction, to a tree from the fixed one on."""

import heapq
from collections.abc import Sequence

import numpy as np

from articugen.core.arrays import Floats, grouped
from articugen.core.errors import InvalidSource
from articugen.core.geometry import joint_motion
from articugen.core.portable import arctan2, dot, norm, product, turned
from articugen.core.records import Joint, JointKind
from articugen.sources.usd.physics import WORLD, PhysicsJoint

_MAX_GAP = 0.01  # metres between the two frames of a joint, along what it does not let move
_MAX_TURN = np.radians(1.0)  # the angle between them, likewise
_STILL = 1e-5  # metres or radians: what less is, is rounding


class Tree:
    """The links' joints, and where links stand.

    A link's frame is turned as the world is, where the model stands as it was drawn; it lies at its
    joint's pivot, or at the world's origin where the link does not move.

    Attributes:
        joints: each after the one its parent hangs on.
        origins: (L, 3) of each body's frame, metres.
        notes: what a user should know.
    """

    def __init__(self, where: str, names: Sequence[str], joints: Sequence[PhysicsJoint],
                 joint_names: Sequence[str], first: Sequence[int]) -> None:  # fmt: skip
        """
        Args:
            where: the file, for messages.
            names: of each body; 0 is the world.
            joints, joint_names: as the file has them.
            first: bodies in the order in which they are asked to hold what hangs on nothing.

        Raises:
            InvalidSource: joints form a loop, or the two frames of one do not fit.
        """
        self._where, self._names = where, names
        self._joints, self._joint_names = joints, joint_names
        self.origins = np.zeros((len(names), 3))
        self.joints: list[Joint] = []
        self.notes: list[str] = [note for joint in joints for note in joint.notes]
        self._rigid = list(range(len(names)))  # of each body, one that it moves with
        self._reached = {WORLD}
        self._used: set[int] = set()
        self._hanging = grouped(
            (body, n) for n, joint in enumerate(joints) for body in joint.bodies
        )
        self._follow(WORLD)
        for body in first:
            if body not in self._reached:
                self._weld(body)
                self._follow(body)

    def _follow(self, start: int) -> None:
        """Go along all joints from a body on, lower numbers first."""
        ready = list(self._hanging.get(start, ()))
        heapq.heapify(ready)
        while ready:
            number = heapq.heappop(ready)
            if number in self._used:
                continue
            self._used.add(number)
            joint = self._joints[number]
            parent, child = joint.bodies
            if child in self._reached and parent in self._reached:
                self._close(number)
                continue
            turned_round = child in self._reached
            if turned_round:
                parent, child = child, parent
            self._add(number, parent, child, turned_round)
            for other in self._hanging[child]:
                heapq.heappush(ready, other)

    def _close(self, number: int) -> None:
        joint = self._joints[number]
        a, b = (self._rigid[body] for body in joint.bodies)
        if joint.kind == JointKind.FIXED and a == b:
            return
        raise InvalidSource(
            f"{self._where}: {joint.path}: closes a loop of joints, and only trees are read; "
            "remove it, or leave the model out"
        )

    def _weld(self, body: int) -> None:
        """Hold a body that hangs on nothing where it stands."""
        self._reached.add(body)
        self._rigid[body] = WORLD
        name = f"{self._names[body]}_held"
        while name in self._joint_names:
            name += "~"
        self.joints.append(_fixed(name, self._names[WORLD], self._names[body]))

    def _add(self, number: int, parent: int, child: int, turned_round: bool) -> None:
        joint, name = self._joints[number], self._joint_names[number]
        self._reached.add(child)
        names = self._names[parent], self._names[child]
        if joint.kind == JointKind.FIXED:
            self._rigid[child] = self._rigid[parent]
            self.origins[child] = self.origins[parent]
            self.joints.append(_fixed(name, *names))
            return
        axis, rest = self._axis(joint)
        self.origins[child] = joint.frames[0][:3, 3]
        if abs(rest) > _STILL:
            unit = "m" if joint.kind == JointKind.PRISMATIC else "rad"
            self.notes.append(f"{name}: drawn at {rest:.4g} {unit}, not at 0")
        else:
            rest = 0.0
        axis = -axis if turned_round else axis
        T = joint_motion(joint.kind != JointKind.PRISMATIC, axis, -rest)
        T[:3, 3] += self.origins[child] - self.origins[parent]
        self.joints.append(Joint(name, joint.kind, *names, T, axis, joint.lower, joint.upper))

    def _axis(self, joint: PhysicsJoint) -> tuple[Floats, float]:
        """Return the axis (3,) in the world, and at which joint state the model was drawn."""
        here, there = joint.frames
        axis = turned(here[:3, :3], joint.axis)
        axis = axis / norm(axis)
        gap = there[:3, 3] - here[:3, 3]
        R = product(here[:3, :3].T, there[:3, :3])
        turn = _turn_about(R, joint.axis)
        tilt = norm(turned(R, joint.axis) - np.array(joint.axis))
        if joint.kind == JointKind.PRISMATIC:
            rest = dot(gap, axis)
            gap, tilt = gap - axis * rest, max(tilt, abs(turn))
        else:
            rest = turn
        if norm(gap) > _MAX_GAP or tilt > _MAX_TURN:
            raise InvalidSource(
                f"{self._where}: {joint.path}: where its two bodies have it is {norm(gap):.3g} m "
                f"and {np.degrees(tilt):.3g} degrees apart; correct localPos and localRot, or "
                "leave the model out"
            )
        return axis, float(rest)


def _turn_about(R: Floats, axis: Sequence[float]) -> float:
    """Return the angle of a rotation about a coordinate axis."""
    x = list(axis).index(1.0)
    y, z = (x + 1) % 3, (x + 2) % 3
    return float(arctan2(R[z, y] - R[y, z], R[y, y] + R[z, z]))


def _fixed(name: str, parent: str, child: str) -> Joint:
    return Joint(name, JointKind.FIXED, parent, child, np.eye(4), np.array([1.0, 0.0, 0.0]))
