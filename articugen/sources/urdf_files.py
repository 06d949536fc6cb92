"""Plain URDFs, as people keep them: a file a model, or somewhere in the model's own folder."""

from os.path import isdir, isfile
from pathlib import Path

from articugen.core.records import ArticulatedObject
from articugen.sources.refs import CategorySettings, Found, ObjectRef
from articugen.sources.urdf import load_object


def detect(path: Path) -> Found | None:
    """Return the model that a URDF file is; what is no regular file is refused when it is read."""
    if path.suffix.lower() == ".urdf" and not isdir(path):
        return Found(path.stem, path, path.stem)
    return None


def find_at(child: Path) -> list[Found]:
    """Return the model that a file is, or the models up to three folders deep in a folder."""
    if not isdir(child):
        model = detect(child)
        return [model] if model else []
    there = [p for d in ("*", "*/*", "*/*/*") for p in sorted(child.glob(d)) if detect(p)]
    deep = [p for p in there if "/." not in f"/{p.relative_to(child)}"]  # hidden ones are not meant
    models = []
    for urdf in deep:
        inside = urdf.relative_to(child).with_suffix("").parts
        name = child.name if len(deep) == 1 else ".".join((child.name, *inside))
        models.append(Found(name, urdf, child.name, root=child))
    return models


def load(ref: ObjectRef, settings: CategorySettings) -> ArticulatedObject:
    """Read one; see `urdf.load_urdf`. A file that was named by itself stands for the ROS package
    that it lies in."""
    package = (f for f in ref.location.absolute().parents if isfile(f / "package.xml"))
    top = ref.top or next(package, None)
    return load_object(ref, settings, ref.location, root=ref.root, top=top)
