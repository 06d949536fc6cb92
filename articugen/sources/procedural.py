"""The bundled objects as a source: made on demand, then read like any other URDF."""

import re
from pathlib import Path

from articugen import procedural
from articugen.core.records import ArticulatedObject
from articugen.sources.refs import CategorySettings, Found, ObjectRef
from articugen.sources.urdf import load_urdf

CATEGORIES = procedural.CATEGORIES


def detect(path: Path) -> Found | None:
    """None: what was written of them reads as any URDF does."""
    return None


def find(base: Path) -> list[Found]:
    """None: which there are is a matter of counting."""
    return []


def object_id(category: str, index: int) -> str:
    """The id of a category's object number `index`, for instance "laptop_0003"."""
    return f"{category}_{index:04d}"


def index_of(category: str, object_id: str) -> int | None:
    """The number of the object of that id, for the first ten thousand; None where it is no id."""
    found = re.fullmatch(rf"{re.escape(category)}_([0-9]{{4}})", object_id)
    return int(found[1]) if found else None


def load(ref: ObjectRef, settings: CategorySettings) -> ArticulatedObject:
    """Read one object, which is written first where it is not there yet."""
    path = procedural.write_object(
        ref.category, ref.object_id, ref.location, messy=ref.messy, varied=ref.varied
    )
    return load_urdf(
        path,
        object_id=ref.object_id,
        category=ref.category,
        source=ref.source,
        T_world_root=settings.turn,
    )
