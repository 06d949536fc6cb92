"""A shard opened distrustfully: its attributes, and its data sets once they are as the schema says.

Nothing is read before its type and size are checked.
"""

import json
import math
import os
import re
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import h5py.h5l
import h5py.h5o
import numpy as np
from numpy.typing import NDArray

from articugen.core import schema
from articugen.core.errors import CorruptShard, machine_fault
from articugen.core.files import UnfitFile, open_regular
from articugen.core.schema import MAX_TEXT, Field
from articugen.store import chunks
from articugen.store.bucket import Remote
from articugen.store.remote import RangeFile

_GZIP, _FLETCHER32 = 1, 3
_MAX_ATTRIBUTES = 64
MAX_ATTRIBUTE_BYTES = 60_000
"""An HDF5 object header has no room for more than 64 kB."""

Attribute = str | int | float


@dataclass(frozen=True, eq=False)
class Column:
    """A data set that was checked, of one chunk a row: where each row lies in the file.

    Rows are read without HDF5, whose handles are slow to open and neither process nor thread may
    share.

    Attributes:
        shape: (N, ...).
        dtype: of what is stored.
        compressed: whether with gzip.
        offset, size: (N,) bytes: where the chunk of each row begins, and how long it is; 0 bytes of
            one that was stored without its checksum.
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
        """Return where a row's bytes begin in the file, and how many they are; 0 if it has none."""
        if not self.row_bytes:
            return 0, 0
        return int(self.offset[row]), min(int(self.size[row]), chunks.most_bytes(self.row_bytes))

    def row(self, stored: bytes) -> NDArray[Any]:
        """Return (...) read-only, of the bytes in its `span`; ValueError where they are damaged."""
        if not self.row_bytes:
            return np.zeros(self.shape[1:], self.dtype)
        if len(stored) <= chunks.CHECKSUM_BYTES:
            raise ValueError("a chunk without its checksum, or cut short")
        data = chunks.decoded(memoryview(stored), self.row_bytes, compressed=self.compressed)
        return np.frombuffer(data, self.dtype).reshape(self.shape[1:])


def opened(path: Path | Remote) -> h5py.File:
    """Open a file without HDF5's lock, which network file systems lack: a shard never changes."""
    try:
        if isinstance(path, Remote):
            return h5py.File(RangeFile(path), "r")
        open_regular(path, sys.maxsize).close()  # HDF5 would wait for a FIFO's writer
        return h5py.File(path, "r", locking=False)
    except UnfitFile as error:
        raise CorruptShard(f"{path}: {error.strerror}; move it away") from None
    except (FileNotFoundError, IsADirectoryError, PermissionError) as error:
        reason = os.strerror(error.errno or 0)
        raise CorruptShard(f"{path}: cannot be opened ({reason})") from None
    except OSError as error:
        raise machine_fault(error) or CorruptShard(
            f"{path}: not an HDF5 file, or cut short; make it again or fetch it again"
        ) from None


def attributes_of(file: h5py.File) -> dict[str, Attribute]:
    """Read the file's attributes; their types and sizes are checked before anything is read.

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
    plain = stored.shape == () and stored.get_storage_size() <= MAX_ATTRIBUTE_BYTES
    if is_text and plain and not stored.get_type().is_variable_str():
        value = file.attrs[name]
        return value.decode() if isinstance(value, bytes) else str(value)
    if plain and not is_text and stored.dtype in (np.dtype("<i8"), np.dtype("<f8")):
        return np.asarray(file.attrs[name]).item()
    raise CorruptShard(f"attribute {name!r} is neither a number nor a text of a fixed length")


def columns_of(file: h5py.File) -> dict[str, Column]:
    """Return every data set, once all is as the schema says; CorruptShard if it is not."""
    columns: dict[str, Column] = {}
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


def _checked_dataset(dataset: h5py.h5d.DatasetID, name: str, field: Field) -> Column:
    shape = dataset.shape
    if shape is None or not _is_dtype(dataset, field):
        raise CorruptShard(f"{name!r} is not of dtype {field.dtype}")
    settings = dataset.get_create_plist()
    if settings.get_layout() != h5py.h5d.CHUNKED or settings.get_chunk() != chunks.shape_of(shape):
        raise CorruptShard(f"{name!r} is not stored one instance a chunk")
    filters = [settings.get_filter(i)[0] for i in range(settings.get_nfilters())]
    if filters not in ([_GZIP, _FLETCHER32], [_FLETCHER32]):
        raise CorruptShard(f"{name!r} has filters {filters}, not the schema's")
    chunk_bytes = int(np.prod(chunks.shape_of(shape), dtype=float)) * dataset.dtype.itemsize
    if chunk_bytes > schema.MAX_CHUNK_BYTES:
        raise CorruptShard(f"{name!r} takes {chunk_bytes} bytes an instance")
    dtype = np.dtype(f"S{dataset.get_type().get_size()}" if field.dtype == "S" else field.dtype)
    offset, size = _places(dataset, shape, math.prod(shape[1:]) * dtype.itemsize)
    if 0 not in shape and len(offset) != shape[0]:
        raise CorruptShard(f"{name!r} has {len(offset)} chunks for shape {shape}")
    return Column(shape, dtype, filters[0] == _GZIP, offset, size)


def _places(
    dataset: h5py.h5d.DatasetID, shape: tuple[int, ...], row_bytes: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return where the chunks of the first rows begin, and their bytes: see `Column`. As many as
    there are rows, unless one is missing.

    HDF5 believes an index that says how many chunks there could be, and goes through 10^18 of them
    where it finds none: it is stopped at the last row, once that is known to be there. It refuses a
    chunk that is larger than the room for it, so no index can ask for more.
    """
    places: list[tuple[int, int]] = []

    def note(chunk: Any) -> bool | None:
        if chunk.chunk_offset[0] != len(places):
            return True
        places.append((chunk.byte_offset, 0 if chunk.filter_mask else chunk.size))
        return True if len(places) == shape[0] else None

    if row_bytes and shape[0]:
        last, room = (shape[0] - 1, *(0,) * (len(shape) - 1)), chunks.most_bytes(row_bytes)
        with suppress(OSError, RuntimeError, ValueError):
            dataset.read_direct_chunk(last, out=np.empty(room, np.uint8))
            dataset.chunk_iter(note)
    offset, size = np.array(places, np.int64).reshape(-1, 2).T
    return offset, size


def _is_dtype(dataset: h5py.h5d.DatasetID, field: Field) -> bool:
    if field.dtype != "S":
        return dataset.dtype == np.dtype(field.dtype)
    stored = dataset.get_type()
    fixed = isinstance(stored, h5py.h5t.TypeStringID) and not stored.is_variable_str()
    return fixed and 1 <= stored.get_size() <= MAX_TEXT
