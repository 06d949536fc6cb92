"""Pictures of what a learner reconstructs: beside the truth, and between two shapes or states."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from articugen.core.colours import colour_of, part_colours, shaded
from articugen.core.records import Floats, JointKind, dequantize
from articugen.core.schema import Instance
from articugen.evaluation.reconstruction import Reconstruction
from articugen.pictures.layout import Caption, Row, sheet
from articugen.pictures.portrait import pooled, portrait, solid_portrait, tile_camera
from articugen.pictures.shading import Picture
from articugen.pictures.solids import ColouredMesh, arrow

Reconstruct = Callable[[Instance], Reconstruction]

POOLED = 8
_CUBE = np.array([[-0.5, -0.5, -0.5], [0.5, 0.5, 0.5]])
_GRAIN = (
    0.006
    * np.array([[1, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]])[
        [[0, 1, 3], [0, 2, 1], [0, 3, 2], [1, 2, 3]]
    ]
)
"""A tetrahedron (4, 3, 3) as which a point is drawn."""


@dataclass(frozen=True)
class Names:
    """Which true part each predicted one stands for, -1 for none: by votes, and by most votes."""

    labels: Sequence[int]
    dominant: Sequence[int]

    @property
    def colours(self) -> list[str]:
        return part_colours(self.labels, self.dominant)

    def part_of(self, joint: int, shape: Reconstruction) -> int | None:
        """Return the predicted part of what a true joint moves: of several the one that is there in
        the shape, by its surface, as doors that are hinged left and right have a part each."""
        corners = shape.triangles
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.bincount(shape.part, np.linalg.norm(across, axis=1), minlength=shape.parts)
        mine = [i for i, label in enumerate(self.labels) if label == joint + 1]
        return max(mine, key=lambda i: (area[i], self.dominant[i] == joint + 1), default=None)


def by_opening(instances: Sequence[Instance]) -> list[Instance]:
    """Return the canonical instance, then the others by how far their joints have moved."""

    def moved(i: Instance) -> float:
        limits = np.where(i.joint_upper == 0.0, 1.0, i.joint_upper)
        return -1.0 if i.state_index == 0 else float(np.abs(i.joint_state / limits).sum())

    return sorted(instances, key=moved)


def evenly(items: Sequence, count: int) -> list:
    """`count` of the items from the first to the last, or all of them."""
    return [items[round(i)] for i in np.linspace(0, len(items) - 1, min(count, len(items)))]


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

    Arrows are joint axes; captions tell how far joints have moved since the canonical pose.

    Args:
        instances: of the object, `by_opening`.
        models: the title of the row, the reconstructions and whose parts they are.
        title: in the place of the object's name.
        pool: points of this many instances make the true surface: more are slower and smoother.
    """
    drawn = evenly(instances, states)
    shapes = [[reconstruct(instance) for instance in drawn] for _, reconstruct, _ in models]
    discs = pooled(evenly(instances, pool))
    axes = [_true_axes(instance) for instance in drawn]
    points = np.concatenate(
        [dequantize(i.surface_points) for i in drawn]
        + [solid.triangles.reshape(-1, 3) for solid in (*axes, *(x for row in shapes for x in row))]
    )
    camera = tile_camera(points, azimuth)
    floor = float(min(dequantize(i.surface_points)[:, 2].min() for i in drawn))
    true = [
        portrait(discs, i, camera, floor, beside=solid)
        for i, solid in zip(drawn, axes, strict=True)
    ]
    moved = [_caption(i, i.joint_state - drawn[0].joint_state) for i in drawn]
    rows = [Row(f"{title or drawn[0].object_id}: ground truth", true, moved)]
    for (name, _, names), some in zip(models, shapes, strict=True):
        pairs = list(zip(drawn, some, strict=True))
        predicted = [
            solid_portrait(_solid(f, names), camera, floor, beside=_predicted_axes(i, f, names))
            for i, f in pairs
        ]
        moved = [_caption(i, _changes(i, some[0], f, names)) for i, f in pairs]
        rows.append(Row(name, predicted, moved))
    return rows


def _solid(found: Reconstruction, names: Names) -> ColouredMesh:
    triangles, part = found.triangles, found.part
    if found.whole is None:  # of points alone
        triangles = (triangles[:, None] + _GRAIN).reshape(-1, 3, 3)
        part = part.repeat(len(_GRAIN))
    return ColouredMesh(triangles, part, names.colours)


def _changes(
    instance: Instance, first: Reconstruction, found: Reconstruction, names: Names
) -> list[float | None]:
    """Return how far each joint has moved by the prediction, positive about the true axis; None
    where no part stands for it, and nothing at all where the method knows no joints."""
    changes: list[float | None] = []
    if first.joints is None or found.joints is None:
        return changes
    for j, kind in enumerate(instance.joint_kind.tolist()):
        i = names.part_of(j, first)
        if i is None or found.joints.kind[i] != kind:
            changes.append(None)
            continue
        changes.append(found.joints.change_since(first.joints, i, instance.joint_axis[j]))
    return changes


def _caption(instance: Instance, changes: Sequence[float | None] | Floats) -> Caption:
    """Each change after a dot in the colour of its part; a question mark where there is none."""
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


def _true_axes(instance: Instance) -> ColouredMesh:
    points, part = dequantize(instance.surface_points), instance.surface_part
    return ColouredMesh.joined([
        _axis(kind, pivot, axis, points, points[part == j + 1], colour_of(j + 1))
        for j, (kind, pivot, axis) in enumerate(
            zip(instance.joint_kind, instance.joint_pivot, instance.joint_axis, strict=True)
        )
    ])  # fmt: skip


def _predicted_axes(instance: Instance, found: Reconstruction, names: Names) -> ColouredMesh:
    """Return the axes of the parts that joints move, as long as the true ones would be there."""
    points, part = dequantize(instance.surface_points), instance.surface_part
    joints, axes = found.joints, []
    for j in range(len(instance.joint_kind)):
        i = names.part_of(j, found)
        if joints is None or i is None or joints.kind[i] == JointKind.FIXED:
            continue
        kind, pivot, direction = joints.kind[i], joints.pivot[i], joints.direction[i]
        axes.append(_axis(kind, pivot, direction, points, points[part == j + 1], colour_of(j + 1)))
    return ColouredMesh.joined(axes)


def _axis(
    kind: int, pivot: Floats, axis: Floats, points: Floats, of_part: Floats, colour: str
) -> ColouredMesh:
    """Through the pivot and all of the part, or out of a sliding part."""
    mine = of_part if len(of_part) else points
    through = pivot if kind == JointKind.REVOLUTE else mine.mean(0)
    along = (mine - through) @ axis
    low = along.min() - 0.1 if kind == JointKind.REVOLUTE else 0.0
    return arrow(
        through + low * axis, through + (along.max() + 0.14) * axis, 0.006, shaded(colour, -0.4)
    )


def interpolations(
    shapes: Sequence[Reconstruction],
    states: Sequence[Reconstruction],
    names: Names,
    instance: Instance,
    azimuth: float,
) -> Picture:
    """Two rows: the shape between two objects, and the joint states of one.

    Args:
        instance: the first object in the pose that is held: its joints and its scale.
    """
    middle = [f"{100 * share:.0f} %" for share in np.linspace(0.0, 1.0, len(shapes))[1:-1]]
    shares: list[Caption] = [[(text, "")] for text in ("one object", *middle, "another")]
    moved = [_caption(instance, _changes(instance, states[0], f, names)) for f in states]
    points = np.concatenate([f.triangles.reshape(-1, 3) for f in (*shapes, *states)])
    points = points if len(points) else _CUBE
    camera, floor = tile_camera(points, azimuth), float(points[:, 2].min())

    def row(title: str, found: Sequence[Reconstruction], captions: Sequence[Caption]) -> Row:
        pictures = [solid_portrait(_solid(f, names), camera, floor) for f in found]
        return Row(title, pictures, captions)

    return sheet([
        row("shape interpolated, pose held", shapes, shares),
        row("joint state interpolated, shape held", states, moved),
    ])  # fmt: skip
