"""What the command `generate` does, as a function that a notebook calls."""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from articugen.core.errors import ArticugenError, InvalidArgument
from articugen.core.recipe import Recipe, load_recipe
from articugen.core.yaml_files import with_settings
from articugen.pipeline.executors.dask import Dask
from articugen.pipeline.executors.local import Local
from articugen.pipeline.executors.slurm import Slurm
from articugen.pipeline.executors.work import Executor
from articugen.pipeline.job import Job, Share
from articugen.pipeline.run import ObjectReport, default_jobs, started
from articugen.sources import registry
from articugen.store.bucket import Remote, is_url
from articugen.store.dataset import DataSet
from articugen.store.dataset import open as open_data_set
from articugen.store.manifest import Manifest

Folder = str | os.PathLike[str]
RecipeLike = str | Path | Mapping[str, Any] | Recipe | None


def jobs_of(
    categories: Sequence[str],
    source: Folder,
    out: Folder,
    recipe: RecipeLike,
    *,
    changes: Sequence[str] = (),
    seed: int = 0,
    objects: int | None = None,
    ids: Sequence[str] = (),
    exclude: Sequence[str] = (),
    joints: Sequence[str] = (),
    states: int | None = None,
    movable: Sequence[str] = (),
    canonical: str | None = None,
    max_rejected: float | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    share: Share | None = None,
) -> list[Job]:
    """Return the data sets that are asked for, one a category; see `generate` for what each means.

    Raises:
        ArticugenError: no such source, category, object or recipe.
    """
    source = os.fspath(source)
    names = registry.categories(source, categories)
    if scheduler and is_url(out):
        raise InvalidArgument(
            f"{out} with a scheduler: run the same command on each machine instead, they share out "
            "the objects among them"
        )
    jobs_asked = [
        Job(
            source=source,
            category=name,
            recipe=with_settings(load_recipe(recipe, name, source), changes)
            .with_counts(objects=objects, states=states, max_rejected=max_rejected)
            .with_articulation(movable=movable, canonical=canonical),
            seed=seed,
            out=Remote(str(out)) / name if is_url(out) else Path(out) / name,
            jobs=default_jobs() if jobs is None else jobs,
            ids=own,
            exclude=out_of,
            joints=tuple(joints),
            scheduler=scheduler or "",
            share=share,
        )
        for name, (own, out_of) in registry.share_out(source, names, ids, exclude).items()
    ]
    if share and any(job.on_slurm for job in jobs_asked):
        raise InvalidArgument("--scheduler slurm shares out the objects by itself: no --shard")
    return jobs_asked


def generate(
    category: str,
    source: Folder = "procedural",
    out: Folder = "data",
    recipe: RecipeLike = None,
    *,
    changes: Sequence[str] = (),
    seed: int = 0,
    objects: int | None = None,
    ids: Sequence[str] = (),
    exclude: Sequence[str] = (),
    joints: Sequence[str] = (),
    states: int | None = None,
    movable: Sequence[str] = (),
    canonical: str | None = None,
    max_rejected: float | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    replace: bool = False,
    on_object: Callable[[ObjectReport], None] = lambda _: None,
) -> DataSet:
    """Make a data set, or what is missing of it, and open it.

    Args:
        category: what to make, one of the source's.
        source: a source's name, or a folder of models.
        out: the data set goes to the folder <out>/<category>. It may be s3://bucket/prefix.
        recipe: a name, a path, the keys of a recipe, or None for the category's own.
        changes: other values than the recipe's, each `section.key=value`.
        seed: the master seed; 0 is one like any other.
        objects, states: so many, instead of the recipe's number.
        ids, exclude: these objects alone; but not these.
        joints: only objects all of whose moving joints are of these kinds: revolute, continuous,
            prismatic, as the model has them.
        movable, canonical: which joints move and what pose is state 0, instead of the recipe's.
        max_rejected: the recipe's max_rejected_fraction.
        jobs: worker processes, None for all cores; 0 works in this process, without limits.
        scheduler: of a Dask cluster, tcp://host:8786, whose workers make it, or
            slurm://partition?tasks=100&cpus=4&time=60, for an array of jobs; `out` must be a folder
            that all of them see.
        replace: whether data that was made in another way may be replaced.
        on_object: called for each object, those that were there already first.

    Raises:
        ArticugenError: no such source, category or recipe; other data is there; objects failed, or
            more were rejected than the recipe allows.
        KeyboardInterrupt: finished objects are kept; the same call goes on after them.
    """
    todo = jobs_of(
        [category], source, out, recipe,
        changes=changes, seed=seed, objects=objects, ids=ids, exclude=exclude, joints=joints,
        states=states, movable=movable, canonical=canonical, max_rejected=max_rejected, jobs=jobs,
        scheduler=scheduler,
    )  # fmt: skip
    if len(todo) != 1:
        raise InvalidArgument(f"{category!r} means {len(todo)} data sets; make one after the other")
    (job,) = todo
    make(job, replace=replace, on_object=on_object)
    return open_data_set(str(job.out))


def make(
    job: Job,
    *,
    replace: bool = False,
    on_object: Callable[[ObjectReport], None] = lambda _: None,
    on_notice: Callable[[str], None] = lambda _: None,
) -> Manifest:
    """Make one data set of `jobs_of`, or what is missing of it; see `generate`.

    Args:
        on_notice: called with one sentence where a worker was lost, and the like.

    Raises:
        ArticugenError, KeyboardInterrupt: as `generate`; the manifest is written first, and tells
            of a `shortfall`, too.
    """
    check_replaces(job, replace=replace)
    executor = executor_of(job)
    with started(job) as run:
        run.check_replaces(replace=replace, cure="pass replace=True")
        manifest = run.finish(executor, on_object, on_notice).manifest
    assert manifest is not None  # it was asked for all of it
    if manifest.shortfall:
        first = (*manifest.failed, *manifest.rejected, *manifest.skipped)[0]
        raise ArticugenError(f"{job.out}: {manifest.shortfall}; the first, {first.sentence}")
    return manifest


def executor_of(job: Job, command: str = "") -> Executor:
    """Return who makes a data set: this machine, unless the job names a scheduler.

    Args:
        command: that makes all of it, as people write it.

    Raises:
        InvalidArgument: the scheduler's address makes no sense.
    """
    if job.on_slurm:
        return Slurm.of(job, command)
    return Dask(job.scheduler) if job.scheduler else Local(job.jobs)


def check_replaces(job: Job, *, replace: bool) -> None:
    """See to it that nobody counts on `replace` where processes share out the objects.

    Raises:
        InvalidArgument: it is asked for, and they do.
    """
    way = "an object store" if isinstance(job.out, Remote) else "slurm" if job.on_slurm else ""
    way = way or ("--shard" if job.share else "")
    if replace and way:
        raise InvalidArgument(
            f"--replace (replace=True) with {way}: processes that share out objects replace "
            "nothing; give a new --out"
        )
