"""The manifest: what was made, from what, by which version, and what was not and why.

It is written last: a folder with a manifest is complete. `pipeline.records` tells of the others.
One of very many objects has their entries in files beside it: see manifest_pages.py.
"""

import errno
import hashlib
import json
import os
import platform
import subprocess
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, ConfigDict, FailFast, Field, ValidationError, model_validator

from articugen.core.content import VERSION
from articugen.core.errors import CorruptShard, MachineFault, printable
from articugen.core.files import UnfitFile, cannot_write, read_regular, sha256_of, write_atomically
from articugen.core.schema import SCHEMA_VERSION, SPLIT
from articugen.store.bucket import Files, Remote
from articugen.store.manifest_pages import MOST_BYTES, Head, Page, slices, stale_pages
from articugen.store.shards import ShardRecord, content_sha256

MANIFEST_NAME = "manifest.json"

MOST_OBJECTS = 2_000_000
"""Of a data set: its manifest has 770 bytes for each, more where there are notes, and is read into
memory as a whole."""

MOST_INSTANCES = 65_536
"""Of an object, as many as a recipe can ask for: a data set that is open has 8 bytes for each."""

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
ShardName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*\.h5$", max_length=200)]


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class _Entry(_Record):
    """A record of which a manifest holds millions."""

    _UNKNOWN: ClassVar[set[str]] = set()

    def model_post_init(self, context: Any) -> None:
        """Forget which fields were given: nobody asks, and it is half of what a record takes."""
        object.__setattr__(self, "__pydantic_fields_set__", self._UNKNOWN)


class Claims(_Record):
    """Names of shards that a run may write, replace and remove: of files in its own folder."""

    claims: tuple[ShardName, ...]


def is_shard_name(name: str) -> bool:
    """Whether a shard may be called so."""
    try:
        Claims(claims=(name,))
    except ValidationError:
        return False
    return True


class Key(_Entry):
    """What decides one object's data; the same key means the same bytes.

    Attributes:
        split, object_id: which object.
        ref: what it is read from: a digest of its files, or whatever a source finds cheap and sure.
        recipe_sha256: of all in the recipe that decides an object's content.
        seed: the master seed.
        generator: what of the code decides it: see `content`.
    """

    split: Annotated[str, Field(pattern=SPLIT)]
    object_id: str
    ref: str
    recipe_sha256: Sha256
    seed: int
    generator: str

    def difference(self, made: "Key") -> str | None:
        """Why data made for the key `made` will not do for this one; None where it does."""
        if made.ref != self.ref:
            return "its source has changed"
        if made.recipe_sha256 != self.recipe_sha256:
            return "the recipe has changed"
        if made.seed != self.seed:
            return f"the seed was {made.seed}, is {self.seed}"
        if made.generator != self.generator:
            was, now = set(made.generator.split(", ")), set(self.generator.split(", "))
            both = ((was, now), (now, was))
            numbers = (", ".join(sorted(one - other)) or "without" for one, other in both)
            return "the code makes other data: it was {}, is {}".format(*numbers)
        return None


class ShardEntry(_Entry):
    """A shard: its name in the folder, digest and size of the file, how many instances it holds."""

    name: ShardName
    sha256: Sha256
    bytes: int = Field(gt=0)
    instances: int = Field(gt=0)

    def is_of(self, path: Path) -> bool:
        """Whether the file has this size and digest.

        Raises:
            OSError: it is not there, or cannot be read.
        """
        return path.stat().st_size == self.bytes and sha256_of(path) == self.sha256


class ObjectEntry(_Entry):
    """An object that was made into data.

    Attributes:
        key: what decided its content.
        input_sha256: of the files it was read from.
        shard: the name of the shard that holds all its instances.
        instances: how many.
        content_sha256: `shards.content_sha256` of its instances.
        notes: what a user should know of it.
        seconds: it took one worker.
    """

    key: Key
    input_sha256: Sha256
    shard: str
    instances: int = Field(gt=0, le=MOST_INSTANCES)
    content_sha256: Sha256
    notes: tuple[str, ...] = ()
    seconds: float = Field(0.0, ge=0.0)


_OUR_FAULT = "internal error, please report it: "


class Rejection(_Record):
    """An object that is not in the data, and why: one sentence.

    Attributes:
        over: where it exceeded a limit of the recipe: the limit's key and value; else ().
    """

    key: Key
    reason: str
    over: tuple[str, float] | tuple[()] = ()

    @property
    def sentence(self) -> str:
        """The object's name, once, and the reason."""
        name = self.key.object_id
        return self.reason if self.reason.startswith(f"{name}:") else f"{name}: {self.reason}"

    @staticmethod
    def of_fault(key: Key, error: Exception) -> "Rejection":
        """For a fault of our code, which says nothing about the object."""
        return Rejection(key=key, reason=printable(f"{_OUR_FAULT}{type(error).__name__}: {error}"))


class Outcome(_Record):
    """What became of one object.

    Attributes:
        made, shard: it is in the data.
        rejected: it cannot be used.
        skipped: it has nothing to articulate in the recipe's sense, which is no fault.
        failed: through a fault of the machine or of ours; the next run tries it again.
    """

    made: ObjectEntry | None = None
    shard: ShardEntry | None = None
    rejected: Rejection | None = None
    skipped: Rejection | None = None
    failed: Rejection | None = None

    @model_validator(mode="after")
    def _is_one_of_four(self) -> "Outcome":
        kinds = (self.made, self.rejected, self.skipped, self.failed)
        if (self.made is None) != (self.shard is None) or sum(o is not None for o in kinds) != 1:
            raise ValueError(
                "an outcome is an object with its shard, or why there is none: one of the two"
            )
        if self.made and self.shard and self.made.shard != self.shard.name:
            raise ValueError("the object is said to be in another shard")
        return self

    @staticmethod
    def of_shard(
        key: Key,
        record: ShardRecord,
        *,
        input_sha256: str,
        notes: tuple[str, ...] = (),
        seconds: float = 0.0,
    ) -> "Outcome":
        """The outcome of an object whose instances, and only those, are in the shard `record`."""
        made = ObjectEntry(
            key=key,
            input_sha256=input_sha256,
            shard=record.name,
            instances=record.instances,
            content_sha256=content_sha256(record.content),
            notes=notes,
            seconds=seconds,
        )
        shard = ShardEntry(
            name=record.name,
            sha256=record.sha256,
            bytes=record.bytes,
            instances=record.instances,
        )
        return Outcome(made=made, shard=shard)

    @property
    def key(self) -> Key:
        entry = self.made or self.rejected or self.skipped or self.failed
        assert entry is not None  # _is_one_of_four has seen to it
        return entry.key

    @property
    def fault(self) -> Rejection | None:
        """Why the object says nothing about itself and is tried again, whatever its key."""
        if self.rejected and self.rejected.reason.startswith(_OUR_FAULT):
            return self.rejected  # so earlier versions wrote it
        return self.failed


class Timings(_Record):
    """Of the run that wrote the manifest; what it took over from an earlier run is not counted."""

    seconds: float = Field(ge=0.0)
    instances_per_second: float = Field(ge=0.0)
    peak_memory_bytes: int = Field(ge=0)
    workers: int = Field(ge=1)


Made = Annotated[tuple[ObjectEntry, ...], FailFast(fail_fast=True)]
Shards = Annotated[tuple[ShardEntry, ...], FailFast(fail_fast=True)]
Unmade = Annotated[tuple[Rejection, ...], FailFast(fail_fast=True)]


class _Entries(_Record):
    """What a page holds of a manifest's lists."""

    objects: Made
    shards: Shards
    rejected: Unmade
    skipped: Unmade
    failed: Unmade


LISTS = tuple(_Entries.model_fields)
"""Of a manifest, that may be in pages."""


class Manifest(_Record):
    """Everything one needs to trust a data set, and to make it again.

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
        made = f"{len(self.objects):,} objects, {sum(s.instances for s in self.shards):,} instances"
        lists = {"rejected": self.rejected, "skipped": self.skipped, "failed": self.failed}
        out = "".join(f", {len(some):,} {name}" for name, some in lists.items() if some)
        return printable(
            f"Manifest({self.category} from {self.source}: {made}{out}; "
            f"content {self.content_sha256[:16]})"
        )

    __str__ = __repr__

    @model_validator(mode="after")
    def _agrees_with_itself(self) -> "Manifest":
        if hashlib.sha256(self.recipe.encode()).hexdigest() != self.recipe_sha256:
            raise ValueError("recipe_sha256 is not the digest of recipe")
        if content_of(self.objects) != self.content_sha256:
            raise ValueError("content_sha256 is not the digest of the objects'")
        held = Counter({shard.name: shard.instances for shard in self.shards})
        listed = Counter[str]()
        for entry in self.objects:
            listed[entry.shard] += entry.instances
        if held != listed or len(held) != len(self.shards):
            raise ValueError("objects and shards do not list the same instances")
        if self.failed and not self.shortfall:
            raise ValueError("objects failed, but the set is said to be whole")
        times = Counter((key.split, key.object_id) for key in self.keys)
        if times and times.most_common(1)[0][1] > 1:
            raise ValueError(f"object {times.most_common(1)[0][0][1]} is listed twice")
        if self.digest() != self.manifest_sha256:
            raise ValueError("manifest_sha256 is not the digest of the rest: it was edited")
        return self

    @property
    def keys(self) -> tuple[Key, ...]:
        """Of all objects that were tried."""
        lists = (self.objects, self.rejected, self.skipped, self.failed)
        return tuple(entry.key for entries in lists for entry in entries)

    def digest(self) -> str:
        """Of everything but `manifest_sha256`, as JSON with sorted keys and without spaces."""
        rest = self.model_dump(mode="json", exclude={"manifest_sha256", *LISTS})
        digest = hashlib.sha256()
        for number, name in enumerate(sorted([*rest, *LISTS])):
            digest.update(b"{" if number == 0 else b",")
            digest.update(_compact(name) + b":")
            if name in LISTS:  # one by one, since there may be millions
                _update_by_each(digest, getattr(self, name))
            else:
                digest.update(_compact(rest[name]))
        digest.update(b"}")
        return digest.hexdigest()

    @staticmethod
    def sealed(**values: Any) -> "Manifest":
        """A manifest of these values, and with their digest."""
        draft = Manifest.model_construct(**values)
        return Manifest(**values, manifest_sha256=draft.digest())

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
        """The manifest of a finished run: of these outcomes, made here and now by this code."""
        outcomes = sorted(outcomes, key=lambda o: (o.key.split, o.key.object_id))
        objects = tuple(o.made for o in outcomes if o.made)
        return Manifest.sealed(
            schema_version=SCHEMA_VERSION,
            category=category,
            source=source,
            licence=licence,
            recipe=recipe,
            recipe_sha256=hashlib.sha256(recipe.encode()).hexdigest(),
            seed=seed,
            articugen_version=code_version(),
            commit=this_commit(),
            versions=library_versions(),
            machine=this_machine(),
            objects=objects,
            shards=tuple(sorted((o.shard for o in outcomes if o.shard), key=lambda s: s.name)),
            rejected=tuple(o.rejected for o in outcomes if o.rejected),
            skipped=tuple(o.skipped for o in outcomes if o.skipped),
            failed=tuple(o.failed for o in outcomes if o.failed),
            shortfall=shortfall,
            content_sha256=content_of(objects),
            timings=timings,
        )

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """What became of each object."""
        shards = {shard.name: shard for shard in self.shards}
        return (
            *(Outcome(made=entry, shard=shards[entry.shard]) for entry in self.objects),
            *(Outcome(rejected=rejection) for rejection in self.rejected),
            *(Outcome(skipped=rejection) for rejection in self.skipped),
            *(Outcome(failed=rejection) for rejection in self.failed),
        )

    def write(self, folder: Path) -> None:
        """Write manifest.json in one step, after its pages where it has any; those of an earlier
        one are removed then.

        Raises:
            ArticugenError: the disk is full, the folder cannot be written to.
        """
        for name, data in self.files():
            write_atomically(folder / name, data)
        try:
            for name in stale_pages(folder / MANIFEST_NAME):
                (folder / name).unlink(missing_ok=True)
        except OSError as error:
            raise MachineFault(cannot_write(folder, error)) from None

    def files(self) -> Iterator[tuple[str, bytes]]:
        """The names and bytes of the files that it is written as, in their order: pages, if it has
        any, then manifest.json."""
        pieces = slices({name: getattr(self, name) for name in LISTS})
        if len(pieces) == 1:
            yield MANIFEST_NAME, (self.model_dump_json(indent=1) + "\n").encode()
            return
        pages: list[Page] = []
        for number, piece in enumerate(pieces):
            text = _Entries.model_construct(None, **piece).model_dump_json(indent=1) + "\n"
            data = text.encode()
            pages.append(Page.of(number, data, sum(map(len, piece.values()))))
            yield pages[-1].name, data
        head: dict[str, Any] = {}
        for name in Manifest.model_fields:
            if name not in LISTS:
                head |= self.model_dump(mode="json", include={name})
            elif name == LISTS[0]:
                head["pages"] = [page.model_dump() for page in pages]
        text = json.dumps(head, indent=1, ensure_ascii=False) + "\n"
        yield MANIFEST_NAME, text.encode()

    @staticmethod
    def read(folder: Path, name: str = MANIFEST_NAME) -> "Manifest":
        """The manifest of a data set; `name` is that of its file, whose pages lie in the folder.

        Raises:
            CorruptShard: there is none, it is of another version, or not as it was written.
        """
        path = folder / name
        try:
            text = read_regular(path, MOST_BYTES)
        except UnfitFile as error:
            raise CorruptShard(
                f"{path}: {error.strerror}; move it away, or choose another folder"
            ) from None
        except OSError as error:
            raise CorruptShard(
                f"{path}: cannot be read ({error.strerror}); a run that was cut short goes on when "
                "it is started again"
            ) from None
        return _parsed(text, path, lambda page: read_regular(folder / page.name, page.bytes))

    @staticmethod
    def in_bucket(bucket: Files) -> "Manifest | None":
        """That of a data set in an object store, or elsewhere; None where there is none.

        Raises:
            CorruptShard: as `read`.
            MachineFault: the store does not answer.
        """
        text = bucket.read(MANIFEST_NAME)
        path = Remote(bucket.url) / MANIFEST_NAME

        def read(page: Page) -> bytes | None:
            size = bucket.size(page.name)
            return bucket.read(page.name) if size in (None, page.bytes) else b""

        return None if text is None else _parsed(text, path, read)


def _parsed(text: bytes, path: Path | Remote, read: Callable[[Page], bytes | None]) -> Manifest:
    """The manifest that lies at `path`; `read` gives its pages, None where one is not there.

    Raises:
        CorruptShard: as `Manifest.read`.
    """
    found = _version_in(text)
    if found is not None and found not in range(1, SCHEMA_VERSION + 1):
        raise CorruptShard(
            f"{path}: schema version {found}, this articugen reads 1 to {SCHEMA_VERSION}; "
            "make the data set again in another folder"
        )
    try:
        head = Head.of(text)
        if head is None:
            return Manifest.model_validate_json(text)
        return Manifest.model_validate(_with_entries(head, path, read))
    except ValidationError as error:
        raise CorruptShard(
            f"{path}: {_first_fault(error)}; fetch it again, or delete the folder and make it again"
        ) from None


def _with_entries(
    head: Head, path: Path | Remote, read: Callable[[Page], bytes | None]
) -> dict[str, Any]:
    """What a manifest says that lists pages, with all that is in them.

    Raises:
        CorruptShard: a page is not there, or not the one that is listed.
    """
    lists: dict[str, list[Any]] = {name: [] for name in LISTS}
    for page in head.pages:
        beside = path.parent / page.name
        try:
            piece = _entries_in(page, read(page))
        except (OSError, ValidationError) as error:
            fault = _first_fault(error) if isinstance(error, ValidationError) else error.strerror
            cure = f"delete {path.name}, and generate writes both again"
            if isinstance(path, Path):
                cure = "mend it with: articugen verify --repair"
            raise CorruptShard(
                f"{beside}: a page of {path.name}: {fault}; fetch it again, or {cure}"
            ) from None
        for name in LISTS:
            lists[name] += getattr(piece, name)
    told = dict(head.model_extra or {})
    for name in told.keys() & lists:
        raise CorruptShard(f"{path}: lists pages, and {name} of its own; fetch it again")
    return told | {name: tuple(entries) for name, entries in lists.items()}


def _entries_in(page: Page, data: bytes | None) -> _Entries:
    """
    Raises:
        OSError: it is not the page that is listed.
        ValidationError: it is, and does not hold entries.
    """
    if data is None:
        raise FileNotFoundError(errno.ENOENT, "is not there")
    if not page.is_whole(data):
        raise UnfitFile(errno.EINVAL, "has other bytes than those listed")
    piece = _Entries.model_validate_json(data)
    if sum(len(getattr(piece, name)) for name in LISTS) != page.entries:
        raise UnfitFile(errno.EINVAL, f"does not hold {page.entries:,} entries")
    return piece


def _compact(value: Any) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":")).encode()


def _update_by_each(digest: Any, entries: Iterable[_Record]) -> None:
    """As if all were one list."""
    digest.update(b"[")
    for number, entry in enumerate(entries):
        digest.update(b"," * (number > 0) + _compact(entry.model_dump(mode="json")))
    digest.update(b"]")


def content_of(objects: Iterable[ObjectEntry]) -> str:
    """The digest of a whole data set: over the sorted (split, object_id, content_sha256)."""
    lines = sorted(f"{o.key.split}\x1f{o.key.object_id}\x1f{o.content_sha256}" for o in objects)
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def library_versions() -> dict[str, str]:
    """Of Python and of the libraries that decide a data set's numbers or bytes."""
    names = ("numpy", "numba", "h5py", "trimesh", "yourdfpy")
    return {"python": platform.python_version()} | {n: metadata.version(n) for n in names}


@cache
def code_version() -> str:
    """The package's version and a digest of all its code."""
    package = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        digest.update(file.relative_to(package).as_posix().encode() + b"\0" + file.read_bytes())
    return f"{VERSION}+{digest.hexdigest()[:12]}"


def this_machine() -> dict[str, str | int]:
    """What we run on: system, architecture, processor, number of cores."""
    processor = platform.processor() or platform.machine()
    information = Path("/proc/cpuinfo")
    if information.is_file():
        lines = information.read_text(errors="replace").splitlines()
        names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
        processor = names[0] if names else processor
    return {
        "system": f"{platform.system()} {platform.release()}",
        "architecture": platform.machine(),
        "processor": processor,
        "cores": os.cpu_count() or 1,
    }


def this_commit() -> str | None:
    """The git commit of the checkout that this package is tracked in; None for an installed one."""
    package = Path(__file__).resolve().parents[1]

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(package), *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=20)
        return done.stdout

    try:
        git("ls-files", "--error-unmatch", "__init__.py")
        changes = git("status", "--porcelain", "--untracked-files=no", "--", ".")
        return git("rev-parse", "HEAD").strip() + ("+changes" if changes else "")
    except (OSError, subprocess.SubprocessError):
        return None


class _Version(BaseModel):
    model_config = ConfigDict(strict=True)
    schema_version: int


def _version_in(text: bytes) -> int | None:
    try:
        return _Version.model_validate_json(text).schema_version
    except ValidationError:
        return None


def _first_fault(error: ValidationError) -> str:
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    said = first["msg"].removeprefix("Value error, ")
    return f"{where}: {said}" if where else said
