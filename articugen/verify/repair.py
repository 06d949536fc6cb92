"""Damaged files of a data set made again from recipe and sources, to the same content.

The manifest stays where it is, and a shard is replaced in one step, by one that has the content
which the manifest records for it: whoever kills a repair finds the data set no worse than before.
What cannot be made again is left as it is, and why is said.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from pydantic import ValidationError

from articugen.core.errors import ArticugenError, CorruptShard, RejectedInstance
from articugen.core.files import write_atomically
from articugen.core.place import Folder
from articugen.core.recipe import Recipe
from articugen.instance.again import generator_of
from articugen.pipeline.executors.local import Local
from articugen.pipeline.executors.work import Work
from articugen.pipeline.job import Job
from articugen.pipeline.making import Task
from articugen.pipeline.records import Records
from articugen.pipeline.run import outcomes_of
from articugen.sources.readers import digest
from articugen.sources.source import open_source
from articugen.store import croissant
from articugen.store.manifest import MANIFEST_NAME, Manifest
from articugen.store.outcome import ObjectEntry, Outcome, ShardEntry
from articugen.store.shards import ShardRecord, content_sha256, open_shard
from articugen.store.writer import copy_user_group
from articugen.verify.dataset import MENDED, Finding, Repair, Report, text_findings, verify
from articugen.verify.rebuild import rebuild
from articugen.verify.replay import made_elsewhere


@dataclass(frozen=True)
class Asked:
    """How a repair is to be done.

    Attributes:
        jobs: worker processes.
        drop_user: whether a group `user` may be lost where it cannot be read.
        on_repair: called with what was done about each file.
        on_notice: called with one sentence where it takes a while, or a worker was lost.
    """

    jobs: int = 1
    drop_user: bool = False
    on_repair: Callable[[Repair], None] = field(default=lambda _: None)
    on_notice: Callable[[str], None] = field(default=lambda _: None)


def repair(folder: Path, report: Report, asked: Asked) -> tuple[Repair, ...]:
    """Mend what `report` found in a data set, as far as that can be proven right.

    Raises:
        ArticugenError: a run is at work there.
        MachineFault: the disk is full, or the like; what was mended is kept.
    """
    repairs: list[Repair] = []
    for done in _repairs(folder, report, asked):
        repairs.append(done)
        asked.on_repair(done)
    return tuple(repairs)


def _repairs(folder: Path, report: Report, asked: Asked) -> Iterator[Repair]:
    try:
        Manifest.read(folder)
    except CorruptShard as error:
        wrong = str(error).removeprefix(f"{folder / MANIFEST_NAME}: ").removeprefix(f"{folder}/")
        wrong = wrong.partition("; ")[0]
        yield (rebuilt := _rebuilt(folder, wrong, asked))
        if not rebuilt.ok:
            return
        report = verify(folder, jobs=asked.jobs)
    with Records(Folder(folder)) as records:
        manifest, wrong = Manifest.read(folder), _damaged(report)
        if _is_of_another_run(manifest, wrong):
            sentence = "not one of the shards is what it records"
            cure = (
                "it may be of another run: bring back the right one, or delete it and repair again"
            )
            yield Repair(MANIFEST_NAME, sentence, cure, ok=False)
            return
        yield from _shards(folder, manifest, wrong, records, asked)
        yield from _texts(folder)


Damaged = dict[str, list[Finding]]
"""What is wrong with each shard that may be made again."""


def _damaged(report: Report) -> Damaged:
    wrong: Damaged = {}
    for finding in report.findings:
        if finding.check in MENDED:
            wrong.setdefault(finding.shard, []).append(finding)
    return wrong


def _is_of_another_run(manifest: Manifest, wrong: Damaged) -> bool:
    """Whether shards that may be whole would be lost for a manifest that was put beside them."""
    alien = any(finding.check == "attributes" for found in wrong.values() for finding in found)
    return alien and len(wrong) == len(manifest.shards)


def _rebuilt(folder: Path, wrong: str, asked: Asked) -> Repair:
    try:
        done = rebuild(folder, jobs=asked.jobs)
    except ArticugenError as error:
        return Repair(MANIFEST_NAME, wrong, f"not made again: {error}", ok=False)
    return Repair(MANIFEST_NAME, wrong, done, ok=True)


def _texts(folder: Path) -> Iterator[Repair]:
    """The manifest as it is written, and what lies beside it for machines."""
    manifest = Manifest.read(folder)
    for finding in text_findings(folder, manifest):
        if finding.shard == croissant.NAME:
            write_atomically(folder / croissant.NAME, croissant.of_data_set(manifest))
        else:
            manifest.write(folder)
        name = finding.shard or MANIFEST_NAME
        yield Repair(name, finding.sentence, "written again", ok=True)


def _shards(
    folder: Path, manifest: Manifest, wrong: Damaged, records: Records, asked: Asked
) -> Iterator[Repair]:
    tasks: list[Task] = []
    for name, findings in wrong.items():
        try:
            tasks.append(_task(manifest, name))
        except ArticugenError as error:
            yield Repair(name, _in_words(findings), f"left as it is: {error}", ok=False)
    yield from _made_again(folder, manifest, records, tasks, wrong, asked)


def _in_words(findings: Sequence[Finding]) -> str:
    more = f" (and {len(findings) - 1} more)" if len(findings) > 1 else ""
    return findings[0].sentence + more


def _task(manifest: Manifest, shard: str) -> Task:
    """What makes a shard again.

    Raises:
        ArticugenError: something that decides its content is not what it was, or not there.
    """
    entry, *others = (o for o in manifest.objects if o.shard == shard)
    if others:
        raise ArticugenError(f"it holds {1 + len(others)} objects; make the data set again")
    source, object_id = manifest.source, entry.key.object_id
    ref = open_source(source).find(manifest.category, object_id)
    now = {
        "ref": f"{source}/{object_id}" if ref.is_made else digest(ref),
        "generator": generator_of(ref, manifest.recipe),
        "recipe_sha256": _recipe(manifest).for_one_object().sha256(),
    }
    changed = entry.key.model_copy(update=now).difference(entry.key)
    if ref.licence != manifest.licence:
        changed = changed or f"the licence was {manifest.licence}, is {ref.licence}"
    if changed:
        raise ArticugenError(f"{object_id}: {changed}; repair it where that is as it was")
    return Task(replace(ref, split=entry.key.split), entry.key, shard, "it is damaged")


def _recipe(manifest: Manifest) -> Recipe:
    try:
        return Recipe.model_validate_json(manifest.recipe)
    except ValidationError:
        raise ArticugenError(
            "its recipe is of another version of articugen; repair it there"
        ) from None


def _made_again(
    folder: Path,
    manifest: Manifest,
    records: Records,
    tasks: Sequence[Task],
    wrong: Damaged,
    asked: Asked,
) -> Iterator[Repair]:
    if not tasks:
        return
    job = Job(
        manifest.source, manifest.category, _recipe(manifest), manifest.seed, folder, asked.jobs
    )
    objects, shards = ({e.shard: e for e in manifest.objects}, {s.name: s for s in manifest.shards})
    again = {task.shard: objects[task.shard] for task in tasks}
    sizes = {name: shards[name].bytes for name in again}
    other: dict[str, ShardEntry] = {}
    check = partial(
        _is_as_recorded, folder, again, sizes, made_elsewhere(manifest), asked.drop_user
    )
    try:
        work = Work(job, len(manifest.objects), check, records.handles)
        with closing(outcomes_of(work, tasks, Local(asked.jobs), asked.on_notice)) as ends:
            for _, outcome, _ in ends:
                assert outcome is not None  # nothing is claimed here
                name = next(n for n, entry in again.items() if entry.key == outcome.key)
                if outcome.shard and outcome.shard != shards[name]:
                    other[name] = outcome.shard
                done = _in_place(folder / name, outcome, same_file=name not in other)
                yield Repair(name, _in_words(wrong[name]), done, ok=outcome.shard is not None)
    finally:
        records.tidy()
        if other:
            _record(folder, manifest, other)


def _is_as_recorded(
    folder: Path,
    objects: dict[str, ObjectEntry],
    sizes: dict[str, int],
    elsewhere: str,
    drop_user: bool,
    temporary: Path,
    record: ShardRecord,
) -> None:
    """Look at a shard that was made again before it replaces the damaged one.

    Raises:
        RejectedInstance: it must not.
    """
    if content_sha256(record.content) != objects[record.name].content_sha256:
        raise RejectedInstance(
            f"made again it has another content than the manifest records{elsewhere}"
        )
    if drop_user:
        return
    damaged = folder / record.name
    try:
        _check_whose(damaged, objects[record.name].key.object_id)
        copy_user_group(damaged, temporary, sizes[record.name])
    except CorruptShard as error:
        raise RejectedInstance(
            f"{error}; take from it what you need, then add --drop-user (drop_user=True)"
        ) from None


def _check_whose(path: Path, object_id: str) -> None:
    """See to it that no group `user` comes to belong to another object's instances.

    Raises:
        CorruptShard: it would.
    """
    try:
        with open_shard(path) as shard:
            others = set(shard.object_ids()) - {object_id} if shard.extended else ()
    except CorruptShard:  # nobody can tell
        return
    if others:
        raise CorruptShard(f"it is a shard of {', '.join(sorted(others))}, with a group 'user'")


def _in_place(path: Path, outcome: Outcome, *, same_file: bool) -> str:
    """What became of a shard, in one sentence."""
    why = outcome.rejected or outcome.skipped or outcome.failed
    if why:
        return f"left as it is: {why.sentence}"
    said = "made again from its source, to the same content"
    if not same_file:
        said += ", in a file of other bytes than before, which the manifest now records"
    with open_shard(path) as shard:
        return said + (", with the group 'user' that it had" if shard.extended else "")


def _record(folder: Path, manifest: Manifest, other: dict[str, ShardEntry]) -> None:
    """Put into the manifest what shards of the same content are as files now."""
    values = {name: getattr(manifest, name) for name in Manifest.model_fields}
    del values["manifest_sha256"]
    values["shards"] = tuple(other.get(shard.name, shard) for shard in manifest.shards)
    sealed = Manifest.sealed(**values)
    write_atomically(folder / croissant.NAME, croissant.of_data_set(sealed))
    sealed.write(folder)
