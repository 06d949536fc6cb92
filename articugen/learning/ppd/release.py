"""Label IoU and EPE as the authors' release measures them, so that numbers stand beside its own.

Where it departs from `evaluate`: meshes on 64^3 samples, moved by one voxel to the low side, whose
borders between parts are stairs; the nearest of 1,000 *sampled points* a predicted part decides,
not the nearest surface; instances without any surface, and true parts that no predicted part is
labelled as, are left out. Here alone it is counted what is left out. The release has no code for
F-score, Chamfer-L1 or the accuracy of joints, so there are none.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from articugen.core.geometry import points_on_triangles
from articugen.core.records import Floats
from articugen.core.schema import Instance
from articugen.core.seeding import generator
from articugen.evaluation.evaluate import Reconstruct
from articugen.evaluation.evaluate import evaluate as evaluate_as_paper
from articugen.evaluation.metrics import NO_LABEL, endpoint_error
from articugen.evaluation.reconstruction import Reconstruction
from articugen.evaluation.results import Evaluation, LeftOut
from articugen.evaluation.tally import (
    Canonical,
    Protocol,
    Tally,
    carriers,
    motions,
    nearest_parts,
    surface_of,
)
from articugen.learning.ppd.learner import Predictor
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
    data: Path, reconstruct: Reconstruct, protocol: Protocol = WHOLE, **how: Any
) -> Evaluation:
    """Evaluate on the test objects of a data set, or on all of another, by the release's rules.

    Args:
        reconstruct: gives `release_meshes`.
        protocol: its `points` are also how many are sampled on a predicted part.
        how: as `evaluation.evaluate.evaluate` takes it.

    Returns:
        What `evaluate` returns, with fewer means, without joints, and with `left_out`: the
        instances without label IoU and EPE, and the true parts that no EPE counts.

    Raises:
        UnfitData: a data set has no training or no test object, or is of another category.
    """

    def in_points(instance: Instance) -> Reconstruction:
        rng = generator(0, "release", instance.object_id, instance.state_index)
        return as_points(reconstruct(instance), protocol.points, rng)

    return evaluate_as_paper(data, in_points, protocol, measures=_Tally, **how)


def as_points(shape: Reconstruction, count: int, rng: np.random.Generator) -> Reconstruction:
    """Return the same with `count` points instead of each part's surface, uniform by area."""
    parts = np.unique(shape.part)
    surfaces = (shape.triangles[shape.part == i] for i in parts)
    drawn = [points_on_triangles(surface, count, rng=rng)[0] for surface in surfaces]
    triangles = np.repeat(np.concatenate([np.zeros((0, 3)), *drawn])[:, None], 3, axis=1)
    return replace(shape, triangles=triangles, part=np.repeat(parts, count), labelling=None)


class _Tally(Tally):
    """Measures by the release's rules."""

    def measure(self, instance: Instance, predicted: Reconstruction, first: Canonical) -> None:
        if not len(predicted.triangles):
            self.left_out["instances_label_iou"] += 1
        else:
            self.add_label_iou(*nearest_parts(instance, predicted, self.protocol))
        if first is None:
            return
        points, true = surface_of(first[0], self.protocol.points)
        T_true = instance.part_motion
        carrier = carriers(points, true, T_true, predicted, self.labels)
        kept = carrier != NO_LABEL
        self.left_out["parts_epe"] += len(np.unique(true)) - len(np.unique(true[kept]))
        if not kept.any() or not len(predicted.triangles):
            self.left_out["instances_epe"] += 1
            return
        for reading, motion in motions(first[1], predicted).items():
            error = endpoint_error(points[kept], true[kept], T_true, motion[carrier[kept]])
            self.add(**{f"epe_{reading}_all": error})

    def evaluation(self) -> Evaluation:
        left_out = LeftOut(**self.left_out)
        return super().evaluation().model_copy(update={"left_out": left_out})
