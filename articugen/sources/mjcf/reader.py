"""MJCF models: a .xml file each, or a folder with one main file and its meshes."""

import re
from os.path import isdir
from pathlib import Path

from articugen.core.errors import InvalidSource
from articugen.core.records import ArticulatedObject, Link
from articugen.meshes.model_files import MAX_TEXT_BYTES, ModelFiles, read_source
from articugen.sources.folders import ending_in, has_urdf
from articugen.sources.mjcf.model import Model
from articugen.sources.refs import CategorySettings, Found, ObjectRef

_ROOT = re.compile(rb"<mujoco[\s>]")


def detect(path: Path) -> Found | None:
    """Return the model that an MJCF file, or a folder with one, is; of several in a folder the one
    that is called like it. Files beside a URDF are its copies, those without bodies are parts."""
    if not isdir(path):
        copy = not _is_main(path) or has_urdf(path.parent) or has_urdf(path.parent.parent)
        return None if copy else Found(path.stem, path, path.stem)
    there = [] if has_urdf(path) else [file for file in ending_in(path, ".xml") if _is_main(file)]
    called = [file for file in there if file.stem.lower() == path.name.lower()]
    for chosen in (called, there):
        if len(chosen) == 1:
            return Found(path.name, chosen[0], path.name, root=path)
    return None


def load(ref: ObjectRef, settings: CategorySettings) -> ArticulatedObject:
    """Read one; InvalidSource if anything is amiss with it."""
    files = ModelFiles(ref.location.parent, ref.root)
    model = Model(ref.location, files)
    if not any(len(mesh.faces) for mesh in model.links.values()):
        raise InvalidSource(f"{ref.location}: shows no geom; add one, or name the main file")
    links = [Link(name, mesh) for name, mesh in model.links.items()]
    return ref.object_of(settings, links, model.joints, files.sha256(), model.notes)


def _is_main(path: Path) -> bool:
    """Return whether a file is MJCF with bodies, sound or not."""
    if path.suffix.lower() != ".xml" or isdir(path):
        return False
    try:
        text = read_source(path, MAX_TEXT_BYTES)
    except InvalidSource:
        return False
    return bool(_ROOT.search(text)) and (b"<worldbody" in text or b"<include" in text)
