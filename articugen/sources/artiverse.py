"""Artiverse's models: a folder with <id>.articulations.json and a URDF in urdf_w_collider/.

They lie in `data/<category>/<origin>/<id>/`. The URDF and its meshes are read; the annotation,
masses and materials beside it are not.
"""

from os.path import isdir, isfile
from pathlib import Path

from articugen.core.records import ArticulatedObject
from articugen.sources.refs import CategorySettings, Found, ObjectRef
from articugen.sources.urdf import load_shortest

_FOLDER = "urdf_w_collider"


def detect(path: Path) -> Found | None:
    """Return the model that a folder is by the names in it, though its URDF be missing."""
    if isfile(path / f"{path.name}.articulations.json") or isdir(path / _FOLDER):
        return Found(path.name, path, path.name, category_above=2)
    return None


def load(ref: ObjectRef, settings: CategorySettings) -> ArticulatedObject:
    """Read one; see `urdf.load_shortest`."""
    missing = "holds no URDF; get the model again, or leave it out"
    return load_shortest(ref, settings, ref.location / _FOLDER, missing)
