"""Which models lie in a folder, in whatever layout people keep them."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from os.path import isdir
from pathlib import Path

from articugen.sources import readers, urdf_files
from articugen.sources.folders import visible
from articugen.sources.refs import Found


def sorted_models(reader: str, base: Path) -> list[Found]:
    """The objects of a source: in `base/<category>`, and those in `base` that tell theirs."""
    found = [f for f in readers.find(reader, base) if f.category]
    own = {f.location for f in found}
    for folder in visible(base):
        if isdir(folder) and folder not in own:
            found += [replace(f, folder=folder.name) for f in readers.find(reader, folder)]
    return found


def mixed_models(base: Path, is_category: Callable[[str], bool]) -> Iterator[Found]:
    """Every object in a folder that no source.yaml describes, and what is known of its category.

    A folder below `base` is a category's where models in a layout that we know lie in it, as deep
    as the layout has it; a folder in `base` of other models where it is called like a category and
    holds two or more.
    """
    for child in visible(base):
        own = readers.detect(child)
        if own is None and isdir(child):
            inside = any_models(child)
            known = any(f.reader != _PLAIN for f in inside)
            if known or (len(inside) > 1 and is_category(child.name)):
                yield from (replace(f, folder=_category_folder(f, base)) for f in inside)
                continue
        yield from _models_at(child, own)


def any_models(base: Path) -> list[Found]:
    """Return every object in `base`, whatever its layout."""
    return [f for child in visible(base) for f in _models_at(child, readers.detect(child))]


def called(object_id: str, base: Path, reader: str) -> list[Found]:
    """Return the models in `base` whose file or folder has the name `object_id`, and they that id;
    others are not examined. None where only a listing can tell: an id with a dot may be the path
    of one of two that share a name, and another package's reader may name models as it likes.

    Args:
        reader: that of the source; "" where no source.yaml names one.
    """
    if not object_id or object_id != Path(object_id).name or "." in object_id:
        return []
    there = base / object_id
    children = [there] if isdir(there) else [c for c in visible(base) if c.stem == object_id]
    found: list[Found] = []
    for child in children:
        if reader:
            found += readers.find_at(reader, child)
        else:
            found += _models_at(child, readers.detect(child))
    return [f for f in found if f.object_id == object_id]


def distinct(found: Sequence[Found], base: Path) -> list[Found]:
    """Return the same objects; those that share a name are called by their whole path below `base`,
    with a ~ for each time that this, too, is taken."""
    count = Counter(f.object_id for f in found)
    renamed = [f for f in found if count[f.object_id] > 1]
    taken = {f.object_id for f in found if count[f.object_id] == 1}
    names: dict[Path, str] = {}
    for f in sorted(renamed, key=lambda f: f.location):
        name = ".".join(f.location.relative_to(base).parts)
        while name in taken:
            name += "~"
        taken.add(name)
        names[f.location] = name
    return [replace(f, object_id=names.get(f.location, f.object_id)) for f in found]


_PLAIN = "urdf"
"""The layout of what no reader knows: URDFs, wherever in a model's folder they are."""


_DEEP = 3
"""How many folders down data sets keep their models: data/<source>/<category>/<id>."""


def _models_at(child: Path, own: Found | None) -> list[Found]:
    """Return the model that a file or folder is, known already; those of layouts that we know
    somewhere in it; or the URDFs somewhere in it."""
    if own is not None:
        return [own]
    below = list(_models_below(child, _DEEP))
    if any(f.reader != _PLAIN for f in below):
        return below
    return [replace(f, reader=_PLAIN) for f in urdf_files.find_at(child)]


def _models_below(folder: Path, deep: int) -> Iterator[Found]:
    for child in visible(folder):
        own = readers.detect(child)
        if own is not None:
            yield own
        elif deep > 1 and isdir(child):
            yield from _models_below(child, deep - 1)


def _category_folder(found: Found, base: Path) -> str:
    """Return the name of the folder below `base` that has a model's category by its layout; ""
    where it would be `base` or above."""
    below = found.location.relative_to(base).parts
    if found.reader == _PLAIN:
        return below[0]
    return below[-1 - found.category_above] if len(below) > found.category_above else ""
