"""The writer of shards: atomic, one instance at a time, read back before the file gets its name.

The bytes depend on nothing but the instances and attributes.
"""

import io
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import h5py.h5l
import h5py.h5o
import numpy as np
from numpy.typing import NDArray

from articugen.core import schema
from articugen.core.errors import ArticugenError, CorruptShard
from articugen.core.files import sha256_of, sync, written_atomically
from articugen.core.schema import MAX_TEXT, Field, Instance
from articugen.store import chunks
from articugen.store.columns import MAX_ATTRIBUTE_BYTES, Attribute, opened
from articugen.store.shards import ShardRecord, content_row, open_shard

Check = Callable[[Path, ShardRecord], None]
"""Examines a shard that is whole but has not its name yet, and raises where it must not get it."""


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
    values = {"format": schema.FORMAT, "schema_version": schema.SCHEMA_VERSION, **attributes}
    for name, (kind, _) in schema.ATTRIBUTES.items():
        if not isinstance(values.get(name), kind):
            raise ValueError(f"{path}: attribute {name!r} is missing or not of its type")
    content: list[tuple[str, int, str]] = []
    record = ShardRecord(path.name, "", 0, 0, ())

    def look(temporary: Path) -> None:
        nonlocal record
        with open_shard(temporary) as shard:
            if shard.content() != tuple(content) or dict(shard.attributes) != values:
                raise ArticugenError(f"{path}: reads back otherwise than written; check the disk")
        size = temporary.stat().st_size
        record = ShardRecord(path.name, sha256_of(temporary), size, len(content), tuple(content))
        if check is not None:
            check(temporary, record)

    with written_atomically(path, check=look) as file:
        disk = Disk(file)
        with new_hdf5(disk, libver="v110") as hdf5:  # 2016: with checksums on its metadata
            _describe_file(hdf5, values)
            for row in _written(hdf5, instances):
                content.append(row)
                if disk.fault is not None:
                    break
    return record


def copy_user_group(path: Path, into: Path, written: int) -> None:
    """Copy the group `user`, if any, of a file that may be damaged, or not be there, into a shard,
    which is otherwise left as it is. A file of more bytes than were `written` may have one:
    CorruptShard if that cannot be read, or if that is unknown."""
    if not os.path.lexists(path):
        return
    is_there = path.stat().st_size > written
    try:
        with opened(path) as theirs:
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
    """An HDF5 file on `disk`, with h5py's options; OSError as the disk gave it."""
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
        arrays = stored_arrays(row)
        if not datasets:
            shapes = {name: array.shape for name, array in arrays.items()}
            datasets = {name: _new_dataset(file, name, array) for name, array in arrays.items()}
        if {name: array.shape for name, array in arrays.items()} != shapes:
            raise ValueError("instances that do not make a shard: of different fields or shapes")
        for name, array in arrays.items():
            datasets[name].set_extent((count + 1, *array.shape))
            if array.size:
                chunk = chunks.encoded(array.tobytes(), compressed=_field(name).compressed)
                datasets[name].write_direct_chunk((count, *(0,) * array.ndim), chunk)
        count += 1
        yield content_row(row.object_id, arrays)
    fault = schema.misfit({name: (count, *shape) for name, shape in shapes.items()})
    if fault:
        raise ValueError(f"instances that do not make a shard: {fault}")


def stored_arrays(row: Instance) -> dict[str, NDArray[Any]]:
    """Return each field of an instance as it is stored, in the order of the names."""
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
    """Return a data set without rows yet, with what the schema says of it as attributes."""
    field = _field(name)
    dataset = file.create_dataset(
        name,
        shape=(0, *row.shape),
        dtype=h5py.string_dtype("utf-8", row.itemsize) if field.dtype == "S" else row.dtype,
        chunks=chunks.shape_of((0, *row.shape)),
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


def _describe_file(file: h5py.File, attributes: Mapping[str, Attribute]) -> None:
    """Write the attributes twice: as anyone reads them, and together as HDF5 checks them."""
    text = json.dumps(attributes, ensure_ascii=False, sort_keys=True).encode()
    if len(text) > MAX_ATTRIBUTE_BYTES:
        raise ValueError(f"attributes of {len(text)} bytes")
    fixed = h5py.string_dtype("utf-8", len(text))
    file.attrs.create(schema.CHECKED_ATTRIBUTES, np.array(text, fixed), dtype=fixed)
    for name, value in attributes.items():
        if isinstance(value, str):
            file.attrs[name] = value
        else:
            file.attrs.create(name, value, dtype="<i8" if isinstance(value, int) else "<f8")
