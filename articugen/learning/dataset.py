"""Shards as training data: a whole split packed in memory, batches unpacked from it by index.

Coordinates stay 16-bit and labels 8-bit until a batch is made, on whatever device they lie; no
worker process is needed, and a batch depends on nothing but its generator and indices.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from articugen.errors import CorruptShard
from articugen.learning import processes
from articugen.learning.recipe import DataSettings
from articugen.records import FREE, is_material
from articugen.store.manifest import Manifest
from articugen.store.shards import Shard, open_shard

Chance = torch.Generator | Sequence[torch.Generator] | None
"""Where a batch's random numbers come from."""


@dataclass(frozen=True)
class BatchSpec:
    """What a learner must be given; nothing else is read or unpacked.

    Attributes:
        surface_points, grid_points, uniform_points, near_points, occupancy: as `DataSettings`.
        grids: resolutions of grids that `Learner.validate` reads, besides those of the stages.
        parts: whether the true parts of surface points are wanted.
        partial: whether clouds are what one depth camera sees, another one each time.
        joints: (revolute, prismatic) joints an object may have at most; None is any number.
    """

    surface_points: int
    grid_points: int = 0
    uniform_points: int = 0
    near_points: int = 0
    occupancy: str = "visible"
    grids: tuple[int, ...] = ()
    parts: bool = False
    partial: bool = False
    joints: tuple[int, int] | None = None

    @staticmethod
    def of(data: DataSettings, **more: Any) -> "BatchSpec":
        """What a recipe says, and more."""
        return BatchSpec(**data.model_dump(exclude={"validation_objects"}), **more)


@dataclass(frozen=True)
class Batch:
    """B samples in the unit frame.

    Attributes:
        rows: (B,) which instances of the split they are.
        cloud: (B, n, 3) surface points, or what a depth camera sees.
        part: (B, n) the cloud's true parts where they were asked for, else (B, 0).
        points: (B, m, 3) query points.
        occupied: (B, m) bool, their indicator values.
        spread: the first so many query points are spread evenly over the cube, the others lie near
            the surface.
    """

    rows: Tensor
    cloud: Tensor
    part: Tensor
    points: Tensor
    occupied: Tensor
    spread: int

    def share(self) -> "Batch":
        """What this process takes of it; all of it where there is one."""
        of = processes.share
        return Batch(
            of(self.rows), of(self.cloud), of(self.part), of(self.points), of(self.occupied),
            self.spread,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class PackedSplit:
    """Instances of some objects, as they are stored. I instances; 16-bit patterns lie in int16.

    Attributes:
        object_id: (I,) names.
        state_index: (I,) 0 is the canonical pose.
        surface: (I, S, 3).
        part: (I, S) the parts of the surface points; (I, 0) unless asked for.
        grids: (I, R^3) labels by resolution, above 0 where the recipe calls it occupied.
        uniform, near: ((I, K, 3) coordinates, (I, K) such labels).
        partial: (I, C, M, 3) what each of C depth cameras sees; C = 0 unless asked for.
    """

    object_id: NDArray[Any]
    state_index: NDArray[np.uint32]
    surface: Tensor
    part: Tensor
    grids: dict[int, Tensor]
    uniform: tuple[Tensor, Tensor]
    near: tuple[Tensor, Tensor]
    partial: Tensor

    def __len__(self) -> int:
        return len(self.object_id)

    @property
    def bytes(self) -> int:
        """What the tensors take."""
        tensors = (self.surface, self.part, *self.grids.values(), *self.uniform, *self.near)
        return sum(t.numel() * t.element_size() for t in (*tensors, self.partial))

    def of(self, objects: Iterable[str]) -> "PackedSplit":
        """The instances of these objects alone."""
        rows = np.flatnonzero(np.isin(self.object_id, list(objects)))
        at = torch.from_numpy(rows)
        some = self._with(lambda tensor: tensor[at])
        return replace(some, object_id=self.object_id[rows], state_index=self.state_index[rows])

    def to(self, device: torch.device) -> "PackedSplit":
        """The same in the memory of a device."""
        return self._with(lambda tensor: tensor.to(device))

    def _with(self, change: Callable[[Tensor], Tensor]) -> "PackedSplit":
        return replace(
            self,
            surface=change(self.surface),
            part=change(self.part),
            grids={resolution: change(grid) for resolution, grid in self.grids.items()},
            uniform=(change(self.uniform[0]), change(self.uniform[1])),
            near=(change(self.near[0]), change(self.near[1])),
            partial=change(self.partial),
        )

    def batch(self, rows: Sequence[int], spec: BatchSpec, resolution: int, rng: Chance) -> Batch:
        """A batch of the instances `rows`; points are drawn without replacement.

        Args:
            resolution: of the grid that `grid_points` are drawn from.
            rng: of the device that the split lies on; None for torch's own. Several draw for an
                equal share of the rows each, what each would draw for a batch of its share.
        """
        at = index_on(self.surface.device, rows)
        cloud, where = self._clouds(at, spec, rng)
        part = self.part[at].gather(1, where) if spec.parts else self.part[at]
        points: list[Tensor] = []
        labels: list[Tensor] = []
        if spec.grid_points:
            grid, where = _some(self.grids[resolution][at], spec.grid_points, rng)
            points.append(voxel_centres(where, resolution))
            labels.append(grid)
        for wanted, (stored, label) in (
            (spec.uniform_points, self.uniform),
            (spec.near_points, self.near),
        ):
            some, where = _some(stored[at], wanted, rng)
            points.append(unpacked(some))
            labels.append(label[at].gather(1, where))
        spread = spec.grid_points + spec.uniform_points
        occupied = torch.cat(labels, 1) > 0
        return Batch(at, unpacked(cloud), part, torch.cat(points, 1), occupied, spread)

    def _clouds(self, at: Tensor, spec: BatchSpec, rng: Chance) -> tuple[Tensor, Tensor]:
        """The stored clouds (B, n, 3) of some instances, and the places of their points (B, n)."""
        if spec.partial:
            B, cameras = len(at), self.partial.shape[1]
            camera = drawn(
                rng, B, lambda g, n: torch.randint(cameras, (n,), generator=g, device=at.device)
            )
            seen = self.partial[at, camera]
            return seen, torch.arange(seen.shape[1], device=at.device).expand(B, -1)
        return _some(self.surface[at], spec.surface_points, rng)


def index_on(device: torch.device, rows: Sequence[int]) -> Tensor:
    """The numbers of rows as a tensor; no GPU is waited for."""
    at = torch.tensor(rows)
    return at.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else at.to(device)


def drawn(rng: Chance, rows: int, draw: Callable[[torch.Generator | None, int], Tensor]) -> Tensor:
    """What `draw` gives for some rows: by each of several generators for its share of them."""
    if rng is None or isinstance(rng, torch.Generator):
        return draw(rng, rows)
    return torch.cat([draw(each, rows // len(rng)) for each in rng])


def _some(rows: Tensor, count: int, rng: Chance) -> tuple[Tensor, Tensor]:
    """`count` entries along axis 1 of (B, n, ...), drawn anew for each row, and their places.

    All n of them stay in order: nothing that uses a batch depends on the order of its points.
    """
    B, n = rows.shape[:2]
    if count in (0, n):
        return rows[:, :count], torch.arange(count, device=rows.device).expand(B, count)
    order = drawn(rng, B, lambda g, b: torch.rand(b, n, generator=g, device=rows.device))
    where = order.topk(count, dim=1, sorted=False).indices
    each = torch.arange(B, device=rows.device)[:, None]
    return rows[each, where], where


def unpacked(stored: Tensor) -> Tensor:
    """16-bit fixed point to the unit frame: x = stored / 65535 - 0.5."""
    return (stored.int() & 0xFFFF).float() / 65535.0 - 0.5


def voxel_centres(index: Tensor, resolution: int) -> Tensor:
    """(..., 3) the centres of voxels from flat indices (...) of a grid [x, y, z]."""
    x = index // (resolution * resolution)
    at = torch.stack([x, index // resolution % resolution, index % resolution], -1)
    return (at + 0.5) / resolution - 0.5


def load_split(
    folder: Path,
    split: str,
    spec: BatchSpec,
    resolutions: Iterable[int],
    *,
    category: str | None = None,
) -> PackedSplit:
    """Pack a split of a data set.

    Args:
        folder: of the data set, with its manifest.
        spec: what batches must hold; more is not read.
        resolutions: of the grids wanted.
        category: what the data set must be of.

    Raises:
        CorruptShard: no such data set or split, another category, too few points, no such grid, no
            clouds of depth cameras, no joint, more joints than the learner can hold.
    """
    manifest = Manifest.read(folder)
    if category is not None and manifest.category != category:
        raise CorruptShard(f"{folder}: holds {manifest.category}, not {category}")
    names = sorted({o.shard for o in manifest.objects if o.key.split == split})
    if not names:
        have = sorted({o.key.split for o in manifest.objects})
        raise CorruptShard(
            f"{folder}: has no object in split {split!r}, only in: {', '.join(have)}"
        )
    about = {"split": split, "category": manifest.category}
    shards = [_read(folder / name, about, spec, sorted(set(resolutions))) for name in names]
    try:
        joined = {name: np.concatenate([shard[name] for shard in shards]) for name in shards[0]}
    except ValueError:
        raise CorruptShard(f"{folder}: shards of different shapes; make them again") from None
    grids = {int(n.rpartition("_")[2]): n for n in joined if n.startswith("occupancy_")}
    for resolution, name in grids.items():
        _fill_empty(joined[name], joined["surface_points"], resolution)
    return PackedSplit(
        joined["object_id"],
        joined["state_index"],
        _tensor(joined["surface_points"]),
        _tensor(joined["surface_part"]),
        {r: _tensor(joined[name]).flatten(1) for r, name in grids.items()},
        (_tensor(joined["uniform_points"]), _tensor(joined["uniform_label"])),
        (_tensor(joined["near_points"]), _tensor(joined["near_label"])),
        _tensor(joined["partial_points"]),
    )


def _read(
    path: Path, about: dict[str, str], spec: BatchSpec, resolutions: list[int]
) -> dict[str, NDArray[Any]]:
    with open_shard(path) as shard:
        for name, should in about.items():
            if shard.attributes[name] != should:
                raise CorruptShard(
                    f"{path}: is of {name} {shard.attributes[name]!r}, the manifest says {should!r}"
                )
        _check(shard, spec, resolutions)
        grids = [f"occupancy_{resolution}" for resolution in resolutions]
        row = {name: shard.read(name) for name in ("state_index", "surface_points", *grids)}
        wanted = {
            "surface_part": spec.parts,
            "uniform_points": spec.uniform_points,
            "uniform_label": spec.uniform_points,
            "near_points": spec.near_points,
            "near_label": spec.near_points,
            "partial_points": spec.partial,
        }
        row |= {name: shard.read(name) if w else _none(shard, name) for name, w in wanted.items()}
        if spec.occupancy == "material":
            for name, array in row.items():
                if name.endswith("_label") or name.startswith("occupancy_"):
                    row[name] = np.where(is_material(array), array, FREE)
        return {"object_id": np.array(shard.object_ids()), **row}


def _none(shard: Shard, name: str) -> NDArray[Any]:
    """A field without any of its points."""
    shape = shard.fields[name]
    dtype = np.uint16 if name.endswith("_points") else np.uint8
    return np.zeros((shape[0], 0, *shape[2:]), dtype)


def _check(shard: Shard, spec: BatchSpec, resolutions: list[int]) -> None:
    """Raise CorruptShard where something is not there that the learner must be given."""
    path = shard.path
    _check_joints(shard, spec.joints)
    if spec.partial and 0 in shard.fields["partial_points"]:
        raise CorruptShard(
            f"{path}: has no partial clouds; set sampling.partial_views and make the data set again"
        )
    for name in ("surface_points", "uniform_points", "near_points"):
        have, count = shard.fields[name][1], getattr(spec, name)
        if have < count:
            raise CorruptShard(
                f"{path}: has {have} {name} an instance, the recipe asks for {count}; "
                "make the data set with more, or lower data in the training recipe"
            )
    for resolution in resolutions:
        if f"occupancy_{resolution}" not in shard.fields:
            raise CorruptShard(
                f"{path}: has no occupancy_{resolution}; add {resolution} to sampling.grids and "
                "make the data set again"
            )


def _fill_empty(grid: NDArray[np.uint8], surface: NDArray[np.uint16], resolution: int) -> None:
    """Where no voxel's centre is occupied, those are that the surface passes through.

    Thin parts can lie between all centres of a coarse grid, and a grid that says "nothing is here"
    would teach just that.

    Args:
        grid: (I, R, R, R) labels, changed in place.
        surface: (I, S, 3) in fixed point.
    """
    for row in np.flatnonzero(~grid.any(axis=(1, 2, 3))):
        x, y, z = (surface[row].astype(np.int64) * resolution // 65536).T
        grid[row, x, y, z] = 1


def _check_joints(shard: Shard, joints: tuple[int, int] | None) -> None:
    if joints is None:
        return
    kind = shard.read("joint_kind")
    if not kind.size:
        raise CorruptShard(f"{shard.path}: has no joint; what never moves teaches no parts")
    have = (int((kind == 1).sum(1).max()), int((kind == 2).sum(1).max()))
    if have[0] > joints[0] or have[1] > joints[1]:
        raise CorruptShard(
            f"{shard.path}: an object has {have[0]} revolute and {have[1]} prismatic joints, the "
            f"recipe's model {joints[0]} and {joints[1]} such parts; add directions to model"
        )


def _tensor(array: NDArray[Any]) -> Tensor:
    """Torch has few functions for uint16: their bits as int16."""
    return torch.from_numpy(array.view(np.int16) if array.dtype == np.uint16 else array)
