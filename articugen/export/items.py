"""How data sets are cut into items, and what their files are called."""

import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from articugen.core.errors import ArticugenError
from articugen.store.dataset import DataSet
from articugen.store.rows import Row

_SAFE = 80
"""Characters of a name: with a number and an ending it fits into every file system's 255 bytes."""

_DIGEST = re.compile(r"-[0-9a-f]{8}$")


class LeftOut(ArticugenError):
    """Data that a format cannot hold: left out with a reason, while the rest is written."""


@dataclass(frozen=True)
class Options:
    """Options of all formats; each format lists those that it takes.

    Attributes:
        resolution: of part meshes, voxels along the unit cube.
        from_grids: take part meshes from the finest stored grid, not from the models.
        collision: add convex parts to collide with.
        occupancy: what counts as inside: "visible", label > 0, or "material" alone.
    """

    resolution: int = 256
    from_grids: bool = False
    collision: bool = False
    occupancy: Literal["visible", "material"] = "visible"


@dataclass(frozen=True)
class Item:
    """Files that are written together, and again if that was interrupted: they hold the instances
    `rows`, and are called after `key`, which no other item of the export has."""

    key: str
    rows: DataSet


def file_name(text: str) -> str:
    """Return a name for files that any system takes, made of a text that may be hostile.

    Letters of any script, digits, _ and - stay. What had to change ends in a digest of the text,
    and so does what ends as if it had: texts whose digests differ never share a name.
    """
    clean = re.sub(r"[^\w-]", "_", text)
    plain = clean == text and not _DIGEST.search(text)
    if plain and 0 < len(text.encode()) <= _SAFE:
        return text
    kept = clean.encode()[: _SAFE - 9].decode("utf-8", "ignore")
    return f"{kept}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def instance_name(row: Row) -> str:
    """Name an instance's files by its object and state."""
    return f"{file_name(row.object_id)}_{row.state_index:04d}"


def of_instances(data: DataSet) -> Iterator[Item]:
    """Yield an item an instance; its key is <split>/<object>_<state>."""
    for index in range(len(data)):
        row = data[index]
        yield Item(f"{row.split}/{instance_name(row)}", data[[index]])


def of_objects(data: DataSet) -> Iterator[Item]:
    """Yield an item an object, with all its instances; its key is <split>/<object>."""
    for name, rows in data.by_object():
        yield Item(f"{rows[0].split}/{file_name(name)}", rows)


def of_splits(data: DataSet) -> Iterator[Item]:
    """Yield an item a split."""
    for name in data.splits:
        yield Item(file_name(name), data.split(name))


def canonical(rows: DataSet) -> Row:
    """Return the canonical pose among an object's instances; LeftOut where it is not among them."""
    for row in rows:
        if row.state_index == 0:
            return row
    raise LeftOut(f"{rows[0].object_id}: its canonical pose, state 0, is not in the data")
