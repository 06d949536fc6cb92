"""Recorded depth images of a laptop, cut out of their background and brought to the unit frame."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from articugen.core.arrays import Floats, Ints
from articugen.core.errors import InvalidSource
from articugen.core.files import read_or_refuse
from articugen.core.geometry import apply, bounds, invert_rigid, rotation_about, transform
from articugen.core.records import Normalization
from articugen.core.seeding import generator
from articugen.evaluation import metrics
from articugen.evaluation.reconstruction import Reconstruction, turn_of
from articugen.meshes.distances import distance
from articugen.meshes.points import FEWEST_POINTS, LONGEST_EDGE

BACKGROUND = -1
FARTHEST = 1e3  # metres, of anything that was recorded
OPEN = np.radians(135.0)
"""How far the paper's laptops open: the unit frame holds the object over all of that."""

_FEWEST_DEGREES = 5.0  # that the lid turns by in a recording, or its hinge is not known
_NEAR = 0.015  # metres that a point of a part may be off its surface
_RING, _FLAT, _MOSTLY = 0.15, 0.008, 0.3  # metres around a part; off a plane; share of the ring
_OUTLIERS = 0.5  # percent of a part's points along each axis, on either side
_SAMPLES = 4096
_MOST_BYTES, _MOST_PIXELS = 1 << 26, 1 << 23


@dataclass(frozen=True, eq=False)
class Frame:
    """One depth image.

    Attributes:
        points: (n, 3) metres, camera axes x right, y down, z forward.
        part: (n,) whose each is, BACKGROUND for none; 0 is the base, 1 the lid.
        T_camera_part: (2, 4, 4) from the parts' own frames, metres.
    """

    points: Floats
    part: Ints
    T_camera_part: Floats


@dataclass(frozen=True, eq=False)
class Recording:
    """Some images of a sequence, in order.

    Attributes:
        surfaces: points (n, 3) of each part in its own frame, metres.
    """

    name: str
    surfaces: Sequence[Floats]
    frames: Sequence[Frame]


@dataclass(frozen=True, eq=False)
class Posed:
    """Object in one image, as the camera sees it, in the unit frame.

    Attributes:
        points, part: (n, 3), (n,) without the background.
        state: radians by which the lid is open.
        pivot: (3,) on the hinge, whose direction is +y.
    """

    points: Floats
    part: Ints
    state: float
    pivot: Floats


def contents(path: Path) -> bytes:
    """Return a file's bytes, or raise InvalidSource."""
    return read_or_refuse(path, _MOST_BYTES, InvalidSource, "put it there as it was recorded")


def picture(path: Path) -> Ints:
    """Return (H, W) the numbers of a PNG of one channel, or raise InvalidSource."""
    data = contents(path)
    try:
        with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
            assert image.width * image.height <= _MOST_PIXELS, "too many pixels"
            numbers = np.asarray(image)
        assert numbers.ndim == 2, "more than one channel"
    except Exception as error:  # whatever the library meets in a broken file
        raise InvalidSource(f"{path}: no picture of depths or parts ({error})") from None
    return numbers.astype(np.int64)


def seen_by(depth: Floats, fx: float, fy: float, cx: float, cy: float) -> Floats:
    """Return (H, W, 3) the points of a depth image (H, W) in metres, nan where there is none within
    `FARTHEST`; pixel (i, j) looks through (u, v) = (j, i), as both data sets' authors have it."""
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    z = np.where((depth > 0.0) & (depth < FARTHEST), depth, np.nan)
    return np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=-1)


def parts_by_surfaces(points: Floats, T_camera_part: Floats, surfaces: Sequence[Floats]) -> Ints:
    """Return (n,) the part whose surface a point is nearest to; BACKGROUND of what is far from all,
    and of points on the plane that the object stands on rather than on a part.

    Args:
        surfaces: triangles (F, 3, 3) of each part, in its own frame.
    """
    away = np.full((len(surfaces), len(points)), np.inf)
    for k, (T, triangles) in enumerate(zip(T_camera_part, surfaces, strict=True)):
        local = apply(invert_rigid(T), points)
        low, high = bounds(triangles.reshape(-1, 3))
        close = ((local > low - _RING) & (local < high + _RING)).all(1)
        away[k, close] = distance(local[close], triangles)
    part, least = np.argmin(away, axis=0), np.min(away, axis=0)
    part[least > _NEAR] = BACKGROUND
    plane = _plane(points[(least > _NEAR) & (least <= _RING)])
    if plane is not None:
        part[np.abs(points @ plane[0] - plane[1]) < np.minimum(least, _FLAT)] = BACKGROUND
    return part


def _plane(points: Floats) -> tuple[Floats, float] | None:
    """Return unit normal and offset of the plane that most points lie on (RANSAC, 200 rounds of
    three, then least squares); None where too few do."""
    if len(points) < FEWEST_POINTS:
        return None
    rng = generator(0, "plane")
    best = np.zeros(len(points), bool)
    for _ in range(200):
        a, b, c = points[rng.integers(len(points), size=3)]
        normal = np.cross(b - a, c - a)
        size = np.linalg.norm(normal)
        if size > 1e-9:
            on = np.abs((points - a) @ (normal / size)) <= _FLAT
            best = on if on.sum() > best.sum() else best
    if best.mean() < _MOSTLY:
        return None
    normal = _thin(points[best])
    return normal, float(normal @ points[best].mean(0))


def surfaces_seen(frames: Sequence[Frame]) -> list[Floats]:
    """Return (n, 3) what the images show of each part, in its own frame, without the points
    farthest out: where masks and depth disagree at an edge."""
    surfaces = []
    for part in range(2):
        points = np.concatenate([
            apply(invert_rigid(f.T_camera_part[part]), f.points[f.part == part]) for f in frames
        ])  # fmt: skip
        if len(points) < FEWEST_POINTS:
            raise InvalidSource(f"the images show too little of part {part}: hardly a pixel is its")
        low, high = np.percentile(points, [_OUTLIERS, 100.0 - _OUTLIERS], axis=0)
        points = points[((points >= low) & (points <= high)).all(1)]
        surfaces.append(points[:: -(-len(points) // _SAMPLES)])
    return surfaces


def into_unit_frame(recording: Recording) -> list[Posed]:
    """Return the images' points in the unit frame that a data set's laptops are in.

    Up is where the base is thinnest, on the lid's side. The hinge is the axis of the greatest turn
    of the lid between two of the images, brought perpendicular to that; it points to +y where the
    base lies towards -x. The lid is closed where it is parallel to the base. Centre and scale are
    of both over 0 to 135 degrees, the longest edge 0.9.

    Raises:
        InvalidSource: the lid turns too little, or an image shows too little of the object.
    """
    base, lid = recording.surfaces
    middle = np.append(lid.mean(0), 1.0)
    T_base_lid = np.array([
        invert_rigid(frame.T_camera_part[0]) @ frame.T_camera_part[1] for frame in recording.frames
    ])  # fmt: skip
    up = _thin(base) * np.sign(_thin(base) @ ((T_base_lid @ middle)[:, :3].mean(0) - base.mean(0)))
    axis, pivot = _hinge(recording.name, T_base_lid)
    y = axis - (axis @ up) * up
    y *= -np.sign(np.cross(y, up) @ (base.mean(0) - pivot)) / np.linalg.norm(y)
    R = np.stack([np.cross(y, up), y, up])
    to_hinge = transform(R, -R @ pivot)
    lids = to_hinge @ T_base_lid
    along = np.cross(lids[:, :3, :3] @ _thin(lid), [0.0, 1.0, 0.0])  # in the lid, off the hinge
    along *= np.sign((along * (lids @ middle)[:, :3]).sum(1))[:, None]
    quarter = np.pi / 2.0  # a lid that is shut may seem to be a little less open than not at all
    states = (np.arctan2(along[:, 2], -along[:, 0]) + quarter) % (4.0 * quarter) - quarter
    swept = [
        apply(transform(rotation_about([0.0, 1.0, 0.0], angle - states[0])) @ lids[0], lid)
        for angle in np.linspace(0.0, OPEN, 28)
    ]
    low, high = bounds(np.concatenate([apply(to_hinge, base), *swept]))
    frame = Normalization((low + high) / 2.0, float((high - low).max()) / LONGEST_EDGE)
    posed = []
    for number, (image, state) in enumerate(zip(recording.frames, states, strict=True)):
        T = to_hinge @ invert_rigid(image.T_camera_part[0])
        points = frame.to_unit(apply(T, image.points))
        inside = (image.part != BACKGROUND) & (np.abs(points) <= 0.5).all(1)
        if inside.sum() < FEWEST_POINTS:
            raise InvalidSource(f"{recording.name}: image {number} hardly shows the object")
        posed.append(
            Posed(points[inside], image.part[inside], float(state), frame.to_unit(np.zeros(3)))
        )
    return posed


def _thin(points: Floats) -> Floats:
    """Return the direction (3,) along which points vary least."""
    return np.linalg.svd(points - points.mean(0), full_matrices=False)[2][2]


def _hinge(name: str, T_base_lid: Floats) -> tuple[Floats, Floats]:
    """Return the axis of the greatest turn between two poses, and a point on it."""
    T, (angle, axis) = max(
        ((T, turn_of(T[:3, :3])) for a in T_base_lid for T in T_base_lid @ invert_rigid(a)),
        key=lambda item: item[1][0],
    )
    if np.degrees(angle) < _FEWEST_DEGREES:
        raise InvalidSource(
            f"{name}: the lid turns by {np.degrees(angle):.1f} degrees in these images, too little "
            "to know its hinge; take more images or another sequence"
        )
    return axis, np.linalg.lstsq(np.eye(3) - T[:3, :3], T[:3, 3], rcond=1e-6)[0]


def measured(
    posed: Sequence[Posed], shapes: Sequence[Reconstruction]
) -> tuple[Ints, Ints, dict[str, float]]:
    """Compare what a model makes of each image with the truth.

    Returns:
        The labels (P,) of the predicted parts, by their votes over all images; those by most votes;
        and means over images: `label_iou` of the points that the camera sees, and of the part with
        most votes for the lid `direction_degrees`, `pivot` (unit frame) and `state_degrees`, a
        change since the image in which the laptop is least open; nan where there is no such part,
        or no joints.
    """
    pairs = list(zip(posed, shapes, strict=True))
    nearest = [metrics.nearest_part_of(f, p.points) for p, f in pairs]
    votes = np.zeros((shapes[0].parts, 2))
    for near, p in zip(nearest, posed, strict=True):
        votes += metrics.votes(near, p.part, *votes.shape)
    labels, dominant = metrics.labels_from(votes), metrics.dominant_labels(votes)
    named = np.append(labels, metrics.NO_LABEL)  # the last one is for no part
    ious = [metrics.label_iou(named[n], p.part) for n, p in zip(nearest, posed, strict=True)]
    errors, lid = [], np.flatnonzero(dominant == 1)
    first = int(np.argmin([p.state for p in posed]))
    before, y = shapes[first].joints, np.array([0.0, 1.0, 0.0])
    for p, f in pairs:
        if len(lid) and before is not None and f.joints is not None:
            change = f.joints.change_since(before, lid[0], y) - (p.state - posed[first].state)
            angle = metrics.angle_between_lines(f.joints.direction[lid[0]], y)
            pivot = metrics.point_to_line(f.joints.pivot[lid[0]], p.pivot, y)
            errors.append((np.degrees(angle), pivot, abs(np.degrees(change))))
    means = np.mean(errors, axis=0).tolist() if errors else [float("nan")] * 3
    names = ("direction_degrees", "pivot", "state_degrees")
    numbers = {"label_iou": float(np.mean(ious)), **dict(zip(names, means, strict=True))}
    return labels, dominant, numbers
