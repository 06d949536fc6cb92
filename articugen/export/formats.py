"""What a format is, and all of them by name."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import TYPE_CHECKING, Literal

from articugen.core.errors import ArticugenError, InvalidArgument
from articugen.core.yaml_files import nearest
from articugen.store.dataset import DataSet

if TYPE_CHECKING:
    from articugen.export.target import Target

NAMES = (
    "ply", "glb", "urdf", "mjcf", "usd", "parquet", "webdataset", "onet", "imnet", "ppd", "ditto",
    "npcs", "particulate", "opalign", "vecset", "artgs",
)  # fmt: skip
"""Each is a file of this folder, which holds one `FORMAT`."""


class LeftOut(ArticugenError):
    """What a format cannot hold: it is left out, said so, and the rest goes on."""


@dataclass(frozen=True)
class Options:
    """What may be chosen; each format says which of it it takes.

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
    """What is written in one go, and again if that was cut short.

    Attributes:
        key: no other item of the export has it; also what its files are called after.
        rows: the instances that are in it.
    """

    key: str
    rows: DataSet


@dataclass(frozen=True)
class Format:
    """A format that data sets are exported to.

    Attributes:
        what: one line on what it is, for lists.
        items: what a data set is written as, in order.
        write: writes an item; raises LeftOut where the format cannot hold it.
        finish: writes what needs all items, such as lists of splits.
        takes: the names of the `Options` that it heeds.
        needs: (library, extra) pairs without which it cannot be written.
    """

    what: str
    items: Callable[[DataSet], Iterator[Item]]
    write: "Callable[[Item, Target], None]"
    finish: "Callable[[DataSet, Target], None]" = lambda data, target: None
    takes: tuple[str, ...] = ()
    needs: tuple[tuple[str, str], ...] = field(default=())


def format_named(name: str) -> Format:
    """
    Raises:
        InvalidArgument: there is none of that name; the sentence lists them.
    """
    if name not in NAMES:
        raise InvalidArgument(
            f"no format {name!r}{nearest(name, list(NAMES))}; there are: {', '.join(NAMES)}"
        )
    return import_module(f"articugen.export.{name}").FORMAT


def options_for(name: str, **given: object) -> Options:
    """The options that a format takes; those that are None are not given.

    Raises:
        InvalidArgument: one that it does not take.
    """
    chosen = {key: value for key, value in given.items() if value is not None}
    for key in chosen:
        if key not in (takes := format_named(name).takes):
            there = f"it takes {', '.join(takes)}" if takes else "it takes no option"
            raise InvalidArgument(f"{name} does not heed {key}: {there}; leave it out")
    if chosen.get("occupancy", "visible") not in ("visible", "material"):
        raise InvalidArgument(
            f"occupancy is visible or material, not {chosen['occupancy']!r}; docs/conventions.md "
            "says when to choose which"
        )
    return replace(Options(), **chosen)
