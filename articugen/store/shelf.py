"""The shards of a data set, wherever they lie, and the files that are held to read from them."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from articugen.core import schema
from articugen.core.arrays import grouped
from articugen.core.errors import CorruptShard, InvalidArgument, machine_fault
from articugen.core.yaml_files import unlisted
from articugen.store.bucket import Remote, is_url
from articugen.store.columns import Attribute, Column
from articugen.store.manifest import MANIFEST_NAME, Manifest
from articugen.store.remote import folder_at
from articugen.store.shards import Handle, handle_of, open_shard

_OPEN_FILES = 64


def shelf_at(path: str | Path) -> "Shelf":
    """Return the shards of a folder, or one shard, on the disk or elsewhere; raises as
    `dataset.open`."""
    place = Remote(str(path)) if is_url(path) else Path(path)
    is_remote = isinstance(place, Remote)
    if is_remote and place.name.endswith(".h5"):
        return Shelf(place, (_entry_of(place),), None)
    if not is_remote and not (place / MANIFEST_NAME).exists():
        return Shelf(place, tuple(map(_entry_of, shards_of(place))), None)
    manifest = Manifest.in_bucket(folder_at(place.url)) if is_remote else Manifest.read(place)
    if manifest is None:
        raise CorruptShard(
            f"{place}: has no {MANIFEST_NAME}; make it with generate, and once more where that was "
            "cut short"
        )
    return Shelf(place, tuple(_entries(place, manifest)), manifest)


@dataclass(frozen=True)
class _Entry:
    """A shard of a data set; `object_ids` of its rows."""

    path: Path | Remote
    split: str
    object_ids: Sequence[str]

    @property
    def instances(self) -> int:
        return len(self.object_ids)


def _entries(folder: Path | Remote, manifest: Manifest) -> Iterator[_Entry]:
    """Yield entries by the manifest; a shard of one object need not be opened for it."""
    inside = grouped((entry.shard, entry.key) for entry in manifest.objects)
    for shard in manifest.shards:
        keys = inside[shard.name]
        if len(keys) == 1:
            ids = Same(keys[0].object_id, shard.instances)
            yield _Entry(folder / shard.name, keys[0].split, ids)
        else:
            yield _entry_of(folder / shard.name)


class Same(Sequence[str]):
    """One text, repeated."""

    def __init__(self, text: str, count: int) -> None:
        self._text, self._count = text, count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: Any) -> Any:
        return self._text


def _entry_of(path: Path | Remote) -> _Entry:
    with open_shard(path) as shard:
        return _Entry(path, str(shard.attributes["split"]), shard.object_ids())


def shards_of(path: Path) -> list[Path]:
    """Return the shards that a path, of one or of a folder, stands for; InvalidArgument if none."""
    if not path.exists():
        raise InvalidArgument(f"{path}: there is no such shard or folder; correct its path")
    if not path.is_dir():
        return [path]
    shards = sorted(path.glob("*.h5"))
    if not shards:
        some = sorted(manifest.parent.name for manifest in path.glob(f"*/{MANIFEST_NAME}"))
        cure = f"open one of: {', '.join(some)}" if some else "make one with: articugen generate"
        raise InvalidArgument(f"{path}: holds no shard; {cure}")
    return shards


def _kind(name: str) -> str:
    """Return the kind of a field: surface, joint, ...; "" for one of an instance."""
    field = schema.field_of(name)
    return name.partition("_")[0] if field and len(field.shape) > 1 and field.shape[1] != 3 else ""


class Shelf:
    """The shards of a data set, shared by all that is taken from it."""

    def __init__(
        self, path: Path | Remote, entries: tuple[_Entry, ...], manifest: Manifest | None
    ) -> None:
        self.path, self.entries, self.manifest = path, entries, manifest
        self._about: dict[int, tuple[Mapping[str, tuple[int, ...]], Mapping[str, Attribute]]] = {}
        self._stored: dict[tuple[int, str], Column] = {}
        self._seen: dict[int, tuple[int, ...]] = {}
        self._handles: dict[int, Handle] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return Shelf, (self.path, self.entries, self.manifest)

    def about(self, shard: int) -> tuple[Mapping[str, tuple[int, ...]], Mapping[str, Attribute]]:
        """Return (N, ...) shapes of the data sets of a shard, and its attributes."""
        if shard not in self._about:
            self._learn(shard, ())
        return self._about[shard]

    def read(self, shard: int, row: int, names: Sequence[str]) -> list[NDArray[Any]]:
        """Some fields of an instance as they are stored, read-only.

        Raises:
            InvalidArgument: there is no such field.
            CorruptShard: damaged, or another shard since it was first read.
        """
        if not all((shard, name) in self._stored for name in names):
            self._learn(shard, names)
        handle = self._handle(shard)
        try:
            stored = [self._stored[shard, name] for name in names]
            parts = handle.read_spans([column.span(row) for column in stored])
            return [column.row(part) for column, part in zip(stored, parts, strict=True)]
        except (OSError, ValueError) as error:
            raise machine_fault(error) or CorruptShard(
                f"{self.entries[shard].path}: damaged ({error}); make it again or fetch it again"
            ) from error

    def _learn(self, shard: int, names: Iterable[str]) -> None:
        """Note where the rows of some fields lie, and of those that are mostly read with them; of a
        remote shard, of all: opening it is what takes time."""
        path = self.entries[shard].path
        with open_shard(path) as opened:
            self._about[shard] = (dict(opened.fields), dict(opened.attributes))
            for name in names:
                if name not in opened.fields:
                    raise InvalidArgument(f"{path}: {unlisted('field', name, opened.fields)}")
            kinds = set(map(_kind, names))
            for name in opened.fields:
                if isinstance(path, Remote) or _kind(name) in kinds:
                    self._stored[shard, name] = opened.columns[name]
        if len(opened) != self.entries[shard].instances:
            raise CorruptShard(f"{path}: not the shard that the manifest lists; see verify")

    def _handle(self, shard: int) -> Handle:
        handle = self._handles.get(shard)
        if handle is None:
            path = self.entries[shard].path
            try:
                handle = handle_of(path)
            except OSError as error:
                raise machine_fault(error) or CorruptShard(
                    f"{path}: cannot be opened ({error.strerror})"
                ) from error
            if self._seen.setdefault(shard, handle.stamp) != handle.stamp:
                raise CorruptShard(f"{path}: was made again since; open the data set again")
            while len(self._handles) >= _OPEN_FILES:
                self._handles.pop(next(iter(self._handles)), None)
            self._handles[shard] = handle
        return handle
