"""The bundled objects as a source: made in memory on demand, then read like any other URDF."""

import re
from pathlib import Path

from articugen import procedural
from articugen.core.records import ArticulatedObject
from articugen.meshes.model_files import FilesInMemory
from articugen.procedural.kit.writer import URDF_NAME, model_files
from articugen.sources.refs import CategorySettings, Found, ObjectRef
from articugen.sources.urdf import load_object

CATEGORIES = procedural.CATEGORIES


def detect(path: Path) -> Found | None:
    """None: what was written of them reads as any URDF does."""
    return None


def object_id(category: str, index: int) -> str:
    """Return the id of a category's object number `index`, for instance "laptop_0003"."""
    return f"{category}_{index:04d}"


def index_of(category: str, object_id: str) -> int | None:
    """Return the number of the object of that id, for the first ten thousand; None where it is no
    id."""
    match = re.fullmatch(rf"{re.escape(category)}_([0-9]{{4}})", object_id)
    return int(match[1]) if match else None


def load(ref: ObjectRef, settings: CategorySettings) -> ArticulatedObject:
    """Make one object's files in memory and read them as those of any other URDF."""
    model = procedural.build_model(ref.category, ref.object_id, varied=ref.varied)
    contents = model_files(model, object_id=ref.object_id, messy=ref.messy)
    path = Path(ref.object_id, URDF_NAME)
    return load_object(ref, settings, path, files=FilesInMemory(contents))


def write(ref: ObjectRef, folder: Path) -> None:
    """Write one object's files, its exact solids among them, as `folder`; or MachineFault."""
    procedural.write_object(ref.category, ref.object_id, folder, messy=ref.messy, varied=ref.varied)
