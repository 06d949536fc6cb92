"""Pictures of what learners reconstruct, beside the truth."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from articugen.core.arrays import grouped
from articugen.core.colours import colour_of, part_colours, shaded
from articugen.core.geometry import area_vectors
from articugen.core.portable import norm
from articugen.core.records import JointKind, dequantize
from articugen.core.schema import Instance
from articugen.evaluation.evaluate import Reconstruct, objects_of, tested
from articugen.evaluation.reconstruction import Reconstruction, truth
from articugen.evaluation.results import Evaluation
from articugen.pictures.contact_sheet import evenly, opening
from articugen.pictures.layout import GREY, Caption, Row, in_columns, save, sheet
from articugen.pictures.portrait import best_azimuth, pooled, portrait, solid_portrait, tile_camera
from articugen.pictures.solids import ColouredMesh, arrow

Between = Callable[..., tuple[Sequence[Reconstruction], Sequence[Reconstruction]]]
"""Function of two instances and a number of `steps`: shapes, and states."""

STEPS = 6
OBJECTS = 3
INSTANCES = 16
"""Instances of each object that are read, the canonical one among them."""

EXAMPLE_STATES = 3
"""Of the one object that stands for its category."""

POOLED = 8
_GRAIN = (
    0.006
    * np.array([[1, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]])[
        [[0, 1, 3], [0, 2, 1], [0, 3, 2], [1, 2, 3]]
    ]
)
"""A tetrahedron (4, 3, 3) as which a point is drawn."""


@dataclass(frozen=True)
class Names:
    """True part that each predicted one stands for, -1 for none: by votes, and by most votes."""

    labels: Sequence[int]
    dominant: Sequence[int]

    @property
    def colours(self) -> list[str]:
        return part_colours(self.labels, self.dominant)

    def part_of(self, joint: int, shape: Reconstruction) -> int | None:
        """Return the predicted part of what a true joint moves: of several the one that is there in
        the shape, by its surface, as doors that are hinged left and right have a part each."""
        doubled = norm(area_vectors(shape.triangles))
        area = np.bincount(shape.part, doubled, minlength=shape.parts)
        parts = [i for i, label in enumerate(self.labels) if label == joint + 1]
        return max(parts, key=lambda i: (area[i], self.dominant[i] == joint + 1), default=None)


def by_opening(instances: Sequence[Instance]) -> list[Instance]:
    """Return the canonical instance, then the others by how far their joints have moved."""
    return sorted(instances, key=lambda i: opening(i.state_index, i.joint_state, i.joint_upper))


def draw_reconstructions(
    path: Path, data: Path, reconstruct: Reconstruct, result: Evaluation, *, on: Path | None = None
) -> None:
    """Draw some test objects of a data set, and below each what a trained model makes of it.

    Args:
        result: what `evaluate` has returned for this model.
        on: as `evaluate` took it.

    Raises:
        ArticugenError: `path` cannot be written.
    """
    model = (reconstruct, Names(result.labels, result.dominant))
    some = evenly([by_opening(i) for i in tested(data, on, INSTANCES - 1)], OBJECTS)
    azimuth = best_azimuth([instances[-1] for instances in some])
    rows = [
        reconstructions(o, [(f"{o[0].object_id}: reconstruction", *model)], azimuth) for o in some
    ]
    save(sheet([row for block in rows for row in block]), path)


def draw_interpolations(
    path: Path, data: Path, between: Between, result: Evaluation, *, on: Path | None = None
) -> None:
    """Draw shapes between two test objects in the pose of the one, and its states towards the
    other's pose.

    Args:
        result, on: as `draw_reconstructions` takes them.

    Raises:
        ArticugenError: `path` cannot be written.
    """
    objects = [by_opening(i) for i in tested(data, on, INSTANCES - 1)]
    one, other = objects[0][len(objects[0]) // 2], objects[-1][-1]
    clouds = [dequantize(instance.surface_points) for instance in (one, other)]
    names = Names(result.labels, result.dominant)
    shapes = between(one, other, steps=STEPS)
    points = np.concatenate([*clouds, *(f.triangles.reshape(-1, 3) for row in shapes for f in row)])
    camera = tile_camera(points, best_azimuth([other]))
    floor = float(clouds[0][:, 2].min())
    shares: list[Caption] = [[(f"{s:.0f} %", GREY)] for s in np.linspace(0.0, 100.0, STEPS)]
    titles = (f"{one.object_id} to {other.object_id}: shapes in one pose", "states of one shape")
    rows = [
        Row(title, [solid_portrait(solid_of(f, names), camera, floor) for f in row], shares)
        for title, row in zip(titles, shapes, strict=True)
    ]
    save(sheet(rows), path)


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
    reconstruct: Reconstruct
    result: Evaluation


def draw_examples(path: Path, examples: Sequence[Example]) -> None:
    """Draw one test object of each category: as it is, and what each model makes of it.

    Raises:
        ArticugenError: `path` cannot be written.
    """
    groups = grouped(((example.category, example.data), example) for example in examples)
    sheets = []
    for (category, data), group in groups.items():
        instances = by_opening(next(objects_of(data, "test", INSTANCES - 1)))
        models = [
            (e.title, e.reconstruct, Names(e.result.labels, e.result.dominant)) for e in group
        ]
        rows = reconstructions(
            instances, models, best_azimuth([instances[-1]]), states=EXAMPLE_STATES,
            title=category.replace("_", " "), pool=INSTANCES,
        )  # fmt: skip
        several = len(group) > 1
        sheets.append(in_columns([sheet([r]) for r in rows], 3) if several else sheet(rows))
    wide = len(sheets) <= EXAMPLE_STATES or len(examples) > len(groups)
    save(in_columns(sheets, 1 if wide else 2), path)


def reconstructions(
    instances: Sequence[Instance],
    models: Sequence[tuple[str, Reconstruct, Names]],
    azimuth: float,
    *,
    states: int = 4,
    title: str = "",
    pool: int = POOLED,
) -> list[Row]:
    """Draw a row of an object's true instances, and one of what each model makes of them.

    Arrows are joint axes; captions say how far joints have moved since the canonical pose.

    Args:
        instances: of the object, `by_opening`.
        models: the title of the row, the reconstructions and whose parts they are.
        title: instead of the object's name.
        pool: points of this many instances make the true surface: more are slower and smoother.
    """
    drawn = evenly(instances, states)
    clouds = [dequantize(instance.surface_points) for instance in drawn]
    shapes = [[reconstruct(instance) for instance in drawn] for _, reconstruct, _ in models]
    discs = pooled(evenly(instances, pool))
    parts = range(len(drawn[0].part_motion))
    axes = [_axes(instance, truth(instance), Names(parts, parts)) for instance in drawn]
    points = np.concatenate(
        clouds
        + [solid.triangles.reshape(-1, 3) for solid in (*axes, *(x for row in shapes for x in row))]
    )
    camera = tile_camera(points, azimuth)
    floor = float(min(cloud[:, 2].min() for cloud in clouds))
    true = [
        portrait(discs, i, camera, floor, beside=solid)
        for i, solid in zip(drawn, axes, strict=True)
    ]
    moved = [_caption(i, i.joint_state - drawn[0].joint_state) for i in drawn]
    rows = [Row(f"{title or drawn[0].object_id}: ground truth", true, moved)]
    for (name, _, names), some in zip(models, shapes, strict=True):
        pairs = list(zip(drawn, some, strict=True))
        predicted = [
            solid_portrait(solid_of(f, names), camera, floor, beside=_axes(i, f, names))
            for i, f in pairs
        ]
        moved = [_caption(i, _changes(i, some[0], f, names)) for i, f in pairs]
        rows.append(Row(name, predicted, moved))
    return rows


def solid_of(shape: Reconstruction, names: Names) -> ColouredMesh:
    """Return a reconstruction as it is drawn; points become tetrahedra."""
    triangles, part = shape.triangles, shape.part
    if shape.whole is None:  # of points alone
        triangles = (triangles[:, None] + _GRAIN).reshape(-1, 3, 3)
        part = part.repeat(len(_GRAIN))
    return ColouredMesh(triangles, part, names.colours)


def _changes(
    instance: Instance, first: Reconstruction, predicted: Reconstruction, names: Names
) -> Iterator[float | None]:
    """Yield how far each joint has moved by the prediction, positive about the true axis; None
    where no part stands for it, and nothing at all where the method knows no joints."""
    if first.joints is None or predicted.joints is None:
        return
    for j, kind in enumerate(instance.joint_kind.tolist()):
        i = names.part_of(j, first)
        if i is None or predicted.joints.kind[i] != kind:
            yield None
        else:
            yield predicted.joints.change_since(first.joints, i, instance.joint_axis[j])


def _caption(instance: Instance, changes: Iterable[float | None]) -> Caption:
    """Return each change after a dot in the colour of its part; a question mark where there is
    none."""
    texts = []
    for j, change in enumerate(changes):
        if change is None:
            text = "?"
        elif instance.joint_kind[j] == JointKind.REVOLUTE:
            text = f"{round(np.degrees(change))}°"
        else:
            text = f"{change * instance.scale:.2g}"
        texts.append((text, colour_of(j + 1)))
    return texts


def _axes(instance: Instance, shape: Reconstruction, names: Names) -> ColouredMesh:
    """Return the axes of the parts that joints move, as long as the true ones would be there:
    through the pivot and all of the part, or out of a sliding part."""
    points, part = dequantize(instance.surface_points), instance.surface_part
    joints, axes = shape.joints, []
    for j in range(len(instance.joint_kind)):
        i = names.part_of(j, shape)
        if joints is None or i is None or joints.kind[i] == JointKind.FIXED:
            continue
        turns, axis = joints.kind[i] == JointKind.REVOLUTE, joints.direction[i]
        near = points[part == j + 1] if (part == j + 1).any() else points
        through = joints.pivot[i] if turns else near.mean(0)
        if np.abs(near.mean(0) - through).max() > 2.0:  # far outside the picture
            continue
        along = (near - through) @ axis
        low, high = along.min() - 0.1 if turns else 0.0, along.max() + 0.14
        colour = shaded(colour_of(j + 1), -0.4)
        axes.append(arrow(through + low * axis, through + high * axis, 0.006, colour))
    return ColouredMesh.joined(axes)
