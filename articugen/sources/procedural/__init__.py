"""The bundled objects: five categories of parametric models whose exact occupancy is known.

`write_object` makes one as an ordinary URDF with OBJ meshes; `truth.load_truth` reads its exact
solids back. An object depends on its id alone.
"""

import importlib
from pathlib import Path

from articugen.errors import InvalidSource
from articugen.seeding import generator
from articugen.sources.procedural.model import Model
from articugen.sources.procedural.writer import URDF_NAME, is_complete, write_model

CATEGORIES = ("drawer", "eyeglasses", "laptop", "oven", "washing_machine")


def object_id(category: str, index: int) -> str:
    """The id of a category's object number `index`, for instance "laptop_0003"."""
    return f"{category}_{index:04d}"


def build_model(category: str, object_id: str) -> Model:
    """The model of one object.

    Raises:
        InvalidSource: there is no such category.
    """
    if category not in CATEGORIES:
        raise InvalidSource(
            f"procedural has no category {category!r}; it has {', '.join(CATEGORIES)}"
        )
    module = importlib.import_module(f"{__name__}.{category}")
    return module.build(generator(0, object_id, "procedural"))


def write_object(category: str, object_id: str, folder: Path, *, messy: bool = False) -> Path:
    """Write one object as `folder`, unless it is already there, and return its URDF's path.

    Args:
        folder: the object's own folder, for instance urdf_sources/procedural/laptop/laptop_0003.
        messy: the same object as real data come (see `writer.write_model`).
    """
    if is_complete(folder, messy=messy):
        return folder / URDF_NAME
    model = build_model(category, object_id)
    return write_model(model, folder, object_id=object_id, category=category, messy=messy)
