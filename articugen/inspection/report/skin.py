"""The surface of each part of an object as a triangle mesh, from its stored surface points alone.

A grid of signed distances to the points' tangent planes goes through marching cubes, a little
swollen, so that a plate thinner than a voxel still has voxels inside of it. Each vertex is then
brought back to where the planes of the points around it meet (the quadric error of Ju et al. 2002,
"Dual contouring of Hermite data"): flat faces come out flat, and edges sharp.
"""

import numpy as np

from articugen.core.geometry import area_vectors
from articugen.core.jit import ahead, dot, helper, kernel, minus, squared, vector
from articugen.core.near import cells_of, near
from articugen.core.records import Mesh
from articugen.meshes.marching_cubes import zero_level
from articugen.pictures.surfels import OrientedPoints

SWOLLEN = 0.45
"""Voxels by which the grid's surface lies outside the points: less than half of one, so that the
two faces of a plate meet no later than their voxels do."""

REACH = 1.5  # voxels around a point within which the grid has a sign; beyond, it counts as free
AROUND = 1.7  # voxels around a vertex within which points say where it belongs
SAME_SIDE = 0.2  # the least cosine between the normals of a vertex and of a point that draws it
STIFF = 0.02
"""How much a vertex keeps to its nearest point where planes leave it free: a share of a plane's."""

MOST_SAMPLES = 150  # along the longest side of a part's grid


def skin(points: OrientedPoints, voxel: float, spacing: float) -> Mesh:
    """Return the surface, unit frame, that the points (of one part, many a voxel) lie on.

    Args:
        voxel: the side of the grid's cells, unit frame; larger where a part has too many.
        spacing: the side of the square that each point stands for.
    """
    low, high = points.points.min(axis=0), points.points.max(axis=0)
    voxel = max(voxel, float((high - low).max()) / (MOST_SAMPLES - 6))
    R = int(np.ceil((high - low).max() / voxel)) + 6
    origin = (low + high) / 2.0 - voxel * (R - 1) / 2.0
    cells = cells_of(points.points, voxel)
    field = _field(points.points, points.normals, cells, origin, voxel, spacing, R)
    mesh = zero_level(field)
    at = origin + ((mesh.vertices + 0.5) * R - 0.5) * voxel
    across = area_vectors(at[mesh.faces])
    normals = np.zeros_like(at)
    for corner in range(3):
        np.add.at(normals, mesh.faces[:, corner], across)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    drawn = _draw_to(at, normals, points.points, points.normals, cells, voxel)
    used, first, number = np.unique(
        mesh.faces[drawn[mesh.faces].all(axis=1)], return_index=True, return_inverse=True
    )
    order = np.argsort(first)
    place = np.empty(len(used), np.int32)
    place[order] = np.arange(len(used), dtype=np.int32)
    return Mesh(at[used[order]], place[number].reshape(-1, 3))


@kernel
def _field(points, normals, cells, origin, voxel, spacing, R):
    """Return (R, R, R) voxels inside the swollen surface, above 0 inside; free far from all points.

    At a sample, the mean over the points nearly as near as the nearest of how far it lies behind
    their planes. In front of them, what leads along a plane past its last points counts as well:
    a face does not go on beyond its edge.
    """
    field = np.full((R, R, R), -REACH)
    place = np.empty(len(points), np.int64)
    gap = 0.5 * spacing * spacing
    for i, j, k in np.argwhere(_band(points, origin, voxel, R)):
        at = origin[0] + i * voxel, origin[1] + j * voxel, origin[2] + k * voxel
        count = near(cells, points, at, REACH * voxel, place)
        least = 1e9
        for n in range(count):
            least = min(least, squared(at, vector(points, place[n])))
        front = weight = 0.0
        width = 0.15 * voxel * voxel + 0.1 * least
        for n in range(count):
            dx, dy, dz = minus(at, vector(points, place[n]))
            w = np.exp((least - dx * dx - dy * dy - dz * dz) / width)
            front += w * dot((dx, dy, dz), vector(normals, place[n]))
            weight += w
        if count == 0:
            continue
        front /= weight
        if front > 0.0:
            front = np.sqrt(max(front * front, least - gap))
        field[i, j, k] = SWOLLEN - front / voxel
    return field


@helper
def _band(points, origin, voxel, R):
    """Return (R, R, R) the samples that may have a point within reach."""
    band = np.zeros((R, R, R), np.bool_)
    for p in range(len(points)):
        x = (points[p, 0] - origin[0]) / voxel
        y = (points[p, 1] - origin[1]) / voxel
        z = (points[p, 2] - origin[2]) / voxel
        for i in range(int(np.ceil(x - REACH)), int(x + REACH) + 1):
            for j in range(int(np.ceil(y - REACH)), int(y + REACH) + 1):
                for k in range(int(np.ceil(z - REACH)), int(z + REACH) + 1):
                    band[i, j, k] = True
    return band


@helper
def _solved(a, b):
    """x of a x = b for a symmetric (3, 3), by Cramer's rule."""
    c00 = a[1, 1] * a[2, 2] - a[1, 2] * a[1, 2]
    c01 = a[0, 2] * a[1, 2] - a[0, 1] * a[2, 2]
    c02 = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    det = a[0, 0] * c00 + a[0, 1] * c01 + a[0, 2] * c02
    c11 = a[0, 0] * a[2, 2] - a[0, 2] * a[0, 2]
    c12 = a[0, 1] * a[0, 2] - a[0, 0] * a[1, 2]
    c22 = a[0, 0] * a[1, 1] - a[0, 1] * a[0, 1]
    return (
        (c00 * b[0] + c01 * b[1] + c02 * b[2]) / det,
        (c01 * b[0] + c11 * b[1] + c12 * b[2]) / det,
        (c02 * b[0] + c12 * b[1] + c22 * b[2]) / det,
    )


@kernel
def _draw_to(vertices, facing, points, normals, cells, voxel):
    """Move each vertex, in place, to where the planes around it meet; whether it has any, (V,)."""
    place = np.empty(len(points), np.int64)
    is_drawn = np.zeros(len(vertices), np.bool_)
    a, b = np.empty((3, 3)), np.empty(3)
    for v in range(len(vertices)):
        at, outwards = vector(vertices, v), vector(facing, v)
        count = near(cells, points, at, AROUND * voxel, place)
        nearest, least = -1, 1e9
        for n in range(count):
            away = squared(at, vector(points, place[n]))
            if away < least and dot(outwards, vector(normals, place[n])) > SAME_SIDE:
                nearest, least = place[n], away
        if nearest < 0:
            continue
        is_drawn[v] = True
        # the foot of the vertex on the nearest plane is where it stays along what is free
        normal = vector(normals, nearest)
        front = ahead(at, vector(points, nearest), normal)
        foot = at[0] - front * normal[0], at[1] - front * normal[1], at[2] - front * normal[2]
        a[:] = 0.0
        b[:] = 0.0
        total = 0.0
        for n in range(count):
            point, normal = vector(points, place[n]), vector(normals, place[n])
            if dot(outwards, normal) <= SAME_SIDE:
                continue
            w = (1.0 - squared(at, point) / (AROUND * voxel) ** 2) ** 2
            d = ahead(point, foot, normal)
            for r in range(3):
                for c in range(r, 3):
                    a[r, c] += w * normal[r] * normal[c]
                b[r] += w * d * normal[r]
            total += w
        for r in range(3):
            a[r, r] += STIFF * total
        step = _solved(a, b)  # from the foot
        shorter = min(1.0, voxel / max(np.sqrt(dot(step, step)), 1e-12))
        for r in range(3):
            vertices[v, r] = foot[r] + shorter * step[r]
    return is_drawn
