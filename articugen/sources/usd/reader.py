"""USD models: a file each, or a folder with one main file and its other layers, as ArtVIP's are.

ArtVIP's lie in `Articulated_objects/<group>/<category>/<id>/`, with `model_<id>.usd`, or another
name, and the layers that it names in `resource/`.
"""

import re
from functools import partial
from os.path import isdir
from pathlib import Path

from articugen.core.errors import InvalidSource
from articugen.core.records import ArticulatedObject
from articugen.meshes import read
from articugen.sources.folders import has_urdf, model_in, visible
from articugen.sources.refs import CategorySettings, Found, ObjectRef
from articugen.sources.usd.apart import apart
from articugen.sources.usd.layers import SUFFIXES
from articugen.sources.usd.model import read_model

LAYER_FOLDERS = frozenset(
    ("resource", "subusds", "configuration", "payloads", "materials", "textures")
)
"""Folders beside a main file, in small letters, in which its layers and textures lie."""

_DEEP = 3  # how far below a model's folder its layers may be examined as files of their own


def detect(path: Path) -> Found | None:
    """Return the model that a USD file or a folder with one main file is.

    A file is none by itself where it lies in the folder of layers of a model, or beside a URDF,
    whose mesh or copy it then is.
    """
    if isdir(path):
        return model_in(path) if main_file(path) else None
    if path.suffix.lower() not in SUFFIXES or _is_of_another(path):
        return None
    return Found(path.stem, path, path.stem)


def main_file(folder: Path) -> Path | None:
    """Return the file of a folder that is a model: of several the one that is called like the
    folder, or as data sets call it in all folders; a single one where layers lie in a folder beside
    it."""
    there = visible(folder)
    files = [path for path in there if path.suffix.lower() in SUFFIXES]
    if not files or has_urdf(folder):
        return None
    called = (folder.name.lower(), f"model_{folder.name.lower()}")
    for chosen in (
        [path for path in files if path.stem.lower() in called],
        [path for path in files if re.match(r"(model|mobility)(_|$)", path.stem.lower())],
        files if any(path.name.lower() in LAYER_FOLDERS for path in there) else [],
    ):
        if len(chosen) == 1 and not isdir(chosen[0]):
            return chosen[0]
    return None


def load(ref: ObjectRef, settings: CategorySettings) -> ArticulatedObject:
    """Read one; InvalidSource if anything is amiss with it, or OpenUSD is not installed. Else
    raises as `apart.apart`."""
    path = main_file(ref.location) if isdir(ref.location) else ref.location
    if path is None:
        raise InvalidSource(
            f"{ref.location}: has no main USD file; call it like the folder, and put its other "
            "layers into resource/"
        )
    model = partial(read_model, root=ref.root or path.parent, wanted=read.wanted())
    return ref.object_of(settings, *apart(model, path))


def _is_of_another(path: Path) -> bool:
    """Return whether a USD file is a layer or a mesh of a model that other files in reach show."""
    folder = path.parent
    reach = (folder, *folder.parents)[:_DEEP]
    layered = (f.name.lower() in LAYER_FOLDERS and main_file(f.parent) for f in reach)
    return has_urdf(folder) or has_urdf(folder.parent) or any(layered)
