"""A source and a category to objects: which there are, in which split, and how each is read.

A source is a name under urdf_sources/ (or under the folder in $ARTICUGEN_SOURCES, which may also
just hold the models of a named source), or a path to any folder of URDFs.
"""

import hashlib
import importlib
import os
import re
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from articugen.bundled import SOURCES, model_folder
from articugen.errors import ArticugenError, InvalidSource, machine_fault, printable
from articugen.geometry import rotation_about, transform
from articugen.recipe_files import nearest
from articugen.records import ArticulatedObject
from articugen.sources.categories import kinds_there, of_category, own_name, unknown
from articugen.sources.discovery import (
    Found,
    any_models,
    distinct,
    layout,
    mixed_models,
    model_category,
    sorted_models,
)
from articugen.sources.model_files import MAX_NAME_BYTES
from articugen.sources.source_file import CategorySettings, SourceFile, read_source_file
from articugen.sources.splits import assign_splits, split_sizes

_UNWRITABLE = re.compile("[\x00-\x1f\x7f\ud800-\udfff]")


@dataclass(frozen=True)
class ObjectRef:
    """Where one object comes from; cheap and picklable.

    Attributes:
        source: a source's name or the path of a folder.
        split: "train" or "test".
        location: the URDF file, or the model's folder for readers that want one.
        root: the folder that the object's files may not leave; None means the reader's default.
    """

    source: str
    category: str
    object_id: str
    split: str
    location: Path
    root: Path | None = None


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
    return [_info(name) for name in sorted(_source_files())]


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
) -> tuple[ObjectRef, ...]:
    """The objects of one category, in a fixed order.

    Args:
        source: a name, or the path of a folder or of one URDF. A `Path` is never taken for a name.
        category: one of the source's; of a plain folder of URDFs any name will do.
        objects: so many objects (fewer where there are fewer), with the ratio of the splits kept
            and, from two objects on, at least one of each split. Procedural sources make any
            number.
        ids: these objects alone, () means all.
        exclude: but not these. Neither changes anything of the other objects.

    Raises:
        InvalidSource: unknown source, category or id, or no object.
    """
    if objects is not None and objects < 1:
        raise InvalidSource(f"{objects} objects asked for; ask for one at least")
    refs = _chosen(_pool(source, category, objects, (*ids, *exclude)), category, ids, exclude)
    if objects is None or objects >= len(refs):
        return tuple(refs)
    tests = sum(ref.split == "test" for ref in refs)
    left = split_sizes(objects, len(refs) - tests, tests)
    return tuple(ref for ref in refs if _take(left, ref.split))


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


def _pool(
    source: str | Path, category: str, objects: int | None, ids: Collection[str]
) -> list[ObjectRef]:
    """All objects of a category; of a procedural one, so many and those called `ids`."""
    named = _named(source)
    if named is None:
        return _folder_refs(Path(source), category)
    own = _category(named, category)
    if named.file.reader == "procedural":
        return _procedural_refs(named, own, objects, ids)
    found = of_category(sorted_models(named.file.reader, named.folder), named.file, own)
    refs = _refs(found, named.file.categories[own], named.name, own, named.folder)
    if not refs:
        raise InvalidSource(
            f"no model of {own!r} under {named.folder}; {named.yaml.parent}/README.md says how to"
            " get them"
        )
    return refs


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


def _take(left: dict[str, int], split: str) -> bool:
    """Take one of `split` where any is left."""
    left[split] -= 1
    return left[split] >= 0


def settings(ref: ObjectRef) -> CategorySettings:
    """What the source says about the object's category.

    A folder whose models look like PartNet-Mobility's or Shape2Motion's gets that source's words;
    a model of another name those for what its meta.json calls it.
    """
    named = _named(ref.source)
    if named is not None:
        return named.file.categories[_category(named, ref.category)]
    like = _source(layout(ref.location))
    if like is None:
        return CategorySettings()
    names = (own_name(like.file, name) for name in (ref.category, model_category(ref.location)))
    own = next(filter(None, names), None)
    return like.file.categories[own] if own else CategorySettings()


def clips_to_limits(source: str) -> bool:
    """Whether joints stay inside the limits of the URDF where the recipe leaves it to the source:
    those of models that others made do."""
    named = _named(source)
    return named is None or named.file.clip_to_limits


def is_procedural(source: str) -> bool:
    """Whether the source's objects are made by our own generators."""
    named = _named(source)
    return named is not None and named.file.reader == "procedural"


def licence(source: str) -> str:
    """The licence of a source's models; "not stated" for a plain folder."""
    named = _named(source)
    return named.file.licence if named else "not stated"


def load(ref: ObjectRef) -> ArticulatedObject:
    """Read one object; a procedural one is written first where it is not there yet.

    Its digest covers what source.yaml says of how it stands and moves.

    Raises:
        InvalidSource: anything amiss with its files.
        MachineFault, MemoryError: the disk does not answer, or the like.
    """
    own = settings(ref)
    obj = _read(ref, own) if is_procedural(ref.source) else _read_distrustfully(ref, own)
    if own.said() == CategorySettings().said():
        return obj
    digest = hashlib.sha256(f"{obj.sha256} {own.said()}".encode()).hexdigest()
    return replace(obj, sha256=digest)


def digest(ref: ObjectRef) -> str:
    """The sha256 that `load` gives a sound object, without making anything of its meshes; of one
    whose meshes are unsound, some digest of its files.

    Raises:
        InvalidSource, MachineFault, MemoryError: as `load`.
    """
    from articugen.sources.meshes import hashed_only  # noqa: PLC0415 - slow to import

    with hashed_only():
        return load(ref).sha256


def _read_distrustfully(ref: ObjectRef, own: CategorySettings) -> ArticulatedObject:
    """A stranger's model: whatever a reader meets that nobody thought of is the model's fault, so
    that it takes no other object along."""
    name = printable(str(ref.location))
    if _UNWRITABLE.search(str(ref.location)):
        raise InvalidSource(
            f"{name}: its name has control characters or is not UTF-8; rename the file or folder"
        )
    if len(ref.object_id.encode()) > MAX_NAME_BYTES:
        raise InvalidSource(f"{name}: its id has more than {MAX_NAME_BYTES} bytes; shorten names")
    try:
        obj = _read(ref, own)
    except (ArticugenError, MemoryError):
        raise
    except Exception as error:
        raise machine_fault(error) or InvalidSource(
            f"{name}: cannot be read ({printable(f'{type(error).__name__}: {error}')[:200]}); leave"
            " it out and report it, please"
        ) from error
    return replace(obj, notes=tuple(map(printable, obj.notes)))


def _read(ref: ObjectRef, own: CategorySettings) -> ArticulatedObject:
    named = _named(ref.source)
    reader = named.file.reader if named else layout(ref.location)
    if reader in ("partnet_mobility", "shape2motion"):
        module = importlib.import_module(f"articugen.sources.{reader}")
        return module.load(ref.location, ref, own)
    from articugen.sources.urdf import load_urdf  # noqa: PLC0415 - slow to import, not always used

    path = ref.location
    if named and reader == "procedural":
        from articugen.sources import procedural  # noqa: PLC0415

        path = procedural.write_object(
            ref.category, ref.object_id, ref.location, messy=named.file.messy
        )
    return load_urdf(
        path,
        object_id=ref.object_id,
        category=ref.category,
        source=ref.source,
        root=ref.root,
        T_world_root=transform(rotation_about((0, 0, 1), np.radians(own.yaw_degrees))),
    )


@dataclass(frozen=True)
class _Named:
    """A source.yaml and the folder of its models."""

    name: str
    yaml: Path
    file: SourceFile
    folder: Path


def _source_files() -> dict[str, Path]:
    """Every source.yaml by the source's name; $ARTICUGEN_SOURCES goes first."""
    found: dict[str, Path] = {}
    for root in filter(None, (_own_sources(), SOURCES)):
        for path in sorted(root.glob("*/source.yaml")):
            found.setdefault(path.parent.name, path)
    return found


def _own_sources() -> Path | None:
    """The folder that $ARTICUGEN_SOURCES names, or None."""
    text = os.environ.get("ARTICUGEN_SOURCES")
    if not text:
        return None
    if not Path(text).is_dir():
        raise InvalidSource(f"ARTICUGEN_SOURCES={text} is not a folder; correct or unset it")
    return Path(text)


def _source(name: str) -> _Named | None:
    path = _source_files().get(name)
    if path is None:
        return None
    file = read_source_file(path)
    own = _own_sources()
    if file.path is not None:
        folder = path.parent / file.path
    elif own and (own / name).is_dir():
        folder = own / name
    elif file.reader == "procedural" and path.is_relative_to(SOURCES):
        folder = model_folder(name)
    else:
        folder = path.parent
    return _Named(name, path, file, folder)


def _named(source: str | Path) -> _Named | None:
    """The named source, or None for the path of something that exists."""
    named = _source(source) if isinstance(source, str) else None
    if named is None and _UNWRITABLE.search(str(source)):
        raise InvalidSource(
            f"{printable(str(source))}: its name has control characters or is not UTF-8; rename it"
        )
    if named is None and not os.path.exists(source):
        known = sorted(_source_files())
        raise InvalidSource(
            f"no source {str(source)!r}{nearest(str(source), known)}; there are: "
            f"{', '.join(known)}, or the path of a folder of URDFs"
        )
    return named


def _category(named: _Named, category: str) -> str:
    """The source's own name of a category."""
    own = own_name(named.file, category)
    if own is None:
        raise unknown(f"source {named.name!r}", category, list(named.file.categories))
    return own


def _categories_there(source: str | Path, named: _Named | None) -> list[str]:
    """The categories of which there are models, or can be made."""
    if named is None:
        return kinds_there(_mixed(Path(source)), _partnet())
    return [c.name for c in _info(named.name).categories if c.train + c.test]


def _meant(source: str | Path, named: _Named | None, name: str) -> str:
    """The category that somebody calls `name`. A folder of the user's own takes any name; where its
    models are PartNet-Mobility's, they are called as there."""
    if named is not None:
        return _category(named, name)
    own = own_name(_partnet(), name)
    path = Path(source)
    sorted_out = own and path.is_dir() and any(f.kinds for f in _mixed(path))
    return own if own and sorted_out else name


def _info(name: str) -> SourceInfo:
    named = _source(name)
    assert named is not None
    reader, models = named.file.reader, []
    if reader != "procedural":
        models = sorted_models(reader, named.folder)
    categories = []
    for category, own in named.file.categories.items():
        if reader == "procedural":
            refs = _procedural_refs(named, category, None, ())
        else:
            found = of_category(models, named.file, category)
            refs = _refs(found, own, name, category, named.folder)
        splits = [ref.split for ref in refs]
        categories.append(CategoryInfo(category, splits.count("train"), splits.count("test")))
    return SourceInfo(
        name,
        named.file.origin,
        named.file.licence,
        named.file.frame,
        named.folder,
        tuple(categories),
    )


def _procedural_refs(
    named: _Named, category: str, objects: int | None, ids: Collection[str]
) -> list[ObjectRef]:
    """The first objects, as many as the source has or as are asked for, and those named by `ids`.

    Object i is always of the same split, however many are asked for.
    """
    own = named.file.categories[category]
    assert isinstance(own.train, int)
    assert isinstance(own.test, int)
    total = own.train + own.test
    numbers = [int(name[-4:]) for name in ids if re.fullmatch(rf"{category}_[0-9]{{4}}", name)]
    left = split_sizes(objects or total, own.train, own.test)
    refs: list[ObjectRef] = []
    i = 0
    while max(left.values()) > 0 or i <= max(numbers, default=-1):
        split = "test" if (i + 1) * own.test // total > i * own.test // total else "train"
        if _take(left, split) or i in numbers:
            name = f"{category}_{i:04d}"
            refs.append(
                ObjectRef(named.name, category, name, split, named.folder / category / name)
            )
        i += 1
    return refs


def _refs(
    found: Sequence[Found], own: CategorySettings, source: str, category: str, base: Path
) -> list[ObjectRef]:
    """Objects with their splits; those that the category's lists leave out are left out."""
    found = sorted(distinct(found, base), key=lambda f: f.object_id)
    splits = assign_splits({f.object_id: f.group for f in found}, own.train, own.test)
    return [
        ObjectRef(source, category, f.object_id, splits[f.object_id], f.location, f.root)
        for f in found
        if f.object_id in splits
    ]


def _folder_refs(path: Path, category: str) -> list[ObjectRef]:
    if path.is_file():
        if path.suffix.lower() != ".urdf":
            raise InvalidSource(f"{path}: is not a .urdf file; name one, or a folder of them")
        found = [Found(path.stem, path, path.stem)]
    elif layout(path) != "urdf":
        found = [Found(path.name, path, path.name)]
    elif (path / category).is_dir():
        found = any_models(path / category)
    else:
        found = _of_category(_mixed(path), path, category)
    if not found:
        raise InvalidSource(
            f"{path}: holds no URDF; put each model there as <id>.urdf or <id>/<any name>.urdf"
        )
    return _refs(found, CategorySettings(), str(path), category, path)


def _mixed(path: Path) -> list[Found]:
    like = _partnet()
    return mixed_models(path, lambda name: own_name(like, name) is not None)


def _partnet() -> SourceFile | None:
    """PartNet-Mobility's categories, whose names are those that folders of models have."""
    like = _source("partnet_mobility")
    return like.file if like else None


def _of_category(found: list[Found], path: Path, category: str) -> list[Found]:
    """Leave out models that are known to be of other categories; any name will do for others."""
    kept = of_category(found, _partnet(), category)
    told = [f for f in found if f.kinds]
    if told and not kept:
        raise unknown(str(path), category, sorted({f.kinds[0] for f in told}))
    return kept + [f for f in found if not f.kinds]
