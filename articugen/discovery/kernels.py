"""The kernels of the search. Everything is in the cube [-0.5, 0.5]^3.

`Cells` in `clouds.py` is what `points` and `starts` belong to: the points of several poses, each
pose's sorted by the cell they are in, cells CELLS an edge; those of cell c of pose k are
`points[starts[k, c] : starts[k, c + 1]]`.
"""

import numpy as np

from articugen.core.jit import helper, kernel

CELLS = 32  # cells along an edge

VOTES = 64
"""Cells along an edge of the grids that votes are looked up in, and what poses are empty of."""

ALONG = 0.02
"""How much a point's distance counts along the surface or the rod that it is on; across it 1."""

FLAT = 0.05
"""Of points on a plane, the variance across it is at most this share of the least along it."""

FAR = 1e9  # the squared distance to where there is nothing

HAIR = 1e-9  # more than what rounding moves a point across the border of a cell

LIKE = 0.85  # cosine between the normals of two points that may be of one surface


@helper
def span(x, reach):
    """Return the cells along an edge that come within `reach` of x."""
    first = max(int(np.floor((x - reach + 0.5) * CELLS)), 0)
    return range(first, min(int(np.floor((x + reach + 0.5) * CELLS)), CELLS - 1) + 1)


@helper
def row(starts, pose, i, j, z, reach):
    """Return the points of a pose in the cells (i, j, k) that come within `reach` of z."""
    first = min(max(int(np.floor((z - reach + 0.5) * CELLS)), 0), CELLS)
    last = min(int(np.floor((z + reach + 0.5) * CELLS)), CELLS - 1)
    row = (i * CELLS + j) * CELLS
    k = np.uintp(pose)  # unsigned: numba does not ask whether to count from the end
    begin, end = np.uintp(row + first), np.uintp(row + max(last, first - 1) + 1)
    return range(starts[k, begin], starts[k, end])


@helper
def moved(M, p, n):
    """Return a point p and its normal n, moved by M (3, 4)."""
    return (
        M[0, 0] * p[0] + M[0, 1] * p[1] + M[0, 2] * p[2] + M[0, 3],
        M[1, 0] * p[0] + M[1, 1] * p[1] + M[1, 2] * p[2] + M[1, 3],
        M[2, 0] * p[0] + M[2, 1] * p[1] + M[2, 2] * p[2] + M[2, 3],
        M[0, 0] * n[0] + M[0, 1] * n[1] + M[0, 2] * n[2],
        M[1, 0] * n[0] + M[1, 1] * n[1] + M[1, 2] * n[2],
        M[2, 0] * n[0] + M[2, 1] * n[1] + M[2, 2] * n[2],
    )


@helper
def _voter(x):
    """Return which of VOTES cells along an edge x is in, or before."""
    return min(max(int((x + 0.5) * VOTES), 0), VOTES - 1)


@helper
def is_void(within, pose, x, y, z):
    """Return whether a pose surely has no point within reach of (x, y, z): one bit says so.

    `within` (G, VOTES^3): bit k % 8 of byte `[k // 8, cell]` is 1 where pose k has a point within
    reach of any place in the cell. A place outside the cube is no nearer to what is in it than the
    cell at the border before it.
    """
    cell = (_voter(x) * VOTES + _voter(y)) * VOTES + _voter(z)
    byte = within[np.uintp(pose >> 3), np.uintp(cell)]
    return (byte >> np.uint8(pose & 7)) & np.uint8(1) == 0


@helper
def is_alike(normals, signed, n, dx, dy, dz, nx, ny, nz, across):
    """Return whether point n, so far from another one, may be of the same surface as that: no more
    than `across` from plane to plane. A normal of zeros says nothing; `signed` ones point out of
    the material, others either way."""
    if abs(dx * nx + dy * ny + dz * nz) > across:
        return False
    mx, my, mz = normals[n, 0], normals[n, 1], normals[n, 2]
    along = mx * nx + my * ny + mz * nz
    if (along if signed else abs(along)) >= LIKE:
        return True
    is_bare = mx == 0.0 and my == 0.0 and mz == 0.0
    return is_bare or (nx == 0.0 and ny == 0.0 and nz == 0.0)


@helper
def _beyond(x, i):
    """Return the square of how far x is from the cells i along an edge, by a hair too little."""
    far = max(i * (1.0 / CELLS) - 0.5 - x, x + 0.5 - (i + 1) * (1.0 / CELLS), HAIR) - HAIR
    return far * far


@helper
def nearest(points, normals, signed, starts, pose, x, y, z, nx, ny, nz, reach, across, guess):
    """Return (index, squared distance) of the point of a pose that is nearest to (x, y, z) and may
    be of the same surface, the last one where several are; -1 if there is none within `reach`.
    `guess` is a point of the pose that may be near, or -1: the nearer, the fewer others are
    examined."""
    best, at = reach * reach, -1
    if guess >= 0:
        g = np.uintp(guess)
        dx, dy, dz = points[g, 0] - x, points[g, 1] - y, points[g, 2] - z
        d = dx * dx + dy * dy + dz * dz
        if d <= best and is_alike(normals, signed, g, dx, dy, dz, nx, ny, nz, across):
            best, at = d, guess
    wide = np.sqrt(best) + HAIR
    for i in span(x, wide):
        beyond = _beyond(x, i)
        if beyond > best:
            continue
        for j in span(y, wide):
            if beyond + _beyond(y, j) > best:
                continue
            for m in row(starts, pose, i, j, z, wide):
                n = np.uintp(m)
                dx, dy, dz = points[n, 0] - x, points[n, 1] - y, points[n, 2] - z
                d = dx * dx + dy * dy + dz * dz
                if (d < best or (d == best and m > at)) and is_alike(
                    normals, signed, n, dx, dy, dz, nx, ny, nz, across
                ):
                    best, at = d, m
    return at, best if at >= 0 else FAR


@kernel
def distances(
    queries, query_normals, motions, points, normals, signed, starts, within, reach, across
):  # fmt: skip
    """Return (K, n) the distance of each query point, moved as in each pose, from what may be of
    the same surface in that pose; FAR beyond `reach`. `motions` (K, 3, 4), `within` as in
    `is_void`."""
    out = np.full((len(motions), len(queries)), FAR, np.float32)
    for k in range(len(motions)):
        for i in range(len(queries)):
            x, y, z, nx, ny, nz = moved(motions[k], queries[i], query_normals[i])
            if is_void(within, k, x, y, z):
                continue
            at, d = nearest(
                points, normals, signed, starts, k, x, y, z, nx, ny, nz, reach, across, -1
            )
            if at >= 0:
                out[k, i] = np.sqrt(d)
    return out


@helper
def meets(points, normals, signed, starts, pose, x, y, z, nx, ny, nz, reach, across):
    """Return whether `nearest` would find a point."""
    for i in span(x, reach):
        for j in span(y, reach):
            for m in row(starts, pose, i, j, z, reach):
                n = np.uintp(m)
                dx, dy, dz = points[n, 0] - x, points[n, 1] - y, points[n, 2] - z
                if dx * dx + dy * dy + dz * dz <= reach * reach and is_alike(
                    normals, signed, n, dx, dy, dz, nx, ny, nz, across
                ):
                    return True
    return False


@kernel
def met(
    queries, query_normals, wanted, motions, points, normals, signed, starts, within, reach, across
):  # fmt: skip
    """Return (K, n) whether each query point, moved as in each pose, lies on what may be of the
    same surface in that pose; False where it is not `wanted` (K, n). `motions` (K, 3, 4), `within`
    as in `is_void`."""
    out = np.zeros(wanted.shape, np.bool_)
    for k in range(len(motions)):
        for i in range(len(queries)):
            if not wanted[k, i]:
                continue
            x, y, z, nx, ny, nz = moved(motions[k], queries[i], query_normals[i])
            if not is_void(within, k, x, y, z):
                out[k, i] = meets(
                    points, normals, signed, starts, k, x, y, z, nx, ny, nz, reach, across
                )
    return out


@kernel
def about(queries, values, points, starts, reach, skip_self):
    """Return (n, 2) of the points of one pose within `reach` of each query: how many, and the sum
    of their `values`; `skip_self` leaves out those that are where the query is."""
    out = np.zeros((len(queries), 2))
    for i in range(len(queries)):
        x, y, z = queries[i, 0], queries[i, 1], queries[i, 2]
        for a in span(x, reach):
            for b in span(y, reach):
                for n in row(starts, 0, a, b, z, reach):
                    dx, dy, dz = points[n, 0] - x, points[n, 1] - y, points[n, 2] - z
                    d = dx * dx + dy * dy + dz * dz
                    if d <= reach * reach and not (skip_self and d == 0.0):
                        out[i, 0] += 1.0
                        out[i, 1] += values[n]
    return out


@kernel
def spacing(queries, points, starts, reach):
    """Return (n,) how far the nearest other point of the same cloud is; `reach` where none is
    nearer."""
    out = np.empty(len(queries))
    for i in range(len(queries)):
        x, y, z = queries[i, 0], queries[i, 1], queries[i, 2]
        best = reach * reach
        for a in span(x, reach):
            for b in span(y, reach):
                for n in row(starts, 0, a, b, z, reach):
                    dx, dy, dz = points[n, 0] - x, points[n, 1] - y, points[n, 2] - z
                    d = dx * dx + dy * dy + dz * dz
                    if 0.0 < d < best:
                        best = d
        out[i] = np.sqrt(best)
    return out


@helper
def _shape(C, normal, stiffness):  # noqa: PLR0912 - two rotations a line each
    """Jacobi's rotations of the symmetric (3, 3) covariance `C`, which is destroyed: into `normal`
    (3,) the direction of least variance, zeros where that is not much less than the others; into
    `stiffness` (3, 3) how well the points determine a shift: 1 along directions in which they
    spread little, ALONG where they spread most."""
    V = np.eye(3)
    for _ in range(8):
        for p in range(2):
            for q in range(p + 1, 3):
                if abs(C[p, q]) < 1e-15:
                    continue
                theta = (C[q, q] - C[p, p]) / (2.0 * C[p, q])
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(3):
                    a, b = C[k, p], C[k, q]
                    C[k, p], C[k, q] = c * a - s * b, s * a + c * b
                for k in range(3):
                    a, b = C[p, k], C[q, k]
                    C[p, k], C[q, k] = c * a - s * b, s * a + c * b
                for k in range(3):
                    a, b = V[k, p], V[k, q]
                    V[k, p], V[k, q] = c * a - s * b, s * a + c * b
    least = 0
    for k in range(1, 3):
        if C[k, k] < C[least, least]:
            least = k
    smaller = min(C[(least + 1) % 3, (least + 1) % 3], C[(least + 2) % 3, (least + 2) % 3])
    most = max(C[0, 0], C[1, 1], C[2, 2], 1e-30)
    for k in range(3):
        normal[k] = V[k, least] if C[least, least] < FLAT * smaller else 0.0
    stiffness[:] = 0.0
    for e in range(3):
        weight = max(1.0 - 2.0 * C[e, e] / most, ALONG)
        for i in range(3):
            for j in range(3):
                stiffness[i, j] += weight * V[i, e] * V[j, e]


@kernel
def shapes(queries, points, starts, reach):
    """Return the shape of what is within `reach` of each query: (n, 3) the unit normal, of either
    sign, of the plane through it, zeros where that is no plane; (n, 3, 3) its stiffness, see
    `_shape`."""
    out, stiffness = np.zeros((len(queries), 3)), np.zeros((len(queries), 3, 3))
    C = np.zeros((3, 3))
    for i in range(len(queries)):
        x, y, z = queries[i, 0], queries[i, 1], queries[i, 2]
        C[:] = 0.0
        sx = sy = sz = count = 0.0
        for a in span(x, reach):
            for b in span(y, reach):
                for n in row(starts, 0, a, b, z, reach):
                    dx, dy, dz = points[n, 0] - x, points[n, 1] - y, points[n, 2] - z
                    if dx * dx + dy * dy + dz * dz > reach * reach:
                        continue
                    count += 1.0
                    sx, sy, sz = sx + dx, sy + dy, sz + dz
                    C[0, 0] += dx * dx
                    C[0, 1] += dx * dy
                    C[0, 2] += dx * dz
                    C[1, 1] += dy * dy
                    C[1, 2] += dy * dz
                    C[2, 2] += dz * dz
        if count > 0.0:
            C[0, 0] -= sx * sx / count
            C[0, 1] -= sx * sy / count
            C[0, 2] -= sx * sz / count
            C[1, 1] -= sy * sy / count
            C[1, 2] -= sy * sz / count
            C[2, 2] -= sz * sz / count
        C[1, 0], C[2, 0], C[2, 1] = C[0, 1], C[0, 2], C[1, 2]
        _shape(C, out[i], stiffness[i])
    return out, stiffness


@kernel
def votes(turned, offsets, weights, grid):
    """Return the step at which most points land, for each of C candidates and each of eight poses.

    Args:
        turned: (T, 3, m) float32, the points at each of T steps, in cells of `grid`: coordinate by
            coordinate, so that several points are looked up at a time.
        offsets: (C, T, 3) float32, what each candidate adds to them.
        weights: (m,) uint64: byte k is 1 where the point counts in pose k.
        grid: (VOTES^3 + 1,) uint64: byte k is 1 where pose k has something new; at the end 0, for
            what is outside. At most 255 points.

    Returns:
        (C, 8) the greatest number of points, and (C, 8) the step where it is reached first.
    """
    C, T = offsets.shape[0], offsets.shape[1]
    nought, edge, row = np.float32(0.0), np.float32(VOTES), np.int32(VOTES)
    nowhere = np.int32(VOTES**3)
    most, step = np.zeros((C, 8), np.uint8), np.zeros((C, 8), np.int32)
    at = np.zeros(turned.shape[2], np.int32)
    for t in range(T):
        X, Y, Z = turned[t, 0], turned[t, 1], turned[t, 2]
        for c in range(C):
            ox, oy, oz = offsets[c, t, 0], offsets[c, t, 1], offsets[c, t, 2]
            for m in range(len(at)):
                x, y, z = X[m] + ox, Y[m] + oy, Z[m] + oz
                inside = (x >= nought) & (y >= nought) & (z >= nought)
                inside &= (x < edge) & (y < edge) & (z < edge)
                cell = (np.int32(x) * row + np.int32(y)) * row + np.int32(z)
                at[m] = cell if inside else nowhere
            total, m = np.uint64(0), 0
            while m < len(at) and at[m] >= 0:  # always: else loads become a gather, half as fast
                total += grid[np.uintp(at[m])] & weights[m]
                m += 1
            if total == 0:
                continue
            for k in range(8):
                count = np.uint8(total >> np.uint64(8 * k) & np.uint64(255))
                if count > most[c, k]:
                    most[c, k], step[c, k] = count, t
    return most, step


@kernel
def agreement(
    queries, query_normals, motions, points, normals, signed, starts, within, reach, across
):  # fmt: skip
    """Return (K, T) how well query points (m, 3), moved by each of `motions` (K, T, 3, 4), lie on
    each pose: the sum over them of 1 - (d / reach)^2, 0 beyond it. `within` as in `is_void`."""
    K, T = motions.shape[:2]
    out = np.zeros((K, T))
    for k in range(K):
        guess = np.full(len(queries), -1)
        for t in range(T):
            for i in range(len(queries)):
                x, y, z, nx, ny, nz = moved(motions[k, t], queries[i], query_normals[i])
                if is_void(within, k, x, y, z):
                    continue
                guess[i], d = nearest(
                    points, normals, signed, starts, k, x, y, z, nx, ny, nz, reach, across, guess[i]
                )
                if guess[i] >= 0:
                    out[k, t] += 1.0 - d / (reach * reach)
    return out
