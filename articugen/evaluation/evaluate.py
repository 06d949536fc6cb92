"""The paper's evaluation over the test objects of a data set; nothing is dropped.

Labels are given to predicted parts by votes of training instances (Appendix C). A test instance
without any predicted surface scores a label IoU of 0; its parts move as predicted. A true part that
none is voted for is taken not to move; distances to what is missing count as the cube's diagonal.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from itertools import takewhile
from pathlib import Path
from threading import Event
from typing import TypeVar

import numpy as np

from articugen.core.errors import UnfitData
from articugen.core.records import Floats
from articugen.core.schema import Instance
from articugen.evaluation import metrics
from articugen.evaluation.reconstruction import Reconstruction
from articugen.evaluation.results import Evaluation
from articugen.evaluation.tally import PAPER, Canonical, Protocol, Tally, nearest_parts
from articugen.store.manifest import Manifest
from articugen.store.shards import open_shard

Reconstruct = Callable[[Instance], Reconstruction]
_T = TypeVar("_T")


def evaluate(
    data: Path,
    reconstruct: Reconstruct,
    protocol: Protocol = PAPER,
    *,
    category: str | None = None,
    on: Path | None = None,
    finer: Reconstruct | None = None,
    jobs: int = 1,
    on_object: Callable[[str], None] = lambda _: None,
    measures: type[Tally] = Tally,
) -> Evaluation:
    """Evaluate on the test objects of a data set, or on all objects of another one.

    What needs joints or motions is measured where the reconstructions have them. Means that are
    called `matched_*` are those of pose estimators, see `matched`. There are a `reconstruction_iou`
    and a `voxels_label_iou` where the data set has a grid of the reconstructions' resolution.

    Args:
        reconstruct: what is measured.
        category: what the data sets must be of.
        on: the other data set; whatever the split, its objects are tested. The training objects
            of `data` vote for labels in either case.
        finer: the same on a finer grid, for a `finer_label_iou` by the same votes, `finer_f_score`
            and `finer_chamfer_l1`. What is finer than its grid is not made again.
        jobs: objects at a time, each in a thread, in which `reconstruct` and `finer` are called;
            what is measured stays the same.
        on_object: called with the name of each object, those that vote first.
        measures: what is measured, by which rules.

    Raises:
        UnfitData: a data set has no training or no test object, or is of another category.
    """
    check_splits(data, category, on)
    votes = label_votes(data, reconstruct, protocol, jobs, on_object)

    def measured(instances: Iterable[Instance]) -> Tally:
        tally = measures(protocol, *votes, objects=1)
        first: Canonical = None
        for instance in instances:
            predicted = reconstruct(instance)
            tally.at(instance)
            tally.measure(instance, predicted, first)
            first = first or (instance, predicted)
            if finer and predicted.whole is not None:
                fine = predicted if predicted.finer is not None else finer(instance)
                tally.add_label_iou(*nearest_parts(instance, fine, protocol), "finer_")
                tally.add_surface(
                    instance, fine.whole if fine.finer is None else fine.finer, "finer_"
                )
        return tally

    tally = measures(protocol, *votes)
    for instances, of_object in _side_by_side(measured, tested(data, on, protocol.states), jobs):
        tally.take(of_object)
        on_object(instances[0].object_id)
    return tally.evaluation()


def check_splits(data: Path, category: str | None, on: Path | None = None) -> None:
    """Raise UnfitData where the data set, or with `on` both, cannot be evaluated on, before
    anything is computed."""
    for folder, splits in ((data, ("train",) if on else ("train", "test")), (on, ())):
        if folder is None:
            continue
        manifest = Manifest.read(folder)
        if category is not None and manifest.category != category:
            raise UnfitData(f"{folder}: holds {manifest.category}, the model is of {category}")
        there = {o.key.split for o in manifest.objects}
        for split in splits:
            if split not in there:
                raise UnfitData(
                    f"{folder}: has no object in split {split!r}; make one with more objects"
                )
        if not there:
            raise UnfitData(f"{folder}: has no object")


def tested(data: Path, on: Path | None, states: int | None) -> Iterator[list[Instance]]:
    """Return the test objects of `data`, or all objects of `on`, as `objects_of` gives them."""
    return objects_of(data, "test", states) if on is None else objects_of(on, None, states)


def label_votes(
    data: Path,
    reconstruct: Reconstruct,
    protocol: Protocol,
    jobs: int,
    on_object: Callable[[str], None],
) -> tuple[Floats, Floats | None]:
    """Return (P, K) the votes of the training objects' canonical instances, summed, and those of
    all instances if the protocol asks for them; K parts of the object that has most."""

    def cast(instances: Iterable[Instance]) -> list[Floats]:
        return [_votes(instance, reconstruct(instance), protocol) for instance in instances]

    of_all = protocol.label_poses == "all"
    voters = objects_of(data, "train", protocol.states if of_all else 0)
    ballots, more = [], []
    for instances, votes in _side_by_side(cast, voters, jobs):
        ballots.append(votes[0])
        more.extend(votes[1:])
        on_object(instances[0].object_id)
    most = max(ballot.shape[1] for ballot in ballots)
    first, others = (
        sum((np.pad(b, ((0, 0), (0, most - b.shape[1]))) for b in some), np.zeros(()))
        for some in (ballots, more)
    )
    return first, first + others if of_all else None


def _votes(instance: Instance, predicted: Reconstruction, protocol: Protocol) -> Floats:
    near, true = nearest_parts(instance, predicted, protocol)
    return metrics.votes(near, true, predicted.parts, len(instance.part_motion))


def _side_by_side(
    work: Callable[[Iterable[Instance]], _T], objects: Iterable[list[Instance]], jobs: int
) -> Iterator[tuple[list[Instance], _T]]:
    """Yield each object and what `work` makes of it, in order; `jobs` at a time, no more of which
    are in memory than that needs. After an error, or Ctrl-C, no further instance is begun."""
    coming: deque[tuple[list[Instance], Future[_T]]] = deque()
    stop = Event()
    with ThreadPoolExecutor(jobs) as pool, ExitStack() as at_the_end:
        at_the_end.callback(stop.set)
        for instances in objects:
            unless_stopped = takewhile(lambda _: not stop.is_set(), instances)
            coming.append((instances, pool.submit(work, unless_stopped)))
            if len(coming) > jobs:
                some, future = coming.popleft()
                yield some, future.result()
        for some, future in coming:
            yield some, future.result()


def objects_of(data: Path, split: str | None, states: int | None) -> Iterator[list[Instance]]:
    """Yield the instances of each object of a split, or of all, the canonical one first."""
    names = sorted({o.shard for o in Manifest.read(data).objects if split in (None, o.key.split)})
    for name in names:
        with open_shard(data / name) as shard:
            index, ids = shard.read("state_index"), np.array(shard.object_ids())
            for object_id in dict.fromkeys(ids.tolist()):
                rows = np.flatnonzero(ids == object_id)
                rows = rows[np.argsort(index[rows])]
                if index[rows[0]] != 0:
                    raise UnfitData(f"{data / name}: {object_id} has no canonical instance")
                wanted = rows if states is None else rows[: 1 + states]
                yield [shard.instance(int(row)) for row in wanted]
