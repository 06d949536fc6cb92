"""Joints as models have them: in metres, at the canonical pose, with names that no other has."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from articugen.core.records import Floats
from articugen.store.rows import Row


@dataclass(frozen=True, eq=False)
class MetricJoint:
    """A joint in the model's own frame, canonical pose; its state there is 0.

    Attributes:
        name: as the model's file has it, or a made-up one; none is there twice.
        kind: "revolute" or "prismatic".
        parent, part: the part that it hangs on, and the one that it moves.
        pivot: (3,) a point on the axis, metres.
        axis: (3,) unit direction.
        lower, upper: its range, rad or metres; 0 lies in it.
    """

    name: str
    kind: str
    parent: int
    part: int
    pivot: Floats
    axis: Floats
    lower: float
    upper: float


def metric_joints(row: Row) -> tuple[MetricJoint, ...]:
    """Return the joints of an object, from its canonical pose.

    The range is that of the data, widened to the canonical pose where that lies outside.
    """
    names = unique(joint.name or f"joint_{joint.part}" for joint in row.joints)
    return tuple(
        MetricJoint(
            name=name,
            kind=joint.kind,
            parent=joint.parent,
            part=joint.part,
            pivot=row.to_metres(joint.pivot),
            axis=np.asarray(joint.axis) / np.linalg.norm(joint.axis),
            lower=min(joint.lower, 0.0),
            upper=max(joint.upper, 0.0),
        )
        for name, joint in zip(names, row.joints, strict=True)
    )


def part_names(row: Row) -> tuple[str, ...]:
    """Name each part, no name twice."""
    return unique(part.name or f"part_{k}" for k, part in enumerate(row.parts))


def unique(names: Iterable[str]) -> tuple[str, ...]:
    """The names, but those that were there before with a number behind; no control characters."""
    taken: set[str] = set()
    given = []
    for name in names:
        plain = "".join(c if c.isprintable() else "_" for c in name)
        number, chosen = 2, plain
        while chosen in taken:
            number, chosen = number + 1, f"{plain}_{number}"
        taken.add(chosen)
        given.append(chosen)
    return tuple(given)
