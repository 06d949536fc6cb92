"""WebDataset: tar files of samples, streamed from disks and buckets without an index.

A sample is `<name>.npz` with points, labels and joints in units, and `<name>.json` with names.
"""

import io
import json
import tarfile
from collections.abc import Iterator

import numpy as np

from articugen.core import schema
from articugen.export.formats import Format
from articugen.export.items import Item, file_name, instance_name
from articugen.export.target import Files, npz
from articugen.store.dataset import DataSet
from articugen.store.rows import Row, in_units, is_scaled

_PER_FILE = 256  # samples of a tar: about 100 MB


def _items(data: DataSet) -> Iterator[Item]:
    for split in data.splits:
        rows = data.split(split)
        for number, first in enumerate(range(0, len(rows), _PER_FILE)):
            yield Item(f"{file_name(split)}-{number:06d}", rows[first : first + _PER_FILE])


def _write(item: Item, target: Files) -> None:
    with (
        target.opened(f"{item.key}.tar") as file,
        tarfile.open(fileobj=file, mode="w", format=tarfile.USTAR_FORMAT) as tar,
    ):
        for row in item.rows:
            name = instance_name(row)
            _add(tar, f"{name}.npz", _arrays(row))
            about = {
                "object_id": row.object_id,
                "state_index": row.state_index,
                "split": row.split,
                "category": row.category,
                "joint_name": [joint.name for joint in row.joints],
                "joint_kind": [joint.kind for joint in row.joints],
                "part_name": [part.name for part in row.parts],
                "part_semantic": [part.semantic for part in row.parts],
            }
            _add(tar, f"{name}.json", json.dumps(about, ensure_ascii=False).encode())


def _add(tar: tarfile.TarFile, name: str, data: bytes) -> None:
    entry = tarfile.TarInfo(name)
    entry.size = len(data)
    tar.addfile(entry, io.BytesIO(data))


def _arrays(row: Row) -> bytes:
    """Return every field that is numbers, in units: points float32 in the unit frame."""
    arrays = {}
    for name in row.fields:
        field = schema.field_of(name)
        if field is not None and field.dtype != "S":
            stored = row.stored(name)
            arrays[name] = in_units(name, stored) if is_scaled(name) else np.asarray(stored)
    return npz(arrays, compressed=True)


FORMAT = Format("tar files of samples, points in units; for webdataset", _items, _write)
