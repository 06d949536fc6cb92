"""What other packages add to articugen: the entry points of their metadata, by group and name.

A package that cannot be used is no reason to fail for those who do not ask for it: what can be
loaded is loaded, and of the rest one sentence is logged, which Python prints where nobody listens.
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from articugen.core.errors import BrokenPlugin, machine_fault, printable
from articugen.core.yaml_files import unlisted

_LOG = logging.getLogger("articugen")


@dataclass(frozen=True, eq=False)
class Table:
    """Things of a kind by name: ours, and those that other packages add.

    Attributes:
        group: of their entry points, "articugen.readers" say.
        ours: which nobody replaces: each itself, or where it is, as `<module>:<attribute>`.
        needs: the attributes that each of theirs must have.
        kind: what one is called in sentences.
        refusal: is raised where there is none of a name.
    """

    group: str
    ours: Mapping[str, Any]
    needs: tuple[str, ...]
    kind: str
    refusal: type[Exception]

    def names(self) -> tuple[str, ...]:
        """Return the names of all that are installed, without `ours`, which nobody replaces."""
        return (*self.ours, *_found(self))

    def check(self, name: str) -> None:
        """Raise the refusal, which lists all, where there is none of that name."""
        if name in self.ours or name in self.names():
            return
        raise self.refusal(unlisted(self.kind, name, filter(None, self.names())))

    def load(self, name: str) -> Any:
        """Return the one of that name; or the refusal if there is none, BrokenPlugin, with the
        package, if it cannot be imported or lacks what it needs, MachineFault or MemoryError."""
        self.check(name)
        if name not in self.ours:
            return _load(self, _found(self)[name])
        value = self.ours[name]
        return EntryPoint(name, value, self.group).load() if isinstance(value, str) else value

    @cache  # noqa: B019 - of a few tables, which stay
    def load_all(self) -> dict[str, Any]:
        """Load all that can be loaded, by name, without `ours`; what cannot is logged."""
        usable = {}
        for name, point in _found(self).items():
            try:
                usable[name] = _load(self, point)
            except BrokenPlugin as broken:
                _LOG.warning("%s", broken)
        return usable


@cache
def _found(table: Table) -> dict[str, EntryPoint]:
    """By name; of one name the first package's counts."""
    points: dict[str, EntryPoint] = {}
    owners = dict.fromkeys(table.ours, "articugen")
    for point in sorted(entry_points(group=table.group), key=lambda p: (p.name, _package(p))):
        owner = owners.setdefault(point.name, _package(point))
        if owner == _package(point) and point.name not in table.ours:
            points.setdefault(point.name, point)
            continue
        _LOG.warning(
            "package %s: its entry point %r of %s is left out, since %s has one of that name; "
            "rename it, or uninstall one of them",
            *(_package(point), point.name, point.group, owner),
        )
    return points


@cache
def _load(table: Table, point: EntryPoint) -> Any:
    where = f"package {_package(point)}: its entry point {point.name!r} of {table.group}"
    try:
        loaded = point.load()
    except Exception as error:  # whatever a stranger's module raises as it is imported
        reason = printable(f"{type(error).__name__}: {error}")[:200]
        raise machine_fault(error) or BrokenPlugin(
            f"{where} cannot be loaded ({reason}); mend or uninstall it"
        ) from error
    missing = [name for name in table.needs if not hasattr(loaded, name)]
    if missing:
        raise BrokenPlugin(
            f"{where} is {point.value}, which has no {', '.join(missing)}; mend or uninstall it"
        )
    return loaded


def _package(point: EntryPoint) -> str:
    return point.dist.name if point.dist else "of an unknown name"
