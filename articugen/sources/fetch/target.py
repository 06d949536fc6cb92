"""The folder that models are fetched into: what is whole in it, and the list of all that came.

Each model has a record in the ledger, written before its folder gets its name: a model is there
with all files that its record lists, whole and checked, or not at all. `fetched.json` is the list
of the records, with the terms. Nothing in the folder that has a name is ever deleted.
"""

import json
import os
import secrets
import shutil
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath

from pydantic import TypeAdapter

from articugen.core.errors import InvalidSource, NotFetched, printable
from articugen.core.files import UnfitFile, lock_folder, make_folder, whole_name, within, writing
from articugen.core.ledger import Ledger
from articugen.core.place import Folder
from articugen.sources.fetch.archives import Unpacked, unpack
from articugen.sources.fetch.terms import NAMES, Terms, terms_of
from articugen.sources.source import load_path

LIST_NAME = "fetched.json"
TERMS_NAME = "terms"  # of the folder in it for what the publisher says of them
WORK_NAME = ".fetch"  # of the folder in it for what is not finished
_UNPACKING = f"{WORK_NAME}/unpacking"
_RENAME = "rename the folder of one, or fetch it into another folder"
_ASIDE = ".set-aside"  # of the folder in it for models that others have taken the place of


@dataclass(frozen=True)
class Fetched:
    """Result of a call: what is there now of the models that were asked for.

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
        sizes: of each file, by its name; `fetched.json` has their number and sum.
        sha256: the digest of the model as it is read; None of one that is refused.
        refused: why it cannot be used, in a sentence.
    """

    source: str
    archive: str
    archive_sha256: str
    sizes: dict[str, int]
    sha256: str | None
    refused: str | None


_RECEIPT = TypeAdapter(Receipt)


class Target:
    """A folder that one process at a time fetches into (`place`); `receipts` are of all models that
    are there whole, by the name of their folder in it."""

    def __init__(self, folder: Path, terms: Terms, notice: Callable[[str], None]) -> None:
        """
        Args:
            notice: called with a sentence for each folder that is set aside.

        Raises:
            ArticugenError: another process fetches into it.
            MachineFault: it cannot be written to.
        """
        self.folder, self.terms, self._notice = folder, terms, notice
        self.failed: dict[str, str] = {}
        self.receipts: dict[str, Receipt] = {}
        self._recorded: set[str] = set()  # with those of which something is missing
        self._new = 0
        self._origins: dict[PurePosixPath, tuple[Path, PurePosixPath]] = {}
        self.place = Folder(folder)
        self._ledger = Ledger(self.place)
        work = self.path(WORK_NAME)
        self._lock = lock_folder(work)
        try:
            self._begin(work)
        except BaseException:
            os.close(self._lock)
            raise

    def _begin(self, work: Path) -> None:
        """Remove what a killed process was writing, and read what came before."""
        shutil.rmtree(self.folder / _UNPACKING, ignore_errors=True)
        self.place.delete(self._ledger.leftovers())
        for path in (*self.folder.glob(f".{LIST_NAME}.*.partial"), *work.glob(".*.partial")):
            if whole_name(path.name) and path.is_file():
                path.unlink(missing_ok=True)
        for name, data in sorted(self._ledger.known().items()):
            with suppress(OSError, ValueError):  # and what is no record of ours counts for nothing
                folder = within(self.folder, name)
                if not folder.is_dir():
                    continue
                self._recorded.add(name)
                receipt = _RECEIPT.validate_json(data)
                sizes = {file: os.lstat(folder / file).st_size for file in receipt.sizes}
                if sizes and sizes == receipt.sizes and receipt.source in NAMES:
                    self.receipts[name] = receipt

    def path(self, name: str) -> Path:
        """Return the path of something of that name in the folder, to be written; MachineFault
        where a symbolic link leads there."""
        with writing(self.folder / name):
            return within(self.folder, name)

    def lacks(self, place: PurePosixPath, archive_sha256: str | None, name: str) -> bool:
        """Return whether a model is to be fetched: it is not there whole, from just that archive
        (None: from any), and nothing is in its way; what is in the way is noted under the model's
        `name`.

        A refused model that is there is read again: it may have been an older version's refusal.
        """
        receipt = self.receipts.get(str(place))
        if receipt and archive_sha256 in (None, receipt.archive_sha256):
            if receipt.refused:
                sha256, refused = _read(self.folder / place, place)
                self._record(place, replace(receipt, sha256=sha256, refused=refused))
            return False
        why = self._in_the_way(place)
        if why:
            self.fail(name, f"{place}: {why}")
        return not why

    def _in_the_way(self, place: PurePosixPath) -> str:
        """Return why no model can be put there, "" where one can: its name is kept for others, it
        would lie in another model, or something that was not fetched is there."""
        first = place.parts[0].casefold() if place.parts else ""
        hidden = any(part.startswith(".") for part in place.parts)
        if hidden or first in ("", LIST_NAME, TERMS_NAME) or not str(place).isprintable():
            return "no model can be called so here; rename its folder"
        try:
            to = within(self.folder, str(place))
        except UnfitFile as error:
            return f"{error.strerror}; move it away to fetch it"
        for above in place.parents[:-1]:
            if above in self._origins or str(above) in self._recorded:
                return f"lies in the folder of another model, {above}; unpack it elsewhere"
        known = str(place) in self._recorded or self._ledger.is_damaged(str(place))
        if os.path.lexists(to) and not known:
            return "is there, and was not fetched; move it away to fetch it"
        return ""

    def take(
        self, path: Path, archive: str, place: Callable[[PurePosixPath], PurePosixPath]
    ) -> list[str]:
        """Unpack the models of an archive that are not there, check them and give each its folder.

        Args:
            archive: what it is called in the list.
            place: the folder here of a model's folder in the archive.

        Returns:
            the places of all models in it; raises as `unpack`.
        """
        places: list[str] = []

        def wanted(sha256: str, root: PurePosixPath) -> bool:
            to, name = place(root), str(path.name / root)
            places.append(str(to))
            origin = self._origins.setdefault(to, (path, root))
            if origin == (path, root):
                return self.lacks(to, sha256, name)
            other = printable(str(origin[0].name / origin[1]))
            self.fail(name, f"{to}: is where another model goes, {other}; {_RENAME}")
            return False

        folder = self.path(_UNPACKING)
        try:
            for model in unpack(path, folder, wanted):
                self._take_in(place(model.root), model, archive)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        return places

    def _take_in(self, place: PurePosixPath, model: Unpacked, archive: str) -> None:
        """Check a model and give it its folder, in one step; what was there of it before is set
        aside."""
        to, source = self.folder / place, self.terms.source
        receipt = Receipt(source, archive, model.sha256, model.sizes, *_read(model.folder, place))
        with writing(to):
            make_folder(to.parent)
            if to.exists():
                aside = self.path(f"{_ASIDE}/{secrets.token_hex(4)}/{place}")
                make_folder(aside.parent)
                to.rename(aside)
                self._notice(f"{to}: was of another version, or had changed; it is in {aside} now")
            self._record(place, receipt)
            model.folder.rename(to)
        self._new += 1

    def _record(self, place: PurePosixPath, receipt: Receipt) -> None:
        self._ledger.record(str(place), _text(asdict(receipt)))
        self._recorded.add(str(place))
        self.receipts[str(place)] = receipt

    def fail(self, name: str, why: str, archive: Path | None = None) -> None:
        """Note why something is not fetched or unpacked, without the paths of this machine."""
        if archive:
            why = why.replace(printable(str(archive)), printable(archive.name))
        self.failed[printable(name)] = printable(why.replace(f"{self.folder}/", ""))

    def outcome(self, places: Collection[str]) -> Fetched:
        """Return what is there of the models in these folders; NotFetched if not one of them is."""
        there = {name: self.receipts[name] for name in places if name in self.receipts}
        if self.failed and not there:
            raise NotFetched(next(iter(self.failed.values())))
        refused = {name: receipt.refused for name, receipt in there.items() if receipt.refused}
        return Fetched(self.folder, self.terms, len(there), self._new, refused, self.failed)

    def close(self) -> None:
        """Write the list of all that came, and let others in."""
        models = {name: asdict(receipt) for name, receipt in self.receipts.items()}
        for model in models.values():
            sizes = model.pop("sizes").values()
            model |= {"files": len(sizes), "bytes": sum(sizes)}
        sources = {self.terms.source, *(receipt.source for receipt in self.receipts.values())}
        terms = {name: terms_of(name)._asdict() for name in sources}
        try:
            report = {"terms": terms, "models": models, "failed": self.failed}
            self.place.write(LIST_NAME, _text(report))
        finally:
            os.close(self._lock)


def _read(folder: Path, place: PurePosixPath) -> tuple[str | None, str | None]:
    """Return a model's digest, or why it cannot be used: it is read as any command reads it."""
    try:
        return load_path(folder).sha256, None
    except InvalidSource as error:
        why = str(error).replace(str(folder.resolve()), str(place))
        return None, why.replace(str(folder), str(place))


def _text(value: object) -> bytes:
    return (json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False) + "\n").encode()
