"""What became of each object of a data set, as ledgers and manifests record it."""

import re
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, model_validator

from articugen.core.files import sha256_of
from articugen.core.schema import SPLIT
from articugen.store.shards import ShardRecord, content_sha256

MOST_INSTANCES = 65_536
"""Of an object, as many as a recipe can ask for: a data set that is open has 8 bytes for each."""

_SHARD_NAME = r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,196}\.h5$"

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
ShardName = Annotated[str, Field(pattern=_SHARD_NAME)]


class Record(BaseModel):
    """A strict record that does not change."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class _Entry(Record):
    """A record of which a manifest holds millions."""

    _UNKNOWN: ClassVar[set[str]] = set()

    def model_post_init(self, context: Any) -> None:
        """Forget which fields were given: nobody asks, and it is half of what a record takes."""
        object.__setattr__(self, "__pydantic_fields_set__", self._UNKNOWN)


def is_shard_name(name: str) -> bool:
    """Return whether a shard may be called so: a name of a file in its own folder."""
    return re.fullmatch(_SHARD_NAME[1:-1], name) is not None


class Key(_Entry):
    """Key of one object's data; the same key means the same bytes.

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

    @property
    def name(self) -> tuple[str, str]:
        """The object, whatever it is made with."""
        return self.split, self.object_id

    def difference(self, theirs: "Key") -> str | None:
        """Return why data made for the key `theirs` will not do for this one; None where it
        does."""
        if theirs.ref != self.ref:
            return "its source has changed"
        if theirs.recipe_sha256 != self.recipe_sha256:
            return "the recipe has changed"
        if theirs.seed != self.seed:
            return f"the seed was {theirs.seed}, is {self.seed}"
        if theirs.generator != self.generator:
            was, now = set(theirs.generator.split(", ")), set(self.generator.split(", "))
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
        """Return whether the file has this size and digest; OSError if it cannot be read."""
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


class Rejection(Record):
    """An object that is not in the data, and why: one sentence; `over` is the recipe's limit that
    it exceeded, key and value, else ()."""

    key: Key
    reason: str
    over: tuple[str, float] | tuple[()] = ()

    @property
    def sentence(self) -> str:
        """The object's name, once, and the reason."""
        name = self.key.object_id
        return self.reason if self.reason.startswith(f"{name}:") else f"{name}: {self.reason}"


class Outcome(Record):
    """Outcome of one object.

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
            raise ValueError("the object is listed in another shard")
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
        """Return the outcome of an object whose instances, and only those, are in a shard."""
        entry = ObjectEntry(
            key=key,
            shard=record.name,
            instances=record.instances,
            content_sha256=content_sha256(record.content),
            input_sha256=input_sha256,
            notes=notes,
            seconds=seconds,
        )
        shard = ShardEntry.model_validate(record, from_attributes=True)
        return Outcome(made=entry, shard=shard)

    @property
    def key(self) -> Key:
        entry = self.made or self.rejected or self.skipped or self.failed
        assert entry is not None  # _is_one_of_four has seen to it
        return entry.key
