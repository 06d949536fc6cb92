"""Whose each point is: a tray that slides out of a case, seen from outside, and naive oracles."""

import numpy as np
import pytest

from articugen.discovery import Ownership, kernels, owner_kernels, parts_of_surface
from articugen.discovery.clouds import Cells, Surface, cell_of
from articugen.discovery.ownership import CELLS, NOBODYS, REACH, _by_votes, examined

CASE = np.array([[-0.4, -0.2, -0.2], [0.0, 0.2, 0.2]])
BAY = np.array([[-0.37, -0.157, -0.157], [0.1, 0.157, 0.157]])
TRAY = np.array([[-0.36, -0.15, -0.15], [0.0, 0.15, 0.15]])
STATES = np.linspace(0.0, 0.3, 9)


def on_faces(low, high, count, rng):
    """Points on the six faces of a box, and its outward normals there."""
    points, normals = rng.uniform(low, high, (count, 3)), np.zeros((count, 3))
    axis, end = rng.integers(3, size=count), rng.integers(2, size=count)
    points[np.arange(count), axis] = np.where(end, high[axis], low[axis])
    normals[np.arange(count), axis] = np.where(end, 1.0, -1.0)
    return points, normals


def scene(rng, states=STATES):
    """Surfaces that are seen from outside, behind the tray the walls of its bay, too, with normals;
    motions and true parts."""
    clouds, normals, parts, motions = [], [], [], []
    for s in states:
        slide = np.array([s, 0.0, 0.0])
        case, tray = on_faces(*CASE, 900, rng), on_faces(*(TRAY + slide), 900, rng)
        bay, inwards = on_faces(*BAY, 900, rng)
        outside = ~((case[0][:, 0] > -1e-9) & (np.abs(case[0][:, 1:]) < 0.157).all(1))
        seen, behind = tray[0][:, 0] >= -1e-9, bay[:, 0] < -0.36 + s  # from behind, through a hole
        points = [case[0][outside], bay[behind], tray[0][seen]]
        facing = [case[1][outside], -inwards[behind], tray[1][seen]]
        clouds.append(np.concatenate(points))
        normals.append(np.concatenate(facing))
        parts.append(np.repeat([0, 0, 1], [*map(len, points)]))
        T = np.tile(np.eye(4), (2, 1, 1))
        T[1, :3, 3] = slide
        motions.append(T)
    return clouds, normals, np.array(motions), parts


@pytest.fixture(scope="module")
def tray():
    made = scene(np.random.default_rng(0))
    return made, Ownership.of(made[0], parts_of_surface(*made[:3]), made[2])


def rest_of(cloud, motion):
    """(P, n, 3) where points would be at rest if they were of each part."""
    back = np.linalg.inv(motion)
    return np.einsum("pij,nj->pni", back[:, :3, :3], cloud) + back[:, None, :3, 3]


def test_each_point_goes_to_the_part_it_moves_with(tray):
    (clouds, _, motions, parts), found = tray
    assert found.owns.all()
    for cloud, motion, part in zip(clouds, motions, parts, strict=True):
        assert (part_of(found, rest_of(cloud, motion)) == part).mean() > 0.96


def part_of(ownership, rest):
    """(n,) the parts of points that would be at `rest` (P, n, 3): whose surface is the nearest."""
    cells = np.clip(((rest + 0.5) * CELLS).astype(int), 0, CELLS - 1)
    far = np.stack([grid[tuple(at.T)] for grid, at in zip(ownership.far, cells, strict=True)])
    return np.where(ownership.owns[:, None], far, np.inf).argmin(0)


def test_surfaces_are_the_parts_that_they_move_with(tray):
    """The walls of the bay, too, though they lie .007 beside the tray, and where it will be."""
    part, (_, true) = parts_of_surface(*tray[0][:3]), examined(tray[0][3])
    known = part != NOBODYS
    assert known.mean() > 0.95
    assert (part == np.concatenate(true))[known].mean() > 0.99


def test_boxes_are_those_of_what_was_seen(tray):
    _, found = tray
    seen = np.array([[-0.3, -0.15, -0.15], [0.0, 0.15, 0.15]])  # what stays inside is never seen
    low, high = found.middle[1] - found.size[1], found.middle[1] + found.size[1]
    np.testing.assert_allclose(high, seen[1], atol=0.02)
    np.testing.assert_allclose(low[1:], seen[0, 1:], atol=0.02)
    assert -0.32 < low[0] < -0.24  # what shows in the last pose alone is little
    low, high = found.middle[0] - found.size[0], found.middle[0] + found.size[0]
    np.testing.assert_allclose([low, high], CASE, atol=0.02)


def test_a_part_that_never_shows_owns_nothing():
    clouds, normals, motions, _ = scene(np.random.default_rng(1), np.zeros(4))
    part = parts_of_surface(clouds, normals, motions)
    assert np.isin(part, [0, NOBODYS]).all()
    found = Ownership.of(clouds, part, motions)
    assert found.owns.tolist() == [True, False]
    assert (part_of(found, rest_of(clouds[0], motions[0])) == 0).all()


def test_points_where_their_part_hardly_is_are_nobodys():
    """Two beside each other, away from the others of their part: no box is drawn out to them."""
    rng = np.random.default_rng(5)
    plane = np.column_stack([rng.uniform(-0.2, 0.2, (400, 2)), np.zeros(400)])
    stray = np.array([[0.4, 0.4, 0.0], [0.41, 0.4, 0.0]])
    points = np.concatenate([np.tile(plane, (3, 1)), stray])
    pose = np.append(np.repeat([0, 1, 2], 400), [0, 1])
    rest, facing = np.stack([points + 0.05, points]), np.tile([0.0, 0.0, 1.0], (2, len(points), 1))
    doubt = np.outer([0.05, 0.0], np.ones(len(points)))  # nothing is sure
    part = _by_votes(doubt, np.zeros(len(points), int), rest, facing, pose, 0.05)
    assert (part[-2:] == NOBODYS).all()
    assert (part[:-2] == 1).mean() > 0.95


def test_what_is_far_from_all_surfaces_is_the_parts_in_whose_box_it_is(tray):
    _, found = tray
    assert found.far.shape == (2, CELLS, CELLS, CELLS)
    assert found.far.max() == pytest.approx(REACH)
    middle, away = found.middle[1][None], np.full((1, 3), 0.45)
    assert part_of(found, np.stack([away, middle])).tolist() == [1]
    assert part_of(found, np.stack([middle, away])).tolist() == [0]
    assert part_of(found, np.stack([away, away])).tolist() == [0]


def random_cells(rng, K, n):
    """Clouds of K poses with the normals of axes, and motions that shift one or turn it upright."""
    clouds = [rng.uniform(-0.45, 0.45, (n, 3)) for _ in range(K)]
    normals = [np.eye(3)[rng.integers(3, size=n)] * rng.choice([-1, 1], (n, 1)) for _ in range(K)]
    motions = np.tile(np.eye(4)[:3], (K, 1, 1))
    motions[:, :, 3] = rng.uniform(-0.1, 0.1, (K, 3))
    motions[1, :2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    return clouds, normals, motions


def test_contradicted_is_what_a_naive_look_says():
    rng = np.random.default_rng(2)
    clouds, normals, motions = random_cells(rng, 4, 3000)
    rest, facing = rng.uniform(-0.5, 0.5, (300, 3)), np.eye(3)[rng.integers(3, size=300)]
    cells = Cells.of([Surface.bare(*both) for both in zip(clouds, normals, strict=True)])
    at = cells.points, cells.normals, cells.starts
    found = owner_kernels.contradicted(*at, rest, facing, motions)
    wanted, ways = np.zeros(len(rest)), np.zeros(2)
    for M, cloud, normal in zip(motions, clouds, normals, strict=True):
        for i, (x, n) in enumerate(
            zip(rest @ M[:, :3].T + M[:, 3], facing @ M[:, :3].T, strict=True)
        ):
            off = cloud - x
            far = np.linalg.norm(off, axis=1)
            level = np.abs(off @ n) <= owner_kernels.LEVEL
            if (level & (far <= owner_kernels.BESIDE) & (normal @ n >= kernels.LIKE)).any():
                ways[0] += 1
                continue
            off = x - owner_kernels.BELOW * n - cloud
            m = np.linalg.norm(off, axis=1).argmin()
            if (
                np.linalg.norm(off[m]) <= owner_kernels.ABOUT
                and off[m] @ normal[m] > owner_kernels.BEFORE
            ):
                ways[1] += 1
                wanted[i] += 1
    np.testing.assert_array_equal(found, wanted / 4)
    assert ways.min() > 10


def test_pieces_are_what_lies_on_each_others_planes():
    """Planes with a step of .002 are one piece; not with one of .01, an edge, in other poses."""
    grid = np.stack(np.meshgrid(np.arange(10), np.arange(10)), -1).reshape(-1, 2) * 0.02
    flat = np.column_stack([grid, np.zeros(100)])
    steps = np.array([[0.2, 0.0, 0.002], [0.4, 0.0, 0.012]])
    beside = [flat, *(flat + step for step in steps), flat[:, [2, 1, 0]]]
    facing = np.repeat(np.eye(3)[[2, 2, 2, 0]], 100, axis=0)
    surface = Surface.bare(np.concatenate(beside) - 0.25, facing)
    order = np.argsort(cell_of(surface.points), kind="stable")
    true = np.repeat([0, 0, 1, 2], 100)[order]
    cells = Cells.of([surface, surface])
    piece = owner_kernels.pieces(cells.points, cells.normals, cells.starts, 0.025).reshape(2, -1)
    for one in piece:
        same = one[:, None] == one
        np.testing.assert_array_equal(same, true[:, None] == true)
    assert not set(piece[0]) & set(piece[1])


def test_ballots_are_what_a_naive_count_says():
    rng = np.random.default_rng(3)
    n, P = 1500, 2
    rest, facing, _ = random_cells(rng, P, n)
    pose, part = rng.integers(3, size=n), rng.integers(P, size=n)
    cells = Cells.of([Surface.bare(*both) for both in zip(rest, facing, strict=True)])
    order = np.concatenate([np.argsort(cell_of(points), kind="stable") for points in rest])
    at = cells.points, cells.normals, cells.starts
    found = owner_kernels.ballots(
        np.array(rest), np.array(facing), pose, *at, part[order], pose[order], 0.2
    )
    for i in range(0, n, 10):
        for p in range(P):
            off = rest[p] - rest[p][i]
            far = np.linalg.norm(off, axis=1)
            like = facing[p] @ facing[p][i] >= kernels.LIKE
            counts = like & (np.abs(off @ facing[p][i]) <= owner_kernels.LEVEL) & (far <= 0.2)
            counts &= (part == p) & (pose != pose[i])
            assert found[i, p] == pytest.approx((1.0 - far[counts] / 0.2).sum())
    assert (found > 0).mean() > 0.05


def test_far_from_is_the_distance_to_the_nearest_point():
    rng = np.random.default_rng(4)
    points = rng.uniform(-0.6, 0.5, (40, 3))
    centres = (np.stack(np.meshgrid(*3 * [np.arange(16)], indexing="ij"), -1) + 0.5) / 16 - 0.5
    wanted = np.linalg.norm(centres[..., None, :] - points, axis=-1).min(-1)
    np.testing.assert_allclose(
        owner_kernels.far_from(points, 16, 0.1), np.minimum(wanted, 0.1), atol=1e-6
    )
