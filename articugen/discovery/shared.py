"""`discover_shared`: one pose of each of several objects of a category in, the joints that they
share out, without labels.

Once fixed parts agree (`alignment`), points where most others have none vote: about which common
axis does an object's part come to lie on another's, in most pairs of objects?
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bools, Floats, Ints
from articugen.core.errors import InvalidArgument
from articugen.core.jit import kernel
from articugen.core.near import by_cell, nearest_within
from articugen.core.records import JointKind
from articugen.discovery.alignment import CELLS, SIDE, Alignment, facing_of, grid_of, values_at
from articugen.discovery.clouds import surfaces_of
from articugen.discovery.discover import KINDS
from articugen.discovery.joints import FoundJoint
from articugen.discovery.search import Candidate, motions

FEWEST = 6  # objects

_FIXED = 0.5  # what so many of the others have at the same place is of the fixed part
_VOTERS, _REFERENCES = 120, 5  # points of a moving part, and objects whose part is landed on
_PIVOTS, _FINE = 0.05, 0.0125  # steps of the pivots that are tried, and of those around the best
_ANGLES, _SLIDES = 48, np.arange(-0.6, 0.601, 0.025)
_FEWEST_MOVERS = 20
_MOST_JOINTS = 4
_FOLLOWS = 0.35  # a point is a joint's where such a share of the others have their part
_TELLS = 0.4  # and where so many have the same part, that is the point's
SURE, MARGIN = 0.3, 1.25
"""A joint is sure with a `score` and a `margin` so great."""


@dataclass(frozen=True, eq=False)
class SharedJoint(FoundJoint):
    """A joint of all N objects of a category, about or along x, y or z.

    Attributes:
        pivot: (N, 3) a point on the axis in each object's own frame.
        states: (N,) of each object; the least is 0.
        score: which share of the others have their part where an object has its, on average.
        margin: how many times the score of the best joint of another kind or direction it has.
    """

    margin: float = field(kw_only=True)

    def of(self, i: int) -> FoundJoint:
        """Return the joint as object i has it."""
        return FoundJoint(self.kind, self.axis, self.pivot[i], self.states, self.score)


@dataclass(frozen=True, eq=False)
class Category:
    """Joints that N objects share. A point x of object i is at `stretch[i]` x + `shift[i]` in the
    frame where fixed parts agree.

    Attributes:
        joints: those that are sure; in the order in which they were found.
        doubtful: what was found next, or None; it is no better than others.
        stretch, shift: (N, 3).
        agreement: (N,) of each object's surface with the others', from 0 to 1.
        part: of each object's points (n_i,), 0 for what stays, j + 1 for what joint j moves.
    """

    joints: tuple[SharedJoint, ...]
    doubtful: SharedJoint | None
    stretch: Floats
    shift: Floats
    agreement: Floats
    part: tuple[Ints, ...]


@kernel
def _landed(points, cls, shifts, grid, side):  # pragma: no cover - compiled
    """Return (H, T) the mean of `grid` (6, R, R, R) where points (T, m, 3) of classes (T, m) come
    to, shifted by (H, T, 3)."""
    R, flat, count = np.int32(grid.shape[1]), grid.reshape(-1), points.shape[1]
    out, cell = np.zeros(shifts.shape[:2]), np.empty(count, np.int32)
    for t in range(len(points)):
        x, y, z = points[t, :, 0].copy(), points[t, :, 1].copy(), points[t, :, 2].copy()
        way = cls[t].astype(np.int32)
        for h in range(len(shifts)):
            a, b, c = shifts[h, t, 0], shifts[h, t, 1], shifts[h, t, 2]
            for n in range(count):  # without a branch, so that several are done at a time
                i = ((x[n] + a) / side + 0.5) * R
                j = ((y[n] + b) / side + 0.5) * R
                k = ((z[n] + c) / side + 0.5) * R
                at = ((way[n] * R + np.int32(i)) * R + np.int32(j)) * R + np.int32(k)
                cell[n] = at if (min(i, j, k) >= 0.0) & (max(i, j, k) < R) else np.int32(-1)
            total = 0.0
            for n in range(count):
                if cell[n] >= 0:
                    total += flat[np.uintp(cell[n])]
            out[h, t] = total / count
    return out


@dataclass(frozen=True)
class _Way:
    """Motions of parts, about or along a coordinate `axis`; what turns is stretched as the object
    is along `along`, where the part extends when it is at rest."""

    turns: bool
    axis: int
    along: int

    @property
    def kind(self) -> JointKind:
        return JointKind.REVOLUTE if self.turns else JointKind.PRISMATIC

    def states(self) -> Floats:
        return np.linspace(-np.pi, np.pi, _ANGLES, endpoint=False) if self.turns else _SLIDES


_WAYS = [_Way(True, axis, along) for axis in range(3) for along in range(3) if along != axis]
_WAYS += [_Way(False, axis, axis) for axis in range(3)]


class _Vote:
    """The search for joints that objects share, once their fixed parts agree."""

    def __init__(
        self, clouds: Sequence[Floats], normals: Sequence[Floats], stretch: Floats, shift: Floats
    ) -> None:
        self.clouds, self.normals, self.stretch, self.shift = clouds, normals, stretch, shift
        self.rng = np.random.default_rng(0)
        facing = [facing_of(ways) for ways in normals]
        self.common = [p * a + b for p, a, b in zip(clouds, stretch, shift, strict=True)]
        grids = [grid_of(p, f) for p, f in zip(self.common, facing, strict=True)]
        whole = np.sum(grids, axis=0)
        self.fixed = [
            values_at(whole - grid, p, f) / (len(grids) - 1)
            for grid, p, f in zip(grids, self.common, facing, strict=True)
        ]
        self.free: list[Bools] = [share < _FIXED for share in self.fixed]

    def moved(
        self, i: int, which: Any, way: _Way, states: Floats, pivots: Floats
    ) -> tuple[Floats, Ints, Floats]:
        """Return points of an object as they would be in other states, (S, m, 3) but for a shift,
        the ways that they face (S, m), and that shift (H, S, 3) by each of the `pivots` (H, 3) of
        the common frame. The frame's origin is the pivot of what turns."""
        points, normals, a = self.clouds[i][which], self.normals[i][which], self.stretch[i]
        if not way.turns:
            shape = (len(states), *points.shape)
            shifts = (states[:, None] * np.eye(3)[way.axis] * a)[None]
            facing = np.broadcast_to(facing_of(normals), shape[:2])
            return np.broadcast_to(points * a + self.shift[i], shape), facing, shifts
        turn = motions(Candidate(True, np.eye(3)[way.axis], np.zeros(3), states))[:, :, :3]
        scale = np.full(3, a[way.along])
        scale[way.axis] = a[way.axis]
        about = (pivots - self.shift[i]) / a
        turned = np.einsum("sij,nj->sni", turn, points) * scale
        facing = facing_of(np.einsum("sij,nj->sni", turn, normals))
        shifts = -np.einsum("sij,hj->hsi", turn, about) * scale
        shifts[..., way.axis] = self.shift[i, way.axis]
        return turned, facing, shifts

    def movers(self) -> list[int]:
        """Return the objects of which something is not explained."""
        return [i for i, free in enumerate(self.free) if free.sum() >= _FEWEST_MOVERS]

    def some(self, i: int) -> NDArray[np.intp]:
        which = np.flatnonzero(self.free[i])
        return which if len(which) <= _VOTERS else self.rng.permutation(which)[:_VOTERS]

    def landed(self, way: _Way, pivots: Floats, R: int = CELLS) -> Floats:
        """Return (H,) which share of an object's part comes to lie on another's, at best, about
        each of the pivots: the mean over pairs of objects."""
        movers = self.movers()
        targets = []
        for r in sorted(movers, key=lambda i: -self.free[i].sum())[:_REFERENCES]:
            points, facing, shifts = self.moved(r, self.free[r], way, np.zeros(1), pivots)
            middle = points[0].mean(0)
            targets.append((r, grid_of(points[0] - middle, facing[0], R), middle + shifts))
        total, pairs = np.zeros(len(pivots)), 0
        for i in movers:
            points, facing, shifts = self.moved(i, self.some(i), way, way.states(), pivots)
            for r, grid, back in targets:
                if i != r:
                    total += _landed(points, facing, shifts - back, grid, SIDE).max(1)
                    pairs += 1
        return total / max(pairs, 1)

    def pivots(self, way: _Way, about: Floats | None = None) -> Floats:
        """Return (H, 3) pivots to try across the objects, or finer ones about the best."""
        if not way.turns:
            return np.zeros((1, 3))
        if about is None:
            low = np.median([p.min(0) for p in self.common], axis=0) - _PIVOTS
            high = np.median([p.max(0) for p in self.common], axis=0) + _PIVOTS
            edges = [np.arange(a, b + _PIVOTS, _PIVOTS) for a, b in zip(low, high, strict=True)]
        else:
            edges = [x + _FINE * np.arange(-5, 6) for x in about]
        edges[way.axis] = np.zeros(1)
        return np.stack(np.meshgrid(*edges, indexing="ij"), axis=-1).reshape(-1, 3)

    def joint(self, kinds: Collection[JointKind]) -> tuple[_Way, Floats, float]:
        """Return how most comes to lie on one another, with the pivot, and how many times the share
        of the best other axis or kind it is."""
        voted = []
        for way in (way for way in _WAYS if way.kind in kinds):
            pivots = self.pivots(way)
            shares = self.landed(way, pivots)
            voted.append((float(shares.max()), way, pivots[shares.argmax()]))
        share, way, pivot = max(voted, key=lambda vote: vote[0])
        others = [v for v, o, _ in voted if (o.turns, o.axis) != (way.turns, way.axis)]
        if way.turns:
            pivots = self.pivots(way, pivot)
            pivot = pivots[self.landed(way, pivots, 2 * CELLS).argmax()]
        return way, pivot, share / max(*others, 1e-9)

    def settled(self, way: _Way, pivot: Floats) -> tuple[Floats, Floats, list[Floats]]:
        """Return (N,) the states at which parts lie on one another, the share of others that each
        then meets, and for all points of each object the share of others with their part there."""
        states, pivots, N = way.states(), pivot[None], len(self.clouds)
        movers = self.movers()
        tried = {i: self.moved(i, self.some(i), way, states, pivots) for i in movers}

        def at(i: int, q: float, which: Any) -> tuple[Floats, Ints]:
            points, facing, shifts = self.moved(i, which, way, np.array([q]), pivots)
            return points[0] + shifts[0, 0], facing[0]

        def score(i: int, grid: Any, middle: Floats) -> Floats:
            points, facing, shifts = tried[i]
            return _landed(points, facing, shifts - middle, np.asarray(grid, np.float32), SIDE)[0]

        best, middle = np.zeros((1, 1)), np.zeros(3)
        for r in movers:
            points, facing = at(r, 0.0, self.free[r])
            grid = grid_of(points - points.mean(0), facing)
            table = np.array([score(i, grid, points.mean(0)) for i in movers])
            if table.max(1).sum() > best.max(1).sum():
                best, middle = table, points.mean(0)

        def grid_at(i: int, q: float) -> NDArray[np.float32]:
            points, facing = at(i, q, self.free[i])
            return grid_of(points - middle, facing)

        q, share = np.zeros(N), np.zeros(N)
        q[movers] = states[best.argmax(1)]
        grids = {i: grid_at(i, q[i]) for i in movers}
        whole = np.sum(list(grids.values()), axis=0)
        for _ in range(3):
            for i in movers:
                table = score(i, (whole - grids[i]) / max(len(movers) - 1, 1), middle)
                q[i], share[i] = states[table.argmax()], table.max()
                whole -= grids[i]
                grids[i] = grid_at(i, q[i])
                whole += grids[i]
        follow = list[Floats]()
        for i in range(N):
            points, facing = at(i, q[i], slice(None))
            others = (whole - grids.get(i, 0.0)) / max(len(movers) - 1, 1)
            follow.append(values_at(others, points - middle, facing))
        return q, share, follow


def discover_shared(
    clouds: Sequence[Any], normals: Sequence[Any], *, kinds: Collection[JointKind] = KINDS
) -> Category:
    """Find the joints that objects of one category share, from one pose of each.

    Joints turn about x, y or z or slide along them, and hang on the fixed part. The same clouds
    give the same joints.

    Args:
        clouds: N >= 6 objects, (n_i, 3) points on the surface of each in its unit frame, in which
            all stand upright and look the same way.
        normals: of these points, (n_i, 3) out of the material.
        kinds: of joints that they may have, of REVOLUTE and PRISMATIC.

    Raises:
        InvalidArgument: the objects are few, one is no cloud of points, or normals are not one for
            each point.
    """
    if len(clouds) < FEWEST:
        raise InvalidArgument(
            f"{len(clouds)} objects say little of what a category shares; give {FEWEST} or more"
        )
    surfaces = surfaces_of(clouds, normals)
    sound, outward = [s.points for s in surfaces], [s.normals for s in surfaces]
    alignment = Alignment(sound, [facing_of(ways) for ways in outward])
    stretch, shift, agreement = alignment.best()
    vote = _Vote(sound, outward, stretch, shift)
    joints, follows, doubtful = list[SharedJoint](), list[list[Floats]](), None
    while len(joints) < _MOST_JOINTS and len(vote.movers()) >= FEWEST:
        way, pivot, margin = vote.joint(kinds)
        states, score, follow = vote.settled(way, pivot)
        joint = _joint(way, (pivot - shift) / stretch, states, float(score.mean()), margin)
        if joint.score < SURE or joint.margin < MARGIN:
            doubtful = joint
            break
        joints.append(joint)
        follows.append(follow)
        vote.free = [f & (share < _FOLLOWS) for f, share in zip(vote.free, follow, strict=True)]
    part = _labels(vote, follows)
    return Category(tuple(joints), doubtful, stretch, shift, agreement, part)


def _joint(way: _Way, pivot: Floats, back: Floats, score: float, margin: float) -> SharedJoint:
    """Return a joint whose parts come to lie on one another where they move `back` (N,)."""
    states = -back
    if way.turns:  # about their mean, so that none is a whole turn away
        mean = np.arctan2(np.sin(states).mean(), np.cos(states).mean())
        states = (states - mean + np.pi) % (2.0 * np.pi) - np.pi
    return SharedJoint(
        way.kind, np.eye(3)[way.axis], pivot, states - states.min(), score, margin=margin
    )


def _labels(vote: _Vote, follows: list[list[Floats]]) -> tuple[Ints, ...]:
    """Return of each object's points (n_i,) the part which most others have at the same place;
    where few have any, that of the nearest point that is sure."""
    labels = []
    for i, fixed in enumerate(vote.fixed):
        shares = np.array([fixed, *(follow[i] for follow in follows)])
        part, sure = shares.argmax(0), shares.max(0) >= _TELLS
        if sure.any():
            cloud = vote.clouds[i]
            nearest = nearest_within(by_cell(cloud[sure]), cloud[~sure], 2.0)
            part[~sure] = part[sure][nearest]
        labels.append(part)
    return tuple(labels)
