"""A contact sheet: some objects, each in some of its joint states, coloured by part.

The pictures are drawn from stored data alone. The surface points of many instances of an object are
brought to its canonical pose by the stored motions of their parts, which makes a dense cloud, and
from there to each pose that is drawn. So what is wrong in a shard shows: points that are off as
specks, a wrong `part_motion` or part label as a blurred or doubled part. But what is wrong in one
instance shows in all pictures of its object.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from articugen.errors import ArticugenError
from articugen.inspection.layout import Caption, Row, save, sheet
from articugen.inspection.portrait import best_azimuth, colour_of, pooled, portrait, tile_camera
from articugen.inspection.surfels import Surfels
from articugen.records import Instance, JointKind, dequantize
from articugen.store.shards import Shard, open_shard

Array = NDArray[np.float64]
T = TypeVar("T")

Place = tuple[Path, int]
"""A shard and an instance's index in it."""

Chosen = tuple[str, str, list[Place]]
"""The category and title of a row, and where its object's instances are."""

POOLED = 16
"""The points of so many instances of an object, or of all that there are, make its pictures."""


@dataclass(frozen=True, eq=False)
class _Object:
    """`instances` to draw; `discs` in the canonical pose, from the points of many instances."""

    category: str
    title: str
    instances: tuple[Instance, ...]
    discs: Surfels

    @property
    def points(self) -> Array:
        return np.concatenate([dequantize(i.surface_points) for i in self.instances])

    @property
    def floor(self) -> float:
        return float(self.points[:, 2].min())


def contact_sheet(shards: Sequence[Path], path: Path, *, objects: int = 4, states: int = 6) -> None:
    """Draw `objects` rows of `states` instances each, chosen evenly from `shards`, as a PNG.

    The first instance of a row is the canonical pose; the others are in the order of how far
    their joints have moved. A category is seen from the side that shows most of its parts.

    Raises:
        CorruptShard: a shard cannot be read.
        ArticugenError: there is nothing to draw, or `path` cannot be written.
    """
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        drawn = list(pool.map(lambda chosen: _object(chosen, states), _chosen(shards, objects)))
        widest: dict[str, list[Instance]] = {}
        for each in drawn:
            widest.setdefault(each.category, []).append(each.instances[-1])
        azimuth = {category: best_azimuth(instances) for category, instances in widest.items()}
        cameras = [tile_camera(each.points, azimuth[each.category]) for each in drawn]
        tiles = [(o, i, c) for o, c in zip(drawn, cameras, strict=True) for i in o.instances]
        pictures = pool.map(lambda t: portrait(t[0].discs, t[1], t[2], t[0].floor), tiles)
    rows = [
        Row(o.title, [next(pictures) for _ in o.instances], [_states(i) for i in o.instances])
        for o in drawn
    ]
    save(sheet(rows), path)


def _chosen(shards: Sequence[Path], objects: int) -> list[Chosen]:
    where: dict[tuple[str, str, str], list[Place]] = {}
    for path in shards:
        with open_shard(path) as shard:
            if shard.fields["surface_points"][1] < 2:
                continue
            category, split = (str(shard.attributes[name]) for name in ("category", "split"))
            for index, object_id in enumerate(shard.object_ids()):
                where.setdefault((category, split, object_id), []).append((path, index))
    if not where:
        raise ArticugenError(
            f"{shards[0].parent}: no surface points to draw; ask for some in the recipe"
        )
    keys = _evenly(sorted(where, key=lambda key: (key[1] != "train", key)), objects)
    return [
        (category, f"{object_id}  {split}", where[category, split, object_id])
        for category, split, object_id in keys
    ]


def _object(chosen: Chosen, states: int) -> _Object:
    category, title, places = chosen
    with ExitStack() as stack:
        opened = {path: stack.enter_context(open_shard(path)) for path in {p for p, _ in places}}
        rows = sorted(((opened[path], index) for path, index in places), key=lambda r: _moved(*r))
        drawn = tuple(shard.instance(index) for shard, index in _evenly(rows, states))
        many = [shard.instance(index) for shard, index in _evenly(rows, POOLED)]
    return _Object(category, title, drawn, pooled(many))


def _evenly(items: Sequence[T], count: int) -> list[T]:
    picked = np.linspace(0, len(items) - 1, min(count, len(items)))
    return [items[round(i)] for i in picked]


def _moved(shard: Shard, index: int) -> float:
    """How far the joints have moved, the canonical pose before all others."""
    if shard.read("state_index", index) == 0:
        return -np.inf
    q, upper = shard.read("joint_state", index), shard.read("joint_upper", index)
    return float(np.abs(q / np.where(upper == 0.0, 1.0, upper)).sum())


def _states(instance: Instance) -> Caption:
    """The joint states, each in the colour of its part."""
    J = len(instance.joint_state)
    return [(_state(instance, j), colour_of(j + 1)) for j in range(J)]


def _state(instance: Instance, joint: int) -> str:
    q = float(instance.joint_state[joint])
    if instance.joint_kind[joint] == JointKind.REVOLUTE:
        return f"{np.degrees(q):.0f}°"
    return f"{100.0 * q * instance.scale:.0f} cm"
