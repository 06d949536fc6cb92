"""How exact instances are: what they store against the exact solids they were made from."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen import fusion
from articugen.core.geometry import voxel_centres
from articugen.core.recipe import Recipe
from articugen.core.records import Floats, Views, dequantize, is_material
from articugen.core.schema import Instance
from articugen.fusion.field import FusedField
from articugen.instance import preparing
from tests.benchmarks import cases
from tests.benchmarks.cases import VOXEL, Bools, Model, Scene

Row = dict[str, Any]

PROBES = (0.03, 0.06, 0.125, 0.25, 0.5, 1.0, 2.0)
"""Voxels of 1/256 to both sides of a surface point, where the field is asked for its sign."""

MATERIAL = ("material uniform", "material near", "material grid")

BEHIND = 1e-4
"""From a surface point to what is certainly inside, ten times the rounding of what is stored."""


def object_rows(model: Model, recipe: Recipe, states: int, points: int, seed: int) -> list[Row]:
    """A row of counts for each random state of an object; `total` adds them up."""
    prepared = preparing.prepare(model.obj, recipe.with_options(states=states), seed)
    rows = []
    for state in range(1, states + 1):
        made = cases.sampled(prepared, state, points)
        exact = cases.scene(model, prepared, state)
        fields = preparing.pose(prepared, state)[1]
        rows.append(
            {"category": model.ref.category, "messy": model.messy, "name": model.name,
             "state": state}
            | _occupancy(made, exact, prepared.views)
            | material(made, exact, fields)
            | _surface(made, exact, fields.whole)
        )  # fmt: skip
    return rows


def _occupancy(made: Instance, exact: Scene, views: Views) -> Row:
    """IoU counts (both, either) of uniform and near points; points of one part, rightly so."""
    row: Row = {"one_part": 0, "labelled": 0}
    for kind, stored, label in (
        ("uniform", made.uniform_points, made.uniform_label),
        ("near", made.near_points, made.near_label),
    ):
        points = dequantize(stored)
        row[kind] = counts(label > 0, exact.unseen(points, views))
        holds = exact.holds(points)
        asked = (holds.sum(axis=1) == 1) & (label > 0)
        row["one_part"] += int(asked.sum())
        row["labelled"] += int(np.sum(label[asked] == holds[asked].argmax(axis=1) + 1))
    return row


def material(made: Instance, exact: Scene, fields: fusion.PosedFields) -> Row:
    """IoU counts (both, either) of what is labelled as material with the solids, enclosed space
    left out: of uniform and near points, and at the centres of a grid of 64."""
    grid = voxel_centres(64)
    row: Row = {}
    for kind, points, label in (
        ("uniform", dequantize(made.uniform_points), made.uniform_label),
        ("near", dequantize(made.near_points), made.near_label),
        ("grid", grid, fields.labels(grid)),
    ):
        row[f"material {kind}"] = counts(
            is_material(label), exact.material(points, fields.part_motion)
        )
    return row


def _surface(made: Instance, exact: Scene, whole: FusedField | fusion.PosedSolids) -> Row:
    """How many surface points there are, how many have their part's exact solid behind them, how
    far they are at most from where the field changes its sign."""
    points, normals = dequantize(made.surface_points), made.surface_normals / 127.0
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    behind = exact.holds(points - BEHIND * normals)
    off = off_level(whole, points, normals)
    return {
        "surface": len(points),
        "on_own_part": int(np.sum(behind[np.arange(len(points)), made.surface_part])),
        "on_level": int(np.sum(off <= 0.5)),
        "off_level": float(off.max()),
    }


def off_level(field: FusedField | fusion.PosedSolids, points: Floats, normals: Floats) -> Floats:
    """(n,) no more than so far, in voxels, is each point from a change of the field's sign.

    The sign is asked at the point and at `PROBES` to both sides; two that differ have a change
    between them. inf where all agree.
    """
    off = np.full(len(points), np.inf)
    here = field.is_free(points)
    left = np.arange(len(points))
    for voxels in PROBES:
        step = voxels * VOXEL * normals[left]
        before, after = field.is_free(points[left] + step), field.is_free(points[left] - step)
        changes = (before != here[left]) | (after != here[left])
        off[left[changes]] = voxels
        left = left[~changes]
    return off


def counts(ours: Bools, truth: Bools) -> NDArray[np.int64]:
    """(2,) how many are in both, and in either: their ratio is the IoU."""
    return np.array([np.sum(ours & truth), np.sum(ours | truth)])


def total(rows: Iterable[Row]) -> Row:
    """The figures of many rows: IoU of all points together and of the worst row, shares."""
    rows = list(rows)
    figures: Row = {"instances": len(rows)}
    for kind in ("uniform", "near", *MATERIAL):
        both, either = np.sum([row[kind] for row in rows], axis=0)
        figures[kind] = float(both / either)
        figures[f"worst {kind}"] = float(min(row[kind][0] / row[kind][1] for row in rows))
    for share, part, whole in (
        ("labels", "labelled", "one_part"),
        ("own part", "on_own_part", "surface"),
        ("level", "on_level", "surface"),
    ):
        figures[share] = sum(row[part] for row in rows) / sum(row[whole] for row in rows)
    figures["off level"] = max(row["off_level"] for row in rows)
    return figures
