"""Clouds to make predictions from, out of the shards of a data set."""

from pathlib import Path
from typing import Any

from articugen.core.errors import InvalidSource, UnfitData
from articugen.core.records import Floats, dequantize
from articugen.core.schema import Instance
from articugen.core.seeding import generator
from articugen.meshes.points import Cloud, checked
from articugen.store.shards import Shard, open_shard


def cloud_of_shard(
    path: Path, row: int = 0, *, category: str | None = None, camera: int | None = None
) -> Cloud:
    """Return the surface points of a shard's instance.

    Args:
        category: what the shard must be of.
        camera: what this depth camera sees instead.

    Raises:
        CorruptShard: it cannot be read.
        InvalidSource: it is of another category, or has no such row or camera.
    """
    with open_shard(path) as shard:
        have = shard.attributes["category"]
        if category is not None and have != category:
            raise InvalidSource(f"{path}: holds {have}, the model is of {category}")
        if row >= len(shard):
            raise InvalidSource(f"{path}: has {len(shard)} instances, from 0; there is no {row}")
        return Cloud(checked(dequantize(_stored(shard, row, camera)), str(path)))


def _stored(shard: Shard, row: int, camera: int | None) -> Any:
    if camera is None:
        return shard.read("surface_points", row)
    cameras = shard.fields["partial_points"][1]
    if camera >= cameras:
        raise InvalidSource(f"{shard.path}: has {cameras} cameras, from 0; there is no {camera}")
    return shard.read("partial_points", row)[camera]


def seen_by_a_camera(instance: Instance) -> Floats:
    """Return (M, 3) what one of the instance's depth cameras sees, always the same one.

    Raises:
        UnfitData: it has none.
    """
    cameras = len(instance.partial_points)
    if not cameras:
        raise UnfitData(
            f"{instance.object_id}: has no partial clouds; set sampling.partial_views and make the "
            "data set again"
        )
    chosen = generator(0, "camera", instance.object_id, instance.state_index).integers(cameras)
    return dequantize(instance.partial_points[chosen])
