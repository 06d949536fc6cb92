"""Parquet: every stored field of every instance, for Hugging Face `datasets` and data frames.

Numbers are what shards hold, bit for bit; docs/format.md says what each means and how whole numbers
become coordinates. All files have one schema, whatever the objects' numbers of joints, and name
the shapes to `datasets`, which it then gives as arrays and not as lists of lists.
"""

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from articugen.core import schema
from articugen.export.formats import Format
from articugen.export.items import Item, file_name
from articugen.export.target import Target
from articugen.store.dataset import DataSet

if TYPE_CHECKING:
    from collections.abc import Iterator

    import pyarrow

_TEXTS = ("split", "category")

_EXTENSION = "datasets.features.features.Array{}DExtensionType"
"""How `datasets` marks the columns that it gives as arrays; to readers that do not know it they are
nested lists."""


def _items(data: DataSet) -> "Iterator[Item]":
    """Yield a file an object, numbered as Hugging Face numbers the files of a split."""
    for split in data.splits:
        objects = list(data.split(split).by_object())
        for number, (_, rows) in enumerate(objects):
            name = f"data/{file_name(split)}-{number:05d}-of-{len(objects):05d}"
            yield Item(name, rows)


def _write(item: Item, target: Target) -> None:
    import pyarrow as pa  # noqa: PLC0415 - optional
    from pyarrow import parquet  # noqa: PLC0415

    layout = _layout(item.rows.fields)
    with (
        target.opened(f"{item.key}.parquet") as file,
        parquet.ParquetWriter(file, layout, compression="zstd") as writer,
    ):
        for row in item.rows:
            texts = {"split": row.split, "category": row.category}
            columns = []
            for field in layout:
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

    columns = [pa.field(name, pa.string()) for name in _TEXTS]
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
                kind = pa.list_(kind, -1 if size is None or len(shape) > 1 else size)
            columns.append(pa.field(name, kind, metadata={k: v for k, v in about.items() if v}))
    return pa.schema(columns)


def _column(value: Any, kind: "pyarrow.DataType") -> "pyarrow.Array":
    """Return one value as a column of one row."""
    import pyarrow as pa  # noqa: PLC0415

    shape, kinds = np.shape(value), [kind]
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
    """Write the card that Hugging Face reads: which files are which split, and what scales what."""
    licence = data.manifest.licence if data.manifest else "unknown"
    splits = "\n".join(
        f"  - split: {file_name(name)}\n    path: data/{file_name(name)}-*" for name in data.splits
    )
    target.write("README.md", _CARD.format(
        name=json.dumps(f"{data.category}, made by articugen"), licence=json.dumps(licence),
        splits=splits, category=data.category,
    ).encode())  # fmt: skip


_CARD = """---
pretty_name: {name}
license_name: {licence}
license: other
configs:
- config_name: default
  data_files:
{splits}
---
# {category}

Each row is an object at one joint state. Columns are the fields of articugen's format, as stored:
points are `stored / 65535 - 0.5` in the unit frame, normals `stored / 127`.
"""

FORMAT = Format(
    "every stored field, bit for bit; loads with Hugging Face datasets",
    _items,
    _write,
    _finish,
    needs=(("pyarrow", "export"),),
)
