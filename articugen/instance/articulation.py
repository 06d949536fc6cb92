"""Joint states and forward kinematics: which joints move, from where to where, and what follows.

`resolve` is called once an object: it decides the canonical pose, the moving joints and their
ranges. Everything after it sees joints that are 0 in the canonical pose. All functions are pure.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Literal

import numpy as np

from articugen.core.arrays import Floats, grouped
from articugen.core.errors import NotOfCategory, RejectedInstance
from articugen.core.geometry import apply, bounds, invert_rigid, joint_motion
from articugen.core.portable import product, turned
from articugen.core.recipe import LEAST_STEP, Articulation
from articugen.core.records import (
    ArticulatedObject,
    Joint,
    JointKind,
    JointState,
    Mimic,
    PosedObject,
    ResolvedObject,
)

Canonical = Literal["zero", "lower", "upper"]

_TIE = 1e-6
"""Rooms (rad or m) on the two sides of the canonical pose that differ by less count as equal."""

_FARTHEST = 1e6  # rad or m: beyond it, joints lose the digits that a pose needs
_LEVEL = 0.02
"""Parts whose middles differ by less than this share of the object's length are in one row."""


def resolve(
    obj: ArticulatedObject,
    settings: Articulation,
    *,
    canonical: Canonical = "zero",
    movable: Sequence[str] = (),
) -> ResolvedObject:
    """Return the object as the recipe wants it: q = 0 is the canonical pose, limits are what is
    sampled.

    A joint that moves counts up from the canonical pose: its axis is turned around where the limits
    of the URDF leave more room on the other side. A joint that does not move becomes `fixed` in its
    canonical pose, so that its links ride on what they hang on. A mimic joint follows its driver,
    whatever `movable` says of itself: multiplier > 0, offset 0 and the driver's range times the
    multiplier; where the driver is locked, so is it.

    Where the source names the parts that move, they are numbered so that a number means the same in
    all its objects: revolute ones first, by the pattern that picks them, then as one reads who
    stands before the object's front (+x), from the top row down and in a row from -y to +y. Other
    objects keep the order of their URDF.

    Args:
        obj: as a source gives it, with the limits of its URDF.
        settings: the recipe's choice; its `clip_to_limits` "source" counts as true.
        canonical: the source's choice of canonical pose; a joint without the limit asked for has
            its canonical pose at 0. `settings.canonical` other than "source" overrides it.
        movable: the source's choice of joints, as fnmatch patterns on the joint's name or on its
            child link's semantic; empty means all. `settings.movable`, if any, overrides it.

    Returns:
        The object with `notes` extended by what was decided against the letter of its URDF.

    Raises:
        NotOfCategory: no joint moves, or none that was asked for.
        RejectedInstance: a prismatic joint has no limit, the limits leave nothing of the recipe's
            range, mimic joints drive each other.
    """
    if settings.canonical == "source":
        settings = settings.model_copy(update={"canonical": canonical})
    patterns = tuple(settings.movable) or tuple(movable)
    moving = [joint for joint in obj.joints if joint.kind != JointKind.FIXED]
    plans = {j.name: _plan_driver(obj, j, patterns, settings) for j in moving if j.mimic is None}
    by_name = {joint.name: joint for joint in obj.joints}
    for joint in (joint for joint in moving if joint.mimic is not None):
        plans[joint.name] = _plan_follower(by_name, joint, plans)
    remarks = grouped((remark, name) for name, plan in plans.items() for remark in plan.remarks)
    if not any(plan.moves for plan in plans.values()):
        raise NotOfCategory(_nothing_moves(obj, patterns))
    resolved = replace(
        ResolvedObject(**vars(obj)),
        joints=tuple(_planned(j, plans[j.name]) if j.name in plans else j for j in obj.joints),
        notes=obj.notes + tuple(f"{text}: {', '.join(names)}" for text, names in remarks.items()),
    )
    return replace(resolved, part_order=_part_order(resolved, patterns)) if movable else resolved


def canonical_state(obj: ArticulatedObject) -> JointState:
    """Return the joint state with all drivers at 0 and driven joints where that puts them (0 too,
    in a resolved object)."""
    return driven_state(obj, {})


def driven_state(obj: ArticulatedObject, drivers: Mapping[str, float]) -> JointState:
    """Return the state in which each driver has its value (rad or m, 0 where not given) and the
    others follow. Limits are not applied."""
    q = np.zeros(len(obj.moving_joints))
    by_name = {joint.name: joint for joint in obj.joints}
    for k, joint in enumerate(obj.moving_joints):
        driver, multiplier, offset = _driver(by_name, joint)
        q[k] = multiplier * drivers.get(driver, 0.0) + offset
    return JointState(q)


def sample_joint_state(
    obj: ArticulatedObject,
    *,
    rng: np.random.Generator,
    before: JointState | None = None,
    turn: int = 0,
) -> JointState:
    """Draw a joint state of a resolved object: each driver uniform in its range, the others follow.

    Draws one number a driver, in part order. Of these only that of driver `turn`, counted round,
    replaces what the state `before` has, if there is one; it is then uniform in what of the range
    is `LEAST_STEP` of that away from there.
    """
    drivers = [joint for joint in obj.moving_joints if joint.mimic is None]
    q = {j.name: rng.uniform(j.lower, j.upper) for j in drivers}
    if before is not None:
        only = drivers[turn % len(drivers)]
        known = dict(zip([j.name for j in obj.moving_joints], before.q.tolist(), strict=True))
        q = known | {only.name: _far_from(known[only.name], q[only.name], only)}
    return driven_state(obj, q)


def _far_from(before: float, drawn: float, joint: Joint) -> float:
    """Return where a joint goes from `before`, by what was drawn uniformly in its range."""
    size = joint.upper - joint.lower
    least = LEAST_STEP * size
    below = max(min(before - least, joint.upper) - joint.lower, 0.0)
    left = below + max(joint.upper - max(before + least, joint.lower), 0.0)
    way = left * (drawn - joint.lower) / (size or 1.0)
    return joint.lower + way if way < below else joint.upper - (left - way)


def forward_kinematics(obj: ArticulatedObject, state: JointState) -> PosedObject:
    """Return where `state` puts every link, part and joint axis of `obj`: world frame, metres.

    T_world_child = T_world_parent T_parent_joint M(q), with M a rotation by q about the joint's
    axis or a translation by q along it (URDF's definition). Limits are not applied.

    Raises:
        ValueError: `state` has not one number for each moving joint.
    """
    moving = obj.moving_joints
    if len(state.q) != len(moving):
        raise ValueError(f"{len(state.q)} joint values for {len(moving)} moving joints")
    q = dict(zip([joint.name for joint in moving], state.q, strict=True))
    index = obj.link_index
    T_world_link = np.tile(np.eye(4), (len(obj.links), 1, 1))
    T_world_link[0] = obj.T_world_root
    T_world_joint: dict[str, Floats] = {}
    for joint in obj.joints:
        T = product(T_world_link[index[joint.parent]], joint.T_parent_joint)
        T_world_joint[joint.name] = T
        T_world_link[index[joint.child]] = product(T, _motion(joint, q.get(joint.name, 0.0)))
    at = [T_world_joint[joint.name] for joint in moving]
    axes = [turned(T[:3, :3], joint.axis) for T, joint in zip(at, moving, strict=True)]
    return PosedObject(
        T_world_link=T_world_link,
        T_world_part=T_world_link[[0] + [index[joint.child] for joint in moving]],
        pivots=np.array([T[:3, 3] for T in at]).reshape(-1, 3),
        axes=np.array(axes).reshape(-1, 3),
    )


def part_motions(posed: PosedObject, canonical_posed: PosedObject) -> Floats:
    """Return (P, 4, 4) the rigid motion of each part from the canonical pose, world frame, metres.

    A point of part k at x in the canonical pose is at `apply(motions[k], x)` in the posed object.
    Part 0 has the identity.
    """
    motions = product(posed.T_world_part, invert_rigid(canonical_posed.T_world_part))
    motions[0] = np.eye(4)
    return motions


def motions_of(
    obj: ArticulatedObject, states: Iterable[JointState], canonical: PosedObject
) -> Floats:
    """Return (N, P, 4, 4) the `part_motions` in N states, world frame, metres."""
    posed = (forward_kinematics(obj, state) for state in states)
    return np.stack([part_motions(one, canonical) for one in posed])


@dataclass(frozen=True)
class _Plan:
    """Fate of one joint.

    Attributes:
        value: the URDF's joint value that becomes q = 0.
        sign: -1.0 where the axis is turned around, so that value_urdf = value + sign * q.
        lower, upper: the range of q to sample from.
        moves: or it is locked at q = 0.
        mimic: what drives it.
        remarks: for the notes.
    """

    value: float
    sign: float = 1.0
    lower: float = 0.0
    upper: float = 0.0
    moves: bool = False
    mimic: Mimic | None = None
    remarks: tuple[str, ...] = ()


def _plan_driver(
    obj: ArticulatedObject, joint: Joint, patterns: tuple[str, ...], settings: Articulation
) -> _Plan:
    canonical = settings.canonical
    value = {"zero": 0.0, "lower": joint.lower, "upper": joint.upper}[canonical]
    remarks: list[str] = []
    if not np.isfinite(value):
        value = 0.0
        if joint.kind != JointKind.CONTINUOUS:
            remarks.append(f"no {canonical} limit, canonical pose at 0 instead")
    if patterns and _pattern_of(obj, joint, patterns) == len(patterns):
        return _Plan(value, remarks=(*remarks, "locked, not among the movable joints"))
    if not joint.lower - _TIE <= value <= joint.upper + _TIE:
        remarks.append("canonical pose outside the limits of the model")
    sign, lower, upper = _sampled_range(joint, value, settings)
    if lower == upper == 0.0:
        return _Plan(value, remarks=(*remarks, "locked, its range is empty"))
    if sign < 0.0:
        remarks.append("axis turned around, more room on that side of the canonical pose")
    ends = (value + sign * lower, value + sign * upper)
    if min(ends) < joint.lower - _TIE or max(ends) > joint.upper + _TIE:
        remarks.append("sampled beyond the limits of the model, as the recipe says")
    return _Plan(value, sign, lower, upper, moves=True, remarks=tuple(remarks))


def _sampled_range(
    joint: Joint, value: float, settings: Articulation
) -> tuple[float, float, float]:
    """Return (sign, lower, upper): the axis is turned around for sign -1; the range is about
    `value`."""
    below, above = value - joint.lower, joint.upper - value
    sign = -1.0 if below > above + _TIE else 1.0
    back, room = min(below, above), max(below, above)
    if joint.kind != JointKind.PRISMATIC:
        lower, upper = np.radians(settings.revolute_degrees).tolist()
    elif settings.prismatic_metres is not None:
        lower, upper = settings.prismatic_metres
    elif np.isfinite(room):
        lower, upper = 0.0, max(room, 0.0)
    else:
        raise RejectedInstance(
            f"prismatic joint {joint.name!r} has no limit at an end; add it, or set "
            "articulation.prismatic_metres in the recipe"
        )
    if settings.clip_to_limits:
        if max(lower, -back) > min(upper, room):
            raise RejectedInstance(
                f"nothing of the recipe's range {lower:g} to {upper:g} lies in "
                f"the limits of joint {joint.name!r}, {-back:g} to {room:g} from the canonical "
                "pose; choose another articulation.canonical or clip_to_limits: false"
            )
        lower, upper = max(lower, -back), min(upper, room)
    return (-sign, -upper, -lower) if upper <= 0.0 and lower < 0.0 else (sign, lower, upper)


def _plan_follower(by_name: Mapping[str, Joint], joint: Joint, plans: dict[str, _Plan]) -> _Plan:
    """With v = m v_driver + b and v_driver = c + s q: v = (m c + b) + m s q."""
    driver, multiplier, offset = _driver(by_name, joint)
    plan = plans.get(driver, _Plan(0.0))
    value, turn = multiplier * plan.value + offset, multiplier * plan.sign
    ends = (value, value + turn * plan.lower, value + turn * plan.upper)
    if not np.all(np.abs(ends) <= _FARTHEST):
        raise RejectedInstance(
            f"joint {joint.name!r} follows {driver!r} beyond {_FARTHEST:,.0f} rad or m; correct "
            "the multipliers and offsets of the <mimic> elements of its URDF"
        )
    if not plan.moves or multiplier == 0.0:
        return _Plan(value, remarks=("locked, as the joints that drive them are",))
    beyond = min(ends) < joint.lower - _TIE or max(ends) > joint.upper + _TIE
    return _Plan(
        value,
        sign=float(np.sign(turn)),
        lower=abs(multiplier) * plan.lower,
        upper=abs(multiplier) * plan.upper,
        moves=True,
        mimic=Mimic(driver, abs(multiplier), 0.0),
        remarks=("beyond the limits of the model, where another joint takes it",) * bool(beyond),
    )


def _driver(by_name: Mapping[str, Joint], joint: Joint) -> tuple[str, float, float]:
    """Return (name, multiplier, offset) of the joint that drives `joint` at the end of all
    mimics."""
    multiplier, offset, passed = 1.0, 0.0, {joint.name: None}
    while joint.mimic is not None and joint.kind != JointKind.FIXED:
        mimic = joint.mimic
        if mimic.joint in passed or mimic.joint not in by_name:
            raise RejectedInstance(
                f"the mimic joints {' -> '.join([*passed, mimic.joint])} end at no joint that "
                "moves by itself; mend the <mimic> elements of its URDF"
            )
        multiplier, offset = multiplier * mimic.multiplier, multiplier * mimic.offset + offset
        joint = by_name[mimic.joint]
        passed[joint.name] = None
    return joint.name, multiplier, offset


def _planned(joint: Joint, plan: _Plan) -> Joint:
    return replace(
        joint,
        kind=joint.kind if plan.moves else JointKind.FIXED,
        T_parent_joint=product(joint.T_parent_joint, _motion(joint, plan.value)),
        axis=plan.sign * joint.axis,
        lower=plan.lower,
        upper=plan.upper,
        mimic=plan.mimic,
    )


def _motion(joint: Joint, q: float) -> Floats:
    """Return (4, 4) what the joint's value does to its child link, in the joint's frame."""
    if joint.kind == JointKind.FIXED:
        return np.eye(4)
    return joint_motion(joint.kind != JointKind.PRISMATIC, joint.axis, q)


def _pattern_of(obj: ArticulatedObject, joint: Joint, patterns: tuple[str, ...]) -> int:
    """Return the first pattern that picks the joint; the number of patterns where none does."""
    names = (joint.name, obj.links[obj.link_index[joint.child]].semantic)
    picks = (k for k, p in enumerate(patterns) if any(fnmatchcase(name, p) for name in names))
    return next(picks, len(patterns))


def _part_order(obj: ArticulatedObject, patterns: tuple[str, ...]) -> tuple[str, ...]:
    """Return the moving joints by pattern, then by where their parts are in the canonical pose."""
    boxes = _part_boxes(obj)
    middle = boxes.mean(axis=1)
    length = float((boxes[:, 1].max(axis=0) - boxes[:, 0].min(axis=0)).max())
    row = _levels(-middle[1:, 2], _LEVEL * length)
    column = _levels(middle[1:, 1], _LEVEL * length)

    def place(j: int) -> tuple[float, ...]:
        x, y, z = middle[j + 1]
        return (_pattern_of(obj, moving[j], patterns), row[j], column[j], -z, y, -x)

    moving = obj.moving_joints
    return tuple(moving[j].name for j in sorted(range(len(moving)), key=place))


def _part_boxes(obj: ArticulatedObject) -> Floats:
    """Return (P, 2, 3) canonical boxes, world frame; of an empty part its pivot or the origin."""
    posed = forward_kinematics(obj, canonical_state(obj))
    pivots = np.concatenate([posed.T_world_part[:1, :3, 3], posed.pivots])
    at: list[list[Floats]] = [[] for _ in pivots]
    for link, T, part in zip(obj.links, posed.T_world_link, obj.part_of_link, strict=True):
        at[part].append(apply(T, link.mesh.vertices[link.mesh.faces].reshape(-1, 3)))
    shapes = [np.concatenate(points) for points in at]
    return np.array([bounds(s if len(s) else p[None]) for s, p in zip(shapes, pivots, strict=True)])


def _levels(values: Floats, gap: float) -> list[int]:
    """Return the number of the level that each value is on; levels ascend, more than `gap`
    apart."""
    order = np.argsort(values, kind="stable")
    levels = np.zeros(len(values), int)
    levels[order[1:]] = np.cumsum(np.diff(values[order]) > gap)
    return levels.tolist()


def _nothing_moves(obj: ArticulatedObject, patterns: tuple[str, ...]) -> str:
    jointed = [joint for joint in obj.joints if joint.kind != JointKind.FIXED]
    if not jointed:
        return "no joint moves; all joints of its URDF are fixed, leave it out"

    def names(joints: list[Joint]) -> str:
        index = obj.link_index
        texts = [f"{j.name} ({obj.links[index[j.child]].semantic or 'no name'})" for j in joints]
        return ", ".join(texts[:12] + ["..."] * (len(texts) > 12))

    picked = [j for j in jointed if not patterns or _pattern_of(obj, j, patterns) < len(patterns)]
    if picked:
        return (
            f"no joint moves: the limits leave no range to {names(picked)}; correct the <limit> "
            "elements of its URDF"
        )
    return (
        f"no joint moves: articulation.movable {list(patterns)} picks none of {names(jointed)}; "
        "name the joints or parts that move there"
    )
