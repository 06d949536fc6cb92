"""The kernels that find whose a surface is; `points` and `starts` as in `kernels.py`."""

import numpy as np

from articugen.core.jit import kernel, root
from articugen.discovery.kernels import is_alike, meets, moved, nearest, row, span

BESIDE, LEVEL = 0.03, 0.004
"""A surface has points so near to one of its own, and no farther from its tangent plane."""

BELOW, ABOUT, BEFORE = 0.01, 0.12, 0.003
"""What is so far below a point of a surface is within; the nearest face shows it, if it is not
farther off than the second, unless it lies before that by more than the third."""

SMOOTH, FLUSH = 0.95, 0.003
"""Of two points of a piece of surface: the cosine between the normals at least, and the distance
from the other's tangent plane at most."""


@kernel
def contradicted(points, normals, starts, rest, facing, motions):
    """Return (n,) in which share of the poses points of a surface, with normals `facing` out of the
    material and moved by `motions` (K, 3, 4), are contradicted: there is no such surface, and what
    would be below it is outside, before the nearest face."""
    out = np.zeros(len(rest))
    for k in range(len(motions)):
        m = -1
        for i in range(len(rest)):
            x, y, z, nx, ny, nz = moved(motions[k], rest[i], facing[i])
            if meets(points, normals, True, starts, k, x, y, z, nx, ny, nz, BESIDE, LEVEL):
                continue
            x, y, z = x - BELOW * nx, y - BELOW * ny, z - BELOW * nz
            m, _ = nearest(points, normals, True, starts, k, x, y, z, 0.0, 0.0, 0.0, ABOUT, 1.0, m)
            if m >= 0:
                dx, dy, dz = x - points[m, 0], y - points[m, 1], z - points[m, 2]
                out[i] += dx * normals[m, 0] + dy * normals[m, 1] + dz * normals[m, 2] > BEFORE
    return out / len(motions)


@kernel
def pieces(points, normals, starts, reach):
    """Return (n,) for each point of K poses the number of one in the same piece of surface: those
    belong to one that lie on each other's tangent planes, within `reach`."""
    above = np.arange(len(points))
    for k in range(len(starts)):
        for i in range(starts[k, 0], starts[k, -1]):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
            for a in span(x, reach):
                for b in span(y, reach):
                    for j in row(starts, k, a, b, z, reach):
                        dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
                        mx, my, mz = normals[j, 0], normals[j, 1], normals[j, 2]
                        if (
                            j < i
                            and dx * dx + dy * dy + dz * dz <= reach * reach
                            and nx * mx + ny * my + nz * mz >= SMOOTH
                            and abs(dx * nx + dy * ny + dz * nz) <= FLUSH
                            and abs(dx * mx + dy * my + dz * mz) <= FLUSH
                        ):
                            above[root(above, i)] = root(above, j)
    for i in range(len(above)):
        above[i] = root(above, i)
    return above


@kernel
def ballots(rest, facing, pose, points, normals, starts, part, poses, reach):
    """Return (n, P) how many points lie within `reach` of those n of a `pose` each, brought to
    `rest` (P, n, 3) as each part: of the same surface, that part's, and of other poses; the nearer,
    the more they count. `points` are the same in cells, those of part p brought to rest as that,
    with their `part` and `poses`."""
    P, n = rest.shape[:2]
    out = np.zeros((n, P))
    for p in range(P):
        for i in range(n):
            x, y, z = rest[p, i, 0], rest[p, i, 1], rest[p, i, 2]
            nx, ny, nz = facing[p, i, 0], facing[p, i, 1], facing[p, i, 2]
            for a in span(x, reach):
                for b in span(y, reach):
                    for m in row(starts, p, a, b, z, reach):
                        if part[m] != p or poses[m] == pose[i]:
                            continue
                        dx, dy, dz = points[m, 0] - x, points[m, 1] - y, points[m, 2] - z
                        d = dx * dx + dy * dy + dz * dz
                        if d <= reach * reach and is_alike(
                            normals, True, m, dx, dy, dz, nx, ny, nz, LEVEL
                        ):
                            out[i, p] += 1.0 - np.sqrt(d) / reach
    return out


@kernel
def far_from(points, R, reach):
    """Return (R, R, R) how far the centres of the unit frame's cells are from the nearest point, at
    most `reach`."""
    out = np.full((R, R, R), np.float32(reach))
    steps = int(np.ceil(reach * R))
    for n in range(len(points)):
        x, y, z = (points[n, 0] + 0.5) * R, (points[n, 1] + 0.5) * R, (points[n, 2] + 0.5) * R
        i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
        for a in range(max(i - steps, 0), min(i + steps, R - 1) + 1):
            for b in range(max(j - steps, 0), min(j + steps, R - 1) + 1):
                across = (a + 0.5 - x) ** 2 + (b + 0.5 - y) ** 2
                for c in range(max(k - steps, 0), min(k + steps, R - 1) + 1):
                    d = np.float32(np.sqrt(across + (c + 0.5 - z) ** 2) / R)
                    out[a, b, c] = min(out[a, b, c], d)
    return out
