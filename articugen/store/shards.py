"""HDF5 shards as they are read: one instance at a time, in chunks that `chunks.py` opens.

HDF5 keeps the index. `columns.py` opens the file distrustfully, `writer.py` writes it.
"""

import hashlib
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.core import schema
from articugen.core.errors import CorruptShard
from articugen.core.schema import Instance, resolution_of
from articugen.store import chunks
from articugen.store.bucket import Remote
from articugen.store.columns import Attribute, Column, attributes_of, columns_of, opened

Content = tuple[tuple[str, int, str], ...]
"""(object_id, state_index, hex digest) of each instance."""


@dataclass(frozen=True)
class ShardRecord:
    """What the manifest says of one shard.

    Attributes:
        name: of the file, without its folder.
        sha256: hex digest of the file.
        bytes: its size.
        instances: how many it holds.
        content: (object_id, state_index, hex digest) of each.
    """

    name: str
    sha256: str
    bytes: int
    instances: int
    content: Content


def instance_sha256(object_id: str, arrays: Iterable[tuple[str, NDArray[Any]]]) -> str:
    """The digest of an instance's content, whatever the layout of the file that holds it.

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


def content_sha256(content: Iterable[tuple[Any, ...]]) -> str:
    """One digest of many: over their sorted lines, so that order and grouping do not matter."""
    lines = sorted("\x1f".join(map(str, entry)) for entry in content)
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def open_shard(path: Path | Remote) -> "Shard":
    """Open a shard for reading, `with open_shard(path) as shard:`.

    Raises:
        CorruptShard: it is not a shard, of another version, or holds anything the schema does not
            allow (links, external or virtual storage, other names, types, filters, shapes).
    """
    return Shard(path)


class Shard:
    """A shard that is open for reading; made by `open_shard`.

    It can be sent to worker processes: each opens the file for itself when it first reads, since an
    HDF5 handle must not be shared over a fork.

    Attributes:
        path: of the file.
        attributes: of the file.
        fields: (N, ...) shape of each data set by its name.
        extended: whether somebody has added a group `user`, which is left alone.
    """

    def __init__(self, path: Path | Remote) -> None:
        self.path: Any = path if isinstance(path, Remote) else Path(path)
        self._open()

    def _open(self) -> None:
        self._file, self._process = opened(self.path), os.getpid()
        try:
            self.attributes: Mapping[str, Attribute] = MappingProxyType(attributes_of(self._file))
            self._stored = columns_of(self._file)
        except CorruptShard as error:
            self.close()
            raise CorruptShard(f"{self.path}: {error}; make it again or fetch it again") from None
        except (OSError, RuntimeError, ValueError, TypeError, KeyError) as error:
            self.close()
            raise CorruptShard(f"{self.path}: damaged ({error}); make it again") from None
        shapes = {name: column.shape for name, column in self._stored.items()}
        self.fields: Mapping[str, tuple[int, ...]] = MappingProxyType(shapes)
        self.extended = schema.USER_GROUP in self._file

    def __enter__(self) -> "Shard":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return self.fields["state_index"][0]

    def __reduce__(self) -> tuple[Any, ...]:
        return open_shard, (self.path,)

    def close(self) -> None:
        with suppress(RuntimeError):  # HDF5 stumbles once more over what is damaged
            self._file.close()

    def read(self, name: str, index: int | slice = slice(None)) -> NDArray[Any]:
        """The rows of a data set: (...) for a number, (n, ...) for a slice.

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
        """The record that was written as row `index`.

        Raises:
            CorruptShard: the bytes fail their checksum.
            IndexError: there is no such row.
        """
        return self.instance_of(self.stored_row(index))

    def stored_row(self, index: int) -> dict[str, NDArray[Any]]:
        """All fields of row `index` as they are stored, for `instance_of` and `instance_sha256`.

        Raises:
            CorruptShard, IndexError: as `instance`.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"{self.path}: no instance {index}, there are {len(self)}")
        return {name: self.read(name, index) for name in self.fields}

    def instance_of(self, stored: Mapping[str, NDArray[Any]]) -> Instance:
        """The record that was written as a row, which `stored_row` gives."""
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
        """The object of each instance."""
        return self._texts(self.read("object_id"))

    def content(self) -> Content:
        """The digest of each instance, computed from what is stored."""
        columns = {name: self._column(name) for name in self.fields}
        buffers = {name: column.buffer() for name, column in columns.items()}
        content: list[tuple[str, int, str]] = []
        for index, object_id in enumerate(self.object_ids()):
            with self._as_damage("an instance"):
                row = {name: column.row(index, buffers[name]) for name, column in columns.items()}
            digest = instance_sha256(object_id, row.items())
            content.append((object_id, int(row["state_index"]), digest))
        return tuple(content)

    def stored(self, name: str) -> "Stored":
        """Where the rows of a data set lie, to read them without HDF5 once the shard is closed.

        Raises:
            CorruptShard: not every row has a chunk of its own.
            KeyError: the shard has no such data set.
        """
        column = self._column(name)
        offset, size = np.zeros(len(self), np.int64), np.zeros(len(self), np.int64)
        with self._as_damage(name):
            if column.row_bytes:
                offset, size = column.places
                if size.min() <= chunks.CHECKSUM_BYTES:
                    raise ValueError("a chunk without its checksum")
        return Stored(column.shape, column.dtype, column.compressed, offset, size)

    def stored_bytes(self, name: str) -> int:
        """What a data set takes in the file, after compression, without its index."""
        return self._column(name).dataset.get_storage_size()

    def _column(self, name: str) -> "Column":
        if self._process != os.getpid():
            self._open()
        return self._stored[name]

    def _rows(self, name: str, rows: Sequence[int]) -> NDArray[Any]:
        with self._as_damage(name):
            return self._column(name).rows(rows)

    @contextmanager
    def _as_damage(self, what: str) -> Iterator[None]:
        try:
            yield
        except (OSError, RuntimeError, ValueError) as error:
            raise CorruptShard(
                f"{self.path}: {what}: damaged ({error}); make it again or fetch it again"
            ) from None

    def _texts(self, stored: Any) -> Any:
        """A text of numpy's as str, an array of them as a tuple."""
        if isinstance(stored, np.ndarray):
            return tuple(map(self._texts, stored))
        try:
            return stored.decode()
        except UnicodeDecodeError:
            raise CorruptShard(f"{self.path}: the text {stored!r} is not UTF-8") from None


@dataclass(frozen=True, eq=False)
class Stored:
    """Where each row of a data set lies in its file: read so, any number of shards take no HDF5
    handle, which is slow to open and neither process nor thread may share.

    Attributes:
        shape: (N, ...).
        dtype: of what is stored.
        compressed: whether with gzip.
        offset, size: (N,) bytes: where the chunk of each row begins, and how long it is.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    compressed: bool
    offset: NDArray[np.int64]
    size: NDArray[np.int64]

    @property
    def row_bytes(self) -> int:
        return math.prod(self.shape[1:]) * self.dtype.itemsize

    def span(self, row: int) -> tuple[int, int]:
        """Where a row's bytes begin in the file, and how many they are; 0 where it has none."""
        if not self.row_bytes:
            return 0, 0
        return int(self.offset[row]), min(int(self.size[row]), chunks.most_bytes(self.row_bytes))

    def row(self, stored: bytes) -> NDArray[Any]:
        """(...) read-only, of the bytes that lie in its `span`; their checksum is looked at.

        Raises:
            ValueError: damaged.
        """
        if not self.row_bytes:
            return np.zeros(self.shape[1:], self.dtype)
        if len(stored) <= chunks.CHECKSUM_BYTES:
            raise ValueError("cut short")
        data = chunks.decoded(memoryview(stored), self.row_bytes, compressed=self.compressed)
        return np.frombuffer(data, self.dtype).reshape(self.shape[1:])
