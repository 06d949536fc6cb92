"""From a job to a data set: one Run, whoever makes the objects and wherever they go.

What an object becomes depends on its files, the recipe, the seed and the code alone, so neither the
number of workers, nor who they are, nor an interruption can be seen in the data. A run in a folder
has it to itself; processes that share out the objects plan the whole, each makes its share, and
whoever finds all of it recorded writes the manifest: `merge` is a run's end without an executor.
"""

import os
import random
import resource
import sys
import time
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from uuid import uuid4

from articugen.core.errors import ArticugenError, MachineFault
from articugen.core.files import megabytes, room_at
from articugen.core.recipe import Recipe
from articugen.pipeline.common import NEVER_MADE, OF_JOB, CommonPlan, key_of, listing_of, recorded
from articugen.pipeline.executors.work import Executor, Work
from articugen.pipeline.job import Job
from articugen.pipeline.making import Task, limit_of, not_made
from articugen.pipeline.options import ObjectReport, OnNotice, OnObject, ignore
from articugen.pipeline.plan import Plan, name_of_ref, objects_of, plan_for
from articugen.pipeline.records import Records
from articugen.sources.refs import ObjectRef
from articugen.sources.source import Source, open_source
from articugen.store import croissant
from articugen.store.bucket import Remote, check_can_be_shared
from articugen.store.manifest import UNMADE, Manifest, Timings
from articugen.store.outcome import Outcome

_KEPT = "finished objects are kept, the same command goes on after them"

POLL_SECONDS = 5.0
"""Seconds between two looks for what others have made."""
MARGIN_SECONDS = 60.0
"""That a claim outlasts the recipe's limit: for copying, and where a worker is tried twice."""

_NAMED, _NUMBERS = 5, 100
"""Missing objects, and shares, that a sentence names."""


@dataclass(frozen=True)
class Finished:
    """Outcome of a run: that of each of its objects, those that were there already first, and the
    manifest; None for a share."""

    outcomes: Sequence[Outcome]
    manifest: Manifest | None


@contextmanager
def started(job: Job, *, command: str = "") -> Iterator["Run"]:
    """A run that has agreed with whoever is at work in its place, and has made nothing yet;
    `command` makes all of it, as people write it.

    Raises:
        ArticugenError: unknown source or category; the folder is in use or damaged; processes make
            something else here.
        InvalidArgument: nothing can be made there.
    """
    if isinstance(job.out, Remote):
        check_can_be_shared(job.out.url)
    source = open_source(job.source)
    job = replace(job, recipe=job.recipe.for_source(clips_to_limits=source.clips))
    lease = limit_of(job.recipe).seconds + MARGIN_SECONDS
    with Records(job.place, is_shared=job.is_shared, lease=lease) as records:
        source = _as_before(source, records)
        job = replace(job, source=source.name)
        refs = objects_of(job, source)
        about = common_plan(job, refs, command)
        ours = [r for n, r in enumerate(refs) if job.share is None or job.share.has(n)]
        names = list(map(name_of_ref, refs)), list(map(name_of_ref, ours))
        records.expect(about, *names, source.licence)
        yield Run(job, records, plan_for(job, records, ours), len(refs), source.licence)


def _as_before(source: Source, records: Records) -> Source:
    """Return the source as an earlier run here called it, where that is the same folder."""
    before = records.manifest or records.agreed
    earlier = open_source(before.source) if before and os.path.exists(before.source) else source
    is_same = os.path.realpath(earlier.folder) == os.path.realpath(source.folder)
    return earlier if is_same else source


@dataclass(frozen=True)
class Run:
    """A run with a plan, see `started`; `objects` is the number of the whole data set, of which the
    plan may be a share."""

    job: Job
    records: Records
    plan: Plan
    objects: int
    licence: str

    def check_replaces(self, *, replace: bool, cure: str) -> None:
        """Raise ArticugenError where data of another run would be replaced and nobody asked for
        that; `cure` is what to add. Processes that share out objects `finish` refuses anyway."""
        if self.plan.conflict and not (replace or self.job.is_shared):
            raise ArticugenError(f"{self.plan.conflict}, or {cure}")

    def finish(
        self, executor: Executor | None, on_object: OnObject = ignore, on_notice: OnNotice = ignore
    ) -> Finished:
        """Make the data set, or what is missing of it, and write its manifest, which lists a
        `shortfall`, if any; of a share, make what is missing.

        Args:
            executor: who makes it; None where all must be there.
            on_object: called for each object, those that are there already first.
            on_notice: called with one sentence where a worker was lost, or room is short.

        Raises:
            ArticugenError: no object can be made; objects are missing, and what makes them.
            MachineFault: the disk is full, or the like; what was made is kept.
            KeyboardInterrupt: finished objects are kept; the next run goes on after them.
        """
        if self.job.is_shared and self.plan.conflict:
            raise ArticugenError(self.plan.conflict)
        if not self.plan.tasks and self._is_told():
            for outcome in self.plan.done:
                on_object(report_of(outcome, reused=True))
            return Finished(self.plan.done, self.records.manifest)
        if executor is None and self.plan.tasks:
            raise ArticugenError(self._missing())
        if executor and any(task.known is None for task in self.plan.tasks):
            executor.get_ready(self.job, on_notice)  # which is not the data's time
        began = time.perf_counter()
        outcomes, instances = self._make(executor, on_object, on_notice)
        self.records.check_there(outcomes)
        if self.job.share is not None:
            return Finished(outcomes, None)
        width = executor.width(len(self.plan.keys)) if executor else self.job.jobs
        timings = timings_of(instances, time.perf_counter() - began, width)
        manifest = Manifest.of(
            outcomes,
            category=self.job.category,
            source=self.job.source,
            licence=self.licence,
            recipe=self.job.recipe.text(),
            seed=self.job.seed,
            timings=timings,
            shortfall=_shortfall(outcomes, self.job.recipe),
        )
        self.job.place.write(croissant.NAME, croissant.of_data_set(manifest))
        self.records.finish(manifest)
        return Finished(outcomes, manifest)

    def _is_told(self) -> bool:
        """Return whether the manifest that is there says just what this run would write."""
        manifest, shortfall = self.records.manifest, _shortfall(self.plan.done, self.job.recipe)
        is_whole = self.job.share is None and self.records.is_complete(self.plan.keys)
        return is_whole and manifest is not None and manifest.shortfall == shortfall

    def _make(
        self, executor: Executor | None, on_object: OnObject, on_notice: OnNotice
    ) -> tuple[list[Outcome], int]:
        """Make all objects of the plan that are missing; return the outcomes, of those that are
        there first, and how many instances were made."""
        plan, outcomes, instances = self.plan, list(self.plan.done), 0
        for outcome in outcomes:
            on_object(report_of(outcome, reused=True))
        is_here = isinstance(self.job.out, Path)
        if is_here:
            plan.check_room(self.job.folder, on_notice)
        if executor and (plan.tasks or not self.job.is_shared):
            self.records.begin(task.shard for task in plan.tasks)
        try:
            for outcome, reused in self._outcomes(executor, on_notice):
                outcomes.append(outcome)
                instances += outcome.made.instances if outcome.made and not reused else 0
                on_object(report_of(outcome, reused=reused))
        except BaseException as error:
            if executor is None or executor.is_here:  # others may be writing still
                self.records.tidy()
            if isinstance(error, MachineFault):
                left = self._still_needed(len(plan.keys) - len(outcomes)) if is_here else ""
                raise MachineFault(f"{error}{left}; {_KEPT}") from error
            raise
        return outcomes, instances

    def _still_needed(self, objects: int) -> str:
        """Return what `objects` objects take on the disk, where that is more than is free."""
        need = objects * self.plan.bytes / max(len(self.plan.tasks), 1)
        with suppress(OSError):
            if need > (free := room_at(self.job.folder)):
                return f"; the rest takes about {megabytes(need)}, {megabytes(free)} are free"
        return ""

    def _outcomes(
        self, executor: Executor | None, on_notice: OnNotice
    ) -> Iterator[tuple[Outcome, bool]]:
        """Yield the outcome of each task, and whether another process made it. In a store objects
        are claimed one by one, and those of others are waited for."""
        if executor is None or not self.plan.tasks:
            return
        todo, waiting, is_said = list(self.plan.tasks), list[Task](), False
        claims = isinstance(self.job.out, Remote)
        if claims:
            random.Random(uuid4().hex).shuffle(todo)  # so that processes rarely meet
        try:
            while todo or waiting:
                for task, outcome in self._made(todo, executor, on_notice):
                    if outcome is None:
                        waiting.append(task)
                    else:
                        yield outcome, False
                if waiting and not is_said:
                    is_said = True
                    on_notice(f"other processes are at {len(waiting)} of the objects; waiting")
                time.sleep(POLL_SECONDS if waiting else 0.0)
                outcomes = [recorded(self.records.ledger, task.key) for task in waiting]
                yield from ((outcome, True) for outcome in outcomes if outcome)
                left = [t for t, done in zip(waiting, outcomes, strict=True) if done is None]
                todo = [t for t in left if self.records.ledger.is_free(key_of(t.key.name))]
                waiting = [task for task in left if task not in todo]
        finally:
            if claims:
                self.records.ledger.free_all()

    def _made(
        self, tasks: Sequence[Task], executor: Executor, on_notice: OnNotice
    ) -> Iterator[tuple[Task, Outcome | None]]:
        """Yield the outcome of each task, once it is recorded; None where another process works on
        it."""
        records = self.records
        claim = records.ledger.claims if isinstance(self.job.out, Remote) else None
        for task in tasks if claim is None else ():
            if task.known:
                records.record(task.known)
                yield task, task.known
        tasks = [task for task in tasks if not task.known or claim]
        work = Work(self.job, self.objects, handles=records.handles, claim=claim)
        with closing(outcomes_of(work, tasks, executor, on_notice)) as ends:
            for task, outcome, is_recorded in ends:
                if outcome and not is_recorded:
                    records.record(outcome)
                    if claim:
                        records.ledger.free(key_of(task.key.name))
                yield task, outcome

    def _missing(self) -> str:
        """Return which objects are missing, and what makes them."""
        plan, about = self.plan, self.records.agreed
        assert about is not None
        names = [t.key.object_id if t.why == NEVER_MADE else t.why for t in plan.tasks]
        some = ", ".join(names[:_NAMED]) + (", ..." if len(names) > _NAMED else "")
        of = max(about.shares, 1)
        numbers = sorted({task.place % of for task in plan.tasks})
        those = ", ".join(map(str, numbers[:_NUMBERS]))
        those += ", ..." if len(numbers) > _NUMBERS else ""
        return (
            f"{self.job.out}: {len(names)} of {len(plan.keys)} objects are missing ({some}); make "
            f"them with: {about.command} --shard i/{of}, i = {those}; or without --shard"
        )


def outcomes_of(
    work: Work, tasks: Sequence[Task], executor: Executor, on_notice: OnNotice
) -> Generator[tuple[Task, Outcome | None, bool], None, None]:
    """Yield the outcome of each task, as they finish, and whether it is recorded; see
    `Executor.ends`."""
    limit = limit_of(work.job.recipe)
    is_recorded = executor.records or work.claim is not None
    with closing(executor.ends(work, tasks, on_notice)) as ends:
        for ended in ends:
            task = tasks[ended.number]
            if ended.over or ended.lost:
                yield task, not_made(task.key, ended, limit), False
            else:
                yield task, ended.value, is_recorded


def common_plan(job: Job, refs: Sequence[ObjectRef], command: str) -> CommonPlan:
    """Return what all processes that make these objects together are asked for."""
    shares = job.share.of if job.share else int(job.is_shared)
    return CommonPlan(
        **{name: getattr(job, name) for name in OF_JOB},
        recipe=job.recipe.text(),
        objects=len(refs),
        listing=listing_of(map(name_of_ref, refs)),
        generator=refs[0].generator_by(job.recipe.text()) if refs else "",
        command=command or "articugen generate ...",
        shares=shares,
    )


def report_of(outcome: Outcome, *, reused: bool) -> ObjectReport:
    entry, key = outcome.made, outcome.key
    return ObjectReport(
        object_id=key.object_id,
        split=key.split,
        shard=entry.shard if entry else "",
        instances=entry.instances if entry else 0,
        seconds=entry.seconds if entry else 0.0,
        reused=reused,
        **{kind: (unmade := getattr(outcome, kind)) and unmade.reason for kind in UNMADE},
    )


def _shortfall(outcomes: Sequence[Outcome], recipe: Recipe) -> str | None:
    """Return one sentence on why the set is not what its recipe asks for, or None."""
    entries, rejected, skipped, failed = (
        sum(getattr(outcome, kind) is not None for outcome in outcomes)
        for kind in ("made", "rejected", "skipped", "failed")
    )
    wanted, sentences = len(outcomes) - skipped, list[str]()
    if failed:
        sentences.append(
            f"{failed} of {wanted} objects failed through no fault of theirs, and are tried again "
            "by the same command"
        )
    if rejected > recipe.max_rejected_fraction * wanted:
        sentences.append(
            f"{rejected} of {wanted} objects were rejected, more than the recipe's "
            f"max_rejected_fraction of {recipe.max_rejected_fraction:g} (--max-rejected) allows"
        )
    if not sentences and not entries:
        sentences.append(f"no object is left: {skipped} skipped, {rejected} rejected")
    return "; ".join(sentences) or None


def timings_of(instances: int, seconds: float, jobs: int) -> Timings:
    """Return the timings of a run by this process and its workers, which ends now."""
    unit = 1 if sys.platform == "darwin" else 1024
    processes = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    peak = max(resource.getrusage(who).ru_maxrss for who in processes)
    return Timings(
        seconds=seconds,
        instances_per_second=instances / seconds if seconds > 0 else 0.0,
        peak_memory_bytes=peak * unit,
        workers=max(1, jobs),
    )
