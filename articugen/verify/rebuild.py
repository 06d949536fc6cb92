"""A manifest that is lost or damaged, made again of what whole shards say of themselves.

They do not say what their objects were read from. Where the damaged manifest still does, and agrees
with the shard, that is believed; else one instance of the object is made again and must come out
the same, which proves source, recipe, seed and code at once.
"""

import hashlib
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel

from articugen.core import processes
from articugen.core.errors import ArticugenError, CorruptShard
from articugen.core.files import locked, read_regular, sha256_of, write_atomically
from articugen.core.ledger import LEDGER
from articugen.core.recipe import Recipe
from articugen.instance.again import resolved
from articugen.instance.preparing import prepare
from articugen.sources.readers import digest
from articugen.sources.refs import ObjectRef
from articugen.sources.source import open_source
from articugen.store import croissant
from articugen.store.manifest import LISTS, MANIFEST_NAME, UNMADE, Manifest, Timings
from articugen.store.manifest_pages import MOST_BYTES, is_page_name
from articugen.store.outcome import Key, ObjectEntry, Outcome, Rejection, ShardEntry, is_shard_name
from articugen.store.shards import ShardRecord, content_sha256, open_shard
from articugen.verify.dataset import recipe_of
from articugen.verify.replay import differences

R = TypeVar("R", bound=BaseModel)

_DECIDES = ("recipe_sha256", "seed", "generator")
"""What of a key all objects have in common."""
_ALIKE = ("category", "source", "licence", "recipe", *_DECIDES)
"""What all shards of a data set must say alike."""

_NO_RUN = Timings(seconds=0.0, instances_per_second=0.0, peak_memory_bytes=0, workers=1)


def rebuild(folder: Path, *, jobs: int) -> str:
    """Write the manifest of a data set again, and return what was done, in one sentence;
    ArticugenError if its shards say too little, or a run is at work or was cut short."""
    with locked(folder):
        if os.path.lexists(folder / LEDGER):
            raise ArticugenError(
                "a run was cut short here; start it again: it goes on, and makes damaged shards "
                "again"
            )
        return _rebuilt(folder, jobs)


@dataclass(frozen=True)
class _Witness:
    """A shard that is whole, and what it says of itself: texts, but for the seed."""

    record: ShardRecord
    about: Mapping[str, Any]

    @property
    def object_id(self) -> str:
        return self.record.content[0][0]

    def ref(self) -> ObjectRef:
        """Return the reference to its object, or InvalidSource."""
        return open_source(self.about["source"]).find(self.about["category"], self.object_id)


def _rebuilt(folder: Path, jobs: int) -> str:
    names = sorted(n for n in os.listdir(folder) if is_shard_name(n) and (folder / n).is_file())
    wide = min(jobs, len(names)) if jobs > 1 else 0
    looked = processes.in_order(partial(_witness, folder), names, workers=wide)
    whole = {name: witness for name, witness in zip(names, looked, strict=True) if witness}
    about, known = _common(whole), _said(folder)
    shards = {shard.name: shard for shard in _entries(known, "shards", ShardEntry)}
    kept = {  # what a damaged manifest still says of objects that were made, if it fits the shards
        entry.shard: Outcome(made=entry, shard=shards[entry.shard])
        for entry in _entries(known, "objects", ObjectEntry)
        if entry.shard in shards and _is_of(entry.key, about)
    }
    outcomes = {name: o for name, o in kept.items() if _agrees(o, whole.get(name))}
    alone = [witness for name, witness in whole.items() if name not in outcomes]
    proven = processes.in_order(
        partial(_proven, folder), alone, workers=wide, name=attrgetter("object_id")
    )
    outcomes |= {outcome.shard.name: outcome for outcome in proven if outcome.shard}
    holders: dict[str, str] = {}
    for name, outcome in outcomes.items():
        other = holders.setdefault(outcome.key.object_id, name)
        if other != name:
            raise ArticugenError(
                f"{other} and {name} both hold {outcome.key.object_id}; move one of them elsewhere"
            )
    others = {
        entry.key.object_id: Outcome.model_validate({kind: entry})
        for kind in UNMADE
        for entry in _entries(known, kind, Rejection)
        if _is_of(entry.key, about) and entry.key.object_id not in holders
    }
    shortfall = known.get("shortfall") or (
        "objects failed" if any(other.failed for other in others.values()) else None
    )
    manifest = Manifest.of(
        [*outcomes.values(), *others.values()],
        recipe=_recipe(known, about) or about["recipe"],
        timings=_NO_RUN,
        shortfall=shortfall if isinstance(shortfall, str) else None,
        **{name: about[name] for name in ("category", "source", "licence", "seed")},
    )
    write_atomically(folder / croissant.NAME, croissant.of_data_set(manifest))
    manifest.write(folder)
    sentence = f"made again from {len(whole)} shards"
    if alone:
        sentence += f", {len(alone)} of them proven by making an instance again"
    rest = "taken from the damaged one" if kept else "lost"
    sentence += f"; what nothing else records (rejected objects, notes, times) is {rest}"
    if lost := sorted(set(names) - outcomes.keys()):
        sentence += f"; what {', '.join(lost)} held is not known any more: move it away, and run "
        sentence += "the command again that made the data set"
    return sentence


def _witness(folder: Path, name: str) -> _Witness | None:
    """None where the shard is damaged, or not of one object."""
    path = folder / name
    try:
        with open_shard(path) as shard:
            content, about = shard.content(), shard.attributes
        record = ShardRecord(name, sha256_of(path), path.stat().st_size, len(content), content)
    except (CorruptShard, OSError):
        return None
    about = {"generator": about["articugen_version"], **about}  # where earlier versions wrote it
    texts = {name: str(value) for name, value in about.items() if name != "seed"}
    return _Witness(record, about | texts) if len({row[0] for row in content}) == 1 else None


def _common(whole: Mapping[str, _Witness]) -> Mapping[str, Any]:
    """Return what all shards say alike; ArticugenError if there is none, or they do not."""
    if not whole:
        raise ArticugenError(
            "no shard is whole that could show what the data set was; fetch manifest.json again, "
            "or make the data set again in another folder"
        )
    (first, witness), *others = whole.items()
    for attribute in _ALIKE:
        if attribute not in witness.about:
            raise ArticugenError(
                f"{first} does not state its {attribute}; fetch manifest.json again"
            )
        for name, other in others:
            if other.about.get(attribute) != witness.about[attribute]:
                raise ArticugenError(
                    f"{first} and {name} are of different runs (by their {attribute}); move those "
                    "elsewhere that do not belong here"
                )
    return witness.about


def _said(folder: Path) -> dict[str, Any]:
    """Return what can be read of a manifest and of its pages; of all pages there, where it does not
    name its own."""
    head = _json(folder / MANIFEST_NAME)
    there = sorted(filter(is_page_name, os.listdir(folder)))
    listed = head.get("pages")
    if isinstance(listed, list):
        names = [page.get("name") for page in listed if isinstance(page, dict)]
        there = [name for name in there if name in names]
    pages = [_json(folder / name) for name in (there if listed or not head else ())]
    lists = {name: [head.get(name), *(page.get(name) for page in pages)] for name in LISTS}
    return head | {
        name: [entry for some in entries if isinstance(some, list) for entry in some]
        for name, entries in lists.items()
    }


def _json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(read_regular(path, MOST_BYTES))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _entries(known: dict[str, Any], name: str, kind: type[R]) -> list[R]:
    """Return the entries of a list that can be read."""
    entries: list[R] = []
    for entry in known[name]:
        with suppress(ValueError):
            entries.append(kind.model_validate_json(json.dumps(entry)))
    return entries


def _is_of(key: Key, about: Mapping[str, Any]) -> bool:
    return all(getattr(key, name) == about[name] for name in _DECIDES)


def _recipe(known: dict[str, Any], about: Mapping[str, Any]) -> str | None:
    """Return the whole recipe, of which shards have what decides one object; None if damaged."""
    text = str(known.get("recipe"))
    recipe = recipe_of(text)
    fits = recipe is not None and recipe.for_one_object().text() == about["recipe"]
    digest = hashlib.sha256(text.encode()).hexdigest()
    return text if fits and digest == known.get("recipe_sha256") else None


def _agrees(outcome: Outcome, witness: _Witness | None) -> bool:
    """Return whether a damaged manifest may be believed of an object. Where its shard is damaged
    too that one is made again, which will show."""
    entry, key = outcome.made, outcome.key
    assert entry
    if witness is None:
        return True
    if entry.content_sha256 != content_sha256(witness.record.content):
        return False
    if key.object_id != witness.object_id or key.split != witness.about["split"]:
        return False
    if key.ref != f"{witness.about['source']}/{key.object_id}":
        return key.ref == entry.input_sha256
    try:
        ref, recipe = witness.ref(), Recipe.of_text(witness.about["recipe"])
        code = ref.generator_by(witness.about["recipe"])
        colours = recipe is not None and recipe.shows_colours
        return code != key.generator or digest(ref, colours=colours) == entry.input_sha256
    except ArticugenError:  # nothing contradicts it
        return True


def _proven(folder: Path, witness: _Witness) -> Outcome:
    """Return the outcome of an object of which only the shard says anything; ArticugenError if its
    source, or the code, is not what it was."""
    about, object_id, ref = witness.about, witness.object_id, witness.ref()
    code = ref.generator_by(about["recipe"])
    if code != about["generator"]:
        raise ArticugenError(
            f"{object_id} was made by other code ({about['generator']}, this is "
            f"{code}); repair it there, or fetch manifest.json again"
        )
    recipe = Recipe.model_validate_json(about["recipe"])
    prepared = prepare(resolved(ref, recipe), recipe, about["seed"])
    with open_shard(folder / witness.record.name) as shard:
        stored = shard.instance(len(shard) - 1)
    for _, sentence in differences(prepared, stored):
        raise ArticugenError(
            f"{object_id}: {sentence}; what it was made from is not what is here now"
        )
    key = Key(
        object_id=object_id,
        ref=f"{about['source']}/{object_id}" if ref.is_made else prepared.obj.sha256,
        **{name: about[name] for name in ("split", *_DECIDES)},
    )
    return Outcome.of_shard(
        key, witness.record, input_sha256=prepared.obj.sha256, notes=prepared.obj.notes
    )
