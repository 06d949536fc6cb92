"""Candidates for joints: a patch of points that have left pose 0 is turned about every axis of a
grid, and slid along every direction of a fan, and what lands on something new is counted."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.core.geometry import cross, fibonacci_sphere
from articugen.core.records import Floats, JointKind
from articugen.discovery import kernels
from articugen.discovery.clouds import Change

ANGLES = 96  # steps of a full turn

PIVOT_STEP = 0.03
SLIDE_STEP = 0.0125
_LONGEST_SLIDE = 0.8
_FAN = 60
_FEW, _KEPT = 3, 8
"""Turns about all pivots are tried with every `_FEW`-th point of a patch, then those about the best
pivots, one in `_KEPT`, with all of its points."""

_VOTE_REACH = 0.02
"""Votes are for places so near to something new, at least: pivots and axes are on coarse grids."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A joint as it is searched for, in the cube: `axis` (3,), `pivot` (3,), `states` (S,) of the
    searched poses."""

    turns: bool
    axis: Floats
    pivot: Floats
    states: Floats

    @property
    def kind(self) -> JointKind:
        return JointKind.REVOLUTE if self.turns else JointKind.PRISMATIC

    def snapped(self) -> "Candidate":
        """Return it with the coordinate axis nearest to its own."""
        nearest = int(np.abs(self.axis).argmax())
        return replace(self, axis=np.eye(3)[nearest] * np.sign(self.axis[nearest]))


_fan = fibonacci_sphere(2 * _FAN)
EVERY_WAY = np.concatenate([np.eye(3), _fan[_fan[:, 2] > 0]])
"""(n, 3) directions to slide in: the coordinate axes and a fan of others."""


def motions(candidate: Candidate, states: Floats | None = None) -> Floats:
    """Return (S, 3, 4) what a joint does to its part at its states, or at others."""
    q = candidate.states if states is None else states
    axis, pivot = candidate.axis, candidate.pivot
    M = np.zeros((len(q), 3, 4))
    if not candidate.turns:
        M[:, :, :3], M[:, :, 3] = np.eye(3), q[:, None] * axis
        return M
    K = np.cross(np.eye(3), axis)
    R = np.eye(3) + np.sin(q)[:, None, None] * K + (1.0 - np.cos(q))[:, None, None] * (K @ K)
    M[:, :, :3] = R
    M[:, :, 3] = pivot - R @ pivot
    return M


def carried(motion: Floats, points: Floats) -> Floats:
    """Return (S, n, 3) points (n, 3) moved by each of S motions (S, 3, 4)."""
    return (motion[:, None, :, :3] @ points[:, :, None])[..., 0] + motion[:, None, :, 3]


def plane_across(axis: Floats) -> Floats:
    """Return (2, 3) unit vectors that span the plane across `axis`; coordinate axes where they
    do."""
    start = np.eye(3)[int(np.abs(axis).argmin())]
    first = cross(axis, start)
    first = first / np.linalg.norm(first)
    return np.stack([first, cross(axis, first)])


def ballot(change: Change) -> NDArray[np.uint64]:
    """Return (VOTES^3 + 1,) bits of each cell: byte k is 1 where something new is near in searched
    pose k; at the end 0, for what is outside."""
    R = kernels.VOTES
    grid = np.zeros((R, R, R), np.uint64)
    wide = max(change.near, _VOTE_REACH)
    reach = int(np.ceil(wide * R))
    ball = np.argwhere(np.ones((2 * reach + 1,) * 3)) - reach
    ball = ball[(ball**2).sum(1) <= (wide * R) ** 2]
    starts = change.targets.starts
    for k in range(len(starts)):
        points = change.targets.points[starts[k, 0] : starts[k, -1]]
        cell = np.unique(np.floor((points + 0.5) * R).astype(int), axis=0)
        around = (cell[:, None] + ball).reshape(-1, 3)
        around = around[np.all((around >= 0) & (around < R), axis=1)]
        mark = np.zeros((R, R, R), bool)
        mark[tuple(around.T)] = True
        grid |= mark.astype(np.uint64) << np.uint64(8 * k)
    return np.append(grid, np.uint64(0))


def weights(change: Change, which: NDArray[np.intp]) -> NDArray[np.uint64]:
    """Return (m,) of points of pose 0: byte k is 1 where the point has left in searched pose k."""
    bits = change.gone[:, which].astype(np.uint64)
    return np.bitwise_or.reduce(
        bits << (8 * np.arange(len(bits), dtype=np.uint64))[:, None], axis=0
    )


class Search:
    """The exhaustive search over what changes."""

    def __init__(self, change: Change) -> None:
        self.change = change
        self.grid = ballot(change)
        points = change.start.points[change.movers]
        self.low = np.min([points.min(0), change.targets.points.min(0)], axis=0)
        self.high = np.max([points.max(0), change.targets.points.max(0)], axis=0)
        self._turns: dict[tuple[float, ...], tuple[Floats, Floats, Floats, Any]] = {}

    def turns(
        self, which: NDArray[np.intp], axis: Floats, keep: int
    ) -> list[tuple[float, Candidate]]:
        """Return the best turns of some points (at most 255) about an axis of this direction."""
        angles, spins, pivots, rest = self._turns_about(tuple(axis.tolist()))
        points = self.change.start.points[which] * kernels.VOTES
        turned = (spins @ points.T).astype(np.float32)
        w = weights(self.change, which)
        few, _ = kernels.votes(turned[:, :, ::_FEW].copy(), rest, w[::_FEW].copy(), self.grid)
        kept = np.argsort(-few.sum(1), kind="stable")[: max(len(pivots) // _KEPT, keep)]
        pivots = pivots[kept]
        most, step = kernels.votes(turned, rest[kept], w, self.grid)
        share = most.sum(1) / self._whole(which)
        chosen, free = [], np.ones(len(pivots), bool)
        for _ in range(keep):
            c = int(np.where(free, share, -1.0).argmax())
            states = self._states(angles, step[c], which)
            chosen.append((float(share[c]), Candidate(True, axis, pivots[c], states)))
            free &= ((pivots - pivots[c]) ** 2).sum(1) > (2.5 * PIVOT_STEP) ** 2
            if not free.any():
                break
        return chosen

    def _turns_about(
        self, axis: tuple[float, ...]
    ) -> tuple[Floats, Floats, Floats, NDArray[np.float32]]:
        """Return what turns of all patches about an axis share: (T,) angles, (T, 3, 3) rotations,
        (C, 3) pivots, and (C, T, 3) what each pivot adds to what is turned, in cells of the
        grid."""
        if axis not in self._turns:
            way = np.array(axis)
            pivots = self._pivots(plane_across(way), way)
            angles = np.linspace(-np.pi, np.pi, ANGLES, endpoint=False)
            spins = motions(Candidate(True, way, np.zeros(3), angles))[:, :, :3]
            rest = pivots[:, None] - np.einsum("tij,cj->cti", spins, pivots)
            offsets = ((rest + 0.5) * kernels.VOTES).astype(np.float32)
            self._turns[axis] = angles, spins, pivots, offsets
        return self._turns[axis]

    def slides(
        self, which: NDArray[np.intp], ways: Floats, keep: int
    ) -> list[tuple[float, Candidate]]:
        """Return the best slides of some points (at most 255) along directions `ways` (n, 3)."""
        P, R = self.change.start.points[which], kernels.VOTES
        lengths = np.arange(-_LONGEST_SLIDE, _LONGEST_SLIDE, SLIDE_STEP)
        offsets = ways[:, None] * lengths[:, None] + 0.5
        turned = np.broadcast_to(P.T * R, (len(lengths), *P.T.shape))
        most, step = kernels.votes(
            turned.astype(np.float32, order="C"), (offsets * R).astype(np.float32),
            weights(self.change, which), self.grid,
        )  # fmt: skip
        share = most.sum(1) / self._whole(which)
        share += 0.02 * (np.abs(ways).max(1) == 1.0)
        middle = P.mean(0)
        best = np.argsort(-share, kind="stable")[:keep]
        slid = [self._states(lengths, step[c], which) for c in best]
        return [
            (float(share[c]), Candidate(False, ways[c], middle, states))
            for c, states in zip(best, slid, strict=True)
        ]

    def _states(self, steps: Floats, best: NDArray[np.int32], which: NDArray[np.intp]) -> Floats:
        """Return (S,) states that got most votes; 0 where few have left, and votes say little."""
        gone = self.change.gone[:, which].mean(1)
        return np.where(gone > 0.3, steps[best[: len(gone)]], 0.0)

    def _whole(self, which: NDArray[np.intp]) -> float:
        return max(float(self.change.gone[:, which].sum()), 1.0)

    def _pivots(self, across: Floats, axis: Floats) -> Floats:
        """Return (C, 3) a grid over the object's shadow along `axis`, at the middle of its
        height."""
        corners = np.array([np.where(b, self.high, self.low) for b in np.ndindex(2, 2, 2)])
        u, v = across @ corners.T
        us = np.arange(u.min() - PIVOT_STEP, u.max() + 2 * PIVOT_STEP, PIVOT_STEP)
        vs = np.arange(v.min() - PIVOT_STEP, v.max() + 2 * PIVOT_STEP, PIVOT_STEP)
        grid = np.stack(np.meshgrid(us, vs, indexing="ij"), axis=-1).reshape(-1, 2)
        middle = (self.low + self.high) @ axis / 2.0
        return grid @ across + middle * axis
