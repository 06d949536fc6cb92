"""What learners ask of a CPU in one pass: where the greatest values are, the patches of a grid that
clouds fill, hardly a tenth of which hold anything, and the points nearest to places."""

import numpy as np

from articugen.core.jit import helper, kernel


@kernel
def greatest(x, out):
    """out (B, C): the first place of a greatest value of each channel of x (B, n, C); single
    precision."""
    B, n, C = x.shape
    best, at = np.zeros(C, np.float32), np.zeros(C, np.int32)
    for b in range(B):
        for c in range(C):
            best[c], at[c] = x[b, 0, c], 0
        for i in range(1, n):
            for c in range(C):
                is_more = x[b, i, c] > best[c]
                best[c] = x[b, i, c] if is_more else best[c]
                at[c] = np.int32(i) if is_more else at[c]
        for c in range(C):
            out[b, c] = at[c]


@helper
def _cell(coordinate, cells):
    """Return the cell along an axis whose centre is the last one before a coordinate of the unit
    frame, and how far that is from it, in cells."""
    at = (coordinate + np.float32(0.5)) * np.float32(cells) - np.float32(0.5)
    at = min(max(at, np.float32(0.0)), np.float32(cells - 1.001))
    low = int(at)
    return low, at - np.float32(low)


@kernel
def patches(clouds, cells, along):
    """Return what clouds (B, n, 3), single precision, fill of a grid of `cells` an edge, by patches
    of `along` cells an edge.

    Returns:
        (M,) int64 which patches hold something, of B (cells / along)^3, in the order of points; and
        (M, along^3) float32 how many points each of their cells holds: a point counts to the eight
        cells whose centres surround it, by how near they are.
    """
    B, n, _ = clouds.shape
    blocks = cells // along
    row = np.full(B * blocks**3, -1, np.int32)
    filled = np.empty(min(len(row), 8 * B * n), np.int64)
    values = np.empty((len(filled), along**3), np.float32)
    count = 0
    for b in range(B):
        for i in range(n):
            x0, dx = _cell(clouds[b, i, 0], cells)
            y0, dy = _cell(clouds[b, i, 1], cells)
            z0, dz = _cell(clouds[b, i, 2], cells)
            for c in range(8):
                u, v, w = c >> 2, c >> 1 & 1, c & 1
                x, y, z = x0 + u, y0 + v, z0 + w
                patch = ((b * blocks + x // along) * blocks + y // along) * blocks + z // along
                if row[patch] < 0:
                    row[patch], filled[count] = count, patch
                    values[count] = 0.0
                    count += 1
                inside = (x % along * along + y % along) * along + z % along
                share = dx if u else np.float32(1.0) - dx
                share *= dy if v else np.float32(1.0) - dy
                share *= dz if w else np.float32(1.0) - dz
                values[row[patch], inside] += share
    return filled[:count].copy(), values[:count].copy()


@kernel
def nearest_of_firsts(clouds, places, firsts, out):
    """out (B, m, s, k): which points of clouds (B, n, 3) are the k nearest to places (B, m, 3), the
    nearest first, among the first `firsts` (s,) of them, ascending numbers; single precision.

    Fastest where a place is beside the one before: what was nearest to that is near to this.
    """
    B, m, s, k = out.shape
    n = clouds.shape[1]
    apart = np.empty(n, np.float32)
    is_near = np.zeros((n + 7) // 8 * 8, np.uint8)
    eights = is_near.view(np.uint64)
    far, at = np.empty(k, np.float32), np.zeros(k, np.int64)
    for b in range(B):
        axes = np.ascontiguousarray(clouds[b].T)
        X, Y, Z = axes[0], axes[1], axes[2]
        for i in range(m):
            x, y, z = places[b, i, 0], places[b, i, 1], places[b, i, 2]
            for j in range(n):
                u, v, w = X[j] - x, Y[j] - y, Z[j] - z
                apart[j] = u * u + v * v + w * w
            far[:] = np.inf
            for scale in range(s):
                bound, last = far[k - 1], firsts[scale]
                if i:
                    bound = min(bound, _farthest_of(apart, out, b, i - 1, scale))
                far[:] = np.inf
                for j in range(last):  # from 0, or it is not done by eight
                    is_near[j] = apart[j] <= bound
                for eight in range((last + 7) // 8):
                    if eights[eight]:
                        for j in range(8 * eight, min(8 * eight + 8, last)):
                            if is_near[j] and apart[j] < far[k - 1]:
                                _insert(far, at, apart[j], j)
                for place in range(k):
                    out[b, i, scale, place] = at[place]


@helper
def _farthest_of(apart, out, b, i, scale):
    most = np.float32(0.0)
    for place in range(out.shape[3]):
        most = max(most, apart[out[b, i, scale, place]])
    return most


@helper
def _insert(far, at, here, j):
    """Insert a number into the ascending `far` in place of the last one, and `j` into `at`."""
    place = len(far) - 1
    while place > 0 and far[place - 1] > here:
        far[place], at[place] = far[place - 1], at[place - 1]
        place -= 1
    far[place], at[place] = here, j
