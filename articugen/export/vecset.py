"""Samples for autoencoders of sets of latents (after 3DShape2VecSet), as Dora packs them.

<split>/<object>_<state>.npz in coordinates from -1 to 1, and lists of paths, <split>.json: surface
points and points on sharp edges, each with normals; points near the surface, then points in all of
the cube, with signed distances, above 0 inside as its library has it; and those near edges.
"""

import json

import numpy as np
from numpy.typing import NDArray

from articugen.export.formats import Format, Item, LeftOut
from articugen.export.items import file_name, instance_name, of_instances
from articugen.export.target import Target
from articugen.store.dataset import DataSet
from articugen.store.rows import Row, RowQueries, RowSurface

_FIELDS = ("sharp_points", "near_distance")


def _write(item: Item, target: Target) -> None:
    (row,) = item.rows
    missing = [name for name in _FIELDS if name not in row.fields]
    if missing:
        raise LeftOut(
            f"{row.object_id}: {missing[0]} is not stored; make the data with "
            "sampling.sharp_points, sampling.near_sharp and sampling.signed_distance"
        )
    edges = round(item.rows.recipe.sampling.near_sharp * len(row.near))
    near, far = _queries(row.near), _queries(row.uniform)
    target.write_arrays(
        _path(row),
        {
            "fps_coarse_surface": _surface(row.surface),
            "fps_sharp_surface": _surface(row.sharp),
            "rand_points": np.concatenate([near[: len(near) - edges], far]),
            "sharp_near_surface": near[len(near) - edges :],
        },
    )


def _path(row: Row) -> str:
    return f"{file_name(row.split)}/{instance_name(row)}.npz"


def _surface(points: RowSurface) -> NDArray[np.float32]:
    """(n, 1, 6) points and normals."""
    return np.concatenate([2.0 * points.points, points.normals], axis=1, dtype=np.float32)[:, None]


def _queries(points: RowQueries) -> NDArray[np.float32]:
    """(n, 4) points and signed distances."""
    return np.concatenate([2.0 * points.points, -2.0 * points.distance[:, None]], axis=1)


def _finish(data: DataSet, target: Target) -> None:
    for split in data.splits:
        paths = [_path(row) for row in data.split(split)]
        target.write(f"{file_name(split)}.json", json.dumps(paths, indent=1).encode() + b"\n")


FORMAT = Format(
    "Dora and others with set latents: surface, sharp edges, signed distances",
    of_instances,
    _write,
    _finish,
)
