"""What is measured of instances whose votes are cast, by the paper's rules, and its means."""

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.core.geometry import points_on_triangles
from articugen.core.records import Floats, JointKind, dequantize, is_material
from articugen.core.schema import Instance
from articugen.core.seeding import generator
from articugen.evaluation import metrics
from articugen.evaluation.matched import (
    STILL,
    hung,
    joint_errors,
    matching,
    pose_errors,
    shown_joints,
)
from articugen.evaluation.metrics import DIAGONAL, NO_LABEL, Ints
from articugen.evaluation.reconstruction import Reconstruction, joints_of
from articugen.evaluation.results import Evaluation, JointError, JointState, Kind, Measures
from articugen.meshes.distances import distance
from articugen.meshes.marching_cubes import zero_level
from articugen.pictures.solids import shown

Instances = tuple[Instance, Instance]
Predicted = tuple[Reconstruction, Reconstruction]
Canonical = tuple[Instance, Reconstruction] | None

KINDS: dict[int, Kind] = {JointKind.REVOLUTE: "revolute", JointKind.PRISMATIC: "prismatic"}
DEGREES = (5.0, 10.0, 15.0, 20.0, 30.0)
LENGTHS = (0.025, 0.05, 0.1, 0.2)
"""Within how much a joint counts as right (Appendix E)."""

NEAR = 0.01
"""The threshold of the F-score, in the unit frame; the paper names none."""


@dataclass(frozen=True)
class Protocol:
    """Extent and protocol of an evaluation.

    Attributes:
        points: surface points a true part.
        label_poses: `canonical`, those of training objects vote; `all`, there is another label IoU
            by the votes of `states` as well.
        states: at most that many random states of an object count; None means all.
        surface_samples: points on the predicted surface for F-score and Chamfer-L1.
        occupancy: what the reconstruction IoU compares with: what is `visible`, or `material`.
    """

    points: int = 1000
    label_poses: str = "canonical"
    states: int | None = None
    surface_samples: int = 8192
    occupancy: str = "visible"


PAPER = Protocol()


@dataclass
class Tally:
    """Measures so far, by votes (P, K) that are cast already: those of canonical poses, and of all
    if those were asked, and what the rules leave out. `at` names the instance that the next
    measures are of."""

    protocol: Protocol
    votes: Floats
    all_votes: Floats | None = None
    objects: int = 0
    values: dict[tuple[str, int], dict[str, list[float]]] = field(default_factory=dict)
    joint_states: list[JointState] = field(default_factory=list)
    joint_errors: list[JointError] = field(default_factory=list)
    left_out: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.labels = metrics.labels_from(self.votes)
        self.dominant = metrics.dominant_labels(self.votes)
        by_all = self.votes if self.all_votes is None else self.all_votes
        self.labels_by_all = metrics.labels_from(by_all)

    def at(self, instance: Instance) -> None:
        self._row = self.values.setdefault((instance.object_id, instance.state_index), {})

    def take(self, other: "Tally") -> None:
        """Take the measures of other objects."""
        self.objects += other.objects
        self.values |= other.values
        self.joint_states += other.joint_states
        self.joint_errors += other.joint_errors
        self.left_out += other.left_out

    def add(self, **values: float) -> None:
        for name, value in values.items():
            self._row.setdefault(name, []).append(value)

    def add_label_iou(self, near: Ints, true: Ints, prefix: str = "") -> None:
        """Add the label IoU of points (n,) by their nearest predicted parts and their true ones."""
        self.add(**{f"{prefix}label_iou": _label_iou(self.labels, near, true)})
        if self.all_votes is not None and not prefix:
            self.add(label_iou_all_poses=_label_iou(self.labels_by_all, near, true))

    def measure(self, instance: Instance, predicted: Reconstruction, first: Canonical) -> None:
        """Add all that is measured of an instance; `first` is None of the canonical one itself."""
        matched = self._measure_shape(instance, predicted)
        self._note_joint_states(instance, predicted)
        if first is None:
            return
        both = (first[0], instance), (first[1], predicted)
        self._measure_motion(*both)
        self._measure_joints(*both)
        for errors in (pose_errors, joint_errors):
            for name, error in errors(*both, matched):
                self.add(**{name: error})

    def _measure_shape(self, instance: Instance, predicted: Reconstruction) -> Ints:
        """Return (K,) the predicted part that each true part is matched with."""
        near, true = nearest_parts(instance, predicted, self.protocol)
        matched, iou = matching(near, true, instance, predicted.parts)
        self.add_label_iou(near, true)
        self.add(matched_part_iou=float(np.nanmean(iou)))
        grid = instance.occupancy.get(len(predicted.occupied))
        if grid is not None:
            true_grid = is_material(grid) if self.protocol.occupancy == "material" else grid > 0
            self.add(
                reconstruction_iou=metrics.occupancy_iou(predicted.occupied, true_grid),
                voxels_label_iou=_voxels_label_iou(
                    grid, *surface_of(instance, self.protocol.points)
                ),
            )
        if predicted.whole is not None:
            self.add(no_surface=float(not len(predicted.whole)))
        self.add_surface(instance, predicted.whole)
        return matched

    def add_surface(self, instance: Instance, whole: Floats | None, prefix: str = "") -> None:
        """Add F-score and Chamfer-L1 of what views see of a predicted surface (F, 3, 3), if any."""
        if whole is None:
            return
        surface = dequantize(instance.surface_points)
        outer = whole[shown(whole)]  # the true points are on such surfaces
        to_predicted = np.minimum(distance(surface, outer), DIAGONAL)
        to_true = np.full(1, DIAGONAL)
        if len(outer):
            rng = generator(0, "evaluate", instance.object_id, instance.state_index)
            drawn = points_on_triangles(outer, self.protocol.surface_samples, rng=rng)[0]
            to_true = distance(drawn, np.repeat(surface[:, None], 3, axis=1))
        f_score = metrics.f_score(to_true, to_predicted, NEAR)
        self.add(**{
            f"{prefix}chamfer_l1": metrics.chamfer_l1(to_true, to_predicted),
            f"{prefix}f_score": 100.0 * f_score,
        })  # fmt: skip

    def _note_joint_states(self, instance: Instance, shape: Reconstruction) -> None:
        if shape.joints is None:
            return
        for j, kind in shown_joints(instance):
            parts = np.flatnonzero((self.dominant == j + 1) & (shape.joints.kind == kind))
            predicted = float(shape.joints.state[parts[0]]) if len(parts) else None
            true = float(instance.joint_state[j])
            self.joint_states.append(
                JointState(**_which(instance, j), true=true, predicted=predicted)
            )

    def _measure_motion(self, instances: Instances, predicted: Predicted) -> None:
        canonical, instance = instances
        points, true = surface_of(canonical, self.protocol.points)
        T_true = instance.part_motion
        still = np.tile(np.eye(4), (len(points), 1, 1))
        self.add(epe_nothing_moves=metrics.endpoint_error(points, true, T_true, still))
        for which, names in (("all", self.labels), ("dominant", self.dominant)):
            carrier = carriers(points, true, T_true, predicted[1], names)
            for reading, motion in motions(*predicted).items():
                T = np.where((carrier == NO_LABEL)[:, None, None], np.eye(4), motion[carrier])
                error = metrics.endpoint_error(points, true, T_true, T)
                self.add(**{f"epe_{reading}_{which}": error})

    def _measure_joints(self, instances: Instances, predicted: Predicted) -> None:
        """Appendix E: right where one part of the same kind is assigned, its error below a limit.

        Kinds of joints that are read off motions are known, not predicted, their pivots are not;
        what has hardly moved shows no direction.
        """
        canonical, instance = instances
        both = joints_of(*predicted, *hung(self.labels, instance))
        if both is None:
            return
        first, joints = both
        fitted = predicted[1].joints is None
        for j, kind in shown_joints(instance):
            parts = np.flatnonzero(self.labels == j + 1)
            same = len(parts) == 1 and int(first.kind[parts[0]]) == kind
            true_change = float(instance.joint_state[j] - canonical.joint_state[j])
            judged = {"state", "direction", "axis"}
            self.add(assigned_parts=float(len(parts)))
            if fitted:
                still = abs(true_change) < STILL[kind]
                self.add(direction_not_judged=100.0 * still)
                judged -= {"axis", "direction"} if still else {"axis"}
            else:
                self.add(type_accuracy=100.0 * same)
            state = direction = axis = None
            if same:
                i = parts[0]
                u, v = joints.direction[i], instance.joint_axis[j]
                state = abs(joints.change_since(first, i, v) - true_change)
                if "direction" in judged:
                    direction = metrics.angle_between_lines(u, v)
                if "axis" in judged and kind == JointKind.REVOLUTE:
                    axis = metrics.line_distance(joints.pivot[i], u, instance.joint_pivot[j], v)
            error = JointError(**_which(instance, j), state=state, direction=direction, axis=axis)
            self.joint_errors.append(error)
            self.add(**_right(error, judged))

    def evaluation(self) -> Evaluation:
        rows = self.values.values()
        names = dict.fromkeys(name for row in rows for name in row)
        values = {name: [v for row in rows for v in row.get(name, ())] for name in names}
        return Evaluation(
            means={name: float(np.mean(numbers)) for name, numbers in values.items()},
            votes=tuple(tuple(row) for row in self.votes.tolist()),
            labels=tuple(self.labels.tolist()),
            dominant=tuple(self.dominant.tolist()),
            objects=self.objects,
            instances=len(values.get("label_iou", [])),
            joint_states=tuple(self.joint_states),
            joint_errors=tuple(self.joint_errors),
            measures=tuple(
                Measures(object=name, state_index=index, values=_means(row))
                for (name, index), row in self.values.items()
            ),
        )


def _means(row: dict[str, list[float]]) -> dict[str, float]:
    """Return the means of an instance's measures, but for those that follow from its errors."""
    return {n: float(np.mean(values)) for n, values in row.items() if "_below_" not in n}


def surface_of(instance: Instance, count: int) -> tuple[Floats, Ints]:
    """Return ((n, 3), (n,)): up to `count` surface points of each part, and their parts."""
    part = instance.surface_part.astype(np.int64)
    kept = np.concatenate([np.flatnonzero(part == k)[:count] for k in np.unique(part)])
    return dequantize(instance.surface_points[kept]), part[kept]


def nearest_parts(
    instance: Instance, predicted: Reconstruction, protocol: Protocol
) -> tuple[Ints, Ints]:
    """Return the predicted part (n,) that is nearest to each surface point, and its true one
    (n,)."""
    points, true = surface_of(instance, protocol.points)
    return metrics.nearest_part_of(predicted, points), true


def _label_iou(labels: Ints, near: Ints, true: Ints) -> float:
    return metrics.label_iou(np.where(near == NO_LABEL, NO_LABEL, labels[near]), true)


def _voxels_label_iou(grid: NDArray[np.uint8], points: Floats, true: Ints) -> float:
    """Return the label IoU of a reconstruction that knows the true label of every voxel's centre,
    and nothing in between: what is thinner than a voxel is missing there."""
    parts = int(true.max(initial=0)) + 1
    surfaces = [zero_level(np.where(grid == k + 1, 1.0, -1.0)).triangles for k in range(parts)]
    part = np.repeat(np.arange(parts), [len(surface) for surface in surfaces])
    near = metrics.nearest_part(points, np.concatenate(surfaces), part, parts)
    return metrics.label_iou(near, true)


def motions(first: Reconstruction, second: Reconstruction) -> dict[str, Floats]:
    """Return the motions of parts (P, 4, 4) by each reading that the method allows: joint,
    transform."""
    readings = {"joint": first.joint_motion_to(second), "transform": first.motion_to(second)}
    return {name: motion for name, motion in readings.items() if motion is not None}


def carriers(
    points: Floats, true: Ints, T_true: Floats, predicted: Reconstruction, label: Ints
) -> Ints:
    """Return (n,) the predicted part of a point's own label that is nearest to where the point has
    moved; NO_LABEL if there is none.

    Args:
        points: (n, 3) in the canonical pose; `true` (n,) their parts, which T_true (K, 4, 4) moves.
    """
    posed = np.einsum("nij,nj->ni", T_true[true, :3, :3], points) + T_true[true, :3, 3]
    carrier = np.full(len(posed), NO_LABEL)
    for k in np.unique(true):
        rows, parts = np.flatnonzero(true == k), np.flatnonzero(label == k)
        if len(parts) == 1:
            carrier[rows] = parts[0]
        elif len(parts):
            far = [distance(posed[rows], predicted.triangles[predicted.part == i]) for i in parts]
            carrier[rows] = parts[np.argmin(far, axis=0)]
    return carrier


def _which(instance: Instance, joint: int) -> dict[str, Any]:
    """Return whose record it is, of a joint of an instance."""
    kind = KINDS[int(instance.joint_kind[joint])]
    place = {"object": instance.object_id, "state_index": instance.state_index}
    return {**place, "joint": joint, "kind": kind}


def _right(error: JointError, judged: set[str]) -> dict[str, float]:
    """Return 100 or 0: whether a joint is right by each quantity that is judged, within limits."""
    angle, length = (np.degrees(1.0), DEGREES), (1.0, LENGTHS)
    limits = {"state": length, "direction": angle}
    if error.kind == "revolute":
        limits = {"state": angle, "axis": length, "direction": angle}
    return {
        f"{error.kind}_{what}_below_{limit:g}": 100.0 * (value is not None and unit * value < limit)
        for what, (unit, thresholds) in limits.items()
        if what in judged
        for value in (getattr(error, what),)
        for limit in thresholds
    }
