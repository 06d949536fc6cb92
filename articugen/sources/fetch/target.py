"""The folder that models are fetched into: what is whole in it, and the list of all that came.

Each model has a record in the ledger, written before its folder gets its name: a model is there
with all files that its record tells of, whole and checked, or not at all. `fetched.json` is the
list of the records, with the terms.
"""

import fcntl
import json
import os
import secrets
import shutil
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
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
    NotFetched,
    printable,
)
from articugen.core.files import (
    UnfitFile,
    cannot_write,
    is_no_folder,
    make_folder,
    sha256_of,
    whole_name,
    within,
    write_atomically,
)
from articugen.core.ledger import Ledger
from articugen.core.place import Folder
from articugen.sources.fetch.models import Unpacked, unpack
from articugen.sources.fetch.terms import NAMES, Terms, terms_of
from articugen.sources.source import load_path

LIST_NAME = "fetched.json"
WORK_NAME = ".fetch"  # of the folder in it for what is not finished
TERMS_NAME = "terms"  # of the folder in it for what the publisher says of them
ASIDE_NAME = ".set-aside"  # of the folder in it for what was in the way and did not come from here
CATEGORIES_NAME = "categories.json"
"""In that of what is not finished: which model is of which category, where that is looked up."""


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


@dataclass(frozen=True)
class Receipt:
    """The record of a model that came.

    Attributes:
        source: the data set's name.
        archive, archive_sha256: what it was unpacked from.
        bytes: of all its files.
        sha256: the digest of the model as it is read; None of one that is refused.
        refused: why it cannot be used, in a sentence.
        checked_by: the version of articugen that says so.
        listing: the SHA-256 of each file, by its name; the list of all models has their number.
    """

    source: str
    archive: str
    archive_sha256: str
    bytes: int
    sha256: str | None
    refused: str | None
    checked_by: str = VERSION
    listing: Mapping[str, str] = field(default_factory=dict)


_RECEIPT = TypeAdapter(Receipt)


class Target:
    """A folder that one process at a time fetches into; `receipts` are of all models that are there
    whole, by the name of their folder in it."""

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
        self.failed: dict[str, str] = {}
        self._claims: dict[PurePosixPath, tuple[str, str]] = {}
        self._ledger = Ledger(Folder(folder))
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
        try:
            self._begin()
        except BaseException:
            self._lock.close()
            raise

    def _begin(self) -> None:
        """Remove what a killed process was writing, and read what came before."""
        shutil.rmtree(self.work / "unpacking", ignore_errors=True)
        self._ledger.place.delete(self._ledger.leftovers())
        for path in (*self.folder.glob(".*.partial"), *self.work.glob(".*.partial")):
            if whole_name(path.name) in (LIST_NAME, CATEGORIES_NAME) and path.is_file():
                path.unlink(missing_ok=True)
        self._recorded = {
            name: _receipt(data)
            for name, data in sorted(self._ledger.known().items())
            if (self.folder / name).is_dir()
        }
        self.receipts = {n: r for n, r in self._recorded.items() if r and self._is_whole(n, r)}

    def path(self, name: str) -> Path:
        """Return the path of something of that name in the folder, to be written; MachineFault
        where a symbolic link leads there."""
        try:
            return within(self.folder, name)
        except UnfitFile as error:
            raise MachineFault(cannot_write(self.folder / name, error)) from error

    def _is_whole(self, name: str, receipt: Receipt) -> bool:
        """Return whether all that came of a model is there, whatever else is there."""
        with suppress(OSError, ValueError):
            folder = within(self.folder, name)
            sizes = (os.lstat(folder / file).st_size for file in receipt.listing)
            return bool(receipt.listing) and receipt.bytes == sum(sizes)
        return False

    def lacks(self, place: PurePosixPath, archive_sha256: str | None, name: str) -> bool:
        """Return whether a model is to be fetched: it is not there whole, from just that archive
        (None: from any), and nothing is in its way; what is in the way is noted under the model's
        `name`.

        A model that is there and was checked by another version is checked again.
        """
        receipt = self.receipts.get(str(place))
        if receipt and archive_sha256 in (None, receipt.archive_sha256):
            if receipt.checked_by != VERSION:
                sha256, refused = self._judged(self.folder / place)
                self._record(
                    place, replace(receipt, sha256=sha256, refused=refused, checked_by=VERSION)
                )
            return False
        try:
            self._free(place)
        except InvalidSource as error:
            self.fail(name, error)
            return False
        return True

    def _free(self, place: PurePosixPath) -> Path:
        """Return the folder of a model; InvalidSource if its name is kept for others, a model is in
        a model, or something that was not fetched is in the way."""
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
            if above in self._claims or str(above) in self._recorded:
                raise InvalidSource(
                    f"{to}: lies in the folder of another model, {above}; unpack it elsewhere"
                )
            if is_no_folder(self.folder / above):
                raise InvalidSource(f"{self.folder / above}: is no folder; move it away")
        ours = str(place) in self._recorded or self._ledger.is_damaged(str(place))
        if os.path.lexists(to) and not ours:
            raise InvalidSource(f"{to}: is there, and was not fetched; move it away to fetch it")
        return to

    def take(
        self, path: Path, archive: str, sha256: str, place: Callable[[PurePosixPath], PurePosixPath]
    ) -> tuple[list[str], int]:
        """Unpack the models of an archive that are not there, check them and give each its folder.

        Args:
            archive, sha256: what the archive is called in the list, and its digest.
            place: the folder here of a model's folder in the archive.

        Returns:
            the places of all models in it, and how many came now; raises as `unpack`.
        """
        new = 0

        def wanted(root: PurePosixPath) -> bool:
            to, origin, name = place(root), f"{sha256}/{root}", str(path.name / root)
            first, called = self._claims.setdefault(to, (origin, name))
            if first == origin:
                return self.lacks(to, sha256, name)
            why = f"{self.folder / to}: is where another model goes, {printable(called)}; "
            cure = "rename the folder of one, or fetch it into another folder"
            self.fail(name, InvalidSource(why + cure))
            return False

        def take_in(model: Unpacked, staged: Path) -> None:
            nonlocal new
            self._take_in(place(model.root), model, staged, archive, sha256)
            new += 1

        folder = self.path(f"{WORK_NAME}/unpacking/{secrets.token_hex(4)}")
        try:
            folder.mkdir(parents=True)
        except OSError as error:
            raise MachineFault(cannot_write(folder, error)) from error
        try:
            roots = unpack(path, folder, wanted, take_in)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        return [str(place(root)) for root in roots], new

    def _take_in(
        self, place: PurePosixPath, model: Unpacked, staged: Path, archive: str, sha256: str
    ) -> None:
        """Check a model and give it its folder, in one step; what was there of it before is gone,
        or set aside where anything in it is somebody's own."""
        to = self._free(place)
        judged = self._judged(staged, to)
        receipt = Receipt(
            self.terms.source, archive, sha256, model.bytes, *judged, listing=model.listing
        )
        try:
            make_folder(to.parent)
            if to.exists():
                away = staged.with_name(f"{staged.name}.old")
                old = self._recorded.get(str(place))
                if not _only(to, {*model.listing.items(), *(old.listing.items() if old else ())}):
                    number = 1
                    while os.path.lexists(away := self.path(f"{ASIDE_NAME}/{number}/{place}")):
                        number += 1
                    make_folder(away.parent)
                    self._notice(
                        f"{to}: holds what was not fetched, or has changed; it is in {away} now"
                    )
                to.rename(away)
            self._record(place, receipt)
            staged.rename(to)
        except OSError as error:
            raise MachineFault(cannot_write(to, error)) from error

    def _record(self, place: PurePosixPath, receipt: Receipt) -> None:
        self._ledger.record(str(place), _text(asdict(receipt)))
        self._recorded[str(place)] = self.receipts[str(place)] = receipt

    def _judged(self, path: Path, shown: Path | None = None) -> tuple[str | None, str | None]:
        """Return a model's digest, or why it cannot be used: it is read as any command reads it."""
        shown = shown or path
        try:
            return load_path(path).sha256, None
        except InvalidSource as error:
            why = str(error).replace(str(path.resolve()), str(shown)).replace(str(path), str(shown))
            return None, why.replace(f"{self.folder}/", "")

    def fail(self, name: str, error: Exception, archive: Path | None = None) -> None:
        """Note what could not be fetched or unpacked, without the paths of this machine."""
        why = str(error)
        if archive:
            why = why.replace(printable(str(archive)), printable(archive.name))
        self.failed[printable(name)] = why.replace(f"{self.folder}/", "")

    def outcome(self, places: Collection[str], new: int) -> Fetched:
        """Return what is there of the models in these folders; NotFetched if not one of them is."""
        there = {name: self.receipts[name] for name in places if name in self.receipts}
        if self.failed and not there:
            raise NotFetched(next(iter(self.failed.values())))
        refused = {name: receipt.refused for name, receipt in there.items() if receipt.refused}
        return Fetched(self.folder, self.terms, len(there), new, refused, dict(self.failed))

    def close(self) -> None:
        """Write the list of all that came, and let others in."""
        models = {name: asdict(receipt) for name, receipt in self.receipts.items()}
        for model in models.values():
            model["files"] = len(model.pop("listing"))
        sources = {self.terms.source, *(receipt.source for receipt in self.receipts.values())}
        terms = {name: asdict(terms_of(name)) for name in sources}
        try:
            write_atomically(
                self.folder / LIST_NAME,
                _text({"terms": terms, "models": models, "failed": self.failed}),
            )
        finally:
            self._lock.close()


def _receipt(data: bytes) -> Receipt | None:
    """Return a model's record; None where it is none that can be believed."""
    with suppress(ValueError):
        receipt = _RECEIPT.validate_json(data)
        return receipt if receipt.source in NAMES else None
    return None


def _only(folder: Path, known: set[tuple[str, str]]) -> bool:
    """Return whether every file below a folder is one of these, by name and SHA-256."""
    try:
        return all(
            not file.is_symlink()
            and (file.relative_to(folder).as_posix(), sha256_of(file)) in known
            for file in folder.rglob("*")
            if is_no_folder(file)
        )
    except OSError:
        return False


def _text(value: object) -> bytes:
    return (json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False) + "\n").encode()
