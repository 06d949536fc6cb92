"""One data set by many processes that do not know of each other, on as many machines as there are.

Every rank plans the whole and makes its share: what an object is called and becomes depends on the
plan alone, so the number of ranks may change while they are at work, and any of them may be killed.
`merge` looks at what they have made and writes the manifest; so does a plain run, which goes on
where they have stopped.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from articugen.core.errors import ArticugenError
from articugen.core.recipe import Recipe
from articugen.instance.again import generator_of
from articugen.pipeline.journal import NEVER_MADE
from articugen.pipeline.rank_journal import (
    CommonPlan,
    Merging,
    Name,
    RankJournal,
    Share,
    listing_of,
)
from articugen.pipeline.run import (
    Job,
    ObjectReport,
    Plan,
    Run,
    as_its_source_is,
    conclude,
    objects_of,
    plain_name,
    plan_for,
    timings_of,
)
from articugen.sources import registry
from articugen.sources.refs import ObjectRef
from articugen.store.manifest import Key, Manifest, Outcome, Timings

_NAMED, _NUMBERS = 5, 100
"""Missing objects, and shares, that a sentence names."""


@dataclass(frozen=True)
class Rank:
    """A rank in its folder.

    Attributes:
        run: of its share alone.
        share: that it makes.
        objects: of the whole data set.
    """

    run: Run
    share: Share
    objects: int

    @property
    def plan(self) -> Plan:
        """For its share."""
        return self.run.plan

    def finish(
        self,
        on_object: Callable[[ObjectReport], None] = lambda _: None,
        on_notice: Callable[[str], None] = lambda _: None,
    ) -> list[Outcome]:
        """Make what is missing of its share; what became of each of its objects.

        Raises:
            ArticugenError: the folder holds another data set; no object can be made.
            MachineFault, KeyboardInterrupt: finished objects are kept; any rank goes on after them.
        """
        if self.plan.conflict:
            raise ArticugenError(self.plan.conflict)
        return self.run.make(on_object, on_notice)


@contextmanager
def started(job: Job, share: Share, *, command: str = "") -> Iterator[Rank]:
    """A rank that has planned its share, and has made nothing yet.

    Args:
        job: the whole data set.
        share: of this rank.
        command: that makes the whole, as people write it, for what is said to them.

    Raises:
        ArticugenError: a run that is no rank is at work in the folder, or ranks that make something
            else.
    """
    job = as_its_source_is(job)
    refs = objects_of(job)
    names = names_of(refs)
    common = common_plan(job, refs, command)
    with RankJournal(job.out, share, common, names) as journal:
        mine = [ref for place, ref in enumerate(refs) if share.has(place)]
        yield Rank(Run(job, journal, plan_for(job, journal, mine)), share, len(refs))


def merge(
    folder: Path,
    *,
    jobs: int = 1,
    sizes_only: bool = False,
    timings: Timings | None = None,
    on_object: Callable[[int, int, str], None] = lambda *_: None,
    on_notice: Callable[[str], None] = lambda _: None,
) -> Manifest:
    """Look at all that ranks have made in a folder, and write its manifest; once it is written and
    they have left nothing since, look whether it still holds.

    Args:
        folder: of the data set.
        jobs: threads that read shards.
        sizes_only: look at the sizes of shards, not at every byte.
        timings: of the ranks, where they are known; else the merge's own.
        on_object: called with how many objects were looked at, of how many, and the last one.
        on_notice: called with one sentence where nothing is left to merge.

    Raises:
        ArticugenError: objects are missing, and which command makes them; ranks are at work; no
            rank has been; their plan is of another version.
        CorruptShard: a journal is damaged.
    """
    began = time.perf_counter()
    with Merging(folder, sizes_only=sizes_only) as journal:
        if journal.merged:
            _check_merged(journal, journal.merged)
            on_notice("nothing to merge: the manifest tells of all that was made")
            return journal.merged
        job = _job_of(journal.common, folder, jobs)
        refs = objects_of(job)
        _check_listing(journal, names_of(refs))
        outcomes, missing = list[Outcome](), dict[int, str]()
        same = (job.recipe.for_one_object().sha256(), generator_of(refs[0], job.recipe.text()))
        with ThreadPoolExecutor(max(1, jobs)) as pool:
            looks = pool.map(lambda ref: _why(journal, ref, job.seed, *same), refs)
            for place, (ref, why) in enumerate(zip(refs, looks, strict=True)):
                on_object(place + 1, len(refs), ref.object_id)
                if why is None:
                    outcomes.append(journal.recorded[_name(ref)])
                else:
                    missing[place] = ref.object_id if why == NEVER_MADE else why
        if missing:
            raise ArticugenError(_told(journal, missing, len(refs)))
        timings = timings or timings_of(0, time.perf_counter() - began, jobs)
        return conclude(job, journal, outcomes, timings, registry.licence(job.source))


def _check_merged(journal: Merging, manifest: Manifest) -> None:
    for outcome in manifest.outcomes:
        why = outcome.shard and journal.why(outcome.key)
        if why:
            raise ArticugenError(
                f"{journal.folder}: is merged, but {why}; mend it with: articugen verify "
                f"{journal.folder} --repair"
            )


def _why(
    journal: Merging, ref: ObjectRef, seed: int, recipe_sha256: str, generator: str
) -> str | None:
    """Why there is nothing to tell of an object yet; None where there is. What it is made from is
    not read again: the plain command does that."""
    outcome = journal.recorded.get(_name(ref))
    if outcome is None:
        return NEVER_MADE
    if outcome.fault is not None:
        return None
    key = Key(
        split=ref.split,
        object_id=plain_name(ref.object_id),
        ref=outcome.key.ref,
        recipe_sha256=recipe_sha256,
        seed=seed,
        generator=generator,
    )
    return journal.why(key)


def _check_listing(journal: Merging, names: list[Name]) -> None:
    """
    Raises:
        ArticugenError: these are not the objects that the ranks have shared out, or there are more.
    """
    if listing_of(names) != journal.common.listing:
        raise ArticugenError(
            f"{journal.folder}: {journal.common.source} has other objects than when ranks began; "
            f"run this to the end instead: {journal.common.command}"
        )
    more = sorted(journal.recorded.keys() - set(names))
    if more:
        raise ArticugenError(
            f"{journal.folder}: holds objects that its ranks were not asked for ({more[0][1]}, for "
            f"one); run this instead: {journal.common.command}"
        )


def _told(journal: Merging, missing: dict[int, str], objects: int) -> str:
    """Which objects are missing, and what makes them."""
    some = ", ".join(list(missing.values())[:_NAMED]) + (", ..." if len(missing) > _NAMED else "")
    said = f"{journal.folder}: {len(missing)} of {objects} objects are missing ({some})"
    of = max((share.of for share in journal.shares), default=1)
    numbers = sorted({place % of for place in missing})
    those = ", ".join(map(str, numbers[:_NUMBERS])) + (", ..." if len(numbers) > _NUMBERS else "")
    return (
        f"{said}; make them with: {journal.common.command} --shard i/{of}, i = {those}; or without "
        "--shard"
    )


def names_of(refs: Iterable[ObjectRef]) -> list[Name]:
    """What objects are called in plans."""
    return [_name(ref) for ref in refs]


def _name(ref: ObjectRef) -> Name:
    return ref.split, plain_name(ref.object_id)


def common_plan(job: Job, refs: Sequence[ObjectRef], command: str) -> CommonPlan:
    """What all processes that make these objects together are asked for."""
    return CommonPlan(
        source=job.source,
        category=job.category,
        recipe=job.recipe.text(),
        seed=job.seed,
        ids=job.ids,
        exclude=job.exclude,
        joints=job.joints,
        objects=len(refs),
        listing=listing_of(names_of(refs)),
        generator=generator_of(refs[0], job.recipe.text()),
        command=command or "articugen generate ...",
    )


def _job_of(common: CommonPlan, folder: Path, jobs: int) -> Job:
    try:
        recipe = Recipe.model_validate_json(common.recipe)
    except ValidationError:
        raise ArticugenError(
            f"{folder}: the ranks' recipe is of another version of articugen; merge it there"
        ) from None
    return Job(
        source=common.source,
        category=common.category,
        recipe=recipe,
        seed=common.seed,
        out=folder,
        jobs=jobs,
        ids=common.ids,
        exclude=common.exclude,
        joints=common.joints,
    )
