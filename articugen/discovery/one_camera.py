"""Joints from what one depth camera sees of each pose.

What is not seen has not left: a point has where a camera sees through its place, and what a
camera sees is new where that of the reference pose sees through. Joints are searched as in whole
clouds, by points alone, since of a lid now one side is seen and now the other. Then they are made
exact by faces, on what is surely new. Poses in which too little of a part is seen have no state.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from articugen.core.arrays import Bools, Floats, Ints
from articugen.core.errors import InvalidArgument
from articugen.core.geometry import norm
from articugen.core.records import JointKind
from articugen.discovery.clouds import Cells, Change, Surface, change, is_new, still, surfaces_of
from articugen.discovery.discover import BESIDE, KINDS, PLAIN, Finder
from articugen.discovery.fitting import refitted, some, states_of
from articugen.discovery.joints import Discovery, by_size, found_joint, labels
from articugen.discovery.search import Candidate, carried, motions
from articugen.discovery.views import Sight

_REFERENCES = 3  # poses that are tried as the reference, those of which most leaves first

_RADII = (1.0, 0.7, 0.5, 0.4)  # about a point, in shares of `near`, the best last
_CORE = 400  # points of a part that joints are fitted to
_SHOWS, _FREE, _POSES = 0.15, 0.25, 2
"""A state is known where the first share of those points lies on something new, and of the points
that would show no more than the second share does not; at least the third number are, or it is no
joint."""

_ACROSS = 0.2  # of a slide's points that face along it: a plane along itself shows no motion
_SAME_WAY, _SAME_STATES = 0.98, {True: 0.1, False: 0.03}  # joints that are one
_APART = 0.05  # of the axes of two

_LOST, _STRANGE = 0.12, 0.25  # so much of what has left, or is new, may follow no joint


def discover_views(
    poses: Sequence[Any], cameras: Any, *, kinds: Collection[JointKind] = KINDS
) -> Discovery:
    """Find the joints of one object from what one camera sees of each of several poses.

    Args:
        poses: K >= 2 clouds (n_k, 3) in one frame, that of the fixed part, of the object alone, all
            of which is in the image.
        cameras: (K, 3) where the cameras are, in that frame.
        kinds: of joints that it may have, of REVOLUTE and PRISMATIC.

    Returns:
        States count from those of its `reference`; they are NaN where too little is seen.

    Raises:
        InvalidArgument: one is no cloud of points, cameras are not one for each, too little is seen
            of what moves, or more moves than the joints explain.
    """
    clouds = [surface.points for surface in surfaces_of(poses)]
    eyes = np.asarray(cameras, np.float64)
    if eyes.shape != (len(clouds), 3):
        raise InvalidArgument(f"cameras of shape {eyes.shape} are no places, one for each pose")
    if not np.isfinite(eyes).all():
        raise InvalidArgument("there are cameras that are no numbers; give places in the frame")
    why = "nothing that moves is seen from the same side twice"
    for order in _orders(clouds, eyes):
        try:
            exact = _Exact(change([clouds[k] for k in order], cameras=eyes[order]), eyes[order])
            fits = exact.joints(kinds)
        except InvalidArgument as error:
            why = str(error)
            continue
        if fits:
            return exact.discovery(fits, clouds, order)
    raise InvalidArgument(f"no joint is found ({why}); give more views, or whole clouds")


def _orders(clouds: list[Floats], eyes: Floats) -> list[Ints]:
    """Return the poses, the reference first, for each that is worth trying."""
    if len(clouds) < 2:
        return [np.arange(len(clouds))]
    everything = np.concatenate(clouds)
    size = float(np.ptp(everything, axis=0).max()) or 1.0
    sight = Sight.of([cloud / size for cloud in clouds], eyes / size)
    few = [cloud[:: max(len(cloud) // 500, 1)] / size for cloud in clouds]
    left = [np.delete(sight.free(cloud).mean(1), k).mean() for k, cloud in enumerate(few)]
    best = np.argsort(-np.array(left), kind="stable")[:_REFERENCES]
    return [np.concatenate([[k], np.delete(np.arange(len(clouds)), k)]) for k in best]


@dataclass(frozen=True, eq=False)
class _Fit:
    """A joint with the states of all poses but the reference, and where they are `known` (K - 1,)
    by the `share` (K - 1,) of its points that lie on something new."""

    joint: Candidate
    known: Bools
    share: Floats

    def is_like(self, other: "_Fit") -> bool:
        """Return whether both are one joint, for all that is known of their states."""
        one, two = self.joint, other.joint
        along = float(one.axis @ two.axis)
        if one.turns != two.turns or abs(along) < _SAME_WAY:
            return False
        off = one.pivot - two.pivot
        if one.turns and np.linalg.norm(off - (off @ one.axis) * one.axis) > _APART:
            return False
        differs = np.abs(one.states - np.sign(along) * two.states)[self.known & other.known]
        return differs.mean() < _SAME_STATES[one.turns] if len(differs) else True


class _Exact:
    """The faces of all poses, to which joints are fitted."""

    def __init__(self, diff: Change, eyes: Floats) -> None:
        self.diff, near = diff, diff.near
        assert diff.all_sight is not None  # it has cameras
        self.sight = diff.all_sight
        eyes = diff.frame.to_unit(eyes)
        self.first = _facing(diff.start, eyes[0], near)
        others = [_facing(diff.others.pose(k), eye, near) for k, eye in enumerate(eyes[1:])]
        self.others = Cells.of(others, near)
        fresh = [is_new(Surface.bare(s.points), diff.stays, near, self.sight) for s in others]
        self.new = Cells.of([s[new] for s, new in zip(others, fresh, strict=True)], near)

    def joints(self, kinds: Collection[JointKind]) -> list[_Fit]:
        """Return the joints, unlike one another, those first that most is known of; InvalidArgument
        if more moves than they explain."""
        search = Finder(self.diff, kinds, {})
        search.look_for_joints()
        fits = list[_Fit]()
        for joint in search.settled():
            follow = search.movers[search.explained(joint, 2.0 * self.diff.near).follow]
            if len(follow):
                fits.append(self._fit(joint, follow))
        fits.sort(key=lambda fit: -fit.share[fit.known].sum())
        unlike, enough = list[_Fit](), min(_POSES, len(self.others))
        for fit in fits:
            if fit.known.sum() >= enough and not any(fit.is_like(other) for other in unlike):
                unlike.append(fit)
        if self._lost(search, unlike) > _LOST or self._strange(unlike) > _STRANGE:
            raise InvalidArgument("more moves than the joints that are found explain")
        return unlike

    def _lost(self, search: Finder, fits: list[_Fit]) -> float:
        """Return the share of what has left that joints, where their states are known, move mostly
        to where nothing is, all of them."""
        part, at = self.diff.start[search.movers], self.diff.chosen - 1
        known, lands = np.zeros((2, *search.gone.shape), np.bool_)
        clear = ~known
        for fit in fits:
            M, knows = motions(fit.joint)[at], fit.known[at, None]
            there = self.diff.poses.met(part, M, 1.5 * self.diff.near)
            free = self.sight[self.diff.chosen].free(carried(M, part.points))
            known |= knows
            lands |= knows & there
            clear &= ~knows | free & ~there
        against = (search.gone & known & clear).sum(0)
        judged = against + (search.gone & lands).sum(0)
        return float((2 * against > judged)[judged > 0].mean()) if judged.any() else 0.0

    def _strange(self, fits: list[_Fit]) -> float:
        """Return the share of what is new, in poses where a state is known, that all joints bring
        back to where nothing was."""
        strange = [np.zeros(1, np.bool_)]
        for s, k in enumerate(self.diff.chosen - 1):
            new, clear = Surface.bare(self.diff.targets.pose(s).points), list[Bools]()
            for joint in (fit.joint for fit in fits if fit.known[k]):
                back = new.moved(motions(joint, -joint.states)[k])
                there = self.diff.first.met(back, still(1), 1.5 * self.diff.near)[0]
                clear.append(self.sight[:1].free(back.points)[0] & ~there)
            strange += [np.all(clear, axis=0)] if clear else []
        return float(np.concatenate(strange).mean())

    def _fit(self, joint: Candidate, which: Ints) -> _Fit:
        near, part = self.diff.near, self.first[some(which, _CORE)]
        states = np.zeros(len(self.others))
        states[self.diff.chosen - 1] = joint.states
        fit = self._known(replace(joint, states=states), part, 2.0 * near)
        for _ in range(2):
            if fit.known.any():
                joint = self._fitted(fit, part)
                joint = replace(joint, states=states_of(joint, part, self.new, self.diff.stays))
                fit = self._known(joint, part, near)
        return fit

    def _known(self, joint: Candidate, part: Surface, reach: float) -> _Fit:
        M = motions(joint)
        met = self.new.met(part, M, reach)
        bare = self.sight[1:].free(carried(M, part.points))
        bare &= ~self.others.met(part, M, self.diff.near, bare)
        share = met.mean(1)
        known = (share >= _SHOWS) & (bare.sum(1) <= _FREE * (met | bare).sum(1))
        across = np.abs(part.normals @ joint.axis) > 0.5
        return _Fit(joint, known & (joint.turns or across.mean() >= _ACROSS), share)

    def _fitted(self, fit: _Fit, part: Surface) -> Candidate:
        """Return the joint fitted to where its states are known."""
        joint = replace(fit.joint, states=fit.joint.states[fit.known])
        poses = [self.new.pose(int(k)) for k in np.flatnonzero(fit.known)]
        plain = PLAIN if not joint.turns or np.abs(joint.axis).max() > BESIDE else 0.0
        return refitted(joint, part, Cells.of(poses, self.diff.near), plain)

    def discovery(self, fits: list[_Fit], clouds: list[Floats], order: Ints) -> Discovery:
        """Return it in the clouds' frame and order."""
        diff = self.diff
        near, cloud = diff.near, np.ascontiguousarray(diff.frame.to_unit(clouds[order[0]]))
        surface, K = Surface.bare(cloud), len(clouds)
        cost = []
        for M, known in [
            (still(K - 1), np.ones(K - 1, np.bool_)),
            *((motions(fit.joint), fit.known) for fit in fits),
        ]:
            far = np.minimum(diff.others.distances(surface, M, near), near) / near
            shown = (far < 1.0) | self.sight[1:].free(carried(M, cloud))
            shown &= known[:, None]
            cost.append(
                np.where(shown.any(0), (far * shown).sum(0) / np.maximum(shown.sum(0), 1), 0.5)
            )
        which, part = by_size(labels(np.array(cost), cloud, near), [0] * len(fits))
        joints = []
        for n, fit in enumerate(fits[j] for j in which):
            states = np.zeros(K)
            states[order[1:]] = np.where(fit.known, fit.joint.states, np.nan)
            middle, score = cloud[part == n + 1].mean(0), float(fit.share[fit.known].mean())
            joints.append(found_joint(diff.frame, fit.joint, states, middle, score))
        return Discovery(tuple(joints), clouds[order[0]], part, int(order[0]))


def _facing(surface: Surface, eye: Floats, near: float) -> Surface:
    """Return a surface with normals towards the camera that saw it: of the plane through the fewest
    points about each that have one, else straight to it."""
    cells, back = Cells.of([surface]), eye - surface.points
    outward = back / np.maximum(norm(back), 1e-12)[:, None]
    for radius in _RADII:
        normals = surface.shaped(cells, radius * near).normals
        along = (back * normals).sum(1, keepdims=True)
        outward = np.where(along != 0.0, np.sign(along) * normals, outward)
    return Surface.bare(surface.points, outward).shaped(cells, near)
