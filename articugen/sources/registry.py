"""A source and a category to objects: which there are, in which split, and how each is read.

A source is a name under urdf_sources/ (or under the folder in $ARTICUGEN_SOURCES, which may also
just hold the models of a named source), or a path to any folder of models, or to one.
"""

import hashlib
import os
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from articugen.core.errors import InvalidSource, printable
from articugen.core.records import ArticulatedObject
from articugen.core.yaml_files import nearest
from articugen.sources import pool, procedural, readers
from articugen.sources.by_joints import of_joints
from articugen.sources.categories import kinds_there, own_name
from articugen.sources.named import NamedSource, common_categories, source_files, source_named
from articugen.sources.pool import model_at
from articugen.sources.refs import CategorySettings, ObjectRef
from articugen.sources.splits import split_sizes, take


@dataclass(frozen=True)
class CategoryInfo:
    """A category of a source; the objects of each split that are there or can be made."""

    name: str
    train: int
    test: int


@dataclass(frozen=True)
class SourceInfo:
    """A named source, for `articugen sources`.

    Attributes:
        folder: where its models are, or are expected.
        present: whether there is any object.
    """

    name: str
    origin: str
    licence: str
    frame: str
    folder: Path
    categories: tuple[CategoryInfo, ...]

    @property
    def present(self) -> bool:
        return any(category.train + category.test for category in self.categories)


def source_names() -> list[SourceInfo]:
    """Every named source, by name.

    Raises:
        InvalidSource: a source.yaml is wrong.
    """
    return [_info(named) for name in sorted(source_files()) if (named := source_named(name))]


def write_bundled(
    folder: Path, categories: Sequence[str] = tuple(procedural.CATEGORIES)
) -> Iterator[tuple[Path, int]]:
    """Write the models that come with articugen below a folder; the folder of each category, once
    it is written, and how many models it has.

    Raises:
        MachineFault: the folder cannot be written to.
    """
    for named in filter(None, map(source_named, sorted(source_files()))):
        if named.file.maker is not procedural:
            continue
        for category in (name for name in named.file.categories if name in categories):
            refs, place = object_refs(named.name, category), folder / named.name / category
            for ref in refs:
                procedural.write(ref, place / ref.object_id)
            yield place, len(refs)


def categories(source: str | Path, asked: Sequence[str]) -> tuple[str, ...]:
    """The categories that `asked` means, in the source's own names: each once, "all" for all.

    Args:
        source: as in `object_refs`.
        asked: names, each perhaps several joined by commas.

    Raises:
        InvalidSource: unknown source or category; "all" of a folder that does not tell categories.
    """
    names = [name.strip() for text in asked for name in text.split(",") if name.strip()]
    if not names:
        raise InvalidSource("no category is asked for; name one as articugen sources lists it")
    named = _named(source)
    there = _categories_there(source, named) if "all" in names else []
    if "all" in names and not there:
        raise InvalidSource(
            f"{source}: does not tell of what categories its models are; name one instead of 'all'"
        )
    wanted = [own for n in names for own in (there if n == "all" else [_meant(source, named, n)])]
    return tuple(dict.fromkeys(wanted))


def object_refs(
    source: str | Path,
    category: str,
    *,
    objects: int | None = None,
    ids: Collection[str] = (),
    exclude: Collection[str] = (),
    joints: Collection[str] = (),
    counts: pool.Counts = pool.all_count,
) -> tuple[ObjectRef, ...]:
    """The objects of one category, in a fixed order.

    Args:
        source: a name, or the path of a folder or of one model. A `Path` is never taken for a name.
        category: one of the source's; of a plain folder of URDFs any name will do.
        objects: so many objects (fewer where there are fewer), with the ratio of the splits kept
            and, from two objects on, at least one of each split. Sources that make their objects
            make any number.
        ids: these objects alone, () means all.
        exclude: but not these. Neither changes anything of the other objects.
        joints: only objects all of whose moving joints are of these kinds, () means any: see
            `by_joints`.
        counts: whether an object will be in the data; where a hash decides about splits neither is
            without one, if two will.

    Raises:
        InvalidSource: unknown source, category, id or kind of joint, or no object.
    """
    if objects is not None and objects < 1:
        raise InvalidSource(f"{objects} objects asked for; ask for one at least")
    there = _pool(source, category, objects, (*ids, *exclude), counts)
    refs = _chosen(there, category, ids, exclude)
    refs = of_joints(refs, joints, category)
    if objects is None or objects >= len(refs):
        return tuple(refs)
    tests = sum(ref.split == "test" for ref in refs)
    left = split_sizes(objects, len(refs) - tests, tests)
    return tuple(ref for ref in refs if take(left, ref.split))


def find(source: str | Path, category: str, object_id: str) -> ObjectRef:
    """The object of one id, without its split, which the other objects decide.

    Others are not looked at where the id is the name of a model's folder or file, in the source or
    in the folder of its category; else the source is listed, once for all ids.

    Raises:
        InvalidSource: unknown source, category or id.
    """
    named = _named(source)
    folder = named.folder if named else Path(source)
    ref = pool.of_id(named, folder, category, object_id)
    if ref is None:
        ref = _listed(source, category, os.path.abspath(folder)).get(object_id)
        if ref is None or not os.path.lexists(ref.location):
            _listed.cache_clear()
            (ref,) = object_refs(source, category, ids=[object_id])
    return replace(ref, split="")


@lru_cache(4)
def _listed(source: str | Path, category: str, _folder: str) -> dict[str, ObjectRef]:
    """The objects of a category in a folder, by id, as they were when one was first looked for."""
    return {ref.object_id: ref for ref in _pool(source, category, None, ())}


def load_path(path: str | Path, category: str = "") -> ArticulatedObject:
    """The one model at a path, in whatever layout: a file, a model's folder, or a folder that holds
    nothing but one model.

    Args:
        category: what to take it for; by default what it says itself, else "object".

    Raises:
        InvalidSource: there is no model, or several; anything amiss with its files.
        MachineFault, MemoryError: the disk does not answer, or the like.
    """
    return load(model_at(path, category))


def share_out(
    source: str | Path, names: Sequence[str], ids: Collection[str], exclude: Collection[str]
) -> dict[str, tuple[tuple[str, ...], tuple[str, ...]]]:
    """Of each category the `ids` and `exclude` that are its own; with ids, none without any.

    Raises:
        InvalidSource: an id is of none of the categories.
    """
    wanted = (*ids, *exclude)
    if len(names) == 1 or not wanted:
        return {name: (tuple(ids), tuple(exclude)) for name in names}
    known: dict[str, list[str]] = {}
    for name in names:
        with suppress(InvalidSource):  # said when its turn comes
            known[name] = [ref.object_id for ref in _pool(source, name, None, wanted)]
    everything = [each for own in known.values() for each in own]
    _check_ids(wanted, everything, ", ".join(names))
    shares = {
        n: tuple(tuple(i for i in w if i in own) for w in (ids, exclude))
        for n, own in known.items()
    }
    return {n: (share[0], share[1]) for n, share in shares.items() if share[0] or not ids}


def settings(ref: ObjectRef) -> CategorySettings:
    """What the source says about the object's category.

    Of a folder that no source.yaml describes, models in the layout of a named source get that
    source's words; a model of another name those for what it calls itself.
    """
    named = _named(ref.source)
    if named is not None:
        return named.file.categories[named.category(ref.category)]
    like = source_named(ref.reader)
    if like is None:
        return CategorySettings()
    names = (own_name(like.file, name) for name in (ref.category, ref.own_category))
    own = next(filter(None, names), None)
    return like.file.categories[own] if own else CategorySettings()


def clips_to_limits(source: str) -> bool:
    """Whether joints stay inside the limits of the URDF where the recipe leaves it to the source:
    those of models that others made do."""
    named = _named(source)
    return named is None or named.file.clip_to_limits


def is_procedural(source: str) -> bool:
    """Whether the source's objects are made on demand, by generators."""
    named = _named(source)
    return named is not None and named.file.maker is not None


def licence(source: str) -> str:
    """The licence of a source's models; "not stated" for a plain folder."""
    named = _named(source)
    return named.file.licence if named else "not stated"


def load(ref: ObjectRef) -> ArticulatedObject:
    """Read one object; one that is made on demand is written first where it is not there yet.

    Its digest covers what source.yaml says of how it stands and moves.

    Raises:
        InvalidSource: anything amiss with its files.
        BrokenPlugin: its reader is another package's and cannot be used.
        MachineFault, MemoryError: the disk does not answer, or the like.
    """
    own = settings(ref)
    obj = readers.load(ref, own)
    if own.said() == CategorySettings().said():
        return obj
    digest = hashlib.sha256(f"{obj.sha256} {own.said()}".encode()).hexdigest()
    return replace(obj, sha256=digest)


def digest(ref: ObjectRef) -> str:
    """The sha256 that `load` gives a sound object, without making anything of its meshes; of one
    whose meshes are unsound, some digest of its files.

    Raises:
        InvalidSource, BrokenPlugin, MachineFault, MemoryError: as `load`.
    """
    from articugen.meshes.read import hashed_only  # noqa: PLC0415 - slow to import

    with hashed_only():
        return load(ref).sha256


def _named(source: str | Path) -> NamedSource | None:
    """The named source, or None for the path of something that exists."""
    named = source_named(source) if isinstance(source, str) else None
    if named is None and readers.UNWRITABLE.search(str(source)):
        raise InvalidSource(
            f"{printable(str(source))}: its name has control characters or is not UTF-8; rename it"
        )
    if named is None and not os.path.exists(source):
        known = sorted(source_files())
        raise InvalidSource(
            f"no source {str(source)!r}{nearest(str(source), known)}; there are: "
            f"{', '.join(known)}, or the path of a folder of URDFs"
        )
    return named


def _pool(
    source: str | Path,
    category: str,
    objects: int | None,
    ids: Collection[str],
    counts: pool.Counts = pool.all_count,
) -> list[ObjectRef]:
    """All objects of a category; of one whose objects are made, so many and those called `ids`."""
    named = _named(source)
    if named is None:
        return pool.of_path(Path(source), category, counts)
    return pool.of_named(named, category, objects, ids, counts)


def _chosen(
    refs: list[ObjectRef], category: str, ids: Collection[str], exclude: Collection[str]
) -> list[ObjectRef]:
    _check_ids((*ids, *exclude), [ref.object_id for ref in refs], category)
    left = [r for r in refs if (not ids or r.object_id in ids) and r.object_id not in exclude]
    if refs and not left:
        raise InvalidSource(f"no object of {category!r} is left; exclude fewer")
    return left


def _check_ids(wanted: Collection[str], known: list[str], category: str) -> None:
    for name in wanted:
        if name not in known:
            hint = nearest(name, known) or f"; there are: {', '.join(known[:5])}, ..."
            raise InvalidSource(f"no object {name!r} of {category!r}{hint}")


def _categories_there(source: str | Path, named: NamedSource | None) -> list[str]:
    """The categories of which there are models, or can be made."""
    if named is None:
        return kinds_there(pool.mixed(Path(source)), common_categories())
    return [c.name for c in _info(named).categories if c.train + c.test]


def _meant(source: str | Path, named: NamedSource | None, name: str) -> str:
    """The category that somebody calls `name`. A folder of the user's own takes any name; where its
    models tell theirs, they are called as in PartNet-Mobility."""
    if named is not None:
        return named.category(name)
    own = own_name(common_categories(), name)
    path = Path(source)
    return own if own and path.is_dir() and pool.tells_categories(path) else name


def _info(named: NamedSource) -> SourceInfo:
    splits = {n: [ref.split for ref in refs] for n, refs in pool.of_every_category(named).items()}
    return SourceInfo(
        named.name,
        named.file.origin,
        named.file.licence,
        named.file.frame,
        named.folder,
        tuple(CategoryInfo(n, s.count("train"), s.count("test")) for n, s in splits.items()),
    )
