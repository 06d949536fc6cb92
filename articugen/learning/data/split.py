"""Shards as training data: a whole split packed in memory, batches unpacked from it by index.

Coordinates stay 16-bit and labels 8-bit until a batch is made, on whatever device they lie; no
worker process is needed, and a batch depends on nothing but its generator and indices.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from articugen.core.errors import CorruptShard, UnfitData
from articugen.core.records import ENCLOSED, FREE
from articugen.learning.data.batch import Batch, BatchSpec
from articugen.learning.data.cells import (
    LabelledCells,
    cells_of,
    finest_grid,
    uniform,
    voxel_centres,
)
from articugen.learning.data.fitness import check_fixed_part, check_shard
from articugen.learning.data.groups import found_objects
from articugen.learning.tensors import changed
from articugen.store.manifest import Manifest
from articugen.store.shards import Shard, open_shard

VALIDATED = 64
"""Instances of objects that are held out by which a learner is validated, at most."""

JOINTS = ("kind", "state", "axis", "pivot")
"""The fields of joints that are packed for a learner which asks for motions."""

FEW = 4
"""Where at most one in this many stored points is taken, one comes from each of equal stretches."""


@dataclass(frozen=True, eq=False)
class PackedSplit:
    """Instances of some objects, as they are stored. I instances; 16-bit patterns lie in int16.

    Attributes:
        object_id: (I,) names; of groups that were found, that of the object of the first instance.
        state_index: (I,) 0 is the canonical pose.
        surface: (I, S, 3).
        part: (I, S) the parts of the surface points; (I, 0) unless asked for.
        normals: (I, S, 3) int8 normals of the surface points, 127 times; (I, 0, 3) likewise. No
            batch holds them.
        grids: (I, R^3) labels by resolution, above 0 where the recipe calls it occupied.
        uniform, near: ((I, K, 3) coordinates, (I, K) such labels).
        band, varying: voxels around this pose's material, and those that differ between poses.
        partial: (I, C, M, 3) what each of C depth cameras sees; C = 0 unless asked for.
        motion: (I, P, 4, 4) float32 of each part from the canonical pose; (I, 0, 4, 4) unless asked
            for. P parts of the object with most, zeros where another has no such part.
        joints: as `Batch.joints`, of all instances.
    """

    object_id: NDArray[Any]
    state_index: NDArray[np.uint32]
    surface: Tensor
    part: Tensor
    normals: Tensor
    grids: dict[int, Tensor]
    uniform: tuple[Tensor, Tensor]
    near: tuple[Tensor, Tensor]
    band: LabelledCells
    varying: LabelledCells
    partial: Tensor
    motion: Tensor
    joints: dict[str, Tensor]

    def __len__(self) -> int:
        return len(self.object_id)

    def poses_of(self, name: str) -> NDArray[np.intp]:
        """Return the rows of an object, by their state: its canonical pose, where it is there,
        comes first."""
        rows = np.flatnonzero(self.object_id == name)
        return rows[np.argsort(self.state_index[rows], kind="stable")]

    def evenly(self) -> NDArray[np.intp]:
        """Return the rows of at most `VALIDATED` instances, from the first to the last."""
        return np.linspace(0, len(self) - 1, min(VALIDATED, len(self))).astype(int)

    def of(self, objects: Iterable[str]) -> "PackedSplit":
        """Return the instances of these objects alone."""
        rows = np.flatnonzero(np.isin(self.object_id, list(objects)))
        at = torch.from_numpy(rows)
        some = changed(self, Tensor, lambda tensor: tensor[at])
        return replace(some, object_id=self.object_id[rows], state_index=self.state_index[rows])

    def for_batches(self, spec: BatchSpec) -> "PackedSplit":
        """Without what such batches do not hold, and `Learner.begin` alone examines."""
        normals = self.normals if spec.sides else self.normals[:, :0].clone()
        return replace(self, normals=normals)

    def to(self, device: torch.device) -> "PackedSplit":
        """Return the same in the memory of a device."""
        return changed(self, Tensor, lambda tensor: tensor.to(device))

    def batch(
        self, rows: Sequence[int], spec: BatchSpec, resolution: int, rng: torch.Generator | None
    ) -> Batch:
        """Return a batch of the instances `rows`; points are drawn without replacement, but for
        `band` and `varying`.

        Args:
            resolution: of the grid that `grid_points` are drawn from.
            rng: of the device that the split lies on; None for torch's own.
        """
        at, device = torch.tensor(rows), self.surface.device
        if device.type == "cuda":  # which is not waited for so
            at = at.pin_memory()
        at = at.to(device, non_blocking=True)
        column = at[:, None]
        cloud, drawn = self._clouds(at, spec, rng)
        part = self.part[column, drawn] if self.part.shape[1] else self.part[at]
        points: list[Tensor] = []
        occupied: list[Tensor] = []
        if spec.grid_points:
            grid = self.grids[resolution]
            where = _places(at, grid.shape[1], spec.grid_points, rng)
            points.append(voxel_centres(where, resolution))
            occupied.append(grid[column, where] > 0)
        for wanted, (stored, label) in (
            (spec.uniform_points, self.uniform),
            (spec.near_points, self.near),
        ):
            where = _places(at, stored.shape[1], wanted, rng)
            points.append(unpacked(stored[column, where]))
            occupied.append(label[column, where] > 0)
        for wanted, some in ((spec.band_points, self.band), (spec.varying_points, self.varying)):
            if wanted:
                centres, inside = some.draw(at, wanted, rng)
                points.append(centres)
                occupied.append(inside)
        spread = spec.grid_points + spec.uniform_points
        chance = uniform(rng, len(at), spec.chances, at.device)
        cloud, whole = unpacked(cloud), not spec.partial
        return Batch(
            at, cloud, part, torch.cat(points, 1), torch.cat(occupied, 1), spread, chance,
            at_rest(cloud, part, self.motion[at]) if spec.motions and whole else None,
            {name: values[at] for name, values in self.joints.items()},
            self.normals[column, drawn].float() / 127.0 if spec.sides and whole else None,
        )  # fmt: skip

    def _clouds(
        self, at: Tensor, spec: BatchSpec, rng: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """Return the stored clouds (B, n, 3) of some instances, and the places of their points (B,
        n)."""
        if spec.partial:
            B, cameras = len(at), self.partial.shape[1]
            camera = torch.randint(cameras, (B,), generator=rng, device=at.device)
            partial = self.partial[at, camera]
            return partial, torch.arange(partial.shape[1], device=at.device).expand(B, -1)
        where = _places(at, self.surface.shape[1], spec.surface_points, rng)
        return self.surface[at[:, None], where], where


def at_rest(points: Tensor, part: Tensor, motion: Tensor) -> Tensor:
    """Return (B, n, 3) points of parts (B, n) in the canonical pose; `motion` (B, P, 4, 4) is how
    each part has moved since."""
    T = motion[torch.arange(len(part), device=part.device)[:, None], part.long()]
    return ((points - T[..., :3, 3])[..., None, :] @ T[..., :3, :3])[..., 0, :]


def _places(at: Tensor, n: int, count: int, rng: torch.Generator | None) -> Tensor:
    """Return (B, count) which `count` of n stored points, drawn again for each row.

    All n of them stay in order: nothing that uses a batch depends on the order of its points. Of
    few each comes from a stretch of its own, on a ring that is turned at random: no number is drawn
    for a point that is not taken.
    """
    if count in (0, n):
        return torch.arange(count, device=at.device).expand(len(at), count)
    if count * FEW > n:
        order = uniform(rng, len(at), n, at.device)
        return order.topk(count, dim=1, sorted=False).indices
    begin = torch.arange(count, device=at.device) * n // count
    width = torch.arange(1, count + 1, device=at.device) * n // count - begin
    share = uniform(rng, len(at), count, at.device)
    turn = torch.randint(n, (len(at), 1), generator=rng, device=at.device)
    return (begin + (share * width).long() + turn) % n


def unpacked(stored: Tensor) -> Tensor:
    """16-bit fixed point to the unit frame: x = stored / 65535 - 0.5."""
    return (stored.int() & 0xFFFF).float() / 65535.0 - 0.5


Folders = Path | tuple[Path, ...]
"""Of a data set with its manifest, or of several that are learned from together."""


def folders_of(data: Folders) -> tuple[Path, ...]:
    return data if isinstance(data, tuple) else (data,)


def load_split(
    data: Folders,
    split: str,
    spec: BatchSpec,
    resolutions: Iterable[int],
    *,
    category: str | None = None,
) -> PackedSplit:
    """Pack a split of a data set, or of several as if they were one.

    Args:
        data: the folder, or folders, of data sets of one category.
        spec: what batches must hold; more is not read.
        resolutions: of the grids wanted.
        category: what the data set must be of.

    Raises:
        CorruptShard: no such data set, or a damaged one.
        UnfitData: no such split, another category, too few points, no such grid, no
            clouds of depth cameras, no joint, more joints than the learner can hold, poses of an
            object that share no frame or, where poses are compared, an object that has but one; an
            object that two of the data sets have, or grids and points of other sizes in one.
    """
    folders = folders_of(data)
    manifests = [Manifest.read(folder) for folder in folders]
    _check_apart(folders, manifests)
    shards: list[Callable[[], Shard]] = []
    for folder, manifest in zip(folders, manifests, strict=True):
        names, about = _shards_of(folder, manifest, split, category)
        category = about["category"]
        shards += [partial(_opened, folder / name, about) for name in names]
    return packed(shards, spec, resolutions, ", ".join(map(str, folders)))


def packed(
    shards: Sequence[Callable[[], Shard]], spec: BatchSpec, resolutions: Iterable[int], where: str
) -> PackedSplit:
    """Pack all instances of shards, each of which is opened when it is read; `where` they are is
    named in errors, which are those of `load_split`."""
    wanted = sorted(set(resolutions))
    is_fine = spec.band_points or spec.varying_points
    finest = finest_grid(shards[0]) if is_fine else 0
    objects = found_objects(shards, where) if spec.finds_objects else [None] * len(shards)
    read = [
        _read(opened, spec, wanted, finest, names)
        for opened, names in zip(shards, objects, strict=True)
    ]
    # what is joined is let go: there is never much more than all of it at a time
    try:
        joined = {name: _joined(name, [s.pop(name) for s in read]) for name in list(read[0])}
    except ValueError:
        raise UnfitData(
            f"{where}: shards of different shapes; make them again, all by one recipe"
        ) from None
    grids = {int(n.rpartition("_")[2]): n for n in joined if n.startswith("occupancy_")}
    return PackedSplit(
        joined["object_id"],
        joined["state_index"],
        _tensor(joined["surface_points"]),
        _tensor(joined["surface_part"]),
        _tensor(joined["surface_normals"]),
        {r: _tensor(joined[name]).flatten(1) for r, name in grids.items()},
        (_tensor(joined["uniform_points"]), _tensor(joined["uniform_label"])),
        (_tensor(joined["near_points"]), _tensor(joined["near_label"])),
        LabelledCells(finest, _tensor(joined["band"]), _tensor(joined["band_count"])),
        LabelledCells(finest, _tensor(joined["varying"]), _tensor(joined["varying_count"])),
        _tensor(joined["partial_points"]),
        _tensor(joined["part_motion"]),
        {name: _tensor(joined[f"joint_{name}"]) for name in JOINTS if spec.motions},
    )


def _joined(name: str, arrays: list[NDArray[Any]]) -> NDArray[Any]:
    """Return one array of those of all shards; objects have parts and joints in any number."""
    if name == "part_motion" or name.startswith("joint_"):
        most = max(array.shape[1] for array in arrays)
        beyond = [((0, 0), (0, most - a.shape[1]), *((0, 0),) * (a.ndim - 2)) for a in arrays]
        arrays = [np.pad(array, more) for array, more in zip(arrays, beyond, strict=True)]
    return np.concatenate(arrays)


def _shards_of(
    folder: Path, manifest: Manifest, split: str, category: str | None
) -> tuple[list[str], dict[str, str]]:
    """Return the names of the shards of a split, and what each must say of itself."""
    if category is not None and manifest.category != category:
        raise UnfitData(f"{folder}: holds {manifest.category}, not {category}")
    names = sorted({o.shard for o in manifest.objects if o.key.split == split})
    if not names:
        have = sorted({o.key.split for o in manifest.objects})
        raise UnfitData(f"{folder}: has no object in split {split!r}, only in: {', '.join(have)}")
    return names, {"split": split, "category": manifest.category}


def _check_apart(folders: Sequence[Path], manifests: Sequence[Manifest]) -> None:
    """No object is in two data sets: both would be taken for one, or what one is tested on would be
    learned from the other."""
    where: dict[str, Path] = {}
    for folder, manifest in zip(folders, manifests, strict=True):
        for entry in manifest.objects:
            name = entry.key.object_id
            if where.setdefault(name, folder) is not folder:
                raise UnfitData(
                    f"{folder}: has an object {name}, as {where[name]} has; leave it out of one, "
                    "with --exclude"
                )


def _opened(path: Path, about: dict[str, str]) -> Shard:
    """Return a shard that says of itself what it must."""
    shard = open_shard(path)
    for name, should in about.items():
        if shard.attributes[name] != should:
            raise CorruptShard(
                f"{path}: is of {name} {shard.attributes[name]!r}, the manifest says {should!r}"
            )
    return shard


def _read(
    opened: Callable[[], Shard],
    spec: BatchSpec,
    resolutions: list[int],
    finest: int,
    objects: NDArray[Any] | None,
) -> dict[str, NDArray[Any]]:
    """Return what is packed of a shard, by name; `finest` is the grid that cells are chosen from,
    or 0; `objects` are what its instances show, as it was found."""
    with opened() as shard:
        every = sorted({*resolutions, finest} - {0})
        check_shard(shard, spec, every)
        row = {name: shard.read(name) for name in ("state_index", "surface_points")}
        wanted = {
            "surface_part": (spec.parts or spec.motions) and not spec.partial,
            "surface_normals": spec.normals or spec.sides,
            "uniform_points": spec.uniform_points,
            "uniform_label": spec.uniform_points,
            "near_points": spec.near_points,
            "near_label": spec.near_points,
            "partial_points": spec.partial,
            "part_motion": spec.motions,
            **{f"joint_{name}": spec.motions for name in JOINTS},
        }
        row |= {name: shard.read(name) if w else _none(shard, name) for name, w in wanted.items()}
        for name in ("uniform_label", "near_label"):
            row[name] = _told(row[name], spec)
        ids = np.array(shard.object_ids())
        names = ids if objects is None else objects
        grids = {r: _grid(shard, r, ids, row["surface_points"], spec) for r in every}
        row |= {f"occupancy_{r}": grids[r] for r in resolutions}
        chosen = cells_of(names, row["state_index"], grids.get(finest), spec, shard.path)
        return {"object_id": names, **row, **chosen}


def _told(label: NDArray[np.uint8], spec: BatchSpec) -> NDArray[np.uint8]:
    """Return the labels, free where the recipe does not call it occupied."""
    return np.where(label == ENCLOSED, FREE, label) if spec.occupancy == "material" else label


def _grid(
    shard: Shard, resolution: int, names: NDArray[Any], surface: NDArray[np.uint16], spec: BatchSpec
) -> NDArray[np.uint8]:
    """Return (n, R, R, R) such labels. Where no voxel's centre is occupied, those are that the
    surface (n, S, 3), in fixed point, passes through: thin parts can lie between all centres of a
    coarse grid, and a grid that says "nothing is here" would teach just that."""
    grid = shard.read(f"occupancy_{resolution}")
    check_fixed_part(shard, names, grid)
    grid = _told(grid, spec)
    for row in np.flatnonzero(~grid.any(axis=(1, 2, 3))):
        x, y, z = (surface[row].astype(np.int64) * resolution // 65536).T
        grid[row, x, y, z] = 1
    return grid


def _none(shard: Shard, name: str) -> NDArray[Any]:
    """Return a field without any of its points."""
    shape = shard.fields[name]
    dtype = {"points": np.uint16, "normals": np.int8}.get(name.rpartition("_")[2], np.uint8)
    return np.zeros((shape[0], 0, *shape[2:]), dtype)


def _tensor(array: NDArray[Any]) -> Tensor:
    """Return a tensor: of uint16 the bits as int16, for which torch has more functions, and of
    double precision the nearest float32."""
    array = array.astype(np.float32) if array.dtype == np.float64 else array
    return torch.from_numpy(array.view(np.int16) if array.dtype == np.uint16 else array)
