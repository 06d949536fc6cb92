"""Which instances show one object, found in their clouds without labels, names or joints.

All poses of an object share the surface of its fixed part exactly, as an object has one frame, and
no other object has that surface. So a cloud becomes a set of tokens: which cell of a coarse grid a
point lies in, which way the surface faces there, and how far across the cell it lies, in steps of a
thousandth. Offsets must be fine and cells large to distinguish objects. Instances are alike as they
have tokens in common, over the geometric mean of how many they have (Ochiai 1957), and are joined
by average linkage (the nearest-neighbour chain: Murtagh 1983).
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Floats, Ints
from articugen.core.errors import InvalidArgument
from articugen.core.jit import helper, kernel

CELLS = 8  # of the coarse grid along each axis; a second grid is shifted by half a cell
STEP = 0.001  # of the offset across a cell, in the unit frame
CUT = 0.25  # mean likeness of what is one object: bundled ones have .32 or more, two at most .24

MOST = 10_000  # instances that are compared each with each, in 400 MB; others join their groups

_OFFSETS = 256  # the half diagonal of a cell is 108 steps
_TOKENS = 2 * (CELLS + 1) ** 3 * 27 * _OFFSETS


class Groups(NamedTuple):
    """Instances by the object that they show.

    Attributes:
        number: (N,) of each instance's group; groups are counted as they first appear.
        within: the least mean likeness of an instance to the others of its group; 1 if none has
            others.
        between: the greatest of an instance to another group; 0 if there is but one.
    """

    number: Ints
    within: float
    between: float


def group_instances(clouds: Iterable[tuple[Floats, Floats]]) -> Groups:
    """Group instances by the object that they show.

    Args:
        clouds: of each instance points (n, 3) in the unit frame, one frame for all poses of an
            object, and their normals (n, 3) out of the material; one cloud is in memory at a time.

    Raises:
        InvalidArgument: a cloud has not one normal a point.
    """
    tokens = [_tokens_of(points, normals) for points, normals in clouds]
    start = np.cumsum([0, *map(len, tokens)])
    token = np.concatenate([*tokens, np.empty(0, np.int32)])
    place = np.cumsum(np.bincount(token + 1, minlength=_TOKENS + 1))
    return _groups(_Index(token, start, _instances(token, start, place), place))


def agreement(number: Ints, truth: Ints) -> tuple[float, float, float]:
    """Return how groups agree with true ones, over pairs of instances.

    Args:
        number, truth: (N,) of each instance's group and true group.

    Returns:
        The adjusted Rand index (Hubert and Arabie 1985), 1 where they are the same and about 0 by
        chance; precision, the share of pairs grouped that are of one object; and recall, the share
        of pairs of one object that are grouped.
    """
    common = np.zeros((number.max(initial=-1) + 1, truth.max(initial=-1) + 1), np.int64)
    np.add.at(common, (number, truth), 1)
    both, grouped, true = map(_pairs, (common, common.sum(1), common.sum(0)))
    chance = grouped * true / max(_pairs(np.array(len(number))), 1)
    most = (grouped + true) / 2
    rand = 1.0 if most == chance else (both - chance) / (most - chance)
    return rand, both / max(grouped, 1), both / max(true, 1)


def _pairs(count: Ints) -> int:
    return int((count * (count - 1) // 2).sum())


class _Index(NamedTuple):
    """The tokens of N instances, and the instances of each token.

    Attributes:
        token: (T,) the instances' tokens one after the other; instance i has those from
            start[i] to start[i + 1] of `start` (N + 1,).
        instance: (T,) likewise the instances of each token, at `place` (tokens + 1,).
    """

    token: NDArray[np.int32]
    start: Ints
    instance: NDArray[np.int32]
    place: Ints


def _tokens_of(points: Floats, normals: Floats) -> NDArray[np.int32]:
    if points.shape != normals.shape:
        raise InvalidArgument("instances are grouped by points with normals; these have none")
    token = np.sort(_tokens(points, normals))
    return token[np.flatnonzero(np.diff(token, prepend=-1))]


def _groups(index: _Index) -> Groups:
    count = len(index.start) - 1
    rows = np.unique(np.linspace(0, max(count - 1, 0), min(count, MOST)).astype(np.int64))
    alike = np.empty((len(rows), len(rows)), np.float32)
    _compare(index, rows, alike)
    number = np.full(count, -1)
    number[rows] = np.unique(_linked(alike), return_inverse=True)[1]
    number, within, between = _nearest(index, number, int(number.max(initial=-1)) + 1)
    names, first, number = np.unique(number, return_index=True, return_inverse=True)
    order = np.empty(len(names), np.int64)
    order[np.argsort(first)] = np.arange(len(names))
    return Groups(order[number], within, between)


@kernel
def _tokens(points, normals):  # pragma: no cover - compiled
    """Return (2 n,) one token a point in each of the two grids."""
    token = np.empty(2 * len(points), np.int32)
    for k in range(len(points)):
        x, y, z = normals[k, 0], normals[k, 1], normals[k, 2]
        length = max(np.sqrt(x * x + y * y + z * z), 1e-12)
        x, y, z = x / length, y / length, z / length
        most = max(abs(x), abs(y), abs(z), 1e-12)  # 26 directions: to a cube's neighbours
        facing = (_third(x / most) * 3 + _third(y / most)) * 3 + _third(z / most)
        for grid in range(2):
            cell, across = 0, 0.0
            for axis, along in ((0, x), (1, y), (2, z)):
                at = (points[k, axis] + 0.5) * CELLS + 0.5 * grid
                i = min(max(int(np.floor(at)), 0), CELLS)
                cell = cell * (CELLS + 1) + i
                across += (at - i - 0.5) / CELLS * along
            step = int(np.floor(across / STEP)) + _OFFSETS // 2
            step = min(max(step, 0), _OFFSETS - 1)
            token[2 * k + grid] = ((grid * (CELLS + 1) ** 3 + cell) * 27 + facing) * _OFFSETS + step
    return token


@helper
def _third(along):  # pragma: no cover - compiled
    """Return 0, 1 or 2: backwards, across or along an axis."""
    return 1 + int(np.rint(along))


@kernel
def _instances(token, start, place):  # pragma: no cover - compiled
    """Return `instance` of an `_Index`."""
    free, instance = place[:-1].copy(), np.empty(len(token), np.int32)
    for i in range(len(start) - 1):
        for k in range(start[i], start[i + 1]):
            instance[free[token[k]]] = i
            free[token[k]] += 1
    return instance


@helper
def _row(index, i, alike):  # pragma: no cover - compiled
    """Write how alike instance i is to all (N,)."""
    alike[:] = 0.0
    start = index.start
    for k in range(start[i], start[i + 1]):
        t = index.token[k]
        for p in range(index.place[t], index.place[t + 1]):
            alike[index.instance[p]] += 1.0
    for j in range(len(alike)):
        if alike[j] > 0.0:
            alike[j] /= np.sqrt(float(start[i + 1] - start[i]) * (start[j + 1] - start[j]))


@kernel
def _compare(index, rows, alike):  # pragma: no cover - compiled
    """Write how alike the instances `rows` (M,) are (M, M)."""
    row = np.empty(len(index.start) - 1, np.float32)
    for k in range(len(rows)):
        _row(index, rows[k], row)
        for m in range(len(rows)):
            alike[k, m] = row[rows[m]]


@kernel
def _linked(alike):  # pragma: no cover - compiled
    """Return (N,) a number for each group that average linkage makes down to `CUT`; `alike` (N, N)
    is overwritten. A group whose nearest is farther than that is done: means do not grow."""
    count = len(alike)
    group, size, is_open = np.arange(count), np.ones(count), np.ones(count, np.bool_)
    chain, length = np.empty(count + 1, np.int64), 0
    for begin in range(count):
        while is_open[begin]:
            if length == 0:
                chain[0], length = begin, 1
            a = chain[length - 1]
            before = chain[length - 2] if length > 1 else -1
            b, most = before, alike[a, before] if before >= 0 else np.float32(-1.0)
            for j in range(count):
                if is_open[j] and j != a and alike[a, j] > most:
                    b, most = j, alike[a, j]
            if most < CUT:
                is_open[a] = False
                length = 0
            elif b != before:
                chain[length] = b
                length += 1
            else:
                whole = size[a] + size[b]
                for j in range(count):
                    alike[a, j] = (size[a] * alike[a, j] + size[b] * alike[b, j]) / whole
                    alike[j, a] = alike[a, j]
                size[a], is_open[b] = whole, False
                for j in range(count):
                    if group[j] == b:
                        group[j] = a
                length -= 2
    return group


@kernel
def _nearest(index, number, groups):  # pragma: no cover - compiled
    """Return (N,) the group whose others each instance is most like, and the least and the greatest
    mean of `Groups`. What was joined in haste moves; what was not compared, -1, joins the group
    that it belongs to, or is one of its own."""
    count = len(number)
    size = np.zeros(groups)
    for i in range(count):
        if number[i] >= 0:
            size[number[i]] += 1
    better, alike = np.empty(count, np.int64), np.empty(count, np.float32)
    within, between = 1.0, 0.0
    for i in range(count):
        _row(index, i, alike)
        alike[i] = 0.0
        mean = np.zeros(groups)
        for j in range(count):
            if number[j] >= 0:
                mean[number[j]] += alike[j]
        for g in range(groups):
            mean[g] /= max(size[g] - (g == number[i]), 1)
        best, others = mean.argmax(), number[i]
        if mean[best] > max(mean[others] if others >= 0 else 0.0, CUT):
            others = best
        better[i] = others if others >= 0 else groups + i
        for g in range(groups):
            if g != others:
                between = max(between, mean[g])
        if others >= 0 and mean[others] > 0.0:
            within = min(within, mean[others])
    return better, within, between
