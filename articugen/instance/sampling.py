"""What is drawn from a posed object: grids, query points, surface points, partial clouds.

Functions here ask the field through a callable and draw through a generator; they know neither how
the field is made nor what is done with the samples. All coordinates are in the unit frame.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from articugen.core.arrays import Bools, Bytes, Floats, Indices, Ints
from articugen.core.errors import RejectedInstance
from articugen.core.geometry import area_vectors, points_on_triangles
from articugen.core.recipe import Sampling
from articugen.core.records import DepthMaps, LabelledMesh

IsFree = Callable[[Floats, Indices], Bools]
"""Whether points (n, 3), right in front of the faces (n,), are free: (n,)."""

SURFACE_OFFSET = 1e-4
"""A surface point is visible where the point this far in front of it is seen free."""

SURFACE_ROUNDS = 40

PROJECTOR = 0.075
"""Metres from a Kinect's camera to its projector. The 35130 cm of `as_kinect` are that, times a
focal length of 585 pixels, in eighths of a pixel; the geometry is that of Khoshelham and Elberink,
"Accuracy and Resolution of Kinect Depth Data", Sensors 12 (2012)."""

SUB_CELLS = 64  # the least sub-cells along the cube's edge that have a sample where faces are


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """`points` (n, 3), unit `normals` (n, 3) outwards, `part` (n,), `face` (n,)."""

    points: Floats
    normals: Floats
    part: Bytes
    face: Indices


def solid_counts(
    inside: Bools, touched: Bools, is_inside: Callable[[Floats], Bools], *, rng: np.random.Generator
) -> tuple[Ints, int]:
    """Return how many of the sub-samples of each cell of a grid are inside, and how many there are.

    A cell that no face touches is all inside or all outside, as its centre is. The others have one
    sample at a random place in each of 2^3 sub-cells or more, so that even a plate that lies
    between all centres counts for what it fills, without bias; a cell of 1/16 has 4^3.

    Args:
        inside: (R, R, R) of the centres.
        touched: (R, R, R) by a face.
    """
    R = len(inside)
    split = 2
    while R * split < SUB_CELLS:
        split *= 2
    counts = np.where(inside, split**3, 0)
    cells = np.argwhere(touched)
    sub = np.stack(np.meshgrid(*[np.arange(split)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    places = (sub + rng.random((len(cells), split**3, 3))) / split
    points = (cells[:, None] + places) / R - 0.5
    counts[touched] = is_inside(points.reshape(-1, 3)).reshape(len(cells), -1).sum(axis=1)
    return counts, split**3


def near_points(
    surface: Floats, count: int, sigma: float | tuple[float, ...], *, rng: np.random.Generator
) -> Floats:
    """Return (count, 3): surface points moved by a Gaussian of `sigma` on each axis, kept in the
    cube; of several sigmas each takes its turn."""
    number = np.arange(count)
    wide = np.atleast_1d(sigma)
    points = rng.normal(size=(count, 3))
    points *= wide[number % len(wide), None]
    points += surface[number % len(surface)]
    return np.clip(points, -0.5, 0.5, out=points)


def surface_points(
    mesh: LabelledMesh, is_seen: Bools, is_free: IsFree, count: int, *, rng: np.random.Generator
) -> SurfacePoints:
    """`count` points uniform by area over the visible surface.

    Drawn uniformly over all faces that can be seen and kept where the point just in front is free:
    what is kept is uniform over the part of the surface that a view sees.

    Args:
        mesh: posed, faces outwards.
        is_seen: (F,) faces that can be seen at all; the others are left out.

    Raises:
        RejectedInstance: next to nothing of the surface is visible.
    """
    corners = mesh.vertices[mesh.faces]
    across = area_vectors(corners)
    doubled = np.linalg.norm(across, axis=1)
    weights = np.where(is_seen, doubled, 0.0)
    if not weights.any():
        raise RejectedInstance("no face of the object can be seen; is its mesh empty?")
    normals = across / np.maximum(doubled, 1e-30)[:, None]
    kept: list[tuple[Floats, Indices]] = []
    have = drawn = 0
    for _ in range(SURFACE_ROUNDS):
        share = max(have / drawn, 0.02) if drawn else 0.6
        draw = int((count - have) / share * 1.05) + 64
        points, face = points_on_triangles(corners, draw, rng=rng, weights=weights)
        visible = is_free(points + SURFACE_OFFSET * normals[face], face)
        kept.append((points[visible], face[visible]))
        drawn, have = drawn + draw, have + int(visible.sum())
        if have >= count:
            break
    else:
        raise RejectedInstance(f"only {have} of {drawn} points on the surface can be seen")
    points = np.concatenate([p for p, _ in kept])[:count]
    face = np.concatenate([f for _, f in kept])[:count]
    return SurfacePoints(points, normals[face], mesh.part_of_face[face], face)


def partial_clouds(
    maps: DepthMaps, part_of_face: Bytes, wanted: Sampling, *, rng: np.random.Generator
) -> tuple[Floats, Bytes]:
    """Return `partial_points` of each view's depth map, without repeats where it has that many:
    (C, m, 3) unit frame, and their parts (C, m).

    Args:
        maps: pinhole depth maps that say which face is seen.
        wanted: how many, and how exactly the cameras measure.

    Raises:
        RejectedInstance: a view sees nothing.
    """
    assert maps.depth is not None
    assert maps.face is not None
    views, count, noise = maps.views, wanted.partial_points, wanted.depth_noise
    clouds = np.zeros((len(views), count, 3))
    parts = np.zeros((len(views), count), np.uint8)
    for k in range(len(views)):
        depth, face = maps.depth[k].astype(np.float64), maps.face[k]
        if wanted.kinect_metres > 0.0:
            baseline = PROJECTOR / wanted.kinect_metres
            face = np.where(lit(depth, face, baseline * float(views.fx[k])), face, -1)
            depth, face = as_kinect(depth, face, wanted.kinect_metres, rng=rng)
        hits = np.flatnonzero(face >= 0)
        if not len(hits):
            raise RejectedInstance("a depth camera sees nothing of the object")
        chosen = rng.permutation(hits)[np.arange(count) % len(hits)]
        i, j = np.divmod(chosen, views.width)
        z = depth[i, j]
        if noise > 0.0:
            z = z + noise * rng.normal(size=count)
        clouds[k] = views.points(k, i, j, z)
        parts[k] = part_of_face[face[i, j]]
    return np.clip(clouds, -0.5, 0.5), parts


def lit(depth: Floats, face: Indices, disparity: float) -> Bools:
    """Return the pixels (H, W) at which something is that a projector right of the camera reaches:
    beside the left edges of what is nearer, a Kinect reads nothing.

    A pixel is `disparity` / depth further left in the projector's image than in the camera's. It is
    in the shadow of those that are on its right here, and on its left there.

    Args:
        disparity: pixels at depth 1: the focal length times the way from camera to projector.
    """
    column = np.arange(face.shape[1]) - disparity / np.where(face >= 0, depth, 1.0)
    column = np.where(face >= 0, column, np.inf)
    return (face >= 0) & (column <= np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1])


def as_kinect(
    depth: Floats, face: Indices, metres: float, *, rng: np.random.Generator
) -> tuple[Floats, Indices]:
    """Return a depth map (H, W), unit frame, and the faces it shows, -1 for none, as measured.

    A pixel reads the depth about half a pixel off (a standard deviation of 1/2 along each axis of
    the image), and none where nothing is there; what it reads is one of the sensor's disparities,
    so that steps and errors grow with the square of the depth. Barron and Malik, "Intrinsic Scene
    Properties from a Single RGB-D Image", CVPR 2013: z' = 35130 / floor(35130 / z + n + 1/2) with
    z in cm and n of standard deviation 1/6. No term of the angle to the surface is added: half a
    Kinect's pixel is off by what Nguyen, Izadi and Lovell (3DIMPVT 2012) measured from 60 to 80
    degrees a metre away, to 30 %.

    Args:
        metres: what the unit frame's edge is for the sensor.
    """
    height, width = face.shape
    off = np.rint(0.5 * rng.normal(size=(2, height, width))).astype(np.intp)
    rows = np.clip(np.arange(height)[:, None] + off[0], 0, height - 1)
    columns = np.clip(np.arange(width) + off[1], 0, width - 1)
    read, face = 100.0 * metres * depth[rows, columns], face[rows, columns]
    steps = 35130.0 / np.where(face >= 0, read, 1.0) + rng.normal(size=face.shape) / 6.0
    measured = 35130.0 / np.maximum(np.floor(steps + 0.5), 1.0)
    return measured / (100.0 * metres), face
