"""Label IoU and EPE as the authors' release measures them, so that numbers stand beside its own.

Where it departs from `evaluate`: meshes on 64^3 samples, moved by one voxel to the low side, whose
borders between parts are stairs; the nearest of 1,000 *sampled points* a predicted part decides,
not the nearest surface; instances without any surface, and true parts that no predicted part is
labelled as, are left out. Here alone it is counted what is left out. The release has no code for
F-score, Chamfer-L1 or the accuracy of joints, so there are none.
"""

import dataclasses
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from articugen.core.records import Floats
from articugen.core.schema import Instance
from articugen.core.seeding import generator
from articugen.evaluation import metrics
from articugen.evaluation.evaluate import (
    Protocol,
    Reconstruct,
    Tally,
    carriers,
    check_splits,
    label_votes,
    motions,
    surface_of,
    tested,
)
from articugen.evaluation.metrics import NO_LABEL
from articugen.evaluation.reconstruction import Reconstruction
from articugen.evaluation.results import Evaluation, LeftOut
from articugen.learning.ppd.learner import Predictor
from articugen.meshes.distances import sample
from articugen.meshes.marching_cubes import zero_level

RESOLUTION = 64
WHOLE = Protocol()
_OUTSIDE = -1e6
"""Of a part where another one is greater: borders lie at the last sample inside."""


def release_meshes(logits: Floats) -> tuple[list[Floats], Floats]:
    """Return the triangles of each part and of the whole, from logits (P, R, R, R).

    Occupancies, not logits, are interpolated, and every vertex is 1 / R too low on each axis.
    """
    R = logits.shape[-1]
    inside = 0.5 * np.tanh(0.5 * logits)  # the sigmoid less 0.5
    owner = logits.argmax(0)
    fields = [np.where(owner == i, part, _OUTSIDE) for i, part in enumerate(inside)]
    parts = [zero_level(part).triangles - 1.0 / R for part in fields]
    return parts, zero_level(inside.max(0)).triangles - 1.0 / R


def reconstruct(learner: Predictor, cloud: Floats, resolution: int) -> Reconstruction:
    """Return what the release's protocol measures."""
    return learner.reconstruct(cloud, resolution=resolution, meshes=release_meshes)


def evaluate(
    data: Path,
    reconstruct: Reconstruct,
    protocol: Protocol = WHOLE,
    *,
    category: str | None = None,
    on: Path | None = None,
    on_object: Callable[[str], None] = lambda _: None,
) -> Evaluation:
    """Evaluate on the test objects of a data set, or on all of another, by the release's rules.

    Args:
        reconstruct: gives `release_meshes`.
        protocol: its `points` are also how many are sampled on a predicted part.

    Returns:
        What `evaluate` returns, with fewer means, without joints, and with `left_out`: the
        instances without label IoU and EPE, and the true parts that no EPE counts.

    Raises:
        UnfitData: a data set has no training or no test object, or is of another category.
    """
    check_splits(data, category, on)

    def in_points(instance: Instance) -> Reconstruction:
        rng = generator(0, "release", instance.object_id, instance.state_index)
        return as_points(reconstruct(instance), protocol.points, rng)

    tally = Tally(*label_votes(data, in_points, protocol, on_object))
    left_out: Counter[str] = Counter()
    for canonical, *posed in tested(data, on, protocol.states):
        tally.objects += 1
        first = in_points(canonical)
        tally.at(canonical)
        _label_iou(tally, left_out, canonical, first, protocol)
        for instance in posed:
            predicted = in_points(instance)
            tally.at(instance)
            _label_iou(tally, left_out, instance, predicted, protocol)
            _epe(tally, left_out, (canonical, instance), (first, predicted), protocol)
        on_object(canonical.object_id)
    return tally.evaluation(LeftOut(**left_out))


def as_points(shape: Reconstruction, count: int, rng: np.random.Generator) -> Reconstruction:
    """Return the same with `count` points instead of each part's surface, uniform by area."""
    drawn = [
        (i, sample(shape.triangles[shape.part == i], count, rng))
        for i in np.unique(shape.part).tolist()
    ]
    points = np.concatenate([np.zeros((0, 3)), *(points for _, points in drawn)])
    return dataclasses.replace(
        shape,
        triangles=np.repeat(points[:, None], 3, axis=1),
        part=np.repeat([i for i, _ in drawn], count).astype(np.int64),
    )


def _label_iou(
    tally: Tally,
    left_out: Counter[str],
    instance: Instance,
    predicted: Reconstruction,
    protocol: Protocol,
) -> None:
    if not len(predicted.triangles):
        left_out["instances_label_iou"] += 1
        return
    points, true = surface_of(instance, protocol.points)
    near = metrics.nearest_part(points, predicted.triangles, predicted.part, predicted.parts)
    tally.add_label_iou(near, true)


def _epe(
    tally: Tally,
    left_out: Counter[str],
    instances: tuple[Instance, Instance],
    predicted: tuple[Reconstruction, Reconstruction],
    protocol: Protocol,
) -> None:
    canonical, instance = instances
    points, true = surface_of(canonical, protocol.points)
    T_true = instance.part_motion
    carrier = carriers(points, true, T_true, predicted[1], tally.labels)
    kept = carrier != NO_LABEL
    left_out["parts_epe"] += len(np.unique(true)) - len(np.unique(true[kept]))
    if not kept.any() or not len(predicted[1].triangles):
        left_out["instances_epe"] += 1
        return
    for reading, motion in motions(*predicted).items():
        error = metrics.endpoint_error(points[kept], true[kept], T_true, motion[carrier[kept]])
        tally.add(**{f"epe_{reading}_all": error})
