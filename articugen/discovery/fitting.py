"""A candidate made exact: its axis, pivot and states fitted to the points that follow it, and the
points that follow it found anew."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from articugen.discovery import kernels
from articugen.discovery.clouds import Cells, Surface
from articugen.discovery.search import Candidate, motions, plane_across
from articugen.records import Floats

_FLAT_FRONT = 10.0
"""What slides is often flat, and says little of where across it goes: it is damped the more."""

_WANDERS = 0.7
"""Pivots farther out than this are no better than slides."""

STEPS = 160


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
            cells.points, cells.normals, cells.starts, reach,
            cells.across(reach),
        )  # fmt: skip
        H[:held], H[:, :held], g[:held] = 0.0, 0.0, 0.0
        scale = max(H.diagonal().max(), 1e-9)
        damped = 1.0 if joint.turns else _FLAT_FRONT
        H[np.diag_indices(len(H))] += damped * (0.002 * H.diagonal() + 1e-5 * scale)
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
    M, wide = motions(joint, steps), 1.5 * near
    rough = [
        kernels.profile(
            part.points,
            part.normals,
            M,
            cells.points,
            cells.normals,
            cells.starts,
            k,
            wide,
            cells.across(wide),
        ).argmax()
        for k in range(len(cells))
    ]
    exact = replace(joint, states=steps[rough])
    exact = fitted(exact, part, cells, 2.0 * near, 3, states_alone=True)
    return fitted(exact, part, cells, near, 4, states_alone=True).states


def some(which: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """At most so many of the indices, evenly."""
    if len(which) <= most:
        return which
    return which[np.linspace(0, len(which) - 1, most).round().astype(int)]
