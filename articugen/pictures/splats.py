"""Discs as a camera sees them: the nearest at each pixel, blended with those at its depth."""

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.geometry import apply
from articugen.core.jit import ahead, cross, dot, helper, kernel, vector
from articugen.pictures.camera import Camera
from articugen.pictures.surfels import Surfels, is_beyond

MOST_AROUND = 15  # a pixel lies in a gap where so many of the 24 around it are nearer


def draw(discs: Surfels, values: Floats, camera: Camera) -> tuple[Floats, Floats, Floats]:
    """Return the discs as a camera sees them.

    Args:
        values: (n, C) what to interpolate between the discs, for instance colours.

    Returns:
        Depth (H, W), inf where nothing is; unit normals (H, W, 3); values (H, W, C).
    """
    facing = ((camera.eye - discs.points) * discs.normals).sum(axis=1) > 0.0
    center = apply(camera.T_camera_world, discs.points)
    normals = apply(camera.T_camera_world, discs.points + discs.normals) - center
    extent = discs.radius[:, None] * np.sqrt(np.maximum(1.0 - normals**2, 0.0))
    # |(x + dx) / (z + dz) - x / z| where |dx|, |dz| are at most the extents.
    z, nearest = center[:, 2:], (center - extent)[:, 2:]
    flat = center[:, :2] / z
    reach = camera.focal * (extent[:, :2] + np.abs(flat) * extent[:, 2:]) / nearest
    middle = camera.focal * flat + (camera.cx, camera.cy)
    box = np.stack([np.floor(middle - reach), np.ceil(middle + reach) + 1], axis=2)
    size, rays = (camera.size, camera.size), camera.rays
    depth, weight = np.full(size, np.inf), np.full(size, 1e-30)
    blended = np.zeros((*size, 3 + values.shape[1]))
    basis = np.stack([rays[0, 0], rays[0, 1] - rays[0, 0], rays[1, 0] - rays[0, 0]])
    _splat(
        discs.points, discs.normals, discs.radius, discs.clip_ends, discs.clip, discs.across,
        discs.reach, np.concatenate([discs.normals, values], axis=1),
        np.flatnonzero(facing)[np.argsort(z[facing, 0])],
        np.clip(box, 0, camera.size).astype(np.int64), basis, camera.eye, discs.spacing, depth,
        blended, weight,
    )  # fmt: skip
    blended /= weight[..., None]
    for _ in range(2):
        _close(depth, blended, 2.0 * float(np.median(discs.spacing)))
    length = np.linalg.norm(blended[..., :3], axis=-1, keepdims=True)
    return depth, blended[..., :3] / np.maximum(length, 1e-12), blended[..., 3:]


@kernel
def _splat(
    points, normals, radius, clip_ends, clip, across, reach, values, order, box, basis, eye,
    spacing, depth, blended, weight,
):  # fmt: skip
    """Two passes: the nearest depth of each pixel, then the sum of the discs at that depth, and of
    their weights.

    The discs from near to far, so that those behind others are known to be in the second pass. A
    ray is basis[0] + column * basis[1] + row * basis[2], and so are its parts along a disc's axes.
    """
    is_seen = np.zeros(len(points), np.bool_)
    origin = (eye[0], eye[1], eye[2])
    for final in (False, True):
        for n in range(len(order)):
            i = order[n]
            if final and not is_seen[i]:
                continue
            center, normal, side = vector(points, i), vector(normals, i), vector(across, i)
            up = cross(normal, side)
            offset = ahead(center, origin, normal)
            a_eye, b_eye = ahead(origin, center, side), ahead(origin, center, up)
            slope_0, slope_u, slope_v = _along(basis, normal)
            a_0, a_u, a_v = _along(basis, side)
            b_0, b_u, b_v = _along(basis, up)
            within = radius[i] * radius[i]
            first, end = clip_ends[i, 0], clip_ends[i, 1]
            gap = 0.1 * spacing[i]  # so that faces that meet leave no crack
            for row in range(box[i, 1, 0], box[i, 1, 1]):
                for column in range(box[i, 0, 0], box[i, 0, 1]):
                    slope = slope_0 + column * slope_u + row * slope_v
                    t = offset / min(slope, -1e-3)
                    a = a_eye + t * (a_0 + column * a_u + row * a_v)
                    b = b_eye + t * (b_0 + column * b_u + row * b_v)
                    squared = a * a + b * b
                    if (
                        squared > within
                        or t > depth[row, column] + spacing[i]
                        or is_beyond(a, b, reach, i)
                    ):
                        continue
                    is_seen[i] = True
                    if first < end:
                        at = (
                            center[0] + a * side[0] + b * up[0],
                            center[1] + a * side[1] + b * up[1],
                            center[2] + a * side[2] + b * up[2],
                        )
                        if _is_cut(points, normals, clip, first, end, at, gap):
                            continue
                    if final:
                        w = np.exp(-4.0 * squared / (spacing[i] * spacing[i])) + 1e-12
                        weight[row, column] += w
                        for k in range(values.shape[1]):
                            blended[row, column, k] += w * values[i, k]
                    else:
                        depth[row, column] = min(t, depth[row, column])


@helper
def _along(basis, way):
    """Return how far the three vectors (3, 3) reach this way."""
    return dot(vector(basis, 0), way), dot(vector(basis, 1), way), dot(vector(basis, 2), way)


@helper
def _is_cut(points, normals, planes, first, end, at, gap):
    for n in range(first, end):
        j = planes[n]
        if ahead(at, vector(points, j), vector(normals, j)) > gap:
            return True
    return False


@kernel
def _close(depth, values, step):
    """Fill each pixel that lies behind most of those around it, by more than `step`, from them.

    Of a random covering a few gaps stay open, through which one sees things behind or nothing;
    beside an object's outline, nearer pixels are in the minority.
    """
    was, before, total = depth.copy(), values.copy(), np.empty(values.shape[2])
    for row in range(2, depth.shape[0] - 2):
        for column in range(2, depth.shape[1] - 2):
            border = was[row, column] - step
            count, away = 0, 0.0
            total[:] = 0.0
            for i in range(row - 2, row + 3):
                for j in range(column - 2, column + 3):
                    if was[i, j] < border:
                        count += 1
                        away += was[i, j]
                        for k in range(len(total)):
                            total[k] += before[i, j, k]
            if count >= MOST_AROUND:
                depth[row, column] = away / count
                for k in range(len(total)):
                    values[row, column, k] = total[k] / count
