"""An export from its beginning to its end, or from where the last call got; Croissant beside it."""

import hashlib
import os
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from articugen.core import schema
from articugen.core.errors import InvalidArgument, MissingExtra
from articugen.core.files import locked, sha256_of
from articugen.core.processes import default_jobs, in_order
from articugen.export.formats import format_named, options_for
from articugen.export.items import Item, LeftOut, Options, file_name, instance_name
from articugen.export.target import Files, Target, Written
from articugen.store import croissant
from articugen.store.dataset import DataSet
from articugen.store.dataset import open as open_data_set

Folder = str | os.PathLike[str]

FEWEST = 4
"""Objects for which it is worth starting other processes, which takes seconds."""


@dataclass(frozen=True)
class Exported:
    """Result of an export.

    Attributes:
        folder: where it is.
        files, bytes: how many files, and how large all of them are.
        left_out: a sentence for each thing that the format cannot hold.
    """

    folder: Path
    files: int
    bytes: int
    left_out: tuple[str, ...]


def export(
    data: Folder | DataSet,
    to: str,
    out: Folder,
    *,
    split: str | None = None,
    resolution: int | None = None,
    from_grids: bool | None = None,
    collision: bool | None = None,
    occupancy: str | None = None,
    jobs: int | None = None,
    on_item: Callable[[int, int, Item], None] = lambda done, items, item: None,
) -> Exported:
    """Write a data set in another format, or what is missing of it; one instance is read at a time.

    Killed and called again it goes on. What each format carries and loses: docs/exports.md.

    Args:
        data: a data set's folder, a shard, or an open data set, which may be some of the instances.
        to: the format's name, one of `formats.names()`.
        out: a folder that is empty, not there yet, or holds a part of this very export.
        split: the instances of this split alone.
        resolution, from_grids, collision, occupancy: see `items.Options`; only some formats take
            them.
        jobs: processes that part meshes are made by; all cores by default. The files are the same.
        on_item: called after each item, with the number that are done and that of all.

    Raises:
        InvalidArgument: no such format, split or option, or no instance.
        MissingExtra: a library that the format needs is not installed.
        ArticugenError: the folder holds something else; the data are damaged; a model cannot be
            made again.
        MachineFault: the disk is full, or the like.
    """
    wanted, options = format_named(to), options_for(
        to, resolution=resolution, from_grids=from_grids, collision=collision, occupancy=occupancy
    )  # fmt: skip
    for library, extra in wanted.needs:
        if find_spec(library) is None:
            raise MissingExtra(library, extra)
    whole = data if isinstance(data, DataSet) else open_data_set(os.fspath(data))
    chosen = whole if split is None else whole.split(split)
    if not len(chosen):
        raise InvalidArgument(f"{whole.path}: there are no instances to export")
    about = {"format": to, "data": _digest(chosen), "category": chosen.category}
    folder = Path(out)
    is_new = not folder.exists()
    with locked(folder):
        target = Target(folder, about, options)
        try:
            if not target.complete:
                _write(chosen, to, target, jobs or default_jobs(), on_item)
        except BaseException:
            target.withdraw(is_new=is_new)
            raise
    files = target.written
    left_out = tuple(done.left_out for done in target.done.values() if done.left_out)
    return Exported(target.folder, len(files), sum(file.bytes for file in files), left_out)


def _write(
    data: DataSet, to: str, target: Target, jobs: int, on_item: Callable[[int, int, Item], None]
) -> None:
    wanted = format_named(to)
    items = list(wanted.items(data))
    missing = [item for item in items if item.key not in target.done]
    workers = jobs if len(missing) >= FEWEST and "resolution" in wanted.takes else 0
    tasks = [(to, target.folder, target.options, item) for item in missing]
    with closing(
        in_order(_written, tasks, workers=workers, name=lambda task: task[-1].key)
    ) as written:
        for number, item in enumerate(items, 1):
            if item.key not in target.done:
                target.finished(item.key, *next(written))
            on_item(number, len(items), item)
    reasons = [done.left_out for done in target.done.values() if done.left_out]
    if len(reasons) == len(items):
        raise InvalidArgument(f"{to} can hold nothing of {data.path}: {reasons[0]}")
    wanted.finish(data, target)
    _write_croissant(data, to, target)
    target.seal()


def _written(task: tuple[str, Path, Options, Item]) -> tuple[list[Written], str | None]:
    """Return the files of an item, which are written, and why it was left out, if it was."""
    to, folder, options, item = task
    files = Files(folder, options)
    try:
        format_named(to).write(item, files)
    except LeftOut as why:
        return [], str(why)
    return files.files, None


def _digest(data: DataSet) -> str:
    """Return a digest of these instances; InvalidArgument where two would be called alike."""
    digest = hashlib.sha256()
    if data.manifest is not None:
        digest.update(data.manifest.content_sha256.encode())
    else:
        digest.update("".join(map(sha256_of, data.shards)).encode())
    objects: dict[str, tuple[str, str]] = {}
    instances: set[str] = set()
    for row in data:
        digest.update(f"{row.split}\x1f{row.object_id}\x1f{row.state_index}\n".encode())
        which = (row.object_id, row.split)
        other = objects.setdefault(file_name(row.object_id), which)
        name = instance_name(row)
        if other != which or name in instances:
            raise InvalidArgument(
                f"{data.path}: {which[0]!r} ({which[1]}) and {other[0]!r} ({other[1]}) would be "
                f"called alike, {name}; choose instances that are there once"
            )
        instances.add(name)
    return digest.hexdigest()


def _write_croissant(data: DataSet, to: str, target: Target) -> None:
    """Write croissant.json; of Parquet with a RecordSet for mlcroissant to read."""
    files = target.written
    distribution, records = croissant.listed(files), []
    if to == "parquet":
        columns = [file for file in files if file.name.endswith(".parquet")]
        distribution = [*croissant.objects(files), *croissant.file_sets(columns)]
        records = [_records(data)]
    splits = ", ".join(f"{count} {name}" for name, count in data.splits.items())
    content = f" (content {data.manifest.content_sha256})" if data.manifest else ""
    about = (
        f"{len(data)} instances ({splits}) of {len(data.objects)} objects of the category "
        f"{data.category}, each an object at one joint state{content}: {format_named(to).what}."
    )
    name = f"{data.category}-{to}"
    record = croissant.document(name, about, data.manifest, distribution, records)
    target.write(croissant.NAME, record)


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
