"""Several poses of one object, prepared for the search: in one cube, sorted into cells, with what
has left pose 0 and what is new elsewhere."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bools, Ints
from articugen.core.errors import InvalidArgument
from articugen.core.records import Floats, Normalization
from articugen.discovery import kernels
from articugen.discovery.views import Sight
from articugen.meshes.points import finite

MOST_POINTS = 8192  # points of a pose that are searched; more are thinned to so many

SEARCHED = 8  # poses that are searched, besides pose 0: as many as a vote has bytes

_EDGE = 0.9
_STAYS = 0.03  # of a pose's points, at least so many lie where pose 0 has matter
_ACROSS = 0.008  # planes so near may be the same

TELLING, _COMMON = 4, 0.55
"""Of the first many poses or more, what the second share of the others has at the same place is no
news."""
_HIDES, _BARE = 0.01, 0.2  # steps before what is new; unless less than such a share is left
_NEAR = np.array([0.008, 0.05])


def cell_of(cloud: Floats) -> NDArray[np.uint16]:
    """Return (n,) the number of the cell that each point is in; what is outside counts to the
    border. Of 16 bits, which numpy sorts by radix."""
    R = kernels.CELLS
    i, j, k = np.clip((cloud.T + 0.5) * R, 0.0, R - 1.0).astype(np.uint16)
    return (i * np.uint16(R) + j) * np.uint16(R) + k


@dataclass(frozen=True, eq=False)
class Surface:
    """`points` (n, 3) with unit `normals` (n, 3), zeros where none is known, and how well each
    determines a shift, `stiffness` (n, 3, 3). Where `signed`, normals point out of the material,
    else either way."""

    points: Floats
    normals: Floats
    stiffness: Floats
    signed: bool = False

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, which: Any) -> "Surface":
        return Surface(self.points[which], self.normals[which], self.stiffness[which], self.signed)

    def moved(self, M: Floats) -> "Surface":
        """Return it moved by `M` (3, 4)."""
        points = self.points @ M[:, :3].T + M[:, 3]
        return replace(self, points=points, normals=self.normals @ M[:, :3].T)

    @staticmethod
    def bare(points: Floats, outward: Floats | None = None) -> "Surface":
        """Points of which nothing else is known, or their `outward` normals (n, 3)."""
        signed = outward is not None
        normals = outward if signed else np.zeros_like(points)
        return Surface(points, normals, np.broadcast_to(np.eye(3), (len(points), 3, 3)), signed)

    def shaped(self, of: "Cells", near: float) -> "Surface":
        """Return the surface with normals and stiffness by the cloud `of` (one pose) around the
        points; normals that are known stay."""
        normals, stiffness = kernels.shapes(self.points, of.points, of.starts, 1.8 * near)
        return replace(self, normals=self.normals if self.signed else normals, stiffness=stiffness)


@dataclass(frozen=True, eq=False)
class Cells:
    """Surfaces of K poses, each pose's points sorted by cell: `points`, `normals` (n, 3) and
    `starts` (K, cells + 1), with the `order` (n,) that sorts them; `near` as in `Change`, `signed`
    as in `Surface`. Grids of what is `within` some cells of a point are made when first needed."""

    points: Floats
    normals: Floats
    starts: NDArray[np.int32]
    order: NDArray[np.int64]
    near: float
    signed: bool
    _within: dict[int, NDArray[np.uint8]] = field(default_factory=dict)

    @staticmethod
    def of(surfaces: Sequence[Surface], near: float = 0.0) -> "Cells":
        starts, orders, before = [], [], 0
        for surface in surfaces:
            cell = cell_of(surface.points)
            orders.append(before + np.argsort(cell, kind="stable"))
            counts = np.bincount(cell, minlength=kernels.CELLS**3)
            starts.append(before + np.concatenate([[0], np.cumsum(counts)]))
            before += len(surface)
        order = np.concatenate(orders)
        points = np.concatenate([surface.points for surface in surfaces])[order]
        normals = np.concatenate([surface.normals for surface in surfaces])[order]
        signed = all(surface.signed for surface in surfaces)
        return Cells(points, normals, np.array(starts, np.int32), order, near, signed)

    def __len__(self) -> int:
        return len(self.starts)

    def pose(self, k: int) -> Surface:
        """Return the points of one pose, sorted."""
        begin, end = self.starts[k][[0, -1]]
        outward = self.normals[begin:end] if self.signed else None
        return Surface.bare(self.points[begin:end], outward)

    def within(self, reach: float) -> NDArray[np.uint8]:
        """Return (G, VOTES^3) the bits by which `kernels.is_void` knows what is out of reach."""
        steps = int(np.ceil(reach * kernels.VOTES))
        if steps not in self._within:
            marks = self._marks()
            R = kernels.VOTES
            self._within[steps] = widened(marks.reshape(-1, R, R, R), steps).reshape(len(marks), -1)
        return self._within[steps]

    def _marks(self) -> NDArray[np.uint8]:
        """Return (G, VOTES^3) bit k % 8 of byte `[k // 8, cell]` is 1 where pose k has a point."""
        R = kernels.VOTES
        marks = np.zeros((-(-len(self) // 8), R**3), np.uint8)
        i, j, k = np.clip(((self.points + 0.5) * R).astype(np.int64), 0, R - 1).T
        cell = (i * R + j) * R + k
        for pose, starts in enumerate(self.starts):
            cells = cell[starts[0] : starts[-1]]
            marks[pose // 8, cells] |= np.uint8(1 << pose % 8)
        return marks

    def _of(self, surface: Surface, *of_each: Any, reach: float) -> tuple[Any, ...]:
        """Return the arguments of the kernels, in the one layout that these are compiled for."""
        moved = map(np.ascontiguousarray, (surface.points, surface.normals, *of_each))
        return (
            *moved, self.points, self.normals, self.signed,
            self.starts, self.within(reach), reach, self.across(reach),
        )  # fmt: skip

    def distances(self, surface: Surface, motions: Floats, reach: float) -> NDArray[np.float32]:
        """Return (K, n) from each pose, of points moved by `motions` (K, 3, 4)."""
        return kernels.distances(*self._of(surface, motions, reach=reach))

    def agreement(self, surface: Surface, motions: Floats, reach: float) -> Floats:
        """Return (K, T) how well points lie on each pose, the more the nearer they are to it, moved
        by each of `motions`: (K, T, 3, 4), or (T, 3, 4) of every pose."""
        of_each = np.array(np.broadcast_to(motions, (len(self), *motions.shape[-3:])), order="C")
        return kernels.agreement(*self._of(surface, of_each, reach=reach))

    def across(self, reach: float) -> float:
        """Return how far from plane to plane points within `reach` may be: planes are known better
        than where on them a cloud has points."""
        return max(reach - 0.6 * self.near, _ACROSS)

    def facing(self, surface: Surface) -> Bools:
        """Return (K, n) which points a face of each pose faces closely, so that neither shows."""
        turned = replace(surface, normals=-surface.normals)
        return _covered(turned, self, -np.arange(3), max(2.0 * _HIDES, self.near))

    def met(
        self,
        surface: Surface,
        motions: Floats,
        reach: float,
        wanted: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.bool_]:
        """Return (K, n) whether points, moved by `motions` (K, 3, 4), lie on each pose; False where
        that is not `wanted` (K, n)."""
        if wanted is None:
            wanted = np.ones((len(motions), len(surface)), np.bool_)
        return kernels.met(*self._of(surface, wanted, motions, reach=reach))


@dataclass(frozen=True, eq=False)
class Change:
    """Evidence of an object's poses, in the cube.

    Attributes:
        frame: leads from the clouds' own frame to the cube's.
        others: the clouds of all poses but pose 0, thinned, with the normals that were given.
        near: two surfaces that are nearer than this may be the same.
        start: pose 0, likewise; `first`: the same in cells.
        chosen: (S,) the poses that are searched.
        poses: those, in cells; `targets`: what of them is where nothing stays.
        stays: what of pose 0 does not move, in cells.
        gone: (S, n) what of pose 0 is not in them, nor behind what is.
        movers: (n,) what of pose 0 has moved, for all one can see.
        sight: what cameras see of the searched poses, `all_sight` of all, pose 0 first; None where
            all of them is seen.
    """

    frame: Normalization
    others: Cells
    near: float
    start: Surface
    first: Cells
    chosen: NDArray[np.intp]
    poses: Cells
    targets: Cells
    stays: Cells
    gone: NDArray[np.bool_]
    movers: NDArray[np.bool_]
    all_sight: Sight | None = None

    @property
    def sight(self) -> Sight | None:
        return None if self.all_sight is None else self.all_sight[self.chosen]


def change(
    poses: Sequence[Any], normals: Sequence[Any] | None = None, cameras: Floats | None = None
) -> Change:
    """Return what changes between the poses of one object, with `normals` of their points out of
    the material where they are known; or what changes for all that `cameras` (K, 3) see, one each.

    Raises:
        InvalidArgument: there is one pose only, one is no cloud of points, they share no frame, or
            nothing moves; normals are not one for each point.
    """
    if len(poses) < 2:
        raise InvalidArgument(
            f"{len(poses)} pose of the object, which shows no motion; give two or more"
        )
    whole = surfaces_of(poses, normals)
    low = np.min([surface.points.min(0) for surface in whole], axis=0)
    high = np.max([surface.points.max(0) for surface in whole], axis=0)
    size = max(float((high - low).max()), 1e-12) / _EDGE
    frame = Normalization((low + high) / 2.0, size)
    rng = np.random.default_rng(0)
    surfaces = [replace(surface, points=frame.to_unit(surface.points)) for surface in whole]
    clouds = tuple(
        s if len(s) <= MOST_POINTS else s[np.sort(rng.choice(len(s), MOST_POINTS, replace=False))]
        for s in surfaces
    )
    points = [cloud.points for cloud in clouds]
    first = Cells.of(clouds[:1])
    near = spacing_of(points[0], first)
    others = Cells.of(clouds[1:], near)
    sight = None if cameras is None else Sight.of(points, frame.to_unit(cameras))
    left = _left(points[0], others) if sight is None else sight.free(points[0])[1:].mean(1)
    if sight is None and left.max() > 1.0 - _STAYS:
        raise InvalidArgument(
            f"pose {left.argmax() + 1} has next to nothing where pose 0 has matter: they share no "
            "frame, or no part of the object stays; bring all poses into one frame, that of the "
            "fixed part"
        )
    chosen = _spread(left)
    start, surfaces = clouds[0].shaped(first, near), [clouds[k] for k in chosen]
    if normals is None:
        surfaces = [surface.shaped(Cells.of([surface]), near) for surface in surfaces]
    searched = Cells.of(surfaces, near)
    gone, shown = ~searched.met(start, still(len(chosen)), near), len(chosen)
    if sight is not None:
        free, shown = sight[chosen].free(start.points), (~gone).sum(0)
        gone &= free
        shown = shown + gone.sum(0)
    elif start.signed:  # a face closely opposite hides it: the floor of a drawer the board below
        over = replace(start, normals=-start.normals)
        gone &= ~searched.met(over, still(len(chosen)), near, gone)
    often = gone.sum(axis=0) >= np.maximum(1, np.round(shown / 4))
    movers = often & (_share_about(points[0], often, near) > 0.5)
    if movers.sum() < max(12, 0.002 * len(movers)):
        raise InvalidArgument(
            f"nothing moves: all of pose 0 is, to {near * size:.2g}, where it was in the others; "
            "give poses in which a joint has another state, or denser clouds or finer grids"
        )
    stays = Cells.of([start[~movers]], near)
    new = [surface[is_new(surface, stays, near, sight)] for surface in surfaces]
    if len(new) >= TELLING:
        new = _rare(new, searched, near)
    elif start.signed:
        new = [_uncovered(surface, first) for surface in new]
    if not any(map(len, new)):
        raise InvalidArgument("nothing moves to where pose 0 has nothing; give other poses")
    targets = Cells.of(new, near)
    return Change(
        frame, others, near, start, first, chosen, searched, targets, stays, gone, movers, sight
    )


def spacing_of(points: Floats, cells: Cells) -> float:
    """Return how near to one another most points of a surface are, which is in cells, too."""
    some = np.ascontiguousarray(points[:: max(len(points) // 2000, 1)])
    gaps = kernels.spacing(some, cells.points, cells.starts, 2.0 / kernels.CELLS)
    return float(np.clip(1.25 * np.quantile(gaps, 0.97), *_NEAR))


def widened(bits: NDArray[Any], steps: int, axes: Sequence[int] = (1, 2, 3)) -> NDArray[Any]:
    """Return grids (G, R, R, R) of bits with those of all cells up to `steps` away along each of
    the axes."""
    for axis in axes:
        wider = bits.copy()
        before, after = np.moveaxis(bits, axis, 0), np.moveaxis(wider, axis, 0)
        for step in range(1, steps + 1):
            after[step:] |= before[:-step]
            after[:-step] |= before[step:]
        bits = wider
    return bits


def still(count: int) -> Floats:
    """Return (count, 3, 4) what moves nothing."""
    return np.tile(np.eye(4)[:3], (count, 1, 1))


def surfaces_of(clouds: Sequence[Any], normals: Sequence[Any] | None = None) -> list[Surface]:
    """Return clouds (n, 3) as floats, with their normals, where these are known.

    Raises:
        InvalidArgument: one is no cloud of points; normals are not one for each point.
    """
    points = [
        np.ascontiguousarray(finite(np.asarray(cloud, np.float64), f"pose {k}", InvalidArgument))
        for k, cloud in enumerate(clouds)
    ]
    if normals is None:
        return [Surface.bare(cloud) for cloud in points]
    outward = [np.ascontiguousarray(normal, np.float64) for normal in normals]
    if [normal.shape for normal in outward] != [cloud.shape for cloud in points]:
        raise InvalidArgument("normals are not one for each point; give those of each cloud")
    for k, normal in enumerate(outward):
        finite(normal, f"normals of pose {k}", InvalidArgument)
    return [Surface.bare(*both) for both in zip(points, outward, strict=True)]


def _left(cloud: Floats, others: Cells) -> Floats:
    """Return (K - 1,) the share of some points of pose 0 that have no matter of each other pose
    near them."""
    some = Surface.bare(np.ascontiguousarray(cloud[:: max(len(cloud) // 1000, 1)]))
    return (~others.met(some, still(len(others)), others.near)).mean(1)


def _spread(left: Floats) -> NDArray[np.intp]:
    """Return the poses to search, in order: of those in which most has left, evenly."""
    if len(left) <= SEARCHED:
        return np.arange(len(left)) + 1
    order = np.argsort(-left, kind="stable")[: max(SEARCHED, int(0.8 * len(left)))]
    picks = np.linspace(0, len(order) - 1, SEARCHED).round().astype(int)
    return np.sort(order[picks]) + 1


def _share_about(cloud: Floats, flags: NDArray[np.bool_], near: float) -> Floats:
    """Return (n,) the share of the points around each one that have their flag set; its own does
    not count."""
    cells = Cells.of([Surface.bare(cloud)])
    at = cells.points, cells.starts, 1.5 * near, True
    about = kernels.about(cloud, flags[cells.order] * 1.0, *at)
    return about[:, 1] / np.maximum(about[:, 0], 1.0)


def is_new(surface: Surface, stays: Cells, near: float, sight: Sight | None) -> NDArray[np.bool_]:
    """Return (n,) which points of a pose are where nothing stays, as most of those around them are;
    with cameras, where that of pose 0 sees through."""
    far = ~stays.met(surface, still(1), near)[0]
    if sight is not None:
        far &= sight[:1].free(surface.points)[0]
    return far & (_share_about(surface.points, far, near) > 0.4)


def _rare(new: Sequence[Surface], poses: Cells, near: float) -> list[Surface]:
    """Return what is new in each pose without what most of the others have at the same place:
    insides that an open door or drawer shows, which say nothing of how far it has moved."""
    most = 1 + _COMMON * (len(new) - 1)  # it has itself
    return [s[poses.met(s, still(len(new)), near).sum(0) <= most] for s in new]


def _covered(surface: Surface, poses: Cells, steps: Ints, reach: float = _HIDES) -> Bools:
    """Return (K, n) whether each pose has a face with a point's normal some of these `steps` along
    that normal."""
    hidden = np.zeros((len(poses), len(surface)), np.bool_)
    for step in steps:
        over = replace(surface, points=surface.points + _HIDES * step * surface.normals)
        hidden |= poses.met(over, still(len(poses)), reach)
    return hidden


def _uncovered(new: Surface, first: Cells) -> Surface:
    """Return what is new without that before which pose 0 has a face: a lid may have hidden it."""
    bare = ~_covered(new, first, np.arange(1, 7))[0]
    return new[bare] if bare.mean() > _BARE else new
