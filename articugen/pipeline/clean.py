"""Tidying up after runs that were killed: what they left and nobody will need."""

import os
from dataclasses import dataclass
from pathlib import Path

from articugen.core.place import Folder
from articugen.pipeline.folder import data_sets
from articugen.pipeline.records import Records


@dataclass(frozen=True)
class Leftover:
    """A file that a killed run left, why it is not needed, in a few words, and its bytes."""

    path: Path
    why: str
    bytes: int


def clean(path: Path, *, dry_run: bool = False) -> list[Leftover]:
    """Remove what killed runs left in a data set, or in the data sets of a folder.

    That is temporary files, shards that were written but not recorded, pages that a manifest does
    not list, and a ledger beside a whole manifest. What is recorded as finished stays, and so does
    the ledger of a run that can go on, and whatever is not what its name says. No link is
    followed or removed.

    Args:
        path: the folder of a data set, or of such folders.
        dry_run: only say what would be removed.

    Raises:
        CorruptShard: there is no data set, or its manifest or plan is damaged.
        ArticugenError: a run is at work there.
        MachineFault: something cannot be read or removed.
    """
    rest: list[Leftover] = []
    for folder in data_sets(path, follow=False):
        with Records(Folder(folder)) as records:
            leftovers = records.leftovers()
            rest += [
                Leftover(folder / name, why, os.lstat(folder / name).st_size)
                for name, why in leftovers.items()
            ]
            if not dry_run:
                records.place.delete(leftovers)
    return rest
