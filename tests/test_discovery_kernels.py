"""The kernels of discovery beside what they mean, written slowly."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from python_process import printed

from articugen.core.records import Floats
from articugen.discovery import kernels
from articugen.discovery.clouds import Cells, Surface
from articugen.discovery.fitting import _DAMPED, fitted
from articugen.discovery.gauss_newton import LEVEL, LONGEST
from articugen.discovery.search import Candidate, motions, plane_across

NEAR, REACH = 0.02, 0.04


@given(seed=st.integers(0, 2**32 - 1), reach=st.floats(0.005, 0.1))
@settings(max_examples=40, deadline=None)
def test_what_is_said_to_be_void_is_void(seed: int, reach: float) -> None:
    rng = np.random.default_rng(seed)
    clouds = [rng.uniform(-0.55, 0.55, (20, 3)) for _ in range(10)]
    cells = Cells.of([Surface.bare(cloud) for cloud in clouds])
    within = cells.within(reach)
    near_one = clouds[0][:, None] + reach * rng.standard_normal((1, 8, 3)) / 2
    queries = np.concatenate([rng.uniform(-0.7, 0.7, (50, 3)), near_one.reshape(-1, 3)])
    some = 0
    for k, cloud in enumerate(clouds):
        least = np.linalg.norm(queries[:, None] - cloud, axis=2).min(1)
        void = np.array([kernels.is_void(within, k, *query) for query in queries])
        assert (least[void] > reach).all()
        some += void.sum()
    assert some > 0


@given(seed=st.integers(0, 2**32 - 1), reach=st.floats(0.005, 0.2))
@settings(max_examples=10, deadline=None)
def test_nearest_is_the_nearest_whatever_is_guessed(seed: int, reach: float) -> None:
    rng = np.random.default_rng(seed)
    cloud = rng.uniform(-0.45, 0.45, (300, 3))
    cloud[::2] = np.round(cloud[::2] * 32) / 32  # on the borders of cells
    cloud = np.concatenate([cloud, cloud[:50]])  # some twice: the last one counts
    cells = Cells.of([Surface.bare(cloud)], NEAR)
    around = cells.points[:15] + reach * rng.standard_normal((15, 3)) / 2
    for query in np.concatenate([cells.points[:15], around]):
        squared = ((cells.points - query) ** 2) @ np.ones(3)
        least = float(squared.min())
        for guess in (-1, *rng.integers(0, len(cloud), 3).tolist(), int(squared.argmin())):
            at, d = kernels.nearest(
                cells.points, cells.normals, False, cells.starts, 0, *query, 0.0, 0.0, 0.0,
                reach, 1.0, guess,
            )  # fmt: skip
            if least > reach**2:
                assert at == -1
            else:
                assert d == pytest.approx(least, abs=1e-15)
                assert at == np.flatnonzero((cells.points == cells.points[at]).all(1))[-1]


def test_surfaces_at_right_angles_are_not_alike() -> None:
    """Of exact normals, which are those of furniture, the product is exactly 0, as with no normal;
    what has none may be of any surface."""
    for facing, is_alike in (([0.0, 1.0, 0.0], False), ([1.0, 0.0, 0.0], True), ([0.0] * 3, True)):
        cells = Cells.of([Surface.bare(np.full((1, 3), 0.1), np.array([facing]))], NEAR)
        for normal, found in (([1.0, 0.0, 0.0], is_alike), ([0.0] * 3, True)):
            at, _ = kernels.nearest(
                cells.points, cells.normals, True, cells.starts, 0, 0.1, 0.1, 0.1, *normal,
                REACH, NEAR, -1,
            )  # fmt: skip
            assert (at == 0) == found


def _rounds_by_hand(joint: Candidate, part: Surface, clouds: list[Floats]) -> Candidate:
    """One round of Gauss and Newton's method, with gradients by differences."""
    across = plane_across(joint.axis)
    unknowns = 4 + len(clouds)

    def moved(u: Floats) -> Floats:
        tilted = joint.axis.copy()
        if joint.turns:
            tilted += np.cross(u[:2] @ across, joint.axis)
        else:
            tilted += u[:2] @ across
        tilted /= np.linalg.norm(tilted)
        pivot = joint.pivot + (u[2:4] @ across if joint.turns else 0.0)
        M = motions(Candidate(joint.turns, tilted, pivot, joint.states + u[4:]))
        return np.einsum("kij,nj->kni", M[:, :, :3], part.points) + M[:, None, :, 3]

    zero, h = np.zeros(unknowns), 1e-6
    there = moved(zero)
    J = np.stack([(moved(h * e) - moved(-h * e)) / (2 * h) for e in np.eye(unknowns)])
    H, g = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    R = motions(joint)[:, :, :3]
    for k, cloud in enumerate(clouds):
        for i, x in enumerate(there[k]):
            off = x - cloud
            at = int((off**2).sum(1).argmin())
            squared = (off[at] ** 2).sum()
            if squared > REACH**2:
                continue
            W = (1 - squared / REACH**2) ** 2 * R[k] @ part.stiffness[i] @ R[k].T
            H += J[:, k, i] @ W @ J[:, k, i].T
            g += J[:, k, i] @ W @ off[at]
    H[np.diag_indices(unknowns)] += _DAMPED[joint.turns] * (
        H.diagonal() + LEVEL * H.diagonal().max()
    )
    u = np.clip(-np.linalg.solve(H, g), -LONGEST, LONGEST)
    axis = joint.axis + (np.cross(u[:2] @ across, joint.axis) if joint.turns else u[:2] @ across)
    pivot = joint.pivot + (u[2:4] @ across if joint.turns else 0.0)
    return Candidate(joint.turns, axis / np.linalg.norm(axis), pivot, joint.states + u[4:])


@pytest.mark.parametrize("turns", [True, False])
@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (0.48, -0.6, 0.64), (-1.0, 0.0, 0.0)])
def test_a_round_is_that_of_gauss_and_newton(turns: bool, axis: tuple[float, ...]) -> None:
    rng = np.random.default_rng(3)
    true = Candidate(turns, np.array(axis), np.array([0.1, -0.05, 0.02]), np.array([0.3, 0.1, 0.2]))
    cloud = rng.uniform(-0.15, 0.15, (120, 3))
    M = motions(true)
    clouds = [cloud @ M[k, :, :3].T + M[k, :, 3] for k in range(3)]
    spread = rng.standard_normal((len(cloud), 3, 3))
    part = Surface(cloud, np.zeros_like(cloud), spread @ spread.transpose(0, 2, 1))
    off = Candidate(
        turns, true.axis, true.pivot + 0.004, true.states + np.array([0.01, -0.008, 0.005])
    )
    cells = Cells.of([Surface.bare(each) for each in clouds], NEAR)
    found, slow = fitted(off, part, cells, REACH, 1), _rounds_by_hand(off, part, clouds)
    np.testing.assert_allclose(found.states, slow.states, atol=1e-7)
    np.testing.assert_allclose(found.axis, slow.axis, atol=1e-7)
    np.testing.assert_allclose(found.pivot, slow.pivot, atol=1e-7)
    assert np.abs(found.states - off.states).max() > 1e-3
    settled = fitted(off, part, cells, REACH, 30)
    np.testing.assert_allclose(settled.states, true.states, atol=1e-4)


def test_what_is_held_stays() -> None:
    rng = np.random.default_rng(4)
    cloud = rng.uniform(-0.2, 0.2, (100, 3))
    cells = Cells.of([Surface.bare(cloud + 0.01)], NEAR)
    part = replace(Surface.bare(cloud), stiffness=np.tile(np.eye(3), (100, 1, 1)))
    start = Candidate(True, np.array([0.0, 0.0, 1.0]), np.zeros(3), np.full(1, 0.1))
    plain = fitted(start, part, cells, REACH, 3, tilts=False)
    np.testing.assert_array_equal(plain.axis, start.axis)
    assert np.abs(plain.pivot).max() > 0.0
    alone = fitted(start, part, cells, REACH, 3, states_alone=True)
    np.testing.assert_array_equal(alone.axis, start.axis)
    np.testing.assert_array_equal(alone.pivot, start.pivot)
    np.testing.assert_array_equal(start.states, 0.1)


AHEAD = """
from numba.core.dispatcher import Dispatcher
from articugen.discovery import discover, gauss_newton, groups, kernels, owner_kernels, warm
warm.joints()
rooms = map(vars, (gauss_newton, groups, kernels, owner_kernels))
some = {thing for room in rooms for thing in room.values() if isinstance(thing, Dispatcher)}
print(len(some), {len(kernel.signatures) for kernel in some})
from test_discovery import LID, faces, np, posed, turn
door = posed([(LID, turn((0, 0, 1), (0.05, -0.22, 0)))], [[0.0], [0.5], [1.0]])
many = [np.concatenate([cloud, cloud + 1e-4]) for cloud in door]
for clouds, normals in ((many, None), faces([0.0, 0.1, 0.2])):
    discover(clouds, normals=normals)
print({len(kernel.signatures) for kernel in some})
"""


def test_what_is_compiled_ahead_is_what_is_used() -> None:
    """Each kernel once: it would be compiled again for arrays of another layout."""
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    lines = printed("-c", AHEAD, PYTHONPATH=path).splitlines()
    assert lines == ["17 {1}", "{1}"]
