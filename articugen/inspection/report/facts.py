"""Facts of a data set for its report, read from its shards in one go, one shard at a time."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bools, Floats, grouped
from articugen.core.records import ENCLOSED, JointKind, dequantize, is_material
from articugen.store.columns import Attribute
from articugen.store.shards import Shard, open_shard


@dataclass(frozen=True, eq=False)
class JointStates:
    """A joint's states in an object's instances, in degrees, or in the unit of its model.

    Attributes:
        name: in the model's file; "" where the shard has none.
        kind: revolute or prismatic.
        lower, upper: the range that they are drawn from.
        states: (n,) all of them, in the order of the rows.
        drawn: (m,) the random ones of these.
    """

    name: str
    kind: JointKind
    lower: float
    upper: float
    states: Floats
    drawn: Floats

    @property
    def unit(self) -> str:
        """The sign behind its states: lengths have none, not all models state their unit."""
        return "°" if self.kind == JointKind.REVOLUTE else ""


@dataclass(frozen=True, eq=False)
class PartSize:
    """Size of a part.

    Attributes:
        name, semantic: in the model's file; "" where the shard has none.
        surface: its share of the visible surface points, over all instances.
        volume: its share of the unit cube, by the uniform points; nan without any.
        box: (3,) of its surface points in the canonical pose, its model's unit; nan without any.
    """

    name: str
    semantic: str
    surface: float
    volume: float
    box: Floats


@dataclass(frozen=True, eq=False)
class ObjectFacts:
    """One object of a data set.

    Attributes:
        shard: the file that holds it.
        scale: metres that the unit frame's unit is long.
        occupied: (n,) the share of the unit cube inside of it, of each instance; nan unless known.
        points: how many surface points an instance has.
        box: (3,) of those in its canonical pose, its model's unit; nan without any.
    """

    object_id: str
    split: str
    shard: Path
    rows: tuple[int, ...]
    scale: float
    joints: tuple[JointStates, ...]
    parts: tuple[PartSize, ...]
    occupied: Floats
    points: int
    box: Floats


@dataclass(frozen=True, eq=False)
class Facts:
    """A data set: its objects, what its shards say of themselves, and bytes a field takes."""

    objects: tuple[ObjectFacts, ...]
    about: Mapping[str, Attribute]
    shards: tuple[Path, ...]
    fields: Mapping[str, tuple[str, int]]

    @property
    def instances(self) -> int:
        return sum(len(one.rows) for one in self.objects)

    @property
    def bytes(self) -> int:
        return sum(path.stat().st_size for path in self.shards)


def facts(shards: Sequence[Path]) -> Facts:
    """Read all shards once; CorruptShard if one cannot be read."""
    return merged([_facts_of(path) for path in shards])


def merged(some: Sequence[Facts]) -> Facts:
    """Return the facts of parts of a data set as those of all of it."""
    fields: dict[str, tuple[str, int]] = {}
    for facts in some:
        for name, (shape, stored) in facts.fields.items():
            fields[name] = (shape, stored + fields.get(name, ("", 0))[1])
    objects = tuple(one for facts in some for one in facts.objects)
    return Facts(objects, some[-1].about, tuple(path for f in some for path in f.shards), fields)


def _facts_of(path: Path) -> Facts:
    with open_shard(path) as shard:
        rows = grouped((object_id, row) for row, object_id in enumerate(shard.object_ids()))
        small = {name: shard.read(name) for name in _SMALL}
        return Facts(
            objects=tuple(_object(shard, name, some, small) for name, some in rows.items()),
            about=dict(shard.attributes),
            shards=(path,),
            fields={
                name: (" × ".join(map(str, shape[1:])) or "1", shard.stored_bytes(name))
                for name, shape in shard.fields.items()
            },
        )


_SMALL = ("state_index", "scale", "joint_kind", "joint_state", "joint_lower", "joint_upper")


def _object(
    shard: Shard, object_id: str, rows: list[int], small: Mapping[str, NDArray[Any]]
) -> ObjectFacts:
    rows.sort(key=lambda row: int(small["state_index"][row]))
    first, scale = shard.instance(rows[0]), float(small["scale"][rows[0]])
    labels = shard.batch(rows, ["uniform_label", "surface_part"])
    inside, parts = labels["uniform_label"], labels["surface_part"]
    solid = is_material(inside) | (inside == ENCLOSED)
    points = dequantize(first.surface_points)
    return ObjectFacts(
        object_id=object_id,
        split=str(shard.attributes["split"]),
        shard=shard.path,
        rows=tuple(rows),
        scale=scale,
        joints=tuple(_joints(first.joint_name, rows, scale, small)),
        parts=tuple(
            PartSize(
                name=first.part_name[k] if first.part_name else "",
                semantic=first.part_semantic[k] if first.part_semantic else "",
                surface=_share(parts == k),
                volume=_share(inside == k + 1),
                box=_box(points[first.surface_part == k], scale),
            )
            for k in range(len(first.part_motion))
        ),
        occupied=solid.mean(axis=1) if solid.size else np.full(len(rows), np.nan),
        points=len(points),
        box=_box(points, scale),
    )


def _joints(
    names: tuple[str, ...] | None, rows: list[int], scale: float, small: Mapping[str, NDArray[Any]]
) -> Iterator[JointStates]:
    random = [row for row in rows if small["state_index"][row] > 0]
    for j, number in enumerate(small["joint_kind"][rows[0]]):
        kind = JointKind(int(number))
        unit = np.degrees(1.0) if kind == JointKind.REVOLUTE else scale
        yield JointStates(
            name=names[j] if names else "",
            kind=kind,
            lower=float(small["joint_lower"][rows[0], j] * unit),
            upper=float(small["joint_upper"][rows[0], j] * unit),
            states=small["joint_state"][rows, j] * unit,
            drawn=small["joint_state"][random, j] * unit,
        )


def _share(which: Bools) -> float:
    return float(which.mean()) if which.size else float("nan")


def _box(points: Floats, scale: float) -> Floats:
    return scale * np.ptp(points, axis=0) if len(points) else np.full(3, np.nan)


def range_text(low: float, high: float, unit: str) -> str:
    """Write the two ends of a range of joint states."""
    return f"{_number(low, unit)} to {_number(high, unit)}{unit}"


def _number(value: float, unit: str) -> str:
    return f"{value:.1f}" if unit else f"{value:.3g}"


def spread_text(values: Sequence[float], unit: str) -> str:
    """Write one number where all are alike, else the least and the greatest."""
    low, high = min(values), max(values)
    one, other = _number(low, unit), _number(high, unit)
    return f"{one}{unit}" if one == other else f"{one} … {other}{unit}"
