"""Croissant 1.1: what a data set is, for machines that look for data sets.

Every file is there with its digest, as one FileObject, or where there are many, as a FileSet. The
day of publication is for whoever publishes: nothing here is of the clock, so that the same data
have the same text.
"""

import json
import re
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Protocol

from articugen.core.content import VERSION
from articugen.store.manifest import Manifest
from articugen.store.provenance import code_version

NAME = "croissant.json"

_MOST_OBJECTS = 100
"""Files that are listed one by one; more are a FileSet."""

_FACTS = ("name", "license", "isBasedOn", "distribution")

_WORDS = """
citeAs column conformsTo cr rai data dataType dct equivalentProperty examples extract field
fileProperty fileObject fileSet format includes isLiveDataset jsonPath key md5 parentField path
recordSet references regex repeated replace samplingRate sc separator source subField transform
"""
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    **{word: f"cr:{word}" for word in _WORDS.split()},
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "sc": "https://schema.org/",
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
_UNKNOWN = "application/octet-stream"

_CITATION = (
    "@misc{articugen, author = {{The articugen authors}}, title = {%s}, "
    "note = {made by articugen %s}}"
)


class File(Protocol):
    """A file: its name from the folder on, with slashes; its size and digest."""

    @property
    def name(self) -> str: ...
    @property
    def bytes(self) -> int: ...
    @property
    def sha256(self) -> str: ...


def of_data_set(manifest: Manifest) -> bytes:
    """Return the file for a manifest."""
    about = (
        f"Articulated objects of the category {manifest.category}: "
        f"{sum(o.instances for o in manifest.objects)} instances, each an object at one joint "
        f"state, in {len(manifest.shards)} HDF5 shards (content {manifest.content_sha256})."
    )
    return document(f"{manifest.category}-articugen", about, manifest, listed(manifest.shards))


def fault(text: bytes, manifest: Manifest) -> str | None:
    """Return what is wrong with the file beside a manifest, or None.

    Other code than this may have worded it otherwise; then what it says of the data counts.
    """
    wanted = of_data_set(manifest)
    if text == wanted:
        return None
    if manifest.articugen_version != code_version():
        with suppress(ValueError, RecursionError, KeyError, TypeError):
            read, facts = json.loads(text), json.loads(wanted)
            if all(read[key] == facts[key] for key in _FACTS):
                return None
    return "it does not say of the data what the manifest says"


def document(
    name: str,
    description: str,
    manifest: Manifest | None,
    distribution: list[dict[str, Any]],
    records: Sequence[dict[str, Any]] = (),
) -> bytes:
    """Return the text of a croissant.json: `manifest` has licence and source, `distribution` is
    what `listed` gives, `records` are RecordSets."""
    text: dict[str, Any] = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.1",
        "name": name,
        "description": description,
        "creator": {"@type": "sc:Organization", "name": f"articugen {VERSION}"},
        "version": "1.0.0",
        "citeAs": _CITATION % (re.sub(r"[^\w -]", "_", name), VERSION),
    }
    if manifest is not None:
        text |= {"license": manifest.licence, "isBasedOn": manifest.source}
    text["distribution"] = distribution
    if records:
        text["recordSet"] = list(records)
    return json.dumps(text, indent=1, ensure_ascii=False).encode() + b"\n"


def listed(files: Sequence[File]) -> list[dict[str, Any]]:
    """Files one by one, or where they are many, a pattern for each kind."""
    return objects(files) if len(files) <= _MOST_OBJECTS else file_sets(files)


def objects(files: Sequence[File]) -> list[dict[str, Any]]:
    return [
        {
            "@type": "cr:FileObject",
            "@id": file.name,
            "name": file.name,
            "contentUrl": file.name,
            "contentSize": f"{file.bytes} B",
            "encodingFormat": _MIME.get(_ending(file.name), _UNKNOWN),
            "sha256": file.sha256,
        }
        for file in files
    ]


def file_sets(files: Sequence[File]) -> list[dict[str, Any]]:
    """Return one for each kind of file, by its ending."""
    return [
        {
            "@type": "cr:FileSet",
            "@id": f"{ending}-files",
            "name": f"{ending}-files",
            "includes": [f"*.{ending}", f"**/*.{ending}"],  # mlcroissant's ** needs a folder
            "encodingFormat": _MIME.get(ending, _UNKNOWN),
        }
        for ending in sorted({_ending(file.name) for file in files})
    ]


def _ending(name: str) -> str:
    return name.rpartition("/")[2].rpartition(".")[2]
