"""Whether a data set is what its manifest says and what its makers promise.

Files first (names, sizes, digests, schema), then content digests, then what checks.py knows of the
numbers. Nothing is changed and nothing is believed.
"""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path

from pydantic import ValidationError

from articugen import workers
from articugen.checks import faults
from articugen.errors import CorruptShard
from articugen.files import sha256_of
from articugen.journal import JOURNAL_NAME
from articugen.manifest import Manifest, ObjectEntry, ShardEntry
from articugen.recipe import Recipe
from articugen.shards import Shard, content_sha256, open_shard


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong.

    Attributes:
        check: what was looked at, for instance "checksum" or "zero level".
        sentence: what is wrong.
        shard: the name of the file, or "" where the finding concerns the data set.
        object_id: or "".
        state_index: of the instance, or None.
    """

    check: str
    sentence: str
    shard: str = ""
    object_id: str = ""
    state_index: int | None = None

    def __str__(self) -> str:
        state = "" if self.state_index is None else f"[{self.state_index}]"
        where = " ".join(part for part in (self.shard, self.object_id + state) if part)
        return (
            f"{where}: {self.check}: {self.sentence}" if where else f"{self.check}: {self.sentence}"
        )


@dataclass(frozen=True)
class Report:
    """What `verify` found, and how much it looked at."""

    findings: tuple[Finding, ...]
    shards: int
    instances: int

    @property
    def ok(self) -> bool:
        return not self.findings


def verify(folder: Path, *, jobs: int = 1, on_shard: Callable[[str], None] | None = None) -> Report:
    """Check a data set: the folder that holds manifest.json and its shards.

    Args:
        folder: of the data set.
        jobs: processes to work with; with 1 it is this one.
        on_shard: called with the name of each shard once it has been looked at.
    """
    try:
        manifest = Manifest.read(folder)
    except CorruptShard as error:
        return Report((Finding("manifest", str(error)),), 0, 0)
    findings = list(_folder_findings(folder, manifest))
    look = partial(_shard_findings, folder, manifest.category, manifest.seed)
    contents = [[o for o in manifest.objects if o.shard == s.name] for s in manifest.shards]
    looked = workers.in_order(
        look,
        list(zip(manifest.shards, contents, strict=True)),
        workers=min(jobs, len(manifest.shards)) if jobs > 1 else 0,
        name=lambda task: task[0].name,
    )
    with closing(looked):
        for shard, found in zip(manifest.shards, looked, strict=True):
            findings += found
            if on_shard is not None:
                on_shard(shard.name)
    return Report(
        tuple(findings), len(manifest.shards), sum(shard.instances for shard in manifest.shards)
    )


def _folder_findings(folder: Path, manifest: Manifest) -> Iterator[Finding]:
    known = {shard.name for shard in manifest.shards}
    for path in sorted(folder.glob("*.h5")):
        if path.name not in known:
            yield Finding("surplus", "the manifest does not know this file", path.name)
    if (folder / JOURNAL_NAME).exists():
        yield Finding("unfinished", "a run is at work here or was cut short; start it again")
    unfinished = [outcome.fault for outcome in manifest.outcomes if outcome.fault]
    for fault in unfinished:
        sentence = f"is not in the data, and will be tried again: {fault.reason}"
        yield Finding("incomplete", sentence, object_id=fault.key.object_id)
    if manifest.shortfall and not unfinished:
        yield Finding("incomplete", manifest.shortfall)
    seen: dict[str, str] = {}
    for entry in manifest.objects:
        other = seen.setdefault(entry.key.object_id, entry.key.split)
        if other != entry.key.split:
            yield Finding(
                "splits",
                f"is in {other} and in {entry.key.split}",
                entry.shard,
                entry.key.object_id,
            )


def _shard_findings(
    folder: Path, category: str, seed: int, told: tuple[ShardEntry, list[ObjectEntry]]
) -> list[Finding]:
    """What is wrong with one shard. A file that is not the one recorded is looked into as well."""
    entry, objects = told
    path = folder / entry.name
    if not path.is_file():
        return [
            Finding("missing", "the manifest lists this shard, the folder lacks it", entry.name)
        ]
    findings: list[Finding] = []
    if path.stat().st_size != entry.bytes or sha256_of(path) != entry.sha256:
        findings.append(Finding("checksum", "not the file that the manifest tells of", entry.name))
    try:
        with open_shard(path) as shard:
            findings += _attribute_findings(shard, category, seed, objects)
            findings += _content_findings(shard, entry, objects)
            findings += _geometry_findings(shard)
    except CorruptShard as error:
        findings.append(Finding("schema", str(error), entry.name))
    return findings


def _attribute_findings(
    shard: Shard, category: str, seed: int, objects: list[ObjectEntry]
) -> Iterator[Finding]:
    about, name = shard.attributes, shard.path.name
    digest = hashlib.sha256(str(about["recipe"]).encode()).hexdigest()
    wanted = {
        "category": {category},
        "seed": {seed},
        "split": {entry.key.split for entry in objects},
        "recipe_sha256": {digest},  # the key has the digest of what decides content alone
    }
    for attribute, values in wanted.items():
        if {about[attribute]} != values:
            told = " or ".join(sorted(map(str, values)))
            yield Finding("attributes", f"{attribute} is {about[attribute]}, not {told}", name)


def _content_findings(
    shard: Shard, entry: ShardEntry, objects: list[ObjectEntry]
) -> Iterator[Finding]:
    name, content = shard.path.name, shard.content()
    if len(content) != entry.instances:
        yield Finding("content", f"{len(content)} instances, not {entry.instances}", name)
    told = {o.key.object_id: o.content_sha256 for o in objects}
    for object_id in sorted(told.keys() | {instance[0] for instance in content}):
        mine = [instance for instance in content if instance[0] == object_id]
        if content_sha256(mine) != told.get(object_id):
            yield Finding("content", "not the content that the manifest tells of", name, object_id)


def _geometry_findings(shard: Shard) -> Iterator[Finding]:
    name = shard.path.name
    try:
        recipe = Recipe.model_validate_json(str(shard.attributes["recipe"]))
    except ValidationError:
        yield Finding("attributes", "recipe is not a recipe of this version", name)
        return
    by_object = sorted((object_id, i) for i, object_id in enumerate(shard.object_ids()))
    for object_id, places in groupby(by_object, key=lambda place: place[0]):
        try:
            rows = [shard.instance(i) for _, i in places]
        except ValueError as error:
            yield Finding("numbers", str(error), name, object_id)
            continue
        for fault in faults(rows, recipe):
            yield Finding(fault.check, fault.sentence, name, object_id, fault.state_index)
