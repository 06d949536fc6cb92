"""What a format is, and all of them by name."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

from articugen.core import plugins
from articugen.core.errors import InvalidArgument
from articugen.export.items import Item, Options
from articugen.export.target import Files, Target
from articugen.store.dataset import DataSet

FORMATS = {
    name: f"articugen.export.{name}:FORMAT"
    for name in (
        "ply", "glb", "urdf", "mjcf", "usd", "parquet", "webdataset", "onet", "imnet", "ppd",
        "ditto", "npcs", "particulate", "opalign", "vecset", "artgs",
    )
}  # fmt: skip
"""Where each format is, by the name that `--to` takes."""

_TABLE = plugins.Table(
    "articugen.formats",
    FORMATS,
    ("what", "items", "write", "takes", "needs"),
    "format",
    InvalidArgument,
)
names = _TABLE.names


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
    write: Callable[[Item, Files], None]
    finish: Callable[[DataSet, Target], None] = lambda data, target: None
    takes: tuple[str, ...] = ()
    needs: tuple[tuple[str, str], ...] = field(default=())


def format_named(name: str) -> Format:
    """Return the format of that name; InvalidArgument, which lists all, if there is none,
    BrokenPlugin if it is another package's and cannot be used."""
    return _TABLE.load(name)


def options_for(name: str, **options: object) -> Options:
    """Return the options that are not None; InvalidArgument if the format does not take one."""
    chosen = {key: value for key, value in options.items() if value is not None}
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
