"""The ledger of work that resumes where it stopped: one record a finished thing, written whole.

It lies beside what is made, in a folder or an object store, and nothing in it is ever appended to:

    .articugen/plan.json                what is made here; the first writer wins
    .articugen/done/<key>.json          one record a finished thing, written once it is in place
    .articugen/claims/<key>/<number>    who is at a thing, where strangers share the work

Whoever is killed has lost what it was at. A record that is torn, or of another thing, counts for
nothing: the thing is made again.
"""

import hashlib
import json
import math
import re
import time
from collections.abc import Iterable, Mapping
from uuid import uuid4

from articugen.core.errors import ArticugenError
from articugen.core.files import UnfitFile, whole_name
from articugen.core.place import Listed, Place, read_all

LEDGER = ".articugen"  # the folder of every ledger
_PLAN = f"{LEDGER}/plan.json"
_DONE = f"{LEDGER}/done"
_CLAIMS = f"{LEDGER}/claims"
_CLOCKS = f"{LEDGER}/clocks"

_PAUSES = (0.0, 0.01, 0.1, 0.5)
"""Seconds before each reading of a plan: on a file system without links another process may be
writing it just now."""

_UNSAFE = re.compile(r"[^A-Za-z0-9_-]+")
_LONGEST = 60  # letters of a key that its file is called by; a digest distinguishes keys


class Ledger:
    """Record of what is made in a place, what of it is finished, and who works on what.

    Several ledgers of one place, in as many processes, see each other's records and claims.

    Attributes:
        claims: `who` and `lease`, for a ledger of another process of the same run.
    """

    def __init__(self, place: Place, *, who: str = "", lease: float = math.inf) -> None:
        """
        Args:
            place: what the ledger lies beside; nothing is read or written yet.
            who: a name unlike any other run's; its processes may take each other's claims.
            lease: seconds after which a claim has run out: nobody is at a thing for so long.
        """
        self.place = place
        self.claims = (who or uuid4().hex, lease)
        self._who, self._lease = self.claims[0].encode(), lease
        self._damaged: set[str] = set()
        self._marked: Mapping[str, Listed] = {}
        self._ahead: float | None = None

    # --- what is made

    def agree(self, about: bytes, *, anew: bool = False) -> bytes:
        """Write down what is made here, the same bytes for the same work, unless somebody has;
        return what stands there then, or ArticugenError if that is damaged. What nobody else is at
        work on may be replaced: `anew`."""
        data = _sealed("", about)
        if anew:
            self.place.write(_PLAN, data)
        elif not self.place.write_new(_PLAN, data):
            theirs = self.agreed()
            return about if theirs is None else theirs
        return about

    def agreed(self) -> bytes | None:
        """Return what is made here, None where nobody has said so; ArticugenError if damaged."""
        for pause in _PAUSES:
            time.sleep(pause)
            try:
                data = self.place.read(_PLAN)
            except UnfitFile as error:
                raise self._damage(f"({error.strerror})") from None
            about = None if data is None else _opened("", data)
            if data is None or about is not None:
                return about
        raise self._damage("")

    def _damage(self, why: str) -> ArticugenError:
        return ArticugenError(
            f"{self.place}/{_PLAN}: damaged {why}".rstrip() + "; delete it, the same command "
            "writes it again and keeps what is finished"
        )

    # --- what is finished

    def known(self, keys: Iterable[str] | None = None) -> dict[str, bytes]:
        """Return the records of these things, or of all; see `is_damaged` for those that say
        nothing."""
        if keys is None:
            return self._values(dict.fromkeys(self.recorded()))
        names: dict[str, str | None] = {_file_of(key): key for key in keys}
        if len(names) > self.place.at_once > 1:  # one listing says which are there
            there = self.recorded()
            names = {name: key for name, key in names.items() if name in there}
        return self._values(names)

    def news(self) -> dict[str, bytes]:
        """Return the records that were written since this was called last, or `mark`."""
        before = self._marked
        self.mark()
        names = [name for name, about in self._marked.items() if before.get(name) != about]
        return self._values(dict.fromkeys(names))

    def mark(self) -> None:
        """Call `news` for what is recorded from now on."""
        self._marked = self.recorded()

    def _values(self, names: Mapping[str, str | None]) -> dict[str, bytes]:
        """Return the records in these files, whose keys are known, or stand in them."""
        records: dict[str, bytes] = {}
        read = read_all(self.place, [f"{_DONE}/{name}" for name in names])
        for (name, wanted), data in zip(names.items(), read, strict=True):
            key = _key_in(data) if wanted is None else wanted
            value = None if data is None or key is None else _opened(key, data)
            if value is not None and key is not None and _file_of(key) == name:
                self._damaged.discard(name)
                records[key] = value
            elif data is not None:
                self._damaged.add(name)
        return records

    def recorded(self) -> Mapping[str, Listed]:
        """Return the files of all records: a record written again is another size or time."""
        listed = self.place.list(_DONE)
        return {name: about for name, about in listed.items() if whole_name(name) is None}

    def is_damaged(self, key: str) -> bool:
        """Return whether a record was read that is torn, or another thing's."""
        return _file_of(key) in self._damaged

    def record(self, key: str, value: bytes) -> None:
        """Write down that a thing is finished, with what is known of it; it must be in place."""
        self.place.write(f"{_DONE}/{_file_of(key)}", _sealed(key, value))
        self._damaged.discard(_file_of(key))

    # --- who is at what

    def claim(self, key: str) -> bool:
        """Claim a thing; whether it is ours now."""
        folder = _claims_of(key)
        if self.place.write_new(f"{folder}/0", self._who):
            return True
        written = self._written(key)
        if written and self._age(written[max(written)]) < self._lease:
            return False
        return self.place.write_new(f"{folder}/{max(written, default=-1) + 1}", self._who)

    def is_free(self, key: str) -> bool:
        """Return whether nobody is at a thing."""
        written = self._written(key)
        return not written or self._age(written[max(written)]) >= self._lease

    def free(self, key: str) -> None:
        """Give up one's claim of a thing, after its record was written."""
        self.place.delete(f"{_claims_of(key)}/{number}" for number in self._written(key))

    def free_all(self) -> None:
        """Give up whatever this run still claims: its processes are no more."""
        names = [f"{_CLAIMS}/{name}" for name in self.place.list(_CLAIMS)]
        texts = read_all(self.place, names)
        self.place.delete(n for n, text in zip(names, texts, strict=True) if text == self._who)

    def _written(self, key: str) -> dict[int, float]:
        """Return the time each claim of a thing was written; a later claim has taken over an
        earlier."""
        listed = self.place.list(_claims_of(key))
        return {int(name): about.written for name, about in listed.items() if name.isdecimal()}

    def _age(self, written: float) -> float:
        """Seconds, by the place's clock, which is read once."""
        if self._ahead is None:
            name = uuid4().hex
            self.place.write(f"{_CLOCKS}/{name}", b"")
            now = self.place.list(_CLOCKS)[name].written
            self.place.delete([f"{_CLOCKS}/{name}"])
            self._ahead = now - time.time()
        return time.time() + self._ahead - written

    # --- the end

    def files(self) -> list[str]:
        """Return all files of the ledger, in the order to remove them: the plan last."""
        names = [f"{LEDGER}/{name}" for name in self.place.list(LEDGER)]
        return sorted(names, key=lambda name: (name == _PLAN, name))

    def leftovers(self) -> list[str]:
        """Return those that a killed process was writing; no other may be at work."""
        return [name for name in self.files() if whole_name(name.rpartition("/")[2]) is not None]

    def seal(self, report: Iterable[tuple[str, bytes]], *, keep: bool = False) -> None:
        """Write files, by name, that describe all of it, in their order, the last of which makes it
        count as finished; then remove the ledger, unless others may still be reading it
        (`keep`)."""
        for name, data in report:
            self.place.write(name, data)
        if not keep:
            self.place.delete(self.files())


def _file_of(key: str) -> str:
    """Return the name of a record's file, another for each key on any file system."""
    readable = _UNSAFE.sub("-", key)[-_LONGEST:]
    return f"{readable}.{hashlib.sha256(_bytes(key)).hexdigest()[:16]}.json"


def _claims_of(key: str) -> str:
    return f"{_CLAIMS}/{_file_of(key).removesuffix('.json')}"


def _sealed(key: str, value: bytes) -> bytes:
    """Two lines: whose record it is with a digest of both, and the record."""
    head = {"key": key, "sha256": hashlib.sha256(_bytes(key) + b"\n" + value).hexdigest()}
    return json.dumps(head).encode() + b"\n" + value + b"\n"


def _opened(key: str, data: bytes) -> bytes | None:
    """Return the record in a file; None where it is damaged or another thing's."""
    value = data.partition(b"\n")[2]
    return value[:-1] if value and data == _sealed(key, value[:-1]) else None


def _key_in(data: bytes | None) -> str | None:
    """Return the key of the record in a file."""
    try:
        key = json.loads((data or b"").partition(b"\n")[0])["key"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return key if isinstance(key, str) else None


def _bytes(key: str) -> bytes:
    return key.encode("utf-8", "surrogatepass")
