"""HDF5 shards: the atomic writer and the distrustful reader (the only user of h5py).

A shard is built in memory, so that HDF5 never holds a half-written file and every fault of the disk
is an ordinary OSError; its bytes depend on nothing but the instances and attributes.
"""

import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any

import h5py
import h5py.h5l
import h5py.h5o
import numpy as np
from numpy.typing import NDArray

from articugen import schema
from articugen.errors import ArticugenError, CorruptShard
from articugen.files import UnfitFile, check_regular, write_atomically
from articugen.records import Instance
from articugen.schema import Field

_GZIP, _FLETCHER32 = 1, 3
_GZIP_LEVEL = 4
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


def write_shard(
    path: Path, instances: Iterable[Instance], attributes: Mapping[str, Attribute]
) -> ShardRecord:
    """Write a shard, read it back, compare, and only then give it its name.

    Args:
        path: the final name; a shard of that name is replaced, in one step.
        instances: one or more, all of the same field shapes.
        attributes: those of `schema.ATTRIBUTES` besides format and schema_version; more may follow.

    Raises:
        ArticugenError: the disk is full, the folder cannot be written to.
        ValueError: instances of different shapes, a missing attribute: faults of the caller.
    """
    rows = list(instances)
    given = {"format": schema.FORMAT, "schema_version": schema.SCHEMA_VERSION, **attributes}
    for name, (kind, _) in schema.ATTRIBUTES.items():
        if not isinstance(given.get(name), kind):
            raise ValueError(f"{path}: attribute {name!r} is missing or not of its type")
    image = _image(rows, given)
    content = content_digests(_columns(rows), [(row.object_id, row.state_index) for row in rows])

    def is_whole(temporary: Path) -> None:
        with open_shard(temporary) as shard:
            if shard.content() != content or dict(shard.attributes) != given:
                raise ArticugenError(f"{path}: reads back otherwise than written; check the disk")

    write_atomically(path, image, check=is_whole)
    sha256 = hashlib.sha256(image).hexdigest()
    return ShardRecord(path.name, sha256, len(image), len(rows), content)


def content_digests(
    columns: Iterable[tuple[str, NDArray[Any]]], instances: Sequence[tuple[str, int]]
) -> Content:
    """The SHA-256 of each instance's content, whatever the layout of the file that holds it.

    For every field but object_id, in the order of the names: one line "name dtype shape" with the
    little-endian dtype and the shape without N, then the bytes of the row in C order.

    Args:
        columns: (name, array (N, ...)) in the order of the names.
        instances: (object_id, state_index) of the N rows; the object_id is digested first.
    """
    digests = [hashlib.sha256(f"object_id {object_id}\n".encode()) for object_id, _ in instances]
    for name, array in columns:
        if name == "object_id":
            continue
        little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        line = f"{name} {little.dtype.str} {little.shape[1:]}\n".encode()
        for digest, row in zip(digests, little, strict=True):
            digest.update(line)
            digest.update(row.tobytes())
    return tuple(
        (object_id, state_index, digest.hexdigest())
        for (object_id, state_index), digest in zip(instances, digests, strict=True)
    )


def content_sha256(content: Iterable[tuple[Any, ...]]) -> str:
    """One digest of many: over their sorted lines, so that order and grouping do not matter."""
    lines = sorted("\x1f".join(map(str, entry)) for entry in content)
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def open_shard(path: Path) -> "Shard":
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
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._file, self._process = _opened(self.path), os.getpid()
        try:
            self.attributes: Mapping[str, Attribute] = MappingProxyType(_attributes(self._file))
            self.fields: Mapping[str, tuple[int, ...]] = MappingProxyType(_checked(self._file))
        except CorruptShard as error:
            self.close()
            raise CorruptShard(f"{self.path}: {error}; make it again or fetch it again") from None
        except (OSError, RuntimeError, ValueError, TypeError, KeyError) as error:
            self.close()
            raise CorruptShard(f"{self.path}: damaged ({error}); make it again") from None

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
        self._file.close()

    def read(self, name: str, index: int | slice = slice(None)) -> NDArray[Any]:
        """The rows of a data set: (...) for a number, (n, ...) for a slice.

        Raises:
            CorruptShard: the bytes fail their checksum.
            KeyError: the shard has no such data set.
        """
        try:
            return self._dataset(name)[index]
        except OSError as error:
            raise CorruptShard(
                f"{self.path}: {name}: damaged ({error}); make it again or fetch it again"
            ) from None

    def batch(self, indices: Sequence[int], names: Iterable[str]) -> dict[str, NDArray[Any]]:
        """Some fields (n, ...) of some instances, in the order asked for; repeats are allowed."""
        chosen, place = np.unique(np.asarray(indices, np.intp), return_inverse=True)
        batch: dict[str, NDArray[Any]] = {}
        for name in names:
            shape = self.fields[name]
            rows = np.empty((len(chosen), *shape[1:]), self._dataset(name).dtype)
            for row, index in enumerate(chosen):
                rows[row] = self.read(name, int(index))
            batch[name] = rows[place]
        return batch

    def instance(self, index: int) -> Instance:
        """The record that was written as row `index`.

        Raises:
            CorruptShard: the bytes fail their checksum.
            IndexError: there is no such row.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"{self.path}: no instance {index}, there are {len(self)}")
        row: dict[str, Any] = {name: self.read(name, index) for name in self.fields}
        grids = {
            int(name.rpartition("_")[2]): row.pop(name)
            for name in list(row)
            if name.startswith("occupancy_")
        }
        row["object_id"] = self._text(row["object_id"])
        row["state_index"], row["scale"] = int(row["state_index"]), float(row["scale"])
        return Instance(occupancy=MappingProxyType(dict(sorted(grids.items()))), **row)

    def object_ids(self) -> tuple[str, ...]:
        """The object of each instance."""
        return tuple(self._text(text) for text in self.read("object_id"))

    def content(self) -> Content:
        """The digest of each instance, computed from what is stored."""
        states = self.read("state_index").tolist()
        columns = ((name, self.read(name)) for name in sorted(self.fields))
        return content_digests(columns, list(zip(self.object_ids(), states, strict=True)))

    def stored_bytes(self, name: str) -> int:
        """What a data set takes in the file, after compression, without its index."""
        return self._dataset(name).id.get_storage_size()

    def _dataset(self, name: str) -> h5py.Dataset:
        if self._process != os.getpid():
            self._file, self._process = _opened(self.path), os.getpid()
        dataset = self._file[name]
        assert isinstance(dataset, h5py.Dataset)  # _checked has seen to it
        return dataset

    def _text(self, text: bytes) -> str:
        try:
            return text.decode()
        except UnicodeDecodeError:
            raise CorruptShard(f"{self.path}: object_id {text!r} is not UTF-8") from None


def _columns(rows: Sequence[Instance]) -> Iterator[tuple[str, NDArray[Any]]]:
    """(name, array (N, ...)) of each field as it is stored, in the order of the names.

    One at a time: all at once, they would take as much memory again as the instances.
    """
    arrays = [row.arrays() for row in rows]
    for name in sorted(arrays[0]):
        field = schema.field_of(name)
        if field is None or any(other.keys() != arrays[0].keys() for other in arrays):
            raise ValueError(f"{name}: not in the schema, or not in every instance of the shard")
        column = [row[name] for row in arrays]
        if field.dtype == "S":
            yield name, np.array([text.encode() for text in column])
        else:
            yield name, np.stack([np.asarray(value, field.dtype) for value in column])


def _image(rows: Sequence[Instance], attributes: Mapping[str, Attribute]) -> bytes:
    """The bytes of the HDF5 file. Format v110 (HDF5 1.10, 2016) has checksums on its metadata."""
    fault = schema.misfit({name: array.shape for name, array in _columns(rows)})
    if fault:
        raise ValueError(f"instances that do not make a shard: {fault}")
    with h5py.File(
        "shard.h5", "w", driver="core", backing_store=False, block_size=1 << 22, libver="v110"
    ) as file:
        _describe(file, attributes)
        for name, array in _columns(rows):
            _add(file, name, array)
        file.flush()
        return file.id.get_file_image()


def _add(file: h5py.File, name: str, array: NDArray[Any]) -> None:
    """One data set, one instance a chunk, with what the schema says of it as attributes."""
    field = schema.field_of(name)
    assert field is not None  # _columns has seen to it
    if array[0].nbytes > schema.MAX_CHUNK_BYTES:
        raise ValueError(f"{name}: {array[0].nbytes} bytes an instance; ask for fewer samples")
    if field.dtype == "S":
        array = array.astype(h5py.string_dtype("utf-8", array.itemsize))
    dataset = file.create_dataset(
        name,
        data=array,
        chunks=_chunks(array.shape),
        # An empty data set has to be allowed to grow before h5py accepts chunks for it.
        maxshape=tuple(size or None for size in array.shape),
        compression=_GZIP_LEVEL if field.compressed else None,
        fletcher32=True,
        track_times=False,
    )
    described = {
        "shape": schema.written_shape(field),
        "unit": field.unit,
        "frame": field.frame,
        "meaning": field.meaning,
    }
    _describe(dataset, {key: text for key, text in described.items() if text})


def _chunks(shape: tuple[int, ...]) -> tuple[int, ...]:
    return (1, *(max(size, 1) for size in shape[1:]))


def _describe(where: h5py.File | h5py.Dataset, attributes: Mapping[str, Attribute]) -> None:
    for name, value in attributes.items():
        if isinstance(value, str):
            text = value.encode()
            if len(text) > _MAX_ATTRIBUTE_BYTES:
                raise ValueError(f"attribute {name!r} takes {len(text)} bytes")
            stored = h5py.string_dtype("utf-8", max(len(text), 1))
            where.attrs.create(name, np.array(text, stored), dtype=stored)
        else:
            where.attrs.create(name, value, dtype="<i8" if isinstance(value, int) else "<f8")


def _opened(path: Path) -> h5py.File:
    """Without HDF5's file lock, which network file systems lack: a shard never changes."""
    try:
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
    """The file's attributes; their types and sizes are looked at before anything is read."""
    names = list(file.attrs)
    if len(names) > _MAX_ATTRIBUTES:
        raise CorruptShard(f"{len(names)} attributes")
    attributes = {name: _attribute(file, name) for name in names}
    if attributes.get("format") != schema.FORMAT:
        raise CorruptShard("an HDF5 file, but not an articugen shard")
    version = attributes.get("schema_version")
    if version != schema.SCHEMA_VERSION:
        raise CorruptShard(
            f"schema version {version}, this articugen reads {schema.SCHEMA_VERSION} only"
        )
    for name, (kind, _) in schema.ATTRIBUTES.items():
        if not isinstance(attributes.get(name), kind):
            raise CorruptShard(f"attribute {name!r} is missing or not of its type")
    return attributes


def _attribute(file: h5py.File, name: str) -> Attribute:
    stored = h5py.h5a.open(file.id, name.encode("utf-8", "surrogateescape"))
    is_text = isinstance(stored.get_type(), h5py.h5t.TypeStringID)
    plain = stored.shape == () and stored.get_storage_size() <= _MAX_ATTRIBUTE_BYTES
    if is_text and plain and not stored.get_type().is_variable_str():
        value = file.attrs[name]
        return value.decode() if isinstance(value, bytes) else str(value)
    if plain and not is_text and stored.dtype in (np.dtype("<i8"), np.dtype("<f8")):
        return np.asarray(file.attrs[name]).item()
    raise CorruptShard(f"attribute {name!r} is neither a number nor a text of a fixed length")


def _checked(file: h5py.File) -> dict[str, tuple[int, ...]]:
    """The shape of every data set, once all is as the schema says."""
    shapes: dict[str, tuple[int, ...]] = {}
    for name in map(str, file):
        field = schema.field_of(name)
        if field is None:
            raise CorruptShard(f"{name!r} is not in the schema")
        if file.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
            raise CorruptShard(f"{name!r} is a link to elsewhere")
        if h5py.h5o.get_info(file.id, name.encode()).type != h5py.h5o.TYPE_DATASET:
            raise CorruptShard(f"{name!r} is not a data set")
        shapes[name] = _checked_dataset(h5py.h5d.open(file.id, name.encode()), name, field)
    fault = schema.misfit(shapes)
    if fault:
        raise CorruptShard(fault)
    return shapes


def _checked_dataset(dataset: h5py.h5d.DatasetID, name: str, field: Field) -> tuple[int, ...]:
    shape = dataset.shape
    if shape is None or not _is_dtype(dataset, field):
        raise CorruptShard(f"{name!r} is not of dtype {field.dtype}")
    made = dataset.get_create_plist()
    if made.get_layout() != h5py.h5d.CHUNKED or made.get_chunk() != _chunks(shape):
        raise CorruptShard(f"{name!r} is not stored one instance a chunk")
    filters = [made.get_filter(i)[0] for i in range(made.get_nfilters())]
    if filters != ([_GZIP] if field.compressed else []) + [_FLETCHER32]:
        raise CorruptShard(f"{name!r} has filters {filters}, not the schema's")
    chunk_bytes = int(np.prod(_chunks(shape), dtype=float)) * dataset.dtype.itemsize
    if chunk_bytes > schema.MAX_CHUNK_BYTES:
        raise CorruptShard(f"{name!r} takes {chunk_bytes} bytes an instance")
    if 0 not in shape and dataset.get_num_chunks() != shape[0]:
        raise CorruptShard(f"{name!r} has {dataset.get_num_chunks()} chunks for shape {shape}")
    return shape


def _is_dtype(dataset: h5py.h5d.DatasetID, field: Field) -> bool:
    if field.dtype != "S":
        return dataset.dtype == np.dtype(field.dtype)
    stored = dataset.get_type()
    fixed = isinstance(stored, h5py.h5t.TypeStringID) and not stored.is_variable_str()
    return fixed and 1 <= stored.get_size() <= schema.MAX_TEXT
