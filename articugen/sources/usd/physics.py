"""Rigid bodies and joints as UsdPhysics has them, in metres and z up."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.errors import InvalidSource
from articugen.core.geometry import transform
from articugen.core.portable import product, turned
from articugen.core.records import JointKind
from articugen.meshes import openusd as pxr
from articugen.meshes.model_files import quoted
from articugen.sources.usd.transforms import (
    Places,
    axis_of,
    numbers,
    rotation_of,
    turn_of,
    value_of,
)

WORLD = 0  # the number of what is no rigid body: the room, and all that does not move in it

_NO_LIMIT = 1e6  # ends beyond it (degrees, stage units) are taken as none, as simulators write them

_KINDS = {
    "PhysicsFixedJoint": JointKind.FIXED,
    "PhysicsRevoluteJoint": JointKind.REVOLUTE,
    "PhysicsPrismaticJoint": JointKind.PRISMATIC,
}


@dataclass(frozen=True)
class Stage:
    """Facts that all joints of a stage share.

    Attributes:
        where: the file, for messages.
        places: where prims stand.
        bodies: the number of each rigid body, from 1, by its path.
        turn: (3, 3) from stage axes to z up.
        metres: how long a stage unit is.
    """

    where: str
    places: Places
    bodies: Mapping[Any, int]
    turn: Floats
    metres: float

    def to_metres(self, points: Floats) -> Floats:
        """Stage points (..., 3) to metres, z up."""
        return turned(self.turn, points) * self.metres


@dataclass(frozen=True)
class PhysicsJoint:
    """A joint between two bodies, each of which says where the joint is as the model stands.

    Attributes:
        path: of its prim.
        bodies: the numbers of both, the one that holds first.
        frames: (4, 4) each, metres, z up.
        axis: (3,) in either frame.
        lower, upper: rad or m; -inf and inf where there is none.
        notes: what was mended.
    """

    path: str
    kind: JointKind
    bodies: tuple[int, int]
    frames: tuple[Floats, Floats]
    axis: tuple[float, float, float]
    lower: float
    upper: float
    notes: tuple[str, ...] = ()


def body_of(prim: Any) -> Any | None:
    """Return the nearest rigid body that a prim is or lies in."""
    while prim and not prim.IsPseudoRoot():
        is_body, body = prim.HasAPI(pxr.UsdPhysics.RigidBodyAPI), pxr.UsdPhysics.RigidBodyAPI(prim)
        if is_body and body.GetRigidBodyEnabledAttr().Get() is not False:
            return prim
        prim = prim.GetParent()
    return None


def read_joint(prim: Any, stage: Stage) -> PhysicsJoint | None:
    """Return the joint that a prim is, None of one that is switched off; InvalidSource if it is of
    a kind that is not read, or anything is amiss with it."""
    by = f"{stage.where}: {prim.GetPath()}"
    joint = pxr.UsdPhysics.Joint(prim)
    if value_of(joint.GetJointEnabledAttr(), by) is False:
        return None
    name = str(prim.GetTypeName())
    if name not in _KINDS:
        raise InvalidSource(
            f"{by}: is a {quoted(name)}, and only fixed, revolute and prismatic joints are read; "
            "leave the model out, or replace the joint"
        )
    kind = _KINDS[name]
    (holder, here), (body, there) = (_end(prim, stage, number, by) for number in (0, 1))
    if holder == body and (kind != JointKind.FIXED or body != WORLD):
        raise InvalidSource(
            f"{by}: joins no two rigid bodies; correct its body0 and body1, or give them the "
            "PhysicsRigidBodyAPI"
        )
    lower, upper, notes, axis = 0.0, 0.0, (), (1.0, 0.0, 0.0)
    if kind != JointKind.FIXED:
        lower, upper, notes = _limits(prim, kind, stage, by)
        axis = axis_of(value_of(prim.GetAttribute("physics:axis"), by), by)
    if kind == JointKind.REVOLUTE and np.isinf(lower) and np.isinf(upper):
        kind = JointKind.CONTINUOUS
    both = (holder, body), (here, there)
    return PhysicsJoint(str(prim.GetPath()), kind, *both, axis, lower, upper, notes)


def _end(prim: Any, stage: Stage, number: int, by: str) -> tuple[int, Floats]:
    """Return the body at one end of a joint, and the joint's frame as that end has it, (4, 4)
    metres."""
    targets = prim.GetRelationship(f"physics:body{number}").GetTargets()
    T, body = np.eye(4), WORLD
    if targets:
        target = prim.GetStage().GetPrimAtPath(targets[0])
        if not target:
            raise InvalidSource(
                f"{by}: its body{number} {quoted(str(targets[0]))} is not there; correct its name"
            )
        T = stage.places.of(target)
        which = body_of(target)
        body = WORLD if which is None else stage.bodies.get(which.GetPath(), WORLD)
    place = _attribute(prim, f"localPos{number}", by)
    what = f"its localPos{number}"
    at = turned(T[:3, :3], numbers(place, (3,), by, what)) + T[:3, 3]
    turn = rotation_of(_attribute(prim, f"localRot{number}", by), by, f"its localRot{number}")
    R = product(stage.turn, turn_of(T, by), turn)
    return body, transform(R, stage.to_metres(at))


def _limits(
    prim: Any, kind: JointKind, stage: Stage, by: str
) -> tuple[float, float, tuple[str, ...]]:
    ends = []
    for name, none in (("lowerLimit", -np.inf), ("upperLimit", np.inf)):
        value = _attribute(prim, name, by)
        value = none if value is None else float(value)
        if np.isnan(value):
            raise InvalidSource(f"{by}: its {name} is not a number; correct it")
        unit = np.pi / 180.0 if kind == JointKind.REVOLUTE else stage.metres
        ends.append(none if abs(value) >= _NO_LIMIT else value * unit)
    lower, upper = ends
    if lower <= upper:
        return lower, upper, ()
    return upper, lower, (f"{prim.GetName()}: its limits were named the wrong way round",)


def _attribute(prim: Any, name: str, by: str) -> Any:
    return value_of(prim.GetAttribute(f"physics:{name}"), by)
