"""Whether `verify` leaves sound data in peace: python -m tests.benchmarks.soundness [--sets N]

Makes N objects of three instances each, with recipes as different as people write them: every rule,
fine and coarse views, many samples and few. They are the bundled ones, clean and messy, and, where
ARTICUGEN_REAL_MODELS names a folder, what lies in its collections. All are judged as `verify` and
`verify --replay` would. Prints what was refused, the most that anything was off beside each
tolerance, and the least share that each bound met where there was enough to refuse it: the margins
of articugen/verify/bounds.py. Exit status 1 if anything was refused.
"""

import argparse
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice, zip_longest
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import ArrayLike, NDArray

from articugen.core.errors import InvalidSource, NotOfCategory
from articugen.core.recipe import Recipe, load_recipe
from articugen.core.schema import Instance
from articugen.instance.again import resolved
from articugen.instance.make import make_instance
from articugen.instance.preparing import Prepared, prepare
from articugen.sources.refs import ObjectRef
from articugen.sources.source import open_source
from articugen.verify import invariants, replay
from articugen.verify.bounds import BOUNDS, TOLERANCES, Tolerance

CATEGORIES = ("drawer", "eyeglasses", "laptop", "oven", "washing_machine")

STATES = 2

RULES = ("seen", "rigid", "reachable", "mean")
VIEWS: tuple[dict[str, Any], ...] = (
    {},
    {"count": 30, "resolution": 48},
    {"count": 60, "resolution": 128},
    {"count": 12, "resolution": 64, "projection": "pinhole"},
)
SAMPLES: tuple[dict[str, Any], ...] = (
    {},
    {"grids": (8,), "surface_points": 512, "uniform_points": 512, "near_points": 512},
    {"grids": (16, 32), "surface_points": 2048, "partial_views": 1, "partial_points": 64},
    {"grids": (8, 32), "coverage": True, "uniform_points": 4096, "near_sigma": 0.002},
    {"grids": (12, 40), "surface_points": 1000, "uniform_points": 20000, "near_sigma": 0.03},
)
FEWER = {"grids": (16, 32), "surface_points": 4096, "near_points": 4096, "uniform_points": 4096}
"""What the recipe's own numbers are taken to be: enough, and quicker."""


@dataclass(frozen=True, eq=False)
class Made:
    """An object made with a recipe, as a data set would hold it."""

    name: str
    recipe: Recipe
    prepared: Prepared
    rows: list[Instance]

    def refused(self) -> list[str]:
        """What `verify` and `verify --replay` would say of it."""
        found = [str(fault) for fault in invariants.faults(self.rows, self.recipe)]
        return found + [s for row in self.rows for s in replay.beside_level(self.prepared, row)]

    def most_off(self) -> dict[str, float]:
        """By tolerance, the most that anything was off."""
        most: dict[str, float] = {}

        def noting(tolerance: Tolerance, off: ArrayLike) -> NDArray[np.bool_]:
            name = next(name for name, known in TOLERANCES.items() if known is tolerance)
            most[name] = max(most.get(name, 0.0), float(np.max(off, initial=0.0)))
            return np.asarray(off) > tolerance.most

        with patch.object(Tolerance, "exceeded_by", noting):
            list(invariants.faults(self.rows, self.recipe))
        return most

    def least_shares(self) -> dict[str, float]:
        """By bound, of the shares that could have been refused."""
        least: dict[str, float] = {}
        for _, _, share in invariants.shares(self.rows, self.recipe):
            if BOUNDS[share.bound].refuses(0, share.judged):  # if none agreed
                agree = share.agree / share.judged
                least[share.bound] = min(agree, least.get(share.bound, 1.0))
        return least


def made_sets(first: int = 0) -> Iterator[Made]:
    """Sets without end, no two alike; the n-th is always the same."""
    refs = list(_refs())
    for n in range(first, sys.maxsize):
        lap, ref = n // len(refs), refs[n % len(refs)]
        seed = n
        rule = RULES[(n + lap) % 4]
        views = VIEWS[(n // 4 + lap) % 4]
        samples = SAMPLES[(n + n // 5 + lap) % 5] or FEWER
        recipe = load_recipe(None, ref.category).with_options(states=STATES)
        recipe = Recipe.model_validate(
            recipe.model_dump()
            | {"fusion": recipe.fusion.model_dump() | {"rule": rule}}
            | {"views": recipe.views.model_dump() | views}
            | {"sampling": recipe.sampling.model_dump() | FEWER | samples}
        )
        name = f"{n}: {ref.source} {ref.category} {ref.object_id} {rule} {views} {samples}"
        try:
            yield _made(name, ref, recipe, seed)
        except NotOfCategory:
            continue


def _made(name: str, ref: ObjectRef, recipe: Recipe, seed: int) -> Made:
    prepared = prepare(resolved(ref, recipe), recipe, seed)
    return Made(name, recipe, prepared, [make_instance(prepared, s) for s in range(STATES + 1)])


def _refs() -> Iterator[ObjectRef]:
    """All there are, bundled and real ones in turn."""
    bundled = [
        list(open_source(source).objects(category))[::stride]
        for source, stride in (("procedural", 7), ("procedural_messy", 9))
        for category in CATEGORIES
    ]
    for turn in zip_longest(*bundled, list(_real())):
        yield from (ref for ref in turn if ref is not None)


def _real() -> Iterator[ObjectRef]:
    root = Path(os.environ.get("ARTICUGEN_REAL_MODELS", "/nonexistent"))
    for folder in sorted(root.glob("*/*/")):
        try:
            yield from open_source(folder.parent).objects(folder.name)
        except InvalidSource:
            continue


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.soundness")
    parser.add_argument("--sets", type=int, default=230, help="so many objects")
    asked = parser.parse_args()
    least: dict[str, tuple[float, str]] = {}
    most: dict[str, tuple[float, str]] = {}
    refused = made = 0
    for one in islice(made_sets(), asked.sets):
        made += 1
        found = one.refused()
        refused += bool(found)
        for sentence in found:
            print(f"REFUSED {one.name}: {sentence}")  # noqa: T201
        for bound, lowest in one.least_shares().items():
            least[bound] = min(least.get(bound, (1.0, "")), (lowest, one.name))
        for tolerance, off in one.most_off().items():
            most[tolerance] = max(most.get(tolerance, (0.0, "")), (off, one.name))
    print(f"{made} sets, {refused} refused; the most that was off by tolerance:")  # noqa: T201
    for tolerance, (off, name) in sorted(most.items()):
        print(f"  {tolerance:14} {off:.2g} in {name}")  # noqa: T201
    print("the least share by bound:")  # noqa: T201
    for bound, (lowest, name) in sorted(least.items()):
        print(f"  {bound:14} {lowest:.3f} in {name}")  # noqa: T201
    return min(refused, 1)


if __name__ == "__main__":
    sys.exit(main())
