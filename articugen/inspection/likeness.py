"""How alike two sets of objects are: neighbours in and between them, proportions, parts, joints.

Distances are Chamfer distances of 1,200 points of the surface in the canonical pose, each object in
the middle of its box, whose longest edge is 1.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.colours import colour_of
from articugen.core.errors import InvalidArgument
from articugen.core.geometry import bounds
from articugen.core.jit import helper, kernel
from articugen.core.records import JointKind, dequantize
from articugen.core.schema import Instance
from articugen.core.seeding import generator
from articugen.pictures.contact_sheet import Chosen, chosen_of, portraits
from articugen.pictures.layout import Row, sheet
from articugen.pictures.shading import Picture
from articugen.store.shards import open_shard
from articugen.store.shelf import shards_of

POINTS = 1200
MOST = 300  # objects of a set that are compared, chosen evenly

MEASURES = (
    "depth (x)", "width (y)", "height (z)", "moving parts", "a part's longest edge",
    "a part's surface", "height of a joint", "range, degrees", "range, of the object",
)  # fmt: skip
"""What is known of an object or of its moving parts; lengths in parts of its longest edge."""


@dataclass(frozen=True, eq=False)
class Objects:
    """One set.

    Attributes:
        chosen: its objects, in the order of all that follows.
        points: (n, 1200, 3) of each.
        floor: the mean distance of other points of an object from these: nothing is nearer.
        pairs, nearest: mean distances between two objects, and of the nearest other one from each.
        measures: (m,) every value of a measure, by its name in `MEASURES`.
    """

    chosen: list[Chosen]
    points: Floats
    floor: float
    pairs: float
    nearest: float
    measures: dict[str, Floats]


@dataclass(frozen=True, eq=False)
class Likeness:
    """Outcome of `likeness` for sets of n and m objects.

    Attributes:
        first, second: the two sets.
        between: (m, n) distances of each object of the second set from each of the first.
    """

    first: Objects
    second: Objects
    between: Floats

    @property
    def reached(self) -> float:
        """Mean distance of objects of the second set from their nearest in the first."""
        return float(self.between.min(axis=1).mean())

    @property
    def numbers(self) -> dict[str, float]:
        """Return all numbers; quantiles 0.1, 0.5 and 0.9 of each measure that any object has."""
        a, b = self.first, self.second
        numbers = {
            "first: objects": len(a.chosen), "second: objects": len(b.chosen),
            "first: pairs": a.pairs, "second: pairs": b.pairs,
            "first: same object": a.floor, "second: same object": b.floor,
            "first: own nearest": a.nearest, "second: own nearest": b.nearest,
            "second to nearest first": self.reached,
        }  # fmt: skip
        for name, some in (("first", a), ("second", b)):
            for measure, values in some.measures.items():
                for q in (0.1, 0.5, 0.9) if len(values) else ():
                    numbers[f"{name}: {measure}, quantile {q}"] = float(np.quantile(values, q))
        return {key: round(float(value), 6) for key, value in numbers.items()}


def likeness(first: Path, second: Path) -> Likeness:
    """Compare two sets: folders of shards, or shards.

    Of each set 300 objects at most are compared, chosen evenly.

    Raises:
        InvalidArgument: a path holds no shard, or fewer than two objects.
        CorruptShard: a shard cannot be read.
    """
    a, b = _objects(first), _objects(second)
    return Likeness(a, b, _distances(b.points, a.points))


def farthest(alike: Likeness, *, count: int = 6) -> Picture:
    """Draw the objects of the second set that are farthest from the first, their nearest below."""
    distance, nearest = alike.between.min(axis=1), alike.between.argmin(axis=1)
    far = np.argsort(-distance, kind="stable")[:count]
    rows = []
    for title, some, picked, colour in (
        ("second set: farthest from the first", alike.second, far, 1),
        ("first set: nearest to the one above", alike.first, nearest[far], 2),
    ):
        drawn = portraits([some.chosen[k] for k in picked], states=1)
        captions = [
            [(f"{d.chosen.object_id}  {distance[k]:.3f}", colour_of(colour))]
            for d, k in zip(drawn, far, strict=True)
        ]
        rows.append(Row(title, [d.pictures[0] for d in drawn], captions))
    return sheet(rows)


def _objects(path: Path) -> Objects:
    chosen = chosen_of(shards_of(path), MOST)
    if len(chosen) < 2:
        raise InvalidArgument(f"{path}: holds one object; a set has two or more to compare")
    points: list[Floats] = []
    floors: list[float] = []
    measures: dict[str, list[float]] = {name: [] for name in MEASURES}
    for one in chosen:
        path, index = one.places[0]  # the canonical pose, where a set has that
        with open_shard(path) as shard:
            instance = shard.instance(index)
        cloud = dequantize(instance.surface_points)
        low, high = bounds(cloud)
        longest = float((high - low).max())
        cloud = (cloud - (low + high) / 2) / longest
        _measure(instance, cloud, (low + high) / 2, longest, measures)
        rng = generator(0, one.object_id, "likeness")
        some, others = np.resize(rng.permutation(cloud, axis=0), (2, POINTS, 3)).astype(np.float64)
        points.append(some)
        floors.append(float(_distances(some[None], others[None])[0, 0]))
    clouds = np.array(points)
    square = _distances(clouds, clouds)
    np.fill_diagonal(square, np.inf)
    return Objects(
        chosen,
        clouds,
        floor=float(np.mean(floors)),
        pairs=float(square[np.isfinite(square)].mean()),
        nearest=float(square.min(axis=1).mean()),
        measures={k: np.array(v) for k, v in measures.items()},
    )


def _measure(
    instance: Instance, cloud: Floats, middle: Floats, longest: float, to: dict[str, list[float]]
) -> None:
    """Note what is measured of an object; `cloud`, `middle` and `longest` are of its box."""
    for name, extent in zip(MEASURES[:3], np.ptp(cloud, axis=0), strict=True):
        to[name].append(extent)
    to["moving parts"].append(len(instance.joint_kind))
    for j, kind in enumerate(instance.joint_kind):
        part = cloud[instance.surface_part == j + 1]
        to["a part's surface"].append(len(part) / len(cloud))
        if len(part):
            to["a part's longest edge"].append(np.ptp(part, axis=0).max())
        reach = float(instance.joint_upper[j] - instance.joint_lower[j])
        if kind == JointKind.REVOLUTE:
            to["range, degrees"].append(np.degrees(reach))
            axis, pivot = instance.joint_axis[j], instance.joint_pivot[j]
            height = float((pivot + axis * (axis @ (middle - pivot)) - middle)[2]) / longest
            to["height of a joint"].append(height - float(cloud[:, 2].min()))
        else:
            to["range, of the object"].append(reach / longest)


def _distances(first: Floats, second: Floats) -> Floats:
    """Return the Chamfer distances (n, m) of clouds (n, k, 3) from clouds (m, k, 3)."""
    by_axis = np.ascontiguousarray(second.transpose(0, 2, 1), np.float32)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        clouds = np.ascontiguousarray(first.transpose(0, 2, 1), np.float32)
        return np.array(list(pool.map(lambda cloud: chamfer(cloud, by_axis), clouds)))


@kernel
def chamfer(cloud, others):  # pragma: no cover - compiled
    """Return (m,): half the mean distance of points from the nearest of the other cloud, and back.

    Every pair of points is examined, eight at a time: clouds are (3, k), others (m, 3, k). A tree
    takes longer for so few.
    """
    distances = np.zeros(len(others))
    for m in range(len(others)):
        distances[m] = (_one_way(cloud, others[m]) + _one_way(others[m], cloud)) / 2
    return distances


@helper
def _one_way(cloud, other):  # pragma: no cover - compiled
    """Return the mean distance of the points of `other` from their nearest in `cloud`."""
    count = other.shape[1]
    least = np.full(count, np.float32(np.inf))
    for i in range(cloud.shape[1]):
        x, y, z = cloud[0, i], cloud[1, i], cloud[2, i]
        for j in range(count):
            dx, dy, dz = other[0, j] - x, other[1, j] - y, other[2, j] - z
            least[j] = min(least[j], dx * dx + dy * dy + dz * dz)
    total = 0.0
    for j in range(count):
        total += np.sqrt(least[j])
    return total / count


def rows(alike: Likeness) -> Sequence[tuple[str, str, str]]:
    """Name, first set, second set: the lines of a table."""
    a, b = alike.first, alike.second
    return [
        ("objects", str(len(a.chosen)), str(len(b.chosen))),
        ("any two in a set", f"{a.pairs:.3f}", f"{b.pairs:.3f}"),
        ("an object, by other points", f"{a.floor:.3f}", f"{b.floor:.3f}"),
        ("nearest in its own set", f"{a.nearest:.3f}", f"{b.nearest:.3f}"),
        ("nearest in the first", "", f"{alike.reached:.3f}"),
        *((name, _spread(a.measures[name]), _spread(b.measures[name])) for name in MEASURES),
    ]


def _spread(values: Floats) -> str:
    if not len(values):
        return "none"
    low, middle, high = np.quantile(values, (0.1, 0.5, 0.9))
    return f"{middle:.3g} ({low:.3g}, {high:.3g})"
