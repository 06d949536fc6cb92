"""Which models lie in a folder, in whatever layout people keep them."""

import json
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from articugen.errors import InvalidSource
from articugen.sources.source_file import Reader


@dataclass(frozen=True)
class Found:
    """An object on the disk.

    Attributes:
        location: the URDF file, or the model's folder for readers that want one.
        group: objects of one group, which may share meshes, stay in one split.
        root: the folder that the object's files may not leave; None means the reader's default.
    """

    object_id: str
    location: Path
    group: str
    root: Path | None = None


def layout(location: Path) -> Reader:
    """Which reader a folder or file on the disk is for."""
    if (location / "mobility.urdf").is_file() and (location / "meta.json").is_file():
        return "partnet_mobility"
    if (location / "motion_attributes.json").is_file() and (location / "part_objs").is_dir():
        return "shape2motion"
    return "urdf"


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
        if any(found.is_file() for mark in marks for found in folder.glob(mark))
    ]


def any_models(base: Path) -> list[Found]:
    """Every object in `base`, whatever its layout."""
    known = {f for f in _visible(base) if layout(f) != "urdf"}
    found = [Found(folder.name, folder, folder.name) for folder in known]
    return sorted(found + urdf_models(base, skip=known), key=lambda f: f.object_id)


def urdf_models(base: Path, skip: Collection[Path] = ()) -> list[Found]:
    """URDF files directly in `base`, and those up to three folders deep in a folder of it."""
    found: list[Found] = []
    for child in _visible(base):
        if child.is_file() and child.suffix == ".urdf":
            found.append(Found(child.stem, child, child.stem))
        elif child.is_dir() and child not in skip:
            deep = [p for depth in ("", "*/", "*/*/") for p in sorted(child.glob(depth + "*.urdf"))]
            for urdf in deep:
                inside = urdf.relative_to(child).with_suffix("").parts
                name = child.name if len(deep) == 1 else ".".join((child.name, *inside))
                found.append(Found(name, urdf, child.name, root=child))
    for name, count in Counter(f.object_id for f in found).items():
        if count > 1:
            raise InvalidSource(f"{base}: {count} objects are called {name!r}; rename all but one")
    return found


def _visible(base: Path) -> list[Path]:
    if not base.is_dir():
        return []
    return sorted(path for path in base.iterdir() if not path.name.startswith("."))


def model_category(folder: Path) -> str:
    """The category that a PartNet-Mobility model's meta.json gives; "" where it gives none."""
    try:
        return str(json.loads((folder / "meta.json").read_bytes())["model_cat"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return ""
