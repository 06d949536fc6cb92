"""Arithmetic that gives the same bits on every processor.

BLAS, numpy's transcendental functions and the C library choose their code by the processor that
they find, and what they return differs in the last bit from one to the next. All that decides the
numbers of a data set goes through these functions instead: sums in a stated order of the operations
that IEEE 754 defines to the bit (+ - * / and the square root), elementwise, so that nothing can be
reordered or fused.
"""

from collections.abc import Sequence
from functools import reduce
from math import factorial
from operator import add
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from articugen.core.arrays import Floats

# pi / 2 and ln 2 in pieces; all but the last have 33 bits, so that their small multiples are exact.
_HALF_PI = (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21)
_LN2 = (0.6931471806019545, -4.2009150726810846e-11)

_SINE = [(-1) ** k / factorial(2 * k + 1) for k in range(9)]
_COSINE = [(-1) ** k / factorial(2 * k) for k in range(10)]

_TURNS = 2.0**20
"""Quarter turns that `sin_cos` takes; more would lose digits that callers think they have."""


def product(*matrices: ArrayLike) -> Floats:
    """Return the matrix product of (..., a, b), (..., b, c), ... from the left to the right."""

    def times(A: Floats, B: Floats) -> Floats:
        total = A[..., :, 0, None] * B[..., 0, None, :]
        for k in range(1, A.shape[-1]):
            total = total + A[..., :, k, None] * B[..., k, None, :]
        return total

    return reduce(times, (np.asarray(matrix, np.float64) for matrix in matrices))


def total(numbers: Sequence[float]) -> float:
    """Return the sum, one number after the other: `sum` rounds otherwise from Python 3.12 on."""
    return reduce(add, numbers)


def turned(matrix: ArrayLike, vectors: ArrayLike) -> Floats:
    """`matrix` (..., a, b) times each of `vectors` (..., b): (..., a)."""
    return product(matrix, np.asarray(vectors, np.float64)[..., None])[..., 0]


def dot(a: ArrayLike, b: ArrayLike) -> Any:
    """Return the inner products of (..., n) and (..., n): (...), a float for two vectors."""
    terms = np.asarray(a, np.float64) * np.asarray(b, np.float64)
    total = terms[..., 0]
    for k in range(1, terms.shape[-1]):
        total = total + terms[..., k]
    return total


def norm(vectors: ArrayLike) -> Any:
    """Return the Euclidean lengths of (..., n): (...), a float for one vector."""
    return np.sqrt(dot(vectors, vectors))


def sin_cos(angle: ArrayLike) -> tuple[Any, Any]:
    """Sine and cosine of `angle` (...), radians, to one unit in the last place or so.

    Taylor's series about the nearest multiple of pi / 2 (Cody and Waite's reduction).

    Raises:
        ValueError: more than a million quarter turns, or not finite.
    """
    angle = np.asarray(angle, np.float64)
    if not np.all(np.abs(angle) < _TURNS):
        raise ValueError(f"angles are finite and below {_TURNS:g} radians")
    quarters = np.rint(angle * (2.0 / np.pi))
    x = angle
    for piece in _HALF_PI:
        x = x - quarters * piece
    square = x * x
    sine, cosine = x * _series(square, _SINE), _series(square, _COSINE)
    turn = quarters.astype(np.int64) & 3
    swapped = turn & 1 == 1
    sine, cosine = np.where(swapped, cosine, sine), np.where(swapped, sine, cosine)
    return (
        np.where(turn >= 2, -sine, sine)[()],
        np.where((turn == 1) | (turn == 2), -cosine, cosine)[()],
    )


def sin(angle: ArrayLike) -> Any:
    """See `sin_cos`."""
    return sin_cos(angle)[0]


def cos(angle: ArrayLike) -> Any:
    """See `sin_cos`."""
    return sin_cos(angle)[1]


def arctan2(y: ArrayLike, x: ArrayLike) -> Any:
    """Return the angle (...) of the points (x, y), in (-pi, pi]; 0 for the origin."""
    y, x = np.broadcast_arrays(np.asarray(y, np.float64), np.asarray(x, np.float64))
    low, high = np.minimum(np.abs(x), np.abs(y)), np.maximum(np.abs(x), np.abs(y))
    slope = low / np.where(high > 0.0, high, 1.0)
    far = slope > 2.0 - np.sqrt(3.0)  # beyond 15 degrees, take the angle from 30 degrees on
    root = np.sqrt(3.0)
    rest = np.where(far, (slope * root - 1.0) / (root + slope), slope)
    angle = rest * _series(rest * rest, [(-1) ** k / (2 * k + 1) for k in range(14)])
    angle = np.where(far, angle + np.pi / 6.0, angle)
    angle = np.where(np.abs(y) > np.abs(x), np.pi / 2.0 - angle, angle)
    angle = np.where(x < 0.0, np.pi - angle, angle)
    return np.where(y < 0.0, -angle, angle)[()]


def power(base: ArrayLike, exponent: ArrayLike) -> Any:
    """`base` (...) >= 0 to the power `exponent` > 0, to some last places: exp(e ln b)."""
    base = np.asarray(base, np.float64)
    mantissa, whole = np.frexp(np.where(base > 0.0, base, 1.0))
    small = mantissa < np.sqrt(0.5)
    mantissa, whole = np.where(small, 2.0 * mantissa, mantissa), whole - small
    s = (mantissa - 1.0) / (mantissa + 1.0)  # ln m = 2 artanh s
    fine = 2.0 * s * _series(s * s, [1.0 / (2 * k + 1) for k in range(12)])
    log = whole * _LN2[0] + (whole * _LN2[1] + fine)
    wanted = log * np.asarray(exponent, np.float64)
    steps = np.rint(wanted * (1.0 / (_LN2[0] + _LN2[1])))
    rest = (wanted - steps * _LN2[0]) - steps * _LN2[1]
    result = np.ldexp(
        _series(rest, [1.0 / factorial(k) for k in range(15)]), steps.astype(np.int64)
    )
    return np.where(base > 0.0, result, 0.0)[()]


def _series(x: Floats, coefficients: list[float]) -> Floats:
    """Return the polynomial in `x` with these coefficients, the constant one first (Horner's
    rule)."""
    total = np.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = total * x + coefficient
    return total
