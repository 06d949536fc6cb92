"""Artiverse's models: a folder with <id>.articulations.json and a URDF in urdf_w_collider/.

They lie in `data/<category>/<origin>/<id>/`. The URDF and its meshes are read; the annotation,
masses and materials beside it are not.
"""

from dataclasses import replace
from os.path import isdir, isfile
from pathlib import Path

from articugen.core.errors import InvalidSource
from articugen.core.records import ArticulatedObject
from articugen.sources.folders import ending_in
from articugen.sources.refs import CategorySettings, Found, ObjectRef
from articugen.sources.urdf import load_object

_FOLDER = "urdf_w_collider"


def detect(path: Path) -> Found | None:
    """Return the model that a folder is by the names in it, though its URDF be missing."""
    if isfile(path / f"{path.name}.articulations.json") or isdir(path / _FOLDER):
        return Found(path.name, path, path.name, category_above=2)
    return None


def load(ref: ObjectRef, settings: CategorySettings) -> ArticulatedObject:
    """Read one; of several URDFs the one with the shortest name, which its notes say. Raises as
    `urdf.load_urdf`, and where there is none."""
    folder = ref.location / _FOLDER
    urdfs = ending_in(folder, ".urdf")
    if not urdfs:
        raise InvalidSource(f"{folder}: holds no URDF; get the model again, or leave it out")
    obj = load_object(ref, settings, urdfs[0], root=folder)
    if len(urdfs) == 1:
        return obj
    others = ", ".join(path.name for path in urdfs[1:])
    return replace(obj, notes=(*obj.notes, f"read from {urdfs[0].name}; left aside: {others}"))
