"""Data without a disk: the instances that `generate` would store, one after the other, for ever."""

import os
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

from articugen.core.errors import ArticugenError, InvalidArgument, printable
from articugen.core.yaml_files import unlisted
from articugen.instance.again import resolved
from articugen.instance.make import make_instance
from articugen.instance.preparing import Prepared, prepare
from articugen.pipeline.common import listing_of
from articugen.pipeline.door import jobs_of
from articugen.pipeline.job import Job, Share
from articugen.pipeline.making import instances_each, verdict_on
from articugen.pipeline.options import Folder, Options, RecipeLike, whole
from articugen.pipeline.plan import name_of_ref, objects_of
from articugen.sources.refs import ObjectRef
from articugen.sources.source import Source, open_source
from articugen.store.dataset import DEFAULT_FIELDS
from articugen.store.rows import Row
from articugen.store.shards import MadeShard
from articugen.store.writer import stored_arrays

if TYPE_CHECKING:
    from articugen.store.torch_dataset import TorchStream

MOST_REJECTED = 100
"""Objects, one after the other, of which nothing can be made: the next ones will not do either."""


def stream(
    category: str,
    recipe: RecipeLike = "light",
    source: Folder = "procedural_varied",
    seed: int = 0,
    *,
    states: int | None = None,
    split: str | None = None,
    share: str = "",
    start: int = 0,
) -> "Stream":
    """Return instances without end, equal to those that `generate` stores of the same objects.

    A source that makes its objects makes new ones for ever. Objects of a folder come again and
    again in other states: in round k in those of a `generate` with seed + k.

    Args:
        category, recipe, source, seed, states: as of `generate`; limits of time and memory do not
            count.
        split: "train" or "test", for objects of that split alone.
        share: i/n for process i of n, each of which makes other objects; by default as torchrun
            says in RANK and WORLD_SIZE.
        start: how many instances are passed over, by each worker of a loader.

    Raises:
        ArticugenError: no such source, category, recipe, split or share.
    """
    job, *others = jobs_of(Options(category, source, recipe=recipe, states=states, seed=seed))
    if others:
        raise InvalidArgument(f"{category!r} means {1 + len(others)} categories; stream one")
    if whole("start", start) < 0:
        raise InvalidArgument(f"start is {start}; give 0 or more")
    ranks = f"{os.environ.get('RANK', '0')}/{os.environ.get('WORLD_SIZE', '1')}"
    opened = open_source(job.source)
    recipe = job.recipe.for_source(clips_to_limits=opened.clips)
    job = replace(job, recipe=recipe, share=Share.of_text(share or ranks))
    refs = opened.objects(job.category) if opened.is_made else objects_of(job, opened)
    splits = sorted({ref.split for ref in refs})
    if split and split not in splits:
        raise InvalidArgument(unlisted("split", split, splits))
    return Stream(job, opened, refs, split or "", int(start))


@dataclass(eq=False, repr=False)
class Stream(Iterator[Row]):
    """Rows without end: all states of an object, then those of the next; made by `stream`.

    Attributes:
        job: what is made, and which share of it.
        refs: the objects of a round.
        position: how many instances of the share are passed, those of rejected objects counted.
    """

    job: Job
    source: Source
    refs: Sequence[ObjectRef]
    split: str
    position: int
    _current: tuple[int, Prepared] | None = field(default=None, init=False, repr=False)
    _rejected: int = field(default=0, init=False, repr=False)

    def __next__(self) -> Row:
        """Return the next row; an object of which nothing can be made is passed over, with a
        warning.

        Raises:
            ArticugenError: that were `MOST_REJECTED` in a row.
            MachineFault, MemoryError: it says nothing about the object.
        """
        while True:
            number, state = divmod(self.position, self.each)
            try:
                arrays = self._made(number, state)
            except Exception as error:  # an object must not take the others down with it
                self._pass_over(number, error)
                self.position = (number + 1) * self.each
                continue
            self.position += 1
            split = self._object(number)[0].split
            return Row(partial(_read, arrays), arrays, split=split, category=self.category)

    @property
    def category(self) -> str:
        return self.job.category

    @property
    def each(self) -> int:
        """Instances of an object."""
        return instances_each(self.job.recipe)

    def objects(self, numbers: Iterable[int]) -> list[MadeShard]:
        """Return all instances of each of some objects; of what cannot be made a warning says so.
        Raises as `next`."""
        shards: list[MadeShard] = []
        for number in numbers:
            try:
                shards.append(MadeShard([self._made(number, n) for n in range(self.each)]))
            except Exception as error:  # likewise
                self._pass_over(number, error)
        return shards

    def for_training(self) -> "Stream":
        """Return the same of training objects alone; InvalidArgument where they come again, so that
        none could be held out."""
        if not self.source.is_made:
            raise InvalidArgument(
                f"{self.job.source}: its objects come again and again, so none could be held out; "
                "make a data set of them with articugen generate, and train on that"
            )
        return replace(self, split="train")

    def _made(self, number: int, state: int) -> Mapping[str, Any]:
        """Return an instance of object `number` as it is stored."""
        recipe = self.job.recipe
        if self._current is None or self._current[0] != number:
            ref, seed = self._object(number)
            self._current = number, prepare(resolved(ref, recipe), recipe, seed)
        arrays = stored_arrays(make_instance(self._current[1], state))
        self._rejected = 0
        return arrays

    def _pass_over(self, number: int, error: Exception) -> None:
        ref = self._object(number)[0]
        verdict = verdict_on(error, ref, self.job.recipe) or repr(error)
        why = printable(f"{ref.object_id}: {verdict}")
        self._rejected += 1
        if self._rejected >= MOST_REJECTED:
            raise ArticugenError(f"{MOST_REJECTED} objects were rejected in a row; the last, {why}")
        warnings.warn(f"{why}; the stream goes on without it", stacklevel=3)

    def __repr__(self) -> str:
        """Return what decides all that comes."""
        job, recipe = self.job, self.job.recipe.for_one_object()
        code = self.refs[0].generator_by(recipe.text())
        if not self.source.is_made:
            code += f", models {listing_of(map(name_of_ref, self.refs))[:12]}"
        return (
            f"{self.split or 'every'} {job.category} of {job.source}, recipe "
            f"{recipe.sha256()[:12]}, seed {job.seed}, share {job.share}, {code}"
        )

    @cached_property
    def _places(self) -> list[int]:
        """The objects of a round that are of the split."""
        return [i for i, ref in enumerate(self.refs) if self.split in ("", ref.split)]

    def _object(self, number: int) -> tuple[ObjectRef, int]:
        """Return object `number` of the share, and the seed of its round."""
        share = self.job.share or Share(0, 1)
        rounds, n = divmod(share.number + number * share.of, len(self._places))
        if self.source.is_made:
            place = rounds * len(self.refs) + self._places[n]
            return self.source.made(self.job.category, place), self.job.seed
        return self.refs[self._places[n]], self.job.seed + rounds

    def part(self, number: int, of: int) -> "Stream":
        """Return the share of worker `number` of `of`, each of which passes over the same number of
        instances; any of them may run in a process of its own."""
        share = self.job.share or Share(0, 1)
        inner = Share(share.number * of + number, share.of * of)
        return replace(self, job=replace(self.job, share=inner))

    def state_dict(self) -> dict[str, Any]:
        """Return where it is, for `load_state_dict`, and what decides what comes there."""
        return {"position": self.position, "of": str(self)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue where such a stream was; InvalidArgument where that makes others, by name."""
        here = self.state_dict()["of"]
        if state.get("of") != here:
            raise InvalidArgument(f"the state is of {state.get('of')}, not of {here}; open that")
        self.position = int(state["position"])

    def torch(self, *, fields: Sequence[str] = DEFAULT_FIELDS) -> "TorchStream":
        """Return a torch IterableDataset of dicts of tensors, as `DataSet.torch` has them, of all
        points. A loader's workers make different objects.

        Raises:
            MissingExtra: torch is not installed.
            InvalidArgument: no such field.
        """
        from articugen.store.torch_dataset import TorchStream  # noqa: PLC0415 - torch is optional

        there = sorted(self.job.recipe.fields())
        if wrong := [name for name in fields if name not in there]:
            raise InvalidArgument(unlisted("field", wrong[0], there))
        return TorchStream(self.part(0, 1), tuple(fields))


def _read(arrays: Mapping[str, Any], names: Sequence[str]) -> list[Any]:
    return [arrays[name] for name in names]
