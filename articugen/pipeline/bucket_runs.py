"""A data set straight into an object store, by any number of processes on any machines.

As a run in a folder, but that nothing is locked or appended to: each object is claimed, made into a
folder of this machine, copied and recorded. Whoever finds all of them made writes the manifest.
"""

import random
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from uuid import uuid4

from articugen.core import processes
from articugen.core.compiling import compile_kernels
from articugen.core.errors import ArticugenError
from articugen.core.place import read_all
from articugen.pipeline.bucket_journal import BucketJournal, ObjectClaims, read_record, record_of
from articugen.pipeline.rank_journal import Share
from articugen.pipeline.ranks import common_plan, names_of
from articugen.pipeline.run import (
    Job,
    ObjectReport,
    Plan,
    Task,
    as_its_source_is,
    common_folder,
    help_make,
    import_stages,
    limit_of,
    make_object,
    manifest_of,
    name_of,
    not_made,
    objects_of,
    plan_for,
    report_of,
    timings_of,
)
from articugen.sources import registry
from articugen.store import croissant
from articugen.store.bucket import Bucket, check_can_be_shared
from articugen.store.manifest import Manifest, Outcome, Timings

POLL_SECONDS = 5.0
"""Between two looks at what others are making."""
MARGIN_SECONDS = 60.0
"""That a claim outlasts the recipe's limit: for copying, and where a worker is tried twice."""


@dataclass(frozen=True)
class BucketRun:
    """A run with a plan, which has made nothing yet; `share` of it, or all."""

    job: Job
    journal: BucketJournal
    plan: Plan
    share: Share | None

    def finish(
        self,
        on_object: Callable[[ObjectReport], None] = lambda _: None,
        on_notice: Callable[[str], None] = lambda _: None,
    ) -> tuple[list[Outcome], Manifest | None]:
        """Make what is missing, or see others make it: what became of each object, and, where it is
        no share, the manifest.

        Raises:
            ArticugenError: another data set is there; no object can be made.
            MachineFault, KeyboardInterrupt: finished objects are kept; the same command goes on.
        """
        if self.plan.conflict:
            raise ArticugenError(self.plan.conflict)
        began = time.perf_counter()
        licence = registry.licence(self.job.source)  # while the source is there
        for outcome in self.plan.done:
            on_object(report_of(outcome, reused=True))
        self.journal.agree()
        made = list[Outcome]()
        for outcome, reused in self._all_made(on_notice):
            made.append(outcome)
            on_object(report_of(outcome, reused=reused))
        outcomes = [*self.plan.done, *made]
        self.journal.check_there(outcomes)
        if self.share is not None:
            return outcomes, None
        instances = sum(o.made.instances for o in made if o.made)
        timings = timings_of(instances, time.perf_counter() - began, self.job.jobs)
        return outcomes, self._concluded(outcomes, timings, licence)

    def _concluded(self, outcomes: Sequence[Outcome], timings: Timings, licence: str) -> Manifest:
        """Write the manifest, unless it says all of it already."""
        bucket = self.journal.bucket
        told = Manifest.in_bucket(bucket) if self.journal.is_told and not self.plan.tasks else None
        if told is not None:
            return told
        manifest = manifest_of(self.job, outcomes, timings, licence)
        bucket.write(croissant.NAME, croissant.of_data_set(manifest))
        for name, data in manifest.files():
            bucket.write(name, data)
        return manifest

    def _all_made(self, on_notice: Callable[[str], None]) -> Iterator[tuple[Outcome, bool]]:
        """What became of each task, and whether another process made it."""
        token, limit = uuid4().hex, limit_of(self.job.recipe)
        lease = limit.seconds + MARGIN_SECONDS
        claims = ObjectClaims(self.journal.bucket, token, lease)
        todo, waiting, told = list(self.plan.tasks), list[Task](), False
        random.Random(token).shuffle(todo)  # so that processes rarely meet
        if todo:
            compile_kernels("generate", jobs=self.job.jobs, notice=on_notice)
        try:
            while todo or waiting:
                for task, outcome in self._made(todo, (token, lease), limit, on_notice):
                    if outcome is None:
                        waiting.append(task)
                    else:
                        yield outcome, False
                if waiting and not told:
                    told = True
                    on_notice(f"other processes are at {len(waiting)} of the objects; waiting")
                time.sleep(POLL_SECONDS if waiting else 0.0)
                found = self._recorded(waiting)
                yield from ((outcome, True) for outcome in found if outcome)
                left = [t for t, outcome in zip(waiting, found, strict=True) if outcome is None]
                todo, waiting = list[Task](), list[Task]()
                for task in left:
                    (todo if claims.is_free(task.shard) else waiting).append(task)
        finally:
            claims.free_all()

    def _made(
        self,
        tasks: Sequence[Task],
        claim: tuple[str, float],
        limit: processes.Limit,
        on_notice: Callable[[str], None],
    ) -> Iterator[tuple[Task, Outcome | None]]:
        """What became of each task; None where another process is at it."""
        bucket = self.journal.bucket
        aside = tempfile.TemporaryDirectory(prefix="articugen-")
        with aside as folder, common_folder(self.job) as common:
            each = processes.each(
                partial(make_into, replace(self.job, out=Path(folder)), claim, common=common),
                tasks,
                workers=self.job.jobs,
                limit=limit,
                ready=import_stages,
                help=common and partial(help_make, self.job, common),
                notice=on_notice,
                name=name_of,
            )
            with closing(each) as ends:
                for ended in ends:
                    task, outcome = tasks[ended.number], ended.value
                    if ended.over or ended.lost:
                        outcome = not_made(task.key, ended, limit)
                        _record(bucket, task, outcome)
                        ObjectClaims(bucket, *claim).free(task.shard)
                    yield task, outcome

    def _recorded(self, tasks: Sequence[Task]) -> list[Outcome | None]:
        """What others have made of these objects by now."""
        bucket = self.journal.bucket
        paths = [record_of(task.shard) for task in tasks]
        texts = list(read_all(bucket, paths))
        found = [
            read_record(text, f"{bucket.url}/{path}") if text is not None else None
            for path, text in zip(paths, texts, strict=True)
        ]
        return [
            outcome if outcome and _will_do(outcome, task) else None
            for task, outcome in zip(tasks, found, strict=True)
        ]


@contextmanager
def started(job: Job, share: Share | None = None, *, command: str = "") -> Iterator[BucketRun]:
    """A run into `job.bucket` that has a plan for its share, or for all, and has made nothing yet.

    Raises:
        MissingExtra: obstore is not installed.
        InvalidArgument: objects cannot be shared out there.
        ArticugenError: other processes make something else there; the store does not answer.
    """
    check_can_be_shared(job.bucket)
    job = as_its_source_is(job)
    bucket = Bucket(job.bucket)
    refs = objects_of(job)
    names = names_of(refs)
    journal = BucketJournal(bucket, common_plan(job, refs, command), names)
    chosen = [place for place in range(len(refs)) if share is None or share.has(place)]
    journal.look_at([names[place] for place in chosen])
    yield BucketRun(job, journal, plan_for(job, journal, [refs[p] for p in chosen]), share)


def make_into(
    job: Job, claim: tuple[str, float], task: Task, common: Path | None = None
) -> Outcome | None:
    """Make one object and copy it into the store; None where another process is at it.

    Args:
        job: with `out`, a folder of this machine for files that are not copied yet.
        claim: the run's name, and the seconds that its claims last.
        task: the object.
        common: as of `make_object`.

    Raises:
        MachineFault, MemoryError, ArticugenError: as `make_object`; the store does not answer.
    """
    bucket = _bucket(job.bucket)
    claims = ObjectClaims(bucket, *claim)
    if not claims.take(task.shard):
        return None
    try:
        text = bucket.read(record_of(task.shard))
        known = read_record(text, task.shard) if text is not None else None
        if known is not None and _will_do(known, task) and _is_there(bucket, known):
            return known  # another process was at it until now
        outcome = task.known or make_object(job, task, common=common)
        if outcome.shard:
            bucket.write(task.shard, job.out / task.shard)
        _record(bucket, task, outcome)
    finally:
        (job.out / task.shard).unlink(missing_ok=True)
        claims.free(task.shard)
    return outcome


@cache
def _bucket(url: str) -> Bucket:
    return Bucket(url)


def _record(bucket: Bucket, task: Task, outcome: Outcome) -> None:
    bucket.write(record_of(task.shard), outcome.model_dump_json().encode())


def _will_do(outcome: Outcome, task: Task) -> bool:
    """Whether it is of the same object, made in the same way."""
    return outcome.fault is None and task.key.difference(outcome.key) is None


def _is_there(bucket: Bucket, outcome: Outcome) -> bool:
    return outcome.shard is None or bucket.size(outcome.shard.name) == outcome.shard.bytes
