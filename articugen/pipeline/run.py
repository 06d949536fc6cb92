"""From a job to a data set: one object a task, one shard an object, any number of workers.

What an object becomes depends on its files, the recipe, the seed and the code alone, so neither the
number of workers nor an interruption can be seen in the data. `instance.py` tells how one is made.
"""

import hashlib
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from articugen.core import processes
from articugen.core.compiling import compile_kernels
from articugen.core.content import VERSION
from articugen.core.errors import (
    ArticugenError,
    InvalidRecipe,
    InvalidSource,
    MachineFault,
    NotOfCategory,
    RejectedInstance,
    machine_fault,
    printable,
)
from articugen.core.files import megabytes, room_at, write_atomically
from articugen.core.memory import give_back
from articugen.core.recipe import Recipe, check_category
from articugen.core.schema import Instance
from articugen.instance.again import generator_of
from articugen.pipeline import sharing
from articugen.pipeline.estimate import instance_bytes, run_seconds
from articugen.pipeline.executors import dask
from articugen.pipeline.journal import Journal
from articugen.sources import registry
from articugen.sources.refs import ObjectRef
from articugen.store import croissant
from articugen.store.manifest import (
    MOST_OBJECTS,
    Key,
    Manifest,
    Outcome,
    Rejection,
    Timings,
    code_version,
)
from articugen.store.writer import Check, write_shard

if TYPE_CHECKING:
    from articugen.instance.make import Prepared

SECONDS_FOR_ANY_OBJECT = 600.0
SECONDS_FOR_ANY_INSTANCE = 5.0
"""What an object may take where its recipe says nothing of it: a hundred times what most do."""

_KEPT = "finished objects are kept, the same command goes on after them"

_FEWEST_SHARED = 8
"""Instances of an object that others may help with: fewer are made before they are ready."""

_HOPELESS = 4
"""A run that is estimated to need so many times what is free is not begun."""

_DEPTH_MAPS = 8 << 20
"""Bytes: what is as large as they are goes back to the system once it is freed."""


@dataclass(frozen=True)
class Job:
    """A data set to make: `recipe.objects` objects of `category` from `source` into `out`.

    `ids`, `exclude` and `joints` choose among the objects and change nothing of those that are
    made.
    `jobs` worker processes make it. With 0 this process does, without the recipe's limits of time
    and memory: for debugging. With a `scheduler`, the address of a Dask cluster's, its workers do,
    all of which must see `out`. With a `bucket`, the data set goes to that folder of an object
    store, s3://bucket/prefix, and `out` means nothing: see `bucket_runs`.
    """

    source: str
    category: str
    recipe: Recipe
    seed: int
    out: Path
    jobs: int
    ids: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()
    scheduler: str = ""
    bucket: str = ""

    def __post_init__(self) -> None:
        """
        Raises:
            InvalidRecipe: what no folder, shard or manifest can be called or hold.
        """
        check_category(self.category)
        if not -(2**63) <= self.seed < 2**63:
            raise InvalidRecipe(f"the seed is {self.seed}; choose one of at most 18 digits")
        if printable(self.source) != self.source:
            raise InvalidRecipe(f"{printable(self.source)}: rename it to plain text")


@dataclass(frozen=True)
class ObjectReport:
    """What became of one object.

    Attributes:
        shard: its file, "" where there is none.
        instances: 0 where there is no shard.
        seconds: of one worker.
        rejected, skipped, failed: why there is none, or None: see `Outcome`.
        reused: whether it was there already.
    """

    object_id: str
    split: str
    shard: str
    instances: int
    seconds: float
    rejected: str | None
    reused: bool
    skipped: str | None = None
    failed: str | None = None


@dataclass(frozen=True)
class Task:
    """An object to make: why, and as which shard; or what is known of it without making it."""

    ref: ObjectRef
    key: Key
    shard: str
    why: str
    known: Outcome | None = None


@dataclass(frozen=True)
class Plan:
    """What a run would do.

    Attributes:
        keys: of all objects.
        tasks: the objects it would make.
        done: what the folder has already.
        instances, bytes, seconds: of the tasks; the latter two are estimates.
        conflict: one sentence where data of another run would be replaced.
    """

    keys: tuple[Key, ...]
    tasks: tuple[Task, ...]
    done: tuple[Outcome, ...]
    instances: int
    bytes: int
    seconds: float
    conflict: str | None

    def check_room(self, out: Path, on_notice: Callable[[str], None]) -> None:
        """Compare what it needs with what is free where it goes; shards that are there already are
        replaced. Nobody's estimate is so wrong as to be `_HOPELESS` times too high.

        Raises:
            MachineFault: it needs far more.
        """
        need = self.bytes
        with suppress(OSError):
            free = room_at(out)
            shards = (out / task.shard for task in self.tasks)
            need -= sum(shard.stat().st_size for shard in shards if shard.is_file())
            if need <= free:
                return
            said = (
                f"{out}: this takes about {megabytes(need)} on the disk, {megabytes(free)} are "
                "free; free some space, choose another folder, or ask for fewer objects or states"
            )
            if need > _HOPELESS * free:
                raise MachineFault(said)
            on_notice(said)


@contextmanager
def started(job: Job) -> Iterator["Run"]:
    """A run that has its folder to itself and a plan, and has made nothing yet.

    Raises:
        ArticugenError: unknown source or category; the folder is in use or damaged.
    """
    job = as_its_source_is(job)
    with Journal(job.out) as journal:
        yield Run(job, journal, plan_for(job, journal, objects_of(job)))


def as_its_source_is(job: Job) -> Job:
    """The job with what its source says of all its models in the recipe."""
    clips = registry.clips_to_limits(job.source)
    return replace(job, recipe=job.recipe.for_source(clips_to_limits=clips))


def objects_of(job: Job) -> tuple[ObjectRef, ...]:
    """All objects of the data set, in the order that gives shards their names.

    Raises:
        InvalidSource: unknown source, category or object.
        InvalidRecipe: they are more than a manifest can tell of.
    """
    crew = processes.Crew(
        partial(_is_of_category, job.recipe),
        workers=min(job.jobs, 1),
        limit=limit_of(job.recipe),
        ready=_import_readers,
        name=lambda ref: plain_name(ref.object_id),
    )
    with crew:  # files of others are read where they can do no harm
        refs = registry.object_refs(
            job.source, job.category, objects=job.recipe.objects, ids=job.ids, exclude=job.exclude,
            joints=job.joints,
            counts=lambda ref: all(ended.value is not False for ended in crew.each([ref])),
        )  # fmt: skip
    if len(refs) > MOST_OBJECTS:
        raise InvalidRecipe(
            f"{len(refs):,} objects of {job.category}: a data set has at most {MOST_OBJECTS:,}, so "
            "that it can be opened; give --objects, or make several data sets of other --ids"
        )
    return refs


def _is_of_category(recipe: Recipe, ref: ObjectRef) -> bool:
    """Whether something of an object moves in the recipe's sense; no mesh is read. One that cannot
    be read counts: its turn comes to be refused, with the reason."""
    from articugen.instance.resolving import resolved  # noqa: PLC0415 - slow to import
    from articugen.meshes.read import unread  # noqa: PLC0415

    try:
        with unread():
            resolved(ref, recipe)
    except NotOfCategory:
        return False
    except Exception as error:
        _verdict(error, ref, recipe)  # raises what says nothing of the object
    return True


@dataclass(frozen=True)
class Run:
    """A run in its folder; see `started`. `check` looks at each shard before it gets its name."""

    job: Job
    journal: Journal
    plan: Plan
    check: Check | None = None

    def finish(
        self,
        on_object: Callable[[ObjectReport], None],
        on_notice: Callable[[str], None] = lambda _: None,
    ) -> Manifest:
        """Make the data set, or what is missing of it, and write its manifest, which tells of a
        `shortfall`, if any.

        Args:
            on_object: called for each object, those that are there already first.
            on_notice: called with one sentence where a worker was lost, or room is short.

        Raises:
            ArticugenError: no object can be made.
            MachineFault: the disk is full, or the like; what was made is kept.
            KeyboardInterrupt: finished objects are kept; the next run goes on after them.
        """
        if not self.plan.tasks and self.journal.is_complete(self.plan.keys):
            manifest = Manifest.read(self.job.out)
            if manifest.shortfall == _shortfall(self.plan.done, self.job.recipe):
                for outcome in self.plan.done:
                    on_object(report_of(outcome, reused=True))
                return manifest
        licence = registry.licence(self.job.source)  # while the source is there
        self.compile(on_notice)  # which is not the data's time
        began = time.perf_counter()
        outcomes = self.make(on_object, on_notice)
        made = [outcome.made for outcome in outcomes[len(self.plan.done) :] if outcome.made]
        instances = sum(entry.instances for entry in made)
        width = dask.threads(self.job.scheduler) if self.job.scheduler else self.job.jobs
        timings = timings_of(instances, time.perf_counter() - began, width)
        return conclude(self.job, self.journal, outcomes, timings, licence)

    def make(
        self, on_object: Callable[[ObjectReport], None], on_notice: Callable[[str], None]
    ) -> list[Outcome]:
        """What became of all objects of the plan: of those that are there, then of the others,
        which are made and recorded."""
        outcomes = list(self.plan.done)
        for outcome in outcomes:
            on_object(report_of(outcome, reused=True))
        self.plan.check_room(self.job.out, on_notice)
        self.journal.claim(task.shard for task in self.plan.tasks)
        try:
            with closing(self.made(on_notice)) as made:
                for outcome in made:
                    self.journal.record(outcome)
                    outcomes.append(outcome)
                    on_object(report_of(outcome, reused=False))
        except BaseException as error:
            if not self.job.scheduler:  # whose workers may be writing still
                self.journal.tidy()
            if isinstance(error, MachineFault):
                left = len(self.plan.keys) - len(outcomes)
                raise MachineFault(f"{error}{self._still_needed(left)}; {_KEPT}") from error
            raise
        return outcomes

    def _still_needed(self, objects: int) -> str:
        """What so many objects take on the disk, where that is more than is free."""
        need = objects * self.plan.bytes / max(len(self.plan.tasks), 1)
        with suppress(OSError):
            if need > (free := room_at(self.job.out)):
                return f"; the rest takes about {megabytes(need)}, {megabytes(free)} are free"
        return ""

    def made(self, on_notice: Callable[[str], None]) -> Generator[Outcome, None, None]:
        """The outcome of each task, as they finish."""
        yield from (task.known for task in self.plan.tasks if task.known)
        tasks = [task for task in self.plan.tasks if not task.known]
        self.compile(on_notice)
        limit = limit_of(self.job.recipe)
        with closing(self._ends(tasks, limit, on_notice)) as made:
            for ended in made:
                yield ended.value or not_made(tasks[ended.number].key, ended, limit)

    def compile(self, on_notice: Callable[[str], None]) -> None:
        """The kernels, unless they are already, or nothing is made here."""
        if not self.job.scheduler and any(task.known is None for task in self.plan.tasks):
            compile_kernels("generate", jobs=self.job.jobs, notice=on_notice)

    def _ends(
        self, tasks: Sequence[Task], limit: processes.Limit, on_notice: Callable[[str], None]
    ) -> Generator[processes.Ended[Outcome], None, None]:
        """How each task ends, in processes of this machine or of a cluster."""
        if self.job.scheduler:
            job = replace(self.job, out=self.job.out.resolve())
            duty = dask.Duty(
                partial(make_object, job, check=self.check),
                limit,
                import_stages,
                name_of,
                code_version(),
                self.journal.path.resolve(),
            )
            return dask.each(duty, tasks, address=self.job.scheduler, notice=on_notice)
        return self._ends_here(tasks, limit, on_notice)

    def _ends_here(
        self, tasks: Sequence[Task], limit: processes.Limit, on_notice: Callable[[str], None]
    ) -> Generator[processes.Ended[Outcome], None, None]:
        with common_folder(self.job) as common:
            each = processes.each(
                partial(make_object, self.job, check=self.check, common=common),
                tasks,
                workers=self.job.jobs,
                limit=limit,
                ready=import_stages,
                help=common and partial(help_make, self.job, common),
                handles=self.journal.handles,
                notice=on_notice,
                name=name_of,
            )
            with closing(each):
                yield from each


@contextmanager
def common_folder(job: Job) -> Iterator[Path | None]:
    """Where workers that have no object left help others with theirs; None if they do not."""
    if job.jobs < 2 or _instances_each(job.recipe) < _FEWEST_SHARED:
        yield None
        return
    with ExitStack() as stack:
        folder = None
        with suppress(OSError):  # no room, no right: everyone works alone
            temporary = tempfile.TemporaryDirectory(prefix="articugen-", ignore_cleanup_errors=True)
            folder = Path(stack.enter_context(temporary))
        yield folder


def name_of(task: Task) -> str:
    return task.key.object_id


def conclude(
    job: Job, journal: Journal, outcomes: Sequence[Outcome], timings: Timings, licence: str
) -> Manifest:
    """Write the manifest, and what lies beside it, of a data set of which these are all objects."""
    manifest = manifest_of(job, outcomes, timings, licence)
    write_atomically(job.out / croissant.NAME, croissant.of_data_set(manifest))
    journal.finish(manifest)
    return manifest


def manifest_of(job: Job, outcomes: Sequence[Outcome], timings: Timings, licence: str) -> Manifest:
    """Of a data set of which these are all objects."""
    return Manifest.of(
        outcomes,
        category=job.category,
        source=job.source,
        licence=licence,
        recipe=job.recipe.text(),
        seed=job.seed,
        timings=timings,
        shortfall=_shortfall(outcomes, job.recipe),
    )


def make_object(
    job: Job, task: Task, check: Check | None = None, common: Path | None = None
) -> Outcome:
    """Make one object and write its shard; a fault of the object becomes its rejection, and so does
    what `check` raises of the shard. Other workers may help in the folder `common`, if any.

    Raises:
        MachineFault, MemoryError: it says nothing about the object.
        ArticugenError: no object can be made, for want of a library say.
    """
    started = time.perf_counter()
    give_back(_DEPTH_MAPS)
    elsewhere = 0.0

    def here(made: _Made) -> Instance:
        nonlocal elsewhere
        elsewhere += made.seconds if made.process != os.getpid() else 0.0
        return made.instance

    try:
        with sharing.owned(common and common / task.shard) as owner:
            prepared = _prepared(job, task)
            obj = prepared.obj
            if _is_other(task, obj.sha256):
                return _changed(task)
            made = owner.in_order(len(prepared.states), partial(_made, prepared))
            attributes = _attributes(job, task)
            record = write_shard(job.out / task.shard, map(here, made), attributes, check)
    except Exception as error:  # an object must not take the others down with it
        verdict = _verdict(error, task.ref, job.recipe)
        if verdict is None:
            return Outcome(failed=Rejection.of_fault(task.key, error))
        if _is_other(task, _source_digest(job.recipe, task.ref)):
            return _changed(task)
        unmade = _unmade(task.key, verdict)
        is_skipped = isinstance(verdict, NotOfCategory)
        return Outcome(skipped=unmade) if is_skipped else Outcome(rejected=unmade)
    return Outcome.of_shard(
        task.key,
        record,
        input_sha256=obj.sha256,
        notes=obj.notes,
        seconds=time.perf_counter() - started + elsewhere,
    )


def help_make(job: Job, common: Path, task: Task) -> int:
    """Make instances of an object that another worker makes, until none is left; how many."""
    give_back(_DEPTH_MAPS)
    prepared = _prepared(job, task)
    if _is_other(task, prepared.obj.sha256):
        return 0
    count = len(prepared.states)
    return sharing.help_with(common / task.shard, count, partial(_made, prepared))


def _is_other(task: Task, digest: str) -> bool:
    """Whether an object's files are no longer those that the run was planned with."""
    return digest != task.key.ref and not _is_made_here(task.ref)


def _is_made_here(ref: ObjectRef) -> bool:
    """Whether our code makes the object; of a folder that is gone that is not so."""
    with suppress(InvalidSource):
        return registry.is_procedural(ref.source)
    return False


def _changed(task: Task) -> Outcome:
    """Of an object whose files are others now, or gone, as with a disk: that is no fault of it."""
    reason = "its files changed, or are gone, since the run began; run it again once they are there"
    return Outcome(failed=Rejection(key=task.key, reason=reason))


class _OverLimit(RejectedInstance):
    """An object takes more than the recipe allows: `over` is the recipe's key and value."""

    def __init__(self, takes: str, key: str, value: float) -> None:
        super().__init__(f"it {takes}; raise the recipe's {key} ({value:,g}) if it may")
        self.over = (key, value)


def _unmade(key: Key, error: Exception) -> Rejection:
    over = error.over if isinstance(error, _OverLimit) else ()
    return Rejection(key=key, reason=printable(str(error)), over=over)


def _verdict(error: Exception, ref: ObjectRef, recipe: Recipe) -> Exception | None:
    """What `error` says of the object; None where it is a fault of our code.

    Raises:
        Exception: it says nothing of the object, and ends the run or has the object tried again.
    """
    fault = machine_fault(error)
    asked = getattr(fault, "_total_size", 0) / 1e6  # of numpy's own MemoryError
    if asked > recipe.memory_per_object_mb:
        takes = f"asks for {asked:,.0f} MB of memory at once"
        return _OverLimit(takes, "memory_per_object_mb", recipe.memory_per_object_mb)
    if fault is not None:
        raise fault
    if isinstance(error, InvalidSource | RejectedInstance | NotOfCategory):
        return error
    if isinstance(error, ArticugenError):
        raise error
    if isinstance(error, OSError) and _is_made_here(ref):
        raise MachineFault(printable(f"{ref.object_id}: {error}; see to it")) from error
    if isinstance(error, OSError) and error.errno is not None:
        return error
    return None


@dataclass(frozen=True)
class _Made:
    """An instance, which process made it and in how many seconds."""

    instance: Instance
    process: int
    seconds: float


def _made(prepared: "Prepared", index: int) -> _Made:
    from articugen.instance.make import make_instance  # noqa: PLC0415

    began = time.perf_counter()
    instance = make_instance(prepared, index)
    return _Made(instance, os.getpid(), time.perf_counter() - began)


def _prepared(job: Job, task: Task) -> "Prepared":
    # numba and the mesh readers take a second to import: the command line should not wait for them
    from articugen.instance.make import prepare  # noqa: PLC0415
    from articugen.instance.resolving import resolved  # noqa: PLC0415

    return prepare(resolved(task.ref, job.recipe), job.recipe, job.seed)


def import_stages() -> None:
    """What takes a worker seconds once, and is no object's fault; before its clock starts."""
    import articugen.instance.articulation  # noqa: PLC0415
    import articugen.instance.make  # noqa: PLC0415, F401


def _import_readers() -> None:
    """The same, for planning alone."""
    import articugen.sources.urdf  # noqa: PLC0415, F401


def not_made(key: Key, ended: processes.Ended, limit: processes.Limit) -> Outcome:
    """The outcome of an object whose worker was killed, by us or by others."""
    over = {
        "seconds": _OverLimit("takes too many seconds", "seconds_per_object", limit.seconds),
        "megabytes": _OverLimit("takes too many MB", "memory_per_object_mb", limit.megabytes),
    }
    if ended.over:
        return Outcome(rejected=_unmade(key, over[ended.over]))
    reason = (
        f"its worker {ended.lost} when it was tried alone as well; use fewer --jobs, or end other "
        "programs, and run it again; if it stays so, report it, and leave it out with --exclude"
    )
    return Outcome(failed=Rejection(key=key, reason=reason))


def limit_of(recipe: Recipe) -> processes.Limit:
    seconds = recipe.seconds_per_object
    if seconds is None:
        seconds = SECONDS_FOR_ANY_OBJECT + SECONDS_FOR_ANY_INSTANCE * _instances_each(recipe)
    return processes.Limit(seconds, recipe.memory_per_object_mb)


def _instances_each(recipe: Recipe) -> int:
    return recipe.articulation.states + 1


class Holdings(Protocol):
    """What is known of objects that were made before; `Journal` says what each means."""

    def why(self, key: Key) -> str | None: ...
    def finished(self, key: Key) -> Outcome | None: ...
    def conflict(self, keys: Sequence[Key]) -> str | None: ...
    def shard_names(self, keys: Sequence[Key]) -> dict[Key, str]: ...


def plan_for(job: Job, journal: Holdings, refs: Sequence[ObjectRef]) -> Plan:
    """What is to be done for these objects of a job, by what its folder holds already."""
    limit = limit_of(job.recipe)
    keys, known = [], dict[Key, Outcome]()
    generator = generator_of(refs[0], job.recipe.text()) if refs else ""
    for ref, read in zip(refs, _read(job, refs, limit), strict=True):
        key = _key(job, ref, read.value or "unreadable", generator)
        keys.append(key)
        if key.object_id != ref.object_id:
            reason = f"{printable(str(ref.location))}: its name is no plain text; rename it"
            known[key] = Outcome(rejected=Rejection(key=key, reason=reason))
        elif read.value is None:
            known[key] = not_made(key, read, limit)
    names = journal.shard_names(keys)
    done, tasks = [], []
    for ref, key in zip(refs, keys, strict=True):
        outcome = journal.finished(key)
        if outcome is not None and not _may_do_with_more(outcome, limit):
            done.append(outcome)
        else:
            why = journal.why(key) or "the recipe now allows it more"
            tasks.append(Task(ref, key, names[key], why, known.get(key)))
    instances = len(tasks) * _instances_each(job.recipe)
    entries = [outcome.made for outcome in done if outcome.made]
    return Plan(
        keys=tuple(keys),
        tasks=tuple(tasks),
        done=tuple(done),
        instances=instances,
        bytes=instances * instance_bytes(job.recipe, [o.shard for o in done if o.shard]),
        seconds=run_seconds(job.recipe, len(tasks), job.jobs, entries),
        conflict=journal.conflict(keys),
    )


def _may_do_with_more(outcome: Outcome, limit: processes.Limit) -> bool:
    """Whether the object was rejected by a limit that is lower than this one."""
    name, value = (outcome.rejected and outcome.rejected.over) or ("", 0.0)
    most = {"seconds_per_object": limit.seconds, "memory_per_object_mb": limit.megabytes}
    return value < most.get(name, 0.0)


def _key(job: Job, ref: ObjectRef, read_from: str, generator: str) -> Key:
    return Key(
        split=ref.split,
        object_id=plain_name(ref.object_id),
        ref=read_from,
        recipe_sha256=job.recipe.for_one_object().sha256(),
        seed=job.seed,
        generator=generator,
    )


def plain_name(object_id: str) -> str:
    """The name that stands for an object whose own no file could hold, unlike any other's."""
    plain = printable(object_id)
    if plain == object_id:
        return plain
    return f"{plain[:100]}~{hashlib.sha256(os.fsencode(object_id)).hexdigest()[:8]}"


def _read(
    job: Job, refs: Sequence[ObjectRef], limit: processes.Limit
) -> Sequence[processes.Ended[str]]:
    """What each object is read from. A procedural one is what our code makes of its name; the files
    of others are digested by workers, which make nothing of their meshes."""
    if registry.is_procedural(job.source):
        return [processes.Ended(i, f"{r.source}/{r.object_id}") for i, r in enumerate(refs)]
    read = processes.each(
        partial(_source_digest, job.recipe),
        refs,
        workers=job.jobs,
        limit=limit,
        ready=_import_readers,
        name=lambda ref: plain_name(ref.object_id),
    )
    return sorted(read, key=lambda ended: ended.number)


def _source_digest(recipe: Recipe, ref: ObjectRef) -> str:
    """Of an object's files; where they cannot be read, why: making it will tell the same.

    Raises:
        MachineFault, MemoryError: it says nothing about the object.
    """
    try:
        return registry.digest(ref)
    except Exception as error:  # an object must not take the others down with it
        verdict = _verdict(error, ref, recipe) or f"{type(error).__name__}: {error}"
        return printable(f"unreadable: {verdict}")


def _attributes(job: Job, task: Task) -> dict[str, str | int]:
    recipe, ref = job.recipe.for_one_object(), task.ref
    return {
        "category": job.category,
        "split": ref.split,
        "source": ref.source,
        "licence": registry.licence(ref.source),
        "recipe": recipe.text(),
        "recipe_sha256": recipe.sha256(),
        "seed": job.seed,
        "articugen_version": VERSION,
        "generator": task.key.generator,
    }


def report_of(outcome: Outcome, *, reused: bool) -> ObjectReport:
    made, key = outcome.made, outcome.key
    return ObjectReport(
        object_id=key.object_id,
        split=key.split,
        shard=made.shard if made else "",
        instances=made.instances if made else 0,
        seconds=made.seconds if made else 0.0,
        rejected=outcome.rejected.reason if outcome.rejected else None,
        reused=reused,
        skipped=outcome.skipped.reason if outcome.skipped else None,
        failed=outcome.failed.reason if outcome.failed else None,
    )


def _shortfall(outcomes: Sequence[Outcome], recipe: Recipe) -> str | None:
    """One sentence on why the set is not what its recipe asks for, or None."""
    made, rejected, skipped, failed = (
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
    if not sentences and not made:
        sentences.append(f"no object is left: {skipped} skipped, {rejected} rejected")
    return "; ".join(sentences) or None


def timings_of(instances: int, seconds: float, jobs: int) -> Timings:
    """Of a run by this process and its workers, which ends now."""
    unit = 1 if sys.platform == "darwin" else 1024
    peak = max(
        resource.getrusage(who).ru_maxrss
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return Timings(
        seconds=seconds,
        instances_per_second=instances / seconds if seconds > 0 else 0.0,
        peak_memory_bytes=peak * unit,
        workers=max(1, jobs),
    )


def default_jobs() -> int:
    """The cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
