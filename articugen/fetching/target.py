"""The folder that models are fetched into: what is whole in it, and the list of all that came.

Each model's folder has a receipt, written before the folder gets its name: a model is there with
it, whole and checked, or not at all. `fetched.json` is the list of the receipts, with the terms.
"""

import fcntl
import json
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from articugen import __version__
from articugen.errors import ArticugenError, InvalidSource, MachineFault
from articugen.fetching.models import Unpacked, folder_size
from articugen.fetching.terms import Terms, terms_of
from articugen.sources import registry
from articugen.sources.folders import visible
from articugen.store.files import (
    UnfitFile,
    cannot_write,
    make_folder,
    read_regular,
    whole_name,
    write_atomically,
)

LIST_NAME = "fetched.json"
RECEIPT_NAME = ".fetched.json"
WORK_NAME = ".fetch"
"""Of the folder in it for what is not finished."""
CATEGORIES_NAME = "categories.json"
"""In that: which model is of which category, where that had to be looked up."""

_MOST_BYTES = 2**20


@dataclass(frozen=True)
class Receipt:
    """What is known of a model that came.

    Attributes:
        source: the data set's name.
        archive, archive_sha256: what it was unpacked from.
        files, bytes: what came of it.
        sha256: the digest of the model as it is read; None of one that is refused.
        refused: why it cannot be used, in a sentence.
        checked_by: the version of articugen that says so.
    """

    source: str
    archive: str
    archive_sha256: str
    files: int
    bytes: int
    sha256: str | None
    refused: str | None
    checked_by: str = __version__


class Target:
    """A folder that one process at a time fetches into.

    Attributes:
        folder: where it is.
        receipts: of all models that came, by the name of their folder in it.
    """

    def __init__(self, folder: Path, terms: Terms) -> None:
        """
        Raises:
            ArticugenError: another process fetches into it.
            MachineFault: it cannot be written to.
        """
        self.folder, self.terms = folder, terms
        self.work = folder / WORK_NAME
        self.receipts: dict[str, Receipt] = {}
        self.failed: dict[str, str] = {}
        try:
            make_folder(self.work)
            flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
            self._lock: BinaryIO = os.fdopen(os.open(self.work / "lock", flags, 0o666), "r+b")
        except OSError as error:
            raise MachineFault(cannot_write(folder, error)) from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._lock.close()
            raise ArticugenError(
                f"{folder}: another process fetches into it; wait for it, or choose another folder"
            ) from None
        shutil.rmtree(self.work / "unpacking", ignore_errors=True)
        self._tidy(folder, self.work)
        for path in _receipts(folder):
            self._tidy(path.parent)
            self._believe(path)

    def _tidy(self, *folders: Path) -> None:
        """Remove the files of ours that a killed process was writing."""
        ours = (LIST_NAME, RECEIPT_NAME, CATEGORIES_NAME)
        for path in (path for folder in folders for path in folder.glob(".*.partial")):
            if whole_name(path.name) in ours and path.is_file():
                path.unlink(missing_ok=True)

    def _believe(self, path: Path) -> None:
        """A model counts as there while all that came of it is."""
        try:
            receipt = Receipt(**json.loads(read_regular(path, _MOST_BYTES, follow=False)))
        except (UnfitFile, OSError, ValueError, TypeError, RecursionError):
            return
        if folder_size(path.parent) == (receipt.files, receipt.bytes):
            self.receipts[path.parent.relative_to(self.folder).as_posix()] = receipt

    def has(self, place: PurePosixPath, archive_sha256: str | None) -> bool:
        """Whether the model is there whole, from just that archive (None: from any), and checked
        by this version; a model that is not ours is left alone."""
        receipt = self.receipts.get(str(place))
        if receipt is None:
            return False
        if archive_sha256 not in (None, receipt.archive_sha256):
            return False
        if receipt.checked_by != __version__:
            sha256, refused = self._judged(self.folder / place)
            self._note(
                place, replace(receipt, sha256=sha256, refused=refused, checked_by=__version__)
            )
        return True

    @contextmanager
    def unpacking(self) -> Iterator[Path]:
        """An empty folder to unpack into, gone afterwards."""
        folder = self.work / "unpacking" / secrets.token_hex(4)
        try:
            folder.mkdir(parents=True)
        except OSError as error:
            raise MachineFault(cannot_write(folder, error)) from error
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def take_in(
        self, place: PurePosixPath, model: Unpacked, staged: Path, archive: str, sha256: str
    ) -> None:
        """Check a model and give it its folder, in one step; what was there of it before is gone.

        Raises:
            ArticugenError: something that was not fetched is in the way.
            MachineFault, MemoryError: the disk is full, or the like.
        """
        to = self.folder / place
        if to.exists() and not (to / RECEIPT_NAME).exists():
            raise InvalidSource(f"{to}: is there, and was not fetched; move it away to fetch it")
        receipt = Receipt(
            self.terms.source, archive, sha256, model.files, model.bytes, *self._judged(staged, to)
        )
        write_atomically(staged / RECEIPT_NAME, _text(asdict(receipt)))
        try:
            make_folder(to.parent)
            with suppress(FileNotFoundError):
                to.rename(staged.with_name(f"{staged.name}.old"))
            staged.rename(to)
        except OSError as error:
            raise MachineFault(cannot_write(to, error)) from error
        self.receipts[str(place)] = receipt

    def _judged(self, path: Path, shown: Path | None = None) -> tuple[str | None, str | None]:
        """A model's digest, or why it cannot be used: it is read as any command reads it."""
        shown = shown or path
        try:
            return registry.load_path(path).sha256, None
        except InvalidSource as error:
            said = (
                str(error).replace(str(path.resolve()), str(shown)).replace(str(path), str(shown))
            )
            return None, said.replace(f"{self.folder}/", "")

    def fail(self, name: str, error: Exception, archive: Path) -> None:
        """Note what could not be fetched or unpacked, without the paths of this machine."""
        said = str(error).replace(str(archive), archive.name)
        self.failed[name] = said.replace(f"{self.folder}/", "")

    def _note(self, place: PurePosixPath, receipt: Receipt) -> None:
        write_atomically(self.folder / place / RECEIPT_NAME, _text(asdict(receipt)))
        self.receipts[str(place)] = receipt

    def close(self) -> None:
        """Write the list of all that came, and let others in."""
        sources = {self.terms.source, *(receipt.source for receipt in self.receipts.values())}
        listed = {
            "terms": {name: asdict(terms_of(name)) for name in sources},
            "models": {name: asdict(receipt) for name, receipt in self.receipts.items()},
            "failed": self.failed,
        }
        try:
            write_atomically(self.folder / LIST_NAME, _text(listed))
        finally:
            self._lock.close()


def _receipts(folder: Path) -> Iterator[Path]:
    """The receipts below a folder; models, which hold thousands of files, are not looked into."""
    if (folder / RECEIPT_NAME).exists():
        yield folder / RECEIPT_NAME
        return
    for child in visible(folder):
        if child.is_dir() and not child.is_symlink():
            yield from _receipts(child)


def _text(value: object) -> bytes:
    return (json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False) + "\n").encode()
