"""What a mesh costs: ours as a whole instance, a peer from the posed mesh to labels."""

import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from articugen.core.records import Floats, dequantize
from articugen.core.schema import Instance
from articugen.instance import make, preparing
from articugen.instance.preparing import Prepared
from articugen.pipeline import making, plan
from articugen.pipeline.job import Job
from articugen.store.writer import write_shard
from tests.benchmarks import ours, rows
from tests.benchmarks.cases import Case, Model
from tests.benchmarks.peers import Answer, Peer
from tests.benchmarks.rows import Results

SHARD = 24
"""Instances that are written to time their writing; a full shard has 101."""


def time_ours(
    model: Model, states: Iterable[int], run: int, results: Results, folder: Path
) -> Prepared:
    """Everything that `articugen generate` does for an instance. What is done once an object is
    shared out among all the instances that its recipe asks for."""
    prepared, once, once_cpu = timed(lambda: preparing.prepare(model.obj, model.recipe, 0))
    made, measured = [], []
    for state in states:
        with ours.stages() as spent:
            single, seconds, cpu = timed(lambda s=state: make.make_instance(prepared, s))
        made.append(single)
        measured.append((state, seconds, cpu, dict(spent)))
    # A file costs something, however few it holds.
    write, write_cpu = _written((made * SHARD)[:SHARD], model, folder)
    count = len(prepared.states)
    for state, seconds, cpu, spent in measured:
        shares = spent | {
            "other": seconds - sum(spent.values()),
            "write": write,
            "prepare": once / count,
        }
        results.timings.append(
            rows.about("ours", model, state)
            | {"run": run, "seconds": sum(shares.values()), "once": once}
            | {"cpu": cpu + once_cpu / count + write_cpu, "once cpu": once_cpu}
            | shares
        )
    return prepared


def time_many(
    prepared: Prepared, made: Case, labels: int, results: Results, folder: Path
) -> Floats:
    """As `time_ours`, just called for the same object, with `labels` query points and no grids.

    Returns:
        (labels, 3) the points, for peers.
    """
    recipe = ours.with_queries(prepared.recipe, labels)
    asked = replace(prepared, recipe=recipe, grids={})
    one, seconds, cpu = timed(lambda: make.make_instance(asked, made.state))
    write, write_cpu = _written([one, one], made.model, folder)
    count, last = len(prepared.states), results.timings[-1]
    results.many.append(
        rows.about("ours", made.model, made.state)
        | {"seconds": seconds + write + last["once"] / count}
        | {"cpu": cpu + write_cpu + last["once cpu"] / count}
    )
    return np.concatenate([dequantize(one.uniform_points), dequantize(one.near_points)])


def _written(instances: list[Instance], model: Model, folder: Path) -> tuple[float, float]:
    """Seconds an instance, on the clock and of all cores."""
    ref = model.ref
    job = Job(ref.source, ref.category, model.recipe, 0, folder, 1)
    key = plan._key(job, ref, "", ref.generator_by(job.recipe.text()))
    attributes = making._attributes(job, making.Task(ref, key, "bench.h5", "measured"))
    _, wall, cpu = timed(lambda: write_shard(folder / "bench.h5", instances, attributes))
    return wall / len(instances), cpu / len(instances)


def time_peer(peer: Peer, made: Case, run: int, results: Results) -> Answer | None:
    """From the mesh to the labels of the points that an instance has, and nothing else; in the
    first run also to those of `made.many`. None where the peer fails."""
    about = rows.about(peer.name, made.model, made.state)
    try:
        answer, built, built_cpu = timed(lambda: peer.build(made.mesh))
        _, seconds, cpu = timed(lambda: answer.inside(made.asked))
        results.timings.append(
            about | {"run": run, "seconds": built + seconds, "cpu": built_cpu + cpu}
        )
        if run == 0 and len(made.many):
            _, seconds, cpu = timed(lambda: answer.inside(made.many))
            results.many.append(about | {"seconds": built + seconds, "cpu": built_cpu + cpu})
    except Exception as error:  # a peer's fault is a result
        results.failures.append(rows.failure(peer.name, made.name, error))
        return None
    return answer


def timed(work: Callable[[], Any]) -> tuple[Any, float, float]:
    """The result, seconds on the clock, seconds of all cores."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, time.perf_counter() - wall, time.process_time() - cpu
