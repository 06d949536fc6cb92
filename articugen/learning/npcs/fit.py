"""Similarities that take normalised coordinates to points: least squares, and RANSAC around it."""

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.geometry import transform

ROUNDS = 1000
INLIER = 0.1
"""Within how much of the unit frame a point is one, as published."""


def similarity(source: Floats, target: Floats) -> tuple[Floats, Floats, Floats]:
    """Return scales (...), rotations (..., 3, 3) and translations (..., 3) that take points
    (..., n, 3) to others: Kabsch's rotation, and the scale that fits pairwise distances best."""
    a, b = (x - x.mean(-2, keepdims=True) for x in (source, target))
    U, _, Vt = np.linalg.svd(np.swapaxes(b, -1, -2) @ a)
    U[..., 2] *= np.linalg.det(U @ Vt)[..., None]
    R = U @ Vt
    of_a, of_b = (np.linalg.norm(x[..., :, None, :] - x[..., None, :, :], axis=-1) for x in (a, b))
    scale = (of_a * of_b).sum((-1, -2)) / np.maximum((of_a**2).sum((-1, -2)), 1e-12)
    shift = target.mean(-2) - scale[..., None] * (R @ source.mean(-2)[..., None])[..., 0]
    return scale, R, shift


def pose(coordinates: Floats, points: Floats, rng: np.random.Generator) -> Floats:
    """Return (4, 4), the pose of a part of which there are points (n, 3), nan of fewer than three.

    Of similarities through three points each the one with most inliers counts; it is fitted again
    to all of these. The pose is its rotation, and where it takes the middle of the part's box, 0:
    how poses differ then is rigid, whatever scale the fits of both share.

    Args:
        coordinates: (n, 3) of the points in the part's frame at rest, from the box's middle.
    """
    if len(points) < 3:
        return np.full((4, 4), np.nan)
    some = np.argpartition(rng.random((ROUNDS, len(points))), 2, axis=1)[:, :3]
    scale, R, shift = similarity(coordinates[some], points[some])
    there = scale[:, None, None] * (coordinates @ np.swapaxes(R, 1, 2)) + shift[:, None]
    inside = np.linalg.norm(there - points, axis=2) < INLIER
    best = inside[inside.sum(1).argmax()]
    _, R, shift = similarity(coordinates[best], points[best])
    return transform(R, shift)
