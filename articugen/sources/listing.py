"""Models in a folder, in whatever layout people keep them, without what a source says of them."""

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from os.path import isdir
from pathlib import Path

from articugen.core.errors import InvalidSource
from articugen.core.records import JointKind
from articugen.core.yaml_files import unlisted
from articugen.sources import readers, urdf_files
from articugen.sources.folders import visible
from articugen.sources.refs import NO_CATEGORY, Found, ObjectRef
from articugen.sources.source_file import SourceFile, plain, unknown


def sorted_models(reader: str, base: Path) -> list[Found]:
    """Return a source's objects: in `base/<category>`, and those in `base` that state theirs."""
    models = [f for f in readers.find(reader, base) if f.category]
    places = {f.location for f in models}
    for folder in visible(base):
        if isdir(folder) and folder not in places:
            models += [replace(f, folder=folder.name) for f in readers.find(reader, folder)]
    return models


def of_category(models: Collection[Found], file: SourceFile, name: str) -> list[Found]:
    """Return the models in a folder of just that name, if there is one; else those whose folder or
    meta.json is called like the category."""
    exact = {plain(name), plain(file.own_name(name) or name)}
    exact_ones = [f for f in models if f.kinds and plain(f.kinds[0]) in exact]
    wanted = file.words(name)
    return exact_ones or [f for f in models if wanted & set(map(plain, f.kinds))]


def in_folder(path: Path, file: SourceFile, category: str) -> list[Found]:
    """Return the models of a category in a folder that no source.yaml describes, or the one in a
    file; where none states its category any name will do, else those that do not are of
    NO_CATEGORY. `file` says what categories are called.

    Raises:
        InvalidSource: there is none; models that state their category, all another.
    """
    single = readers.detect(path)
    if single:
        return [single]
    if path.is_file():
        raise InvalidSource(
            f"{path}: is no URDF, nor an MJCF or USD file of its own; name one, or a folder"
        )
    if (path / category).is_dir():
        models = any_models(path / category)
    else:
        every = list(mixed_models(path, file))
        others = [f for f in every if not f.kinds]
        known = sorted({f.kinds[0] for f in every if f.kinds})
        models = of_category(every, file, category)
        if not models and (not known or category == NO_CATEGORY):
            models = others
        elif not models:
            raise unknown(str(path), category, known + [NO_CATEGORY] * bool(others))
    if not models:
        raise InvalidSource(
            f"{path}: holds no URDF, MJCF or USD{_too_deep(path)}; put each model there as "
            "<id>.urdf, <id>.usd or <id>/<any name>.urdf"
        )
    return models


def _too_deep(base: Path) -> str:
    """Return words on a URDF that lies farther down than models are looked for, if there is one
    among the first things in a folder; no link is followed."""
    with suppress(RecursionError):  # at a tree of folders that is no data set
        for path in islice(base.rglob("*"), 100_000):
            if len(path.relative_to(base).parts) > _DEEP + 1 and urdf_files.detect(path):
                return f" up to {_DEEP} folders down in what is in it, though {path} lies deeper"
    return ""


def mixed_models(base: Path, file: SourceFile) -> Iterator[Found]:
    """Return every object in a folder that no source.yaml describes, and what is known of its
    category.

    A folder below `base` is a category's where models in a layout that we know lie in it, as deep
    as the layout has it; a folder in `base` of other models where it is called like a category and
    holds two or more.
    """
    for child in visible(base):
        model = readers.detect(child)
        if model is None and isdir(child):
            inside = any_models(child)
            known = any(f.reader != _PLAIN for f in inside)
            if known or (len(inside) > 1 and file.own_name(child.name) is not None):
                for f in inside:
                    below = ("", *f.location.relative_to(base).parts)
                    named = 1 if f.reader == _PLAIN else len(below) - 1 - f.category_above
                    yield replace(f, folder=below[max(named, 0)])
                continue
        yield from _models_at(child, model)


def any_models(base: Path) -> list[Found]:
    """Return every object in `base`, whatever its layout."""
    return [f for child in visible(base) for f in _models_at(child, readers.detect(child))]


def called(object_id: str, base: Path, reader: str) -> list[Found]:
    """Return the models in `base` whose file or folder has the name `object_id`, and they that id,
    by the source's `reader`, "" where no source.yaml names one; others are not examined. None where
    only a listing can say: an id with a dot may be the path of one of two that share a name, and
    another package's reader may name models as it likes."""
    if not object_id or object_id != Path(object_id).name or "." in object_id:
        return []
    there = base / object_id
    children = [there] if isdir(there) else [c for c in visible(base) if c.stem == object_id]
    models = (
        readers.find_at(reader, child) if reader else _models_at(child, readers.detect(child))
        for child in children
    )
    return [f for of_child in models for f in of_child if f.object_id == object_id]


def distinct(models: Sequence[Found], base: Path) -> list[Found]:
    """Return the same objects; those that share a name are called by their whole path below `base`,
    with a ~ for each time that this, too, is taken."""
    count = Counter(f.object_id for f in models)
    renamed = [f for f in models if count[f.object_id] > 1]
    taken = {f.object_id for f in models if count[f.object_id] == 1}
    names: dict[Path, str] = {}
    for f in sorted(renamed, key=lambda f: f.location):
        name = ".".join(f.location.relative_to(base).parts)
        while name in taken:
            name += "~"
        taken.add(name)
        names[f.location] = name
    return [replace(f, object_id=names.get(f.location, f.object_id)) for f in models]


KINDS = tuple(str(kind) for kind in JointKind if kind != JointKind.FIXED)
"""What `joints` may name, in URDF's words."""


def of_joints(refs: list[ObjectRef], joints: Collection[str], category: str) -> list[ObjectRef]:
    """Return the objects that have joints that move, all of them of the kinds `joints`, as
    `Source.objects` says; no mesh is read. InvalidSource if none is left, or a word is no kind."""
    for word in joints:
        if word not in KINDS:
            raise InvalidSource(unlisted("kind of joint", word, KINDS))
    left = [ref for ref in refs if not joints or _fits(ref, frozenset(joints))]
    if refs and not left:
        raise InvalidSource(
            f"no object of {category!r} has {' and '.join(sorted(set(joints)))} joints alone; name "
            f"more of {', '.join(KINDS)}"
        )
    return left


def _fits(ref: ObjectRef, wanted: frozenset[str]) -> bool:
    from articugen.meshes.read import wanting  # noqa: PLC0415 - slow to import

    try:
        with wanting("nothing"):
            obj = readers.load(ref)
    except InvalidSource:
        return True
    kinds = {str(joint.kind) for joint in obj.moving_joints}
    return bool(kinds) and kinds <= wanted


_PLAIN = "urdf"  # the layout of what no reader knows: URDFs, wherever in a model's folder they are


_DEEP = 3  # how many folders down data sets keep their models: data/<source>/<category>/<id>


def _models_at(child: Path, model: Found | None) -> list[Found]:
    """Return the model that a file or folder is, known already; those of layouts that we know
    somewhere in it; or the URDFs somewhere in it."""
    if model is not None:
        return [model]
    below = list(_models_below(child, _DEEP))
    if any(f.reader != _PLAIN for f in below):
        return below
    return [replace(f, reader=_PLAIN) for f in urdf_files.find_at(child)]


def _models_below(folder: Path, deep: int) -> Iterator[Found]:
    for child in visible(folder):
        model = readers.detect(child)
        if model is not None:
            yield model
        elif deep > 1 and isdir(child):
            yield from _models_below(child, deep - 1)
