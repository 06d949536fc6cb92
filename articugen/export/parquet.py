"""Parquet: every stored field of every instance, for the hub of Hugging Face, and for data frames.

Numbers are what shards hold, bit for bit; docs/format.md says what each means and how whole numbers
become coordinates. All files have one schema, whatever the objects' numbers of joints, and name
the shapes to `datasets`, which it then gives as arrays and not as lists of lists. The first column
is a picture, which the hub's viewer shows.
"""

import json
import os
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from articugen.core import schema
from articugen.core.arrays import Floats
from articugen.export.formats import Format
from articugen.export.items import Item, file_name
from articugen.export.target import Files, Target
from articugen.pictures.camera import Camera
from articugen.pictures.contact_sheet import evenly
from articugen.pictures.layout import png
from articugen.pictures.portrait import (
    best_azimuth,
    instance_of,
    plain_portrait,
    pooled,
    swept,
    tile_camera,
)
from articugen.pictures.shading import Picture
from articugen.pictures.surfels import Surfels
from articugen.store.dataset import DataSet

if TYPE_CHECKING:
    import pyarrow

_IMAGE, _TEXTS = "image", ("split", "category")

_HUB = json.dumps({"info": {"features": {_IMAGE: {"_type": "Image"}}}})
"""The column that `datasets` is to decode; the others follow from their types."""

_POOLED, _SIDE = 3, 96
"""Instances whose points make a picture; pixels along its edge."""

_EXTENSION = "datasets.features.features.Array{}DExtensionType"
"""How `datasets` marks the columns that it gives as arrays; to readers that do not know it they are
nested lists."""


def _items(data: DataSet) -> Iterator[Item]:
    """Yield a file an object, numbered as Hugging Face numbers the files of a split."""
    for split in data.splits:
        objects = list(data.split(split).by_object())
        for number, (_, rows) in enumerate(objects):
            name = f"data/{file_name(split)}-{number:05d}-of-{len(objects):05d}"
            yield Item(name, rows)


@dataclass(frozen=True, eq=False)
class _Model:
    """An object to draw: its discs in the canonical pose, and a camera."""

    discs: Surfels
    camera: Camera

    @staticmethod
    def of(rows: DataSet) -> "_Model":
        instances = [instance_of(row) for row in evenly(rows, _POOLED)]
        azimuth = best_azimuth(instances[-1:])
        return _Model(pooled(instances), tile_camera(swept(instances[0]), azimuth, _SIDE))

    def at(self, T_part: Floats) -> Picture:
        return plain_portrait(self.discs, T_part, self.camera)


def _write(item: Item, target: Files) -> None:
    import pyarrow as pa  # noqa: PLC0415 - optional
    from pyarrow import parquet  # noqa: PLC0415

    layout = _layout(item.rows.fields)
    model = _Model.of(item.rows) if item.rows.fields["surface_points"][0] > 1 else None

    def picture(number: int) -> dict[str, Any] | None:
        motion = item.rows[number].stored("part_motion")
        # left to the zstd of the file, which makes as little of it as zlib would
        return {"bytes": png(model.at(motion), level=0), "path": None} if model else None

    with (
        target.opened(f"{item.key}.parquet") as file,
        parquet.ParquetWriter(file, layout, compression="zstd") as writer,
        ThreadPoolExecutor(os.cpu_count()) as pool,
    ):
        for row, image in zip(item.rows, pool.map(picture, range(len(item.rows))), strict=True):
            texts = {"split": row.split, "category": row.category}
            columns = [pa.array([image], layout.field(_IMAGE).type)]
            for field in list(layout)[1:]:
                if field.name in texts or field.name in row.fields:
                    value = texts.get(field.name) or row.stored(field.name)
                    columns.append(_column(value, field.type))
                else:
                    columns.append(pa.nulls(1, field.type))
            writer.write_table(pa.Table.from_arrays(columns, schema=layout))


def _layout(shapes: Mapping[str, tuple[int, ...]]) -> "pyarrow.Schema":
    """Return the columns, the same for all objects of a data set.

    Fields and their shapes follow from the recipe, but for the numbers of joints and parts, and for
    names, which one model has and another has not.
    """
    import pyarrow as pa  # noqa: PLC0415

    image = pa.struct({"bytes": pa.binary(), "path": pa.string()})
    columns = [pa.field(_IMAGE, image), *(pa.field(name, pa.string()) for name in _TEXTS)]
    for field in schema.FIELDS:
        is_text = field.dtype == "S"
        for name in [field.name] if is_text else filter(field.matches, shapes):
            sizes = shapes.get(name, (0,) * (len(field.shape) - 1))
            kind = pa.string() if is_text else pa.from_numpy_dtype(np.dtype(field.dtype))
            about = {"unit": field.unit, "frame": field.frame, "meaning": field.meaning}
            shape = [
                None if letter in ("J", "P") else size
                for letter, size in zip(field.shape[1:], sizes, strict=True)
            ]
            if len(shape) > 1:
                about["ARROW:extension:name"] = _EXTENSION.format(len(shape))
                about["ARROW:extension:metadata"] = json.dumps([shape, np.dtype(field.dtype).name])
            for size in reversed(shape):
                kind = pa.list_(kind, -1 if not size or len(shape) > 1 else size)
            columns.append(pa.field(name, kind, metadata={k: v for k, v in about.items() if v}))
    return pa.schema(columns, {"huggingface": _HUB})


def _column(value: Any, kind: "pyarrow.DataType") -> "pyarrow.Array":
    """Return one value as a column of one row."""
    import pyarrow as pa  # noqa: PLC0415

    shape, kinds = np.shape(value), [kind]
    if 0 in shape:
        return pa.array([np.asarray(value).tolist()], kind)
    while not pa.types.is_primitive(kinds[-1]) and kinds[-1] != pa.string():
        kinds.append(kinds[-1].value_type)
    leaf = kinds.pop()
    flat = [value] if isinstance(value, str) else np.ravel(value)
    column = pa.array(list(map(str, flat)) if leaf == pa.string() else flat, leaf)
    for above, size in zip(reversed(kinds), reversed(shape), strict=True):
        if pa.types.is_fixed_size_list(above):
            column = pa.FixedSizeListArray.from_arrays(column, size)
        else:
            ends = np.arange(len(column) // size + 1, dtype=np.int32) * size
            column = pa.ListArray.from_arrays(ends, column)
    return column


def _finish(data: DataSet, target: Target) -> None:
    """Write the card that Hugging Face shows."""
    licence = data.manifest.licence if data.manifest else "unknown"
    known = licence.lower() in _LICENCES
    size = next((name for most, name in _SIZES.items() if len(data) < most), _SIZES[1e7])
    counts = [
        f"| {file_name(name)} | {len(data.split(name).objects):,} | {count:,} |"
        for name, count in data.splits.items()
    ]
    splits = [
        f"  - split: {file_name(name)}\n    path: data/{file_name(name)}-*" for name in data.splits
    ]
    target.write("README.md", _CARD.format(
        name=json.dumps(f"{data.category}, made by articugen"), category=data.category,
        licence=licence.lower() if known else f"other\nlicense_name: {json.dumps(licence)}",
        size=size, splits="\n".join(splits), counts="\n".join(counts),
    ).encode())  # fmt: skip


_LICENCES = {"mit", "cc0-1.0", "cc-by-4.0", "cc-by-sa-4.0", "cc-by-nc-4.0", "apache-2.0"}
"""Those that the hub knows by these names."""

_SIZES = {1e3: "n<1K", 1e4: "1K<n<10K", 1e5: "10K<n<100K", 1e6: "100K<n<1M", 1e7: "1M<n<10M"}
"""The hub's words for numbers of rows below these."""

_CARD = """---
pretty_name: {name}
license: {licence}
size_categories:
- {size}
task_categories:
- robotics
tags:
- 3d
- articulated-objects
- robotics
- point-cloud
- occupancy
configs:
- config_name: default
  data_files:
{splits}
---
# {category}

Each row is an object at one joint state. Columns are the fields of articugen's format, as stored:
points are `stored / 65535 - 0.5` in the unit frame, normals `stored / 127`.

| split | objects | rows |
|---|---:|---:|
{counts}
"""

FORMAT = Format(
    "every stored field, bit for bit, and pictures; what Hugging Face's hub shows",
    _items,
    _write,
    _finish,
    needs=(("pyarrow", "export"),),
)
