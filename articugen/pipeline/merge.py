"""The end of a data set that processes have shared out: check what they have made, write the
manifest."""

from collections.abc import Callable, Sequence
from pathlib import Path

from articugen.core.errors import ArticugenError
from articugen.core.place import Folder
from articugen.core.processes import default_jobs
from articugen.core.recipe import Recipe
from articugen.pipeline.common import OF_JOB, CommonPlan, listing_of
from articugen.pipeline.job import Job
from articugen.pipeline.plan import name_of_ref, objects_of, plan_recorded
from articugen.pipeline.records import Records
from articugen.pipeline.run import OnNotice, Run
from articugen.sources.refs import ObjectRef
from articugen.sources.source import open_source
from articugen.store.manifest import Manifest


def merge(
    folder: Path,
    *,
    jobs: int | None = None,
    sizes_only: bool = False,
    on_object: Callable[[int, int, str], None] = lambda *_: None,
    on_notice: OnNotice = lambda _: None,
) -> Manifest:
    """Check all that shares have made in a folder, and write its manifest; once it is written and
    nothing was recorded since, check whether it still holds.

    Args:
        folder: of the data set.
        jobs: threads that read shards, None for all cores.
        sizes_only: compare the sizes of shards, not every byte.
        on_object: called with how many objects were checked, of how many, and the last one.
        on_notice: called with one sentence where nothing is left to merge.

    Raises:
        ArticugenError: objects are missing, and which command makes them; processes are at work; no
            share was made; their plan is of another version.
    """
    with Records(Folder(folder), sizes_only=sizes_only) as records:
        if records.agreed is None:
            manifest = _check_merged(records, folder)
            on_notice("nothing to merge: the manifest lists all that was made")
            return manifest
        job = _job_of(records.agreed, folder, jobs or default_jobs())
        refs = objects_of(job, open_source(job.source))
        _check_listing(records, refs)
        plan = plan_recorded(job, records, refs, on_object)
        manifest = Run(job, records, plan, len(refs), refs[0].licence).finish(None).manifest
        assert manifest is not None  # it is no share
        return manifest


def _check_merged(records: Records, folder: Path) -> Manifest:
    if records.manifest is None:
        raise ArticugenError(
            f"{folder}: no rank has been at work here; make objects with: articugen "
            "generate ... --shard i/n"
        )
    for outcome in records.manifest.outcomes:
        why = outcome.shard and records.why(outcome.key)
        if why:
            raise ArticugenError(
                f"{folder}: is merged, but {why}; mend it with: articugen verify {folder} --repair"
            )
    return records.manifest


def _check_listing(records: Records, refs: Sequence[ObjectRef]) -> None:
    """Raise ArticugenError if these are not the objects that were shared out, or fewer than are
    recorded."""
    names, about = list(map(name_of_ref, refs)), records.agreed
    assert about is not None
    if listing_of(names) != about.listing:
        raise ArticugenError(
            f"{records.place}: {about.source} has other objects than when ranks began; "
            f"run this to the end instead: {about.command}"
        )
    more = sorted(records.outcomes.keys() - set(names))
    if more:
        raise ArticugenError(
            f"{records.place}: holds objects that its ranks were not asked for ({more[0][1]}, for "
            f"one); run this instead: {about.command}"
        )


def _job_of(common: CommonPlan, folder: Path, jobs: int) -> Job:
    recipe = Recipe.of_text(common.recipe)
    if recipe is None:
        raise ArticugenError(
            f"{folder}: the ranks' recipe is of another version of articugen; merge it there"
        )
    choice = {name: getattr(common, name) for name in OF_JOB}
    return Job(**choice, recipe=recipe, out=folder, jobs=jobs)
