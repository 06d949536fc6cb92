"""How exact articugen is, in one table: python -m tests.benchmarks.accuracy [--quick]

Prints tables and saves accuracy.json and accuracy.md in the folder --out. Every number is against
exact solids: see exactness.py (instances, with and without unseen space; the rule `rigid`),
forms.py (shapes), open_space.py (the rule `reachable`).
"""

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from rich.console import Console

from articugen.core.recipe import Recipe
from articugen.core.records import dequantize
from articugen.instance import make, preparing
from articugen.instance.preparing import Prepared
from articugen.procedural import CATEGORIES
from tests.benchmarks import accuracy_tables, cases, exactness, forms
from tests.benchmarks.about import about
from tests.benchmarks.exactness import Row, counts
from tests.benchmarks.open_space import INSIDE, UNDECIDED, open_space

HOLLOW = ("drawer", "oven", "washing_machine")
SEED = 1
TIMED = 3


@dataclass(frozen=True)
class Size:
    """How much is measured: `objects` of each category, `hollow` of them for the other rules."""

    objects: int
    states: int
    points: int
    hollow: int


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.accuracy")
    parser.add_argument("--objects", type=int, default=10, help="of each category")
    parser.add_argument("--states", type=int, default=2, help="random joint states an object")
    parser.add_argument("--points", type=int, default=100_000, help="of each kind, an instance")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--quick", action="store_true", help="see that it works")
    parser.add_argument("--out", type=Path, default=Path("benchmarks_out"), help="folder")
    asked = parser.parse_args()
    hollow = min(3, asked.objects)
    size = Size(asked.objects, asked.states, asked.points, hollow)
    if asked.quick:
        size = Size(objects=1, states=1, points=5000, hollow=1)
    record, started = about(asked.quick), time.perf_counter()
    console = Console()
    with tempfile.TemporaryDirectory(prefix="articugen-accuracy-") as folder:
        report = {"about": record} | _measured(size, asked.jobs, Path(folder), console)
    record["minutes"] = (time.perf_counter() - started) / 60.0
    asked.out.mkdir(parents=True, exist_ok=True)
    (asked.out / "accuracy.json").write_text(json.dumps(report, indent=1, default=_plain) + "\n")
    (asked.out / "accuracy.md").write_text(accuracy_tables.markdown(report))
    wide = Console(width=max(console.width, 160))
    for table in accuracy_tables.all_tables(report):
        table.print(wide)
    console.print(f"saved: {asked.out}/accuracy.json, accuracy.md")


def _measured(size: Size, jobs: int, folder: Path, console: Console) -> Row:
    report: Row = {"objects": [], "reachable": [], "rigid": [], "shapes": []}
    started = time.perf_counter()
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        waiting = {pool.submit(_shapes, size): "shapes"}
        waiting |= {
            pool.submit(_open, category, index, size): "reachable"
            for category in HOLLOW
            for index in range(size.hollow)
        }
        waiting |= {
            pool.submit(_rigid, category, index, size): "rigid"
            for category in CATEGORIES
            for index in range(size.hollow)
        }
        waiting |= {
            pool.submit(_object, category, index, messy, size): "objects"
            for category in CATEGORIES
            for index in range(size.objects)
            for messy in (False, True)
        }
        for n, done in enumerate(as_completed(waiting), start=1):
            report[waiting[done]] += done.result()
            if n % 10 == 0 or n == len(waiting):
                console.print(f"{time.perf_counter() - started:6.1f} s  {n} of {len(waiting)}")
    # workers finish in any order
    report["objects"].sort(key=lambda row: (row["category"], row["messy"], row["name"]))
    for rule in ("reachable", "rigid"):
        report[rule].sort(key=lambda row: (row["category"], row["name"], row["state"]))
    return report


def _object(category: str, index: int, messy: bool, size: Size) -> list[Row]:
    model = cases.bundled(category, index, messy=messy)
    return exactness.object_rows(model, model.recipe, size.states, size.points, SEED)


def _shapes(size: Size) -> list[Row]:
    model = cases.bundled("drawer", 0, messy=False)
    recipe = model.recipe
    return [
        {
            "tubes": forms.tubes(recipe, size.points),
            "sheets": forms.sheets(recipe),
            "growth": forms.growth(recipe),
            "uniformity": forms.uniformity(recipe, model, min(size.points, 20_000)),
        }
    ]


def _open(category: str, index: int, size: Size) -> list[Row]:
    """The rule `reachable` on an open object: IoU with what is open in truth, CPU time over that
    of `seen`."""
    model = cases.bundled(category, index, messy=False)
    recipe = model.recipe.with_options(states=size.states)
    prepared = _prepared(model, recipe, ("seen", "reachable"))
    rows = []
    for state in range(1, size.states + 1):
        made = cases.sampled(prepared["reachable"], state, size.points)
        scene = cases.scene(model, prepared["reachable"], state)
        space = open_space(scene, recipe.fusion.opening)
        row: Row = {"category": category, "name": model.name, "state": state}
        row |= {"undecided": 0, "asked": 0}
        for kind, stored, label in (
            ("uniform", made.uniform_points, made.uniform_label),
            ("near", made.near_points, made.near_label),
        ):
            points = dequantize(stored)
            verdict = space.verdict(points, prepared["reachable"].views)
            known = verdict != UNDECIDED
            row[kind] = counts(label[known] > 0, verdict[known] == INSIDE)
            row["undecided"] += int(np.sum(~known))
            row["asked"] += len(points)
        rows.append(row | _seconds(prepared, state))
    return rows


def _rigid(category: str, index: int, size: Size) -> list[Row]:
    """The rule `rigid`: IoU with the exact solids, CPU time beside that of `seen`."""
    model = cases.bundled(category, index, messy=False)
    prepared = _prepared(model, model.recipe.with_options(states=size.states), ("seen", "rigid"))
    rows = []
    for state in range(1, size.states + 1):
        made = cases.sampled(prepared["rigid"], state, size.points)
        scene = cases.scene(model, prepared["rigid"], state)
        fields = preparing.pose(prepared["rigid"], state)[1]
        row: Row = {"category": category, "name": model.name, "state": state}
        rows.append(row | exactness.material(made, scene, fields) | _seconds(prepared, state))
    return rows


def _prepared(model: cases.Model, recipe: Recipe, rules: Sequence[str]) -> dict[str, Prepared]:
    """The object by each rule."""
    by_rule = {
        rule: recipe.model_copy(update={"fusion": recipe.fusion.model_copy(update={"rule": rule})})
        for rule in rules
    }
    return {rule: preparing.prepare(model.obj, r, SEED) for rule, r in by_rule.items()}


def _seconds(prepared: dict[str, Prepared], state: int) -> dict[str, float]:
    """The median CPU time of an instance by each rule, taken in turns."""
    seconds: dict[str, list[float]] = {rule: [] for rule in prepared}
    for _ in range(TIMED):
        for rule, p in prepared.items():
            seconds[rule].append(_cpu(partial(make.make_instance, p, state)))
    return {rule: statistics.median(spent) for rule, spent in seconds.items()}


def _cpu(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def _plain(value: object) -> object:
    return value.tolist() if isinstance(value, np.ndarray) else float(value)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
