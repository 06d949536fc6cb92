"""Whose each point of an object is, once its joints are known.

A point of a surface that is taken to move with the wrong part comes, in some of the poses, to where
no such surface is, but free space: this contradicts it. Where a surface goes on as it is, as a
plane that slides along itself, nothing does. So all points of a piece of surface are the part that
is contradicted least in the whole piece. Pieces of two parts may touch, and little of a piece may
show in one pose; so the poses vote: brought to rest as parts, points lie on points of the same
part, in the box of those that are surely that part's. What is inside is the part's whose surface is
the nearest.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bools, Floats, Ints
from articugen.core.geometry import invert_rigid
from articugen.discovery import kernels, owner_kernels
from articugen.discovery.clouds import Cells, Surface

POSES, POINTS = 21, 1024
"""Number of poses that are examined, and of points of each, about."""

JOINED, VOTING = 6.0, 2.5
"""Points of a plane so near are of one piece, and how near to a point others vote: both in mean
distances from one to the nearest."""

ROUNDS = 3
"""How often the poses vote."""

CELLS, REACH = 64, 0.06
"""Cells along an edge in which it is known how far surfaces are; those beyond are equally far."""

FEWEST, OUTLIERS = 20, 0.002
"""Points that show where a part is, and the share of them that its box leaves out along each axis,
each way."""

_INSIDE = 0.98 * REACH  # at most: what is nobody's surface is the part's in whose box it is

_SPARSE = 2.0 / kernels.CELLS  # the greatest distance from a point to the nearest

NOBODYS = 255
"""The part of a point that nothing is known of: it lies where others of its part hardly are."""

_LONELY = 0.2  # of the median of a part's points: such a share of it in votes

_SURE, _BEYOND = 0.1, 0.02
"""A point is surely a part's where others are contradicted in a share of poses larger by more than
the first; how far beyond the box of those that part may reach."""

_DOUBTED = 0.02  # how much a point counts for its piece that contradicts no part more than another


@dataclass(frozen=True, eq=False)
class Ownership:
    """Distances from the surfaces of each part, in its rest frame. P parts, part 0 is fixed.

    Attributes:
        owns: (P,) whether those are known; of a moving part too few points may show.
        middle, size: (P, 3) of a box along the axes that holds the part; `size` is half its edges.
        far: (P, CELLS, CELLS, CELLS) those of the centres of cells of the unit frame, at most
            REACH; in a moving part's box less than that.
    """

    owns: Bools
    middle: Floats
    size: Floats
    far: NDArray[np.float16]

    @staticmethod
    def of(
        clouds: Sequence[Floats], part: NDArray[np.uint8], motion: NDArray[np.float64]
    ) -> "Ownership":
        """Return those of an object whose `examined` points are of parts (n,).

        Args:
            clouds: K poses (n_k, 3) in the unit frame.
            motion: (K, P, 4, 4) of each part from its rest frame.
        """
        poses, some = examined(clouds)
        T = invert_rigid(motion[poses])[np.repeat(np.arange(len(poses)), [*map(len, some)])]
        points, P = np.concatenate(some), motion.shape[1]
        owns, bounds = np.arange(P) == 0, np.zeros((P, 2, 3))
        far = np.empty((P, CELLS, CELLS, CELLS), np.float16)
        for p in range(P):
            back = T[part == p, p]
            rest = (back[:, :3, :3] @ points[part == p, :, None])[..., 0] + back[:, :3, 3]
            far[p] = owner_kernels.far_from(rest, CELLS, REACH)
            if len(rest) >= FEWEST:
                owns[p], bounds[p] = True, _bounds(rest)
                if p:
                    low, high = np.clip(np.round((bounds[p] + 0.5) * CELLS), 0, CELLS).astype(int)
                    box = far[p, low[0] : high[0], low[1] : high[1], low[2] : high[2]]
                    np.minimum(box, _INSIDE, out=box)
        return Ownership(owns, bounds.mean(1), 0.5 * np.ptp(bounds, axis=1), far)


def examined(clouds: Sequence[Floats]) -> tuple[Ints, list[Floats]]:
    """Return some of an object's poses, and some points (or normals) of each of those clouds."""
    poses = np.unique(np.linspace(0, len(clouds) - 1, POSES).astype(int))
    return poses, [clouds[k][:: max(len(clouds[k]) // POINTS, 1)] for k in poses]


def parts_of_surface(
    clouds: Sequence[Floats], normals: Sequence[Floats], motion: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Return (n,) the parts of the `examined` points, by the surfaces and how parts moved, or
    NOBODYS.

    Args:
        clouds, normals: K poses (n_k, 3) of one object in the unit frame, outward normals.
        motion: (K, P, 4, 4) of each part from its rest frame.
    """
    poses, some = examined(clouds)
    cells = _cells(some, examined(normals)[1])
    points, facing = cells.points, cells.normals  # neighbours beside each other
    pose = np.repeat(np.arange(len(poses)), [*map(len, some)])
    apart = kernels.spacing(points[pose == 0], points, cells.starts, _SPARSE).mean()
    piece = owner_kernels.pieces(points, facing, cells.starts, JOINED * apart)
    T, M = invert_rigid(motion[poses])[pose].swapaxes(0, 1), motion[poses, :, :3].swapaxes(0, 1)
    rest = (T[..., :3, :3] @ points[..., None])[..., 0] + T[..., :3, 3]
    facing = (T[..., :3, :3] @ facing[..., None])[..., 0]
    whole = _cells([clouds[k] for k in poses], [normals[k] for k in poses])
    at = whole.points, whole.normals, whole.starts
    doubt = map(partial(owner_kernels.contradicted, *at), rest, facing, np.ascontiguousarray(M))
    part = _by_votes(np.array([*doubt]), piece, rest, facing, pose, VOTING * apart)
    return part[np.argsort(cells.order)].astype(np.uint8)


def _cells(clouds: Iterable[Floats], normals: Iterable[Floats]) -> Cells:
    return Cells.of([Surface.bare(*both) for both in zip(clouds, normals, strict=True)])


def _least_doubted(doubt: Floats, piece: Ints) -> Ints:
    """Return (n,) the part of each point: that which is contradicted least in its piece, where a
    point counts the more, the surer it is.

    Args:
        doubt: (P, n) in which share of the poses each point is contradicted as each part.
        piece: (n,) as of `owner_kernels.pieces`.
    """
    least, second = np.sort(doubt, axis=0)[:2]
    counts = _DOUBTED + second - least
    summed = [np.bincount(piece, counts * against, len(piece)) for against in doubt]
    return np.argmin(summed, axis=0)[piece]


def _by_votes(
    doubt: Floats, piece: Ints, rest: Floats, facing: Floats, pose: Ints, near: float
) -> Ints:
    """Return (n,) the parts of the points of other poses that lie around each at rest, or NOBODYS.

    Args:
        doubt, piece: as for `_least_doubted`, whose parts the points are at first.
        rest, facing: (P, n, 3) the points and their normals, brought to rest as each part.
        pose: (n,) that each point is of.
        near: how near those are that count.
    """
    part = _least_doubted(doubt, piece)
    cells = _cells(rest, facing)
    order = cells.order % len(part)
    at = cells.points, cells.normals, cells.starts
    votes, every = np.zeros((len(part), len(rest))), np.arange(len(part))
    for _ in range(ROUNDS):
        reach = _reach(part, doubt, rest)
        votes = owner_kernels.ballots(rest, facing, pose, *at, part[order], pose[order], near)
        votes *= reach
        part = np.where(votes.any(1), votes.argmax(1), part * reach[every, part])
    most = votes.max(1)
    for p in np.unique(part):
        part[(part == p) & (most <= _LONELY * np.median(most[part == p]))] = NOBODYS
    return part


def _reach(part: Ints, doubt: Floats, rest: Floats) -> Bools:
    """Return (n, P) whether points, brought to rest (P, n, 3) as each part, are about where those
    are that are surely of that part."""
    reach = np.ones((len(part), len(rest)), bool)
    for p in range(1, len(rest)):
        surely = rest[p, (part == p) & (np.delete(doubt, p, 0).min(0) > doubt[p] + _SURE)]
        if len(surely) >= FEWEST:
            low, high = _bounds(surely)
            reach[:, p] = ((low - _BEYOND <= rest[p]) & (rest[p] <= high + _BEYOND)).all(1)
    return reach


def _bounds(points: Floats) -> Floats:
    """Return (2, 3) the corners of a box around points (n, 3), but for OUTLIERS."""
    return np.quantile(points, [OUTLIERS, 1.0 - OUTLIERS], axis=0)
