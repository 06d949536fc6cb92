"""Parts matched in every instance again: what self-supervised pose estimators are measured by.

OP-Align (Che et al., ECCV 2024) and SCAPO (Zhang and Lee, CVPR 2026) do not distinguish parts:
which prediction stands for which true part is what labels most points of the instance rightly.
Here, where there may be more predicted parts than true ones, that is an assignment problem. They
measure what they match alone; here nothing is dropped: a true part without a predicted one has IoU
0 and does not move, and its joint is 90 degrees and the unit cube's diagonal off.
"""

from collections.abc import Iterator

import numpy as np

from articugen.core.geometry import apply, motions_apart, twist_ends
from articugen.core.records import Floats, JointKind, dequantize
from articugen.core.schema import Instance
from articugen.evaluation import metrics
from articugen.evaluation.metrics import DIAGONAL, NO_LABEL, Ints
from articugen.evaluation.reconstruction import Reconstruction, joints_of

RIGHT_ANGLE = 90.0

STILL: dict[int, float] = {JointKind.REVOLUTE: float(np.radians(5.0)), JointKind.PRISMATIC: 0.02}
"""Of a joint that has moved by less, fitted motions do not show the direction: it is not judged."""


def matching(nearest: Ints, true: Ints, instance: Instance, parts: int) -> tuple[Ints, Floats]:
    """Match predicted with true parts, so that most of an instance's surface points are labelled
    rightly.

    Args:
        nearest, true: (n,) of some of its points, a limited number a true part; each part's stand
            for all that are stored of it, which are uniform by area.
        parts: how many predicted parts there are.

    Returns:
        (K,) the predicted part that each true part is matched with, NO_LABEL for none; and (K,)
        |points of both| / |points of either|, nan of a part that has no point.
    """
    K = len(instance.part_motion)
    count = np.bincount(instance.surface_part, minlength=K)
    shared = count * metrics.votes(nearest, true, parts, K)
    predicted = metrics.assigned(shared.T)
    both = np.where(predicted == NO_LABEL, 0.0, shared[predicted, np.arange(K)])
    either = count + np.where(predicted == NO_LABEL, 0.0, shared.sum(1)[predicted]) - both
    iou = np.full(K, np.nan)
    np.divide(both, either, out=iou, where=count > 0)
    return predicted, iou


def pose_errors(
    instances: tuple[Instance, Instance],
    predicted: tuple[Reconstruction, Reconstruction],
    matched: Ints,
) -> Iterator[tuple[str, float]]:
    """Yield the means over an instance's true parts of how far rotations and translations are off.

    Args:
        instances: of one object, the canonical one and another; poses are counted from the former.
        matched: (K,) the predicted part that each true part of the latter is matched with.
    """
    motion = predicted[0].motion_to(predicted[1])
    motion = predicted[0].joint_motion_to(predicted[1]) if motion is None else motion
    if motion is None:
        return
    canonical, instance = instances
    points, part = dequantize(canonical.surface_points), canonical.surface_part
    errors = {}
    for k in np.unique(part).tolist():
        i, some = matched[k], points[part == k]
        T, T_true = np.eye(4) if i == NO_LABEL else motion[i], instance.part_motion[k]
        centre = 0.5 * (some.min(0) + some.max(0))
        angle = np.degrees(metrics.angle_between_rotations(T[:3, :3], T_true[:3, :3]))
        errors[k] = angle, np.linalg.norm(apply(T, centre) - apply(T_true, centre))
    for which, first in (("all", 0), ("moving", 1)):
        some = [errors[k] for k in errors if k >= first]
        if some:
            degrees, length = np.mean(some, axis=0)
            yield f"matched_rotation_degrees_{which}", float(degrees)
            yield f"matched_translation_{which}", float(length)


def joint_errors(
    instances: tuple[Instance, Instance],
    predicted: tuple[Reconstruction, Reconstruction],
    matched: Ints,
) -> Iterator[tuple[str, float]]:
    """Yield how far each joint's direction, pivot, state and motion (`motions_apart`) since the
    canonical pose are off.

    Args:
        instances, matched: as `pose_errors` takes them.
    """
    canonical, instance = instances
    label = np.full(predicted[1].parts, NO_LABEL)
    there = np.flatnonzero(matched != NO_LABEL)
    label[matched[there]] = there
    both = joints_of(*predicted, *hung(label, instance))
    if both is None:
        return
    (first, joints), fitted = both, predicted[1].joints is None
    for j, kind in shown_joints(instance):
        i, true_axis = int(matched[j + 1]), instance.joint_axis[j]
        revolute = kind == JointKind.REVOLUTE
        true_change = float(instance.joint_state[j] - canonical.joint_state[j])
        direction, pivot, change = RIGHT_ANGLE, DIAGONAL, 0.0
        true_pivot = instance.joint_pivot[j] if revolute else None
        truth, ends = twist_ends(true_axis, true_pivot, [0.0, true_change]), np.zeros((2, 6))
        if i != NO_LABEL and joints.kind[i] == kind:
            u = joints.direction[i]
            direction = float(np.degrees(metrics.angle_between_lines(u, true_axis)))
            pivot = metrics.point_to_line(joints.pivot[i], instance.joint_pivot[j], true_axis)
            change = joints.change_since(first, i, true_axis)
            its_pivot, sign = joints.pivot[i] if revolute else None, np.sign(u @ true_axis)
            ends = twist_ends(u, its_pivot, [0.0, sign * change])
        state = abs(change - true_change)
        if not fitted or abs(true_change) >= STILL[kind]:
            yield "matched_direction_degrees", direction
        if not fitted:
            points = dequantize(instance.surface_points[instance.surface_part == j + 1])
            yield "matched_motion", motions_apart(truth, ends, points)
        if revolute:
            if not fitted:
                yield "matched_pivot_distance", pivot
            yield "matched_state_degrees", float(np.degrees(state))
        else:
            yield "matched_state_length", state


def shown_joints(instance: Instance) -> list[tuple[int, int]]:
    """Return the number and the kind of each joint whose part has surface points."""
    shown = np.isin(np.arange(len(instance.joint_kind)) + 1, instance.surface_part)
    return [(j, kind) for j, kind in enumerate(instance.joint_kind.tolist()) if shown[j]]


def hung(label: Ints, instance: Instance) -> tuple[Ints, Ints]:
    """Return (P,) the kind of the joint that each predicted part moves by, and (P,) the first
    predicted part of those that carry it, from the true parts that these stand for (P,)."""
    kind, carrier = np.full(len(label), int(JointKind.FIXED)), np.zeros(len(label), int)
    for j, of_joint in enumerate(instance.joint_kind.tolist()):
        kind[label == j + 1] = of_joint
        parent = int(instance.joint_parent[j])
        if parent and (label == parent).any():
            carrier[label == j + 1] = (label == parent).argmax()
    return kind, carrier
