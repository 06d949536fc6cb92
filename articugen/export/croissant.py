"""Croissant metadata beside an export; of Parquet with a RecordSet for mlcroissant to read."""

from typing import Any

from articugen.core import schema
from articugen.export.formats import format_named
from articugen.export.target import Target
from articugen.store import croissant
from articugen.store.dataset import DataSet


def write(data: DataSet, to: str, target: Target) -> None:
    """Write croissant.json beside what was exported."""
    files = target.written
    distribution, records = croissant.listed(files), []
    if to == "parquet":
        columns = [file for file in files if file.name.endswith(".parquet")]
        distribution = [*croissant.objects(files), *croissant.file_sets(columns)]
        records = [_records(data)]
    name, about = f"{data.category}-{to}", _description(data, to)
    record = croissant.document(name, about, data.manifest, distribution, records)
    target.write(croissant.NAME, record)


def _description(data: DataSet, to: str) -> str:
    splits = ", ".join(f"{count} {name}" for name, count in data.splits.items())
    content = f" (content {data.manifest.content_sha256})" if data.manifest else ""
    return (
        f"{len(data)} instances ({splits}) of {len(data.objects)} objects of the category "
        f"{data.category}, each an object at one joint state{content}: {format_named(to).what}."
    )


def _records(data: DataSet) -> dict[str, Any]:
    """Return the columns of Parquet."""
    kinds = {"S": "sc:Text", "<f8": "sc:Float", "<f4": "sc:Float"}
    fields = []
    for name in sorted(data.fields):
        field = schema.field_of(name)
        assert field is not None
        fields.append({
            "@type": "cr:Field",
            "@id": f"instances/{name}",
            "name": name,
            "description": field.meaning,
            "dataType": kinds.get(field.dtype, "sc:Integer"),
            "source": {"fileSet": {"@id": "parquet-files"}, "extract": {"column": name}},
        })  # fmt: skip
    return {"@type": "cr:RecordSet", "@id": "instances", "name": "instances", "field": fields}
