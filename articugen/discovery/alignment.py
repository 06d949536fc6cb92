"""Objects of one category, each stretched along x, y and z until its surface agrees with that of
the others, as in congealing (Learned-Miller 2006): fixed parts then lie on one another, and moving
parts do not, as each is in a state of its own.

Surfaces are compared as the cells that they are in, apart by the way that they face.
"""

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Floats, Ints
from articugen.core.jit import kernel

SIDE, CELLS = 1.6, 32
"""The cube in which objects are compared, and cells along an edge of it."""
_SPILL = 0.6  # a surface counts so much in the cells beside its own

# How far both faces of an object's box are tried along an axis, and in which steps, in turns.
_ROUNDS = ((0.24, 0.04), (0.24, 0.04), (0.12, 0.03), (0.06, 0.015), (0.03, 0.0075))
_SAMPLE = 1500  # points of an object that are moved
_STRETCH = 0.15  # agreement that is worth a stretch by a factor e
_LEAST, _MOST = 0.4, 2.0  # an object's extent becomes so many times its own


def facing_of(normals: Floats) -> Ints:
    """Return (...) which of the six ways along the axes normals (..., 3) point most."""
    axis = np.abs(normals).argmax(-1)
    return 2 * axis + (np.take_along_axis(normals, axis[..., None], -1)[..., 0] > 0)


def grid_of(points: Floats, facing: Ints, R: int = CELLS) -> NDArray[np.float32]:
    """Return (6, R, R, R) 1 where a surface is, less in the cells beside it."""
    grid = np.zeros((6, R, R, R), np.float32)
    at = np.floor((points / SIDE + 0.5) * R).astype(np.int64)
    inside = np.all((at >= 0) & (at < R), axis=1)
    grid[(facing[inside], *at[inside].T)] = 1.0
    for axis in (1, 2, 3):
        beside = np.roll(grid, 1, axis) + np.roll(grid, -1, axis)
        grid = np.minimum(grid + _SPILL * beside, np.float32(1.0))
    return grid


def values_at(grid: NDArray[Any], points: Floats, facing: Ints) -> Floats:
    """Return (n,) what a grid has where the points are."""
    R = grid.shape[1]
    at = np.clip(np.floor((points / SIDE + 0.5) * R).astype(np.int64), 0, R - 1)
    return grid[(facing, *at.T)].astype(np.float64)


@kernel
def _stretched(points, cls, low, high, axis, steps, least, most, others, side):  # pragma: no cover
    """Return (S, S) how well an object agrees with `others` (6, R, R, R) as both faces of its box
    are moved by `steps` (S,) along an axis: the cosine between the cells that it has and those. An
    object's `points` (n, 3) are shares of its box."""
    R, count = others.shape[1], len(points)
    flat, wide = others.reshape(-1), np.array([R * R, R, 1])
    stamp, start = np.zeros(6 * R**3, np.int32), np.empty(count, np.int64)
    for n in range(count):
        start[n] = cls[n] * R**3
        for k in range(3):
            if k != axis and start[n] >= 0:
                at = low[k] + points[n, k] * (high[k] - low[k])
                c = int(np.floor((at / side + 0.5) * R))
                start[n] = start[n] + c * wide[k] if 0 <= c < R else -1
    out = np.full((len(steps), len(steps)), -1.0)
    for t in range(len(steps) * len(steps)):
        a, b = t // len(steps), t % len(steps)
        first, extent = low[axis] + steps[a], high[axis] + steps[b] - low[axis] - steps[a]
        if extent < least or extent > most:
            continue
        total, cells = 0.0, 0
        for n in range(count):
            c = int(np.floor(((first + points[n, axis] * extent) / side + 0.5) * R))
            if start[n] < 0 or c < 0 or c >= R:
                cells += 1
                continue
            cell = start[n] + c * wide[axis]
            if stamp[cell] != t + 1:
                stamp[cell] = t + 1
                cells += 1
                total += flat[cell]
        out[a, b] = total / np.sqrt(cells)
    return out


class Alignment:
    """Objects in boxes from `low` to `high` (N, 3) of the common frame, which are moved."""

    def __init__(self, clouds: Sequence[Floats], facing: Sequence[Ints]) -> None:
        rng = np.random.default_rng(0)
        some = [rng.permutation(len(cloud))[:_SAMPLE] for cloud in clouds]
        self.corner = np.array([cloud.min(0) for cloud in clouds])
        self.size = np.array([np.maximum(np.ptp(cloud, axis=0), 1e-6) for cloud in clouds])
        self.points = [
            np.ascontiguousarray((cloud[which] - corner) / size)
            for cloud, which, corner, size in zip(clouds, some, self.corner, self.size, strict=True)
        ]
        self.facing = [ways[which] for ways, which in zip(facing, some, strict=True)]

    def best(self) -> tuple[Floats, Floats, Floats]:
        """Return the stretches, the shifts and the agreement of the best alignment."""
        starts = []
        for anchor in product((0.0, 0.5, 1.0), repeat=3):  # low faces, middles or high faces meet
            low = -self.size * anchor + self.size.mean(0) * (np.array(anchor) - 0.5)
            starts.append((low, low + self.size))
        low, high = self._settled(*max(starts, key=lambda boxes: self._agreement(*boxes).mean()))
        stretch = (high - low) / self.size
        return stretch, low - stretch * self.corner, self._agreement(low, high)

    def _grid(self, i: int, low: Floats, high: Floats) -> NDArray[np.float32]:
        return grid_of(low[i] + self.points[i] * (high[i] - low[i]), self.facing[i])

    def _agreement(self, low: Floats, high: Floats) -> Floats:
        grids = np.array([self._grid(i, low, high) for i in range(len(low))])
        whole, count = grids.sum(0), len(grids) - 1
        shares = [(((whole - g) / count) ** 2 * g).sum() / max(g.sum(), 1.0) for g in grids]
        return np.sqrt(shares)

    def _settled(self, low: Floats, high: Floats) -> tuple[Floats, Floats]:
        """Return boxes with each object in turn where it agrees best with the others."""
        low, high = low.copy(), high.copy()
        for reach, step in _ROUNDS:
            steps = np.arange(-reach, reach + 1e-9, step)
            grids = [self._grid(i, low, high) for i in range(len(low))]
            whole = np.sum(grids, axis=0)
            for i, grid in enumerate(grids):
                others = ((whole - grid) / (len(low) - 1)) ** 2
                others /= max(float(np.sqrt((others**2).sum())), 1e-9)
                for axis in (2, 0, 1):
                    self._move(i, axis, steps, low, high, others)
                whole += self._grid(i, low, high) - grid
            factor = np.exp(np.log((high - low) / self.size).mean(0))  # of all objects it stays 1
            middle = 0.5 * (low + high).mean(0)
            low, high = (low - middle) / factor, (high - middle) / factor
        return low, high

    def _move(
        self, i: int, axis: int, steps: Floats, low: Floats, high: Floats, others: Any
    ) -> None:
        size, extent = self.size[i, axis], high[i, axis] - low[i, axis]
        score = _stretched(
            self.points[i], self.facing[i], low[i], high[i], axis, steps,
            _LEAST * size, _MOST * size, others, SIDE,
        )  # fmt: skip
        ratio = np.maximum(extent + steps - steps[:, None], 0.01) / extent
        score *= 1.0 - _STRETCH * np.abs(np.log(ratio))
        a, b = np.unravel_index(int(score.argmax()), score.shape)
        low[i, axis] += steps[a]
        high[i, axis] += steps[b]
