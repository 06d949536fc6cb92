"""Which objects are for training and which for testing; disjoint by object, never random."""

import hashlib
import os
from collections.abc import Callable, Iterable, Mapping

from articugen.core.arrays import grouped
from articugen.sources.refs import Share

TEST_FRACTION = 0.2  # of the objects of a source that says nothing about splits


def assign_splits(
    group_of: Mapping[str, str],
    train: Share,
    test: Share,
    counts: Callable[[str], bool] = lambda _: True,
) -> dict[str, str]:
    """Return the split, "train" or "test", of each object.

    Ids name the objects of a split; where both splits name theirs, other objects have none.
    Otherwise a hash of its group decides for each object by itself, so that more objects change
    nothing for the others, except that neither split is without an object that counts where two
    groups have one. One alone is for training.

    Args:
        group_of: a group for each object id; objects of one group (the same meshes) stay together.
        train, test: ids, or numbers whose ratio is kept, or None.
        counts: whether an object will be in the data; few are asked for.
    """
    listed = {"train": train, "test": test}
    named = {i: split for split, ids in listed.items() if isinstance(ids, tuple) for i in ids}
    if isinstance(train, tuple) and isinstance(test, tuple):
        return {i: named[i] for i in group_of if i in named}
    if isinstance(train, tuple) or isinstance(test, tuple):
        other = "train" if isinstance(test, tuple) else "test"
        return {i: named.get(i, other) for i in group_of}
    fraction = TEST_FRACTION
    if isinstance(train, int) and isinstance(test, int):
        fraction = test / (train + test)
    chosen = _test_groups(group_of, fraction, counts)
    return {i: "test" if group in chosen else "train" for i, group in group_of.items()}


def split_sizes(objects: int, train: int, test: int) -> dict[str, int]:
    """`objects` divided as `train` : `test`; of two or more, each split that is not 0 gets one."""
    count = round(objects * test / (train + test))
    if train and test and objects > 1:
        count = min(max(count, 1), objects - 1)
    return {"train": objects - count, "test": count}


def take(left: dict[str, int], split: str) -> bool:
    """Take one of `split` where any is left."""
    left[split] -= 1
    return left[split] >= 0


def _test_groups(
    group_of: Mapping[str, str], fraction: float, counts: Callable[[str], bool]
) -> set[str]:
    """Return the groups whose hash, as a number in [0, 1), is below `fraction`; see
    `assign_splits`."""
    members = grouped((group, name) for name, group in group_of.items())
    ranked = sorted((hashlib.sha256(os.fsencode(name)).digest(), name) for name in members)
    places, names = range(len(ranked)), [name for _, name in ranked]
    count = sum(int.from_bytes(digest[:8], "big") < fraction * 2.0**64 for digest, _ in ranked)
    if 0.0 < fraction < 1.0:

        def first_of(order: Iterable[int]) -> int:
            return next((k for k in order if any(map(counts, members[names[k]]))), 0)

        alone = len(names) == 1  # whatever it holds: nobody need be asked
        first, last = (0, 0) if alone else (first_of(places), first_of(reversed(places)))
        count = min(max(count, first + 1), last)
    return set(names[:count])
