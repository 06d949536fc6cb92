"""The patches of a grid that clouds fill, on a CPU: hardly a tenth of them hold anything."""

import numpy as np

from articugen.core.jit import helper, kernel


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
    count = 0
    for b in range(B):
        for i in range(n):
            x0, _ = _cell(clouds[b, i, 0], cells)
            y0, _ = _cell(clouds[b, i, 1], cells)
            z0, _ = _cell(clouds[b, i, 2], cells)
            for c in range(8):
                x, y, z = x0 + (c >> 2), y0 + (c >> 1 & 1), z0 + (c & 1)
                patch = ((b * blocks + x // along) * blocks + y // along) * blocks + z // along
                if row[patch] < 0:
                    row[patch] = count
                    filled[count] = patch
                    count += 1
    values = np.zeros((count, along**3), np.float32)
    for b in range(B):
        for i in range(n):
            x0, dx = _cell(clouds[b, i, 0], cells)
            y0, dy = _cell(clouds[b, i, 1], cells)
            z0, dz = _cell(clouds[b, i, 2], cells)
            for c in range(8):
                u, v, w = c >> 2, c >> 1 & 1, c & 1
                x, y, z = x0 + u, y0 + v, z0 + w
                patch = ((b * blocks + x // along) * blocks + y // along) * blocks + z // along
                inside = (x % along * along + y % along) * along + z % along
                share = dx if u else np.float32(1.0) - dx
                share *= dy if v else np.float32(1.0) - dy
                share *= dz if w else np.float32(1.0) - dz
                values[row[patch], inside] += share
    return filled[:count].copy(), values
