"""Portable arithmetic: close to the usual libraries, and the same bits as sums written out."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from articugen.core import portable

LAST_PLACE = 2.3e-16

numbers = st.floats(-10.0, 10.0, allow_subnormal=False)
matrices = arrays(np.float64, (3, 4, 4), elements=numbers)
angles = arrays(np.float64, 20, elements=st.floats(-1000.0, 1000.0))
lengths = arrays(np.float64, 20, elements=st.floats(0.0, 1e3, allow_subnormal=False))


@given(
    arrays(np.float64, (3, 4, 4), elements=numbers), arrays(np.float64, (4, 3), elements=numbers)
)
def test_a_product_is_the_sum_of_its_terms_from_the_first_to_the_last(A, B):
    expected = np.zeros((3, 4, 3))
    for n in range(3):
        for i in range(4):
            for j in range(3):
                total = A[n, i, 0] * B[0, j]
                for k in range(1, 4):
                    total = total + A[n, i, k] * B[k, j]
                expected[n, i, j] = total
    assert np.array_equal(portable.product(A, B), expected)
    assert np.array_equal(portable.turned(A, B[:, 0]), expected[..., 0])


@given(arrays(np.float64, (5, 3), elements=numbers))
def test_lengths_and_inner_products_are_those_of_numpy(v):
    assert np.allclose(portable.norm(v), np.linalg.norm(v, axis=1), rtol=1e-15, atol=0)
    assert portable.norm(v[0]) == math.sqrt(v[0, 0] ** 2 + v[0, 1] ** 2 + v[0, 2] ** 2)
    assert np.allclose(portable.dot(v, v[::-1]), np.sum(v * v[::-1], axis=1), atol=1e-13)


@given(angles)
def test_sine_and_cosine_are_exact_to_the_last_place(x):
    sine, cosine = portable.sin_cos(x)
    assert np.abs(sine - [math.sin(a) for a in x]).max() <= LAST_PLACE
    assert np.abs(cosine - [math.cos(a) for a in x]).max() <= LAST_PLACE


def test_sine_and_cosine_at_their_zeros_and_turns():
    assert portable.sin_cos(0.0) == (0.0, 1.0)
    sine, cosine = portable.sin_cos(np.pi * np.arange(-4, 5) / 2)
    assert np.allclose(sine, [0, 1, 0, -1, 0, 1, 0, -1, 0], atol=LAST_PLACE * 4)
    assert np.allclose(cosine, [1, 0, -1, 0, 1, 0, -1, 0, 1], atol=LAST_PLACE * 4)


@pytest.mark.parametrize("angle", [np.inf, np.nan, 1e300])
def test_angles_that_are_none_are_refused(angle):
    with pytest.raises(ValueError, match="finite"):
        portable.sin_cos(angle)


@given(arrays(np.float64, (20, 2), elements=numbers))
def test_arctan2_is_exact_to_the_last_places(points):
    points = points + 0.0  # the sign of zero is not kept
    exact = [math.atan2(y, x) for x, y in points]
    assert np.abs(portable.arctan2(points[:, 1], points[:, 0]) - exact).max() <= 3 * LAST_PLACE


@given(lengths, st.floats(0.05, 8.0))
def test_powers_are_exact_to_some_last_places(base, exponent):
    exact = np.array([math.pow(b, exponent) for b in base])
    error = np.abs(portable.power(base, exponent) - exact)
    spread = 1.0 + exponent * np.abs(np.log(np.maximum(base, 1e-300)))
    assert (error <= exact * spread * 4 * LAST_PLACE + 1e-300).all()
