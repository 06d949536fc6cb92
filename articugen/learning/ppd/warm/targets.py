"""What a warm start knows of each training instance: its joints, which candidates carry them, and
whose its material is.

`articugen.discovery` finds it in the surface points of training objects, without labels; but it
must know which instances belong to one object, which the paper does not use.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import permutations
from typing import Any

import numpy as np
import torch
from numpy.linalg import norm
from numpy.typing import NDArray
from torch import Tensor

from articugen.core.geometry import invert_rigid
from articugen.core.records import Floats, JointKind
from articugen.discovery import LEAN, FoundJoint, Joints, Ownership
from articugen.discovery.ownership import CELLS
from articugen.learning.data.split import PackedSplit, unpacked
from articugen.learning.ppd.kinematics import InverseMotion
from articugen.learning.ppd.network import rest_states, widest
from articugen.learning.ppd.settings import ModelSettings, directions_of
from articugen.learning.ppd.warm.found import FEW_OBJECTS, Found, kinds_of

LEFT_RIGHT = 1
"""The axis of the unit frame that goes from left to right."""

_UPRIGHT = np.cos(np.radians(10.0))
"""A joint that leans less from a coordinate axis is taken to point along it."""

ROW = 0.075
"""Joints whose pivots are so far apart in height are not in one row."""

_ONE_SIDED = np.cos(np.radians(5.0))
"""Joints that a mirror lets lean otherwise by more than this are not as any object's are."""

_FLIPPED = 0.5
"""What it costs to give a joint to a candidate that turns the other way: as much as a lean of 29
degrees."""


@dataclass(frozen=True, eq=False)
class Targets:
    """Targets of the instances of a split. I instances, P parts, J = P - 1 candidates. Where they
    may be mirrored there are 2 I rows, row I + i being what is asked of instance i then: other
    candidates may take its joints. All of it is as it is, though.

    Attributes:
        known: (I,) 1 where it was found how the instance moves, else 0: nothing to aim at.
        there: (I, J) 1 where the object has a joint for the candidate, else 0.
        still: (I, J) 1 where it has none, but other objects have one, else 0.
        state: (I, J) of that joint; of a closed one where there is none.
        axis, pivot: (I, J, 3) of that joint, in the unit frame.
        owns: (I, P) 1 where it is known where the part's material lies, else 0.
        middle, size: (I, P, 3) of a box around it, in the part's rest frame, that of the pose in
            which it is closed.
        rotation, offset: (I, P, 3, 3), (I, P, 3) from the instance to the rest frame.
        centre, extent: (I, 3) the middle and the edges of a box that holds all poses of the object.
        alike: (I, 3, 3) takes the logarithms of an object's growth along the axes to those of one
            that leaves its motions rigid: the mean over axes that a joint turns into each other.
        grid: (I, P) which of `far` belongs to a part; the first is that of unknown ones.
        far: (V, CELLS^3) as in `Ownership`, of cells of a part's rest frame.
    """

    known: Tensor
    there: Tensor
    still: Tensor
    state: Tensor
    axis: Tensor
    pivot: Tensor
    owns: Tensor
    middle: Tensor
    size: Tensor
    rotation: Tensor
    offset: Tensor
    centre: Tensor
    extent: Tensor
    alike: Tensor
    grid: Tensor
    far: Tensor

    def of(self, rows: Tensor, mirrored: Tensor | None = None) -> Targets:
        """Return those of some instances, of which some (B,) are mirrored."""
        if mirrored is not None:
            rows = rows + mirrored * (len(self.known) // 2)
        some = {f.name: getattr(self, f.name)[rows] for f in fields(self)[:-1]}
        return replace(self, **some)

    def owner(self, points: Tensor, occupied: Tensor) -> Tensor:
        """Return (B, n) the part that each occupied point belongs to, as `Ownership` says; -1 for
        points in free space.

        Args:
            points: (B, n, 3) in the instances that these targets are of.
        """
        rest = InverseMotion(self.rotation, self.offset).apply(points)
        cell = self.grid[..., None] * CELLS**3 + _cells(rest)
        far = self.far.flatten()[cell].masked_fill(self.owns[..., None] == 0, torch.inf)
        return torch.where(occupied, far.argmin(1), -1)


def targets(
    split: PackedSplit,
    discoveries: Found,
    rows: Sequence[NDArray[np.intp]],
    model: ModelSettings,
    *,
    mirrored: bool = False,
) -> Targets:
    """Return the targets of a split, on its device.

    Args:
        discoveries: what was found in each object, its poses in the order of `rows`.
        rows: the instances of each object that were examined.
        mirrored: whether they may be mirrored.
    """
    far = [torch.ones(CELLS**3, dtype=torch.float16)]
    tables = [_unknown(len(split), model) for _ in range(1 + mirrored)]
    for discovery, instances in zip(likely(discoveries, model), rows, strict=True):
        if not discovery:
            continue
        points = unpacked(split.surface[torch.from_numpy(instances)].cpu()).double().numpy()
        placed: dict[tuple[float, ...], tuple[Floats, Ownership, int]] = {}
        for table, one in zip(tables, (discovery, in_mirror(discovery)), strict=False):
            taken = [(-1, 1.0), *assigned(one, model)]
            senses = tuple(slot[1] if slot else 1.0 for slot in taken)
            if senses not in placed:
                motion = _from_closed(discovery, senses)
                ownership = Ownership.of(list(points), discovery.owner, motion)
                placed[senses] = motion, ownership, len(far)
                far += [torch.from_numpy(grid).flatten() for grid in ownership.far]
            _fill(table, instances, discovery, taken, *placed[senses])
            low, high = points.min((0, 1)), points.max((0, 1))
            table["centre"][instances], table["extent"][instances] = 0.5 * (low + high), high - low
    device = split.surface.device
    values = {
        name: torch.from_numpy(np.concatenate([table[name] for table in tables])).to(device)
        for name in tables[0]
    }
    grid = values.pop("grid")
    values = {name: tensor.float() for name, tensor in values.items()}
    values["still"] = values["known"][:, None] * values["there"].amax(0) * (1.0 - values["there"])
    values["state"] = in_range(
        values["state"] + rest_states(values["state"], len(model.revolute)), len(model.revolute)
    )
    return Targets(**values, grid=grid, far=torch.stack(far).to(device))


def in_range(states: Tensor, revolute: int) -> Tensor:
    """States (..., J), no nearer to the ends of their ranges than half of a closed joint's."""
    beside = 0.5 * rest_states(states, revolute)
    return torch.maximum(torch.minimum(states, widest(states, revolute) - beside), beside)


def _unknown(count: int, model: ModelSettings) -> dict[str, NDArray[Any]]:
    """Return what `Targets` holds of instances of which nothing is known."""
    J, P = model.joints, model.parts
    zeros = {"known": (), "there": (J,), "state": (J,), "axis": (J, 3), "pivot": (J, 3)}
    zeros |= {"owns": (P,), "offset": (P, 3), "centre": (3,)}
    ones = {"middle": (P, 3), "size": (P, 3), "extent": (3,)}
    return {
        **{name: np.zeros((count, *shape)) for name, shape in zeros.items()},
        **{name: np.ones((count, *shape)) for name, shape in ones.items()},
        "rotation": np.tile(np.eye(3), (count, P, 1, 1)),
        "alike": np.full((count, 3, 3), 1.0 / 3.0),
        "grid": np.zeros((count, P), np.int64),
    }


def _fill(
    table: dict[str, NDArray[Any]],
    rows: NDArray[np.intp],
    discovery: Joints,
    taken: list[tuple[int, float] | None],
    motion: Floats,
    ownership: Ownership,
    first: int,
) -> None:
    """Fill in the targets of an object's instances.

    Args:
        taken: as `assigned` gives it, with the fixed part.
        motion: (K, P, 4, 4) of each part from its rest frame.
        ownership: whose its material is; `first`: the place of part 0's cells in `far`.
    """
    T = invert_rigid(motion)
    table["known"][rows], table["alike"][rows] = 1.0, _alike(discovery)
    for part, candidate in enumerate(taken):
        if candidate is None:
            continue
        slot, sense = candidate
        at = rows, slot + 1
        table["rotation"][at], table["offset"][at] = T[:, part, :3, :3], T[:, part, :3, 3]
        table["owns"][at], table["grid"][at] = ownership.owns[part], first + part
        table["middle"][at], table["size"][at] = ownership.middle[part], ownership.size[part]
        if part:
            joint, at = discovery.joints[part - 1], (rows, slot)
            table["there"][at], table["axis"][at] = 1.0, sense * joint.axis
            opened = sense * joint.states
            table["state"][at], table["pivot"][at] = opened - opened.min(), joint.pivot


def in_mirror(discovery: Joints) -> Joints:
    """Return an object's joints as a mirror shows them that swaps left and right: what turns one
    way turns the other way then."""
    side = np.ones(3)
    side[LEFT_RIGHT] = -1.0

    def seen(joint: FoundJoint) -> FoundJoint:
        sense = -1.0 if joint.kind == JointKind.REVOLUTE else 1.0
        return replace(joint, axis=sense * side * joint.axis, pivot=side * joint.pivot)

    return replace(discovery, joints=tuple(seen(joint) for joint in discovery.joints))


def is_one_sided(discoveries: Found, model: ModelSettings) -> bool:
    """Return whether mirrored objects are unlike all that there are: the joints of some candidate
    lean to one side. Of glasses the same temple always folds over the other one, which their open
    pose does not show; with mirrored ones among them a model can only guess."""
    axes: tuple[dict[int, list[Floats]], ...] = {}, {}
    known = [discovery for discovery in likely(discoveries, model) if discovery]
    for discovery in known:
        for side, one in zip(axes, (discovery, in_mirror(discovery)), strict=True):
            for joint, taken in zip(one.joints, assigned(one, model), strict=True):
                if taken:
                    side.setdefault(taken[0], []).append(taken[1] * joint.axis)
    means = [
        [np.mean(side[slot], axis=0) for side in axes]
        for slot in axes[0].keys() & axes[1].keys()
        if min(len(side[slot]) for side in axes) >= FEW_OBJECTS * len(known)
    ]
    return any(a @ b < _ONE_SIDED * norm(a) * norm(b) for a, b in means)


def _alike(discovery: Joints) -> Floats:
    """Return (3, 3) of `Targets.alike`: joints turn two coordinate axes into each other if they
    point along the third, else all three."""
    across = np.zeros((3, 3), bool)
    for joint in discovery.joints:
        if joint.kind == JointKind.REVOLUTE:
            about = np.abs(joint.axis) > _UPRIGHT
            across |= ~(about[:, None] | about)
    together = np.linalg.matrix_power(across + np.eye(3), 2) > 0
    return together / together.sum(1, keepdims=True)


def _from_closed(discovery: Joints, senses: tuple[float, ...]) -> Floats:
    """Return (K, P, 4, 4) the motion of each part from the pose in which it is closed, which is
    that with the least state in the `senses` of the parts, to all poses."""
    motion = np.stack([discovery.motion(k) for k in range(len(discovery.joints[0].states))])
    for part, sense in enumerate(senses[1:], 1):
        closed = int((sense * discovery.joints[part - 1].states).argmin())
        motion[:, part] = motion[:, part] @ invert_rigid(motion[closed, part])
    return motion


def _cells(points: Tensor) -> Tensor:
    """Return the flat cells of points (..., 3); those outside are given to the nearest cells."""
    at = ((points + 0.5) * CELLS).floor().long().clamp(0, CELLS - 1)
    return (at[..., 0] * CELLS + at[..., 1]) * CELLS + at[..., 2]


def likely(discoveries: Found, model: ModelSettings) -> Found:
    """Return what was found without the objects that are unlike the others or the candidates: with
    a kind of joint that few objects have, or a joint that leans too far from every candidate."""
    kinds, directions = kinds_of(discoveries), directions_of(model)

    def is_likely(discovery: Joints) -> bool:
        along = [np.abs(directions[j.kind] @ j.axis).max() for j in discovery.joints]
        return min(along) > LEAN and {joint.kind for joint in discovery.joints} <= kinds

    return [one if one and is_likely(one) else None for one in discoveries]


def assigned(discovery: Joints, model: ModelSettings) -> list[tuple[int, float] | None]:
    """Return the candidate that each joint of an object goes to, and 1 or -1, the sense of its axis
    there.

    Candidates point as joints do, if there are such. Those that point alike are handed out as one
    reads, row by row, so that they mean the same in objects with as many parts.
    A joint for which no candidate of its kind is left gets None.
    """
    joints = discovery.joints
    taken: list[tuple[int, float] | None] = [None] * len(joints)
    for kind, first in ((JointKind.REVOLUTE, 0), (JointKind.PRISMATIC, len(model.revolute))):
        directions = directions_of(model)[kind]
        indices = [j for j, joint in enumerate(joints) if joint.kind == kind][: len(directions)]
        if indices:
            order = _as_read(np.array([joints[j].pivot for j in indices]))
            indices = [indices[i] for i in order]
            along = np.array([joints[j].axis for j in indices]) @ directions.T
            cost = (4.0 * (1.0 - np.abs(along)) + _FLIPPED * (along < 0)).round(1)
            options = permutations(range(len(directions)), len(indices))
            best = min(options, key=lambda slots: sum(cost[i, s] for i, s in enumerate(slots)))
            for i, (j, slot) in enumerate(zip(indices, best, strict=True)):
                taken[j] = first + slot, 1.0 if along[i, slot] >= 0 else -1.0
    return taken


def _as_read(places: Floats) -> list[int]:
    """Return the order of places (n, 3) from the top row down and in a row with growing y or x,
    whichever the places differ in more."""
    across = int(np.ptp(places[:, :2], axis=0).argmax())
    down = np.argsort(-places[:, 2], kind="stable")
    rows = np.split(down, np.flatnonzero(-np.diff(places[down, 2]) > ROW) + 1)
    return [i for row in rows for i in row[np.argsort(places[row, across], kind="stable")].tolist()]
