"""Damaged files of a data set made again from recipe and sources, to the same content.

The manifest stays where it is, and a shard is replaced in one step, by one that has the content
which the manifest records for it: whoever kills a repair finds the data set no worse than before.
What cannot be made again is left as it is, with the reason.
"""

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

from articugen.core.arrays import grouped
from articugen.core.errors import ArticugenError, CorruptShard, RejectedInstance
from articugen.core.files import write_atomically
from articugen.core.place import Folder
from articugen.core.recipe import Recipe
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
from articugen.store.outcome import ObjectEntry, ShardEntry
from articugen.store.shards import ShardRecord, content_sha256, open_shard
from articugen.store.writer import copy_user_group
from articugen.verify.dataset import MENDED, Repair, Report, text_findings, verify
from articugen.verify.rebuild import rebuild
from articugen.verify.replay import made_elsewhere


def repair(
    folder: Path,
    report: Report,
    *,
    jobs: int = 1,
    drop_user: bool = False,
    on_notice: Callable[[str], None] = lambda _: None,
) -> Iterator[Repair]:
    """Mend what `report` found in a data set, as far as that can be proven right; yield what was
    done about each file.

    Args:
        drop_user: whether a group `user` may be lost where it cannot be read.
        on_notice: called with one sentence where it takes a while, or a worker was lost.

    Raises:
        ArticugenError: a run is at work there.
        MachineFault: the disk is full, or the like; what was mended is kept.
    """
    try:
        Manifest.read(folder)
    except CorruptShard as error:
        fault = str(error).removeprefix(f"{folder / MANIFEST_NAME}: ").removeprefix(f"{folder}/")
        fault = fault.partition("; ")[0]
        try:
            done = rebuild(folder, jobs=jobs)
        except ArticugenError as why:
            yield Repair(MANIFEST_NAME, fault, f"not made again: {why}", ok=False)
            return
        yield Repair(MANIFEST_NAME, fault, done, ok=True)
        report = verify(folder, jobs=jobs)
    wrong = grouped((f.shard, f) for f in report.findings if f.check in MENDED)
    with Records(Folder(folder)) as records:
        manifest = Manifest.read(folder)
        alien = any(one.check == "attributes" for findings in wrong.values() for one in findings)
        if alien and len(wrong) == len(manifest.shards):  # shards that may be whole would be lost
            yield Repair(
                MANIFEST_NAME,
                "not one of the shards is what it records",
                "it may be of another run: bring back the right one, or delete it and repair again",
                ok=False,
            )
            return
        sentences = {
            name: findings[0].sentence
            + (f" (and {len(findings) - 1} more)" if findings[1:] else "")
            for name, findings in wrong.items()
        }
        yield from _shards(manifest, sentences, records, folder, jobs, drop_user, on_notice)
        manifest = Manifest.read(folder)
        for finding in text_findings(folder, manifest):
            name = finding.shard or MANIFEST_NAME
            if name == MANIFEST_NAME:
                manifest.write(folder)
            else:
                write_atomically(folder / name, croissant.of_data_set(manifest))
            yield Repair(name, finding.sentence, "written again", ok=True)


def _shards(
    manifest: Manifest,
    wrong: dict[str, str],
    records: Records,
    folder: Path,
    jobs: int,
    drop_user: bool,
    on_notice: Callable[[str], None],
) -> Iterator[Repair]:
    """Make shards again, those of `wrong`, by a run of the manifest's own job over them alone."""
    tasks: list[Task] = []
    for name, sentence in wrong.items():
        try:
            tasks.append(_task(manifest, name))
        except ArticugenError as error:
            yield Repair(name, sentence, f"left as it is: {error}", ok=False)
    if not tasks:
        return
    recipe, others = Recipe.model_validate_json(manifest.recipe), dict[str, ShardEntry]()
    job = Job(manifest.source, manifest.category, recipe, manifest.seed, folder, jobs)
    shards = {shard.name: shard for shard in manifest.shards if shard.name in wrong}
    objects = {entry.shard: entry for entry in manifest.objects if entry.shard in wrong}
    check = _AsRecorded(folder, objects, shards, made_elsewhere(manifest), drop_user)
    work = Work(job, len(manifest.objects), check, records.handles)
    try:
        with closing(outcomes_of(work, tasks, Local(jobs), on_notice)) as ends:
            for task, outcome, _ in ends:
                assert outcome is not None  # nothing is claimed here
                name, why = task.shard, outcome.rejected or outcome.skipped or outcome.failed
                if why:
                    yield Repair(name, wrong[name], f"left as it is: {why.sentence}", ok=False)
                    continue
                done = "made again from its source, to the same content"
                if outcome.shard and outcome.shard != shards[name]:
                    others[name] = outcome.shard
                    done += ", in a file of other bytes than before, which the manifest now records"
                with open_shard(folder / name) as shard:
                    done += ", with the group 'user' that it had" if shard.extended else ""
                yield Repair(name, wrong[name], done, ok=True)
    finally:
        records.tidy()
        if others:
            now = tuple(others.get(shard.name, shard) for shard in manifest.shards)
            manifest = Manifest.sealed(**dict(iter(manifest)) | {"shards": now})
            write_atomically(folder / croissant.NAME, croissant.of_data_set(manifest))
            manifest.write(folder)


def _task(manifest: Manifest, shard: str) -> Task:
    """Return what makes a shard again; ArticugenError if what decides its content has changed, or
    is gone."""
    entry, *others = (o for o in manifest.objects if o.shard == shard)
    if others:
        raise ArticugenError(f"it holds {1 + len(others)} objects; make the data set again")
    source, object_id = manifest.source, entry.key.object_id
    ref = open_source(source).find(manifest.category, object_id)
    recipe = Recipe.of_text(manifest.recipe)
    if recipe is None:
        raise ArticugenError("its recipe is of another version of articugen; repair it there")
    read = "" if ref.is_made else digest(ref, colours=recipe.shows_colours)
    now = {
        "ref": read or f"{source}/{object_id}",
        "generator": ref.generator_by(manifest.recipe),
        "recipe_sha256": recipe.for_one_object().sha256(),
    }
    changed = entry.key.model_copy(update=now).difference(entry.key)
    if ref.licence != manifest.licence:
        changed = changed or f"the licence was {manifest.licence}, is {ref.licence}"
    if changed:
        raise ArticugenError(f"{object_id}: {changed}; repair it where that is as it was")
    return Task(replace(ref, split=entry.key.split), entry.key, shard, "it is damaged")


@dataclass(frozen=True)
class _AsRecorded:
    """Check of shards that are made again, before they replace the damaged ones."""

    folder: Path
    objects: dict[str, ObjectEntry]
    shards: dict[str, ShardEntry]
    elsewhere: str
    drop_user: bool

    def __call__(self, temporary: Path, record: ShardRecord) -> None:
        """Raise RejectedInstance where it must not."""
        entry = self.objects[record.name]
        if content_sha256(record.content) != entry.content_sha256:
            raise RejectedInstance(
                f"made again it has another content than the manifest records{self.elsewhere}"
            )
        if self.drop_user:
            return
        damaged = self.folder / record.name
        try:
            _check_whose(damaged, entry.key.object_id)
            copy_user_group(damaged, temporary, self.shards[record.name].bytes)
        except CorruptShard as error:
            raise RejectedInstance(
                f"{error}; take from it what you need, then add --drop-user (drop_user=True)"
            ) from None


def _check_whose(path: Path, object_id: str) -> None:
    """Raise CorruptShard where a group `user` would come to belong to another object's
    instances."""
    try:
        with open_shard(path) as shard:
            others = set(shard.object_ids()) - {object_id} if shard.extended else ()
    except CorruptShard:  # that is unknown
        return
    if others:
        raise CorruptShard(f"it is a shard of {', '.join(sorted(others))}, with a group 'user'")
