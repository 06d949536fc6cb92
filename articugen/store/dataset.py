"""A data set as a sequence of rows: `open` it, take slices and splits, draw batches.

Nothing is read before it is asked for, and then only the chunks that hold it. Shards are not kept
open: where the rows of a field lie is noted once (`columns.Column`), and a few files are held to
read from, so that a data set may have any number of shards, be used by threads, survive a fork and
be sent to other processes.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, overload

import numpy as np
from numpy.typing import NDArray

from articugen.core import schema
from articugen.core.arrays import grouped
from articugen.core.errors import CorruptShard, InvalidArgument
from articugen.core.recipe import Recipe
from articugen.core.yaml_files import nearest, unlisted
from articugen.store.bucket import Remote
from articugen.store.columns import Attribute
from articugen.store.manifest import Manifest
from articugen.store.rows import Row, in_units, is_scaled, texts
from articugen.store.shelf import Same, Shelf, shelf_at

if TYPE_CHECKING:
    from articugen.store.torch_dataset import TorchDataSet

Rng = int | np.random.Generator | None
"""A seed, a generator, or None for other numbers each time."""

DEFAULT_FIELDS = ("surface_points", "surface_part")

_POINT_SYMBOLS = ("S", "U", "K", "M")
"""The letters of schema.SYMBOLS that count points, of which a batch may hold fewer."""


def open(path: str | Path) -> "DataSet":
    """Open a data set: its folder, or one of its shards. Of a folder that is not finished, and has
    no manifest yet, what is there. A folder s3://bucket/prefix is read where it is, and so is one
    on the web (https://), on Hugging Face's hub (hf://datasets/owner/name) or wherever else fsspec
    reads: what is asked for comes over, and no more.

    Raises:
        InvalidArgument: there is none.
        CorruptShard: it is damaged.
        MachineFault: an object store does not answer.
    """
    shelf = shelf_at(path)
    counts = np.array([entry.instances for entry in shelf.entries], np.int64)
    where = np.empty((counts.sum(), 2), np.int32)  # of a hundred million instances, maybe
    where[:, 0] = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
    where[:, 1] = np.arange(len(where), dtype=np.int32)
    where[:, 1] -= np.repeat((counts.cumsum() - counts).astype(np.int32), counts)
    last = np.array([entry.split != "train" for entry in shelf.entries], bool)[where[:, 0]]
    # drawn from in the order of the files, so that a seed draws what it always did
    return DataSet(shelf, where[np.argsort(last, kind="stable")], where)


class DataSet(Sequence[Row]):
    """Instances of a data set, or some of them: `data[7]` is a `Row`, `data[10:20]` a `DataSet`.

    Those for training come first, otherwise they are in the order of the shards' names.
    """

    draw: ClassVar[Callable[["DataSet"], str] | None] = None
    """Makes HTML of it for a notebook; `inspection.notebook`, which may draw, puts it here."""

    def __init__(
        self, shelf: "Shelf", where: NDArray[np.int32], drawn: NDArray[np.int32] | None = None
    ) -> None:
        """Made by `open`; `where` (n, 2) holds the shard and the row of each instance, `drawn` the
        same in the order in which random numbers count them, where that is another."""
        self._shelf, self._where = shelf, where
        self._counted = where if drawn is None else drawn

    @property
    def path(self) -> Any:
        """Opened place: a `Path`, or a `Remote` in an object store."""
        return self._shelf.path

    @property
    def manifest(self) -> Manifest | None:
        """Manifest of the whole data set; None of a single shard."""
        return self._shelf.manifest

    @cached_property
    def shards(self) -> tuple[Any, ...]:
        """The files that hold these instances, in their order."""
        return tuple(entry.path for entry in self._entries())

    @cached_property
    def category(self) -> str:
        """Category of its objects, "laptop" say, by its first instance.

        Raises:
            InvalidArgument: it holds no instance.
        """
        return str(self._attributes()["category"])

    @cached_property
    def recipe(self) -> Recipe:
        """Recipe that it was made by.

        Raises:
            CorruptShard: by a recipe of another version.
        """
        text = self.manifest.recipe if self.manifest else self._attributes()["recipe"]
        recipe = Recipe.of_text(str(text))
        if recipe is None:
            raise CorruptShard(
                f"{self.path}: its recipe is of another version of articugen; read it there"
            )
        return recipe

    @cached_property
    def objects(self) -> tuple[str, ...]:
        """The ids of its objects, in the order of their first instances."""
        ids = [entry.object_ids for entry in self._entries()]
        if all(isinstance(some, Same) for some in ids):  # every instance need not be read
            return tuple(dict.fromkeys(some[0] for some in ids))
        return tuple(dict.fromkeys(self._object_ids()))

    @cached_property
    def splits(self) -> Mapping[str, int]:
        """Number of instances of each split."""
        names = list(dict.fromkeys(entry.split for entry in self._shelf.entries))
        of_shard = np.array([names.index(entry.split) for entry in self._shelf.entries], np.int32)
        split = of_shard[self._where[:, 0]]
        counts = np.bincount(split, minlength=len(names)).tolist()
        first = {n: int((split == n).argmax()) for n, count in enumerate(counts) if count}
        return {names[n]: counts[n] for n in sorted(first, key=lambda n: first[n])}

    @cached_property
    def fields(self) -> Mapping[str, tuple[int, ...]]:
        """The shape of each field of its first instance; `J` and `P` may differ between objects."""
        return {n: shape[1:] for n, shape in self._shelf.about(self._first())[0].items()}

    def split(self, name: str) -> "DataSet":
        """Its instances of one split, "train" say.

        Raises:
            InvalidArgument: there is none.
        """
        if name not in self.splits:
            raise InvalidArgument(f"{self.path}: {unlisted('split', name, self.splits)}")
        of_split = [entry.split == name for entry in self._shelf.entries]
        return DataSet(self._shelf, self._where[np.array(of_split)[self._where[:, 0]]])

    def of(self, *objects: str) -> "DataSet":
        """Return the instances of these objects alone.

        Raises:
            InvalidArgument: there is no such object.
        """
        for name in objects:
            if name not in self.objects:
                raise InvalidArgument(
                    f"{self.path}: no object {name!r}{nearest(name, self.objects)}; `objects` "
                    "lists them"
                )
        return self[np.isin(self._object_ids(), objects)]

    def by_object(self) -> Iterator[tuple[str, "DataSet"]]:
        """Yield each object's id, and its instances, in the order of `objects`."""
        where = grouped((name, index) for index, name in enumerate(self._object_ids()))
        yield from ((name, self[indices]) for name, indices in where.items())

    def __fspath__(self) -> str:
        """Its path, for functions that take a data set's folder: `train`, `verify` and the like.

        Raises:
            InvalidArgument: it is only some of the instances, which is not what they would see.
        """
        if isinstance(self.path, Remote):
            raise InvalidArgument(
                f"{self.path}: this needs the files here; copy them (aws s3 sync, or the like) and "
                "give that folder"
            )
        whole = sum(entry.instances for entry in self._shelf.entries)
        if len(self) != whole:
            raise InvalidArgument(
                f"{self.path}: these are {len(self):,} of {whole:,} instances; give the whole data "
                "set, the splits are chosen there"
            )
        return str(self.path)

    def __len__(self) -> int:
        return len(self._where)

    @overload
    def __getitem__(self, index: int) -> Row: ...
    @overload
    def __getitem__(self, index: slice | Sequence[int] | NDArray[Any]) -> "DataSet": ...
    def __getitem__(self, index: Any) -> Any:
        """Return a row for a number; a data set for a slice, numbers, or one bool an instance.

        Raises:
            IndexError: there is no such instance.
        """
        if isinstance(index, slice):
            return DataSet(self._shelf, self._where[index])
        at = np.asarray(index)
        if at.ndim == 1 and (at.dtype.kind in "iub" or not len(at)):
            return DataSet(self._shelf, self._where[at if len(at) else []])
        if at.ndim or at.dtype.kind not in "iu":
            raise TypeError(f"instances are counted by whole numbers, not by {index!r}")
        if not -len(self) <= index < len(self):
            raise IndexError(f"{self.path}: no instance {index}, there are {len(self)}")
        shard, row = self._where[int(index)].tolist()
        entry, (shapes, about) = self._shelf.entries[shard], self._shelf.about(shard)
        return Row(
            partial(self._shelf.read, shard, row),
            shapes,
            split=entry.split,
            category=str(about["category"]),
        )

    def __iter__(self) -> Iterator[Row]:
        return (self[i] for i in range(len(self)))

    def batch(
        self,
        which: int | Sequence[int] | NDArray[Any],
        fields: Sequence[str] = DEFAULT_FIELDS,
        *,
        points: int | None = None,
        rng: Rng = None,
        raw: bool = False,
    ) -> dict[str, NDArray[Any]]:
        """Some fields of some instances, each (n, ...).

        Args:
            which: how many, drawn without repeats; or which, by their numbers.
            fields: names as in `fields` and docs/format.md.
            points: how many of the stored points of an instance, drawn without repeats, each as
                likely as any other; what belongs to the same points (normals, parts, labels)
                stays with them. None takes all, in the order they are stored in.
            rng: for what is drawn; the same seed draws the same.
            raw: leave whole numbers as they are stored. Otherwise points come as float32 in the
                unit frame, normals and coverage as float32 too. Labels are uint8, all else float64.

        Raises:
            InvalidArgument: there are fewer instances or points, no such field, or it is not of the
                same shape in all of these instances, as of objects with unlike numbers of joints.
            CorruptShard: the bytes fail their checksum.
        """
        rng = np.random.default_rng(rng)
        where, fields = self._drawn(which, rng), list(dict.fromkeys(fields))
        kinds = [_kind_of_points(name) for name in fields]
        floats = {name for name in fields if is_scaled(name) and not raw}
        batch: dict[str, NDArray[Any]] = {}
        for n, (shard, row) in enumerate(where.tolist()):
            stored = self._shelf.read(shard, row, fields)
            if points is not None:
                stored = _some_of_each(stored, kinds, points, rng)
                if stored is None:
                    raise self._too_few(shard, fields, points)
            for name, array in zip(fields, stored, strict=True):
                if n == 0:
                    dtype = np.float32 if name in floats else array.dtype
                    batch[name] = np.empty((len(where), *array.shape), dtype)
                if batch[name].shape[1:] != array.shape:
                    raise self._ragged(name, where[[0, n]])
                if name in floats:
                    in_units(name, array, out=batch[name][n])
                else:
                    batch[name][n] = array
        is_text = {name for name in fields if (f := schema.field_of(name)) and f.dtype == "S"}
        return {n: np.char.decode(a, "utf-8") if n in is_text else a for n, a in batch.items()}

    def torch(
        self, *, fields: Sequence[str] = DEFAULT_FIELDS, points: int | None = None
    ) -> "TorchDataSet":
        """Return a map-style torch Dataset of dicts of tensors, for any DataLoader.

        Points are drawn again each time, by torch's own generator: `torch.manual_seed` decides
        them, and a DataLoader's workers draw different ones. Points, normals and numbers of joints
        are float32, labels uint8, `state_index` int64.

        Args:
            fields, points: see `batch`.

        Raises:
            MissingExtra: torch is not installed.
            InvalidArgument: no such field, or fewer points.
        """
        from articugen.store.torch_dataset import TorchDataSet  # noqa: PLC0415 - torch is optional

        if len(self):
            self.batch([0], fields, points=points, rng=0)  # what is missing is an error here
        return TorchDataSet(self, tuple(fields), points)

    def _drawn(self, which: Any, rng: np.random.Generator) -> NDArray[np.int32]:
        """Return (n, 2) the places of the instances that a batch asks for."""
        if isinstance(which, int | np.integer):
            if not 1 <= which <= len(self):
                raise InvalidArgument(
                    f"{self.path}: a batch of {which} different instances out of {len(self)}; ask "
                    "for fewer, or give their numbers"
                )
            return self._counted[rng.choice(len(self), int(which), replace=False)]
        where = self[np.asarray(which)]._where
        if not len(where):
            raise InvalidArgument(f"{self.path}: a batch of no instances; ask for one at least")
        return where

    def _too_few(self, shard: int, fields: Sequence[str], points: int) -> InvalidArgument:
        shapes = self._shelf.about(shard)[0]
        have = {n: shapes[n][1 + kind[1]] for n in fields if (kind := _kind_of_points(n))}
        name = min(have, key=lambda name: have[name])
        return InvalidArgument(
            f"{self._shelf.entries[shard].path}: {points} points of {name}, which has {have[name]} "
            "an instance; ask for fewer, or make the data set with more"
        )

    def _ragged(self, name: str, where: NDArray[np.int32]) -> InvalidArgument:
        (one, shape), (other, unlike) = (
            (
                texts(self._shelf.read(shard, row, ["object_id"])[0]),
                self._shelf.about(shard)[0][name][1:],
            )
            for shard, row in where.tolist()
        )
        return InvalidArgument(
            f"{self.path}: {name} is {shape} in {one} and {unlike} in {other}, which do not stack; "
            "take objects of like joints with of(...), or read rows one by one"
        )

    def _entries(self) -> list[Any]:
        """List the shards that hold these instances, in the order of their first ones."""
        shards, first = np.unique(self._where[:, 0], return_index=True)
        return [self._shelf.entries[shard] for shard in shards[np.argsort(first)]]

    def _object_ids(self) -> list[str]:
        return [self._shelf.entries[s].object_ids[row] for s, row in self._where.tolist()]

    def _first(self) -> int:
        if not len(self):
            raise InvalidArgument(f"{self.path}: these are no instances; take more of them")
        return int(self._where[0, 0])

    def _attributes(self) -> Mapping[str, Attribute]:
        return self._shelf.about(self._first())[1]

    def __repr__(self) -> str:
        if not len(self):
            return f"DataSet({self.path}: no instances)"
        per_split = ", ".join(f"{count:,} {split}" for split, count in self.splits.items())
        objects = f"{len(self.objects)} object{'s' * (len(self.objects) != 1)}"
        clouds = {stem: self.fields.get(f"{stem}_points", (0,))[:-1] for stem in _CLOUDS}
        sizes = [f"{n} {' x '.join(map(str, s))}" for n, s in clouds.items() if s and 0 not in s]
        grids = [n.removeprefix("occupancy_") for n in self.fields if n.startswith("occupancy_")]
        sizes += [f"grids {', '.join(sorted(grids, key=int))}"] if grids else []
        return (
            f"DataSet({self.path}: {self.category}, {len(self):,} instances ({per_split}) of "
            f"{objects}\n  points: {', '.join(sizes)})"
        )

    def _repr_html_(self) -> str | None:
        return self.draw() if self.draw and len(self) else None


_CLOUDS = ("surface", "uniform", "near", "partial")


def _kind_of_points(name: str) -> tuple[str, int] | None:
    """Return the letter that counts a field's points, and the axis of an instance that they are
    on."""
    field = schema.field_of(name)
    letters = enumerate(field.shape[1:] if field else ())
    return next(((str(s), axis) for axis, s in letters if s in _POINT_SYMBOLS), None)


def _some_of_each(
    stored: Sequence[NDArray[Any]],
    kinds: Sequence[tuple[str, int] | None],
    points: int,
    rng: np.random.Generator,
) -> list[NDArray[Any]] | None:
    """Fields of an instance with `points` of each kind of its points; None where it has fewer."""
    drawn: dict[str, NDArray[np.intp]] = {}
    chosen: list[NDArray[Any]] = []
    for array, kind in zip(stored, kinds, strict=True):
        if kind is None or array.shape[kind[1]] == points:
            chosen.append(array)
            continue
        symbol, axis = kind
        if not 0 <= points <= array.shape[axis]:
            return None
        if symbol not in drawn:
            drawn[symbol] = _some(array.shape[axis], points, rng)
        chosen.append(array.take(drawn[symbol], axis))
    return chosen


def _some(there: int, count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """`count` different numbers below `there`, each as likely as any other.

    Where they divide, one of each run of neighbours: stored points are independent of their order,
    so that this is as random a sample of the shape, and takes a sixth of the time.
    """
    per_part, rest = divmod(there, max(count, 1))
    if rest or not count:
        return rng.choice(there, count, replace=False, shuffle=False)
    if 256 % per_part == 0:  # many times faster, and as even
        return np.arange(0, there, per_part) + (
            rng.integers(0, 256, count, np.uint8) & np.uint8(per_part - 1)
        )
    return np.arange(0, there, per_part) + rng.integers(0, per_part, count)
