"""Shards of hinged boxes on the disk, and a small data set of them with its manifest."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from instances import SMALL, hinged_box

from articugen.core.recipe import Recipe
from articugen.core.schema import Instance
from articugen.store.manifest import Manifest, Timings
from articugen.store.outcome import Key, Outcome
from articugen.store.shards import open_shard
from articugen.store.writer import write_shard

RECIPE_SHA256 = SMALL.for_one_object().sha256()


def attributes_of(recipe: Recipe = SMALL, **others: Any) -> dict[str, Any]:
    """Return the attributes of a shard of boxes, but for the given ones."""
    return {
        "category": "box",
        "split": "train",
        "recipe": recipe.text(),
        "recipe_sha256": recipe.sha256(),
        "seed": 0,
        "articugen_version": "0",
    } | others


def shard(path: Path, instances: Iterable[Instance], split: str = "train") -> Path:
    """Write a shard, and return its path."""
    write_shard(path, instances, attributes_of(split=split))
    return path


def rewrite(
    path: Path, edit: Callable[[list[Instance]], Sequence[Instance]], **attributes: Any
) -> list[Instance]:
    """Write a shard again, of what `edit` makes of its instances; return those it was of."""
    with open_shard(path) as before:
        rows, about = [before.instance(i) for i in range(len(before))], dict(before.attributes)
    write_shard(path, edit(rows), about | attributes)
    return rows


def one_box(
    folder: Path, edit: Callable[[list[Instance]], Sequence[Instance]], **attributes: Any
) -> list[Instance]:
    """Write a data set of one training object in two poses, whose shard is of what `edit` makes of
    them; return those it was of."""
    write_boxes(folder, train=1, test=0, states=1)
    return rewrite(folder / "train-00000.h5", edit, **attributes)


def write_boxes(
    folder: Path,
    *,
    train: int = 4,
    test: int = 2,
    states: int = 3,
    category: str = "box",
    recipe: Recipe = SMALL,
    slides: float = 0.3,
    first: int = 0,
) -> Path:
    """`train` + `test` objects, each in its canonical pose and at `states` random ones; the knob on
    the lid slides so far at most. Their numbers begin with `first`."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(5)
    outcomes = []
    for index in range(first, first + train + test):
        split = "train" if index < first + train else "test"
        name = f"box-{index}"
        angles = [(0.0, 0.0), *zip(rng.uniform(0, 1.7, states), rng.uniform(0, slides, states))]  # noqa: B905
        amounts = [(float(a), float(b)) for a, b in angles]
        rows = hinged_box(amounts, object_id=name, seed=index, recipe=recipe)
        about = attributes_of(recipe, category=category, split=split)
        record = write_shard(folder / f"{split}-{index:05d}.h5", rows, about)
        key = Key(
            split=split, object_id=name, ref="r", recipe_sha256=RECIPE_SHA256, seed=0, generator="0"
        )
        outcomes.append(Outcome.of_shard(key, record, input_sha256="f" * 64))
    timings = Timings(seconds=1.0, instances_per_second=1.0, peak_memory_bytes=1, workers=1)
    about = {"category": category, "source": "tests", "licence": "MIT", "seed": 0}
    Manifest.of(outcomes, recipe=recipe.text(), timings=timings, **about).write(folder)
    return folder
