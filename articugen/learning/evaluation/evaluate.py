"""The paper's evaluation over the test objects of a data set; nothing is dropped.

Labels are given to predicted parts by votes of training instances (Appendix C). A test instance
without any predicted surface scores a label IoU of 0; a true part without a predicted one is taken
not to move; distances to what is missing count as the unit cube's diagonal.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.errors import CorruptShard
from articugen.learning.evaluation import metrics
from articugen.learning.evaluation.metrics import NO_LABEL, Ints
from articugen.learning.evaluation.surfaces import Floats, distance, sample
from articugen.learning.ppd.reconstruct import PRISMATIC, REVOLUTE, Reconstruction
from articugen.records import Instance, dequantize, is_material
from articugen.seeding import generator
from articugen.store.manifest import Manifest
from articugen.store.shards import open_shard

Reconstruct = Callable[[Instance], Reconstruction]
_Rows = list[dict[str, Any]]

DIAGONAL = float(np.sqrt(3.0))
KINDS = {REVOLUTE: "revolute", PRISMATIC: "prismatic"}
STATE_DEGREES = (5.0, 10.0, 15.0, 20.0, 30.0)
STATE_LENGTHS = (0.025, 0.05, 0.1, 0.2)
DIRECTION_DEGREES = (5.0, 10.0, 15.0, 20.0, 30.0)
AXIS_LENGTHS = (0.025, 0.05, 0.1, 0.2)


@dataclass(frozen=True)
class Protocol:
    """How much is looked at.

    Attributes:
        points: surface points a true part.
        label_poses: whether the canonical poses of training objects vote, or all of them.
        label_objects, test_states: at most so many training objects, and random states of a test
            object; None means all.
        f_threshold: of the F-score, in the unit frame; the paper names none.
        surface_samples: points on the predicted surface for F-score and Chamfer-L1.
        occupancy: what the reconstruction IoU compares with, as `DataSettings.occupancy`.
    """

    points: int = 1000
    label_poses: str = "canonical"
    label_objects: int | None = None
    test_states: int | None = None
    f_threshold: float = 0.01
    surface_samples: int = 8192
    occupancy: str = "visible"


@dataclass
class Tally:
    """Every measured number, by its name; what was predicted of each joint."""

    values: dict[str, list[float]] = field(default_factory=dict)
    joint_states: _Rows = field(default_factory=list)
    joint_errors: _Rows = field(default_factory=list)

    def add(self, **values: float) -> None:
        for name, value in values.items():
            self.values.setdefault(name, []).append(value)

    def means(self) -> dict[str, float]:
        return {name: float(np.mean(values)) for name, values in self.values.items()}


def evaluate(
    data: Path,
    reconstruct: Reconstruct,
    protocol: Protocol = Protocol(),
    *,
    category: str | None = None,
    on_object: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Evaluate on the test objects of a data set.

    Args:
        category: what the data set must be of.

    Returns:
        `means` of every metric over all test instances, `votes` (P, K), `labels` and `dominant`
        of the predicted parts, how many `objects` and `instances` there were; `joint_states`,
        what the dominant parts say of every joint, and the `joint_lines` through them;
        `joint_errors`, null where the joint failed. There is a `reconstruction_iou` where the data
        set has a grid of the reconstructions' resolution.

    Raises:
        CorruptShard: the data set has no training or no test object, or is of another category.
    """
    check_splits(data, category)
    table = label_votes(data, reconstruct, protocol, on_object)
    label, dominant = metrics.labels_from(table), metrics.dominant_labels(table)
    tally, objects = Tally(), 0
    for instances in objects_of(data, "test", protocol.test_states):
        canonical, *posed = instances
        objects += 1
        first = reconstruct(canonical)
        _shape_metrics(tally, canonical, first, label, protocol)
        tally.joint_states += _joint_states(canonical, first, dominant)
        for instance in posed:
            found = reconstruct(instance)
            _shape_metrics(tally, instance, found, label, protocol)
            tally.joint_states += _joint_states(instance, found, dominant)
            _motion_metrics(tally, (canonical, instance), (first, found), label, dominant, protocol)
        on_object(canonical.object_id)
    return {
        "means": tally.means(),
        "votes": table.tolist(),
        "labels": label.tolist(),
        "dominant": dominant.tolist(),
        "objects": objects,
        "instances": len(tally.values["label_iou"]),
        "joint_states": tally.joint_states,
        "joint_lines": _joint_lines(tally.joint_states),
        "joint_errors": tally.joint_errors,
    }


def check_splits(data: Path, category: str | None) -> None:
    """Raise CorruptShard where the data set cannot be evaluated on, before anything is computed."""
    manifest = Manifest.read(data)
    if category is not None and manifest.category != category:
        raise CorruptShard(f"{data}: holds {manifest.category}, the model is of {category}")
    for split in ("train", "test"):
        if not any(o.key.split == split for o in manifest.objects):
            raise CorruptShard(
                f"{data}: has no object in split {split!r}; make one with more objects"
            )


def label_votes(
    data: Path, reconstruct: Reconstruct, protocol: Protocol, on_object: Callable[[str], None]
) -> Floats:
    """(P, K) the votes of the training instances, summed."""
    states = 0 if protocol.label_poses == "canonical" else None
    table: Floats | None = None
    for count, instances in enumerate(objects_of(data, "train", states)):
        if count == protocol.label_objects:
            break
        for instance in instances:
            points, true = surface_of(instance, protocol.points)
            found = reconstruct(instance)
            near = metrics.nearest_part(points, found.triangles, found.part, found.parts)
            ballot = metrics.votes(near, true, found.parts, len(instance.part_motion))
            table = ballot if table is None else table + ballot
        on_object(instances[0].object_id)
    assert table is not None  # check_splits has seen to it
    return table


def objects_of(data: Path, split: str, states: int | None) -> Iterator[list[Instance]]:
    """The instances of each object of a split, the canonical one first."""
    names = sorted({o.shard for o in Manifest.read(data).objects if o.key.split == split})
    for name in names:
        with open_shard(data / name) as shard:
            index, ids = shard.read("state_index"), np.array(shard.object_ids())
            for object_id in dict.fromkeys(ids.tolist()):
                rows = np.flatnonzero(ids == object_id)
                rows = rows[np.argsort(index[rows])]
                if index[rows[0]] != 0:
                    raise CorruptShard(f"{data / name}: {object_id} has no canonical instance")
                wanted = rows if states is None else rows[: 1 + states]
                yield [shard.instance(int(row)) for row in wanted]


def surface_of(instance: Instance, count: int) -> tuple[Floats, Ints]:
    """((n, 3), (n,)): up to `count` surface points of each part, and their parts."""
    part = instance.surface_part.astype(np.int64)
    kept = np.concatenate([np.flatnonzero(part == k)[:count] for k in np.unique(part)])
    return dequantize(instance.surface_points[kept]), part[kept]


def _shape_metrics(
    tally: Tally, instance: Instance, found: Reconstruction, label: Ints, protocol: Protocol
) -> None:
    points, true = surface_of(instance, protocol.points)
    near = metrics.nearest_part(points, found.triangles, found.part, found.parts)
    named = np.where(near == NO_LABEL, NO_LABEL, label[near])
    tally.add(label_iou=metrics.label_iou(named, true))
    grid = instance.occupancy.get(len(found.occupied))
    if grid is not None:
        true_grid = is_material(grid) if protocol.occupancy == "material" else grid > 0
        tally.add(reconstruction_iou=metrics.occupancy_iou(found.occupied, true_grid))
    surface = dequantize(instance.surface_points)
    to_predicted = np.minimum(distance(surface, found.whole), DIAGONAL)
    to_true = np.full(1, DIAGONAL)
    if len(found.whole):
        rng = generator(0, "evaluate", instance.object_id, instance.state_index)
        drawn = _points_on(found.whole, protocol.surface_samples, rng)
        to_true = distance(drawn, np.repeat(surface[:, None], 3, axis=1))
    tally.add(
        chamfer_l1=metrics.chamfer_l1(to_true, to_predicted),
        f_score=100.0 * metrics.f_score(to_true, to_predicted, protocol.f_threshold),
        no_surface=float(not len(found.whole)),
    )


def _points_on(triangles: Floats, count: int, rng: np.random.Generator) -> Floats:
    if np.ptp(triangles, axis=1).max() == 0.0:  # stored points in the place of triangles
        return triangles[:, 0]
    return sample(triangles, count, rng)


def _motion_metrics(
    tally: Tally,
    instances: tuple[Instance, Instance],
    found: tuple[Reconstruction, Reconstruction],
    label: Ints,
    dominant: Ints,
    protocol: Protocol,
) -> None:
    canonical, instance = instances
    points, true = surface_of(canonical, protocol.points)
    T_true = instance.part_motion
    still = np.tile(np.eye(4), (len(points), 1, 1))
    tally.add(epe_nothing_moves=metrics.endpoint_error(points, true, T_true, still))
    posed = np.einsum("nij,nj->ni", T_true[true, :3, :3], points) + T_true[true, :3, 3]
    motions = {
        "joint": found[0].joint_motion_to(found[1]),
        "transform": found[0].motion_to(found[1]),
    }
    for which, names in (("all", label), ("dominant", dominant)):
        carrier = carriers(posed, true, found[1], names)
        for reading, motion in motions.items():
            T = np.where((carrier == NO_LABEL)[:, None, None], np.eye(4), motion[carrier])
            error = metrics.endpoint_error(points, true, T_true, T)
            tally.add(**{f"epe_{reading}_{which}": error})
    for j, kind in enumerate(canonical.joint_kind.tolist()):
        _joint_metrics(tally, instances, found, np.flatnonzero(label == j + 1), j, kind)


def carriers(posed: Floats, true: Ints, found: Reconstruction, label: Ints) -> Ints:
    """(n,) the predicted part of a point's own label that is nearest to it; NO_LABEL if none is."""
    carrier = np.full(len(posed), NO_LABEL)
    for k in np.unique(true):
        mine, parts = np.flatnonzero(true == k), np.flatnonzero(label == k)
        if len(parts) == 1:
            carrier[mine] = parts[0]
        elif len(parts):
            far = [distance(posed[mine], found.triangles[found.part == i]) for i in parts]
            carrier[mine] = parts[np.argmin(far, axis=0)]
    return carrier


def _joint_states(instance: Instance, found: Reconstruction, dominant: Ints) -> _Rows:
    """Of every joint its true state and, as predicted, that of the dominant part; null if that is
    of another kind."""
    rows: _Rows = []
    for j, kind in enumerate(instance.joint_kind.tolist()):
        parts = [i for i in np.flatnonzero(dominant == j + 1) if found.kind[i] == kind]
        rows.append({
            "object": instance.object_id, "state_index": instance.state_index, "joint": j,
            "kind": KINDS[kind], "true": float(instance.joint_state[j]),
            "predicted": float(found.state[parts[0]]) if parts else None,
        })  # fmt: skip
    return rows


def _joint_lines(states: _Rows) -> _Rows:
    """Of each joint the line through its predicted states over the true ones; null if none is."""
    lines: _Rows = []
    for joint, kind in sorted({(row["joint"], row["kind"]) for row in states}):
        rows = [r for r in states if (r["joint"], r["kind"]) == (joint, kind)]
        seen = [(r["true"], r["predicted"]) for r in rows if r["predicted"] is not None]
        line = metrics.line_through(*np.array(seen, np.float64).reshape(-1, 2).T)
        slope, offset, residual = line or (None, None, None)
        lines.append({
            "joint": joint, "kind": kind, "states": len(rows), "predicted": len(seen),
            "slope": slope, "offset": offset, "residual": residual,
        })  # fmt: skip
    return lines


def _joint_metrics(
    tally: Tally,
    instances: tuple[Instance, Instance],
    found: tuple[Reconstruction, Reconstruction],
    parts: NDArray[np.intp],
    joint: int,
    kind: int,
) -> None:
    """Appendix E: right where one part is assigned, of the same kind, its error below a threshold.

    A line has two directions: where the predicted one points the other way, states count the other
    way too.
    """
    name = KINDS[kind]
    canonical, instance = instances
    one = len(parts) == 1
    same = one and found[0].kind[parts[0]] == kind
    tally.add(assigned_parts=float(len(parts)), type_accuracy=100.0 * same)
    state = direction = axis = np.inf
    if same:
        i = parts[0]
        u, v = found[1].direction[i], instance.joint_axis[joint]
        change = (found[1].state[i] - found[0].state[i]) * (1.0 if np.dot(u, v) >= 0 else -1.0)
        state = abs(change - (instance.joint_state[joint] - canonical.joint_state[joint]))
        direction = metrics.angle_between_lines(u, v)
        axis = metrics.line_distance(found[1].pivot[i], u, instance.joint_pivot[joint], v)
    tally.joint_errors.append({
        "object": instance.object_id, "state_index": instance.state_index, "joint": joint,
        "kind": name, "state": float(state) if same else None,
        "direction": float(direction) if same else None,
        "axis": float(axis) if same and kind == REVOLUTE else None,
    })  # fmt: skip
    limits: list[tuple[str, float, tuple[float, ...]]]
    if kind == REVOLUTE:
        limits = [("state", float(np.degrees(state)), STATE_DEGREES), ("axis", axis, AXIS_LENGTHS)]
    else:
        limits = [("state", state, STATE_LENGTHS)]
    limits.append(("direction", float(np.degrees(direction)), DIRECTION_DEGREES))
    for what, error, thresholds in limits:
        for limit in thresholds:
            tally.add(**{f"{name}_{what}_below_{limit:g}": 100.0 * (error < limit)})
