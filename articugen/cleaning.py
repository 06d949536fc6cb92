"""Tidying up after runs that were killed: what they left and nobody will need."""

import os
from dataclasses import dataclass
from pathlib import Path

from articugen.errors import CorruptShard
from articugen.journal import JOURNAL_NAME, Journal, is_temporary
from articugen.manifest import MANIFEST_NAME


@dataclass(frozen=True)
class Leftover:
    """A file that a killed run left.

    Attributes:
        path: of it.
        why: it is not needed, in a few words.
        bytes: that it takes.
    """

    path: Path
    why: str
    bytes: int


def clean(path: Path, *, dry_run: bool = False) -> list[Leftover]:
    """Remove what killed runs left in a data set, or in the data sets of a folder.

    That is temporary files, shards that were written but not recorded, and a journal beside a whole
    manifest. What is recorded as finished stays, and so does the journal of a run that can go on.

    Args:
        path: the folder of a data set, or of such folders.
        dry_run: only say what would be removed.

    Raises:
        CorruptShard: there is no data set, or its manifest or journal is damaged.
        ArticugenError: a run is at work there.
        MachineFault: something cannot be read or removed.
    """
    found: list[Leftover] = []
    for folder in _data_sets(path):
        with Journal(folder) as journal:
            leftovers = journal.leftovers()
            found += [
                Leftover(folder / name, why, os.lstat(folder / name).st_size)
                for name, why in leftovers.items()
            ]
            if not dry_run:
                journal.remove(leftovers)
    return found


def _data_sets(path: Path) -> list[Path]:
    inside = sorted(path.iterdir()) if path.is_dir() else []
    folders = [folder for folder in (path, *inside) if _is_data_set(folder)]
    if not folders:
        raise CorruptShard(f"{path}: holds no data set and nothing that a run has left")
    return folders


def _is_data_set(folder: Path) -> bool:
    """Whether a run has been at work in a folder."""
    if not folder.is_dir() or folder.is_symlink():
        return False
    names = os.listdir(folder)
    return any(name in (MANIFEST_NAME, JOURNAL_NAME) or is_temporary(name) for name in names)
