"""Whether a data set is what its manifest says and what its makers promise.

The manifest first, against its digest and itself; then files (names, sizes, digests, schema), what
the shards say of themselves, content digests, and what `invariants` knows of the numbers. Nothing
is changed and nothing is believed.

Pictures and pages are welcome in a data set's folder: our commands put them there. Whatever else
the manifest does not list is named.
"""

import hashlib
import json
import os
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from pydantic import TypeAdapter

from articugen.core import processes
from articugen.core.arrays import grouped
from articugen.core.errors import CorruptShard, spelt_out
from articugen.core.files import read_regular
from articugen.core.ledger import LEDGER
from articugen.core.recipe import Recipe
from articugen.pipeline.folder import is_temporary
from articugen.store import croissant
from articugen.store.manifest import MANIFEST_NAME, Manifest
from articugen.store.manifest_pages import MOST_BYTES, listed_pages, stale_pages
from articugen.store.outcome import ObjectEntry, ShardEntry
from articugen.store.shards import Shard, content_row, content_sha256, open_shard
from articugen.verify.invariants import Finding, faults

WELCOME = (".png", ".html")
"""Endings of files that may lie beside the shards."""

MENDED = ("missing", "checksum", "schema", "unreadable", "attributes", "content")
"""What a shard made again is rid of; numbers that are wrong in a file that is as it was made stay
wrong."""


@dataclass(frozen=True)
class Repair:
    """Fault of one file of a data set, in a sentence; what was done about it, or why nothing was;
    and whether it is whole again."""

    name: str
    wrong: str
    done: str
    ok: bool

    def __str__(self) -> str:
        return spelt_out(f"{self.name}: {self.wrong}: {self.done}")


@dataclass(frozen=True, repr=False)
class Report:
    """Findings of `verify`, and how much it checked.

    Attributes:
        extended: names of the shards that are as they were made but for a group `user` that
            somebody added; it was not checked.
        repairs: what was done, where that was asked for, before this was found.
    """

    findings: tuple[Finding, ...]
    shards: int
    instances: int
    extended: tuple[str, ...] = ()
    repairs: tuple["Repair", ...] = ()

    @property
    def ok(self) -> bool:
        return not self.findings

    @property
    def mendable(self) -> bool:
        """True where a repair may do anything about it."""
        checks = (*MENDED, "manifest", "croissant")
        return any(finding.check in checks for finding in self.findings)

    def __repr__(self) -> str:
        count = len(self.findings)
        summary = "ok" if self.ok else f"{count} finding{'s' * (count != 1)}"
        about = f"Report({summary}: {self.shards} shards, {self.instances:,} instances)"
        lines = [*self.repairs, *self.findings]
        return "\n".join([about, *(f"  {line}" for line in lines)])


def verify(folder: Path, *, jobs: int = 1, on_shard: Callable[[str], None] | None = None) -> Report:
    """Check a data set: the folder that holds manifest.json and its shards. With `jobs` of 1
    this process does; `on_shard` is called with the name of each shard once it is examined."""
    try:
        manifest = Manifest.read(folder)
    except CorruptShard as error:
        return Report((Finding("manifest", str(error)), *_leftovers(folder)), 0, 0)
    findings = [*text_findings(folder, manifest), *_manifest_findings(manifest)]
    findings += [*_strays(folder, manifest), *_leftovers(folder)]
    recipe = recipe_of(manifest.recipe)
    about = {name: getattr(manifest, name) for name in ("category", "source", "licence", "seed")}
    about |= {"recipe": recipe.for_one_object().text()} if recipe else {}
    contents = grouped((entry.shard, entry) for entry in manifest.objects)
    looked = processes.in_order(
        partial(_shard_findings, folder, about),
        [(shard, contents[shard.name]) for shard in manifest.shards],
        workers=min(jobs, len(manifest.shards)) if jobs > 1 else 0,
        name=lambda task: task[0].name,
    )
    extended: list[str] = []
    with closing(looked):
        for shard, (some, more) in zip(manifest.shards, looked, strict=True):
            findings += some
            extended += [shard.name] * more
            if on_shard is not None:
                on_shard(shard.name)
    instances = sum(shard.instances for shard in manifest.shards)
    return Report(tuple(findings), len(manifest.shards), instances, tuple(extended))


def text_findings(folder: Path, manifest: Manifest) -> Iterator[Finding]:
    """Yield flipped bits that change no meaning, or none for us: the last digit of a fraction, and
    files for machines that look for data sets."""
    miswritten: list[str] = []

    def note(fraction: str) -> float:
        ours = TypeAdapter(float).dump_json(float(fraction)).decode()
        if fraction not in (ours, repr(float(fraction))):
            miswritten.append(fraction)
        return float(fraction)

    json.loads(read_regular(folder / MANIFEST_NAME, MOST_BYTES), parse_float=note)
    for fraction in miswritten:
        yield Finding("manifest", f"{MANIFEST_NAME}: {fraction} is not how it was written")
    path = folder / croissant.NAME
    try:
        fault = croissant.fault(read_regular(path, MOST_BYTES), manifest)
    except FileNotFoundError:  # it decides nothing
        return
    except OSError as error:
        fault = error.strerror or str(error)
    if fault:
        yield Finding("croissant", fault, croissant.NAME)


def _manifest_findings(manifest: Manifest) -> Iterator[Finding]:
    """Yield where the manifest does not agree with itself, though its digest does."""
    recipe, keys = recipe_of(manifest.recipe), manifest.keys
    if recipe is None:
        yield Finding("manifest", "recipe is not a recipe of this version")
    elif recipe.objects is not None and len(keys) > recipe.objects:
        yield Finding("manifest", f"{len(keys)} objects, the recipe asks for fewer")
    recipe_sha256 = recipe.for_one_object().sha256() if recipe else ""
    for key in keys:
        if recipe and key.recipe_sha256 != recipe_sha256:
            yield Finding("manifest", "recipe_sha256 is not of the recipe", "", key.object_id)
        if key.seed != manifest.seed:
            yield Finding("manifest", f"seed is not {manifest.seed}", "", key.object_id)
        if key.generator != keys[0].generator:
            yield Finding("manifest", "generator is not that of the others", "", key.object_id)
    for entry in manifest.objects:
        if entry.key.ref not in (entry.input_sha256, f"{manifest.source}/{entry.key.object_id}"):
            yield Finding(
                "manifest", "ref is neither its input's nor a name's", "", entry.key.object_id
            )
    instances = manifest.timings.instances_per_second * manifest.timings.seconds
    most = len(keys) * (recipe.articulation.states + 1) if recipe else 0
    if recipe and (
        instances >= most + 0.5 or abs(instances - round(instances)) > 1e-6 * max(instances, 1.0)
    ):
        yield Finding("manifest", "timings give a number of instances that cannot be")
    for failed in manifest.failed:
        sentence = f"is not in the data, and will be tried again: {failed.reason}"
        yield Finding("incomplete", sentence, object_id=failed.key.object_id)
    if manifest.shortfall and not manifest.failed:
        yield Finding("incomplete", manifest.shortfall)
    yield from _splits(manifest)


def _splits(manifest: Manifest) -> Iterator[Finding]:
    shards = {entry.key: entry.shard for entry in manifest.objects}
    known: dict[str, str] = {}
    for key in manifest.keys:
        other = known.setdefault(key.object_id, key.split)
        if other != key.split:
            sentence = f"is in {other} and in {key.split}"
            yield Finding("splits", sentence, shards.get(key, ""), key.object_id)


def _strays(folder: Path, manifest: Manifest) -> Iterator[Finding]:
    ours = {MANIFEST_NAME, croissant.NAME}
    known = ours | {shard.name for shard in manifest.shards} | listed_pages(folder / MANIFEST_NAME)
    stale = stale_pages(folder / MANIFEST_NAME)
    for name in sorted(set(os.listdir(folder)) - known):
        path = folder / name
        welcome = path.suffix in WELCOME and path.is_file() and not path.is_symlink()
        if name in stale:
            sentence = f"a page that no manifest lists; remove it with: articugen clean {folder}"
            yield Finding("leftover", sentence, name)
        elif not (welcome or is_temporary(name) or name == LEDGER):
            what = "folder" if path.is_dir() else "file"
            sentence = f"the manifest does not know this {what}; move it elsewhere"
            yield Finding("surplus", sentence, name)


def _leftovers(folder: Path) -> Iterator[Finding]:
    """Yield leftovers of a run that was cut short."""
    for name in sorted(os.listdir(folder)) if folder.is_dir() else []:
        if name == LEDGER:
            yield Finding(
                "unfinished",
                "a run is at work here or was cut short; start it again, merge what ranks have "
                f"made, or tidy up with: articugen clean {folder}",
            )
        elif is_temporary(name):
            yield Finding(
                "leftover",
                "a temporary file of a run that is at work or was killed; remove the latter's "
                f"with: articugen clean {folder}",
                name,
            )


def recipe_of(text: str) -> Recipe | None:
    """Return the recipe of just this text; None where it is another's, or of another version."""
    recipe = Recipe.of_text(text)
    return recipe if recipe and recipe.text() == text else None


def _shard_findings(
    folder: Path, about: dict[str, str | int], recorded: tuple[ShardEntry, list[ObjectEntry]]
) -> tuple[list[Finding], bool]:
    """Return what is wrong with one shard, and whether all that is not as recorded is a group
    `user`.

    A file that is not the one recorded is looked into as well. With such a group it may be another:
    then its attributes and the digests of its content say whether the rest is what it was.
    """
    entry, objects = recorded
    path = folder / entry.name
    if not path.is_file():
        sentence = "the manifest lists this shard, the folder lacks it"
        return [Finding("missing", sentence, entry.name)], False
    findings: list[Finding] = []
    other, extended = False, False
    try:
        other = not entry.is_of(path)
        with open_shard(path) as shard:
            findings += _attribute_findings(shard, about, objects)
            content, geometry = _row_findings(shard, entry, objects)
            findings += content
            extended = other and shard.extended and not findings
            findings += geometry
    except CorruptShard as error:
        findings.append(Finding("schema", str(error), entry.name))
    except OSError as error:
        findings.append(Finding("unreadable", error.strerror or str(error), entry.name))
    if other and not extended:
        sentence = "not the file that the manifest records"
        findings.insert(0, Finding("checksum", sentence, entry.name))
    return findings, extended


def _attribute_findings(
    shard: Shard, expected: dict[str, str | int], objects: list[ObjectEntry]
) -> Iterator[Finding]:
    about, name = dict(shard.attributes), shard.path.name
    wanted = {attribute: {value} for attribute, value in expected.items() if attribute in about}
    wanted["recipe_sha256"] = {hashlib.sha256(str(about["recipe"]).encode()).hexdigest()}
    wanted["split"] = {entry.key.split for entry in objects}
    wanted["generator"] = {entry.key.generator for entry in objects}
    about.setdefault("generator", about["articugen_version"])  # where earlier versions wrote it
    for attribute, values in wanted.items():
        if {about[attribute]} != values:
            right = " or ".join(sorted(map(str, values)))
            yield Finding("attributes", f"{attribute} is {about[attribute]}, not {right}", name)


def _row_findings(
    shard: Shard, entry: ShardEntry, objects: list[ObjectEntry]
) -> tuple[list[Finding], list[Finding]]:
    """Return what is wrong with the content, and with the geometry; each row is read once for
    both."""
    name, recipe = shard.path.name, Recipe.of_text(str(shard.attributes["recipe"]))
    content: list[Finding] = []
    geometry: list[Finding] = []
    if recipe is None:
        sentence = "recipe is not a recipe of this version"
        geometry.append(Finding("attributes", sentence, name))
    if len(shard) != entry.instances:
        content.append(Finding("content", f"{len(shard)} instances, not {entry.instances}", name))
    recorded = {o.key.object_id: o.content_sha256 for o in objects}
    places = grouped((object_id, index) for index, object_id in enumerate(shard.object_ids()))
    for object_id in sorted({*places, *recorded}):
        rows = [shard.stored_row(index) for index in places.get(object_id, ())]
        content_now = [content_row(object_id, row) for row in rows]
        if content_sha256(content_now) != recorded.get(object_id):
            sentence = "not the content that the manifest records"
            content.append(Finding("content", sentence, name, object_id))
        if recipe is not None and rows:
            geometry += _geometry_findings(shard, object_id, rows, recipe)
    return content, geometry


def _geometry_findings(
    shard: Shard, object_id: str, stored: list[dict[str, NDArray[Any]]], recipe: Recipe
) -> Iterator[Finding]:
    """Yield what is wrong with one object, given its rows as they are stored."""
    name = shard.path.name
    try:
        rows = [shard.instance_of(row) for row in stored]
    except ValueError as error:
        yield Finding("numbers", str(error), name, object_id)
        return
    for fault in faults(rows, recipe):
        yield replace(fault, shard=name, object_id=object_id)
