"""Query points where they are most informative: voxels of a fine grid, as many of an instance as
are kept.

Two kinds: `varying`, whose label differs between the poses of one object, and those in the `band`
around the material of one pose. Free and occupied ones are kept apart, so that a batch can hold as
many of each, however few there are; that a moving part fills one voxel in a thousand matters no
more.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from articugen.core.arrays import Bools
from articugen.core.errors import UnfitData
from articugen.core.seeding import generator
from articugen.discovery.clouds import widened
from articugen.learning.data.batch import BatchSpec
from articugen.learning.data.fitness import check_varies
from articugen.store.shards import Shard

KEPT = 2048
"""Free and occupied cells that are kept of an instance, each: together 16 KiB."""

FINEST = 64
"""The resolution of the grid that they are of, or the finest one below that a data set has."""

REACH = 3
"""How far the band reaches, in cells along each axis: 0.047 of the unit frame's edge at 64^3."""


@dataclass(frozen=True, eq=False)
class LabelledCells:
    """Free and occupied voxels of I instances, on whatever device they lie.

    Attributes:
        resolution: of the grid [x, y, z].
        index: (I, 2, K) int32, flat; [:, 0] are free, [:, 1] occupied. K = 0 where unasked for.
        count: (I, 2) int32, how many of each count, at most K; what follows says nothing.
    """

    resolution: int
    index: Tensor
    count: Tensor

    def draw(self, at: Tensor, count: int, rng: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """Voxels' centres (B, count, 3) of the instances `at` (B,), and whether each is occupied.

        Every second one is occupied; all are of one label where an instance has none of the other.
        Each is drawn by itself, so that rare ones come several times.
        """
        at = at[:, None]
        label = (torch.arange(count, device=at.device) % 2).expand(len(at), count)
        label = torch.where(self.count[at, label] > 0, label, 1 - label)
        share = uniform(rng, len(at), count, at.device)
        place = (share * self.count[at, label]).long()
        return voxel_centres(self.index[at, label, place], self.resolution), label > 0


def uniform(rng: torch.Generator | None, rows: int, count: int, device: torch.device) -> Tensor:
    """Return (rows, count) numbers in [0, 1)."""
    return torch.rand(rows, count, generator=rng, device=device)


def voxel_centres(index: Tensor, resolution: int) -> Tensor:
    """Return (..., 3) the centres of voxels from flat indices (...) of a grid [x, y, z]."""
    x = index // (resolution * resolution)
    at = torch.stack([x, index // resolution % resolution, index % resolution], -1)
    return (at + 0.5) / resolution - 0.5


def pack(
    kind: str,
    chosen: Iterable[Bools],
    occupied: Bools,
    names: NDArray[Any],
    states: NDArray[np.integer],
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return `LabelledCells.index` and `count`: at most `KEPT` of each label, chosen at random.

    Args:
        kind: `band` or `varying`. Which cells are kept depends on it, names and states alone.
        chosen: for each instance a mask (R, R, R).
        occupied: (N, R, R, R).
        names, states: (N,) the objects, and which pose of it each is.
    """
    index, count = np.zeros((len(names), 2, KEPT), np.int32), np.zeros((len(names), 2), np.int32)
    for i, (mask, inside) in enumerate(zip(chosen, occupied, strict=True)):
        rng = generator(0, kind, str(names[i]), int(states[i]))
        for label, of_label in enumerate((mask & ~inside, mask & inside)):
            cells = np.flatnonzero(of_label)
            if len(cells) > KEPT:
                cells = rng.choice(cells, KEPT, replace=False, shuffle=False)
            index[i, label, : len(cells)] = cells
            count[i, label] = len(cells)
    return index, count


def differing(occupied: Bools, names: NDArray[Any]) -> list[Bools]:
    """Return for each instance which cells (N, R, R, R) are not the same in all poses of its
    object."""
    of = {}
    for name in dict.fromkeys(names.tolist()):
        poses = occupied[names == name]
        of[name] = poses.any(axis=0) & ~poses.all(axis=0)
    return [of[name] for name in names.tolist()]


def band(inside: Bools) -> Bools:
    """Return which cells (R, R, R) have both labels within `REACH` cells along each axis."""
    both = _packed_near(inside) & _packed_near(~inside)
    return np.unpackbits(both, axis=2, count=inside.shape[2]).view(np.bool_)


def _packed_near(mask: Bools) -> NDArray[np.uint8]:
    """Return the cells within `REACH` cells, along each axis, of one that is set: eight a byte
    along z."""
    apart = np.pad(mask, ((0, 0), (0, 0), (0, REACH)))  # one line of cells: long moves are fast
    along = widened(apart.ravel(), REACH, (0,)).reshape(apart.shape)
    return widened(np.packbits(along[..., : mask.shape[2]], axis=2), REACH, (0, 1))


def cells_of(
    names: NDArray[Any],
    states: NDArray[np.uint32],
    grid: NDArray[np.uint8] | None,
    spec: BatchSpec,
    path: Any,
) -> dict[str, NDArray[Any]]:
    """Return the cells that query points are drawn at, as `LabelledCells` holds them."""
    row: dict[str, NDArray[Any]] = {}
    for kind, wanted in (("band", spec.band_points), ("varying", spec.varying_points)):
        row[kind] = np.zeros((len(names), 2, 0), np.int32)
        row[f"{kind}_count"] = np.zeros((len(names), 2), np.int32)
        if grid is not None and wanted:
            occupied = grid > 0
            if kind == "band":
                chosen = [band(inside) for inside in occupied]
            elif spec.finds_objects:  # an object may have been found once
                around = zip(differing(occupied, names), map(band, occupied), strict=True)
                chosen = [mask if mask.any() else band for mask, band in around]
            else:
                chosen = differing(occupied, names)
                check_varies(path, names, chosen)
            row[kind], row[f"{kind}_count"] = pack(kind, chosen, occupied, names, states)
    return row


def finest_grid(opened: Callable[[], Shard]) -> int:
    """Return the resolution of the grid that cells are chosen from."""
    with opened() as shard:
        grids = [int(n.rpartition("_")[2]) for n in shard.fields if n.startswith("occupancy_")]
    fit = [resolution for resolution in grids if resolution <= FINEST]
    if not fit:
        raise UnfitData(
            f"{shard.path}: has no grid of {FINEST} or less, which data.band_points and "
            f"varying_points need; add {FINEST} to sampling.grids and make the data set again"
        )
    return max(fit)
