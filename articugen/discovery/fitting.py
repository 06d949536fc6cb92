"""A candidate made exact: its axis, pivot and states fitted to the points that follow it, and the
points that follow it found again."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from articugen.core.records import Floats
from articugen.discovery import gauss_newton
from articugen.discovery.clouds import Cells, Surface
from articugen.discovery.search import Candidate, motions

_DAMPED = {True: 1e-4, False: 2e-2}
"""What slides is often flat, and says little of where across it goes: it is damped the more."""

STEPS = 160
_FEW = {True: 80, False: 160}
"""Points of a part that say roughly where it may lie, with and without known normals."""

_COMMON, _FIXED = 0.2, 0.5
"""By these shares a surface counts less that is there in all poses, or is the fixed part's."""

_PEAKS = 3  # of each pose so many states are made exact, before the best is taken


def fitted(
    joint: Candidate,
    part: Surface,
    cells: Cells,
    reach: float,
    rounds: int,
    *,
    tilts: bool = True,
    states_alone: bool = False,
) -> Candidate:
    """Return the joint after `rounds` rounds of Gauss and Newton's method, damped a little.

    Args:
        part: in pose 0.
        reach: points farther than this from a pose say nothing.
        tilts: whether the axis may.
        states_alone: or everything but the states is kept.
    """
    fixed = 4 if states_alone else 0 if tilts else 2
    axis, pivot, states = joint.axis.copy(), joint.pivot.copy(), np.array(joint.states, np.float64)
    gauss_newton.fit(
        part.points, part.normals, part.stiffness, joint.turns, axis, pivot, states, fixed, rounds,
        _DAMPED[joint.turns], cells.points, cells.normals, cells.signed, cells.starts,
        cells.within(reach), reach, cells.across(reach),
    )  # fmt: skip
    return replace(joint, axis=axis, pivot=pivot, states=states)


def refitted(joint: Candidate, part: Surface, cells: Cells, plain: float) -> Candidate:
    """Return the joint fitted to a part in ever narrower reach; with the coordinate axis beside its
    own where that agrees as well, `plain` times as much counting alike, or 0 if it is no choice."""

    def refit(joint: Candidate, tilts: bool) -> tuple[Candidate, int]:
        for reach in (2.5, 1.5, 1.0, 1.0):
            joint = fitted(joint, part, cells, reach * cells.near, 8, tilts=tilts)
        return joint, int(cells.met(part, motions(joint), cells.near).sum())

    free, hits = refit(joint, tilts=np.abs(joint.axis).max() < 1.0)
    if not plain:
        return free
    snapped, as_many = refit(joint.snapped(), tilts=False)
    return snapped if as_many * plain >= hits else free


def states_of(joint: Candidate, part: Surface, cells: Cells, fixed: Cells) -> Floats:
    """Return (K,) the states at which a part lies on each of the poses in `cells`, searched one by
    one over a whole turn or the cube's length, then made exact. What is there in many poses, or is
    the `fixed` part's, says less: a door turned the wrong way round lies on the cabinet's side."""
    near = cells.near
    if joint.turns:
        steps = np.linspace(-np.pi, np.pi, STEPS, endpoint=False)
    else:
        steps = np.linspace(-1.0, 1.0, STEPS + 1)
    few = part[some(np.arange(len(part)), _FEW[part.signed])]
    tried = motions(joint, steps)
    heights = cells.agreement(few, tried, 1.5 * near)
    doubt = _COMMON * heights.mean(0)
    if joint.turns:
        doubt += _FIXED * fixed.agreement(few, tried, 1.5 * near)[0]
    heights -= doubt
    fits, fit = [], []
    for _ in range(_PEAKS):
        peak = heights.argmax(1)
        close = replace(joint, states=steps[peak])
        for reach in (2.0 * near, near):
            close = fitted(close, few, cells, reach, 4, states_alone=True)
        fits.append(close.states)
        fit.append(cells.agreement(few, motions(close)[:, None], near)[:, 0] - doubt[peak])
        for k, at in enumerate(peak):
            heights[k, max(at - 2, 0) : at + 3] = -np.inf
    best = replace(joint, states=np.choose(np.argmax(fit, axis=0), fits))
    return fitted(best, part, cells, near, 8, states_alone=True).states


def some(which: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """Return at most `most` of the indices, evenly."""
    if len(which) <= most:
        return which
    return which[np.linspace(0, len(which) - 1, most).round().astype(int)]
