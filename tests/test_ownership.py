"""Whose each point is: a tray that slides out of a case, seen from outside, and naive oracles."""

from dataclasses import replace

import numpy as np
import pytest

from articugen.discovery import assign_material
from articugen.discovery.clouds import Cells, Surface
from articugen.discovery.kernels import to_nothing
from articugen.discovery.ownership import RIM

R = 32
CASE = np.array([[-0.4, -0.2, -0.2], [0.0, 0.2, 0.2]])
TRAY = np.array([[-0.36, -0.15, -0.15], [0.0, 0.15, 0.15]])
STATES = np.linspace(0.0, 0.3, 9)


def on_faces(low, high, count, rng):
    """Points on the six faces of a box."""
    points = rng.uniform(low, high, (count, 3))
    axis, end = rng.integers(3, size=count), rng.integers(2, size=count)
    points[np.arange(count), axis] = np.where(end, high[axis], low[axis])
    return points


def scene(rng, states=STATES):
    """Clouds of what is seen from outside, what no view sees free, motions and true parts."""
    centres = (np.stack(np.meshgrid(*3 * [np.arange(R)], indexing="ij"), -1) + 0.5) / R - 0.5
    clouds, hidden, parts, motions = [], [], [], []
    for s in states:
        slide = np.array([s, 0.0, 0.0])
        case, tray = on_faces(*CASE, 900, rng), on_faces(*(TRAY + slide), 900, rng)
        case = case[~((case[:, 0] > -1e-9) & (np.abs(case[:, 1:]) < 0.15).all(1))]  # the opening
        seen = tray[tray[:, 0] >= -1e-9]
        clouds.append(np.concatenate([case, seen]))
        parts.append(np.repeat([0, 1], [len(case), len(seen)]))
        inside = [((centres > b[0]) & (centres < b[1])).all(-1) for b in (CASE, TRAY + slide)]
        hidden.append(inside[0] | inside[1])
        T = np.tile(np.eye(4), (2, 1, 1))
        T[1, :3, 3] = slide
        motions.append(T)
    return clouds, np.array(hidden), np.array(motions), parts


@pytest.fixture(scope="module")
def tray():
    made = scene(np.random.default_rng(0))
    return made, assign_material(*made[:3])


def rest_of(cloud, motion):
    """(P, n, 3) where points would be at rest if they were of each part."""
    back = np.linalg.inv(motion)
    return np.einsum("pij,nj->pni", back[:, :3, :3], cloud) + back[:, None, :3, 3]


def test_each_point_goes_to_the_part_it_moves_with(tray):
    (clouds, _, motions, parts), found = tray
    assert found.owns.all()
    for cloud, motion, part in zip(clouds, motions, parts, strict=True):
        assert (found.part_of(rest_of(cloud, motion)) == part).mean() > 0.95


def test_boxes_are_those_of_what_was_seen(tray):
    _, found = tray
    seen = np.array([[-0.3, -0.15, -0.15], [0.0, 0.15, 0.15]])  # what stays inside is never seen
    low, high = found.middle[1] - found.size[1], found.middle[1] + found.size[1]
    np.testing.assert_allclose([low, high], seen, atol=0.05)
    low, high = found.middle[0] - found.size[0], found.middle[0] + found.size[0]
    np.testing.assert_allclose([low, high], CASE, atol=0.03)


def test_a_part_that_never_shows_owns_nothing():
    clouds, hidden, motions, _ = scene(np.random.default_rng(1), np.zeros(4))
    found = assign_material(clouds, hidden, motions)
    assert found.owns.tolist() == [True, False]
    assert (found.part_of(rest_of(clouds[0], motions[0])) == 0).all()


def test_doubt_is_known_where_a_box_is_and_nowhere_else(tray):
    _, found = tray
    assert found.doubt.shape == (2, R, R, R)
    centres = (np.argwhere(found.doubt[0]) + 0.5) / R - 0.5
    assert (centres[:, 0] > 0.0).all()  # never of the case, nor of what it hides
    assert (np.abs(centres[:, 1:]) < 0.15 + 2.0 / R).all()
    assert (centres[:, 0] < 0.3 + 2.0 / R).all()  # no tray ever comes here
    centres = (np.argwhere(found.doubt[1]) + 0.5) / R - 0.5
    assert (np.abs(centres - found.middle[1]) <= found.size[1] + RIM + 1.0 / R).all()
    middle = found.part_of(np.stack([np.full((1, 3), 9.0), found.middle[1][None]]))
    assert middle.tolist() == [1]


def test_the_rim_of_a_box_is_its_parts_where_the_fixed_part_is_never(tray):
    """A point beside the tray's box, where only the open tray comes, and one in the case's wall."""
    _, found = tray
    side = found.middle[1] + [0.0, found.size[1][1] + 0.5 * RIM, 0.0]
    out, wall = side + np.array([0.25, 0.0, 0.0]), np.array([-0.2, 0.2, 0.0])
    doubt = found.doubt.copy()
    i, j, k = ((side + 0.5) * R).astype(int)
    doubt[1, i, j, k] = 0.0  # something is there at rest in every pose
    i, j, k = ((out + 0.5) * R).astype(int)
    doubt[0, i, j, k] = 0.5  # and nothing is where it would be if it were fixed
    rim = replace(found, doubt=doubt)
    assert rim.part_of(np.stack([[out], [side]])).tolist() == [1]
    assert rim.part_of(np.stack([[wall], [side]])).tolist() == [0]
    beyond = side + np.array([0.0, RIM, 0.0])
    assert rim.part_of(np.stack([[out], [beyond]])).tolist() == [0]


def test_to_nothing_is_what_a_naive_look_says():
    rng = np.random.default_rng(2)
    clouds = [rng.uniform(-0.45, 0.45, (300, 3)) for _ in range(4)]
    taken = (rng.random((4, 8, 8, 8)) < 0.3).astype(np.uint8)
    motions = np.tile(np.eye(4)[:3], (4, 1, 1))
    motions[:, :, 3] = rng.uniform(-0.1, 0.1, (4, 3))
    motions[1, :2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    rest = rng.uniform(-0.5, 0.5, (200, 3))
    cells = Cells.of([Surface.bare(cloud) for cloud in clouds])
    found = to_nothing(rest, motions, taken, cells.points, cells.starts, 0.05)
    wanted = np.zeros(len(rest))
    for M, grid, cloud in zip(motions, taken, clouds, strict=True):
        posed = rest @ M[:, :3].T + M[:, 3]
        at = np.clip(np.floor((posed + 0.5) * 8).astype(int), 0, 7)
        near = np.linalg.norm(posed[:, None] - cloud, axis=2).min(1) <= 0.05
        wanted += (grid[tuple(at.T)] == 0) & ~near
    np.testing.assert_array_equal(found, wanted / 4)
    assert 0.0 < found.mean() < 1.0
