"""What the command `generate` does, as a function that a notebook calls."""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from articugen import pipeline
from articugen.errors import ArticugenError, InvalidArgument
from articugen.pipeline import Job, ObjectReport
from articugen.recipe import Recipe, load_recipe
from articugen.sources import registry
from articugen.store.dataset import DataSet
from articugen.store.dataset import open as open_data_set

Folder = str | os.PathLike[str]


def generate(
    category: str,
    source: Folder = "procedural",
    out: Folder = "data",
    recipe: str | Path | Mapping[str, Any] | Recipe | None = None,
    *,
    seed: int = 0,
    objects: int | None = None,
    ids: Sequence[str] = (),
    exclude: Sequence[str] = (),
    states: int | None = None,
    movable: Sequence[str] = (),
    canonical: str | None = None,
    max_rejected: float | None = None,
    jobs: int | None = None,
    replace: bool = False,
    tell: Callable[[ObjectReport], None] = lambda _: None,
) -> DataSet:
    """Make a data set, or what is missing of it, and open it.

    Args:
        category: what to make, one of the source's.
        source: a source's name, or a folder of models.
        out: the data set goes to the folder <out>/<category>.
        recipe: a name, a path, the keys of a recipe, or None for the category's own.
        seed: the master seed; 0 is one like any other.
        objects, states: so many, instead of the recipe's number.
        ids, exclude: these objects alone; but not these.
        movable, canonical: which joints move and what pose is state 0, instead of the recipe's.
        max_rejected: the recipe's max_rejected_fraction.
        jobs: worker processes, None for all cores; 0 works in this process, without limits.
        replace: whether data that was made in another way may be replaced.
        tell: called for each object, those that were there already first.

    Raises:
        ArticugenError: no such source, category or recipe; other data is there; objects failed, or
            more were rejected than the recipe allows.
        KeyboardInterrupt: finished objects are kept; the same call goes on after them.
    """
    source = os.fspath(source)
    names = registry.categories(source, [category])
    if len(names) != 1:
        raise InvalidArgument(
            f"{category!r} means {len(names)} data sets; make one after the other"
        )
    job = Job(
        source=source,
        category=names[0],
        recipe=load_recipe(recipe, names[0])
        .with_counts(objects=objects, states=states, max_rejected=max_rejected)
        .with_articulation(movable=movable, canonical=canonical),
        seed=seed,
        out=Path(out) / names[0],
        jobs=pipeline.default_jobs() if jobs is None else jobs,
        ids=tuple(ids),
        exclude=tuple(exclude),
    )
    with pipeline.started(job) as run:
        if run.plan.conflict and not replace:
            raise ArticugenError(f"{run.plan.conflict}, or pass replace=True")
        manifest = run.finish(tell)
    if manifest.shortfall:
        first = (*manifest.failed, *manifest.rejected, *manifest.skipped)[0]
        raise ArticugenError(f"{job.out}: {manifest.shortfall}; the first, {first.sentence}")
    return open_data_set(job.out)
