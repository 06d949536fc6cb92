"""Parquet: every stored field of every instance, for Hugging Face `datasets` and data frames.

Numbers are what shards hold, bit for bit; docs/format.md says what each means and how whole numbers
become coordinates. Nested fixed-size lists keep the shapes.
"""

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from articugen.export.formats import Format, Item
from articugen.export.items import file_name
from articugen.export.target import Target
from articugen.store import schema
from articugen.store.dataset import DataSet
from articugen.store.rows import Row

if TYPE_CHECKING:
    from collections.abc import Iterator

    import pyarrow

_TEXTS = ("split", "category")


def _items(data: DataSet) -> "Iterator[Item]":
    """A file an object, numbered as Hugging Face numbers the files of a split."""
    for split in data.splits:
        objects = list(data.split(split).by_object())
        for number, (_, rows) in enumerate(objects):
            name = f"data/{file_name(split)}-{number:05d}-of-{len(objects):05d}"
            yield Item(name, rows)


def _write(item: Item, target: Target) -> None:
    from pyarrow import parquet  # noqa: PLC0415 - optional

    layout = _layout(item.rows[0])
    with (
        target.opened(f"{item.key}.parquet") as file,
        parquet.ParquetWriter(file, layout, compression="zstd") as writer,
    ):
        for row in item.rows:
            writer.write_table(_table(row, layout))


def _layout(row: Row) -> "pyarrow.Schema":
    """The columns of an object's instances; the shapes of its fields are in them."""
    import pyarrow as pa  # noqa: PLC0415

    columns = [pa.field(name, pa.string()) for name in _TEXTS]
    for name in row.fields:
        value = row.stored(name)
        kind, shape = _kind(name, value)
        for size in reversed(shape):
            kind = pa.list_(kind, size)
        field = schema.field_of(name)
        assert field is not None
        about = {"unit": field.unit, "frame": field.frame, "meaning": field.meaning}
        columns.append(pa.field(name, kind, metadata={k: v for k, v in about.items() if v}))
    return pa.schema(columns)


def _kind(name: str, value: Any) -> tuple[Any, tuple[int, ...]]:
    import pyarrow as pa  # noqa: PLC0415

    field = schema.field_of(name)
    if field is not None and field.dtype == "S":
        return pa.string(), () if isinstance(value, str) else (len(value),)
    array = np.asarray(value)
    return pa.from_numpy_dtype(array.dtype.newbyteorder("=")), array.shape


def _table(row: Row, layout: "pyarrow.Schema") -> "pyarrow.Table":
    import pyarrow as pa  # noqa: PLC0415

    told = {"split": row.split, "category": row.category}
    columns = []
    for field in layout:
        value = told.get(field.name) or row.stored(field.name)
        columns.append(_column(value, field.type))
    return pa.Table.from_arrays(columns, schema=layout)


def _column(value: Any, kind: "pyarrow.DataType") -> "pyarrow.Array":
    """One value as a column of one row."""
    import pyarrow as pa  # noqa: PLC0415

    sizes, leaf = [], kind
    while pa.types.is_fixed_size_list(leaf):
        sizes.append(leaf.list_size)
        leaf = leaf.value_type
    flat = [value] if isinstance(value, str) else np.ravel(value)
    column = pa.array(list(map(str, flat)) if leaf == pa.string() else flat, leaf)
    for size in reversed(sizes):
        column = pa.FixedSizeListArray.from_arrays(column, size)
    return column


def _finish(data: DataSet, target: Target) -> None:
    """The card that Hugging Face reads: which files are which split, and what scales what."""
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
