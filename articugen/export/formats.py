"""What a format is, and all of them by name."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from importlib import import_module

from articugen.core.errors import InvalidArgument
from articugen.core.yaml_files import nearest
from articugen.export.items import Item, Options
from articugen.export.target import Target
from articugen.store.dataset import DataSet

NAMES = (
    "ply", "glb", "urdf", "mjcf", "usd", "parquet", "webdataset", "onet", "imnet", "ppd", "ditto",
    "npcs", "particulate", "opalign", "vecset", "artgs",
)  # fmt: skip
"""Each is a file of this folder, which holds one `FORMAT`."""


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
    write: Callable[[Item, Target], None]
    finish: Callable[[DataSet, Target], None] = lambda data, target: None
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


def options_for(name: str, **options: object) -> Options:
    """Return the options that a format takes; those that are None are not given.

    Raises:
        InvalidArgument: one that it does not take.
    """
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
