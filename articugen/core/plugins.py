"""What other packages add to articugen: the entry points of their metadata, by group and name.

A package that cannot be used is no reason to fail for those who do not ask for it: what can be
loaded is loaded, and of the rest one sentence is logged, which Python prints where nobody listens.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from articugen.core.errors import BrokenPlugin, machine_fault, printable

_LOG = logging.getLogger("articugen")


@dataclass(frozen=True)
class Group:
    """A group of entry points, "articugen.readers" say, and the attributes that each object must
    have."""

    name: str
    needs: tuple[str, ...]

    def names(self, ours: Sequence[str] = ()) -> tuple[str, ...]:
        """Of all that are installed, but those that are `ours`, which nobody replaces."""
        return tuple(_found(self.name, tuple(ours)))

    def load(self, name: str) -> Any:
        """Return the object of that name; BrokenPlugin, with the package, if it cannot be imported
        or lacks what it needs, or MachineFault or MemoryError."""
        return _load(self, _installed(self.name)[name])

    def load_all(self, ours: Sequence[str] = ()) -> dict[str, Any]:
        """All that can be loaded, by name, but those that are `ours`; what cannot is logged."""
        return _load_all(self, tuple(ours))


def forget() -> None:
    """Look again at what is installed."""
    for cached in (_installed, _found, _load, _load_all):
        cached.cache_clear()


@cache
def _installed(group: str) -> dict[str, EntryPoint]:
    """By name; of one name the first package's counts."""
    found: dict[str, EntryPoint] = {}
    for point in sorted(entry_points(group=group), key=lambda p: (p.name, _package(p))):
        first = found.setdefault(point.name, point)
        if _package(first) != _package(point):
            _leave_out(point, _package(first))
    return found


@cache
def _found(group: str, ours: tuple[str, ...]) -> dict[str, EntryPoint]:
    found = dict(_installed(group))
    for name in ours:
        if name in found:
            _leave_out(found.pop(name), "articugen")
    return found


def _leave_out(point: EntryPoint, other: str) -> None:
    _LOG.warning(
        "package %s: its entry point %r of %s is left out, since %s has one of that name; rename "
        "it, or uninstall one of them",
        *(_package(point), point.name, point.group, other),
    )


@cache
def _load(group: Group, point: EntryPoint) -> Any:
    where = f"package {_package(point)}: its entry point {point.name!r} of {group.name}"
    try:
        loaded = point.load()
    except Exception as error:  # whatever a stranger's module raises as it is imported
        reason = printable(f"{type(error).__name__}: {error}")[:200]
        raise machine_fault(error) or BrokenPlugin(
            f"{where} cannot be loaded ({reason}); mend or uninstall it"
        ) from error
    missing = [name for name in group.needs if not hasattr(loaded, name)]
    if missing:
        raise BrokenPlugin(
            f"{where} is {point.value}, which has no {', '.join(missing)}; mend or uninstall it"
        )
    return loaded


@cache
def _load_all(group: Group, ours: tuple[str, ...]) -> dict[str, Any]:
    usable = {}
    for name, point in _found(group.name, ours).items():
        try:
            usable[name] = _load(group, point)
        except BrokenPlugin as broken:
            _LOG.warning("%s", broken)
    return usable


def _package(point: EntryPoint) -> str:
    return point.dist.name if point.dist else "of an unknown name"
