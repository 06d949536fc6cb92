"""Croissant 1.1: what an export is, for machines that look for data sets.

Every file is there with its digest, as one FileObject, or where there are many, as a FileSet. Of
Parquet there is a RecordSet too, which mlcroissant can read records from.
"""

import json
from typing import Any

from articugen import __version__
from articugen.export.formats import format_named
from articugen.export.target import Target, Written
from articugen.store import schema
from articugen.store.dataset import DataSet
from articugen.store.manifest import Manifest

NAME = "croissant.json"

_MOST_OBJECTS = 100
"""Files that are listed one by one; more are a FileSet, and export.json has their digests."""

_CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileProperty": "cr:fileProperty",
    "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}

_MIME = {
    "glb": "model/gltf-binary",
    "h5": "application/x-hdf5",
    "hdf5": "application/x-hdf5",
    "json": "application/json",
    "lst": "text/plain",
    "md": "text/markdown",
    "npz": "application/x-npz",
    "obj": "model/obj",
    "parquet": "application/x-parquet",
    "tar": "application/x-tar",
    "txt": "text/plain",
    "urdf": "application/xml",
    "xml": "application/xml",
}


def write(data: DataSet, to: str, target: Target) -> None:
    """Write croissant.json beside what was exported."""
    files = target.written
    told: dict[str, Any] = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.1",
        "name": f"{data.category}-{to}",
        "description": _description(data, to),
        "creator": {"@type": "sc:Organization", "name": f"articugen {__version__}"},
        "version": "1.0.0",
        **_licence(data.manifest),
        "distribution": _objects(files) if len(files) <= _MOST_OBJECTS else _file_sets(files),
    }
    if to == "parquet":
        columns = [file for file in files if file.name.endswith(".parquet")]
        told["distribution"] = [*_objects(files), *_file_sets(columns)]
        told["recordSet"] = [_records(data)]
    target.write(NAME, json.dumps(told, indent=1, ensure_ascii=False).encode() + b"\n")


def _description(data: DataSet, to: str) -> str:
    splits = ", ".join(f"{count} {name}" for name, count in data.splits.items())
    made = f" (content {data.manifest.content_sha256})" if data.manifest else ""
    return (
        f"{len(data)} instances ({splits}) of {len(data.objects)} objects of the category "
        f"{data.category}, each an object at one joint state{made}: {format_named(to).what}."
    )


def _licence(manifest: Manifest | None) -> dict[str, str]:
    if manifest is None:
        return {}
    return {"license": manifest.licence, "isBasedOn": manifest.source}


def _objects(files: list[Written]) -> list[dict[str, Any]]:
    return [
        {
            "@type": "cr:FileObject",
            "@id": file.name,
            "name": file.name,
            "contentUrl": file.name,
            "contentSize": f"{file.bytes} B",
            "encodingFormat": _mime(_ending(file.name)),
            "sha256": file.sha256,
        }
        for file in files
    ]


def _file_sets(files: list[Written]) -> list[dict[str, Any]]:
    """One for each kind of file, by its ending."""
    return [
        {
            "@type": "cr:FileSet",
            "@id": f"{ending}-files",
            "name": f"{ending}-files",
            "includes": [f"*.{ending}", f"**/*.{ending}"],  # mlcroissant's ** needs a folder
            "encodingFormat": _mime(ending),
        }
        for ending in sorted({_ending(file.name) for file in files})
    ]


def _ending(name: str) -> str:
    return name.rpartition("/")[2].rpartition(".")[2]


def _mime(ending: str) -> str:
    return _MIME.get(ending, "application/octet-stream")


def _records(data: DataSet) -> dict[str, Any]:
    """The columns of Parquet."""
    kinds = {"S": "sc:Text", "<f8": "sc:Float"}
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
