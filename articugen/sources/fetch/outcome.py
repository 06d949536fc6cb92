"""What a call of `fetch` comes to."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from articugen.core.errors import NotFetched
from articugen.sources.fetch.target import Target
from articugen.sources.fetch.terms import Terms


@dataclass(frozen=True)
class Fetched:
    """What is there now of what was asked for.

    Attributes:
        folder: where it is.
        terms: on which terms.
        models: how many there are, `new` of them fetched now.
        refused: of those, the ones that cannot be used, and why.
        failed: what could not be fetched, or unpacked, and why.
    """

    folder: Path
    terms: Terms
    models: int
    new: int
    refused: dict[str, str]
    failed: dict[str, str]


def outcome(target: Target, places: Collection[str], new: int) -> Fetched:
    """Of the models whose folders in `target` are `places`.

    Raises:
        NotFetched: not one of them is there.
    """
    there = {name: target.receipts[name] for name in places if name in target.receipts}
    if target.failed and not there:
        raise NotFetched(next(iter(target.failed.values())))
    refused = {name: receipt.refused for name, receipt in there.items() if receipt.refused}
    return Fetched(target.folder, target.terms, len(there), new, refused, dict(target.failed))
