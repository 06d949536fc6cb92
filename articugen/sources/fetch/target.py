"""The folder that models are fetched into: what is whole in it, and the list of all that came.

Each model's folder has a receipt, written before the folder gets its name: a model is there with
it, whole and checked, or not at all. `fetched.json` is the list of the receipts, with the terms.
"""

import fcntl
import json
import os
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from pydantic import TypeAdapter

from articugen.core.content import VERSION
from articugen.core.errors import (
    ArticugenError,
    InvalidArgument,
    InvalidSource,
    MachineFault,
    printable,
)
from articugen.core.files import (
    UnfitFile,
    cannot_write,
    is_no_folder,
    make_folder,
    read_regular,
    sha256_of,
    whole_name,
    within,
    write_atomically,
)
from articugen.sources.fetch.models import Unpacked
from articugen.sources.fetch.terms import NAMES, Terms, terms_of
from articugen.sources.folders import visible
from articugen.sources.source import load_path

LIST_NAME = "fetched.json"
RECEIPT_NAME = ".fetched.json"
WORK_NAME = ".fetch"
"""Of the folder in it for what is not finished."""
TERMS_NAME = "terms"
"""Of the folder in it for what the publisher says of them."""
ASIDE_NAME = ".set-aside"
"""Of the folder in it for what was in the way and did not come from here."""
CATEGORIES_NAME = "categories.json"
"""In that: which model is of which category, where that had to be looked up."""

_MOST_BYTES = 64 * 2**20


@dataclass(frozen=True)
class Receipt:
    """What is known of a model that came.

    Attributes:
        source: the data set's name.
        archive, archive_sha256: what it was unpacked from.
        files, bytes: what came of it.
        listing: the SHA-256 of each file, by its name; not in the list of all models.
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
    checked_by: str = VERSION
    listing: Mapping[str, str] = field(default_factory=dict)


_RECEIPT = TypeAdapter(Receipt)


class Target:
    """A folder that one process at a time fetches into.

    Attributes:
        folder: where it is.
        receipts: of all models that came, by the name of their folder in it.
    """

    def __init__(
        self, folder: Path, terms: Terms, notice: Callable[[str], None] = lambda _: None
    ) -> None:
        """
        Args:
            notice: called with a sentence for each folder that is set aside.

        Raises:
            ArticugenError: another process fetches into it.
            MachineFault: it cannot be written to.
        """
        self.folder, self.terms, self._notice = folder, terms, notice
        self.receipts: dict[str, Receipt] = {}
        self.failed: dict[str, str] = {}
        self._claims: dict[PurePosixPath, tuple[str, str]] = {}
        self.work = self.path(WORK_NAME)
        try:
            make_folder(self.work)
            flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
            self._lock: BinaryIO = os.fdopen(os.open(self.work / "lock", flags, 0o666), "r+b")
        except OSError as error:
            raise MachineFault(cannot_write(folder, error)) from error
        except ValueError:
            raise InvalidArgument(
                f"{str(folder)!r}: no folder can have that name; choose another"
            ) from None
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

    def path(self, name: str) -> Path:
        """Return the path of something of that name in the folder, to be written.

        Raises:
            MachineFault: a symbolic link leads there.
        """
        try:
            return within(self.folder, name)
        except UnfitFile as error:
            raise MachineFault(cannot_write(self.folder / name, error)) from error

    def _tidy(self, *folders: Path) -> None:
        """Remove the files of ours that a killed process was writing."""
        ours = (LIST_NAME, RECEIPT_NAME, CATEGORIES_NAME)
        for path in (path for folder in folders for path in folder.glob(".*.partial")):
            if whole_name(path.name) in ours and path.is_file():
                path.unlink(missing_ok=True)

    def _believe(self, path: Path) -> None:
        """A model counts as there while all that came of it is, whatever else is there."""
        receipt = _receipt(path.parent)
        if receipt is None or receipt.files != len(receipt.listing):
            return
        with suppress(OSError, ValueError):
            if receipt.bytes == sum(os.lstat(path.parent / n).st_size for n in receipt.listing):
                self.receipts[path.parent.relative_to(self.folder).as_posix()] = receipt

    def wants(
        self, place: PurePosixPath, archive_sha256: str | None, origin: str, name: str
    ) -> bool:
        """Return whether a model is to be fetched: it is not there, as `has` says, and has a place
        of its own; where it has none that is noted.

        Args:
            origin: by which it is known from another one that would take its place.
            name: what it is called where it cannot be fetched.
        """
        first, called = self._claims.setdefault(place, (origin, name))
        try:
            if first != origin:
                raise InvalidSource(
                    f"{self.folder / place}: is where another model goes, {printable(called)}; "
                    "rename the folder of one, or fetch it into another folder"
                )
            if self.has(place, archive_sha256):
                return False
            self._free(place)
        except InvalidSource as error:
            self.fail(name, error)
            return False
        return True

    def _free(self, place: PurePosixPath) -> Path:
        """Return the folder of a model, where it may be had.

        Raises:
            InvalidSource: its name is kept for others, a model is in a model, or something that was
                not fetched is in the way.
        """
        to = self.folder / place
        first = place.parts[0].casefold() if place.parts else ""
        if (
            first in ("", LIST_NAME, TERMS_NAME)
            or any(part.startswith(".") for part in place.parts)
            or not str(place).isprintable()
        ):
            raise InvalidSource(f"{to}: no model can be called so here; rename its folder")
        try:
            within(self.folder, str(place))
        except UnfitFile as error:
            raise InvalidSource(f"{to}: {error.strerror}; move it away to fetch it") from None
        for above in place.parents[:-1]:
            if above in self._claims or os.path.lexists(self.folder / above / RECEIPT_NAME):
                raise InvalidSource(
                    f"{to}: lies in the folder of another model, {above}; unpack it elsewhere"
                )
            if is_no_folder(self.folder / above):
                raise InvalidSource(f"{self.folder / above}: is no folder; move it away")
        if os.path.lexists(to) and not (to / RECEIPT_NAME).exists():
            raise InvalidSource(f"{to}: is there, and was not fetched; move it away to fetch it")
        return to

    def has(self, place: PurePosixPath, archive_sha256: str | None) -> bool:
        """Return whether the model is there whole, from just that archive (None: from any), and
        checked by this version; a model that is not ours is left alone."""
        receipt = self.receipts.get(str(place))
        if receipt is None:
            return False
        if archive_sha256 not in (None, receipt.archive_sha256):
            return False
        if receipt.checked_by != VERSION:
            sha256, refused = self._judged(self.folder / place)
            self._note(place, replace(receipt, sha256=sha256, refused=refused, checked_by=VERSION))
        return True

    @contextmanager
    def unpacking(self) -> Iterator[Path]:
        """An empty folder to unpack into, gone afterwards."""
        folder = self.path(f"{WORK_NAME}/unpacking/{secrets.token_hex(4)}")
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
        """Check a model and give it its folder, in one step; what was there of it before is gone,
        or set aside where anything in it is somebody's own.

        Raises:
            InvalidSource: something that was not fetched is in the way.
            MachineFault, MemoryError: the disk is full, or the like.
        """
        to = self._free(place)
        receipt = Receipt(
            self.terms.source,
            archive,
            sha256,
            len(model.listing),
            model.bytes,
            *self._judged(staged, to),
            listing=model.listing,
        )
        write_atomically(staged / RECEIPT_NAME, _text(asdict(receipt)))
        try:
            make_folder(to.parent)
            if to.exists():
                self._clear(to, place, model.listing, staged.with_name(f"{staged.name}.old"))
            staged.rename(to)
        except OSError as error:
            raise MachineFault(cannot_write(to, error)) from error
        self.receipts[str(place)] = receipt

    def _clear(
        self, to: Path, place: PurePosixPath, listing: Mapping[str, str], away: Path
    ) -> None:
        """Move what is in a model's place away, to be deleted if all of it was fetched."""
        old = _receipt(to)
        if not _only(to, {*listing.items(), *(old.listing.items() if old else ())}):
            number = 1
            while os.path.lexists(away := self.path(f"{ASIDE_NAME}/{number}/{place}")):
                number += 1
            make_folder(away.parent)
            self._notice(f"{to}: holds what was not fetched, or has changed; it is in {away} now")
        to.rename(away)

    def _judged(self, path: Path, shown: Path | None = None) -> tuple[str | None, str | None]:
        """Return a model's digest, or why it cannot be used: it is read as any command reads it."""
        shown = shown or path
        try:
            return load_path(path).sha256, None
        except InvalidSource as error:
            said = (
                str(error).replace(str(path.resolve()), str(shown)).replace(str(path), str(shown))
            )
            return None, said.replace(f"{self.folder}/", "")

    def fail(self, name: str, error: Exception, archive: Path | None = None) -> None:
        """Note what could not be fetched or unpacked, without the paths of this machine."""
        said = str(error)
        if archive:
            said = said.replace(printable(str(archive)), printable(archive.name))
        self.failed[printable(name)] = said.replace(f"{self.folder}/", "")

    def _note(self, place: PurePosixPath, receipt: Receipt) -> None:
        write_atomically(self.folder / place / RECEIPT_NAME, _text(asdict(receipt)))
        self.receipts[str(place)] = receipt

    def close(self) -> None:
        """Write the list of all that came, and let others in."""
        sources = {self.terms.source, *(receipt.source for receipt in self.receipts.values())}
        listed = {
            "terms": {name: asdict(terms_of(name)) for name in sources},
            "models": {
                name: {k: v for k, v in asdict(receipt).items() if k != "listing"}
                for name, receipt in self.receipts.items()
            },
            "failed": self.failed,
        }
        try:
            write_atomically(self.folder / LIST_NAME, _text(listed))
        finally:
            self._lock.close()


def _receipts(folder: Path) -> Iterator[Path]:
    """The receipts below a folder; models, which hold thousands of files, are not looked into."""
    todo = [folder]
    while todo:
        for child in visible(todo.pop()):
            if not child.is_dir() or child.is_symlink():
                continue
            if (child / RECEIPT_NAME).exists():
                yield child / RECEIPT_NAME
            else:
                todo.append(child)


def _receipt(folder: Path) -> Receipt | None:
    """Return a model's receipt; None where it has none that can be believed."""
    try:
        data = read_regular(folder / RECEIPT_NAME, _MOST_BYTES, follow=False)
        receipt = _RECEIPT.validate_json(data)
    except (OSError, ValueError):
        return None
    return receipt if receipt.source in NAMES else None


def _only(folder: Path, known: set[tuple[str, str]]) -> bool:
    """Whether every file below a folder, but its receipt, is one of these, by name and SHA-256."""
    files = (p for p in folder.rglob("*") if is_no_folder(p) and p != folder / RECEIPT_NAME)
    try:
        return all(
            not file.is_symlink()
            and (file.relative_to(folder).as_posix(), sha256_of(file)) in known
            for file in files
        )
    except OSError:
        return False


def _text(value: object) -> bytes:
    return (json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False) + "\n").encode()
