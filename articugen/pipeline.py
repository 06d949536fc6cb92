"""From a job to a data set: one object a task, one shard an object, any number of workers.

What an object becomes depends on its files, the recipe, the seed and the code alone, so neither the
number of workers nor an interruption can be seen in the data. `instance.py` tells how one is made.
"""

import ctypes
import hashlib
import multiprocessing
import os
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from articugen import __version__
from articugen.errors import ArticugenError, InvalidSource, RejectedInstance
from articugen.journal import Journal
from articugen.manifest import Key, Manifest, Outcome, Rejection, Timings
from articugen.recipe import Recipe, Sampling
from articugen.records import ArticulatedObject, Instance
from articugen.shards import write_shard
from articugen.sources import registry
from articugen.sources.registry import ObjectRef

SECONDS_PER_INSTANCE = 0.06
SECONDS_PER_OBJECT = 1.0
"""Rough figures of one core, for `plan`; a run's own rate shows in its progress bar."""

_M_MMAP_THRESHOLD = -3  # of malloc.h
_LARGE_BLOCK = 8 << 20

GENERATING_CODE = (
    "articulation.py",
    "fusion.py",
    "fusion_kernels.py",
    "geometry.py",
    "hierarchy.py",
    "instance.py",
    "portable.py",
    "reachable.py",
    "recipe.py",
    "recipe_files.py",
    "records.py",
    "rendering",
    "sampling.py",
    "schema.py",
    "seeding.py",
    "sheets.py",
    "slender.py",
    "sources",
)


@dataclass(frozen=True)
class Job:
    """A data set to make: `recipe.objects` objects of `category` from `source` into `out`."""

    source: str
    category: str
    recipe: Recipe
    seed: int
    out: Path
    jobs: int


@dataclass(frozen=True)
class ObjectReport:
    """What became of one object.

    Attributes:
        shard: its file, "" where it was rejected.
        instances: 0 where it was rejected.
        seconds: of one worker.
        rejected: why, or None.
        reused: whether it was there already.
    """

    object_id: str
    split: str
    shard: str
    instances: int
    seconds: float
    rejected: str | None
    reused: bool


@dataclass(frozen=True)
class Task:
    """An object to make: why, and as which shard."""

    ref: ObjectRef
    key: Key
    shard: str
    why: str


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


def plan(job: Job) -> Plan:
    """What `generate` would do, and why; nothing is written.

    Raises:
        ArticugenError: unknown source or category; the folder is in use or damaged.
    """
    with started(job) as run:
        return run.plan


def generate(job: Job, on_object: Callable[[ObjectReport], None]) -> Manifest:
    """Make the data set, or what is missing of it, and write its manifest.

    Args:
        on_object: called for each object, those that are there already first.

    Raises:
        ArticugenError: unknown source or category, the disk is full, more objects were rejected
            than the recipe allows (what was made is kept), and the like.
        KeyboardInterrupt: finished objects are kept; the next run goes on after them.
    """
    with started(job) as run:
        return run.finish(on_object)


@contextmanager
def started(job: Job) -> Iterator["Run"]:
    """A run that has its folder to itself and a plan, and has made nothing yet."""
    with Journal(job.out) as journal:
        yield Run(job, journal, _plan(job, journal))


@dataclass(frozen=True)
class Run:
    """A run in its folder; see `started`."""

    job: Job
    journal: Journal
    plan: Plan

    def finish(self, on_object: Callable[[ObjectReport], None]) -> Manifest:
        """Make what is missing; see `generate`."""
        began = time.perf_counter()
        outcomes = list(self.plan.done)
        for outcome in outcomes:
            on_object(_report(outcome, reused=True))
        if self.journal.is_complete(self.plan.keys):
            return Manifest.read(self.job.out)
        self.journal.claim(task.shard for task in self.plan.tasks)
        for outcome in _made(self.job, self.plan.tasks):
            self.journal.record(outcome)
            outcomes.append(outcome)
            on_object(_report(outcome, reused=False))
        _check_rejects(outcomes, self.job)
        manifest = Manifest.of(
            outcomes,
            category=self.job.category,
            source=self.job.source,
            licence=registry.licence(self.job.source),
            recipe=self.job.recipe.text(),
            seed=self.job.seed,
            timings=_timings(self.plan, time.perf_counter() - began, self.job.jobs),
        )
        self.journal.finish(manifest)
        return manifest


def make_object(job: Job, task: Task) -> Outcome:
    """Make one object and write its shard; a fault of the object becomes its rejection."""
    started = time.perf_counter()
    _give_back_large_blocks()
    try:
        obj, instances = _instances(job, task)
    except (InvalidSource, RejectedInstance) as error:
        return _rejected(task, str(error))
    except ArticugenError:
        raise
    except Exception as error:  # an object must not take the others down with it
        return _rejected(task, f"internal error, please report it: {type(error).__name__}: {error}")
    record = write_shard(job.out / task.shard, instances, _attributes(job, task.ref))
    return Outcome.of_shard(
        task.key,
        record,
        input_sha256=obj.sha256,
        notes=obj.notes,
        seconds=time.perf_counter() - started,
    )


@cache
def _give_back_large_blocks() -> None:
    """Have glibc return freed depth maps to the system; by default it keeps them, full of holes.

    Elsewhere than on glibc nothing changes.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _LARGE_BLOCK)


def _instances(job: Job, task: Task) -> tuple[ArticulatedObject, list[Instance]]:
    """The object and all its instances; what they share is given back before they are written."""
    # numba and the mesh readers take a second to import: the command line should not wait for them
    from articugen import articulation  # noqa: PLC0415
    from articugen.instance import make_instance, prepare  # noqa: PLC0415

    settings = registry.settings(task.ref)
    obj = articulation.resolve(
        registry.load(task.ref),
        job.recipe.articulation,
        canonical=settings.canonical,
        movable=settings.movable,
    )
    prepared = prepare(obj, job.recipe, job.seed)
    return obj, [make_instance(prepared, index) for index in range(len(prepared.states))]


def _rejected(task: Task, reason: str) -> Outcome:
    return Outcome(rejected=Rejection(key=task.key, reason=reason))


def _plan(job: Job, journal: Journal) -> Plan:
    refs = registry.object_refs(job.source, job.category, objects=job.recipe.objects)
    keys = [_key(job, ref) for ref in refs]
    names = journal.shard_names(keys)
    done, tasks = [], []
    for ref, key in zip(refs, keys, strict=True):
        outcome = journal.finished(key)
        if outcome is not None:
            done.append(outcome)
        else:
            tasks.append(Task(ref, key, names[key], journal.why(key) or ""))
    instances = len(tasks) * (job.recipe.articulation.states + 1)
    seconds = instances * SECONDS_PER_INSTANCE + len(tasks) * SECONDS_PER_OBJECT
    return Plan(
        keys=tuple(keys),
        tasks=tuple(tasks),
        done=tuple(done),
        instances=instances,
        bytes=instances * _bytes_per_instance(job.recipe.sampling),
        seconds=seconds / max(1, min(job.jobs, len(tasks))),
        conflict=journal.conflict(keys),
    )


def _key(job: Job, ref: ObjectRef) -> Key:
    return Key(
        split=ref.split,
        object_id=ref.object_id,
        ref=_source_digest(ref),
        recipe_sha256=job.recipe.for_one_object().sha256(),
        seed=job.seed,
        generator=generator_version(),
    )


def _source_digest(ref: ObjectRef) -> str:
    """What an object is read from. A procedural one is what the generating code makes of its name;
    an unreadable one will be rejected with its reason when its turn comes."""
    if registry.is_procedural(ref.source):
        return f"{ref.source}/{ref.object_id}"
    try:
        return registry.load(ref).sha256
    except InvalidSource as error:
        return f"unreadable: {error}"


@cache
def generator_version() -> str:
    """The package's version and a digest of the code that decides what an instance holds."""
    package = Path(__file__).resolve().parent
    digest = hashlib.sha256()
    for name in GENERATING_CODE:
        path = package / name
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(file.relative_to(package).as_posix().encode() + b"\0" + file.read_bytes())
    return f"{__version__}+{digest.hexdigest()[:12]}"


def _made(job: Job, tasks: tuple[Task, ...]) -> Iterator[Outcome]:
    """The outcome of each task, as they finish."""
    if job.jobs == 1 or len(tasks) < 2:
        for task in tasks:
            yield make_object(job, task)
        return
    pool = ProcessPoolExecutor(
        min(job.jobs, len(tasks)),
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_leave_interrupts_to_the_parent,
    )
    try:
        for future in as_completed([pool.submit(make_object, job, task) for task in tasks]):
            yield future.result()
    except BaseException:
        for process in list((pool._processes or {}).values()):
            process.terminate()  # a shard that is being written has no final name yet
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    pool.shutdown()


def _leave_interrupts_to_the_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _attributes(job: Job, ref: ObjectRef) -> dict[str, str | int]:
    recipe = job.recipe.for_one_object()
    return {
        "category": job.category,
        "split": ref.split,
        "source": ref.source,
        "licence": registry.licence(ref.source),
        "recipe": recipe.text(),
        "recipe_sha256": recipe.sha256(),
        "seed": job.seed,
        "articugen_version": generator_version(),
    }


def _report(outcome: Outcome, *, reused: bool) -> ObjectReport:
    made, key = outcome.made, outcome.key
    return ObjectReport(
        object_id=key.object_id,
        split=key.split,
        shard=made.shard if made else "",
        instances=made.instances if made else 0,
        seconds=made.seconds if made else 0.0,
        rejected=outcome.rejected.reason if outcome.rejected else None,
        reused=reused,
    )


def _check_rejects(outcomes: list[Outcome], job: Job) -> None:
    rejected = [outcome.rejected for outcome in outcomes if outcome.rejected]
    if len(rejected) <= job.recipe.max_rejected_fraction * len(outcomes):
        return
    first = rejected[0]
    raise ArticugenError(
        f"{len(rejected)} of {len(outcomes)} objects were rejected, more than the recipe's "
        f"max_rejected_fraction of {job.recipe.max_rejected_fraction:g}; the first, "
        f"{first.key.object_id}: {first.reason}"
    )


def _timings(todo: Plan, seconds: float, workers: int) -> Timings:
    unit = 1 if sys.platform == "darwin" else 1024
    peak = max(
        resource.getrusage(who).ru_maxrss
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return Timings(
        seconds=seconds,
        instances_per_second=todo.instances / seconds if seconds > 0 else 0.0,
        peak_memory_bytes=peak * unit,
        workers=workers,
    )


def _bytes_per_instance(sampling: Sampling) -> int:
    points = 10 * sampling.surface_points + 7 * (sampling.uniform_points + sampling.near_points)
    partial = 7 * sampling.partial_views * sampling.partial_points
    return points + partial + sum(r**3 for r in sampling.grids) // 25 + 2000


def default_jobs() -> int:
    """The cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
