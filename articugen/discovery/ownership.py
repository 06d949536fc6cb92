"""Whose each point of an object is, once its joints are known.

A point that is taken to move with the wrong part comes, in some of the poses, to where nothing is:
this contradicts it. Points that are contradicted of all parts but one are surely that part's. Of a
moving part they span a box; points in it in the part's rest frame that are hardly contradicted are
the part's own, and points on the box's rim if they are surely not the fixed part's. All else is the
fixed part's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from articugen.core.geometry import invert_rigid
from articugen.core.records import Floats
from articugen.discovery import kernels
from articugen.discovery.clouds import Cells, Surface, widened

ASKED, ASKING, POINTS = 21, 41, 400
"""Number of poses that are asked, of poses whose points are asked about, and of points of each."""

REACH = 0.02  # where a cloud has no point this near, it has no surface; in the unit frame

RARELY, CLEARLY = 0.15, 0.08
"""A part's own points are contradicted in this share of the poses at most; a point is sure of its
part where that is contradicted so much less than any other."""

FEWEST_SURE, OUTLIERS = 20, 0.002
"""Sure points that a box needs, and the share of them that it leaves out along each axis, each
way."""

RIM = 0.03
"""So far around a box a point that is surely not the fixed part's is the part's own: sure points
are few where parts meet, and leave the box's ends out."""

MOST_DOUBT = 0.2
"""What is contradicted in a greater share of the poses is not the part's, wherever it lies."""


@dataclass(frozen=True, eq=False)
class Ownership:
    """Material of each part, in its rest frame. P parts, part 0 is fixed.

    Attributes:
        owns: (P,) whether it is known where; of a moving part too few points may be sure.
        middle, size: (P, 3) of a box along the axes that holds the part; `size` is half its edges.
        doubt: (P, R, R, R) in which share of the poses the part is contradicted at the centres of
            cells of the unit frame; 0 where neither its box nor the rim comes, of part 0 where no
            pose decides.
    """

    owns: NDArray[np.bool_]
    middle: Floats
    size: Floats
    doubt: NDArray[np.float32]

    def part_of(self, rest: Floats) -> NDArray[np.int64]:
        """Return (n,) the parts of points that would be at `rest` (P, n, 3) if they were of each
        part."""
        R = self.doubt.shape[1]
        i, j, k = np.moveaxis(np.clip(((rest + 0.5) * R).astype(np.int64), 0, R - 1), -1, 0)
        doubt = self.doubt[np.arange(len(rest))[:, None], i, j, k]
        best, part = np.full(rest.shape[1], MOST_DOUBT), np.zeros(rest.shape[1], np.int64)
        for p in np.flatnonzero(self.owns[1:]) + 1:
            beyond = (np.abs(rest[p] - self.middle[p]) - self.size[p]).max(1)
            rim = np.where(beyond <= RIM, np.minimum(RARELY, doubt[0] - CLEARLY), 0.0)
            better = doubt[p] < np.minimum(best, np.where(beyond <= 0.0, MOST_DOUBT, rim))
            best, part = np.where(better, doubt[p], best), np.where(better, p, part)
        return part


def assign_material(
    clouds: Sequence[Floats], hidden: NDArray[np.bool_], motion: NDArray[np.float64]
) -> Ownership:
    """Find it from surfaces, free space and how the parts moved.

    Args:
        clouds: K poses, (n_k, 3) surface points each, in the unit frame.
        hidden: (K, R, R, R) voxels of the unit frame that are not free: material, or enclosed.
        motion: (K, P, 4, 4) of each part from its rest frame.
    """
    K, P = motion.shape[:2]
    poses = np.unique(np.linspace(0, K - 1, ASKED).astype(int))
    surfaces = Cells.of([Surface.bare(clouds[k]) for k in poses])
    evidence = _Evidence(surfaces, widened(hidden[poses].astype(np.uint8), 1), motion[poses])
    asking = np.unique(np.linspace(0, K - 1, ASKING).astype(int))
    some = [clouds[k][:: len(clouds[k]) // POINTS + 1] for k in asking]
    back = zip(some, invert_rigid(motion[asking]), strict=True)
    rest = np.concatenate([np.einsum("pij,nj->pni", T[:, :3, :3], cloud) + T[:, None, :3, 3]
                           for cloud, T in back], 1)  # fmt: skip
    doubt = np.stack([evidence.against(rest[p], p) for p in range(P)])
    boxes = [_box_of_sure(rest, doubt, p) for p in range(1, P)]
    owns = np.array([True, *(box is not None for box in boxes)])
    bounds = [np.zeros((2, 3)), *(np.zeros((2, 3)) if box is None else box for box in boxes)]
    middle = np.array([0.5 * (low + high) for low, high in bounds])
    size = np.array([0.5 * (high - low) for low, high in bounds])
    cells = [evidence.of_fixed(), *(evidence.around(bounds[p], p) for p in range(1, P))]
    moving = Ownership(owns, middle, size, np.array(cells, np.float32))
    fixed = rest[0][moving.part_of(rest) == 0]
    if not len(fixed):
        return moving
    low, high = _bounds(fixed)
    middle, size = middle.copy(), size.copy()
    middle[0], size[0] = 0.5 * (low + high), 0.5 * (high - low)
    return replace(moving, middle=middle, size=size)


@dataclass(frozen=True, eq=False)
class _Evidence:
    """Evidence of some poses: `cells` of their surfaces, `taken` (K, R, R, R) voxels that have
    something in them or beside them, `motion` (K, P, 4, 4)."""

    cells: Cells
    taken: NDArray[np.uint8]
    motion: NDArray[np.float64]

    def against(self, rest: Floats, part: int) -> Floats:
        """Return (n,) the share of the poses in which points, at rest (n, 3), come to where nothing
        is."""
        M = np.ascontiguousarray(self.motion[:, part, :3])
        rest = np.ascontiguousarray(rest)
        return kernels.to_nothing(rest, M, self.taken, self.cells.points, self.cells.starts, REACH)

    def around(self, bounds: Floats, part: int) -> Floats:
        """Return (R, R, R) the same of the centres of cells that lie within bounds or on their rim,
        else 0."""
        R = self.taken.shape[1]
        centres, beside = (np.arange(R) + 0.5) / R - 0.5, RIM + 1.0 / R
        i, j, k = ((centres > low - beside) & (centres < high + beside) for low, high in bounds.T)
        wanted = i[:, None, None] & j[:, None] & k
        return self._on_grid(wanted if np.ptp(bounds) else np.zeros_like(wanted), part)

    def of_fixed(self) -> Floats:
        """Return (R, R, R) the same of part 0 where something is in some of the poses, else 0."""
        return self._on_grid((self.taken.max(0) > 0) & (self.taken.min(0) == 0), 0)

    def _on_grid(self, wanted: NDArray[np.bool_], part: int) -> Floats:
        """Return (R, R, R) the same of the centres of the cells that are `wanted`, else 0."""
        out = np.zeros(wanted.shape)
        out[wanted] = self.against((np.argwhere(wanted) + 0.5) / len(wanted) - 0.5, part)
        return out


def _box_of_sure(rest: Floats, doubt: Floats, part: int) -> Floats | None:
    """Return (2, 3) the least and greatest coordinates of a part's sure points, None if they are
    few."""
    others = np.delete(doubt, part, axis=0).min(0)
    sure = (doubt[part] < RARELY) & (others - doubt[part] > CLEARLY)
    return _bounds(rest[part][sure]) if sure.sum() >= FEWEST_SURE else None


def _bounds(points: Floats) -> Floats:
    return np.quantile(points, [OUTLIERS, 1.0 - OUTLIERS], axis=0)
