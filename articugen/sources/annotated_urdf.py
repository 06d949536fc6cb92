"""SketchMobility's models: a folder with mobility.urdf, annotation.json and meshes/.

They lie in `data/<source>/<category>/<id>/`. ArtiAtlas is read where it has been exported to the
same two files. annotation.json marks the layout and is not read: the URDF says all that is needed,
and the keys of the JSON are not published.
"""

from os.path import isfile
from pathlib import Path

from articugen.core.records import ArticulatedObject
from articugen.sources.refs import CategorySettings, Found, ObjectRef
from articugen.sources.urdf import load_object

_URDF = "mobility.urdf"


def detect(path: Path) -> Found | None:
    """Return the model that a folder with mobility.urdf and annotation.json is."""
    if isfile(path / _URDF) and isfile(path / "annotation.json"):
        return Found(path.name, path, path.name)
    return None


def load(ref: ObjectRef, settings: CategorySettings) -> ArticulatedObject:
    """Read one; see `urdf.load_urdf`."""
    return load_object(ref, settings, ref.location / _URDF, root=ref.location)
