"""What the command `generate` does, as a function that a notebook calls."""

from pathlib import Path

from articugen.core.errors import ArticugenError, InvalidArgument
from articugen.core.processes import default_jobs
from articugen.core.recipe import load_recipe
from articugen.core.yaml_files import with_settings
from articugen.pipeline.job import Job, Share
from articugen.pipeline.options import OnNotice, OnObject, Options, ignore, takes, whole
from articugen.pipeline.run import started
from articugen.sources.source import open_source
from articugen.store.bucket import Remote, is_url
from articugen.store.dataset import DataSet
from articugen.store.dataset import open as open_data_set
from articugen.store.manifest import Manifest

_OF_RECIPE = ("objects", "states", "max_rejected", "movable", "canonical")
"""Options that change the recipe."""


def jobs_of(options: Options, share: Share | None = None) -> list[Job]:
    """Return the data sets that are asked for, one a category; ArticugenError if there is no such
    source, category, object or recipe."""
    opened, out = open_source(options.source), options.out
    wanted = [options.category] if isinstance(options.category, str) else options.category
    names = opened.categories(wanted)
    if options.scheduler and is_url(out):
        raise InvalidArgument(
            f"{out} with a scheduler: run the same command on each machine instead, they share out "
            "the objects among them"
        )
    jobs = [
        Job(
            source=opened.name,
            category=name,
            recipe=with_settings(
                load_recipe(options.recipe, name, opened.name), options.changes
            ).with_options(**{name: getattr(options, name) for name in _OF_RECIPE}),
            seed=whole("seed", options.seed),
            out=Remote(str(out)) / name if is_url(out) else Path(out) / name,
            jobs=default_jobs() if options.jobs is None else whole("jobs", options.jobs),
            ids=ids,
            exclude=exclude,
            joints=tuple(options.joints),
            scheduler=options.scheduler or "",
            share=share,
        )
        for name, (ids, exclude) in opened.share_out(names, options.ids, options.exclude).items()
    ]
    if share and any(job.executor.records for job in jobs):
        raise InvalidArgument(
            f"--scheduler {options.scheduler} shares out the objects by itself: no --shard"
        )
    if options.replace and jobs[0].is_shared:
        way = "an object store" if is_url(out) else "--shard" if share else jobs[0].scheduler
        raise InvalidArgument(
            f"--replace (replace=True) with {way}: processes that share out objects replace "
            "nothing; give a new --out"
        )
    return jobs


@takes(Options)
def generate(options: Options) -> DataSet:
    """Make the data set of one category, or what is missing of it, and open it.

    The recipe may also be the keys of one, or a `Recipe`.

    Raises:
        ArticugenError: no such source, category or recipe; other data is there; objects failed, or
            more were rejected than the recipe allows.
        KeyboardInterrupt: finished objects are kept; the same call goes on after them.
    """
    jobs = jobs_of(options)
    if len(jobs) != 1:
        raise InvalidArgument(
            f"{options.category!r} means {len(jobs)} data sets; make one after the other"
        )
    make(jobs[0], replace=options.replace, on_object=options.on_object)
    return open_data_set(str(jobs[0].out))


def make(
    job: Job, *, replace: bool = False, on_object: OnObject = ignore, on_notice: OnNotice = ignore
) -> Manifest:
    """Make one data set of `jobs_of`, or what is missing of it; see `generate`. `on_notice` is
    called with one sentence where a worker was lost, and the like.

    Raises:
        ArticugenError, KeyboardInterrupt: as `generate`; the manifest is written first, and has a
            `shortfall`, too.
    """
    executor = job.executor.of(job, "")
    with started(job) as run:
        run.check_replaces(replace=replace, cure="pass replace=True")
        manifest = run.finish(executor, on_object, on_notice).manifest
    assert manifest is not None  # it was asked for all of it
    if manifest.shortfall:
        first = (*manifest.failed, *manifest.rejected, *manifest.skipped)[0]
        raise ArticugenError(f"{job.out}: {manifest.shortfall}; the first, {first.sentence}")
    return manifest
