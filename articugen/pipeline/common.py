"""What processes that make one data set agree on: its objects, and what their shards are called."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import count

from pydantic import ValidationError

from articugen.core.errors import ArticugenError
from articugen.core.ledger import Ledger
from articugen.store.bucket import Bucket
from articugen.store.outcome import Key, Outcome, Record, Sha256

OF_JOB = ("source", "category", "seed", "ids", "exclude", "joints")
"""What a `CommonPlan` takes from a job as it is."""

NEVER_MADE = "it has not been made yet"

Name = tuple[str, str]
"""(split, object_id)."""


class CommonPlan(Record):
    """Plan of a place; processes that share out the objects are all asked for the same.

    Attributes:
        objects: how many.
        listing: a digest of their splits and ids, in order: what decides the shards' names.
        generator: of an object's `Key`.
        command: that makes all of it, for people.
        shares: how many the process that wrote it was one of; 0 where it was alone.
    """

    source: str
    category: str
    recipe: str
    seed: int
    ids: tuple[str, ...]
    exclude: tuple[str, ...]
    joints: tuple[str, ...]
    objects: int
    listing: Sha256
    generator: str
    command: str
    shares: int = 0

    def check_like(self, theirs: "CommonPlan", place: object) -> None:
        """Raise ArticugenError where processes that make `theirs` here were asked for another
        set."""
        words = {
            "listing": "list of objects",
            "objects": "number of objects",
            "ids": "choice of ids",
        }
        ours = self.model_dump(exclude={"command", "shares"})
        other = [words.get(n, n) for n, value in ours.items() if value != getattr(theirs, n)]
        if other:
            raise ArticugenError(
                f"{place}: other ranks make another data set here (another {', '.join(other)}), "
                f"by: {theirs.command}; do as they do, or choose another output folder"
            )


def listing_of(names: Iterable[Name]) -> str:
    """Return the digest of objects in their order."""
    return hashlib.sha256("\n".join("\x1f".join(name) for name in names).encode()).hexdigest()


def shard_names(names: Iterable[Name]) -> dict[Name, str]:
    """`<split>-<place among the objects of its split>.h5`, as in a new folder."""
    place, shards = Counter[str](), dict[Name, str]()
    for split, object_id in names:
        shards[split, object_id] = f"{split}-{place[split]:05d}.h5"
        place[split] += 1
    return shards


def key_of(name: Name) -> str:
    """Return what an object is called in the ledger."""
    return "/".join(name)


def with_free_names(names: dict[Key, str], keys: Sequence[Key]) -> dict[Key, str]:
    """Add a shard's name for each other key: that of its place, or one that is free."""
    names, taken = dict(names), set(names.values())
    of_place = shard_names(key.name for key in keys)
    for key in keys:
        if key not in names and of_place[key.name] not in taken:
            names[key] = of_place[key.name]
            taken.add(names[key])
    for key in keys:
        if key not in names:
            places = (f"{key.split}-{number:05d}.h5" for number in count())
            names[key] = next(name for name in places if name not in taken)
            taken.add(names[key])
    return names


def record_in(ledger: Ledger, outcome: Outcome) -> None:
    """Write down what has become of an object; its shard must be in place."""
    ledger.record(key_of(outcome.key.name), outcome.model_dump_json().encode())


def recorded(ledger: Ledger, key: Key) -> Outcome | None:
    """Return what another process has just recorded of an object in a store; None where that is not
    of the same object, made in the same way, and there."""
    name, bucket = key_of(key.name), ledger.place
    assert isinstance(bucket, Bucket)
    try:
        outcome = Outcome.model_validate_json(ledger.known([name]).get(name, b""))
    except ValidationError:
        return None
    shard = outcome.shard
    if outcome.failed is not None or key.difference(outcome.key):
        return None
    return outcome if not shard or bucket.size(shard.name) == shard.bytes else None
