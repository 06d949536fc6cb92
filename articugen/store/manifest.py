"""The manifest: what was made, from what, by which version, and what was not and why.

It is written last: a folder with a manifest is complete. `pipeline.records` knows the others.
One of very many objects has their entries in files beside it: see manifest_pages.py.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, FailFast, Field, ValidationError, model_validator

from articugen.core.errors import CorruptShard, printable
from articugen.core.files import read_or_refuse, read_regular, write_atomically
from articugen.core.place import Folder
from articugen.core.schema import SCHEMA_VERSION
from articugen.core.yaml_files import fault_in
from articugen.store.bucket import Files, Remote
from articugen.store.manifest_pages import MOST_BYTES, Head, Page, head_in, page_of, stale_pages
from articugen.store.outcome import Key, ObjectEntry, Outcome, Record, Rejection, Sha256, ShardEntry
from articugen.store.provenance import code_version, library_versions, this_commit, this_machine
from articugen.store.shards import content_sha256

MANIFEST_NAME = "manifest.json"

MOST_OBJECTS = 2_000_000
"""Of a data set: its manifest has 770 bytes for each, more where there are notes, and is read into
memory as a whole."""

PAGE_ENTRIES = 50_000
"""Of each list that a page holds at most; a manifest that has no more of any is one file."""


class _Version(BaseModel):
    model_config = ConfigDict(strict=True)
    schema_version: int


class Timings(Record):
    """Timings of the run that wrote the manifest; what it took over from an earlier run is not
    counted."""

    seconds: float = Field(ge=0.0)
    instances_per_second: float = Field(ge=0.0)
    peak_memory_bytes: int = Field(ge=0)
    workers: int = Field(ge=1)


Made = Annotated[tuple[ObjectEntry, ...], FailFast(fail_fast=True)]
Shards = Annotated[tuple[ShardEntry, ...], FailFast(fail_fast=True)]
Unmade = Annotated[tuple[Rejection, ...], FailFast(fail_fast=True)]


class _Entries(Record):
    """Page of a manifest's lists."""

    objects: Made
    shards: Shards
    rejected: Unmade
    skipped: Unmade
    failed: Unmade


LISTS = tuple(_Entries.model_fields)
"""Of a manifest, that may be in pages."""
UNMADE = ("rejected", "skipped", "failed")
"""Those of what is not in the data, as an `Outcome` calls them, too."""


class Manifest(Record):
    """Manifest of a data set: everything needed to trust it, and to make it again.

    Attributes:
        schema_version: of its shards.
        category, source, licence: of the models.
        recipe: the resolved recipe as canonical JSON; `recipe_sha256` its digest.
        seed: the master seed.
        articugen_version: of the package, + a digest of its code; it decides nothing, and objects
            that an earlier run made were made by that one's.
        commit: of the code, only where it ran from a checkout; "+changes" where that had any.
        versions: of Python and the libraries that decide numbers or bytes.
        machine: what it ran on.
        objects, shards, rejected, skipped, failed: what was made and what was not: see `Outcome`.
        shortfall: one sentence on why the set is not what its recipe asks for, or None.
        content_sha256: `content_of` the objects: the same for the same recipe, seed, models and
            code, whatever the number of workers, the grouping into shards or the HDF5 version.
        timings: of the last run.
        manifest_sha256: `digest` of all the rest: an edit shows.
    """

    schema_version: int
    category: str
    source: str
    licence: str
    recipe: str
    recipe_sha256: Sha256
    seed: int
    articugen_version: str
    commit: str | None
    versions: dict[str, str]
    machine: dict[str, str | int]
    objects: Made
    shards: Shards
    rejected: Unmade
    skipped: Unmade
    failed: Unmade
    shortfall: str | None
    content_sha256: Sha256
    timings: Timings
    manifest_sha256: Sha256

    def __repr__(self) -> str:
        counts = (
            f"{len(self.objects):,} objects, {sum(s.instances for s in self.shards):,} instances"
        )
        lists = ((name, getattr(self, name)) for name in UNMADE)
        out = "".join(f", {len(some):,} {name}" for name, some in lists if some)
        return printable(
            f"Manifest({self.category} from {self.source}: {counts}{out}; "
            f"content {self.content_sha256[:16]})"
        )

    __str__ = __repr__

    @model_validator(mode="after")
    def _agrees_with_itself(self) -> "Manifest":
        if hashlib.sha256(self.recipe.encode()).hexdigest() != self.recipe_sha256:
            raise ValueError("recipe_sha256 is not the digest of recipe")
        if content_of(self.objects) != self.content_sha256:
            raise ValueError("content_sha256 is not the digest of the objects'")
        instances = Counter({shard.name: shard.instances for shard in self.shards})
        listed = Counter[str]()
        for entry in self.objects:
            listed[entry.shard] += entry.instances
        if instances != listed or len(instances) != len(self.shards):
            raise ValueError("objects and shards do not list the same instances")
        if self.failed and not self.shortfall:
            raise ValueError("objects failed, but the set is marked as whole")
        times = Counter((key.split, key.object_id) for key in self.keys)
        if times and times.most_common(1)[0][1] > 1:
            raise ValueError(f"object {times.most_common(1)[0][0][1]} is listed twice")
        if self.digest() != self.manifest_sha256:
            raise ValueError("manifest_sha256 is not the digest of the rest: it was edited")
        return self

    @property
    def keys(self) -> tuple[Key, ...]:
        """Keys of all objects that were tried."""
        lists = (self.objects, self.rejected, self.skipped, self.failed)
        return tuple(entry.key for entries in lists for entry in entries)

    def digest(self) -> str:
        """Return the digest of all but `manifest_sha256`, as JSON with sorted keys and without
        spaces."""
        rest = self.model_dump(mode="json", exclude={"manifest_sha256", *LISTS})
        digest = hashlib.sha256()
        for number, name in enumerate(sorted([*rest, *LISTS])):
            digest.update(b"{" if number == 0 else b",")
            digest.update(_compact(name) + b":")
            if name not in LISTS:
                digest.update(_compact(rest[name]))
                continue
            digest.update(b"[")
            for place, entry in enumerate(getattr(self, name)):  # one by one: there may be millions
                digest.update(b"," * (place > 0) + _compact(entry.model_dump(mode="json")))
            digest.update(b"]")
        digest.update(b"}")
        return digest.hexdigest()

    @staticmethod
    def sealed(**values: Any) -> "Manifest":
        """Return a manifest of these values, and with their digest."""
        values["manifest_sha256"] = Manifest.model_construct(**values).digest()
        return Manifest(**values)

    @staticmethod
    def of(
        outcomes: Iterable[Outcome],
        *,
        category: str,
        source: str,
        licence: str,
        recipe: str,
        seed: int,
        timings: Timings,
        shortfall: str | None = None,
    ) -> "Manifest":
        """Return the manifest of a finished run: of these outcomes, made here and now by this
        code."""
        outcomes = sorted(outcomes, key=lambda o: (o.key.split, o.key.object_id))
        objects = tuple(o.made for o in outcomes if o.made)
        return Manifest.sealed(
            schema_version=SCHEMA_VERSION,
            category=category, source=source, licence=licence, recipe=recipe, seed=seed,
            recipe_sha256=hashlib.sha256(recipe.encode()).hexdigest(),
            articugen_version=code_version(), commit=this_commit(), versions=library_versions(),
            machine=this_machine(), objects=objects, shortfall=shortfall, timings=timings,
            shards=tuple(sorted((o.shard for o in outcomes if o.shard), key=lambda s: s.name)),
            content_sha256=content_of(objects),
            **{kind: tuple(filter(None, map(attrgetter(kind), outcomes))) for kind in UNMADE},
        )  # fmt: skip

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """Outcome of each object."""
        shards = {shard.name: shard for shard in self.shards}
        return (
            *(Outcome(made=entry, shard=shards[entry.shard]) for entry in self.objects),
            *(Outcome(**{kind: entry}) for kind in UNMADE for entry in getattr(self, kind)),
        )

    def write(self, folder: Path) -> None:
        """Write manifest.json in one step, after its pages where it has any, and remove those of an
        earlier one; ArticugenError if the disk is full, or the folder cannot be written to."""
        for name, data in self.files():
            write_atomically(folder / name, data)
        Folder(folder).delete(stale_pages(folder / MANIFEST_NAME))

    def files(self) -> Iterator[tuple[str, bytes]]:
        """Yield the names and bytes of the files that it is written as, in their order: pages, if
        it has any, then manifest.json."""
        longest = max(len(getattr(self, name)) for name in LISTS)
        if longest <= PAGE_ENTRIES:
            yield MANIFEST_NAME, (self.model_dump_json(indent=1) + "\n").encode()
            return
        pages: list[Page] = []
        for number, at in enumerate(range(0, longest, PAGE_ENTRIES)):
            piece = {name: getattr(self, name)[at : at + PAGE_ENTRIES] for name in LISTS}
            text = _Entries.model_construct(None, **piece).model_dump_json(indent=1) + "\n"
            pages.append(page_of(number, text.encode(), sum(map(len, piece.values()))))
            yield pages[-1].name, text.encode()
        head = self.model_dump(mode="json", exclude=set(LISTS))
        head["pages"] = [page.model_dump() for page in pages]
        yield MANIFEST_NAME, (json.dumps(head, indent=1, ensure_ascii=False) + "\n").encode()

    @staticmethod
    def read(folder: Path, name: str = MANIFEST_NAME) -> "Manifest":
        """Read the manifest of a data set; `name` is that of its file, whose pages lie in the
        folder.

        Raises:
            CorruptShard: there is none, it is of another version, or not as it was written.
        """
        path = folder / name
        cure = "a run that was cut short goes on when it is started again; else move it away"
        text = read_or_refuse(path, MOST_BYTES, CorruptShard, cure)
        return _parsed(text, path, lambda page: read_regular(folder / page.name, page.bytes))

    @staticmethod
    def in_bucket(bucket: Files) -> "Manifest | None":
        """Return that of a data set in an object store, or elsewhere; None where there is none,
        CorruptShard as `read`, MachineFault if the store does not answer."""
        text = bucket.read(MANIFEST_NAME)
        path = Remote(bucket.url) / MANIFEST_NAME

        def read(page: Page) -> bytes | None:
            size = bucket.size(page.name)
            return bucket.read(page.name) if size in (None, page.bytes) else b""

        return None if text is None else _parsed(text, path, read)


def _parsed(text: bytes, path: Path | Remote, read: Callable[[Page], bytes | None]) -> Manifest:
    """Return the manifest that lies at `path`, or CorruptShard; `read` gives its pages, None where
    one is not there."""
    with suppress(ValidationError):
        version = _Version.model_validate_json(text).schema_version
        if version not in range(1, SCHEMA_VERSION + 1):
            raise CorruptShard(
                f"{path}: schema version {version}, this articugen reads 1 to {SCHEMA_VERSION}; "
                "make the data set again in another folder"
            )
    try:
        head = head_in(text)
        if head is None:
            return Manifest.model_validate_json(text)
        return Manifest.model_validate(_with_entries(head, path, read))
    except ValidationError as error:
        raise CorruptShard(
            f"{path}: {fault_in(error)}; fetch it again, or delete the folder and make it again"
        ) from None


def _with_entries(
    head: Head, path: Path | Remote, read: Callable[[Page], bytes | None]
) -> dict[str, Any]:
    """Return what a manifest says that lists pages, with all that is in them; CorruptShard if a
    page is not there, or another one."""
    rest = dict(head.model_extra or {})
    for name in rest.keys() & LISTS:
        raise CorruptShard(f"{path}: lists pages, and {name} of its own; fetch it again")
    lists: dict[str, list[Any]] = {name: [] for name in LISTS}
    for page in head.pages:
        try:
            piece = _entries_in(page, read(page))
        except (OSError, ValueError) as error:
            fault = error.strerror if isinstance(error, OSError) else error
            cure = f"delete {path.name}, and generate writes both again"
            if isinstance(path, Path):
                cure = "mend it with: articugen verify --repair"
            raise CorruptShard(
                f"{path.parent / page.name}: a page of {path.name}: {fault}; fetch it again, or "
                f"{cure}"
            ) from None
        for name in LISTS:
            lists[name] += getattr(piece, name)
    return rest | {name: tuple(entries) for name, entries in lists.items()}


def _entries_in(page: Page, data: bytes | None) -> _Entries:
    """Return what a page holds; ValueError says what is wrong with it."""
    if data is None:
        raise ValueError("is not there")
    if len(data) != page.bytes or hashlib.sha256(data).hexdigest() != page.sha256:
        raise ValueError("has other bytes than those listed")
    try:
        piece = _Entries.model_validate_json(data)
    except ValidationError as error:
        raise ValueError(fault_in(error)) from None
    if sum(len(getattr(piece, name)) for name in LISTS) != page.entries:
        raise ValueError(f"does not hold {page.entries:,} entries")
    return piece


def _compact(value: Any) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":")).encode()


def content_of(objects: Iterable[ObjectEntry]) -> str:
    """Return the digest of a whole data set: over the sorted (split, object_id, content_sha256)."""
    return content_sha256((o.key.split, o.key.object_id, o.content_sha256) for o in objects)
