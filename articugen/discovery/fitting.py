"""A candidate made exact: its axis, pivot and states fitted to the points that follow it, and the
points that follow it found anew."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from articugen.discovery import kernels
from articugen.discovery.clouds import Cells, Surface
from articugen.discovery.search import Candidate, motions, plane_across
from articugen.records import Floats

_DAMPED = {True: 1e-4, False: 2e-2}
"""What slides is often flat, and says little of where across it goes: it is damped the more."""

_WANDERS = 0.7
"""Pivots farther out than this are no better than slides."""

STEPS = 160
_PEAKS = 3
"""Of each pose so many states are made exact, before the best is taken."""


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
    """The joint after so many rounds of Gauss and Newton's method, damped a little.

    Args:
        part: in pose 0.
        reach: points farther than this from a pose say nothing.
        tilts: whether the axis may.
        states_alone: or everything but the states is kept.
    """
    held = 4 if states_alone else 0 if tilts else 2
    for _ in range(rounds):
        across = plane_across(joint.axis)
        H, g = kernels.normal_equations(
            part.points, part.normals, part.stiffness, motions(joint), joint.turns,
            np.concatenate([joint.axis[None], joint.pivot[None], across]),
            cells.points, cells.normals, cells.signed, cells.starts, reach,
            cells.across(reach),
        )  # fmt: skip
        H[:held], H[:, :held], g[:held] = 0.0, 0.0, 0.0
        scale = max(H.diagonal().max(), 1e-9)
        damped = _DAMPED[joint.turns]
        H[np.diag_indices(len(H))] += damped * (H.diagonal() + 0.005 * scale)
        step = np.clip(-np.linalg.solve(H, g), -0.2, 0.2)
        joint = _moved(joint, across, step)
        if np.abs(step).max() < 1e-5:
            break
    return joint


def _moved(joint: Candidate, across: Floats, step: Floats) -> Candidate:
    if joint.turns:
        w = step[0] * across[0] + step[1] * across[1]
        axis = joint.axis + np.cross(w, joint.axis)
        pivot = joint.pivot + step[2] * across[0] + step[3] * across[1]
        pivot = np.clip(pivot, -_WANDERS, _WANDERS)
    else:
        axis, pivot = joint.axis + step[0] * across[0] + step[1] * across[1], joint.pivot
    states = joint.states + step[4:]
    return replace(joint, axis=axis / np.linalg.norm(axis), pivot=pivot, states=states)


def states_of(joint: Candidate, part: Surface, cells: Cells, near: float) -> Floats:
    """(K,) the states at which a part lies on each of the poses in `cells`, searched one by one
    over a whole turn or the cube's length, then made exact."""
    if joint.turns:
        steps = np.linspace(-np.pi, np.pi, STEPS, endpoint=False)
    else:
        steps = np.linspace(-1.0, 1.0, STEPS + 1)
    wide = 1.5 * near
    heights = _profiles(joint, steps, part, cells, wide)
    found, fit = [], []
    for _ in range(_PEAKS):
        peak = heights.argmax(1)
        exact = replace(joint, states=steps[peak])
        for reach in (2.0 * near, near):
            exact = fitted(exact, part, cells, reach, 4, states_alone=True)
        found.append(exact.states)
        fit.append(_fit(exact, part, cells, near))
        for k, at in enumerate(peak):
            heights[k, max(at - 2, 0) : at + 3] = -1.0
    return np.choose(np.argmax(fit, axis=0), found)


def _profiles(joint: Candidate, steps: Floats, part: Surface, cells: Cells, reach: float) -> Floats:
    """(K, T) how well the part lies on each pose at each step of the joint."""
    M = motions(joint, steps)
    return np.array([_profile(M, part, cells, k, reach) for k in range(len(cells))])


def _fit(joint: Candidate, part: Surface, cells: Cells, reach: float) -> Floats:
    """(K,) how well the part lies on each pose at the joint's state of it."""
    M = motions(joint)
    return np.array([_profile(M[[k]], part, cells, k, reach)[0] for k in range(len(cells))])


def _profile(M: Floats, part: Surface, cells: Cells, pose: int, reach: float) -> Floats:
    return kernels.profile(
        part.points, part.normals, M, cells.points, cells.normals, cells.signed, cells.starts,
        pose, reach, cells.across(reach),
    )  # fmt: skip


def some(which: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """At most so many of the indices, evenly."""
    if len(which) <= most:
        return which
    return which[np.linspace(0, len(which) - 1, most).round().astype(int)]
