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
from numpy.typing import ArrayLike

from articugen.core.arrays import Floats, grouped
from articugen.core.colours import colour_of
from articugen.core.errors import ArticugenError
from articugen.core.records import JointKind, dequantize
from articugen.core.schema import Instance
from articugen.pictures.camera import Camera
from articugen.pictures.layout import TILE, Caption, Row, check_picture, save, sheet
from articugen.pictures.portrait import best_azimuth, pooled, portrait, tile_camera
from articugen.pictures.shading import Picture
from articugen.pictures.surfels import Surfels
from articugen.store.shards import open_shard

T = TypeVar("T")

Place = tuple[Path, int]  # a shard and an instance's index in it
POOLED = 16
"""Instances of an object, or all that there are, whose points make its pictures."""

ASKED = 4  # objects of a category, of those that are drawn, that say from which side it is seen


@dataclass(frozen=True)
class Chosen:
    """An object to draw, and where its instances are."""

    category: str
    split: str
    object_id: str
    places: list[Place]


@dataclass(frozen=True, eq=False)
class Portraits:
    """An object's row: `instances`, a picture of each, and what its joints' states are."""

    chosen: Chosen
    instances: tuple[Instance, ...]
    pictures: tuple[Picture, ...]

    @property
    def captions(self) -> tuple[Caption, ...]:
        """The joint states, each in the colour of its part."""
        return tuple(
            [(_state(i, j), colour_of(j + 1)) for j in range(len(i.joint_state))]
            for i in self.instances
        )


def contact_sheet(shards: Sequence[Path], path: Path, *, objects: int = 4, states: int = 6) -> None:
    """Draw `objects` rows of `states` instances each, chosen evenly from `shards`, as a PNG.

    Raises:
        CorruptShard: a shard cannot be read.
        ArticugenError: there is nothing to draw, `path` is not named like a PNG, or it cannot be
            written.
    """
    check_picture(path)
    save(drawn_sheet(shards, objects, states), path)


def drawn_sheet(shards: Sequence[Path], objects: int, states: int) -> Picture:
    """Return the same as a picture."""
    rows = [
        Row(f"{d.chosen.object_id}  {d.chosen.split}", d.pictures, d.captions)
        for d in portraits(chosen_of(shards, objects), states=states)
    ]
    return sheet(rows)


def portraits(
    chosen: Sequence[Chosen], *, states: int, pooling: int = POOLED, size: int = TILE,
    which: slice = slice(None),
) -> list[Portraits]:  # fmt: skip
    """Pictures of objects in `states` instances each.

    The first instance of an object is the canonical pose; the others are in the order of how far
    their joints have moved. A category is seen from the side that shows most of its parts.

    Args:
        pooling: number of an object's instances whose points make its pictures.
        size: of a picture, pixels.
        which: of these instances are drawn; the others only say how much room an object takes.

    Raises:
        CorruptShard: a shard cannot be read.
    """
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        read = pool.map(lambda one: _read(one, states, pooling), chosen)
        objects = list(zip(chosen, read, strict=True))
        widest = grouped((one.category, instances[-1]) for one, (instances, _) in objects)
        azimuth = {name: best_azimuth(evenly(many, ASKED)) for name, many in widest.items()}
        tiles: list[tuple[Surfels, Instance, Camera, float]] = []
        for one, (instances, discs) in objects:
            points = np.concatenate([dequantize(i.surface_points) for i in instances])
            camera = tile_camera(points, azimuth[one.category], size)
            tiles += [(discs, i, camera, float(points[:, 2].min())) for i in instances[which]]
        drawn = pool.map(lambda tile: portrait(*tile), tiles)
    shown = [(one, instances[which]) for one, (instances, _) in objects]
    return [Portraits(one, some, tuple(next(drawn) for _ in some)) for one, some in shown]


def chosen_of(shards: Sequence[Path], objects: int) -> list[Chosen]:
    """Choose `count` of the objects in the shards, evenly; ArticugenError without a surface."""
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
    return some_of([Chosen(*key, places) for key, places in where.items()], objects)


def some_of(every: Sequence[Chosen], count: int) -> list[Chosen]:
    """Return `count` of them, chosen evenly, those for training first."""
    order = sorted(every, key=lambda c: (c.split != "train", c.category, c.split, c.object_id))
    return evenly(order, count)


def _read(chosen: Chosen, states: int, pooling: int) -> tuple[tuple[Instance, ...], Surfels]:
    """Return instances to draw, and discs in the canonical pose, from the points of many."""
    with ExitStack() as stack:
        paths = {path for path, _ in chosen.places}
        opened = {path: stack.enter_context(open_shard(path)) for path in paths}
        names = ("state_index", "joint_state", "joint_upper")
        moved = {path: opening(*map(shard.read, names)) for path, shard in opened.items()}
        places = sorted(chosen.places, key=lambda place: moved[place[0]][place[1]])
        drawn, pool = evenly(places, states), evenly(places, pooling)
        read = {(p, index): opened[p].instance(index) for p, index in {*drawn, *pool}}
    return tuple(read[place] for place in drawn), pooled([read[place] for place in pool])


def evenly(items: Sequence[T], count: int) -> list[T]:
    """Return `count` of the items, from the first to the last."""
    picked = np.linspace(0, len(items) - 1, min(count, len(items)))
    return [items[round(i)] for i in picked]


def opening(state: ArrayLike, q: Floats, upper: Floats) -> Floats:
    """Return (...) how far joints (..., J) have moved by their upper limits in the states (...) of
    these numbers, the canonical pose before all others."""
    far = np.abs(q / np.where(upper == 0.0, 1.0, upper)).sum(axis=-1)
    return np.where(np.equal(state, 0), -np.inf, far)


def _state(instance: Instance, joint: int) -> str:
    q = float(instance.joint_state[joint])
    if instance.joint_kind[joint] == JointKind.REVOLUTE:
        return f"{np.degrees(q):.0f}°"
    return f"{q * instance.scale:.2g}"
