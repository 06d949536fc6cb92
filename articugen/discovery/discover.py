"""`discover`: several poses of one object in, its joints out, without labels.

Patches of what has left pose 0 vote for joints (`search`). The best candidates are made exact and
grow to all points that follow them (`fitting`). Then they are taken one after the other, the one
that explains most of what is not yet explained first. In the end each point goes to the joint, or
to the fixed part, that it agrees with in most poses, and each joint is fitted to its points.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Ints
from articugen.core.records import Floats, JointKind
from articugen.discovery.fitting import fitted, refitted, some, states_of
from articugen.discovery.joints import Discovery, FoundJoint, by_size, found_joint, labels
from articugen.discovery.search import EVERY_WAY, Candidate, Search, carried, motions

from articugen.discovery.clouds import (  # isort: skip
    SEARCHED, TELLING, Cells, Change, Surface, change, still, surfaces_of,
)  # fmt: skip

Directions = Mapping[JointKind, Floats]

KINDS = (JointKind.REVOLUTE, JointKind.PRISMATIC)  # of joints that can be found

LEAN = np.cos(np.radians(30.0))
"""A joint that leans further from where joints of its kind point is a mistake."""

# How many: of patches, of points in one, of points that have left and are examined, of candidates
# that grow, and of points that a growing one is fitted to.
_PATCHES, _PATCH, _MOVERS, _GROWN, _CORE = 12, 48, 800, 10, 200
# Of those points: what candidates are asked for in the end, and what ranks them at first.
_ALL, _SOME = slice(None), slice(None, None, 2)

# Shares, of the poses in which a point has left, of what has left, or of `near`:
_RIGHT, _WRONG = 0.4, 0.2  # a joint that a point follows is right in so many poses, wrong in so few
_AGREES = 0.6  # a joint is fitted to points that it lays on something in so many poses
_WORTH = 0.04  # a joint explains at least this share of all that has left
_ALONE = 0.15  # and of what it explains best no other does this share at least
_ALONG, _ITSELF, _FRONT, _SIDES = 0.3, 0.5, 0.1, 0.5
"""A plane that slides along itself (to this cosine) lands on where it was, which counts so much of
landing on something new, if so much of what has left does that, and so much of that on planes."""

# What is preferred where both explain about as much; the more, the fewer poses say which is right:
_SLIDES_FIRST = 1.05  # a slide along x, y or z, which has two parameters fewer, to a turn
_ASKEW = 0.97  # any other slide
_FAR_TURNS = 0.03  # a lesser turn, by this share a radian: a plate may have been turned over
_FAR_AXES = 0.5  # an axis by its part, by this share a unit: a hinge does not hang in the air
PLAIN = 1.03  # the coordinate axis nearest to one, that of turns no farther than 12 degrees
BESIDE = np.cos(np.radians(12.0))
_SAME_WAY = 0.99  # directions are one where the cosine between them, of any sign, is no less

# How far a point may be from where it should land as a candidate grows: so many times `near`, or
# `_WIDE` where that is more.
_GROWS, _WIDE = (2.0, 2.0, 2.0, 2.0, 1.5), 0.015


def discover(
    poses: Sequence[Any],
    *,
    normals: Sequence[Any] | None = None,
    kinds: Collection[JointKind] = KINDS,
    directions: Directions | None = None,
) -> Discovery:
    """Find the joints of one object from several poses of it.

    All moving parts hang on a fixed one, which stays where it is; see `discover_chains` for others.
    The same clouds give the same joints.

    Args:
        poses: K >= 2 clouds (n_k, 3) in one frame: points on the surface, or the centres of
            occupied voxels. Joints are found from pose 0 to the others.
        normals: of these points, (n_k, 3) of unit length, out of the material, where they are
            known: the front of a plate is not taken for its back then.
        kinds: of joints that it may have, of REVOLUTE and PRISMATIC.
        directions: where joints of each kind point, give or take 30 degrees and the sign, (n, 3)
            each; unless it is known, turns about the coordinate axes and slides any way.

    Raises:
        InvalidArgument: there is one pose only, one is no cloud of points, they share no frame, or
            nothing moves; normals are not one for each point.
    """
    diff = change(poses, normals)
    first = surfaces_of(poses[:1], normals and normals[:1])[0]
    return complete(diff, searched(diff, kinds, directions), first)


def searched(
    diff: Change, kinds: Collection[JointKind], directions: Directions | None = None
) -> list[Candidate]:
    """Return the joints on the fixed part that explain what moves."""
    search = Finder(diff, kinds, directions or {})
    search.look_for_joints()
    return search.settled()


@dataclass(frozen=True, eq=False)
class _Grown:
    """A candidate with what it explains: of movers in the searched poses, the pairs where it is
    `right` (S, m), where one that may follow is `wrong` (S, m), where one lands on its own plane,
    `slid` (S, m), the movers that `follow` (m,)."""

    joint: Candidate
    right: NDArray[np.bool_]
    wrong: NDArray[np.bool_]
    slid: NDArray[np.bool_]
    follow: NDArray[np.bool_]
    polished: bool = False


def _unlike(directions: Floats) -> Floats:
    """Return each direction once, whatever its sign."""
    unlike: list[Floats] = []
    for direction in np.asarray(directions, np.float64):
        one = direction / np.linalg.norm(direction)
        if all(abs(one @ other) < _SAME_WAY for other in unlike):
            unlike.append(one)
    return np.array(unlike)


def _alike(one: _Grown, other: _Grown) -> bool:
    """Return whether two candidates explain nearly the same pairs."""
    both, any_ = (one.right & other.right).sum(), (one.right | other.right).sum()
    return one.joint.turns == other.joint.turns and both > 0.85 * any_


class Finder:
    """The search for joints, and what it has found so far."""

    def __init__(self, diff: Change, kinds: Collection[JointKind], directions: Directions) -> None:
        self.change, self.kinds = diff, kinds
        self.directions = {kind: _unlike(axes) for kind, axes in directions.items()}
        self.search = Search(diff)
        self.movers = some(np.flatnonzero(diff.movers), _MOVERS)
        self.part = diff.start[self.movers]
        self.gone = diff.gone[:, self.movers]
        self.sight = diff.sight
        self.left = np.ones(len(self.movers), bool)
        few = len(self.gone) < TELLING
        self.width = 2 if few else 1  # of what is tried
        self.by_faces = few and self.part.signed  # which say more than so few poses
        self.prior = float(np.sqrt(SEARCHED / len(self.gone)))
        self.joints: list[_Grown] = []

    def look_for_joints(self) -> None:
        worth = _WORTH * self.gone.sum()
        pool: list[_Grown] = []
        for _ in range(3):
            if self.gone[:, self.left].sum() < 2.0 * worth:
                break
            pool += self._grown(self._patches())
            if not self._taken(pool, worth):
                break

    def _taken(self, pool: list[_Grown], worth: float) -> bool:
        """Take the candidates that explain most, one after the other; whether there was any."""
        before = len(self.joints)
        while pool:
            gains = [self._gain(grown) for grown in pool]
            best = int(np.argmax(gains))
            if gains[best] < worth:
                break
            if pool[best].polished:
                taken = pool.pop(best)
                self.joints.append(taken)
                touching = self._touching(taken.joint).sum(0)
                self.left &= ~taken.follow & (2 * touching < np.maximum(self.gone.sum(0), 1))
            else:
                pool[best] = self._polished(pool[best])
        return len(self.joints) > before

    def _gain(self, grown: _Grown, among: slice = _ALL) -> float:
        """Return how many pairs of a point and a pose it explains that nothing yet does, less those
        where it is wrong of its own points; of the movers `among` which it was asked."""
        known = self.directions.get(grown.joint.kind)
        if known is not None and np.abs(known @ grown.joint.axis).max() <= LEAN:
            return -1.0
        movers = grown.follow & self.left[among]
        gain = grown.right[:, movers].sum() - 2.0 * grown.wrong[:, movers].sum()
        gain += _ITSELF * grown.slid[:, movers].sum()
        liking = self._liking(grown.joint, self.part.points[among][movers])
        return float(gain * liking**self.prior)

    def _liking(self, joint: Candidate, points: Floats) -> float:
        """Return by how much it is preferred to others that explain as much of its points."""
        if not joint.turns:
            return _SLIDES_FIRST if np.abs(joint.axis).max() > BESIDE else _ASKEW
        off = points - joint.pivot
        off -= (off @ joint.axis)[:, None] * joint.axis
        away = float(np.sqrt((off**2).sum(1).min(initial=1.0)))
        return 1.0 - _FAR_TURNS * float(np.abs(joint.states).mean()) - _FAR_AXES * away

    def _patches(self) -> list[NDArray[np.intp]]:
        """Return patches of neighbours among the movers that nothing explains yet, about points
        that are far from one another, and some of all."""
        free = np.flatnonzero(self.left)
        points = self.part.points[free]
        far = np.full(len(free), np.inf)
        at = int(((points - points.mean(0)) ** 2).sum(1).argmax())
        patches = [some(free, 200)]
        for _ in range(_PATCHES):
            squared = ((points - points[at]) ** 2).sum(1)
            patches.append(free[np.sort(np.argsort(squared, kind="stable")[: self.width * _PATCH])])
            far = np.minimum(far, squared)
            at = int(far.argmax())
        return patches

    def _fronts(self) -> list[tuple[NDArray[np.intp], Candidate]]:
        """Return slides along each axis by what faces that way, with that, where poses are few."""
        if not self.by_faces or JointKind.PRISMATIC not in self.kinds:
            return []
        free = np.flatnonzero(self.left)
        facing = np.abs(self.part.normals[free]).argmax(1)
        planes = [(way, some(free[facing == n], 200)) for n, way in enumerate(np.eye(3))]
        return [
            (plane, joint)
            for way, plane in planes
            if len(plane) > _PATCH
            for _, joint in self.search.slides(self.movers[plane], way[None], 1)
        ]

    def _grown(self, patches: list[NDArray[np.intp]]) -> list[_Grown]:
        """Return the candidates that patches vote for, fitted and grown; the best unlike ones."""
        reach = 2.0 * self.change.near
        voted = [(patch, joint) for patch in patches for joint in self._voted(patch)]
        seeds = [
            fitted(joint, self.part[some(patch, 60)], self.change.targets, reach, 3)
            for patch, joint in voted + self._fronts()
        ]
        seeds = [self.explained(seed, reach, _SOME) for seed in seeds]
        seeds.sort(key=lambda seed: -self._gain(seed, _SOME))
        unlike, most = list[_Grown](), self.width * _GROWN
        for seed in seeds:
            if len(unlike) < most and not any(_alike(seed, other) for other in unlike):
                unlike.append(seed)
        return [self._grow(self.explained(seed.joint, reach)) for seed in unlike]

    def _voted(self, patch: NDArray[np.intp]) -> list[Candidate]:
        which, most = self.movers[patch], self.width * np.array([3, 4, 2])
        voted: list[tuple[float, Candidate]] = []
        if JointKind.REVOLUTE in self.kinds:
            axes = self.directions.get(JointKind.REVOLUTE, np.eye(3))
            turns = [turn for axis in axes for turn in self.search.turns(which, axis, most[0])]
            voted += sorted(turns, key=lambda vote: -vote[0])[: most[1]]
        if JointKind.PRISMATIC in self.kinds:
            ways = self.directions.get(JointKind.PRISMATIC, EVERY_WAY)
            voted += self.search.slides(which, ways, most[2])
        return [joint for _, joint in voted]

    def _grow(self, seed: _Grown) -> _Grown:
        near, targets = self.change.near, self.change.targets
        grown = seed
        for reach in (*(grows * max(near, _WIDE) for grows in _GROWS), near):
            core = some(np.flatnonzero(grown.follow & self.left), _CORE)
            if len(core) < 12:
                return self.explained(grown.joint, near)
            joint = fitted(grown.joint, self.part[core], targets, reach, 3)
            grown = self.explained(joint, reach)
        if grown.joint.turns or not self.by_faces:
            return grown
        return max(grown, self.explained(grown.joint.snapped(), near), key=self._gain)

    def _polished(self, grown: _Grown) -> _Grown:
        """With the states voted again by all that follow, and all of it fitted to them; about the
        coordinate axis beside its own, where that explains as much."""
        core = some(np.flatnonzero(grown.follow & self.left), _CORE)
        if len(core) < 12:
            return replace(grown, polished=True)
        tried = [grown, self._revoted(grown.joint, core, tilts=True)]
        if not grown.joint.turns or np.abs(grown.joint.axis).max() > BESIDE:
            tried.append(self._revoted(grown.joint.snapped(), core, tilts=False))
        gains = [self._gain(one) * PLAIN ** (self.prior * (n == 2)) for n, one in enumerate(tried)]
        return replace(tried[int(np.argmax(gains))], polished=True)

    def _revoted(self, joint: Candidate, core: NDArray[np.intp], *, tilts: bool) -> _Grown:
        near, poses = self.change.near, self.change.poses
        wide = max(near, _WIDE)
        best = None
        for _ in range(3):
            states = states_of(joint, self.part[core], poses, self.change.stays)
            joint = replace(joint, states=states)
            for reach in (2.0 * wide, near):
                joint = fitted(joint, self.part[core], poses, reach, 4, tilts=tilts)
            now = self.explained(joint, near)
            if best is None or self._gain(now) > self._gain(best):
                best = now
            around = self.explained(joint, 2.0 * wide).follow & self.left
            again = some(np.flatnonzero(around), _CORE)
            if len(again) < 12:
                break
            core = again
        assert best is not None
        return best

    def explained(self, joint: Candidate, reach: float, among: slice = _ALL) -> _Grown:
        """Return what a candidate explains of the movers: where a point has left and lands on
        something new it is right, where it lands on nothing it is wrong; what was hidden in pose 0
        and is there in most others says neither, nor does what a camera would not see."""
        M, part, gone = motions(joint), self.part[among], self.gone[:, among]
        right = self.change.targets.met(part, M, reach, gone)
        shown = gone
        if self.sight is not None:
            there = self.change.poses.met(part, M, reach, gone)
            shown = there | gone & self.sight.free(carried(M, part.points))
        left = np.maximum(shown.sum(0), 1)
        slid = np.zeros_like(gone)
        if self.by_faces and not joint.turns and right.sum() >= _FRONT * gone.sum():
            slid = gone & ~right & (np.abs(part.normals @ joint.axis) < _ALONG)
            slid &= self.change.poses.met(part, M, reach, slid)
            slid &= slid.sum() >= _SIDES * right.sum()
        follow = (right | slid).sum(0) >= _RIGHT * left
        wrong = shown & ~right & ~slid & follow  # what is new in a pose is of it
        wrong &= ~self.change.poses.met(part, M, reach, wrong)
        follow &= wrong.sum(0) <= _WRONG * left
        return _Grown(joint, right, wrong, slid, follow)

    def _touching(self, joint: Candidate) -> NDArray[np.bool_]:
        """Return (S, m) which movers that have left a joint brings face to face, so that neither
        shows: a lid's lower face and what it comes to lie on. Many poses say it by themselves."""
        if not self.by_faces:
            return np.zeros_like(self.gone)
        every, M = self.change.start[self.change.movers], motions(joint)
        there = Cells.of([every.moved(m) for m in M], self.change.near)
        here = Cells.of([every], self.change.near)
        below = [here.facing(self.part.moved(m))[0] for m in M]
        return (there.facing(self.part) | below) & self.gone

    def settled(self) -> list[Candidate]:
        """Return the joints, each fitted to the points that agree with it best, but for needless
        ones."""
        joints = self._needed([grown.joint for grown in self.joints])
        for _ in range(2):
            shares = _agreement(self.change, joints, self.part).mean(1)
            best = shares.argmax(0)
            for j, joint in enumerate(joints):
                points = np.flatnonzero((best == j + 1) & (shares[j + 1] >= _AGREES))
                core = some(points, 400)
                if len(core) >= 12:
                    plain = 0.0 if joint.turns else PLAIN**self.prior
                    joints[j] = refitted(joint, self.part[core], self.change.poses, plain)
            joints = self._needed(joints)
        return joints

    def _needed(self, joints: list[Candidate]) -> list[Candidate]:
        """Without those that explain too little that no other joint does."""
        joints = list(joints)
        touch = np.array([self._touching(joint) for joint in joints])
        while joints:
            agree = _agreement(self.change, joints, self.part)[1:] & self.gone
            hits = agree.sum(1)
            others = [
                np.maximum(
                    np.delete(hits, j, axis=0).max(0, initial=0),
                    (np.delete(touch, j, axis=0).any(0) & agree[j]).sum(0),
                )
                for j in range(len(joints))
            ]
            whole = np.where(hits >= others, hits, 0).sum(1)
            alone = np.maximum(hits - others, 0).sum(1)
            needed = np.minimum(
                alone / (0.5 * _WORTH * self.gone.sum()), alone / (_ALONE * np.maximum(whole, 1))
            )
            if needed.min() >= 1.0:
                break
            right = [self.explained(joint, self.change.near).right.sum(0) for joint in joints]
            liked = [
                self._liking(joint, self.part.points[hit > 0]) * hit.sum()
                for joint, hit in zip(joints, right, strict=True)
            ]
            least = int(np.where(needed < 1.0, liked, np.inf).argmin())
            joints.pop(least)
            touch = np.delete(touch, least, axis=0)
        return joints


def _agreement(diff: Change, joints: list[Candidate], surface: Surface) -> NDArray[np.bool_]:
    """Return (1 + J, S, n) whether points agree with what stays, and with each joint, in each
    pose."""
    return np.array([diff.poses.met(surface, M, diff.near) for M in _moved(diff, joints)])


def _moved(diff: Change, joints: list[Candidate]) -> list[Floats]:
    """Return (S, 3, 4) what stays and what each joint moves in the searched poses."""
    return [still(len(diff.chosen)), *(motions(joint) for joint in joints)]


def complete(diff: Change, joints: list[Candidate], first: Surface) -> Discovery:
    """Labels of pose 0 as it was given, `first`, states of all poses and scores, in its frame."""
    order, part, parts = parted(diff, _moved(diff, joints), first, [0] * len(joints))
    fixed = Cells.of(parts[:1], diff.near)
    done = [in_clouds(diff, joints[j], parts[n], fixed) for n, j in enumerate(order, 1)]
    return Discovery(tuple(done), first.points, part)


def parted(
    diff: Change, moved: list[Floats], first: Surface, parents: list[int]
) -> tuple[list[int], Ints, list[Surface]]:
    """Return which joints move anything, by the parts that they hang on, `parents`, as `by_size`
    does; the parts (n,) of pose 0; and their surfaces in the cube, the fixed one's first. `moved`
    (S, 3, 4) is what stays and what each joint moves in the searched poses."""
    cloud = replace(first, points=np.ascontiguousarray(diff.frame.to_unit(first.points)))
    surface = cloud.shaped(diff.first, diff.near)
    far = [diff.poses.distances(surface, M, diff.near) for M in moved]
    cost = np.minimum(far, diff.near).mean(1) / diff.near
    order, part = by_size(labels(cost, surface.points, diff.near), parents)
    return order, part, [surface[part == n] for n in range(len(order) + 1)]


def in_clouds(diff: Change, joint: Candidate, part: Surface, fixed: Cells) -> FoundJoint:
    """Return the joint in the clouds' frame, with the states of all poses."""
    core = part[some(np.arange(len(part)), 250)]
    states = np.concatenate([[0.0], states_of(joint, core, diff.others, fixed)])
    right = score(diff, part, motions(joint))
    return found_joint(diff.frame, joint, states, part.points.mean(0), right)


def score(diff: Change, part: Surface, moved: Floats) -> float:
    """Return the share of a part's points, where they have left, that land on something new."""
    core = part[some(np.arange(len(part)), 250)]
    gone = ~diff.poses.met(core, still(len(diff.chosen)), diff.near)
    new = diff.targets.met(core, moved, diff.near)
    return float((gone & new).sum() / max(gone.sum(), 1))
