"""Which models lie in a folder, in whatever layout people keep them."""

import json
import os
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from os.path import isdir, isfile
from pathlib import Path

from articugen.errors import InvalidSource
from articugen.sources.model_files import MAX_TEXT_BYTES, read_source, unreadable
from articugen.sources.source_file import Reader


@dataclass(frozen=True)
class Found:
    """An object on the disk.

    Attributes:
        location: the URDF file, or the model's folder for readers that want one.
        group: objects of one group, which may share meshes, stay in one split.
        root: the folder that the object's files may not leave; None means the reader's default.
        kinds: what its category is called: by its folder, then by its meta.json, where either says.
    """

    object_id: str
    location: Path
    group: str
    root: Path | None = None
    kinds: tuple[str, ...] = ()


def layout(location: Path) -> Reader:
    """Which reader a folder or file on the disk is for."""
    if isfile(location / "mobility.urdf") and isfile(location / "meta.json"):
        return "partnet_mobility"
    if isfile(location / "motion_attributes.json") and isdir(location / "part_objs"):
        return "shape2motion"
    return "urdf"


def sorted_models(reader: Reader, base: Path) -> list[Found]:
    """The objects of a source: in `base/<category>`, and those in `base` whose meta.json tells."""
    flat = [f for f in models_for(reader, base) if _told(f).kinds] if reader != "urdf" else []
    own = {f.location for f in flat}
    found = list(map(_told, flat))
    for folder in _visible(base):
        if isdir(folder) and folder not in own:
            found += [_told(f, folder.name) for f in models_for(reader, folder)]
    return found


def mixed_models(base: Path, is_category: Callable[[str], bool]) -> list[Found]:
    """Every object in a folder that no source.yaml describes, and what is known of its category.

    A folder in `base` is a category's where it holds models in a layout that we know, or is called
    like a category and holds two models or more.
    """
    found: list[Found] = []
    folders: set[Path] = set()
    for folder in _visible(base):
        if isdir(folder) and layout(folder) == "urdf":
            inside = any_models(folder)
            known = any(layout(f.location) != "urdf" for f in inside)
            if known or (len(inside) > 1 and is_category(folder.name)):
                folders.add(folder)
                found += [_told(f, folder.name) for f in inside]
    return [*map(_told, any_models(base, skip=folders)), *found]


def _told(found: Found, folder: str | None = None) -> Found:
    """The object with what `folder` and its meta.json call its category."""
    told = model_category(found.location)
    return replace(found, kinds=tuple(filter(None, (folder, told))))


def models_for(reader: Reader, base: Path) -> list[Found]:
    """The objects in `base` that `reader` can read."""
    if reader == "urdf":
        return urdf_models(base)
    marks = {"partnet_mobility": ["mobility.urdf"]}.get(
        reader, ["motion_attributes.json", "*.urdf"]
    )
    return [
        Found(folder.name, folder, folder.name)
        for folder in _visible(base)
        if any(isfile(found) for mark in marks for found in folder.glob(mark))
    ]


def any_models(base: Path, skip: Collection[Path] = ()) -> list[Found]:
    """Every object in `base`, whatever its layout."""
    known = {f for f in _visible(base) if f not in skip and layout(f) != "urdf"}
    found = [Found(folder.name, folder, folder.name) for folder in known]
    found += urdf_models(base, skip=known.union(skip))
    return sorted(found, key=lambda f: f.object_id)


def urdf_models(base: Path, skip: Collection[Path] = ()) -> list[Found]:
    """URDF files directly in `base`, and those up to three folders deep in a folder of it."""
    found: list[Found] = []
    for child in _visible(base):
        if _is_urdf(child):
            found.append(Found(child.stem, child, child.stem))
        elif isdir(child) and child not in skip:
            deep = [p for d in ("*", "*/*", "*/*/*") for p in sorted(child.glob(d)) if _is_urdf(p)]
            for urdf in deep:
                inside = urdf.relative_to(child).with_suffix("").parts
                name = child.name if len(deep) == 1 else ".".join((child.name, *inside))
                found.append(Found(name, urdf, child.name, root=child))
    return found


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


def _is_urdf(path: Path) -> bool:
    """Whether it is called like one; what is no regular file is refused when it is read."""
    return path.suffix.lower() == ".urdf" and not isdir(path)


def _visible(base: Path) -> list[Path]:
    if not isdir(base):
        return []
    try:
        return sorted(base / name for name in os.listdir(base) if not name.startswith("."))
    except OSError as error:
        raise unreadable(base, error) from error


def model_category(folder: Path) -> str:
    """The category that a PartNet-Mobility model's meta.json gives; "" where it gives none."""
    try:
        return str(json.loads(read_source(folder / "meta.json", MAX_TEXT_BYTES))["model_cat"])
    except (InvalidSource, ValueError, KeyError, TypeError, RecursionError):
        return ""
