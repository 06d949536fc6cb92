"""Tables of ranges: what kinds of a product there are, as numbers instead of code."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

Range = tuple[float, float]  # (low, high) of a number that is drawn uniformly


@dataclass(frozen=True)
class Either:
    """An entry that depends on another, or on chance.

    Attributes:
        test: the name of an entry before this one, or how often it holds, in 0 .. 1.
        then, otherwise: the entry where it holds and where it does not.
    """

    test: str | float
    then: Any = True
    otherwise: Any = False


def draw(rng: np.random.Generator, entry: Any, before: Mapping[str, Any] | None = None) -> Any:
    """Return a value as an entry of a table says.

    Args:
        entry: a tuple (low, high) for a number between them, a list for one of its members, an
            `Either`; whatever else stands for itself.
        before: the values of the entries before this one.
    """
    if isinstance(entry, tuple):
        return rng.uniform(*entry)
    if isinstance(entry, list):
        return entry[rng.choice(len(entry))]
    if isinstance(entry, Either):
        test = entry.test
        holds = (before or {})[test] if isinstance(test, str) else rng.uniform() < test
        return draw(rng, entry.then if holds else entry.otherwise, before)
    return entry


def draw_all(rng: np.random.Generator, table: Mapping[str, Any]) -> dict[str, Any]:
    """Return a value for each entry of a table, in its order."""
    values: dict[str, Any] = {}
    for name, entry in table.items():
        values[name] = draw(rng, entry, values)
    return values
