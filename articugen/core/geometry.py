"""Rigid transforms, axis-angle, boxes, voxels, points on triangles, directions on a sphere.

`T_a_b` is the 4x4 transform that takes b-coordinates to a-coordinates. Everything is float64 and
right-handed; angles are radians. Sums and angles go through portable.py: the same bits everywhere.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from articugen.core.arrays import Floats, Indices
from articugen.core.portable import dot, norm, product, sin_cos, turned

_NO_AREA = 1e-60
"""The square of twice the area, unit frame, of triangles that are taken for points."""

CORNERS = np.array([[(i >> k) & 1 for k in range(3)] for i in range(8)])
"""(8, 3) which corner of a box each is along each axis: 0 the lower, 1 the upper."""

_INWARDS = 1e-6
"""Least share of a corner: right behind the edge of a picture that repeats its other side lies."""


def rotation_about(axis: ArrayLike, angle: float) -> Floats:
    """Return the (3, 3) rotation by `angle` about the unit vector `axis` (Rodrigues' formula)."""
    x, y, z = np.asarray(axis, dtype=np.float64)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, cosine = sin_cos(angle)
    return np.eye(3) + sine * K + (1.0 - cosine) * product(K, K)


def rotation_from_rpy(rpy: ArrayLike) -> Floats:
    """Return (3, 3) the rotation of URDF's fixed-axis roll, pitch, yaw: Rz(yaw) Ry(pitch)
    Rx(roll)."""
    roll, pitch, yaw = np.asarray(rpy, dtype=np.float64)
    return product(
        rotation_about((0, 0, 1), yaw),
        rotation_about((0, 1, 0), pitch),
        rotation_about((1, 0, 0), roll),
    )


def rotation_from_quaternion(quaternion: ArrayLike) -> Floats:
    """Return the rotations (..., 3, 3) of unit quaternions w, x, y, z (..., 4)."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, dtype=np.float64), -1, 0)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def transform(rotation: ArrayLike | None = None, translation: ArrayLike | None = None) -> Floats:
    """Return a (4, 4) transform from a (3, 3) rotation and a (3,) translation; each defaults to
    none."""
    T = np.eye(4)
    if rotation is not None:
        T[:3, :3] = rotation
    if translation is not None:
        T[:3, 3] = translation
    return T


def joint_motion(turns: bool, axis: ArrayLike, q: float, pivot: ArrayLike = (0, 0, 0)) -> Floats:
    """Return the (4, 4) turn by `q` about the unit vector `axis` through `pivot`, or slide along
    it."""
    if not turns:
        return transform(translation=q * np.asarray(axis))
    R = rotation_about(axis, q)
    return transform(R, np.asarray(pivot) - turned(R, pivot))


def apply(T: Floats, points: ArrayLike) -> Floats:
    """`T` (4, 4), or (..., 4, 4) one for each point, applied to `points` (..., 3)."""
    points = np.asarray(points, dtype=np.float64)
    x, y, z = np.moveaxis(points, -1, 0)
    moved = np.empty_like(points)
    for row in range(3):
        a, b, c, d = (T[..., row, column] for column in range(4))
        moved[..., row] = a * x + b * y + c * z + d
    return moved


def invert_rigid(T: Floats) -> Floats:
    """Return the inverse of rigid transforms (..., 4, 4), exact up to rounding and cheap."""
    inverse = np.zeros_like(T)
    rotation_t = np.swapaxes(T[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = rotation_t
    inverse[..., :3, 3] = -turned(rotation_t, T[..., :3, 3])
    inverse[..., 3, 3] = 1.0
    return inverse


def bounds(points: ArrayLike) -> Floats:
    """Return the axis-aligned box (2, 3) of `points` (n, 3): lower corner, upper corner."""
    columns = np.asarray(points, dtype=np.float64).T  # each by itself: rows of 3 take five times it
    return np.array([[x.min() for x in columns], [x.max() for x in columns]])


def box_corners(box: Floats) -> Floats:
    """Return the 8 corners (8, 3) of a box (2, 3)."""
    return np.take_along_axis(box, CORNERS, axis=0)


def voxel_centres(resolution: int, which: NDArray[np.integer] | None = None) -> Floats:
    """Return the centres (i + 0.5) / R - 0.5 of the R^3 voxels of a grid: (R^3, 3), x slowest.

    Args:
        which: flat indices (...), of whose voxels alone the centres (..., 3) are wanted.
    """
    which = np.arange(resolution**3) if which is None else which
    index = np.stack(np.unravel_index(which, (resolution,) * 3), axis=-1)
    return (index + 0.5) / resolution - 0.5


def points_on_triangles(
    corners: Floats, count: int, *, rng: np.random.Generator, weights: ArrayLike | None = None
) -> tuple[Floats, Indices]:
    """Points (count, 3) spread at random over triangles (F, 3, 3), and the face (count,) of each.

    Args:
        weights: (F,) how much of the points each face gets; by default its area, and where no face
            has any (corners that coincide are a point) each the same.
    """
    if weights is None:
        area = norm(area_vectors(corners))
        weights = np.where(np.any(area), area, 1.0)
    face = pick_by_weight(weights, rng.random(count))
    a, b = rng.random((2, count, 1))
    return points_in_triangles(corners[face], a, b), face


def pick_by_weight(weights: ArrayLike, at: NDArray[np.floating]) -> Indices:
    """Return (n,) the index at the share `at` (n,), each in [0, 1), of the sum of the weights
    (F,)."""
    cumulative = np.cumsum(weights)
    index = np.searchsorted(cumulative, at * cumulative[-1], side="right")
    return np.minimum(index, len(cumulative) - 1)


def points_in_triangles(
    corners: Floats, a: NDArray[np.floating], b: NDArray[np.floating]
) -> Floats:
    """Return (n, 3) the points of triangles (n, 3, 3) at places (n, 1) of the unit square, which is
    folded along its diagonal: what is uniform there is uniform by area."""
    folded = a + b > 1.0
    a, b = np.where(folded, 1.0 - a, a), np.where(folded, 1.0 - b, b)
    return corners[:, 0] * (1.0 - a - b) + corners[:, 1] * a + corners[:, 2] * b


def spread_evenly(rank: Indices) -> Floats:
    """Return (2, n) places of points (n,) of these numbers in the unit square: the R2 sequence
    (Roberts 2018)."""
    steps: Floats = np.array([[0.7548776662466927], [0.5698402909980532]])
    return (0.5 + rank * steps) % 1.0


def plane_weights(corners: Floats, points: Floats) -> Floats:
    """Return (n, 3) the barycentric coordinates of points (n, 3) in the planes of triangles (n, 3,
    3); thirds in triangles without area."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = area_vectors(corners)
    square = dot(normal, normal)
    flat = square < _NO_AREA
    square = np.where(flat, 1.0, square)
    beta = dot(cross(points - a, c - a), normal) / square
    gamma = dot(cross(b - a, points - a), normal) / square
    weights = np.stack([1.0 - beta - gamma, beta, gamma], axis=1)
    weights[flat] = 1.0 / 3.0
    return weights


def nearest_weights(corners: Floats, points: Floats) -> Floats:
    """Return (n, 3) what `plane_weights` does, of points moved into the triangles from beside
    them."""
    weights = np.maximum(plane_weights(corners, points), _INWARDS)
    return weights / dot(weights, np.ones(3))[:, None]


def fibonacci_sphere(count: int) -> Floats:
    """`count` unit directions (count, 3) spread evenly over the sphere.

    Spherical Fibonacci points: z at the midpoints of equal slices, which have equal areas, and
    longitude in steps of the golden angle (Gonzalez 2010, "Measurement of areas on a sphere using
    Fibonacci and latitude-longitude lattices").
    """
    i = np.arange(count)
    z = 1.0 - (2.0 * i + 1.0) / count
    longitude = i * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - z * z)
    sine, cosine = sin_cos(longitude)
    return np.stack([radius * cosine, radius * sine, z], axis=1)


def cross(a: ArrayLike, b: ArrayLike) -> Floats:
    """Return the cross products of (..., 3) and (..., 3); the same numbers as numpy's, at a tenth
    of its overhead, of which the procedural models' thousands of small polygons are most."""
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    a0, a1, a2 = a[..., 0], a[..., 1], a[..., 2]
    b0, b1, b2 = b[..., 0], b[..., 1], b[..., 2]
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0] = a1 * b2 - a2 * b1
    out[..., 1] = a2 * b0 - a0 * b2
    out[..., 2] = a0 * b1 - a1 * b0
    return out


def area_vectors(triangles: Floats) -> Floats:
    """Return (n, 3) the normals of triangles (n, 3, 3) by the right-hand rule, twice as long as the
    areas."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    return cross(b - a, c - a)


def unit_normals(triangles: Floats) -> Floats:
    """Return (n, 3) the same, 1 long; shorter where there is no area."""
    normals = area_vectors(triangles)
    return normals / np.maximum(norm(normals), 1e-30)[:, None]


def look_along(direction: ArrayLike, eye: ArrayLike = (0.0, 0.0, 0.0)) -> Floats:
    """`T_camera_world` (..., 4, 4) of cameras at `eye` (..., 3) that look along `direction`
    (..., 3).

    Camera axes: x right, y down, z forward (along `direction`). Image-up is the world's z, or its
    y for a camera that looks straight up or down.
    """
    forward = np.asarray(direction, dtype=np.float64)
    forward = forward / norm(forward)[..., None]
    steep = np.abs(forward[..., 2:]) >= 0.999
    right = cross(forward, np.where(steep, [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]))
    right /= norm(right)[..., None]
    T = np.zeros((*forward.shape[:-1], 4, 4))
    T[..., :3, :3] = np.stack([right, cross(forward, right), forward], axis=-2)
    T[..., :3, 3] = -turned(T[..., :3, :3], eye)
    T[..., 3, 3] = 1.0
    return T


def twist_ends(direction: Floats, pivot: Floats | None, ends: ArrayLike) -> Floats:
    """Return (2, 6) the twists (w, v) that move by a joint from rest to both ends of a range.

    Points x move by w x x + v, to first order.

    Args:
        direction: (3,) of unit length.
        pivot: (3,) a point on the axis of a joint that turns; None of one that slides.
        ends: (2,) states, radians or lengths.
    """
    slides = pivot is None
    twist = [0.0 * direction, direction] if slides else [direction, np.cross(pivot, direction)]
    return np.asarray(ends, dtype=np.float64)[:, None] * np.concatenate(twist)


def motions_apart(one: Floats, other: Floats, points: Floats) -> float:
    """Return the quotient distance E of two joints' motions `twist_ends` (2, 6), unit of `points`.

    The root of the mean square by which the ends of their ranges move points (n, 3) of a part
    apart, whichever end comes first: 0 where they are the same motion, however it is written
    (ArticulateArena, arXiv 2609.33931, with its kinetic-energy norm for equal masses at the points;
    a joint that is missing does not move).
    """

    def square(twist: Floats) -> float:
        moved = np.cross(twist[:3], points) + twist[3:]
        return float((moved * moved).sum(axis=1).mean())

    return min(sum(map(square, one - ends)) for ends in (other, other[::-1])) ** 0.5
