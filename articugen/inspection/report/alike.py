"""Which objects of a data set are nearly the same, and which are unlike the others."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from articugen.core.arrays import Floats, Ints
from articugen.inspection.report.facts import ObjectFacts

LOOKED_AT = 30  # pairs whose coarse shapes are the nearest are compared in full
SAME = 1.25
"""Two objects are near-duplicates where their clouds are apart by less than so many times what two
halves of one cloud are."""

UNLIKE = 3.5  # modified z-scores above it make an outlier (Iglewicz and Hoaglin 1993)
FEWEST = 8  # objects, of which one can be unlike the others
_COARSE = 12
_TURN = 0.2


@dataclass(frozen=True)
class Pair:
    """Two objects: `apart`, a share of the unit frame, is the mean distance of the points of one to
    the planes at the other's, and `ratio` that over the same of two halves of one object."""

    first: ObjectFacts
    second: ObjectFacts
    apart: float
    ratio: float

    @property
    def same(self) -> bool:
        return self.ratio < SAME


@dataclass(frozen=True)
class Outlier:
    """An object whose `what` is `value`, where of most it is `typical`; written as in `unit`."""

    object: ObjectFacts
    what: str
    value: float
    typical: float
    score: float
    unit: str


def nearest_pairs(objects: Sequence[ObjectFacts], count: int) -> list[Pair]:
    """The `count` pairs whose canonical poses are the most alike, and all near-duplicates found."""
    objects = [each for each in objects if len(each.cloud) >= 4]
    coarse = []  # how many points are in each of `_COARSE`^3 cells
    for cloud in (each.cloud for each in objects):
        cell = np.clip((cloud + 0.5) * _COARSE, 0, _COARSE - 1).astype(np.int64)
        flat = cell @ (_COARSE * _COARSE, _COARSE, 1)
        coarse.append(np.bincount(flat, minlength=_COARSE**3) / len(cloud))
    pairs = list(combinations(range(len(objects)), 2))
    near = sorted(pairs, key=lambda ij: float(np.abs(coarse[ij[0]] - coarse[ij[1]]).sum()))
    found = [_pair(objects[i], objects[j]) for i, j in near[:LOOKED_AT]]
    found.sort(key=lambda pair: pair.ratio)
    return [pair for n, pair in enumerate(found) if n < count or pair.same]


def _pair(a: ObjectFacts, b: ObjectFacts) -> Pair:
    """Return each compared by halves, so that the halves of one object have as many points."""
    (a0, a1), (b0, b1) = (  # stored points are in random order
        [(each.cloud[first::2], each.normals[first::2]) for first in (0, 1)] for each in (a, b)
    )
    apart = 0.25 * sum(_apart(x, y) for x in (a0, a1) for y in (b0, b1))
    floor = 0.5 * (_apart(a0, a1) + _apart(b0, b1))
    return Pair(a, b, apart, apart / max(floor, 1e-9))


_Cloud = tuple[Floats, Floats]


def _apart(a: _Cloud, b: _Cloud) -> float:
    """Return the mean distance of the points of each to the plane at the other's nearest that faces
    alike; clouds of one surface are next to nothing apart, however few points they are."""
    one, other = (np.c_[points, _TURN * normals].astype(np.float32) for points, normals in (a, b))
    squared = (one**2).sum(1)[:, None] + (other**2).sum(1) - 2.0 * one @ other.T
    return 0.5 * (_to_planes(a, b, squared.argmin(1)) + _to_planes(b, a, squared.argmin(0)))


def _to_planes(a: _Cloud, b: _Cloud, nearest: Ints) -> float:
    offset = a[0] - b[0][nearest]
    return float(np.abs((offset * b[1][nearest]).sum(axis=1)).mean())


def outliers(objects: Sequence[ObjectFacts]) -> list[Outlier]:
    """Objects far from the median in one of some measures, the farthest first."""
    found: list[Outlier] = []
    if len(objects) < FEWEST:
        return found
    for what, unit, measure in _MEASURES:
        values = np.array([measure(each) for each in objects])
        known = np.isfinite(values)
        if known.sum() < FEWEST:
            continue
        typical = float(np.median(values[known]))
        spread = float(np.median(np.abs(values[known] - typical)))
        if spread <= 1e-6 * max(abs(typical), 1e-6):  # most are just the same: no scale to judge by
            continue
        scores = 0.6745 * np.abs(values - typical) / spread
        found += [
            Outlier(objects[i], what, float(values[i]), typical, float(scores[i]), unit)
            for i in np.flatnonzero(known & (scores > UNLIKE)).tolist()
        ]
    return sorted(found, key=lambda outlier: -outlier.score)


_MEASURES: tuple[tuple[str, str, Callable[[ObjectFacts], float]], ...] = (
    ("length of the unit frame", "", lambda each: each.scale),
    ("occupied fraction", " %", lambda each: 100.0 * float(each.occupied.mean())),
    ("enclosed fraction", " %", lambda each: 100.0 * each.enclosed),
    ("surface of part 0", " %", lambda each: 100.0 * each.parts[0].surface),
    ("moving joints", "", lambda each: float(len(each.joints))),
)
