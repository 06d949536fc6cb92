"""The bundled objects: five categories of parametric models whose exact occupancy is known.

`write_object` makes one as an ordinary URDF with OBJ meshes; `truth.load_truth` reads its exact
solids back. An object depends on its id alone.
"""

import importlib
import re
from pathlib import Path

from articugen.content import MODELS
from articugen.errors import InvalidSource
from articugen.seeding import generator
from articugen.sources.procedural.cache import stored
from articugen.sources.procedural.model import Model
from articugen.sources.procedural.writer import URDF_NAME, write_model

CATEGORIES = ("drawer", "eyeglasses", "laptop", "oven", "washing_machine")


def object_id(category: str, index: int) -> str:
    """The id of a category's object number `index`, for instance "laptop_0003"."""
    return f"{category}_{index:04d}"


def build_model(category: str, object_id: str) -> Model:
    """The model of one object.

    Raises:
        InvalidSource: there is no such category, or it has no such object.
    """
    if category not in CATEGORIES:
        raise InvalidSource(
            f"procedural has no category {category!r}; it has {', '.join(CATEGORIES)}"
        )
    if not re.fullmatch(rf"{category}_[0-9]{{4,9}}", object_id):
        raise InvalidSource(f"procedural has no {object_id!r}; its ids are like {category}_0003")
    module = importlib.import_module(f"{__name__}.{category}")
    return module.build(generator(0, object_id, "procedural"))


def write_object(category: str, object_id: str, folder: Path, *, messy: bool = False) -> Path:
    """Write one object as `folder`, unless it is there as it should be, and return its URDF's path.

    Where `folder` cannot be written to, the URDF is elsewhere (see `cache.stored`).

    Args:
        folder: the object's own folder, for instance urdf_sources/procedural/laptop/laptop_0003.
        messy: the same object as real data come (see `writer.write_model`).

    Raises:
        InvalidSource: no such category or object.
        MachineFault: the disk is full or broken, or no memory is left.
    """

    def write(work: Path) -> None:
        model = build_model(category, object_id)
        write_model(model, work, object_id=object_id, category=category, messy=messy)

    identity = {"object_id": object_id, "category": category, "messy": messy}
    identity["content_version"] = MODELS.get(category, 0)
    return stored(folder, identity, write) / URDF_NAME
