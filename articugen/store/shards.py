"""HDF5 shards as they are read: one instance at a time, in chunks that `chunks.py` opens.

`columns.py` opens the file distrustfully and reads its index, `writer.py` writes it.
"""

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.core import schema
from articugen.core.errors import CorruptShard, machine_fault
from articugen.core.schema import Instance, resolution_of
from articugen.store.bucket import Remote
from articugen.store.columns import Attribute, attributes_of, columns_of, opened
from articugen.store.remote import RangeFile
from articugen.store.rows import texts

Content = tuple[tuple[str, int, str], ...]
"""(object_id, state_index, hex digest) of each instance."""


@dataclass(frozen=True)
class ShardRecord:
    """A shard that was written: its name in the folder, digest and size of the file, how many
    instances it holds, and (object_id, state_index, hex digest) of each."""

    name: str
    sha256: str
    bytes: int
    instances: int
    content: Content


def instance_sha256(object_id: str, arrays: Iterable[tuple[str, NDArray[Any]]]) -> str:
    """Return the digest of an instance's content, whatever the layout of the file that holds it.

    First a line "object_id <id>". For every other field, in the order of the names: one line "name
    dtype shape" with the little-endian dtype, then the bytes in C order. Of text the dtype is
    "utf-8", and a zero byte follows each, however long the file makes them all.
    """
    digest = hashlib.sha256(f"object_id {object_id}\n".encode())
    for name, array in sorted(arrays, key=lambda named: named[0]):
        if name == "object_id":
            continue
        if array.dtype.kind == "S":
            digest.update(f"{name} utf-8 {array.shape}\n".encode())
            digest.update(b"".join(text + b"\0" for text in array.ravel()))
        else:
            little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
            digest.update(f"{name} {little.dtype.str} {array.shape}\n".encode())
            digest.update(little.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def content_row(object_id: str, row: Mapping[str, NDArray[Any]]) -> tuple[str, int, str]:
    """Return what `Content` has of an instance, of its fields as they are stored."""
    return object_id, int(row["state_index"]), instance_sha256(object_id, row.items())


def content_sha256(content: Iterable[tuple[Any, ...]]) -> str:
    """Return one digest of many: over their sorted lines, so that order and grouping do not
    matter."""
    lines = sorted("\x1f".join(map(str, entry)) for entry in content)
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def open_shard(path: Path | Remote) -> "Shard":
    """Open a shard for reading, `with open_shard(path) as shard:`.

    Raises:
        CorruptShard: it is not a shard, of another version, or holds anything the schema does not
            allow (links, external or virtual storage, other names, types, filters, shapes).
    """
    return Shard(path)


class _Handle:
    """A file that is open for reading until nobody holds this."""

    def __init__(self, path: Path) -> None:
        """Raise OSError where it cannot be opened."""
        self.number = os.open(path, os.O_RDONLY)
        about = os.fstat(self.number)
        self.stamp = (about.st_ino, about.st_size, about.st_mtime_ns)

    def read_spans(self, spans: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        return [os.pread(self.number, size, at) for at, size in spans]

    def __del__(self, close: Callable[[int], None] = os.close) -> None:
        if hasattr(self, "number"):
            close(self.number)


Handle = _Handle | RangeFile


def handle_of(path: Path | Remote) -> Handle:
    """Return what reads parts of a file, by where they begin and their bytes; or OSError."""
    return RangeFile(path) if isinstance(path, Remote) else _Handle(path)


class Shard(AbstractContextManager["Shard"]):
    """A shard that is open for reading; made by `open_shard`.

    HDF5 has closed it by then: threads may share it, it survives a fork, and it can be sent to
    worker processes.

    Attributes:
        path: of the file.
        attributes: of the file.
        fields: (N, ...) shape of each data set by its name.
        columns: where the rows of each lie.
        extended: whether somebody has added a group `user`, which is left alone.
    """

    def __init__(self, path: Path | Remote) -> None:
        self.path: Any = path if isinstance(path, Remote) else Path(path)
        file = opened(self.path)
        try:
            self.attributes: Mapping[str, Attribute] = MappingProxyType(attributes_of(file))
            self.columns = columns_of(file)
            self.extended = schema.USER_GROUP in file
            self._handle: Handle | None = handle_of(self.path)
        except CorruptShard as error:
            raise CorruptShard(f"{self.path}: {error}; make it again or fetch it again") from None
        except (OSError, RuntimeError, ValueError, TypeError, KeyError) as error:
            damage = CorruptShard(f"{self.path}: damaged ({error}); make it again")
            raise machine_fault(error) or damage from None
        finally:
            with suppress(RuntimeError):  # HDF5 stumbles once more over what is damaged
                file.close()
        shapes = {name: column.shape for name, column in self.columns.items()}
        self.fields: Mapping[str, tuple[int, ...]] = MappingProxyType(shapes)

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return self.fields["state_index"][0]

    def __reduce__(self) -> tuple[Any, ...]:
        return open_shard, (self.path,)

    def close(self) -> None:
        self._handle = None

    def read(self, name: str, index: int | slice = slice(None)) -> NDArray[Any]:
        """Return the rows of a data set: (...) for a number, (n, ...) for a slice.

        Raises:
            CorruptShard: the bytes fail their checksum.
            IndexError: there is no such row.
            KeyError: the shard has no such data set.
        """
        chosen = range(len(self))[index]
        if isinstance(chosen, int):
            return self._rows(name, [chosen])[0]
        return self._rows(name, chosen)

    def batch(self, indices: Sequence[int], names: Iterable[str]) -> dict[str, NDArray[Any]]:
        """Some fields (n, ...) of some instances, in the order asked for; repeats are allowed."""
        every = range(len(self))
        chosen = [every[int(index)] for index in indices]
        return {name: self._rows(name, chosen) for name in names}

    def instance(self, index: int) -> Instance:
        """Return the record that was written as row `index`.

        Raises:
            CorruptShard: the bytes fail their checksum.
            IndexError: there is no such row.
        """
        return self.instance_of(self.stored_row(index))

    def stored_row(self, index: int) -> dict[str, NDArray[Any]]:
        """Return all fields of row `index` as they are stored, for `instance_of` and
        `instance_sha256`; raises as `instance`."""
        if not 0 <= index < len(self):
            raise IndexError(f"{self.path}: no instance {index}, there are {len(self)}")
        with self._as_damage("an instance"):
            parts = self._read(column.span(index) for column in self.columns.values())
            pieces = zip(self.columns.items(), parts, strict=True)
            return {name: column.row(part) for (name, column), part in pieces}

    def instance_of(self, stored: Mapping[str, NDArray[Any]]) -> Instance:
        """Return the record that was written as a row, which `stored_row` gives."""
        row: dict[str, Any] = dict(stored)
        for field in schema.FIELDS:
            if field.is_grid:
                names = sorted(filter(field.matches, self.fields), key=resolution_of)
                grids = {resolution_of(name): row.pop(name) for name in names}
                row[field.stem] = MappingProxyType(grids)
            elif field.dtype == "S" and field.name in row:
                row[field.name] = self._texts(row[field.name])
        row["state_index"], row["scale"] = int(row["state_index"]), float(row["scale"])
        return Instance(**row)

    def object_ids(self) -> tuple[str, ...]:
        """Return the object of each instance."""
        return self._texts(self.read("object_id"))

    def content(self) -> Content:
        """Return the digest of each instance, computed from what is stored."""
        return tuple(content_row(o, self.stored_row(n)) for n, o in enumerate(self.object_ids()))

    def stored_bytes(self, name: str) -> int:
        """Return the bytes of a data set in the file, after compression, without its index."""
        return int(self.columns[name].size.sum())

    def _rows(self, name: str, rows: Sequence[int]) -> NDArray[Any]:
        column = self.columns[name]
        array = np.empty((len(rows), *column.shape[1:]), column.dtype)
        with self._as_damage(name):
            for place, part in enumerate(self._read(map(column.span, rows))):
                array[place] = column.row(part)
        return array

    def _read(self, spans: Iterable[tuple[int, int]]) -> Sequence[bytes]:
        if self._handle is None:
            raise ValueError("it is closed")
        return self._handle.read_spans(list(spans))

    @contextmanager
    def _as_damage(self, what: str) -> Iterator[None]:
        try:
            yield
        except (OSError, RuntimeError, ValueError) as error:
            raise machine_fault(error) or CorruptShard(
                f"{self.path}: {what}: damaged ({error}); make it again or fetch it again"
            ) from None

    def _texts(self, stored: Any) -> Any:
        try:
            return texts(stored)
        except UnicodeDecodeError as error:
            raise CorruptShard(f"{self.path}: the text {error.object!r} is not UTF-8") from None


class MadeShard(Shard):
    """Shard of one object that lies in memory alone, read as those that were written."""

    def __init__(self, rows: Sequence[Mapping[str, NDArray[Any]]]) -> None:
        """Take all fields of instances as they are stored."""
        self._arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
        self.fields = {name: array.shape for name, array in self._arrays.items()}
        self.attributes = {"schema_version": schema.SCHEMA_VERSION}
        self.path, self._handle = self.object_ids()[0], None

    def _rows(self, name: str, rows: Sequence[int]) -> NDArray[Any]:
        return self._arrays[name][rows]
