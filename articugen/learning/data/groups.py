"""The objects that training instances show, found without asking the data set for them."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Floats
from articugen.core.errors import UnfitData
from articugen.discovery.groups import group_instances
from articugen.store.shards import Shard


def found_objects(shards: Sequence[Callable[[], Shard]], where: str) -> list[NDArray[Any]]:
    """Return for each shard the objects (n,) that its instances show, by their clouds alone.

    Where the shards are is named in errors.

    A group is named after the object of its first instance; one that begins with an object that
    another begins with as well is `<name>~2`. So where groups are as the data set's objects are,
    all that follows is the same to the bit.

    Raises:
        UnfitData: no two instances show one object.
    """
    names: list[str] = []
    counts: list[int] = []

    def clouds() -> Iterator[tuple[Floats, Floats]]:
        for opened in shards:
            with opened() as shard:
                stored = shard.read("surface_points"), shard.read("surface_normals")
                names.extend(shard.object_ids())
            counts.append(len(stored[0]))
            for points, normals in zip(*stored, strict=True):
                yield points / 65535.0 - 0.5, normals / 127.0

    number = group_instances(clouds()).number
    if len(set(number.tolist())) == len(number):
        raise UnfitData(
            f"{where}: no two training instances show one object, but the recipe "
            "compares poses; make the data set with more of them (generate --states), all poses of "
            "an object in one frame, or use a recipe with data.varying_points 0 and without a warm "
            "start"
        )
    of_group: dict[int, str] = {}
    begun: dict[str, int] = {}
    for group, name in zip(number.tolist(), names, strict=True):
        if group not in of_group:
            begun[name] = begun.get(name, 0) + 1
            of_group[group] = name if begun[name] == 1 else f"{name}~{begun[name]}"
    objects = np.array([of_group[group] for group in number.tolist()])
    return np.split(objects, np.cumsum(counts)[:-1])
