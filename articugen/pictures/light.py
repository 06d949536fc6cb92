"""How much of the sky a cloud of surface points hides from places on it and off it.

The share of the sky that a small disc hides is its form factor, after Bunnell 2005, "Dynamic
ambient occlusion and indirect lighting"; discs behind each other are counted twice.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Floats, Ints
from articugen.core.jit import dot, helper, inlined, kernel, squared, vector
from articugen.core.near import cells_of, near, reached

ENOUGH = 2500  # of a larger cloud about so many points stand for all where a sum goes over all
DETAIL = 1.0  # within so many spacings of a coarse cloud a finer one says what hides the sky


@dataclass(frozen=True, eq=False)
class SurfaceCloud:
    """Points of a surface.

    Attributes:
        points, normals: (n, 3), unit normals.
        area: (n,) the surface that each point stands for.
    """

    points: Floats
    normals: Floats
    area: Floats

    def __getitem__(self, which: slice | Ints) -> "SurfaceCloud":
        return SurfaceCloud(self.points[which], self.normals[which], self.area[which])

    def thinned(self, step: int) -> "SurfaceCloud":
        """Return every `step`-th point, with `step` times the area."""
        few = self[::step]
        return SurfaceCloud(few.points, few.normals, step * few.area)

    def few(self) -> "SurfaceCloud":
        """Not many more than `ENOUGH` points."""
        return self.thinned(max(len(self.points) // ENOUGH, 1))

    def columns(self) -> tuple[NDArray[np.float32], ...]:
        """Seven times (n,): points, normals and area, as the sums read them quickest. Rows of one
        table would not do: numba takes them for strided, and gathers instead of loading."""
        table = np.concatenate([self.points.T, self.normals.T, self.area[None]])
        return tuple(np.ascontiguousarray(table, dtype=np.float32))


def occlusion(at: Floats, facing: Floats, cloud: SurfaceCloud) -> Floats:
    """Return the share of the cosine-weighted sky that `cloud` hides from `at` (m, 3): (m,).

    Args:
        facing: (m, 3) the unit normals at these places.
    """
    return np.minimum(_far(at, facing, cloud.few().columns(), 1e-6), 1.0)


def occlusion_in_detail(
    at: Floats, facing: Floats, coarse: SurfaceCloud, fine: SurfaceCloud
) -> Floats:
    """Compute `occlusion` for many places `at` (m, 3) on the surface that two clouds lie on.

    What the far hides changes slowly: it is summed up at some points of `coarse` only and averaged
    over those around a place that face as it does. What the near hides comes from `fine`.
    """
    few = coarse.few()
    around = 2.0 * float(np.sqrt(np.median(few.area)))
    detail = DETAIL * float(np.sqrt(np.median(coarse.area)))
    hidden = _far(few.points, few.normals, coarse.thinned(2).columns(), detail)
    cells = cells_of(few.points, around)
    far = _carried(at, facing, few.points, few.normals, hidden, cells, around)
    alone = np.isnan(far)
    far[alone] = _far(at[alone], facing[alone], few.columns(), detail)
    fine = fine.thinned(2)
    cells = cells_of(fine.points, 0.5 * detail)
    close = _near(at, facing, fine[cells.order].columns(), cells, detail)
    return np.minimum(far + close, 1.0)


@inlined
def _hidden(at, facing, columns, first, last, detail, is_far):
    """Compute the share that discs first to last hide, those within `detail` or those beyond, with
    a soft border.

    Discs much nearer than their size count less than they should: of a random covering, the few
    that happen to be so near would speckle. In single precision and without a branch, which lets
    the compiler take eight at a time.
    """
    ax, ay, az = at
    fx, fy, fz = facing
    px, py, pz, nx, ny, nz, area = columns
    scale = np.float32(1.0 / (detail * detail))
    sign = np.float32(1.0 if is_far else -1.0)
    offset = np.float32(0.0 if is_far else 1.0)
    zero, one, two, three = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(3.0)
    pi, tiny = np.float32(np.pi), np.float32(1e-12)
    total = zero
    for j in range(first, last):
        x, y, z = px[j] - ax, py[j] - ay, pz[j] - az
        squared = x * x + y * y + z * z + tiny
        above = max(x * fx + y * fy + z * fz, zero)
        toward = max(-(x * nx[j] + y * ny[j] + z * nz[j]), zero)
        t = min(squared * scale, one)
        weight = offset + sign * (t * t * (three - two * t))
        total += (
            weight * area[j] * above * toward / ((squared + area[j]) * (pi * squared + area[j]))
        )
    return total


@helper
def _single(vectors, i):
    return np.float32(vectors[i, 0]), np.float32(vectors[i, 1]), np.float32(vectors[i, 2])


@kernel(fastmath=True)
def _far(at, facing, columns, detail):
    hidden = np.empty(len(at))
    for i in range(len(at)):
        here, up = _single(at, i), _single(facing, i)
        hidden[i] = _hidden(here, up, columns, 0, len(columns[0]), detail, True)
    return hidden


@kernel(fastmath=True)
def _near(at, facing, columns, cells, detail):
    """Return the columns in the order of the cells."""
    hidden = np.zeros(len(at))
    cube = cells.first
    for i in range(len(at)):
        here, up = _single(at, i), _single(facing, i)
        x_low, x_end = reached(cells, 0, at[i, 0], detail)
        y_low, y_end = reached(cells, 1, at[i, 1], detail)
        z_low, z_end = reached(cells, 2, at[i, 2], detail)
        for x in range(x_low, x_end):
            for y in range(y_low, y_end):
                row = (x * cells.shape[1] + y) * cells.shape[2]
                first, last = cube[row + z_low], cube[row + z_end]
                hidden[i] += _hidden(here, up, columns, first, last, detail, False)
    return hidden


@kernel
def _carried(at, facing, points, normals, values, cells, reach):
    """Return the mean of the values at the points around each place that face as it does; nan if
    none."""
    means = np.empty(len(at))
    nearest = np.empty(len(points), np.int64)
    for i in range(len(at)):
        here, up = vector(at, i), vector(facing, i)
        total = weight = 0.0
        for n in range(near(cells, points, here, reach, nearest)):
            j = nearest[n]
            alike = dot(up, vector(normals, j))
            if alike <= 0.5:
                continue
            w = alike**4 * (1.0 - squared(here, vector(points, j)) / (reach * reach)) ** 2
            total += w * values[j]
            weight += w
        means[i] = total / weight if weight > 0.0 else np.nan
    return means
