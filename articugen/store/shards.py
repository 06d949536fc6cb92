"""HDF5 shards: the atomic writer and the distrustful reader (the only user of h5py).

A shard is written one instance at a time, and read so, in chunks that `chunks.py` makes and opens:
HDF5 keeps the index. Its bytes depend on nothing but the instances and attributes.
"""

import hashlib
import io
import json
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, BinaryIO

import h5py
import h5py.h5l
import h5py.h5o
import numpy as np
from numpy.typing import NDArray

from articugen.core import schema
from articugen.core.errors import ArticugenError, CorruptShard
from articugen.core.fields import MAX_TEXT, Field, resolution_of
from articugen.core.files import UnfitFile, check_regular, sha256_of, sync, written_atomically
from articugen.core.schema import Instance
from articugen.store import chunks
from articugen.store.bucket import Remote
from articugen.store.remote import RangeFile

_GZIP, _FLETCHER32 = 1, 3
_MAX_ATTRIBUTES = 64
_MAX_ATTRIBUTE_BYTES = 60_000
"""An HDF5 object header has no room for more than 64 kB."""

Attribute = str | int | float
Content = tuple[tuple[str, int, str], ...]
"""(object_id, state_index, hex digest) of each instance; see `content_digests`."""


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


Check = Callable[[Path, ShardRecord], None]
"""Looks at a shard that is whole but has not its name yet, and raises where it must not get it."""


def write_shard(
    path: Path,
    instances: Iterable[Instance],
    attributes: Mapping[str, Attribute],
    check: Check | None = None,
) -> ShardRecord:
    """Write a shard, read it back, compare, and only then give it its name.

    Args:
        path: the final name; a shard of that name is replaced, in one step.
        instances: one or more, all of the same field shapes; taken one at a time, so that memory
            does not grow with their number. What it raises leaves no file behind.
        attributes: those of `schema.ATTRIBUTES` besides format and schema_version; more may follow.
        check: called once it is whole.

    Raises:
        MachineFault: the disk is full, the folder cannot be written to.
        ValueError: instances of different shapes, a missing attribute: faults of the caller.
    """
    given = {"format": schema.FORMAT, "schema_version": schema.SCHEMA_VERSION, **attributes}
    for name, (kind, _) in schema.ATTRIBUTES.items():
        if not isinstance(given.get(name), kind):
            raise ValueError(f"{path}: attribute {name!r} is missing or not of its type")
    content: list[tuple[str, int, str]] = []
    record = ShardRecord(path.name, "", 0, 0, ())

    def look(temporary: Path) -> None:
        nonlocal record
        with open_shard(temporary) as shard:
            if shard.content() != tuple(content) or dict(shard.attributes) != given:
                raise ArticugenError(f"{path}: reads back otherwise than written; check the disk")
        size = temporary.stat().st_size
        record = ShardRecord(path.name, sha256_of(temporary), size, len(content), tuple(content))
        if check is not None:
            check(temporary, record)

    with written_atomically(path, check=look) as file:
        disk = Disk(file)
        with new_hdf5(disk, libver="v110") as hdf5:  # 2016: with checksums on its metadata
            _describe_file(hdf5, given)
            for row in _written(hdf5, instances):
                content.append(row)
                if disk.fault is not None:
                    break
    return record


def copy_user_group(path: Path, into: Path, written: int) -> None:
    """Copy the group `user`, if any, of a file that may be damaged into a shard, which is otherwise
    left as it is.

    Args:
        path: of the file, which need not be there.
        written: bytes that it had when it was written: a larger one may have such a group.

    Raises:
        CorruptShard: there is one that cannot be read, or there may be.
    """
    if not os.path.lexists(path):
        return
    is_there = path.stat().st_size > written
    try:
        with _opened(path) as theirs:
            name = schema.USER_GROUP.encode()
            is_there = theirs.id.links.exists(name)
            if not is_there:
                return
            if theirs.id.links.get_info(name).type != h5py.h5l.TYPE_HARD:
                raise CorruptShard(f"{path}: {schema.USER_GROUP!r} is a link to elsewhere")
            with h5py.File(into, "r+", libver="v110", locking=False) as ours:
                theirs.copy(schema.USER_GROUP, ours)
    except (OSError, RuntimeError, ValueError, KeyError, CorruptShard) as error:
        if is_there:
            raise CorruptShard(
                f"it may have a group 'user', which cannot be read ({error})"
            ) from None
        return
    sync(into)


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
        self._file, self._process = _opened(self.path), os.getpid()
        try:
            self.attributes: Mapping[str, Attribute] = MappingProxyType(_attributes(self._file))
            self._stored = _checked(self._file)
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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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

    def _column(self, name: str) -> "_Column":
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


@dataclass(frozen=True)
class _Column:
    """A data set that has been looked at: one chunk a row, which are read without HDF5's filters.

    Attributes:
        dataset: open for reading.
        shape: (N, ...).
        dtype: of what is stored.
        compressed: whether with gzip.
    """

    dataset: h5py.h5d.DatasetID
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    compressed: bool

    @property
    def row_bytes(self) -> int:
        return math.prod(self.shape[1:]) * self.dtype.itemsize

    @cached_property
    def places(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Where the chunks of the first rows begin, and their bytes; 0 bytes of one that was
        stored without its checksum. As many as there are rows, unless one is missing.

        HDF5 believes an index that says how many chunks there could be, and goes through 10^18 of
        them where it finds none: it is stopped at the last row, once that is known to be there.
        """
        found: list[tuple[int, int]] = []

        def note(chunk: Any) -> bool | None:
            if chunk.chunk_offset[0] != len(found):
                return True
            found.append((chunk.byte_offset, 0 if chunk.filter_mask else chunk.size))
            return True if len(found) == self.shape[0] else None

        if self.row_bytes and self.shape[0] and self._has(self.shape[0] - 1):
            self.dataset.chunk_iter(note)
        offset, size = np.array(found, np.int64).reshape(-1, 2).T
        return offset, size

    def _has(self, row: int) -> bool:
        try:
            self.dataset.read_direct_chunk(self._at(row), out=self.buffer())
        except (OSError, RuntimeError, ValueError):
            return False
        return True

    def _at(self, row: int) -> tuple[int, ...]:
        return (row, *(0,) * (len(self.shape) - 1))

    def buffer(self) -> NDArray[np.uint8]:
        """Room for one chunk. HDF5 refuses one that is larger, so no index can ask for more."""
        return np.empty(chunks.most_bytes(self.row_bytes), np.uint8)

    def row(self, row: int, buffer: NDArray[np.uint8]) -> NDArray[Any]:
        """(...) in place in `buffer` where nothing had to be done to it.

        Raises:
            OSError, RuntimeError, ValueError: damaged.
        """
        return np.frombuffer(self._bytes(row, buffer), self.dtype).reshape(self.shape[1:])

    def rows(self, rows: Sequence[int]) -> NDArray[Any]:
        """(n, ...) in the order asked for.

        Raises:
            OSError, RuntimeError, ValueError: damaged.
        """
        array = np.empty((len(rows), *self.shape[1:]), self.dtype)
        into, size = array.reshape(-1).view(np.uint8).data, self.row_bytes
        buffer = self.buffer()
        for place, row in enumerate(rows):
            into[place * size : (place + 1) * size] = self._bytes(row, buffer)
        return array

    def _bytes(self, row: int, buffer: NDArray[np.uint8]) -> memoryview | bytes:
        size = self.row_bytes
        if not size:
            return b""
        skipped, chunk = self.dataset.read_direct_chunk(self._at(row), out=buffer)
        if skipped:
            raise ValueError("a chunk without its checksum")
        return chunks.decoded(chunk, size, compressed=self.compressed)


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


class Disk(io.RawIOBase):
    """The file that HDF5 writes to; the disk's first fault is kept as it was.

    HDF5 would make other errors of it, and more of them when it closes: it hears that all is well
    from then on, and the fault is raised once it is done.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._handle = file.fileno()
        self._at = 0
        self.fault: OSError | None = None

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        end = whence == os.SEEK_END
        self._at = os.fstat(self._handle).st_size + offset if end else offset
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: Any) -> int:
        data = self._unless_faulty(os.pread, self._handle, len(buffer), self._at) or b""
        buffer[: len(data)] = data
        return len(data)

    def write(self, data: Any) -> int:
        rest = memoryview(data).cast("B")
        size = len(rest)
        while rest and self.fault is None:  # a call may write less than it is given
            done = self._unless_faulty(os.pwrite, self._handle, rest, self._at) or 0
            rest, self._at = rest[done:], self._at + done
        return size

    def truncate(self, size: int | None = None) -> int:
        end = self._at if size is None else size
        self._unless_faulty(os.ftruncate, self._handle, end)
        return end

    def _unless_faulty(self, act: Any, *arguments: Any) -> Any:
        if self.fault is not None:
            return None
        try:
            return act(*arguments)
        except OSError as error:
            self.fault = error
            return None


@contextmanager
def new_hdf5(disk: Disk, **options: Any) -> Iterator[h5py.File]:
    """An HDF5 file on `disk`, with h5py's options.

    Raises:
        OSError: as the disk gave it.
    """
    try:
        with h5py.File(disk, "w", **options) as hdf5:
            yield hdf5
    finally:
        if disk.fault is not None:
            raise disk.fault


def _written(file: h5py.File, instances: Iterable[Instance]) -> Iterator[tuple[str, int, str]]:
    """Write rows as they come; (object_id, state_index, digest) of each."""
    datasets: dict[str, h5py.h5d.DatasetID] = {}
    shapes: dict[str, tuple[int, ...]] = {}
    count = 0
    for row in instances:
        arrays = _stored_arrays(row)
        if not datasets:
            shapes = {name: array.shape for name, array in arrays.items()}
            datasets = {name: _new_dataset(file, name, array) for name, array in arrays.items()}
        if {name: array.shape for name, array in arrays.items()} != shapes:
            raise ValueError("instances that do not make a shard: of different fields or shapes")
        for name, array in arrays.items():
            _append(datasets[name], count, array, compressed=_field(name).compressed)
        count += 1
        yield row.object_id, row.state_index, instance_sha256(row.object_id, arrays.items())
    fault = schema.misfit({name: (count, *shape) for name, shape in shapes.items()})
    if fault:
        raise ValueError(f"instances that do not make a shard: {fault}")


def _stored_arrays(row: Instance) -> dict[str, NDArray[Any]]:
    """Each field of an instance as it is stored, in the order of the names."""
    arrays: dict[str, NDArray[Any]] = {}
    for name, value in sorted(row.arrays().items()):
        field = _field(name)
        if field.dtype == "S":
            arrays[name] = _stored_texts(value)
        else:
            arrays[name] = np.ascontiguousarray(value, field.dtype).reshape(np.shape(value))
        if arrays[name].nbytes > schema.MAX_CHUNK_BYTES:
            raise ValueError(
                f"{name}: {arrays[name].nbytes} bytes an instance; ask for fewer samples"
            )
    return arrays


def _field(name: str) -> Field:
    field = schema.field_of(name)
    if field is None:
        raise ValueError(f"{name}: not in the schema")
    return field


def _stored_texts(texts: str | tuple[str, ...]) -> NDArray[Any]:
    """Text in UTF-8 of a fixed length, which is the same in every shard."""
    text = np.char.encode(np.asarray(texts, np.str_), "utf-8")
    if text.itemsize > MAX_TEXT:
        raise ValueError(f"a text of more than {MAX_TEXT} bytes ({text.itemsize})")
    return text.astype(f"S{MAX_TEXT}")


def _new_dataset(file: h5py.File, name: str, row: NDArray[Any]) -> h5py.h5d.DatasetID:
    """A data set without rows yet, with what the schema says of it as attributes."""
    field = _field(name)
    dataset = file.create_dataset(
        name,
        shape=(0, *row.shape),
        dtype=h5py.string_dtype("utf-8", row.itemsize) if field.dtype == "S" else row.dtype,
        chunks=_chunks((0, *row.shape)),
        # An empty data set has to be allowed to grow before h5py accepts chunks for it.
        maxshape=(None, *(size or None for size in row.shape)),
        compression=chunks.GZIP_LEVEL if field.compressed else None,
        fletcher32=True,
        track_times=False,
    )
    described = {
        "shape": field.written_shape,
        "unit": field.unit,
        "frame": field.frame,
        "meaning": field.meaning,
    }
    for key, text in described.items():
        if text:
            dataset.attrs[key] = text
    return dataset.id


def _append(
    dataset: h5py.h5d.DatasetID, count: int, row: NDArray[Any], *, compressed: bool
) -> None:
    """Give a data set of `count` rows one more."""
    dataset.set_extent((count + 1, *row.shape))
    if row.size:
        chunk = chunks.encoded(row.tobytes(), compressed=compressed)
        dataset.write_direct_chunk((count, *(0,) * row.ndim), chunk)


def _chunks(shape: tuple[int, ...]) -> tuple[int, ...]:
    return (1, *(max(size, 1) for size in shape[1:]))


def _describe_file(file: h5py.File, attributes: Mapping[str, Attribute]) -> None:
    """Write the attributes twice: as anyone reads them, and together as HDF5 checks them."""
    text = json.dumps(attributes, ensure_ascii=False, sort_keys=True).encode()
    if len(text) > _MAX_ATTRIBUTE_BYTES:
        raise ValueError(f"attributes of {len(text)} bytes")
    fixed = h5py.string_dtype("utf-8", len(text))
    file.attrs.create(schema.CHECKED_ATTRIBUTES, np.array(text, fixed), dtype=fixed)
    for name, value in attributes.items():
        if isinstance(value, str):
            file.attrs[name] = value
        else:
            file.attrs.create(name, value, dtype="<i8" if isinstance(value, int) else "<f8")


def _opened(path: Path | Remote) -> h5py.File:
    """Without HDF5's file lock, which network file systems lack: a shard never changes."""
    try:
        if isinstance(path, Remote):
            return h5py.File(RangeFile(path), "r")
        check_regular(path)
        return h5py.File(path, "r", locking=False)
    except UnfitFile as error:
        raise CorruptShard(f"{path}: {error.strerror}; move it away") from None
    except (FileNotFoundError, IsADirectoryError, PermissionError) as error:
        reason = os.strerror(error.errno or 0)
        raise CorruptShard(f"{path}: cannot be opened ({reason})") from None
    except OSError:
        raise CorruptShard(
            f"{path}: not an HDF5 file, or cut short; make it again or fetch it again"
        ) from None


def _attributes(file: h5py.File) -> dict[str, Attribute]:
    """The file's attributes; their types and sizes are looked at before anything is read.

    Text of variable length is left unread: HDF5 trusts the sizes it finds there, and no checksum
    guards them. From version 2 on all is in one text of a fixed length as well.
    """
    if len(file.attrs) > _MAX_ATTRIBUTES:
        raise CorruptShard(f"{len(file.attrs)} attributes")
    version = _attribute(file, "schema_version") if "schema_version" in file.attrs else None
    if not isinstance(version, int) or not 1 <= version <= schema.SCHEMA_VERSION:
        if "schema_version" not in file.attrs and "format" not in file.attrs:
            raise CorruptShard("an HDF5 file, but not an articugen shard")
        raise CorruptShard(
            f"schema version {version}, this articugen reads 1 to {schema.SCHEMA_VERSION}"
        )
    if version == 1:
        attributes = {name: _attribute(file, name) for name in file.attrs}
    else:
        attributes = _unpacked(str(_attribute(file, schema.CHECKED_ATTRIBUTES)))
    if attributes.get("format") != schema.FORMAT:
        raise CorruptShard("an HDF5 file, but not an articugen shard")
    for name, (kind, _) in schema.ATTRIBUTES.items():
        if not isinstance(attributes.get(name), kind):
            raise CorruptShard(f"attribute {name!r} is missing or not of its type")
    if not re.fullmatch(schema.SPLIT, str(attributes["split"])):
        raise CorruptShard(f"no split may be called {attributes['split']!r}")
    if attributes["schema_version"] != version:
        raise CorruptShard(f"schema version {version} or {attributes['schema_version']}")
    return attributes


def _unpacked(text: str) -> dict[str, Attribute]:
    try:
        attributes = json.loads(text)
    except (ValueError, RecursionError):
        raise CorruptShard(f"attribute {schema.CHECKED_ATTRIBUTES!r} is not JSON") from None
    if not isinstance(attributes, dict) or len(attributes) > _MAX_ATTRIBUTES:
        raise CorruptShard(f"attribute {schema.CHECKED_ATTRIBUTES!r} does not hold the others")
    for name, value in attributes.items():
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise CorruptShard(f"attribute {name!r} is neither a number nor a text")
    return attributes


def _attribute(file: h5py.File, name: str) -> Attribute:
    if name not in file.attrs:
        raise CorruptShard(f"attribute {name!r} is missing")
    stored = h5py.h5a.open(file.id, name.encode("utf-8", "surrogateescape"))
    is_text = isinstance(stored.get_type(), h5py.h5t.TypeStringID)
    plain = stored.shape == () and stored.get_storage_size() <= _MAX_ATTRIBUTE_BYTES
    if is_text and plain and not stored.get_type().is_variable_str():
        value = file.attrs[name]
        return value.decode() if isinstance(value, bytes) else str(value)
    if plain and not is_text and stored.dtype in (np.dtype("<i8"), np.dtype("<f8")):
        return np.asarray(file.attrs[name]).item()
    raise CorruptShard(f"attribute {name!r} is neither a number nor a text of a fixed length")


def _checked(file: h5py.File) -> dict[str, _Column]:
    """Every data set, once all is as the schema says."""
    columns: dict[str, _Column] = {}
    for name in map(str, file):
        field = schema.field_of(name)
        if field is None and name != schema.USER_GROUP:
            raise CorruptShard(f"{name!r} is not in the schema")
        if file.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
            raise CorruptShard(f"{name!r} is a link to elsewhere")
        kind = h5py.h5o.get_info(file.id, name.encode()).type
        if kind != (h5py.h5o.TYPE_DATASET if field else h5py.h5o.TYPE_GROUP):
            raise CorruptShard(f"{name!r} is not a {'data set' if field else 'group'}")
        if field is None:
            continue
        columns[name] = _checked_dataset(h5py.h5d.open(file.id, name.encode()), name, field)
    fault = schema.misfit({name: column.shape for name, column in columns.items()})
    if fault:
        raise CorruptShard(fault)
    return columns


def _checked_dataset(dataset: h5py.h5d.DatasetID, name: str, field: Field) -> _Column:
    shape = dataset.shape
    if shape is None or not _is_dtype(dataset, field):
        raise CorruptShard(f"{name!r} is not of dtype {field.dtype}")
    made = dataset.get_create_plist()
    if made.get_layout() != h5py.h5d.CHUNKED or made.get_chunk() != _chunks(shape):
        raise CorruptShard(f"{name!r} is not stored one instance a chunk")
    filters = [made.get_filter(i)[0] for i in range(made.get_nfilters())]
    if filters not in ([_GZIP, _FLETCHER32], [_FLETCHER32]):
        raise CorruptShard(f"{name!r} has filters {filters}, not the schema's")
    chunk_bytes = int(np.prod(_chunks(shape), dtype=float)) * dataset.dtype.itemsize
    if chunk_bytes > schema.MAX_CHUNK_BYTES:
        raise CorruptShard(f"{name!r} takes {chunk_bytes} bytes an instance")
    dtype = np.dtype(f"S{dataset.get_type().get_size()}" if field.dtype == "S" else field.dtype)
    column = _Column(dataset, shape, dtype, compressed=filters[0] == _GZIP)
    found = len(column.places[0])
    if 0 not in shape and found != shape[0]:
        raise CorruptShard(f"{name!r} has {found} chunks for shape {shape}")
    return column


def _is_dtype(dataset: h5py.h5d.DatasetID, field: Field) -> bool:
    if field.dtype != "S":
        return dataset.dtype == np.dtype(field.dtype)
    stored = dataset.get_type()
    fixed = isinstance(stored, h5py.h5t.TypeStringID) and not stored.is_variable_str()
    return fixed and 1 <= stored.get_size() <= MAX_TEXT
