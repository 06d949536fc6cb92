"""What a data set in an object store holds, and who is at which object: no locks, no appending.

Beside the shards lie, under `.articugen/`, what all processes make together (`plan.json`), one
record for each finished object, written after its shard, and one claim for each object that a
process is at. A claim is a file that was not there before: stores see to it that only one process
writes it. That of a killed process runs out, by the store's clock.
"""

import time
from collections.abc import Mapping, Sequence
from uuid import uuid4

from pydantic import ValidationError

from articugen.core.errors import ArticugenError, CorruptShard
from articugen.core.place import read_all
from articugen.pipeline.journal import why_again
from articugen.pipeline.rank_journal import CommonPlan, Name, shard_names
from articugen.store.bucket import Bucket
from articugen.store.manifest import Key, Manifest, Outcome

_OURS = ".articugen"
_PLAN = f"{_OURS}/plan.json"
_RECORDS = f"{_OURS}/done"
_CLAIMS = f"{_OURS}/claims"


class BucketJournal:
    """What is known of objects that were made before: `Journal` says what each method means."""

    def __init__(self, bucket: Bucket, plan: CommonPlan, names: Sequence[Name]) -> None:
        """
        Args:
            bucket: the data set's folder.
            plan: of all processes.
            names: of all objects, in the order of the plan.

        Raises:
            ArticugenError: other processes make something else here.
            MachineFault: the store does not answer.
            CorruptShard: the manifest or a record is damaged.
        """
        self.bucket, self._plan = bucket, plan
        self._shards = shard_names(names)
        self._check_plan()
        manifest = Manifest.in_bucket(bucket)
        self._outcomes: dict[Name, Outcome] = {}
        for outcome in manifest.outcomes if manifest else ():
            self._outcomes[outcome.key.split, outcome.key.object_id] = outcome
        self._files = bucket.list("")
        self.is_told = manifest is not None

    def look_at(self, names: Sequence[Name]) -> None:
        """Read the records of some objects, where the manifest does not tell of them."""
        recorded = [
            (name, path)
            for name in names
            if (path := record_of(self._shards[name])) in self._files and not self._is_known(name)
        ]
        texts = list(read_all(self.bucket, [path for _, path in recorded]))
        for (name, path), text in zip(recorded, texts, strict=True):
            if text is not None:
                self._outcomes[name] = read_record(text, f"{self.bucket.url}/{path}")
                self.is_told = False

    def agree(self) -> None:
        """Write down what all processes make, or see that it is what the first has written."""
        if not self.bucket.write_new(_PLAN, self._plan.model_dump_json().encode()):
            self._check_plan()

    def why(self, key: Key) -> str | None:
        return why_again(key, self._outcomes.get((key.split, key.object_id)), self._is_whole)

    def finished(self, key: Key) -> Outcome | None:
        return None if self.why(key) else self._outcomes[key.split, key.object_id]

    def shard_names(self, keys: Sequence[Key]) -> dict[Key, str]:
        return {key: self._shards[key.split, key.object_id] for key in keys}

    def conflict(self, keys: Sequence[Key]) -> str | None:
        """One sentence, where the folder holds what would have to be replaced."""
        for key in keys:
            outcome = self._outcomes.get((key.split, key.object_id))
            why = key.difference(outcome.key) if outcome and outcome.shard else None
            if why:
                return (
                    f"{self.bucket.url}: holds another data set ({key.object_id}, for one: {why}), "
                    "and nothing in a store is replaced; choose another --out"
                )
        return None

    def check_there(self, outcomes: Sequence[Outcome]) -> None:
        """See to it that the shards of these outcomes are there still.

        Raises:
            ArticugenError: some were removed or replaced meanwhile.
        """
        self._files = self.bucket.list("")
        gone = [o.shard.name for o in outcomes if o.shard and not self._is_whole(o)]
        if gone:
            raise ArticugenError(
                f"{self.bucket.url}: {len(gone)} shards were removed or replaced during the run "
                f"({gone[0]}, for one); see who writes there, and run the same command again"
            )

    def _is_known(self, name: Name) -> bool:
        outcome = self._outcomes.get(name)
        return outcome is not None and outcome.fault is None

    def _is_whole(self, outcome: Outcome) -> bool:
        """Whether a shard of that size is there: the store keeps what it was given."""
        shard = outcome.shard
        there = self._files.get(shard.name) if shard else None
        return bool(shard and there and there.bytes == shard.bytes)

    def _check_plan(self) -> None:
        text = self.bucket.read(_PLAN)
        if text is None:
            return
        try:
            theirs = CommonPlan.model_validate_json(text)
        except ValidationError:
            raise CorruptShard(f"{self.bucket.url}/{_PLAN}: damaged; delete it") from None
        self._plan.check_like(theirs, self.bucket.url)


def record_of(shard: str) -> str:
    """Where the record of the object lies whose shard is called so."""
    return f"{_RECORDS}/{shard}.json"


def read_record(text: bytes, path: str) -> Outcome:
    """
    Raises:
        CorruptShard: it is damaged.
    """
    try:
        return Outcome.model_validate_json(text)
    except ValidationError:
        raise CorruptShard(f"{path}: damaged; delete it, its object is made again then") from None


class ObjectClaims:
    """Which objects the processes of a run are at, and which those of others."""

    def __init__(self, bucket: Bucket, run: str, seconds: float) -> None:
        """
        Args:
            bucket: the data set's folder.
            run: a name unlike any other run's; its processes may take each other's claims.
            seconds: after which a claim has run out: nobody is at an object for so long.
        """
        self._bucket, self._run, self._seconds = bucket, run.encode(), seconds
        self._ahead: float | None = None

    def take(self, shard: str) -> bool:
        """Claim an object; whether it is ours now."""
        folder = _claims_of(shard)
        if self._bucket.write_new(f"{folder}/0", self._run):
            return True
        written = self._written(shard)
        if written and self._age(written[max(written)]) < self._seconds:
            return False
        return self._bucket.write_new(f"{folder}/{max(written, default=-1) + 1}", self._run)

    def is_free(self, shard: str) -> bool:
        """Whether nobody is at an object."""
        written = self._written(shard)
        return not written or self._age(written[max(written)]) >= self._seconds

    def free(self, shard: str) -> None:
        """Give up one's claim of an object, after its record was written."""
        self._bucket.delete(f"{_claims_of(shard)}/{n}" for n in self._written(shard))

    def free_all(self) -> None:
        """Give up whatever processes of this run still claim: they are no more."""
        names = [f"{_CLAIMS}/{name}" for name in self._bucket.list(_CLAIMS)]
        texts = list(read_all(self._bucket, names))
        self._bucket.delete(n for n, text in zip(names, texts, strict=True) if text == self._run)

    def _written(self, shard: str) -> Mapping[int, float]:
        """When each claim of an object was written; a later one has taken over an earlier."""
        listed = self._bucket.list(_claims_of(shard))
        return {int(name): about.written for name, about in listed.items() if name.isdecimal()}

    def _age(self, written: float) -> float:
        """Seconds, by the store's clock, which is read once."""
        if self._ahead is None:
            name = f"{_OURS}/clocks/{uuid4().hex}"
            self._bucket.write(name, b"")
            now = self._bucket.list(f"{_OURS}/clocks")[name.rpartition("/")[2]].written
            self._bucket.delete([name])
            self._ahead = now - time.time()
        return time.time() + self._ahead - written


def _claims_of(shard: str) -> str:
    return f"{_CLAIMS}/{shard}"
