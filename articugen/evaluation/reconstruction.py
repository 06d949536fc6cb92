"""What a learner says of one cloud: part surfaces and, where it knows them, motions and joints."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.core.geometry import invert_rigid, joint_motion
from articugen.core.records import Floats, JointKind, dequantize
from articugen.core.schema import Instance


@dataclass(frozen=True, eq=False)
class PartJoints:
    """The joint that each of P parts hangs on; the unit frame, radians.

    Attributes:
        kind: (P,) of `JointKind`.
        state: (P,) joint states, 0 for fixed parts.
        pivot, direction: (P, 3) a point on the axis, and its unit direction.
    """

    kind: NDArray[np.int64]
    state: Floats
    pivot: Floats
    direction: Floats

    def change_since(self, before: "PartJoints", part: int, axis: Floats) -> float:
        """Return how far a part has moved, positive about `axis`: a line has two directions, and by
        the other one states count the other way."""
        change = float(self.state[part] - before.state[part])
        return change if np.dot(self.direction[part], axis) >= 0 else -change


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """The parts of one posed shape, in the unit frame.

    Attributes:
        triangles, part: (F, 3, 3) the surfaces of all parts, (F,) whose each is; labelled points,
            as triangles of no size, of a method without surfaces.
        whole: (G, 3, 3) the surface of the whole; None of a method without surfaces.
        occupied: (R, R, R) whether a voxel's centre lies in any part; R = 0 where that is unknown.
        parts: P, how many parts there can be; the same for all shapes of a learner.
        T_part: (P, 4, 4) the rigid transform of each part from a rest frame that is the same in
            every pose, nan of a part that has none; None of a method that knows no motion.
        joints: None of a method that knows none.
        finer: (H, 3, 3) the surface of the whole as fine as those of the parts, where these are
            drawn finer than the grid that was asked for.
        labelling: where other surfaces label points, those, as `triangles` and `part`.
    """

    triangles: Floats
    part: NDArray[np.int64]
    whole: Floats | None
    occupied: NDArray[np.bool_]
    parts: int
    T_part: Floats | None = None
    joints: PartJoints | None = None
    finer: Floats | None = None
    labelling: tuple[Floats, NDArray[np.int64]] | None = None

    def motion_to(self, posed: "Reconstruction") -> Floats | None:
        """Return how parts moved by their transforms, T(posed) T(here)^-1: (P, 4, 4). What has no
        transform stays."""
        if self.T_part is None or posed.T_part is None:
            return None
        motion = posed.T_part @ invert_rigid(self.T_part)
        return np.where(np.isfinite(motion).all((1, 2), keepdims=True), motion, np.eye(4))

    def joint_motion_to(self, posed: "Reconstruction") -> Floats | None:
        """Return (P, 4, 4) the motions of parts by this shape's axes and the difference of joint
        states."""
        if self.joints is None or posed.joints is None:
            return None
        joints, motion = self.joints, np.tile(np.eye(4), (self.parts, 1, 1))
        change = posed.joints.state - joints.state
        for i in np.flatnonzero(np.isin(joints.kind, [JointKind.REVOLUTE, JointKind.PRISMATIC])):
            turns = joints.kind[i] == JointKind.REVOLUTE
            motion[i] = joint_motion(turns, joints.direction[i], change[i], joints.pivot[i])
        return motion


def joints_of(
    first: Reconstruction,
    posed: Reconstruction,
    kind: NDArray[np.int64],
    carrier: NDArray[np.int64],
) -> tuple[PartJoints, PartJoints] | None:
    """Return the joints of one object in two poses: those that the method predicts or, where it
    knows motions alone, state 0 in the first pose, in the other how far each part has turned or
    slid against what carries it, and along which direction; pivots are nan.

    Args:
        kind: (P,) of the joint that each part is known to hang on; `carrier` (P,) the part that
            carries it.
    """
    if first.joints is not None and posed.joints is not None:
        return first.joints, posed.joints
    motion = first.motion_to(posed)
    if motion is None:
        return None
    state, direction = np.zeros(len(kind)), np.tile([0.0, 0.0, 1.0], (len(kind), 1))
    carried = invert_rigid(motion[0]) @ motion[carrier]
    for i, T in enumerate(invert_rigid(motion[carrier]) @ motion):
        if kind[i] == JointKind.REVOLUTE:
            state[i], direction[i] = turn_of(T[:3, :3])
        elif kind[i] == JointKind.PRISMATIC and T[:3, 3].any():
            state[i] = np.linalg.norm(T[:3, 3])
            direction[i] = T[:3, 3] / state[i]
        direction[i] = carried[i, :3, :3] @ direction[i]
    pivot = np.full_like(direction, np.nan)
    before = PartJoints(kind, np.zeros(len(kind)), pivot, direction)
    return before, PartJoints(kind, state, pivot, direction)


def turn_of(R: Floats) -> tuple[float, Floats]:
    """Return the angle in [0, pi] and the unit axis (3,) of a rotation (3, 3)."""
    twist = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])  # 2 sin(angle) axis
    axis = np.linalg.svd(R - np.eye(3))[2][2]
    axis = -axis if axis @ twist < 0.0 else axis
    return float(np.arctan2(0.5 * axis @ twist, 0.5 * (np.trace(R) - 1.0))), axis


def labelled_points(
    points: Floats, part: NDArray[np.int64], parts: int, **known: Any
) -> Reconstruction:
    """Return what a method without surfaces makes of a cloud: points (n, 3) of parts (n,), each a
    triangle of no size, so that the nearest one has the label of the nearest point.

    Args:
        known: `T_part` and `joints` of `Reconstruction`.
    """
    triangles = np.repeat(points[:, None], 3, axis=1)
    return Reconstruction(triangles, part, None, np.zeros((0, 0, 0), bool), parts, **known)


def truth(instance: Instance, resolution: int = 32) -> Reconstruction:
    """Return the ground truth as if it were predicted; its surfaces are the stored points.

    Args:
        resolution: of the stored grid of occupancy, if there is such a grid.
    """
    grid = instance.occupancy.get(resolution, np.zeros((0, 0, 0), np.uint8))
    joints = PartJoints(
        kind=np.append(JointKind.FIXED, instance.joint_kind).astype(np.int64),
        state=np.append(0.0, instance.joint_state),
        pivot=np.concatenate([np.zeros((1, 3)), instance.joint_pivot]),
        direction=np.concatenate([[[0, 0, 1.0]], instance.joint_axis]),
    )
    points, part = dequantize(instance.surface_points), instance.surface_part.astype(np.int64)
    motion = instance.part_motion
    known = labelled_points(points, part, len(motion), T_part=motion, joints=joints)
    return replace(known, whole=known.triangles, occupied=grid > 0)
