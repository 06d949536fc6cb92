"""SketchMobility's models: a folder with mobility.urdf, annotation.json and meshes/.

They lie in `data/<source>/<category>/<id>/`. ArtiAtlas is read where it has been exported to the
same two files. annotation.json marks the layout and is not read: the URDF says all that is needed,
and the keys of the JSON are not published.
"""

from os.path import isfile
from pathlib import Path

from articugen.core.records import ArticulatedObject
from articugen.sources.folders import visible
from articugen.sources.refs import CategorySettings, Found, ObjectRef
from articugen.sources.urdf import load_urdf

_URDF = "mobility.urdf"


def detect(path: Path) -> Found | None:
    """Return the model that a folder with mobility.urdf and annotation.json is."""
    if isfile(path / _URDF) and isfile(path / "annotation.json"):
        return Found(path.name, path, path.name)
    return None


def find(base: Path) -> list[Found]:
    """Return the folders in `base` that are models."""
    return [found for folder in visible(base) if (found := detect(folder))]


def load(ref: ObjectRef, settings: CategorySettings) -> ArticulatedObject:
    """Read one; see `urdf.load_urdf`."""
    return load_urdf(
        ref.location / _URDF,
        object_id=ref.object_id,
        category=ref.category,
        source=ref.source,
        root=ref.location,
        T_world_root=settings.turn,
    )
