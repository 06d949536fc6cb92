import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from articugen.core import geometry as g

lengths = st.floats(-10, 10)
angles = st.floats(-7, 7)
points = arrays(np.float64, (5, 3), elements=lengths)
directions = (
    arrays(np.float64, (3,), elements=st.floats(-1, 1))
    .filter(lambda v: np.linalg.norm(v) > 1e-3)
    .map(lambda v: v / np.linalg.norm(v))
)
rigid = st.builds(
    lambda axis, angle, t: g.transform(g.rotation_about(axis, angle), t),
    directions,
    angles,
    arrays(np.float64, (3,), elements=lengths),
)


@pytest.mark.parametrize(
    ("axis", "before", "after"),
    [
        ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
        ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
        ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    ],
)
def test_a_quarter_turn_follows_the_right_hand(axis, before, after) -> None:
    np.testing.assert_allclose(g.rotation_about(axis, np.pi / 2) @ before, after, atol=1e-15)


@given(directions, angles)
def test_rotation_about_is_a_rotation_that_keeps_its_axis(axis, angle) -> None:
    R = g.rotation_about(axis, angle)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-12)
    np.testing.assert_allclose(R @ axis, axis, atol=1e-12)
    np.testing.assert_allclose(np.trace(R), 1 + 2 * np.cos(angle), atol=1e-12)


def test_rpy_turns_about_the_fixed_axes_in_the_order_x_y_z() -> None:
    """Roll takes y to z, then pitch takes z to x, then yaw takes x to y."""
    quarter = np.pi / 2
    np.testing.assert_allclose(
        g.rotation_from_rpy((quarter, quarter, quarter)) @ (0, 1, 0), (0, 1, 0), atol=1e-15
    )
    np.testing.assert_allclose(
        g.rotation_from_rpy((quarter, quarter, 0)) @ (0, 1, 0), (1, 0, 0), atol=1e-15
    )


@given(rigid, points)
def test_inverting_undoes(T, x) -> None:
    np.testing.assert_allclose(g.apply(g.invert_rigid(T), g.apply(T, x)), x, atol=1e-11)
    np.testing.assert_allclose(g.invert_rigid(T), np.linalg.inv(T), atol=1e-11)


@given(st.lists(rigid, min_size=2, max_size=4))
def test_a_stack_is_inverted_like_each_of_its_members(Ts) -> None:
    np.testing.assert_array_equal(
        g.invert_rigid(np.stack(Ts)), np.stack([g.invert_rigid(T) for T in Ts])
    )


@given(rigid, rigid, points)
def test_transforms_compose_by_their_names(T_a_b, T_b_c, x_c) -> None:
    np.testing.assert_allclose(
        g.apply(T_a_b @ T_b_c, x_c), g.apply(T_a_b, g.apply(T_b_c, x_c)), atol=1e-10
    )


@given(points)
def test_the_box_holds_its_points_and_touches_them(x) -> None:
    low, high = g.bounds(x)
    assert np.all(low <= x)
    assert np.all(x <= high)
    np.testing.assert_array_equal(g.bounds(g.box_corners(np.stack([low, high]))), [low, high])


def test_box_corners_are_eight_different_points() -> None:
    corners = g.box_corners(np.array([[0.0, 0, 0], [1, 2, 3]]))
    assert {tuple(c) for c in corners} == {
        (x, y, z) for x in (0, 1) for y in (0, 2) for z in (0, 3)
    }


@pytest.mark.parametrize("count", [1, 2, 10, 100])
def test_fibonacci_directions_are_of_unit_length_and_all_different(count: int) -> None:
    d = g.fibonacci_sphere(count)
    assert d.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1.0, atol=1e-15)
    assert len(np.unique(d.round(9), axis=0)) == count


def test_a_hundred_fibonacci_directions_leave_no_hole_wider_than_sixteen_degrees() -> None:
    """A hundred equal caps that cover the sphere would be 11.5 degrees wide (1 - cos = 2/100)."""
    probe = np.random.default_rng(0).normal(size=(20_000, 3))
    probe /= np.linalg.norm(probe, axis=1, keepdims=True)
    d = g.fibonacci_sphere(100)
    nearest = np.degrees(np.arccos(np.clip((probe @ d.T).max(axis=1), -1, 1)))
    assert nearest.max() < 16.0
    assert np.linalg.norm(d.mean(axis=0)) < 0.01


@given(directions, arrays(np.float64, (3,), elements=lengths), st.floats(0.1, 5))
def test_what_the_camera_looks_at_lies_on_its_optical_axis(direction, eye, distance) -> None:
    T_camera_world = g.look_along(direction, eye)
    seen = g.apply(T_camera_world, eye + distance * direction)
    np.testing.assert_allclose(seen, (0, 0, distance), atol=1e-11)
    np.testing.assert_allclose(np.linalg.det(T_camera_world[:3, :3]), 1.0, atol=1e-12)


def test_image_up_is_the_worlds_z_and_image_right_is_the_viewers_right() -> None:
    R = g.look_along((1, 0, 0))[:3, :3]
    np.testing.assert_allclose(R @ (0, 0, 1), (0, -1, 0), atol=1e-15)
    np.testing.assert_allclose(R @ (0, -1, 0), (1, 0, 0), atol=1e-15)


@pytest.mark.parametrize("straight", [(0, 0, 1), (0, 0, -1)])
def test_a_camera_may_look_straight_up_or_down(straight) -> None:
    R = g.look_along(straight)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(R @ (0, 1, 0), (0, -1, 0), atol=1e-15)


def test_voxel_centres_have_x_slowest() -> None:
    centres = g.voxel_centres(4)
    for n, index in enumerate(np.ndindex(4, 4, 4)):
        np.testing.assert_array_equal(centres[n], (np.array(index) + 0.5) / 4 - 0.5)
    some = np.array([[63, 0], [17, 5]])
    np.testing.assert_array_equal(g.voxel_centres(4, some), centres[some])


def test_points_are_on_their_triangles_and_uniform_by_area() -> None:
    corners = np.array([
        [[0, 0, 1], [3, 0, 1], [0, 2, 1]],
        [[0, 0, 0], [0, 0, 0], [0, 0, 0]],
        [[0, 0, 2], [0, 2, 2], [1, 0, 2]],
    ], float)  # fmt: skip
    points, face = g.points_on_triangles(corners, 40_000, rng=np.random.default_rng(0))
    count = np.bincount(face, minlength=3)
    assert count[1] == 0
    assert count[0] / 40_000 == pytest.approx(3 / 4, abs=0.01)  # sigma is 0.002
    np.testing.assert_array_equal(points[:, 2], corners[face, 0, 2])
    x, y = points[face == 0, :2].T
    assert min(x.min(), y.min(), (1 - x / 3 - y / 2).min()) >= 0.0
    for share in (0.25, 0.5, 0.75):  # a corner cut off parallel to the other side
        assert np.mean(x < 3 * (1 - np.sqrt(1 - share))) == pytest.approx(share, abs=0.015)
        assert np.mean(x / 3 + y / 2 < np.sqrt(share)) == pytest.approx(share, abs=0.015)


def test_weights_choose_the_triangles() -> None:
    corners = np.repeat(np.arange(3.0)[:, None, None], 3, 1) * np.ones(3)
    rng = np.random.default_rng(0)
    points, face = g.points_on_triangles(corners, 1000, rng=rng, weights=[1, 0, 3])
    assert set(face) == {0, 2}
    assert np.mean(face == 2) == pytest.approx(3 / 4, abs=0.06)
    np.testing.assert_allclose(points, np.repeat(face[:, None], 3, 1), atol=1e-15)
    _, face = g.points_on_triangles(corners, 1000, rng=rng)
    assert set(face) == {0, 1, 2}, "points count the same"


@given(st.integers(0, 10**6))
def test_motions_are_apart_as_the_authors_have_it(seed):
    """Their kinetic-energy norm, of the centre and inertia that points of equal mass have; and
    whichever end is called lower, whichever way the axis points."""
    arena = pytest.importorskip("articulatearena")
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(30, 3))
    center, off = points.mean(axis=0), points - points.mean(axis=0)
    inertia = (off * off).sum() * np.eye(3) - off.T @ off
    norm = arena.make_kinetic_energy_norm(arena.LinkInertia(mass=30.0, com=center, inertia=inertia))
    ends = []
    for kind in rng.choice(["revolute", "prismatic"], 2):
        axis, pivot, limits = rng.normal(size=3), rng.normal(size=3), rng.normal(size=2)
        axis /= np.linalg.norm(axis)
        ours = g.twist_ends(axis, pivot if kind == "revolute" else None, limits)
        twist = arena.screw_twist(axis, pivot, str(kind))
        theirs = arena.make_endpoint_pair(twist, *limits)
        turned = g.twist_ends(-axis, pivot if kind == "revolute" else None, -limits[::-1])
        assert g.motions_apart(ours, turned, points) == pytest.approx(0.0, abs=1e-7)
        ends.append((ours, theirs))
    (one, first), (other, second) = ends
    expected = arena.joint_metric(first.u.data, first.v.data, second.u.data, second.v.data, norm)
    assert g.motions_apart(one, other, points) == pytest.approx(expected)


def test_a_motion_by_a_hinge_and_one_that_is_missing():
    """A point 2 from the axis, that swings by 0.1 and does not: 0.2 apart at one end."""
    swing = g.twist_ends(np.array([0.0, 0.0, 1.0]), np.zeros(3), [0.0, 0.1])
    at = np.array([[2.0, 0.0, 5.0]])
    assert g.motions_apart(swing, np.zeros((2, 6)), at) == pytest.approx(0.2)
