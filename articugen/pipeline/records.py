"""What a place holds of a data set: how a run resumes where an earlier one stopped, and what it may
replace.

While a run is under way the ledger (`.articugen/`) has a record of each finished object, written
once its shard is in place, and the folder has no manifest; the one that a plain run takes away
waits in the ledger until the next one is written.
"""

import fcntl
import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from functools import cache, partial

from pydantic import ValidationError

from articugen.core.errors import ArticugenError, MachineFault
from articugen.core.files import is_plain_file, lock_folder, read_regular
from articugen.core.ledger import LEDGER, Ledger
from articugen.core.place import Folder, Listed
from articugen.pipeline.common import (
    NEVER_MADE,
    CommonPlan,
    Name,
    key_of,
    record_in,
    shard_names,
    with_free_names,
)
from articugen.pipeline.folder import (
    called_otherwise,
    is_of_plan,
    is_shard_of_ours,
    is_temporary,
    is_whole,
    listed,
)
from articugen.store.bucket import Bucket
from articugen.store.manifest import MANIFEST_NAME, Manifest
from articugen.store.manifest_pages import MOST_BYTES, stale_pages
from articugen.store.outcome import Key, Outcome, ShardEntry

_BEFORE = f"{LEDGER}/{MANIFEST_NAME}"
"""The manifest of what was there before a run began that may replace it."""


class Records(AbstractContextManager["Records"]):
    """Records of a place, and of a run in it.

    Nothing is believed that is not there as it was recorded: a shard in a folder counts only with
    the size and digest that its record states, or, where somebody has added a group `user`, with
    the content that it states; one in a store with its size, as the store keeps what it was given.

    A plain run has the folder to itself, and replaces shards of ours that are out of date.
    Processes that share out the objects, in a folder or a store, replace nothing. Files that no run
    of ours made are never touched, nor anything outside the folder.

    Attributes:
        agreed: what is made here, as the ledger says; None where no run has been cut short.
        manifest: of the data set as it is, if it is whole.
        outcomes: what was recorded of each object that anybody has asked for.
    """

    def __init__(
        self,
        place: Folder | Bucket,
        *,
        is_shared: bool = False,
        sizes_only: bool = False,
        lease: float = math.inf,
    ) -> None:
        """Read what a place holds, and keep other runs out of a folder. Nothing is written yet.

        Args:
            place: of the data set.
            is_shared: whether other processes may be at work on the same.
            sizes_only: believe a shard that has the recorded size.
            lease: seconds that a claim holds: see `Ledger`.

        Raises:
            ArticugenError: another run is at work in it, or models were fetched into it.
            MachineFault: it cannot be read.
            CorruptShard: its manifest is damaged.
        """
        self.place, self.is_shared = place, is_shared
        self.ledger = Ledger(place, lease=lease)
        self.agreed: CommonPlan | None = None
        self.manifest: Manifest | None = None
        self._folder = place.path if isinstance(place, Folder) else None
        self._sizes_only = sizes_only
        self._about: CommonPlan | None = None
        self._otherwise: Callable[[str], str | None] = lambda _: None
        self._names: dict[Name, str] = {}
        self.outcomes: dict[Name, Outcome] = {}
        self._recorded: set[str] = set()
        self._trusted: dict[str, tuple[ShardEntry, bool]] = {}
        self._stored: dict[str, Listed] = {}
        self._has_begun = self._has_news = False
        self._lock: int | None = None
        if self._folder is None or self._folder.exists():
            self._take_lock()
            try:
                self._load()
            except BaseException:
                self.close()
                raise

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let other runs into the folder."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    @property
    def handles(self) -> tuple[int, ...]:
        """The open file that keeps other runs out; whoever holds it does so as well."""
        return () if self._lock is None else (self._lock,)

    # --- what is there

    def expect(
        self, about: CommonPlan, names: Sequence[Name], ours: Sequence[Name], licence: str
    ) -> None:
        """Take what is to be made, the names of all objects and those of this share, and the
        source's licence; ArticugenError if other processes make something else here."""
        self._about = about
        if not self.is_shared:
            terms = {"source": about.source, "licence": licence}
            whole = self.manifest and {name: getattr(self.manifest, name) for name in terms}
            if self._folder and whole != terms:
                self._otherwise = cache(partial(called_otherwise, self._folder, terms))
            return
        self._names = shard_names(names)
        if self.agreed:
            about.check_like(self.agreed, self.place)
        self.look(ours)

    def look(self, names: Iterable[Name]) -> None:
        """Read the records of some objects."""
        wanted = list(names)
        if self._folder is None:
            known = {name: self.outcomes.get(name) for name in wanted}
            wanted = [n for n, o in known.items() if not o or o.failed or not self._is_trusted(o)]
        self._add(self.ledger.known(map(key_of, wanted)).values())

    def why(self, key: Key) -> str | None:
        """Return why the object must be made (again); None where what is there will do."""
        outcome = self.outcomes.get(key.name)
        if outcome is None:
            is_damaged = self.ledger.is_damaged(key_of(key.name))
            return "its record is damaged" if is_damaged else NEVER_MADE
        if outcome.failed is not None:
            return f"it failed ({outcome.failed.reason})"
        difference = self._difference(key, outcome)
        if difference is not None or outcome.shard is None:
            return difference
        is_whole = self._is_trusted(outcome)
        return None if is_whole else f"its shard {outcome.shard.name} is missing or altered"

    def finished(self, key: Key) -> Outcome | None:
        """Return what became of the object, where that still holds: see `why`."""
        return None if self.why(key) else self.outcomes[key.name]

    def is_complete(self, keys: Sequence[Key]) -> bool:
        """Return whether a run for `keys` has nothing to do: all made, and the manifest says just
        that."""
        if self.manifest is None or self._has_news or (self._folder and self.ledger.files()):
            return False
        return set(self.manifest.keys) == set(keys) and all(self.why(key) is None for key in keys)

    def conflict(self, keys: Sequence[Key]) -> str | None:
        """Return one sentence, where the place holds data that a run for `keys` would replace."""
        wanted = {key.name: key for key in keys}
        if self.is_shared:
            first = next(self._differences(wanted), None)
            return first and (
                f"{self.place}: holds shards of another data set ({first[0][1]}, for one: "
                f"{first[1]}), and processes that share out objects replace nothing; choose "
                "another output folder"
            )
        reasons = Counter(why for _, why in self._differences(wanted))
        if not reasons:
            return None
        why = ", ".join(f"{count} since {reason}" for reason, count in reasons.most_common())
        return (
            f"{self.place}: {reasons.total()} shards of an earlier run will be replaced or "
            f"removed ({why}); choose another output folder, which keeps them"
        )

    def _differences(self, wanted: Mapping[Name, Key]) -> Iterator[tuple[Name, str]]:
        """Yield the objects whose shards are not what a run for these keys wants, and why."""
        for name, outcome in self.outcomes.items():
            if outcome.shard is None:
                continue
            why = None if self.is_shared else "this run does not ask for it"
            if self.is_shared and outcome.shard.name != self._names.get(name):
                why = "its shard is called otherwise than ranks call it"
            elif name in wanted:
                why = self._difference(wanted[name], outcome)
            if why:
                yield name, why

    def _difference(self, key: Key, outcome: Outcome) -> str | None:
        """Return why an outcome will not do for a key, though its shard may be whole."""
        shard = outcome.shard
        return key.difference(outcome.key) or (self._otherwise(shard.name) if shard else None)

    def shard_names(self, keys: Sequence[Key]) -> dict[Key, str]:
        """Return a shard's name for each object: the one it has where it is finished, else a free
        one.

        In a new folder that is `<split>-<place among the keys of its split>.h5`; shares take these
        names, whatever they have seen of the others' work.
        """
        if self.is_shared:
            return {key: self._names[key.name] for key in keys}
        names = {
            key: done.shard.name for key in keys if (done := self.finished(key)) and done.shard
        }
        return with_free_names(names, keys)

    # --- a run

    def begin(self, names: Iterable[str]) -> None:
        """Take note that shards of these names are about to be written; a plain run takes the
        manifest away, if there is one.

        Raises:
            ArticugenError: a file of that name is not ours; other processes make something else.
            MachineFault: the place cannot be written.
        """
        assert self._about is not None, "say what is expected before anything is begun"
        names = sorted(set(names))
        if self._lock is None:
            self._take_lock()
            if self._folder and not self.is_shared and listed(self._folder):
                raise ArticugenError(f"{self.place}: another run was here meanwhile; run it again")
        for name in self._foreign(names):
            raise ArticugenError(
                f"{self.place}/{name}: exists and was not made by an earlier run here; "
                "move it away or choose another output folder"
            )
        text = self._about.model_dump_json().encode()
        if self.is_shared:
            self.agreed = self._plan_in(self.ledger.agree(text))
            self._about.check_like(self.agreed, self.place)
        else:
            # by the plan before this one
            self.place.delete([*self._unrecorded(), *self._temporary()])
            if self.manifest and self._folder:
                self.place.write(_BEFORE, read_regular(self._folder / MANIFEST_NAME, MOST_BYTES))
            self.ledger.agree(text, anew=True)
            self.agreed, self.manifest = self._about, None
            self.place.delete([MANIFEST_NAME])
        self._has_begun = True

    def _foreign(self, names: Iterable[str]) -> Iterator[str]:
        """Yield the names where something is that no run of ours has put there. Where a shard
        counts, a damaged one, or a link, is itself replaced."""
        trusted = {o.shard.name for o in self.outcomes.values() if o.shard}
        folder = self._folder
        about = self.agreed or (self._about if folder and self.ledger.files() else None)
        for name in names if folder else ():
            assert folder
            path = folder / name
            if (
                os.path.lexists(path)
                and not (name in trusted and (path.is_symlink() or not path.is_dir()))
                and not (name in self._recorded and is_shard_of_ours(folder, name))
                and not is_of_plan(folder, name, about)
            ):
                yield name

    def record(self, outcome: Outcome) -> None:
        """Add a finished object. Its shard must be in place."""
        if not self._has_begun:
            raise ValueError("begin, with the shards' names, before the first record")
        record_in(self.ledger, outcome)
        self.outcomes[outcome.key.name] = outcome
        if outcome.shard is not None:
            self._recorded.add(outcome.shard.name)
            self._trusted[outcome.shard.name] = outcome.shard, True

    def check_there(self, outcomes: Sequence[Outcome]) -> None:
        """Raise ArticugenError if shards of these outcomes were removed or replaced meanwhile,
        where others are at work."""
        if not self.is_shared:
            return
        self._sizes_only = True
        self._stored = {} if self._folder else dict(self.place.list())
        gone = [o.shard.name for o in outcomes if o.shard and not self._is_whole(o)]
        if gone:
            raise ArticugenError(
                f"{self.place}: {len(gone)} shards were removed or replaced during the run "
                f"({gone[0]}, for one); see who writes there, and run the same command again"
            )

    def finish(self, manifest: Manifest) -> None:
        """Write the manifest, then remove the ledger, which stays in a store where others may be
        reading it, and those of our shards it does not name; ArticugenError if another process is
        at work."""
        if self._lock is None or self.is_shared:
            self.close()
            self._take_lock(fcntl.LOCK_EX)
        self.ledger.seal(manifest.files(), keep=True)
        self.manifest = manifest
        if self._folder is not None:
            self.place.delete(self._leftovers(manifest))
        self._has_begun = False

    # --- what is left over

    def leftovers(self) -> dict[str, str]:
        """Return leftovers of killed runs in a folder, in the order to remove them, and why each is
        not needed.

        No worker may be at work. Shards that are recorded, and the records of a run that can go on,
        are none.
        """
        return self._leftovers(self.manifest if self._tells_all() else None)

    def _leftovers(self, whole: Manifest | None) -> dict[str, str]:
        """Return the leftovers; `whole` is a manifest of all that is recorded."""
        left = dict.fromkeys(self._temporary(), "a temporary file")
        named = {shard.name for shard in whole.shards} if whole else set[str]()
        orphans = [name for name in self._unrecorded() if name not in named]
        if whole and self._folder:
            names = sorted(self._recorded - named)
            orphans += [name for name in names if is_shard_of_ours(self._folder, name)]
        left |= dict.fromkeys(orphans, "a shard that is not recorded")
        if self.manifest and self._folder:  # without one, pages are all that lists the shards
            stale = stale_pages(self._folder / MANIFEST_NAME)
            left |= dict.fromkeys(stale, "a page that no manifest lists")
        if whole:
            files = [name for name in self.ledger.files() if name not in left]
            left |= dict.fromkeys(files, "the manifest says it all")
        return left

    def _tells_all(self) -> bool:
        """Return whether the manifest has all that shares have recorded; if not, merge them."""
        if self.manifest is None:
            return False
        is_of_shares = self.agreed is not None and self.agreed.shares > 0
        return not is_of_shares or set(self.outcomes.values()) <= set(self.manifest.outcomes)

    def tidy(self) -> None:
        """Remove what workers of a plain run were writing as it ended early, none of which is left;
        where the disk does not let us, the next run does."""
        if not self.is_shared:
            with suppress(MachineFault):
                self.place.delete(self._temporary())

    def _temporary(self) -> list[str]:
        """List files that killed runs were writing."""
        folder, names = self._folder, list[str]()
        if folder:
            names = [n for n in listed(folder) if is_temporary(n) and is_plain_file(folder / n)]
        return names + self.ledger.leftovers()

    def _unrecorded(self) -> list[str]:
        """List the shards that a killed run has left without a record."""
        folder = self._folder
        names = [n for n in listed(folder) if n not in self._recorded] if folder else []
        return [n for n in names if folder and is_of_plan(folder, n, self.agreed)]

    def _take_lock(self, kind: int | None = None) -> None:
        if self._folder is None:
            return
        kind = kind or (fcntl.LOCK_SH if self.is_shared else fcntl.LOCK_EX)
        self._lock = lock_folder(self._folder, kind)

    def _load(self) -> None:
        if isinstance(self.place, Bucket):
            self.manifest = Manifest.in_bucket(self.place)
            self._stored = dict(self.place.list())
            self._take(self.manifest)
            self.agreed = self._agreed()
            return
        assert self._folder is not None
        if "fetched.json" in listed(self._folder):
            raise ArticugenError(f"{self.place}: models were fetched into it; choose another")
        if os.path.lexists(self._folder / MANIFEST_NAME):
            self.manifest = Manifest.read(self._folder)
        self.agreed = self._agreed()
        ledger = self._folder / LEDGER
        if is_plain_file(self._folder / _BEFORE) and not ledger.is_symlink():
            earlier = Manifest.read(self._folder, _BEFORE)
            self._recorded = {shard.name for shard in earlier.shards}
            if self.manifest is None:
                self._take(earlier)
        self._take(self.manifest)
        if not self.is_shared:
            self._add(self.ledger.known().values())
        self._recorded |= {o.shard.name for o in self.outcomes.values() if o.shard}

    def _agreed(self) -> CommonPlan | None:
        try:
            text = self.ledger.agreed()
            return None if text is None else self._plan_in(text)
        except ArticugenError:
            if self.manifest is None:
                raise
            return None  # a whole set needs no plan

    def _plan_in(self, text: bytes) -> CommonPlan:
        try:
            return CommonPlan.model_validate_json(text)
        except ValidationError:
            raise ArticugenError(
                f"{self.place}/{LEDGER}: its run is of another version of articugen; finish it "
                "there, or choose another output folder"
            ) from None

    def _take(self, manifest: Manifest | None) -> None:
        for outcome in manifest.outcomes if manifest else ():
            self.outcomes[outcome.key.name] = outcome

    def _add(self, texts: Iterable[bytes]) -> None:
        """Take what records say: of a thing that is known already, anything but a fault."""
        for text in texts:
            with suppress(ValidationError):  # of another version: it says nothing
                outcome = Outcome.model_validate_json(text)
                known = self.outcomes.get(outcome.key.name)
                if known is None or known.failed or not outcome.failed:
                    self._has_news = self._has_news or outcome != known
                    self.outcomes[outcome.key.name] = outcome

    def _is_trusted(self, outcome: Outcome) -> bool:
        """Return whether its shard, if any, is whole: checked once."""
        if outcome.shard is None:
            return True
        shard, trusted = self._trusted.get(outcome.shard.name, (None, False))
        if shard != outcome.shard:
            trusted = self._is_whole(outcome)
            self._trusted[outcome.shard.name] = outcome.shard, trusted
        return trusted

    def _is_whole(self, outcome: Outcome) -> bool:
        """Return whether a shard is the file that was recorded, or that with a group `user`
        besides."""
        assert outcome.shard
        if self._folder is not None:
            return is_whole(self._folder, outcome, sizes_only=self._sizes_only)
        there = self._stored.get(outcome.shard.name)
        return there is not None and there.bytes == outcome.shard.bytes
