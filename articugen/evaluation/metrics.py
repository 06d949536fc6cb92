"""The paper's numbers, from plain arrays (Section 4, Appendices C and E).

K ground-truth parts (0 is the fixed one), P predicted parts. Lengths are in the unit frame.
"""

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Floats, Ints
from articugen.core.geometry import apply
from articugen.evaluation.reconstruction import Reconstruction
from articugen.meshes.distances import distance

NO_LABEL = -1
"""Of a predicted part that nothing voted for, and of a true part that none is assigned to."""

DIAGONAL = float(np.sqrt(3.0))
"""Of the unit cube: how far off what is missing is."""


def nearest_part(points: Floats, triangles: Floats, part: Ints, parts: int) -> Ints:
    """Return (n,) the predicted part whose surface is nearest to each point; NO_LABEL where none
    has any.

    Args:
        triangles: (F, 3, 3) of all parts; `part` (F,) whose each is.
    """
    far = np.stack([distance(points, triangles[part == i]) for i in range(parts)])
    return np.where(np.isfinite(far.min(0)), far.argmin(0), NO_LABEL)


def nearest_part_of(shape: Reconstruction, points: Floats) -> Ints:
    """Return the same by the surfaces by which a shape's points are labelled."""
    return nearest_part(points, *(shape.labelling or (shape.triangles, shape.part)), shape.parts)


def votes(nearest: Ints, true_part: Ints, parts: int, true_parts: int) -> Floats:
    """Return (P, K) the share of each true part's points that are nearest to each predicted part.

    A true part counts the same however large it is.
    """
    table = np.zeros((parts, true_parts))
    is_known = nearest != NO_LABEL
    np.add.at(table, (nearest[is_known], true_part[is_known]), 1.0)
    count = np.bincount(true_part, minlength=true_parts)
    return table / np.maximum(count, 1)


def labels_from(table: Floats) -> Ints:
    """Return (P,) the true part that each predicted part gets most votes from; NO_LABEL without
    any."""
    return np.where(table.sum(1) > 0, table.argmax(1), NO_LABEL)


def dominant_labels(table: Floats) -> Ints:
    """Return (P,) the same, but each label only for the part with the most votes for it."""
    label = labels_from(table)
    kept = np.full(len(label), NO_LABEL)
    for k in set(label.tolist()) - {NO_LABEL}:
        best = np.where(label == k, table[:, k], -1.0).argmax()
        kept[best] = k
    return kept


def assigned(gain: Floats) -> Ints:
    """Return (K,) the column of each row of (K, P), no two the same, with the greatest sum of
    gains; NO_LABEL where that gains nothing."""
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415 - of learners alone

    rows, columns = linear_sum_assignment(gain, maximize=True)
    labels = np.full(len(gain), NO_LABEL)
    gains = gain[rows, columns] > 0.0
    labels[rows[gains]] = columns[gains]
    return labels


def label_iou(predicted: Ints, true: Ints) -> float:
    """Return the mean over the true parts present of |predicted and true| / |predicted or true|."""
    return float(np.mean([occupancy_iou(predicted == k, true == k) for k in np.unique(true)]))


def occupancy_iou(predicted: NDArray[np.bool_], true: NDArray[np.bool_]) -> float:
    """|predicted and true| / |predicted or true| of two masks; 1 where both are empty."""
    either = np.count_nonzero(predicted | true)
    return np.count_nonzero(predicted & true) / either if either else 1.0


def line_through(true: Floats, predicted: Floats) -> tuple[float, float] | None:
    """Return (slope, residual): least squares, root mean square; None if `true` does not vary."""
    if len(true) < 2 or np.ptp(true) < 1e-9:
        return None
    slope, offset = np.polyfit(true, predicted, 1)
    residual = np.sqrt(np.mean((predicted - slope * true - offset) ** 2))
    return float(slope), float(residual)


def endpoint_error(points: Floats, true: Ints, T_true: Floats, T_predicted: Floats) -> float:
    """EPE: the mean over true parts of the mean distance between where points end up.

    Args:
        points: (n, 3) in the canonical pose; `true` (n,) their parts.
        T_true: (K, 4, 4) each part's motion.
        T_predicted: (n, 4, 4) what moves each point.
    """
    moved = np.einsum("nij,nj->ni", T_predicted[:, :3, :3], points) + T_predicted[:, :3, 3]
    apart = np.linalg.norm(moved - apply(T_true[true], points), axis=1)
    return float(np.mean([apart[true == k].mean() for k in np.unique(true)]))


def chamfer_l1(to_true: Floats, to_predicted: Floats) -> float:
    """Half the sum of the mean distances, prediction to truth and truth to prediction."""
    return float(0.5 * (to_true.mean() + to_predicted.mean()))


def f_score(to_true: Floats, to_predicted: Floats, threshold: float) -> float:
    """Return the harmonic mean of precision and recall: shares of points nearer than the
    threshold."""
    precision, recall = np.mean(to_true < threshold), np.mean(to_predicted < threshold)
    return float(2.0 * precision * recall / max(precision + recall, 1e-12))


def angle_between_lines(u: Floats, v: Floats) -> float:
    """Radians in [0, pi / 2] between two directions, whatever their signs."""
    return float(np.arctan2(np.linalg.norm(np.cross(u, v)), abs(np.dot(u, v))))


def angle_between_rotations(R: Floats, S: Floats) -> float:
    """Radians in [0, pi] by which one must turn to get from R to S, both (3, 3)."""
    turn = R.T @ S
    twist = turn - turn.T  # 2 sin(angle) [axis]
    sine = 0.5 * np.linalg.norm([twist[2, 1], twist[0, 2], twist[1, 0]])
    return float(np.arctan2(sine, 0.5 * (np.trace(turn) - 1.0)))


def point_to_line(point: Floats, q: Floats, v: Floats) -> float:
    """Return the distance from a point to the line q + t v; v of unit length."""
    between = point - q
    return float(np.linalg.norm(between - np.dot(between, v) * v))


def line_distance(p: Floats, u: Floats, q: Floats, v: Floats) -> float:
    """Return the least distance between the lines p + t u and q + t v; u and v of unit length."""
    normal = np.cross(u, v)
    size = np.linalg.norm(normal)
    if size < 1e-9:
        return point_to_line(q, p, u)
    return float(abs(np.dot(q - p, normal)) / size)
