"""An export from its beginning to its end, or from where the last call got."""

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from articugen.core.errors import InvalidArgument, MissingExtra
from articugen.core.files import sha256_of
from articugen.export import croissant
from articugen.export.formats import format_named, options_for
from articugen.export.items import Item, LeftOut, file_name, instance_name
from articugen.export.parts import PartMeshes
from articugen.export.target import Target
from articugen.store.dataset import DataSet
from articugen.store.dataset import open as open_data_set

Folder = str | os.PathLike[str]


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
    target = Target(Path(out), about, options, PartMeshes(whole, options))
    try:
        if not target.complete:
            _write(chosen, to, target, on_item)
    except BaseException:
        target.withdraw()
        raise
    finally:
        target.close()
    files = target.written
    left_out = tuple(done.left_out for done in target.done.values() if done.left_out)
    return Exported(target.folder, len(files), sum(file.bytes for file in files), left_out)


def _write(
    data: DataSet, to: str, target: Target, on_item: Callable[[int, int, Item], None]
) -> None:
    wanted = format_named(to)
    items = list(wanted.items(data))
    for number, item in enumerate(items, 1):
        if item.key not in target.done:
            try:
                wanted.write(item, target)
            except LeftOut as why:
                target.finished(item.key, str(why))
            else:
                target.finished(item.key)
        on_item(number, len(items), item)
    reasons = [done.left_out for done in target.done.values() if done.left_out]
    if len(reasons) == len(items):
        raise InvalidArgument(f"{to} can hold nothing of {data.path}: {reasons[0]}")
    wanted.finish(data, target)
    croissant.write(data, to, target)
    target.seal()


def _digest(data: DataSet) -> str:
    """Tells these instances from any others.

    Raises:
        InvalidArgument: two of them would be called alike: nothing may be lost, nor an object of
            two splits end in one folder.
    """
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
