"""Distances against a fine sampling, metrics by hand."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from articugen.core.geometry import points_on_triangles, rotation_about, transform
from articugen.evaluation import metrics
from articugen.meshes.distances import distance, nearest


def test_nothing_is_infinitely_far():
    assert np.isinf(distance(np.zeros((2, 3)), np.zeros((0, 3, 3)))).all()
    assert nearest(np.zeros((2, 3)), np.zeros((0, 3, 3)))[1].tolist() == [-1, -1]


@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 10**6), flat=st.booleans())
def test_distance_to_triangles(seed, flat):
    """Against the best of many points of each triangle, which can only be a little farther."""
    rng = np.random.default_rng(seed)
    triangles = rng.normal(size=(5, 3, 3))
    if flat:
        triangles[:, 2] = triangles[:, 1]  # a segment
        triangles[0] = triangles[0, 0]  # a point
    points = rng.normal(size=(4, 3)) * 2
    steps = np.array([(i, j) for i in range(41) for j in range(41 - i)]) / 40
    a, b, c = np.moveaxis(triangles, 1, 0)
    u, v = steps[:, :1, None], steps[:, 1:, None]
    tried = (a + u * (b - a) + v * (c - a)).reshape(-1, 3)
    brute = np.linalg.norm(points[:, None] - tried, axis=2).min(1)
    exact = distance(points, triangles)
    assert (exact <= brute + 1e-9).all()
    size = np.linalg.norm(triangles - triangles.mean(1, keepdims=True), axis=2).max()
    assert (exact >= brute - 2 * size / 40).all()


def test_samples_are_uniform_by_area():
    triangles = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[5, 0, 0], [8, 0, 0], [5, 3, 0]]])
    points = points_on_triangles(triangles.astype(float), 20_000, rng=np.random.default_rng(0))[0]
    assert np.mean(points[:, 0] > 4) == pytest.approx(0.9, abs=0.01)
    assert distance(points, triangles.astype(float)).max() < 1e-12
    small = points[points[:, 0] < 4]
    np.testing.assert_allclose(small.mean(0), [1 / 3, 1 / 3, 0], atol=0.02)


def test_the_nearest_part_is_by_surface_not_by_sample():
    """A point over the middle of a large triangle, beside the corner of a small one."""
    large = [[-10.0, -10, 0], [10, -10, 0], [0, 10, 0]]
    small = [[0.0, 0, 0.5], [0.1, 0, 0.5], [0, 0.1, 0.5]]
    near = metrics.nearest_part(
        np.array([[0.0, 0.0, 0.2]]), np.array([small, large]), np.array([2, 5]), 8
    )
    assert near.tolist() == [5]


def test_votes_count_parts_not_points():
    nearest = np.array([3, 3, 3, 3, 1, 3, 1, metrics.NO_LABEL])
    true = np.array([0, 0, 0, 0, 0, 1, 1, 1])
    table = metrics.votes(nearest, true, 4, 2)
    np.testing.assert_allclose(table[3], [4 / 5, 1 / 3])
    np.testing.assert_allclose(table[1], [1 / 5, 1 / 3])
    assert metrics.labels_from(table).tolist() == [-1, 1, -1, 0]


def test_one_dominant_part_a_label():
    table = np.array([[0.5, 0.1], [0.0, 0.4], [0.0, 0.3], [0.0, 0.0]])
    assert metrics.labels_from(table).tolist() == [0, 1, 1, -1]
    assert metrics.dominant_labels(table).tolist() == [0, 1, -1, -1]


@settings(deadline=None, max_examples=150)
@given(
    gain=st.integers(1, 4).flatmap(
        lambda rows: st.integers(1, 5).flatmap(
            lambda columns: st.lists(
                st.lists(st.integers(0, 6), min_size=columns, max_size=columns),
                min_size=rows, max_size=rows,
            )
        )
    )
)  # fmt: skip
def test_no_other_assignment_gains_more(gain):
    gain = np.array(gain, float)
    found = metrics.assigned(gain)
    kept = np.flatnonzero(found != metrics.NO_LABEL)
    assert len(set(found[kept].tolist())) == len(kept)
    assert (gain[kept, found[kept]] > 0).all()
    rows, columns = gain.shape
    padded = np.pad(gain, ((0, 0), (0, rows)))  # a row may have no column
    best = max(
        sum(padded[row, column] for row, column in enumerate(order))
        for order in itertools.permutations(range(columns + rows), rows)
    )
    assert gain[kept, found[kept]].sum() == best


def test_label_iou_by_hand():
    true, predicted = np.array([0, 0, 0, 1, 1]), np.array([0, 0, 1, 1, -1])
    assert metrics.label_iou(predicted, true) == pytest.approx((2 / 3 + 1 / 3) / 2)
    assert metrics.label_iou(true, true) == 1.0


def test_occupancy_iou_by_hand():
    a, b = np.array([True, True, False, False]), np.array([True, False, True, False])
    assert metrics.occupancy_iou(a, b) == pytest.approx(1 / 3)
    assert metrics.occupancy_iou(a, a) == metrics.occupancy_iou(a & ~a, a & ~a) == 1.0
    assert metrics.occupancy_iou(a, ~a) == 0.0


def test_a_line_through_states():
    true = np.linspace(0.0, 2.0, 50)
    line = metrics.line_through(true, 0.3 - 0.9 * true)
    assert line == pytest.approx((-0.9, 0.0), abs=1e-9)
    line = metrics.line_through(np.array([0.0, 1, 2, 3]), np.array([0.0, 1, 1, 0]))
    assert line == pytest.approx((0.0, 0.5))
    assert metrics.line_through(np.zeros(4), np.arange(4.0)) is None


def test_endpoint_error_by_hand():
    points = np.array([[1.0, 0, 0], [2.0, 0, 0], [0, 1.0, 0]])
    true = np.array([1, 1, 0])
    quarter = transform(rotation_about((0, 0, 1), math.pi / 2))
    still = np.tile(np.eye(4), (3, 1, 1))
    T_true = np.stack([np.eye(4), quarter])
    error = metrics.endpoint_error(points, true, T_true, still)
    assert error == pytest.approx((0 + 1.5 * math.sqrt(2)) / 2)
    assert metrics.endpoint_error(points, true, T_true, T_true[true]) == 0.0


def test_reconstruction_scores_by_hand():
    to_true, to_predicted = np.array([0.0, 0.1, 0.2]), np.array([0.0, 0.4])
    assert metrics.chamfer_l1(to_true, to_predicted) == pytest.approx(0.15)
    assert metrics.f_score(to_true, to_predicted, 0.15) == pytest.approx(
        2 * (2 / 3) * 0.5 / (7 / 6)
    )
    assert metrics.f_score(to_true + 1, to_predicted + 1, 0.1) == 0.0


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10**6), count=st.integers(1, 400))
def test_distance_to_many_triangles_is_that_to_the_nearest(seed, count):
    """The tree, against each triangle alone, and against plain distances between points."""
    rng = np.random.default_rng(seed)
    triangles = rng.normal(size=(count, 1, 3)) * [1.0, 0.3, 0.01] + 0.1 * rng.normal(
        size=(count, 3, 3)
    )
    triangles[::7] = triangles[:1]  # several in one place
    points = rng.normal(size=(9, 3))
    alone = np.min([distance(points, one[None]) for one in triangles[:60]], axis=0)
    np.testing.assert_array_equal(distance(points, triangles[:60]), alone)
    far, which = nearest(points, triangles)
    there = [distance(p[None], triangles[k][None])[0] for p, k in zip(points, which, strict=True)]
    np.testing.assert_array_equal(far, there)
    corners = np.repeat(triangles[:, :1], 3, axis=1)
    plain = np.linalg.norm(points[:, None] - triangles[:, 0], axis=2).min(1)
    np.testing.assert_allclose(distance(points, corners), plain, atol=1e-12)


@pytest.mark.parametrize("degrees", [0.0, 1e-3, 10.0, 90.0, 179.9, 180.0])
def test_rotations_differ_by_what_lies_between(degrees):
    R = rotation_about((0.36, 0.48, 0.8), 1.1)
    turned = R @ rotation_about((0.0, 0.6, 0.8), math.radians(degrees))
    assert math.degrees(metrics.angle_between_rotations(R, turned)) == pytest.approx(
        degrees, abs=1e-6
    )


def test_lines():
    x, y, z = np.eye(3)
    assert metrics.angle_between_lines(x, -x) == 0.0
    assert metrics.angle_between_lines(x, (x + y) / math.sqrt(2)) == pytest.approx(math.pi / 4)
    assert metrics.line_distance(0 * x, x, 2 * z, y) == pytest.approx(2.0)
    assert metrics.line_distance(0 * x, x, 3 * x + y, -x) == pytest.approx(1.0)
    assert metrics.point_to_line(5 * x + 3 * y + 4 * z, 2 * x, -x) == pytest.approx(5.0)
