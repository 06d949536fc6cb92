"""A source and a category to objects: which there are, in which split, and how each is read.

A source is a name under urdf_sources/ (or under the folder in $ARTICUGEN_SOURCES, which may also
just hold the models of a named source), or a path to any folder of URDFs.
"""

import importlib
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from articugen.errors import InvalidSource
from articugen.geometry import rotation_about, transform
from articugen.recipe_files import nearest
from articugen.records import ArticulatedObject
from articugen.sources.discovery import Found, any_models, layout, model_category, models_for
from articugen.sources.source_file import CategorySettings, SourceFile, read_source_file
from articugen.sources.splits import assign_splits, split_sizes

SOURCE_FOLDER = Path(__file__).resolve().parent.parent.parent / "urdf_sources"


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


def object_refs(
    source: str | Path, category: str, *, objects: int | None = None
) -> tuple[ObjectRef, ...]:
    """The objects of one category, in a fixed order.

    Args:
        source: a name, or the path of a folder or of one URDF. A `Path` is never taken for a name.
        category: one of the source's; of a plain folder of URDFs any name will do.
        objects: so many objects (fewer where there are fewer), with the ratio of the splits kept
            and, from two objects on, at least one of each split. Procedural sources make any
            number.

    Raises:
        InvalidSource: unknown source or category, or no object.
    """
    if objects is not None and objects < 1:
        raise InvalidSource(f"{objects} objects asked for; ask for one at least")
    named = _named(source)
    if named is None:
        refs = _folder_refs(Path(source), category)
    else:
        _category(named, category)
        refs = _named_refs(named, category, objects)
        if not refs:
            raise InvalidSource(
                f"no model of {category!r} under {named.folder}; {named.yaml.parent}/README.md says"
                " how to get them"
            )
    if objects is None or objects >= len(refs):
        return tuple(refs)
    tests = sum(ref.split == "test" for ref in refs)
    left = split_sizes(objects, len(refs) - tests, tests)
    return tuple(ref for ref in refs if _take(left, ref.split))


def _take(left: dict[str, int], split: str) -> bool:
    """Take one of `split` where any is left."""
    left[split] -= 1
    return left[split] >= 0


def settings(ref: ObjectRef) -> CategorySettings:
    """What the source says about the object's category.

    A folder whose models look like PartNet-Mobility's or Shape2Motion's gets that source's words.
    """
    named = _named(ref.source)
    if named is not None:
        return _category(named, ref.category)
    like = _source(layout(ref.location))
    return (
        like.file.categories.get(ref.category, CategorySettings()) if like else CategorySettings()
    )


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

    Raises:
        InvalidSource: anything amiss with its files.
    """
    named = _named(ref.source)
    reader = named.file.reader if named else layout(ref.location)
    own = settings(ref)
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
    for root in filter(None, (_own_sources(), SOURCE_FOLDER)):
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
    else:
        folder = path.parent
    return _Named(name, path, file, folder)


def _named(source: str | Path) -> _Named | None:
    """The named source, or None for the path of something that exists."""
    named = _source(source) if isinstance(source, str) else None
    if named is None and not Path(source).exists():
        known = sorted(_source_files())
        raise InvalidSource(
            f"no source {str(source)!r}{nearest(str(source), known)}; there are: "
            f"{', '.join(known)}, or the path of a folder of URDFs"
        )
    return named


def _category(named: _Named, category: str) -> CategorySettings:
    known = named.file.categories
    if category not in known:
        raise InvalidSource(
            f"source {named.name!r} has no category {category!r}{nearest(category, list(known))}; "
            f"there are: {', '.join(known)}"
        )
    return known[category]


def _info(name: str) -> SourceInfo:
    named = _source(name)
    assert named is not None
    categories = []
    for category in named.file.categories:
        splits = [ref.split for ref in _named_refs(named, category, None)]
        categories.append(CategoryInfo(category, splits.count("train"), splits.count("test")))
    return SourceInfo(
        name,
        named.file.origin,
        named.file.licence,
        named.file.frame,
        named.folder,
        tuple(categories),
    )


def _named_refs(named: _Named, category: str, objects: int | None) -> list[ObjectRef]:
    own = named.file.categories[category]
    if named.file.reader == "procedural":
        return _procedural_refs(named, category, objects)
    sorted_out = (named.folder / category).is_dir()
    base = named.folder / category if sorted_out else named.folder
    found = models_for(named.file.reader, base)
    if not sorted_out and named.file.reader == "partnet_mobility":
        found = [f for f in found if model_category(f.location) in own.model_cat]
    elif not sorted_out:
        found = []
    return _refs(found, own, named.name, category)


def _procedural_refs(named: _Named, category: str, objects: int | None) -> list[ObjectRef]:
    """Object i is always of the same split, however many are asked for."""
    own = named.file.categories[category]
    assert isinstance(own.train, int)
    assert isinstance(own.test, int)
    total = own.train + own.test
    left = split_sizes(objects or total, own.train, own.test)
    refs: list[ObjectRef] = []
    i = 0
    while max(left.values()) > 0:
        split = "test" if (i + 1) * own.test // total > i * own.test // total else "train"
        if _take(left, split):
            name = f"{category}_{i:04d}"
            refs.append(
                ObjectRef(named.name, category, name, split, named.folder / category / name)
            )
        i += 1
    return refs


def _refs(found: list[Found], own: CategorySettings, source: str, category: str) -> list[ObjectRef]:
    """Objects with their splits; those that the category's lists leave out are left out."""
    splits = assign_splits({f.object_id: f.group for f in found}, own.train, own.test)
    return [
        ObjectRef(source, category, f.object_id, splits[f.object_id], f.location, f.root)
        for f in found
        if f.object_id in splits
    ]


def _folder_refs(path: Path, category: str) -> list[ObjectRef]:
    if path.is_file():
        if path.suffix != ".urdf":
            raise InvalidSource(f"{path}: is not a .urdf file; name one, or a folder of them")
        found = [Found(path.stem, path, path.stem)]
    elif layout(path) != "urdf":
        found = [Found(path.name, path, path.name)]
    elif (path / category).is_dir():
        found = any_models(path / category)
    else:
        found = _of_category(any_models(path), path, category)
    if not found:
        raise InvalidSource(
            f"{path}: holds no URDF; put each model there as <id>.urdf or <id>/<any name>.urdf"
        )
    return _refs(found, CategorySettings(), str(path), category)


def _of_category(found: list[Found], path: Path, category: str) -> list[Found]:
    """Leave out PartNet-Mobility models of other categories, which SAPIEN ships side by side."""
    like = _source("partnet_mobility")
    mapped = like.file.categories.get(category, CategorySettings()).model_cat if like else ()
    wanted = {_plain(name) for name in (category, *mapped)}
    names = {
        f: model_category(f.location) for f in found if layout(f.location) == "partnet_mobility"
    }
    kept = [f for f in found if f not in names or _plain(names[f]) in wanted]
    if found and not kept:
        raise InvalidSource(
            f"{path}: its models are {', '.join(sorted(set(names.values())))}, none is a "
            f"{category!r}; put the ones you mean into {path / category}"
        )
    return kept


def _plain(name: str) -> str:
    return "".join(filter(str.isalnum, name)).lower()
