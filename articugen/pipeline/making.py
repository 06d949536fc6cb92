"""One object of a job made into a shard, and whose fault it is where that fails."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from articugen.core import processes
from articugen.core.content import VERSION
from articugen.core.errors import (
    ArticugenError,
    InvalidSource,
    MachineFault,
    NotOfCategory,
    RejectedInstance,
    machine_fault,
    printable,
)
from articugen.core.memory import give_back
from articugen.core.recipe import Recipe
from articugen.core.records import ResolvedObject
from articugen.core.schema import Instance
from articugen.pipeline.job import Job
from articugen.sources import readers
from articugen.sources.refs import ObjectRef
from articugen.store.outcome import Key, Outcome, Rejection
from articugen.store.writer import Check, write_shard

SECONDS_FOR_ANY_OBJECT = 600.0
SECONDS_FOR_ANY_INSTANCE = 5.0
"""What an object may take where its recipe says nothing of it: a hundred times what most do."""

_DEPTH_MAPS = 8 << 20
"""Bytes: what is as large as they are goes back to the system once it is freed."""


@dataclass(frozen=True)
class Task:
    """An object to make.

    Attributes:
        shard: the name of its file.
        why: it is to be made, in a few words.
        known: what has become of it, where that is known without making it.
        place: its number in the plan.
    """

    ref: ObjectRef
    key: Key
    shard: str
    why: str
    known: Outcome | None = None
    place: int = 0


def make_object(job: Job, folder: Path, task: Task, check: Check | None = None) -> Outcome:
    """Make one object and write its shard into a folder; a fault of the object becomes its
    rejection, and so does what `check` raises of the shard.

    Raises:
        MachineFault, MemoryError: it says nothing about the object.
        ArticugenError: no object can be made, for want of a library say.
    """
    started = time.perf_counter()
    give_back(_DEPTH_MAPS)
    try:
        obj, instances = _instances(job, task)
        if _is_other(task, obj.sha256):
            return _changed(task)
        record = write_shard(folder / task.shard, instances, _attributes(job, task), check)
    except Exception as error:  # an object must not take the others down with it
        verdict = verdict_on(error, task.ref, job.recipe)
        if verdict is None:
            what = f"internal error, please report it: {type(error).__name__}: {error}"
            return Outcome(failed=Rejection(key=task.key, reason=printable(what)))
        if _is_other(task, source_digest(job.recipe, task.ref)):
            return _changed(task)
        unmade = _unmade(task.key, verdict)
        is_skipped = isinstance(verdict, NotOfCategory)
        return Outcome(skipped=unmade) if is_skipped else Outcome(rejected=unmade)
    return Outcome.of_shard(
        task.key,
        record,
        input_sha256=obj.sha256,
        notes=obj.notes,
        seconds=time.perf_counter() - started,
    )


def _is_other(task: Task, digest: str) -> bool:
    """Return whether an object's files are no longer those that the run was planned with."""
    return digest != task.key.ref and not task.ref.is_made


def _changed(task: Task) -> Outcome:
    """Return the outcome of an object whose files have changed or are gone, as with a disk: that is
    no fault of it."""
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


def verdict_on(error: Exception, ref: ObjectRef, recipe: Recipe) -> Exception | None:
    """Return what `error` says of the object, None where it is a fault of our code; raise it where
    it ends the run or has the object tried again."""
    fault = machine_fault(error)
    wanted = getattr(fault, "_total_size", 0) / 1e6  # of numpy's own MemoryError
    if wanted > recipe.memory_per_object_mb:
        takes = f"asks for {wanted:,.0f} MB of memory at once"
        return _OverLimit(takes, "memory_per_object_mb", recipe.memory_per_object_mb)
    if fault is not None:
        raise fault
    if isinstance(error, InvalidSource | RejectedInstance | NotOfCategory):
        return error
    if isinstance(error, ArticugenError):
        raise error
    if isinstance(error, OSError) and ref.is_made:
        raise MachineFault(printable(f"{ref.object_id}: {error}; see to it")) from error
    return error if isinstance(error, OSError) and error.errno is not None else None


def _instances(job: Job, task: Task) -> tuple[ResolvedObject, Iterator[Instance]]:
    """Return an object as it is made, and its instances, one after the other."""
    # numba and the mesh readers take a second to import: the command line should not wait for them
    from articugen.instance.again import resolved  # noqa: PLC0415
    from articugen.instance.make import make_instance  # noqa: PLC0415
    from articugen.instance.preparing import prepare  # noqa: PLC0415

    prepared = prepare(resolved(task.ref, job.recipe), job.recipe, job.seed)
    return prepared.obj, map(partial(make_instance, prepared), range(len(prepared.states)))


def source_digest(recipe: Recipe, ref: ObjectRef) -> str:
    """Return the digest of an object's files, or why they cannot be read, as making it will;
    MachineFault or MemoryError where that says nothing of the object."""
    try:
        return readers.digest(ref, colours=recipe.shows_colours)
    except Exception as error:  # an object must not take the others down with it
        verdict = verdict_on(error, ref, recipe) or f"{type(error).__name__}: {error}"
        return printable(f"unreadable: {verdict}")


def import_stages() -> None:
    """Import what takes a worker seconds once, and is no object's fault; before its clock
    starts."""
    import articugen.instance.articulation  # noqa: PLC0415
    import articugen.instance.make  # noqa: PLC0415, F401


def import_readers() -> None:
    """Return the same, for planning alone."""
    import articugen.sources.urdf  # noqa: PLC0415, F401


def not_made(key: Key, ended: processes.Ended, limit: processes.Limit) -> Outcome:
    """Return the outcome of an object whose worker was killed, by us or by others."""
    over = {
        "seconds": _OverLimit("takes too many seconds", "seconds_per_object", limit.seconds),
        "megabytes": _OverLimit("takes too many MB", "memory_per_object_mb", limit.megabytes),
    }
    if ended.over:
        return Outcome(rejected=_unmade(key, over[ended.over]))
    reason = (
        f"its worker {ended.lost}; use fewer --jobs, or end other programs, and run it again; if "
        "it stays so, report it, and leave it out with --exclude"
    )
    return Outcome(failed=Rejection(key=key, reason=reason))


def limit_of(recipe: Recipe) -> processes.Limit:
    seconds = recipe.seconds_per_object
    if seconds is None:
        seconds = SECONDS_FOR_ANY_OBJECT + SECONDS_FOR_ANY_INSTANCE * instances_each(recipe)
    return processes.Limit(seconds, recipe.memory_per_object_mb)


def instances_each(recipe: Recipe) -> int:
    return recipe.articulation.states + 1


def _attributes(job: Job, task: Task) -> dict[str, str | int]:
    recipe, ref = job.recipe.for_one_object(), task.ref
    return {
        "category": job.category,
        **{name: getattr(ref, name) for name in ("split", "source", "licence")},
        "recipe": recipe.text(),
        "recipe_sha256": recipe.sha256(),
        "seed": job.seed,
        "articugen_version": VERSION,
        "generator": task.key.generator,
    }
