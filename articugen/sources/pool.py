"""All objects that a source has of a category, each with its split."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from functools import cache
from os.path import exists
from pathlib import Path

from articugen.core.errors import InvalidSource, printable
from articugen.core.recipe import load_recipe
from articugen.sources import readers
from articugen.sources.categories import of_category, own_name, plain, unknown, words
from articugen.sources.discovery import any_models, called, distinct, mixed_models, sorted_models
from articugen.sources.folders import visible
from articugen.sources.named import NamedSource, common_categories
from articugen.sources.readers import Maker
from articugen.sources.refs import CategorySettings, Found, ObjectRef
from articugen.sources.source_file import SourceFile
from articugen.sources.splits import assign_splits, split_sizes, take

Counts = Callable[[ObjectRef], bool]
"""Whether an object will be in the data, which no split may be without: see `assign_splits`."""


def all_count(_: ObjectRef) -> bool:
    """Whoever does not look: all will."""
    return True


def of_named(
    named: NamedSource,
    category: str,
    objects: int | None,
    ids: Collection[str],
    counts: Counts = all_count,
) -> list[ObjectRef]:
    """Return the objects of a named source; of one that makes them, so many and those called `ids`.

    Raises:
        InvalidSource: no such category, or no model of it.
    """
    own = named.category(category)
    maker = named.file.maker
    if maker:
        return _made(named, maker, own, objects, ids)
    refs = _found(named, sorted_models(named.file.reader, named.folder), own, counts)
    if not refs:
        raise InvalidSource(
            f"no model of {own!r} under {named.folder}; {named.yaml.parent}/README.md says how to"
            " get them"
        )
    return refs


def of_every_category(named: NamedSource) -> dict[str, list[ObjectRef]]:
    """Return the objects of each category of a named source, though there be none; of one that
    makes them as many as the category's recipe makes."""
    maker, every = named.file.maker, named.file.categories
    if maker:
        counts = {own: load_recipe(None, own, named.name).objects for own in every}
        return {own: _made(named, maker, own, counts[own], ()) for own in every}
    models = sorted_models(named.file.reader, named.folder)
    return {own: _found(named, models, own) for own in every}


def of_path(path: Path, category: str, counts: Counts = all_count) -> list[ObjectRef]:
    """Return the objects of a file, or of a folder that no source.yaml describes.

    Raises:
        InvalidSource: there is none; models that tell their category, all another.
    """
    single = readers.detect(path)
    if single:
        found = [single]
    elif path.is_file():
        raise InvalidSource(
            f"{path}: is not a .urdf file, nor a USD file of its own; name one, or a folder"
        )
    elif (path / category).is_dir():
        found = any_models(path / category)
    else:
        found = _of_category(list(mixed(path)), path, category)
    if not found:
        raise InvalidSource(
            f"{path}: holds no URDF or USD; put each model there as <id>.urdf, <id>.usd or "
            "<id>/<any name>.urdf"
        )
    return _with_splits(found, CategorySettings(), str(path), category, path, counts)


def of_id(named: NamedSource | None, path: Path, category: str, object_id: str) -> ObjectRef | None:
    """Return the object of that id where the name alone leads to it; no other one is examined, so
    that its split, which they decide, stays open. None where only a listing can tell.

    Args:
        named: the source whose folder `path` is; None where no source.yaml describes it.
    """
    own = named.category(category) if named else category
    if named and named.file.maker:
        number = named.file.maker.index_of(own, object_id)
        return None if number is None else _one_made(named, named.file.maker, own, number)
    if not named and (not path.is_dir() or readers.detect(path)):
        return None
    file, reader = (named.file, named.file.reader) if named else (common_categories(), "")
    settings = named.file.categories[own] if named else CategorySettings()
    by_folder = not named and (path / category).is_dir()
    for folder in [path / category] if by_folder else _folders(path, file, own):
        found = called(object_id, folder, reader)
        if not found:
            continue
        kinds = set(map(plain, found[0].kinds))
        if folder == path and not (kinds & words(file, own) if kinds else named is None):
            return None
        refs = _with_splits(found, settings, named.name if named else str(path), own, path)
        return replace(refs[0], split="") if len(refs) == 1 else None
    return None


def _folders(base: Path, file: SourceFile | None, own: str) -> Iterator[Path]:
    """A source's folder, then those in it that are called like a category, its own name first."""
    yield base
    wanted = words(file, own)
    like = [child for child in visible(base) if plain(child.name) in wanted]
    yield from sorted(like, key=lambda child: plain(child.name) != plain(own))


def model_at(path: str | Path, category: str = "") -> ObjectRef:
    """The one model at a path: a file, a model's folder, or a folder that holds nothing but one.

    Args:
        category: what to take it for; by default what it says itself, else "object".

    Raises:
        InvalidSource: there is none, or several.
    """
    path = Path(path)
    if not exists(path):
        raise InvalidSource(f"{printable(str(path))}: there is no such file or folder; correct it")
    own = readers.detect(path)
    found = [own] if own else any_models(path)
    if not found:
        raise InvalidSource(
            f"{printable(str(path))}: is no model, nor a folder of one; name a .urdf or USD "
            f"file, or a model's folder ({', '.join(readers.names())})"
        )
    if len(found) > 1:
        raise InvalidSource(
            f"{printable(str(path))}: holds {len(found)} models; name one, such as "
            f"{printable(str(found[0].location))}"
        )
    (one,) = _with_splits(
        found, CategorySettings(), str(path), category or found[0].category or "object", path
    )
    return one


def mixed(path: Path) -> Iterator[Found]:
    """Return every model in a folder that no source.yaml describes."""
    like = common_categories()
    return mixed_models(path, lambda name: own_name(like, name) is not None)


def tells_categories(path: Path) -> bool:
    """Whether any model in the folder tells its category; no more are examined than that takes."""
    return any(found.kinds for found in mixed(path))


def _of_category(found: list[Found], path: Path, category: str) -> list[Found]:
    """Leave out models that are known to be of other categories; any name will do for others."""
    kept = of_category(found, common_categories(), category)
    known = [f for f in found if f.kinds]
    if known and not kept:
        raise unknown(str(path), category, sorted({f.kinds[0] for f in known}))
    return kept + [f for f in found if not f.kinds]


def _found(
    named: NamedSource, models: Collection[Found], own: str, counts: Counts = all_count
) -> list[ObjectRef]:
    """Return those of `models` that are of the category."""
    found = of_category(models, named.file, own)
    settings = named.file.categories[own]
    return _with_splits(found, settings, named.name, own, named.folder, counts)


def _with_splits(
    found: Sequence[Found],
    own: CategorySettings,
    source: str,
    category: str,
    base: Path,
    counts: Counts = all_count,
) -> list[ObjectRef]:
    """Objects with their splits; those that the category's lists leave out are left out."""
    found = sorted(distinct(found, base), key=lambda f: f.object_id)
    refs = {
        f.object_id: ObjectRef(
            source,
            category,
            f.object_id,
            "",
            f.location,
            f.root,
            base if base.is_dir() else None,
            f.reader,
            own_category=f.category,
        )
        for f in found
    }
    groups = {f.object_id: f.group for f in found}
    splits = assign_splits(groups, own.train, own.test, cache(lambda name: counts(refs[name])))
    return [replace(ref, split=splits[name]) for name, ref in refs.items() if name in splits]


def _made(
    named: NamedSource, maker: Maker, category: str, objects: int | None, ids: Collection[str]
) -> list[ObjectRef]:
    """The first objects, as many as the source has or as are asked for, and those named by `ids`.

    Object i is always of the same split, however many are asked for.
    """
    own = named.file.categories[category]
    assert isinstance(own.train, int)
    assert isinstance(own.test, int)
    total = own.train + own.test
    numbers = {i for name in ids if (i := maker.index_of(category, name)) is not None}
    left = split_sizes(objects or total, own.train, own.test)
    refs: list[ObjectRef] = []
    i = 0
    while max(left.values()) > 0 or i <= max(numbers, default=-1):
        split = "test" if (i + 1) * own.test // total > i * own.test // total else "train"
        if take(left, split) or i in numbers:
            refs.append(replace(_one_made(named, maker, category, i), split=split))
        i += 1
    return refs


def _one_made(named: NamedSource, maker: Maker, category: str, index: int) -> ObjectRef:
    name = maker.object_id(category, index)
    return ObjectRef(
        named.name,
        category,
        name,
        "",
        named.folder / category / name,
        reader=named.file.reader,
        messy=named.file.messy,
        varied=named.file.varied,
    )
