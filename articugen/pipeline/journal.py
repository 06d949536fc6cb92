"""The journal: how a run goes on where an earlier one stopped, and what it may replace.

While a run is under way its folder has a journal in place of the manifest: one line for each
finished object, on the disk as soon as its shard is. Ranks, which make a data set together, have a
journal each: see rank_journal.py.
"""

import fcntl
import json
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import TypeVar

from pydantic import ValidationError

from articugen.core.errors import ArticugenError, CorruptShard, MachineFault
from articugen.core.files import (
    UnfitFile,
    cannot_write,
    is_no_folder,
    is_plain_file,
    lock_folder,
    make_folder,
    open_regular,
    sync,
    whole_name,
    written_atomically,
)
from articugen.store.croissant import NAME as CROISSANT_NAME
from articugen.store.manifest import (
    MANIFEST_NAME,
    Claims,
    Key,
    Manifest,
    Outcome,
    ShardEntry,
    is_shard_name,
)
from articugen.store.manifest_pages import MOST_BYTES, MOST_PAGED_BYTES, is_page_name, stale_pages
from articugen.store.shards import content_sha256, open_shard

JOURNAL_NAME = ".articugen-journal.jsonl"
COMMON_PLAN = ".articugen-plan.json"
"""What ranks agree on."""

_SHARD = re.compile(r"(?P<split>.+)-\d{5,}\.h5")
_OF_A_RANK = re.compile(r"\.articugen-journal\.(\d{1,7})-of-(\d{1,7})\.[0-9a-f]{8}\.jsonl")

NEVER_MADE = "it has not been made yet"

J = TypeVar("J", bound="Journal")


class Journal:
    """What a folder already holds, and the record of a run in it; one run at a time.

    Nothing is believed that is not on the disk as it was recorded: a shard counts only with the
    size and digest that its line states, or, where somebody has added a group `user`, with the
    content that it states. Shards of ours that are out of date are replaced; files that no line
    names are never touched, nor anything outside the folder, whatever a line says.

    Use it as `with Journal(folder) as journal:`. The journal's first line that claims a file name
    is on the disk before the file is, so that a run that was killed recognises its own files.

    Journals that ranks have left are read like its own, and replaced by it.
    """

    _LOCK = fcntl.LOCK_EX

    def __init__(self, folder: Path) -> None:
        """Read what `folder` holds, and keep other runs out of it. Nothing is written yet.

        Raises:
            ArticugenError: another run is at work in it.
            MachineFault: it cannot be read.
            CorruptShard: its manifest or journal is damaged.
        """
        self.folder = folder
        self._path = folder / JOURNAL_NAME
        self._trusted: dict[str, tuple[ShardEntry, bool]] = {}
        self._outcomes: dict[tuple[str, str], Outcome] = {}
        self._ours: set[str] = set()
        self._manifest: Manifest | None = None
        self._of_ranks: list[str] = []
        self._claimed = False
        self._lock: int | None = None
        if folder.exists():
            self._take_lock()
            try:
                self._load()
            except BaseException:
                self.close()
                raise

    def __enter__(self: J) -> J:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let other runs into the folder."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    @property
    def path(self) -> Path:
        """Of the file."""
        return self._path

    @property
    def handles(self) -> tuple[int, ...]:
        """The open file that keeps other runs out; whoever holds it does so as well."""
        return () if self._lock is None else (self._lock,)

    def why(self, key: Key) -> str | None:
        """Why the object must be made (again); None where what is on the disk will do."""
        return why_again(key, self._outcomes.get((key.split, key.object_id)), self._is_trusted)

    def finished(self, key: Key) -> Outcome | None:
        """What became of the object, where that still holds: see `why`."""
        return None if self.why(key) else self._outcomes[key.split, key.object_id]

    def is_complete(self, keys: Sequence[Key]) -> bool:
        """Whether a run for `keys` has nothing to do: all made, and the manifest says just that."""
        if self._manifest is None or self._of_ranks or os.path.lexists(self._path):
            return False
        return set(self._manifest.keys) == set(keys) and all(self.why(key) is None for key in keys)

    def conflict(self, keys: Sequence[Key]) -> str | None:
        """One sentence, where the folder holds data that a run for `keys` would replace."""
        wanted = {(key.split, key.object_id): key for key in keys}
        reasons = Counter[str]()
        for name, outcome in self._outcomes.items():
            if outcome.shard is None:
                continue
            key = wanted.get(name)
            reason = key.difference(outcome.key) if key else "this run does not ask for it"
            if reason is not None:
                reasons[reason] += 1
        if not reasons:
            return None
        why = ", ".join(f"{count} since {reason}" for reason, count in reasons.most_common())
        return (
            f"{self.folder}: {sum(reasons.values())} shards of an earlier run will be replaced or "
            f"removed ({why}); choose another output folder, which keeps them"
        )

    def shard_names(self, keys: Sequence[Key]) -> dict[Key, str]:
        """A shard's name for each object: the one it has where it is finished, else a free one.

        In a new folder that is `<split>-<place among the keys of its split>.h5`.
        """
        names = {
            key: done.shard.name for key in keys if (done := self.finished(key)) and done.shard
        }
        taken, place = set(names.values()), Counter[str]()
        homeless: list[Key] = []
        for key in keys:
            own = f"{key.split}-{place[key.split]:05d}.h5"
            place[key.split] += 1
            if key in names:
                continue
            if own in taken:
                homeless.append(key)
            else:
                names[key] = own
                taken.add(own)
        free = {split: _numbered(split) for split in place}
        for key in homeless:
            names[key] = next(name for name in free[key.split] if name not in taken)
            taken.add(names[key])
        return names

    def claim(self, names: Iterable[str]) -> None:
        """Say that shards of these names are about to be written; the manifest goes, if any.

        Raises:
            ArticugenError: a file of that name is there and not ours.
            MachineFault: the folder cannot be written.
        """
        names = self._free(names)
        self._ours.update(names)
        self._manifest = None
        with written_atomically(self._path) as file:
            claims = Claims(claims=tuple(sorted(self._ours)))
            for line in (claims, *self._outcomes.values()):
                file.write(json.dumps(line.model_dump(mode="json")).encode() + b"\n")
        self.remove([MANIFEST_NAME, *self._of_ranks, *self._temporary()])
        self.remove(self._stale_pages())
        self._of_ranks = []
        self._claimed = True

    def _free(self, names: Iterable[str]) -> list[str]:
        """These names, once the folder is there and nothing of another's is called so."""
        names = sorted(set(names))
        if self._lock is None:
            self._take_lock()
        foreign = self._foreign(names)
        if foreign:
            raise ArticugenError(
                f"{self.folder / foreign[0]}: exists and was not made by an earlier run here; "
                "move it away or choose another output folder"
            )
        return names

    def record(self, outcome: Outcome) -> None:
        """Add a finished object: on the disk when this returns. Its shard must be in place."""
        if not self._claimed:
            raise ValueError("claim the shards' names before the first record")
        self._outcomes[outcome.key.split, outcome.key.object_id] = outcome
        if outcome.shard is not None:
            self._trusted[outcome.shard.name] = outcome.shard, True
        line = outcome.model_dump_json() + "\n"
        try:
            _append(self._path, line.encode())
        except OSError as error:
            raise MachineFault(cannot_write(self._path, error, len(line))) from None

    def finish(self, manifest: Manifest) -> None:
        """Write the manifest, then remove journals and those of our shards it does not name."""
        manifest.write(self.folder)
        self._manifest = manifest
        self.remove([*self.leftovers(), *self._of_ranks])
        self._of_ranks = []
        self._claimed = False

    def leftovers(self) -> dict[str, str]:
        """What killed runs left here, in the order to remove it, and why it is not needed.

        No worker may be at work. Shards that are recorded, and the journal of a run that can go on,
        are none.
        """
        told = self._manifest if self._manifest and self._tells_all(self._manifest) else None
        entries = [o.shard for o in self._outcomes.values() if o.shard]
        kept = {shard.name for shard in (told.shards if told else entries)}
        orphans = [name for name in sorted(self._ours - kept) if self._is_ours(name)]
        found = dict.fromkeys(self._temporary(), "a temporary file")
        found |= dict.fromkeys(orphans, "a shard that is not recorded")
        if self._manifest:  # without one, pages are all that tells of the shards
            found |= dict.fromkeys(self._stale_pages(), "a page that no manifest lists")
        if told:
            journals = [n for n in (JOURNAL_NAME, *self._of_ranks) if self._is_file(n)]
            found |= dict.fromkeys(journals, "the manifest says it all")
        return found

    def _tells_all(self, manifest: Manifest) -> bool:
        """Whether it tells of what ranks have recorded, too; else that awaits a merge."""
        return not self._of_ranks or set(self._outcomes.values()) <= set(manifest.outcomes)

    def remove(self, names: Iterable[str]) -> None:
        """Remove files of this folder, in this order; what is not there is no fault."""
        try:
            for name in names:
                (self.folder / name).unlink(missing_ok=True)
            sync(self.folder)
        except OSError as error:
            raise MachineFault(cannot_write(self.folder, error)) from None

    def tidy(self) -> None:
        """Remove what workers were writing as the run ended early, none of which is left; where the
        disk does not let us, the next run does."""
        with suppress(MachineFault):
            self.remove(self._temporary())

    def _temporary(self) -> list[str]:
        return [name for name in self._names() if is_temporary(name) and self._is_file(name)]

    def _stale_pages(self) -> list[str]:
        try:
            return stale_pages(self.folder / MANIFEST_NAME)
        except OSError as error:
            raise MachineFault(f"{self.folder}: cannot be read ({error.strerror})") from None

    def _names(self) -> list[str]:
        try:
            return sorted(os.listdir(self.folder))
        except OSError as error:
            raise MachineFault(f"{self.folder}: cannot be read ({error.strerror})") from None

    def _is_file(self, name: str) -> bool:
        return is_plain_file(self.folder / name)

    def _is_ours(self, name: str) -> bool:
        """Whether a file that a journal claims is what runs put there, a shard of the split that it
        is called by: journals are files like any other, and may claim what is somebody's own."""
        called = _SHARD.fullmatch(name)
        if called is None or not self._is_file(name):
            return False
        try:
            with open_shard(self.folder / name) as shard:
                return shard.attributes["split"] == called["split"]
        except CorruptShard:
            return False

    def _take_lock(self) -> None:
        try:
            make_folder(self.folder)
            self._lock = lock_folder(self.folder, self._LOCK)
        except OSError as error:
            raise MachineFault(cannot_write(self.folder, error)) from None

    def _foreign(self, names: Iterable[str]) -> list[str]:
        """Those of the names where something is that no run of ours has put there. What is recorded
        may be damaged, or a link, which is itself replaced."""
        recorded = {o.shard.name for o in self._outcomes.values() if o.shard}
        return [
            name
            for name in names
            if os.path.lexists(self.folder / name)
            and not (name in recorded and is_no_folder(self.folder / name))
            and not (name in self._ours and self._is_ours(name))
        ]

    def _load(self) -> None:
        if os.path.lexists(self.folder / MANIFEST_NAME):
            manifest = Manifest.read(self.folder)
            self._ours.update(shard.name for shard in manifest.shards)
            self._take(manifest.outcomes)
            self._manifest = manifest
        journal = self.folder / JOURNAL_NAME
        if os.path.lexists(journal):
            self._take(self._lines(journal))
        self._of_ranks = self._journals_of_ranks()
        for name in self._of_ranks:
            if name != COMMON_PLAN:
                self._add(self._lines(self.folder / name))

    def _journals_of_ranks(self) -> list[str]:
        """The names of those in this folder that are to be read, and of what they agreed on."""
        names = self._names()
        journals = [name for name in names if is_journal(name) and name != JOURNAL_NAME]
        return journals + [name for name in names if name == COMMON_PLAN]

    def _lines(self, path: Path) -> Iterator[Outcome]:
        """What a journal records; the names that it claims become ours."""
        cure, number = "delete that file and the shards beside it to start afresh", 0
        try:
            with open_regular(path, MOST_PAGED_BYTES, follow=False) as file:
                lines = iter(partial(file.readline, MOST_BYTES), b"")
                for number, line in enumerate(lines, start=1):
                    if not line.endswith(b"\n") and len(line) < MOST_BYTES:
                        return  # what follows the last \n is torn
                    if number == 1:
                        self._ours.update(Claims.model_validate_json(line).claims)
                    else:
                        yield Outcome.model_validate_json(line)
        except ValidationError:
            raise CorruptShard(f"{path}: line {number} is damaged; {cure}") from None
        except UnfitFile as error:
            raise CorruptShard(f"{path}: {error.strerror}; {cure}") from None
        except OSError as error:
            raise MachineFault(f"{path}: cannot be read ({error.strerror})") from None

    def _take(self, outcomes: Iterable[Outcome]) -> None:
        for outcome in outcomes:
            self._outcomes[outcome.key.split, outcome.key.object_id] = outcome

    def _add(self, outcomes: Iterable[Outcome]) -> None:
        """Take what other ranks may have recorded of the same objects: a shard rather than none,
        and of two the one that lies here."""
        for outcome in outcomes:
            known = self._outcomes.get((outcome.key.split, outcome.key.object_id))
            if known is None or known.fault or self._is_better(outcome, known):
                self._take([outcome])

    def _is_better(self, outcome: Outcome, known: Outcome) -> bool:
        if outcome.shard is None or outcome.shard == known.shard:
            return False
        return known.shard is None or self._is_whole(outcome)

    def _is_trusted(self, outcome: Outcome) -> bool:
        """Whether its shard is whole, looked at once."""
        assert outcome.shard
        shard, trusted = self._trusted.get(outcome.shard.name, (None, False))
        if shard != outcome.shard:
            trusted = self._is_whole(outcome)
            self._trusted[outcome.shard.name] = outcome.shard, trusted
        return trusted

    def _is_whole(self, outcome: Outcome) -> bool:
        """Whether a shard is the file that was recorded, or that with a group `user` besides."""
        assert outcome.shard
        assert outcome.made
        path = self.folder / outcome.shard.name
        try:
            if outcome.shard.is_of(path):
                return True
            with open_shard(path) as shard:
                content = [row for row in shard.content() if row[0] == outcome.key.object_id]
                return shard.extended and content_sha256(content) == outcome.made.content_sha256
        except (OSError, CorruptShard):
            return False


def why_again(key: Key, outcome: Outcome | None, is_whole: Callable[[Outcome], bool]) -> str | None:
    """Why an object must be made (again) of which `outcome` is known; None where that will do."""
    if outcome is None:
        return NEVER_MADE
    if outcome.fault is not None:
        return f"it failed ({outcome.fault.reason})"
    difference = key.difference(outcome.key)
    if difference is not None or outcome.shard is None:
        return difference
    return None if is_whole(outcome) else f"its shard {outcome.shard.name} is missing or altered"


def data_sets(path: Path, *, follow: bool = True) -> list[Path]:
    """The data set in `path`, or those in its folders, whole or not.

    Args:
        path: a folder; the link to one is followed, since it was named.
        follow: whether links in it are; not where something is written or removed.

    Raises:
        CorruptShard: there is none.
        ArticugenError: a data set would have to be followed to.
    """
    folders = [path]
    if not _is_data_set(path):
        inside = sorted(path.iterdir()) if path.is_dir() else []
        folders = [folder for folder in inside if _is_data_set(folder)]
        links = [] if follow else [folder for folder in folders if folder.is_symlink()]
        if links:
            raise ArticugenError(f"{links[0]}: a link to elsewhere; name that folder itself")
    if not folders:
        raise CorruptShard(f"{path}: holds no data set; make one with: articugen generate")
    return folders


def _is_data_set(folder: Path) -> bool:
    """Whether a run has been at work in a folder, or shards lie there."""
    names = os.listdir(folder) if folder.is_dir() else []
    return any(
        name == MANIFEST_NAME or is_journal(name) or is_temporary(name) or is_shard_name(name)
        for name in names
    )


def is_journal(name: str) -> bool:
    """Whether a run, or a rank, calls its journal so."""
    return name == JOURNAL_NAME or rank_of(name) is not None


def rank_of(name: str) -> tuple[int, int] | None:
    """Of a rank's journal: which it is, of how many; None of other files."""
    match = _OF_A_RANK.fullmatch(name)
    return (int(match[1]), int(match[2])) if match else None


def is_temporary(name: str) -> bool:
    """Whether a run gives a file this name until it is whole."""
    whole = whole_name(name)
    if whole is None:
        return False
    ours = is_journal(whole) or is_shard_name(whole) or is_page_name(whole)
    return ours or whole in (MANIFEST_NAME, CROISSANT_NAME, COMMON_PLAN)


def _numbered(split: str) -> Iterator[str]:
    return (f"{split}-{number:05d}.h5" for number in count())


def _append(path: Path, line: bytes) -> None:
    """Add a line to a file that is there: on the disk when this returns, or none of it is."""
    handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_NOFOLLOW)
    try:
        before = os.fstat(handle).st_size
        try:
            written = 0
            while written < len(line):
                written += os.write(handle, line[written:])
            os.fsync(handle)
        except OSError:
            os.ftruncate(handle, before)  # a torn line would spoil what is added after it
            raise
    finally:
        os.close(handle)
