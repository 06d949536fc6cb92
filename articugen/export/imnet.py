"""IM-NET's layout, which BSP-NET reads as well: one HDF5 a split, and the names in a text file.

Their points are lattice numbers p of a 256^3 grid, x = (p + 0.5) / 256 - 0.5, as bytes; ours are
the same numbers as float32, which their loaders cast to anyway, so that every point lies where its
label was asked. At 16^3 a point a cell, an inside one where there is any; at 32^3 and 64^3 points
near the surface, and uniform ones.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bools, Ints
from articugen.core.geometry import voxel_centres
from articugen.core.seeding import generator
from articugen.export.formats import Format
from articugen.export.hdf5 import stack
from articugen.export.items import Item, file_name, instance_name, of_splits
from articugen.export.labels import grid, inside, need
from articugen.export.target import Files
from articugen.store.rows import Row

_COARSE, _FINE = 16, 64
_NEAR, _EACH = 4096, 8192


def _write(item: Item, target: Files) -> None:
    row = item.rows[0]
    name = f"{file_name(row.category)}_{item.key}"
    with target.opened(f"{name}.hdf5") as file:
        stack(file, len(item.rows), _rows(item, target))
    target.write_lines(f"{name}.txt", map(instance_name, item.rows))


def _rows(item: Item, target: Files) -> Iterator[dict[str, NDArray]]:
    for row in item.rows:
        need(row, "uniform", _EACH)
        need(row, "near", _EACH)
        voxels = inside(grid(row, _FINE), target.options)
        points = np.concatenate([row.near.points[:_EACH], row.uniform.points[:_EACH]])
        label = np.concatenate([row.near.label[:_EACH], row.uniform.label[:_EACH]])
        values = inside(label, target.options).astype(np.uint8)[:, None]
        coarse = _one_a_cell(row, voxels)
        yield {
            "voxels": voxels.astype(np.uint8)[..., None],
            "points_16": _lattice(voxel_centres(_FINE, coarse)),
            "values_16": voxels.ravel()[coarse].astype(np.uint8)[:, None],
            "points_32": _lattice(points[:_NEAR]),
            "values_32": values[:_NEAR],
            "points_64": _lattice(points),
            "values_64": values,
        }


def _one_a_cell(row: Row, voxels: Bools) -> Ints:
    """Return (4096,) a voxel in each cell of the 16^3 grid: a random inside one, else a random
    one."""
    k = _FINE // _COARSE
    number = np.arange(_FINE**3).reshape((_COARSE, k) * 3).transpose(0, 2, 4, 1, 3, 5)
    cells = number.reshape(_COARSE**3, k**3)
    rng = generator(0, row.object_id, row.state_index, "imnet")
    chance = rng.random(cells.shape) + voxels.ravel()[cells]
    return np.take_along_axis(cells, chance.argmax(axis=1)[:, None], 1)[:, 0]


def _lattice(points: NDArray[np.floating]) -> NDArray[np.float32]:
    return ((np.asarray(points, np.float64) + 0.5) * 256.0 - 0.5).astype(np.float32)


FORMAT = Format(
    "IM-NET, BSP-NET: one HDF5 a split with voxels and points of three resolutions",
    of_splits,
    _write,
    takes=("occupancy",),
)
