"""Data sets to export, and what tests of exports compare with: boxes in closed form, made objects.

Boxes and fixtures are taken by name: `BOXES, rows = exports.BOXES, exports.rows`.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from instances import RICH

import articugen as ag
from articugen.export.items import Options
from articugen.export.parts import part_solids

BOXES = {"train": 2, "test": 1, "states": 2, "recipe": RICH}  # for `conftest.boxes`
MESHES = {"from_grids": True}


@pytest.fixture(scope="module")
def rows(boxes: Path) -> ag.DataSet:
    return ag.open(boxes)


@pytest.fixture(scope="module")
def exported(boxes: Path, tmp_path_factory: pytest.TempPathFactory):
    """The folder of the boxes in a format."""
    root, made = tmp_path_factory.mktemp("exported"), {}

    def export(to: str, **options) -> Path:
        key = (to, *sorted(options))
        if key not in made:
            made[key] = root / "-".join(key)
            done = ag.export(boxes, to, made[key], **options)
            assert done.left_out == ()
        return made[key]

    return export


def generated(
    category: str, out: Path, *, objects: int = 1, states: int = 0, views: int = 30, **sampling: Any
) -> Path:
    """Generate a small data set of a bundled category, and return its folder."""
    recipe = {"extends": "quick", "views": {"count": views, "resolution": 128},
              "sampling": {"grids": [16], **sampling}}  # fmt: skip
    ag.generate(category, out=out, recipe=recipe, objects=objects, states=states, jobs=0)
    return out / category


def name_of(row: ag.Row) -> str:
    return f"{row.object_id}_{row.state_index:04d}"


def motion_in_metres(row: ag.Row, part: int) -> np.ndarray:
    """(4, 4) of a part from the canonical pose, in the model's own frame."""
    T = np.array(row.parts[part].motion)
    T[:3, 3] = row.scale * T[:3, 3] + row.center - T[:3, :3] @ row.center
    return T


def state_in_metres(row: ag.Row) -> list[float]:
    return [joint.state for joint in row.joints]


def canonical_meshes(data: ag.DataSet, row: ag.Row) -> list[np.ndarray]:
    """The vertices of each part in metres, canonical pose."""
    solids = part_solids(data.of(row.object_id), Options(from_grids=True))
    return [row.to_metres(solid.mesh.vertices) for solid in solids]
