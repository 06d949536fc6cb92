"""Journals of ranks: processes on any machines that make one data set in one folder.

They never wait for each other, need no locks of the file system, and remove nothing. Each process
writes a journal of its own; what an earlier one has left, killed or not, is read. What they make
together is written down once, by the first of them.
"""

import fcntl
import hashlib
import json
import math
import os
import re
import secrets
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from articugen.core.errors import ArticugenError, CorruptShard, InvalidArgument, MachineFault
from articugen.core.files import (
    UnfitFile,
    cannot_write,
    make_folder,
    open_regular,
    partial_name,
    read_regular,
    sync,
    write_atomically,
)
from articugen.pipeline.journal import COMMON_PLAN, Journal, rank_of
from articugen.store.manifest import Claims, Key, Manifest, Outcome, Sha256
from articugen.store.manifest_pages import MOST_PAGED_BYTES

_MOST_PLAN_BYTES = 1 << 26

Name = tuple[str, str]
"""(split, object_id)."""


class Share(BaseModel):
    """The objects whose place in the plan leaves `number` when it is divided by `of`."""

    model_config = ConfigDict(frozen=True, strict=True)

    number: Annotated[int, Field(ge=0)]
    of: Annotated[int, Field(ge=1, le=1_000_000)]

    @staticmethod
    def of_text(text: str) -> "Share":
        """
        Raises:
            InvalidArgument: it is not like 3/8, or not below 8/8.
        """
        match = re.fullmatch(r"(\d{1,7})/(\d{1,7})", text)
        number, of = (int(match[1]), int(match[2])) if match else (0, 0)
        if not 0 <= number < of <= 1_000_000:
            raise InvalidArgument(
                f"--shard {text}: give i/n, counted from 0: 0/8 to 7/8 are all of eight"
            )
        return Share(number=number, of=of)

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"

    def has(self, place: int) -> bool:
        return place % self.of == self.number

    def meets(self, other: tuple[int, int]) -> bool:
        """Whether an object may be in both: ranks of another number share out differently."""
        number, of = other
        return of > 0 and (number - self.number) % math.gcd(of, self.of) == 0


class CommonPlan(BaseModel):
    """What ranks make together; all of them are asked for the same.

    Attributes:
        objects: how many.
        listing: a digest of their splits and ids, in order: what decides the shards' names.
        generator: of an object's `Key`.
        command: that makes all of it, for people.
    """

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    source: str
    category: str
    recipe: str
    seed: int
    ids: tuple[str, ...]
    exclude: tuple[str, ...]
    joints: tuple[str, ...]
    objects: int
    listing: Sha256
    generator: str
    command: str

    @staticmethod
    def read(folder: Path) -> "CommonPlan | None":
        """None where no rank has been at work.

        Raises:
            CorruptShard: it is damaged.
            MachineFault: it cannot be read.
        """
        path = folder / COMMON_PLAN
        try:
            return CommonPlan.model_validate_json(
                read_regular(path, _MOST_PLAN_BYTES, follow=False)
            )
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (UnfitFile, ValidationError):
            raise CorruptShard(
                f"{path}: damaged; delete it, the ranks' command writes it anew"
            ) from None
        except OSError as error:
            raise MachineFault(f"{path}: cannot be read ({error.strerror})") from None

    def check_like(self, theirs: "CommonPlan", folder: Path | str) -> None:
        """
        Raises:
            ArticugenError: ranks that made `theirs` in this folder were asked for something else.
        """
        words = {
            "listing": "list of objects",
            "objects": "number of objects",
            "ids": "choice of ids",
        }
        mine = self.model_dump(exclude={"command"})
        other = [words.get(n, n) for n, value in mine.items() if value != getattr(theirs, n)]
        if other:
            raise ArticugenError(
                f"{folder}: other ranks make another data set here (another {', '.join(other)}), "
                f"by: {theirs.command}; do as they do, or choose another output folder"
            )


def listing_of(names: Iterable[Name]) -> str:
    """The digest of objects in their order."""
    return hashlib.sha256("\n".join("\x1f".join(name) for name in names).encode()).hexdigest()


def shard_names(names: Iterable[Name]) -> dict[Name, str]:
    """`<split>-<place among the objects of its split>.h5`, as in a new folder."""
    place, found = Counter[str](), dict[Name, str]()
    for split, object_id in names:
        found[split, object_id] = f"{split}-{place[split]:05d}.h5"
        place[split] += 1
    return found


class RankJournal(Journal):
    """The journal of one rank, beside those of any others: see `Journal`.

    Its file is new, so that no two processes ever write into the same one. It reads what lies in
    the folder, but of other ranks only those whose share may meet its own.
    """

    _LOCK = fcntl.LOCK_SH

    def __init__(self, folder: Path, share: Share, plan: CommonPlan, names: Sequence[Name]) -> None:
        """Read what the folder holds; nothing is written yet.

        Args:
            folder: of the data set.
            share: of this rank.
            plan: of all ranks.
            names: of all objects, in the order of the plan.

        Raises:
            ArticugenError: another run, that is no rank, is at work in it, or ranks that make
                something else.
            MachineFault, CorruptShard: as `Journal`.
        """
        self._share, self._plan = share, plan
        self._shards = shard_names(names)
        super().__init__(folder)
        self._path = folder / f".articugen-journal.{share.number}-of-{share.of}.{_token()}.jsonl"

    def shard_names(self, keys: Sequence[Key]) -> dict[Key, str]:
        """By the plan of all alone, whatever this rank has seen of the others' work."""
        return {key: self._shards[key.split, key.object_id] for key in keys}

    def conflict(self, keys: Sequence[Key]) -> str | None:
        """One sentence, where the folder holds what ranks would have to replace or rename."""
        wanted = {_name(key): key for key in keys}
        for name, outcome in self._outcomes.items():
            if outcome.shard is None:
                continue
            why = "its shard is called otherwise than ranks call it"
            if outcome.shard.name == self._shards.get(name):
                why = wanted[name].difference(outcome.key) if name in wanted else None
            if why is not None:
                return (
                    f"{self.folder}: holds shards of another data set ({name[1]}, for one: {why}), "
                    "and ranks replace nothing; choose another output folder, or go on without "
                    "--shard"
                )
        return None

    def claim(self, names: Iterable[str]) -> None:
        """Say that shards of these names are about to be written.

        Raises:
            ArticugenError: a file of that name is there and not ours; other ranks make something
                else here.
            MachineFault: the folder cannot be written.
        """
        if not (names := sorted(set(names))):
            return
        if self._lock is None:
            self._take_lock()
        self._agree()
        if self._foreign(names):
            self._load()  # of a rank that has come meanwhile
        self._ours.update(self._free(names))
        line = json.dumps(Claims(claims=tuple(names)).model_dump()) + "\n"
        write_atomically(self._path, line.encode())
        self._claimed = True

    def tidy(self) -> None:
        """Leave it to the merge: other ranks may be writing."""

    def _agree(self) -> None:
        """Write down what all ranks make, or see that it is what the first has written."""
        if CommonPlan.read(self.folder) is None:
            _write_once(self.folder / COMMON_PLAN, self._plan.model_dump_json().encode())
        self._check_plan()

    def _check_plan(self) -> None:
        theirs = CommonPlan.read(self.folder)
        if theirs is not None:
            self._plan.check_like(theirs, self.folder)

    def _load(self) -> None:
        self._check_plan()
        super()._load()

    def _journals_of_ranks(self) -> list[str]:
        mine = super()._journals_of_ranks()
        return [n for n in mine if (rank := rank_of(n)) is not None and self._share.meets(rank)]


class Merging(Journal):
    """A folder that ranks have filled; as `Journal`, no other run may be at work in it.

    Attributes:
        merged: its manifest, where nothing of ranks is left to merge; else None.
        common: what the ranks make together, where something is.
    """

    merged: Manifest | None
    common: CommonPlan

    def __init__(self, folder: Path, *, sizes_only: bool = False) -> None:
        """
        Args:
            folder: of the data set.
            sizes_only: believe a shard that has the size which its rank recorded.

        Raises:
            ArticugenError: as `Journal`; no rank has been at work here.
        """
        self._sizes_only = sizes_only
        super().__init__(folder)

    def _load(self) -> None:
        super()._load()
        plan = CommonPlan.read(self.folder)
        if plan is None and (self._manifest is None or self._of_ranks):
            raise ArticugenError(
                f"{self.folder}: no rank has been at work here; make objects with: articugen "
                "generate ... --shard i/n"
            )
        self.merged = self._manifest if plan is None else None
        if plan is not None:
            self.common = plan

    @property
    def shares(self) -> tuple[Share, ...]:
        """Of the ranks that have left a journal."""
        ranks = sorted({rank for name in self._of_ranks if (rank := rank_of(name))})
        return tuple(Share(number=number, of=of) for number, of in ranks if number < of)

    @property
    def recorded(self) -> Mapping[Name, Outcome]:
        """What ranks, and runs before them, say of each object."""
        return self._outcomes

    def _is_whole(self, outcome: Outcome) -> bool:
        if not self._sizes_only or outcome.shard is None:
            return super()._is_whole(outcome)
        try:
            return (self.folder / outcome.shard.name).stat().st_size == outcome.shard.bytes
        except OSError:
            return False


class Following:
    """What ranks record in a folder, while they do."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._read = folder, dict[str, int]()

    def news(self) -> list[Outcome]:
        """What was recorded since this was called last.

        Raises:
            CorruptShard: a journal is damaged.
            MachineFault: one cannot be read.
        """
        names = sorted(os.listdir(self._folder)) if self._folder.is_dir() else []
        return [outcome for name in filter(rank_of, names) for outcome in self._lines(name)]

    def _lines(self, name: str) -> Iterator[Outcome]:
        path, begin = self._folder / name, self._read.get(name, 0)
        try:
            with open_regular(path, MOST_PAGED_BYTES, follow=False) as file:
                file.seek(begin)
                whole, _, _ = file.read().rpartition(b"\n")  # what follows is not written yet
        except FileNotFoundError:  # merged
            return
        except UnfitFile as error:
            raise CorruptShard(f"{path}: {error.strerror}; delete it") from None
        except OSError as error:
            raise MachineFault(f"{path}: cannot be read ({error.strerror})") from None
        self._read[name] = begin + len(whole) + bool(whole)
        try:
            for line in whole.splitlines()[0 if begin else 1 :]:  # the first one is of claims
                yield Outcome.model_validate_json(line)
        except ValidationError:
            raise CorruptShard(f"{path}: damaged; delete it, the same command goes on") from None


def _name(key: Key) -> Name:
    return key.split, key.object_id


def _token() -> str:
    return secrets.token_hex(4)


def _write_once(path: Path, data: bytes) -> None:
    """Write a file, unless another process has: then it stays what that one wrote."""
    temporary = path.with_name(partial_name(path.name))
    try:
        make_folder(path.parent)
        with temporary.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        try:
            with suppress(FileExistsError):
                os.link(temporary, path)
        except OSError:  # a file system without links; what the last one writes says the same
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
        sync(path.parent)
    except OSError as error:
        raise MachineFault(cannot_write(path, error, len(data))) from None
