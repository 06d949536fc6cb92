"""The bundled objects: parametric models whose exact occupancy is known.

`build_model` makes one, `kit.writer.model_files` its files: an ordinary URDF with OBJ meshes;
`truth.truth_of` gives its exact solids. An object depends on its id, and whether it is a varied
one, alone. A category is a module of its own here and a line of `CATEGORIES`; docs/extending.md
shows how to add one.
"""

import importlib
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from articugen.core.errors import InvalidSource
from articugen.core.seeding import generator
from articugen.procedural.kit.model import Model
from articugen.procedural.kit.writer import URDF_NAME, write_model

CATEGORIES = {
    "box": {"train": 30, "test": 7},
    "drawer": {"train": 24, "test": 6},
    "eyeglasses": {"train": 35, "test": 7},
    "laptop": {"train": 73, "test": 13},
    "microwave": {"train": 30, "test": 7},
    "oven": {"train": 30, "test": 7},
    "refrigerator": {"train": 30, "test": 7},
    "washing_machine": {"train": 39, "test": 6},
}
"""By the name of the module whose `build` makes its models: how many objects each split has unless
more are asked for; of the PPD paper's five, as many as it had (its table of samples)."""


def build_model(category: str, object_id: str, *, varied: bool = False) -> Model:
    """Build the model of one object.

    Args:
        varied: as various as objects of others are: what the category's module builds by
            `build_varied`; some have none.

    Raises:
        InvalidSource: there is no such category, or it has no such object.
    """
    build = _builder(category, varied=varied) if category in CATEGORIES else None
    if build is None:
        source = "procedural_varied" if varied else "procedural"
        offered = [name for name in CATEGORIES if _builder(name, varied=varied)]
        raise InvalidSource(f"{source} has no category {category!r}; it has {', '.join(offered)}")
    if not re.fullmatch(rf"{category}_[0-9]{{4,9}}", object_id):
        raise InvalidSource(f"procedural has no {object_id!r}; its ids are like {category}_0003")
    return build(generator(0, object_id, "procedural"))


def _builder(category: str, *, varied: bool) -> Callable[[np.random.Generator], Model] | None:
    """Return the function that makes the models of a category; None of one that has no varied
    ones."""
    module = importlib.import_module(f"{__name__}.{category}")
    return getattr(module, "build_varied" if varied else "build", None)


def write_object(
    category: str, object_id: str, folder: Path, *, messy: int = 0, varied: bool = False
) -> Path:
    """Write one object as `folder`, for other programs; return its URDF's path.

    Args:
        messy: the same object as real data come (see `writer.model_files`).
        varied: another object, see `build_model`.

    Raises:
        InvalidSource: no such category or object.
        MachineFault: the folder cannot be written to.
    """
    model = build_model(category, object_id, varied=varied)
    write_model(model, folder, object_id=object_id, category=category, messy=messy)
    return folder / URDF_NAME
