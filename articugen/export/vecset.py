"""Samples for Dora's autoencoder of sets of latents, so that its loader takes them as configured.

<split>/<object>_<state>.npz in coordinates from -1 to 1, and lists of paths, <split>.json: surface
points and points on sharp edges, each with normals; points near the surface, then points in all of
the cube, with signed distances, above 0 inside as its library has it; and those near edges.
"""

import numpy as np
from numpy.typing import NDArray

from articugen.export.formats import Format
from articugen.export.items import Item, LeftOut, file_name, instance_name, of_instances
from articugen.export.target import Files, Target
from articugen.store.dataset import DataSet
from articugen.store.rows import Row, RowQueries, RowSurface

_FIELDS = ("sharp_points", "near_distance")

_NEAR, _FAR, _EDGES = 400_000, 10_000, 21_384
"""Its loader takes the first 400,000 of `rand_points` for those near the surface, whatever they
are, and draws 10,000 of them, 10,000 of the others and 21,384 of those near edges, none twice."""


def _write(item: Item, target: Files) -> None:
    (row,) = item.rows
    missing = [name for name in _FIELDS if name not in row.fields]
    if missing:
        raise LeftOut(
            f"{row.object_id}: {missing[0]} is not stored; make the data with "
            "sampling.sharp_points, sampling.near_sharp and sampling.signed_distance"
        )
    edges = round(item.rows.recipe.sampling.near_sharp * len(row.near))
    if not 0 < edges < len(row.near) or not len(row.uniform):
        raise LeftOut(
            f"{row.object_id}: points near edges, near the surface and in all of the cube are "
            "needed; make the data with sampling.near_sharp between 0 and 1 and uniform_points"
        )
    near, far = _queries(row.near), _queries(row.uniform)
    near, sharp = near[:-edges], near[-edges:]
    arrays = {
        "fps_coarse_surface": _surface(row.surface),
        "fps_sharp_surface": _surface(row.sharp),
        "rand_points": np.concatenate([_repeated(near, _NEAR)[:_NEAR], _repeated(far, _FAR)]),
        "sharp_near_surface": _repeated(sharp, _EDGES),
    }
    target.write_arrays(_path(row), arrays)


def _repeated(points: NDArray[np.float32], least: int) -> NDArray[np.float32]:
    """Return the points (n, 4), over and over where they are fewer than `least`."""
    return np.resize(points, (max(len(points), least), points.shape[1]))


def _path(row: Row) -> str:
    return f"{file_name(row.split)}/{instance_name(row)}.npz"


def _surface(points: RowSurface) -> NDArray[np.float32]:
    """Return (n, 1, 6) points and normals."""
    return np.concatenate([2.0 * points.points, points.normals], axis=1, dtype=np.float32)[:, None]


def _queries(points: RowQueries) -> NDArray[np.float32]:
    """Return (n, 4) points and signed distances."""
    return np.concatenate([2.0 * points.points, -2.0 * points.distance[:, None]], axis=1)


def _finish(data: DataSet, target: Target) -> None:
    lists = {name: [_path(row) for row in data.split(name)] for name in data.splits}
    train = lists.get("train", [])
    lists.setdefault("val", train[: -(-len(train) // 10)])  # a part of train, while that runs
    for split, paths in lists.items():
        if paths:
            target.write_json(f"{file_name(split)}.json", paths)


FORMAT = Format(
    "Dora, autoencoders of set latents: surface, sharp edges, signed distances",
    of_instances,
    _write,
    _finish,
)
