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

    A folder in `base` is a category's where it holds models in a layout that we know, or is called
    like a category and holds two models or more.
    """
    for child in visible(base):
        own = readers.detect(child)
        if own is None and isdir(child):
            inside = any_models(child)
            known = any(f.reader != _PLAIN for f in inside)
            if known or (len(inside) > 1 and is_category(child.name)):
                yield from (replace(f, folder=child.name) for f in inside)
                continue
        yield from _models_at(child, own)


def any_models(base: Path) -> list[Found]:
    """Every object in `base`, whatever its layout."""
    return [f for child in visible(base) for f in _models_at(child, readers.detect(child))]


def distinct(found: Sequence[Found], base: Path) -> list[Found]:
    """The same objects; those that share a name are called by their whole path below `base`, with
    a ~ for each time that this, too, is taken."""
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


def _models_at(child: Path, own: Found | None) -> list[Found]:
    """The model that a file or folder is, known already, or the URDFs somewhere in it."""
    if own is not None:
        return [own]
    return [replace(f, reader=_PLAIN) for f in urdf_files.find_at(child)]
