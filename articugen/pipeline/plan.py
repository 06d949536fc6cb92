"""What a run would make, and why: planned from its job and from what the place holds already.

The estimates of seconds were fitted by eye to CPU seconds of a few bundled objects; once a place
has objects made by the recipe, their own times decide.
"""

import hashlib
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from articugen.core import processes
from articugen.core.errors import InvalidRecipe, MachineFault, NotOfCategory, printable
from articugen.core.files import megabytes, room_at
from articugen.core.recipe import Recipe
from articugen.pipeline.common import Name
from articugen.pipeline.job import Job
from articugen.pipeline.making import (
    Task,
    import_readers,
    instances_each,
    limit_of,
    not_made,
    source_digest,
    verdict_on,
)
from articugen.pipeline.records import Records
from articugen.sources.refs import ObjectRef
from articugen.sources.source import Source
from articugen.store.manifest import MOST_OBJECTS
from articugen.store.outcome import Key, ObjectEntry, Outcome, Rejection, ShardEntry

STARTUP = 3.0
"""Seconds until a worker has imported what it needs; once a run."""

_SHRUNK_BY: dict[str | int, int] = {"R": 25, "H": 20}
"""What gzip makes of the grids and images of a drawer's cabinet, by a letter of their shapes."""

_HOPELESS = 4
"""A run that is estimated to need this many times what is free is not begun."""


@dataclass(frozen=True)
class Plan:
    """Plan of a run.

    Attributes:
        keys: of all objects.
        tasks: the objects it would make.
        done: what the place has already.
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
            sentence = (
                f"{out}: this takes about {megabytes(need)} on the disk, {megabytes(free)} are "
                "free; free some space, choose another folder, or ask for fewer objects or states"
            )
            if need > _HOPELESS * free:
                raise MachineFault(sentence)
            on_notice(sentence)


def objects_of(job: Job, source: Source) -> tuple[ObjectRef, ...]:
    """Return all objects of the data set, in the order that gives shards their names.

    Raises:
        InvalidSource: unknown source, category or object.
        InvalidRecipe: they are more than a manifest can list.
    """
    counted = partial(_is_of_category, job.recipe)
    # files of others are read where they can do no harm
    with processes.Crew(counted, workers=min(job.jobs, 1), **_for_reading(job)) as crew:
        refs = source.objects(
            job.category, objects=job.recipe.objects, ids=job.ids, exclude=job.exclude,
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
    """Return whether a part of an object moves in the recipe's sense; no mesh is read. One that
    cannot be read counts: its turn comes to be refused, with the reason."""
    from articugen.instance.again import resolved  # noqa: PLC0415 - slow to import
    from articugen.meshes.read import wanting  # noqa: PLC0415

    try:
        with wanting("nothing"):
            resolved(ref, recipe)
    except NotOfCategory:
        return False
    except Exception as error:
        verdict_on(error, ref, recipe)  # raises what says nothing of the object
    return True


def plan_for(job: Job, records: Records, refs: Sequence[ObjectRef]) -> Plan:
    """Return what is to be done for these objects of a job, by what its place holds already."""
    limit = limit_of(job.recipe)
    keys, known = [], dict[Key, Outcome]()
    generator = refs[0].generator_by(job.recipe.text()) if refs else ""
    for ref, read in zip(refs, _read(job, refs), strict=True):
        key = _key(job, ref, read.value or "unreadable", generator)
        keys.append(key)
        if key.object_id != ref.object_id:
            reason = f"{printable(str(ref.location))}: its name is no plain text; rename it"
            known[key] = Outcome(rejected=Rejection(key=key, reason=reason))
        elif read.value is None:
            known[key] = not_made(key, read, limit)
    names = records.shard_names(keys)
    done, tasks = [], []
    for place, (ref, key) in enumerate(zip(refs, keys, strict=True)):
        outcome = records.finished(key)
        if outcome is not None and not _may_do_with_more(outcome, limit):
            done.append(outcome)
        else:
            why = records.why(key) or "the recipe now allows it more"
            tasks.append(Task(ref, key, names[key], why, known.get(key), place))
    instances = len(tasks) * instances_each(job.recipe)
    return Plan(
        keys=tuple(keys),
        tasks=tuple(tasks),
        done=tuple(done),
        instances=instances,
        bytes=instances * instance_bytes(job.recipe, [o.shard for o in done if o.shard]),
        seconds=run_seconds(job.recipe, len(tasks), job.jobs, [o.made for o in done if o.made]),
        conflict=records.conflict(keys),
    )


def plan_recorded(
    job: Job,
    records: Records,
    refs: Sequence[ObjectRef],
    on_object: Callable[[int, int, str], None],
) -> Plan:
    """Return the same by records alone: what objects are made from is not read again, the plain
    command does that. `on_object` is called with how many objects were checked, of how many, and
    the last one."""
    generator = refs[0].generator_by(job.recipe.text())

    def check(ref: ObjectRef) -> tuple[Key, str | None]:
        outcome = records.outcomes.get(name_of_ref(ref))
        key = _key(job, ref, outcome.key.ref if outcome else "unknown", generator)
        return key, None if outcome and outcome.failed else records.why(key)

    done, tasks, keys = list[Outcome](), list[Task](), list[Key]()
    with ThreadPoolExecutor(max(1, job.jobs)) as pool:
        for number, (ref, (key, why)) in enumerate(zip(refs, pool.map(check, refs), strict=True)):
            on_object(number + 1, len(refs), ref.object_id)
            keys.append(key)
            if why is None:
                done.append(records.outcomes[name_of_ref(ref)])
            else:
                tasks.append(Task(ref, key, "", why, place=number))
    return Plan(tuple(keys), tuple(tasks), tuple(done), 0, 0, 0.0, None)


def name_of_ref(ref: ObjectRef) -> Name:
    """Return what an object is called in plans and records."""
    return ref.split, plain_name(ref.object_id)


def _may_do_with_more(outcome: Outcome, limit: processes.Limit) -> bool:
    """Return whether the object was rejected by a limit that is lower than this one."""
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
    """Return the name that stands for an object whose own no file could hold, unlike any
    other's."""
    plain = printable(object_id)
    if plain == object_id:
        return plain
    return f"{plain[:100]}~{hashlib.sha256(os.fsencode(object_id)).hexdigest()[:8]}"


def _read(job: Job, refs: Sequence[ObjectRef]) -> Sequence[processes.Ended[str]]:
    """Return the files each object is read from. A procedural one is made of its name; others'
    files are digested by workers, which make nothing of their meshes."""
    if all(ref.is_made for ref in refs):
        return [processes.Ended(i, f"{r.source}/{r.object_id}") for i, r in enumerate(refs)]
    digested = partial(source_digest, job.recipe)
    read = processes.each(digested, refs, workers=job.jobs, **_for_reading(job))
    return sorted(read, key=lambda ended: ended.number)


def _for_reading(job: Job) -> dict[str, Any]:
    """Return the settings of workers that read objects' files and make nothing."""
    named = {"name": lambda ref: plain_name(ref.object_id)}
    return {"limit": limit_of(job.recipe), "ready": import_readers, **named}


def run_seconds(recipe: Recipe, objects: int, workers: int, done: Sequence[ObjectEntry]) -> float:
    """Estimate seconds of the clock to make `objects` objects; `done` are some that this recipe
    made before."""
    if objects == 0:
        return 0.0
    expected = sum(object_seconds(recipe, entry.instances) for entry in done)
    taken = sum(entry.seconds for entry in done)
    pace = taken / expected if taken > 0 and expected > 0 else 1.0
    seconds = object_seconds(recipe, recipe.articulation.states + 1) * pace
    rounds = objects / max(1, min(workers, objects))
    return STARTUP + seconds * rounds


def object_seconds(recipe: Recipe, instances: int) -> float:
    """Estimate seconds of one worker for one object."""
    views, sampling = recipe.views, recipe.sampling
    voxels = sum(resolution**3 for resolution in sampling.grids)
    shared = 0.6 + views.count * views.resolution**2 * 7.5e-8 + voxels * 3.3e-7
    points = 2.2e-6 * sampling.surface_points + 1.2e-6 * sampling.near_points
    clouds = 2e-3 * sampling.partial_views
    return shared + instances * (0.01 + 3.5e-4 * views.count + points + clouds + 7e-8 * voxels)


def instance_bytes(recipe: Recipe, done: Sequence[ShardEntry] = ()) -> int:
    """Estimate bytes of an instance in its shard; `done` are some that this recipe made before."""
    if done:
        return sum(shard.bytes for shard in done) // sum(shard.instances for shard in done)
    fields, sizes = recipe.fields(), recipe.instance_bytes()
    shrunk = {
        name: max(_SHRUNK_BY.get(letter, 1) for letter in field.shape)
        for name, field in fields.items()
    }
    samples = (n for n, shape in recipe.instance_shapes().items() if shape and None not in shape)
    return sum(sizes[name] // shrunk[name] for name in samples) + 2000
