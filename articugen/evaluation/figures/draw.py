"""The figures of an evaluation, as PNG: curves, joints, part fields, shapes, interpolations."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from articugen.core.colours import COLOURS
from articugen.core.records import Floats, JointKind, dequantize
from articugen.core.schema import Instance
from articugen.evaluation.evaluate import objects_of, tested
from articugen.evaluation.figures import plots
from articugen.evaluation.figures.shapes import (
    Names,
    by_opening,
    evenly,
    interpolations,
    reconstructions,
)
from articugen.evaluation.reconstruction import Reconstruction
from articugen.evaluation.results import Evaluation
from articugen.pictures.layout import in_columns, save, sheet
from articugen.pictures.portrait import best_azimuth

OBJECTS = 3
INSTANCES = 16
"""Of each object so many are read, the canonical one among them."""

EXAMPLE_STATES = 3
"""Of the one object that stands for its category."""

STEPS = 5
"""Of an interpolation, its ends included."""

SLICE = 256
"""Pixels along a slice of the fields."""

NEAR = 0.01
"""Surface points so near a slice are drawn in it."""

Opening = tuple[Floats, Floats, Floats]
"""Clouds (n, 3) of one object: closed, half open and wide open."""


@dataclass(frozen=True)
class Between:
    """Reconstructions from one shape to another, and from the closed to the widest joint state.

    Attributes:
        first: the index of the object whose pose is held, and whose joints move.
    """

    first: int
    shapes: Sequence[Reconstruction]
    states: Sequence[Reconstruction]


@dataclass(frozen=True)
class Drawable:
    """A trained model, as far as it can be drawn; what a method cannot do is None and is left out.

    Attributes:
        reconstruct: of a cloud (n, 3).
        part_fields: of a cloud and points (m, 3), the probability (P, m) that each part is there.
        interpolate: between two of these objects, in so many steps.
        parts: what each predicted part is called; by its number if not given.
        titles: of curves, by the name of a loss term or "held-out <name>"; the name if not given.
    """

    reconstruct: Callable[[Floats], Reconstruction]
    part_fields: Callable[[Floats, Floats], Floats] | None = None
    interpolate: Callable[[Sequence[Opening], int], Between] | None = None
    parts: Sequence[str] = ()
    titles: Mapping[str, str] = field(default_factory=dict)


def draw_figures(
    folder: Path,
    metrics: Sequence[dict[str, Any]],
    data: Path,
    model: Drawable,
    result: Evaluation,
    *,
    on: Path | None = None,
) -> Iterator[Path]:
    """Draw every figure into `folder` and yield its path when it is there.

    Args:
        metrics: the records of the run's metrics.jsonl, for the training curves.
        data: the data set whose test objects are drawn.
        result: what `evaluate` has returned for this model.
        on: as `evaluate` took it.

    Raises:
        ArticugenError: a file cannot be written.
    """
    names = Names(result.labels, result.dominant)
    objects = [by_opening(instances) for instances in tested(data, on, INSTANCES - 1)]
    path = folder / "curves.png"
    plots.curves(metrics, path, model.titles)
    yield path
    if result.joint_states:
        path = folder / "joints.png"
        plots.joints(result, COLOURS, path)
        yield path
    if model.part_fields:
        path = folder / "fields.png"
        _fields(path, model, _half_open(objects[0]), names)
        yield path
    path = folder / "reconstructions.png"
    some = evenly(objects, OBJECTS)
    azimuth = best_azimuth([instances[-1] for instances in some])
    rows = [
        reconstructions(o, [(f"{o[0].object_id}: reconstruction", _of(model), names)], azimuth)
        for o in some
    ]
    save(sheet([row for each in rows for row in each]), path)
    yield path
    if model.interpolate:
        path = folder / "interpolations.png"
        openings = [(_cloud(o[0]), _cloud(_half_open(o)), _cloud(o[-1])) for o in objects]
        found = model.interpolate(openings, STEPS)
        held = _half_open(objects[found.first])
        save(interpolations(found.shapes, found.states, names, held, azimuth), path)
        yield path


@dataclass(frozen=True)
class Example:
    """A trained model, and the data set of which it shows the first test object.

    Attributes:
        category, title: of its rows.
        result: what `evaluate` has returned for this model.
    """

    category: str
    title: str
    data: Path
    model: Drawable
    result: Evaluation


def draw_examples(path: Path, examples: Sequence[Example]) -> None:
    """Draw one test object of each category: as it is, and what each model makes of it.

    Raises:
        ArticugenError: `path` cannot be written.
    """
    groups: dict[tuple[str, Path], list[Example]] = {}
    for example in examples:
        groups.setdefault((example.category, example.data), []).append(example)
    sheets = []
    for (category, data), group in groups.items():
        instances = by_opening(next(objects_of(data, "test", INSTANCES - 1)))
        models = [
            (
                example.title,
                _of(example.model),
                Names(example.result.labels, example.result.dominant),
            )
            for example in group
        ]
        rows = reconstructions(
            instances, models, best_azimuth([instances[-1]]), states=EXAMPLE_STATES,
            title=category.replace("_", " "), pool=INSTANCES,
        )  # fmt: skip
        several = len(group) > 1
        sheets.append(in_columns([sheet([r]) for r in rows], 3) if several else sheet(rows))
    wide = len(sheets) <= EXAMPLE_STATES or len(examples) > len(groups)
    save(in_columns(sheets, 1 if wide else 2), path)


def _of(model: Drawable) -> Callable[[Instance], Reconstruction]:
    return lambda instance: model.reconstruct(_cloud(instance))


def _half_open(instances: Sequence[Instance]) -> Instance:
    return instances[len(instances) // 2]


def _cloud(instance: Instance) -> Floats:
    return dequantize(instance.surface_points)


def _fields(path: Path, model: Drawable, instance: Instance, names: Names) -> None:
    """A slice through all part fields, across the first joint's axis or along its slide."""
    assert model.part_fields
    normal, offset = cutting_plane(instance)
    across = [axis for axis in range(3) if axis != normal]
    at = (np.arange(SLICE) + 0.5) / SLICE - 0.5
    points = np.full((SLICE, SLICE, 3), offset)
    points[..., across[0]], points[..., across[1]] = np.meshgrid(at, at, indexing="ij")
    surface = _cloud(instance)
    fields = model.part_fields(surface, points.reshape(-1, 3))
    near = np.abs(surface[:, normal] - offset) < NEAR
    plots.slices(
        fields.reshape(-1, SLICE, SLICE),
        names.colours,
        model.parts or [f"part {i}" for i in range(len(fields))],
        (surface[near][:, across], instance.surface_part[near].astype(np.int64), COLOURS),
        ("xyz"[across[0]], "xyz"[across[1]]),
        path,
    )


def cutting_plane(instance: Instance) -> tuple[int, float]:
    """Return (k, c): the plane where coordinate k is c, on which the first joint's motion shows.

    Across a revolute axis, upright along a slide; through the middle of the parts that move.
    """
    if not len(instance.joint_kind):
        return 1, 0.0
    steepest = int(np.abs(instance.joint_axis[0]).argmax())
    sideways = 1 if steepest == 0 else 0
    normal = steepest if instance.joint_kind[0] == JointKind.REVOLUTE else sideways
    moving = dequantize(instance.surface_points)[instance.surface_part > 0, normal]
    return normal, float(np.median(moving)) if len(moving) else 0.0
