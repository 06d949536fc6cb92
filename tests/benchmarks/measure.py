"""The measurements: methods take turns on the same meshes, so that a busy machine slows all alike.

Everything is kept as plain rows (dicts), one for each timing and each score; tables.py adds up.
"""

import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from articugen import instance, pipeline
from articugen.instance import Prepared
from articugen.records import Views
from articugen.store.shards import write_shard
from tests.benchmarks import cases, ours
from tests.benchmarks.cases import VOXEL, Bools, Case, Inside, Model, iou
from tests.benchmarks.peers import Answer, Peer

Row = dict[str, Any]
Say = Callable[[str], None]

SHARD = 24
"""Instances that are written to time their writing; a full shard has 101."""


@dataclass
class Results:
    """Rows.

    timings: method, case, category, messy, run, seconds, cpu; ours also a column for each stage.
    scores: method, case, category, messy, uniform, near (IoU), truth (what it is judged by).
    shapes: method, thickness (voxels: mean, least, most), growth (voxels).
    failures: method, case, error.
    shared: the cases that peers, too, are measured on.
    triangles: of each real case.
    """

    timings: list[Row] = field(default_factory=list)
    scores: list[Row] = field(default_factory=list)
    shapes: list[Row] = field(default_factory=list)
    failures: list[Row] = field(default_factory=list)
    shared: list[str] = field(default_factory=list)
    triangles: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Extent:
    """How much is measured.

    Attributes:
        states: random joint states an object.
        runs: on clean objects; slow peers run once, messy and real objects are measured once.
        points: of each kind, to judge by.
        slow_on: the categories whose first objects the slow peers get.
    """

    states: int
    runs: int
    points: int
    slow_on: tuple[str, ...]


def shapes(peers: Sequence[Peer], model: Model, results: Results, say: Say) -> None:
    """Thickness of zero-thickness sheets and growth of a closed solid. Warms all methods up."""
    recipes = {name: ours.at(model.recipe, size) for name, size in ours.SETTINGS.items()}
    builders: dict[str, Callable[..., Inside]] = {
        name: lambda mesh, r=r: ours.alone(mesh, r) for name, r in recipes.items()
    }
    builders |= {p.name: lambda mesh, p=p: p.build(mesh).inside for p in peers}
    reach = 8 * VOXEL
    for method, build in builders.items():
        say(f"{method}: sheets and a drum")
        sheets, feet, normals = cases.pages()
        drum, on_drum, outwards = cases.drum()
        row: Row = {"method": method, "thickness": None, "growth": None}
        try:
            thick = cases.depth_along(build(sheets), feet, normals, reach).reshape(5, -1)
            by_sheet = thick.mean(axis=1)
            row["thickness"] = [float(f(by_sheet)) for f in (np.mean, np.min, np.max)]
            held = cases.depth_along(build(drum), on_drum, outwards, reach)
            row["growth"] = float(held.mean()) - reach / VOXEL
        except Exception as error:  # a peer's fault is a result
            results.failures.append(_failure(method, "sheets and a drum", error))
        results.shapes.append(row)


def objects(
    models: Sequence[Model], peers: Sequence[Peer], extent: Extent, results: Results, say: Say,
    folder: Path,
) -> None:  # fmt: skip
    """All methods on all objects; peers, `fast` and `fine` on state 1 of each category's first."""
    shared: dict[str, Case] = {}
    states = range(1, extent.states + 1)
    firsts = {(m.ref.category, m.messy): m for m in reversed(models)}
    instance.make_instance(instance.prepare(models[0].obj, models[0].recipe, 0), 1)  # warms up
    for run in range(extent.runs):
        for model in models:
            if run > 0 and model.messy:
                continue
            say(f"run {run + 1} of {extent.runs}: {model.name}")
            first = firsts[model.ref.category, model.messy] is model
            prepared = _time_ours("ours", model, states, run, results, folder)
            if first and run == 0:
                made = shared[model.name] = cases.case(model, prepared, 1, extent.points)
                results.shared.append(made.name)
                _score_ours("ours", made, prepared, _truths(made, prepared.views), results)
            del prepared
            if first:
                _one_case(model, shared[model.name], peers, extent, run, results, say, folder)


def _one_case(
    model: Model, made: Case, peers: Sequence[Peer], extent: Extent, run: int, results: Results,
    say: Say, folder: Path,
) -> None:  # fmt: skip
    truths = None
    for method in list(ours.SETTINGS)[1:]:
        prepared = _time_ours(method, model, [made.state], run, results, folder)
        if run == 0:
            truths = truths or _truths(made, prepared.views)
            _score_ours(method, made, prepared, truths, results)
    for peer in peers:
        if peer.slow and (run > 0 or model.ref.category not in extent.slow_on):
            continue
        say(f"run {run + 1}: {peer.name} on {made.name}")
        answer = _time_peer(peer, made, run, results)
        if run == 0 and answer and truths:
            _score_peer(peer.name, made, answer, truths, results)


def real_models(
    models: Sequence[Model], peers: Sequence[Peer], extent: Extent, results: Results, say: Say,
    folder: Path,
) -> None:  # fmt: skip
    """Speed on models without a truth, and how far each peer agrees with ours; no slow peers."""
    for model in models:
        say(model.name)
        prepared = _time_ours("ours", model, range(1, extent.states + 1), 0, results, folder)
        made = cases.case(model, prepared, 1, extent.points)
        results.triangles[made.name] = len(made.mesh.faces)
        label = instance.pose(prepared, 1)[1].labels
        by_ours = {kind: label(points) > 0 for kind, points in made.points.items()}
        for peer in peers:
            answer = None if peer.slow else _time_peer(peer, made, 0, results)
            if answer:
                got = {kind: answer.inside(points) for kind, points in made.points.items()}
                results.scores.append(_score(peer.name, made, got, by_ours, "ours"))


def _time_ours(
    method: str, model: Model, states: Iterable[int], run: int, results: Results, folder: Path
) -> Prepared:
    """Everything that `articugen generate` does for an instance. What is done once an object is
    shared out among all the instances that its recipe asks for."""
    recipe = ours.at(model.recipe, ours.SETTINGS[method])
    prepared, once, once_cpu = _timed(lambda: instance.prepare(model.obj, recipe, 0))
    made, rows = [], []
    for state in states:
        with ours.stages() as spent:
            single, seconds, cpu = _timed(lambda s=state: instance.make_instance(prepared, s))
        made.append(single)
        rows.append((state, seconds, cpu, dict(spent)))
    job = pipeline.Job(
        model.ref.source, model.ref.category, recipe, 0, folder, 1
    )  # for the attributes of a shard
    attributes = pipeline._attributes(job, model.ref)
    shard = (made * SHARD)[:SHARD]  # a file costs something, however few it holds
    _, write, write_cpu = _timed(lambda: write_shard(folder / "bench.h5", shard, attributes))
    count = len(prepared.states)
    for state, seconds, cpu, spent in rows:
        shares = spent | {
            "other": seconds - sum(spent.values()),
            "write": write / SHARD,
            "prepare": once / count,
        }
        total_cpu = cpu + once_cpu / count + write_cpu / SHARD
        results.timings.append(
            _about(method, model, state)
            | {"run": run, "seconds": sum(shares.values()), "cpu": total_cpu, "once": once}
            | shares
        )
    return prepared


def _time_peer(peer: Peer, made: Case, run: int, results: Results) -> Answer | None:
    """From the mesh to the labels of the points that an instance has, and nothing else."""

    def work() -> Answer:
        answer = peer.build(made.mesh)
        answer.inside(made.asked)
        return answer

    about = _about(peer.name, made.model, made.state)
    try:
        answer, seconds, cpu = _timed(work)
    except Exception as error:  # a peer's fault is a result
        results.failures.append(_failure(peer.name, made.name, error))
        return None
    results.timings.append(about | {"run": run, "seconds": seconds, "cpu": cpu})
    return answer


@dataclass(frozen=True)
class _Truths:
    """By kind of points: the exact solids, and those with what our views do not see."""

    solid: dict[str, Bools]
    unseen: dict[str, Bools]


def _truths(made: Case, views: Views) -> _Truths:
    scene = made.scene
    assert scene is not None
    return _Truths(
        {kind: scene.solid(points) for kind, points in made.points.items()},
        {kind: scene.unseen(points, views) for kind, points in made.points.items()},
    )


def _score_ours(
    method: str, made: Case, prepared: Prepared, truths: _Truths, results: Results
) -> None:
    label = instance.pose(prepared, made.state)[1].labels
    got = {kind: label(points) > 0 for kind, points in made.points.items()}
    results.scores.append(_score(method, made, got, truths.unseen, "unseen is inside"))


def _score_peer(method: str, made: Case, answer: Answer, truths: _Truths, results: Results) -> None:
    """By the kinder of two truths: the solids alone, or with what is unseen (by its own views)."""
    assert made.scene is not None
    got = {kind: answer.inside(points) for kind, points in made.points.items()}
    unseen = truths.unseen
    if answer.views is not None:
        unseen = {k: made.scene.unseen(points, answer.views) for k, points in made.points.items()}
    both = [
        _score(method, made, got, truths.solid, "solids"),
        _score(method, made, got, unseen, "unseen is inside"),
    ]
    results.scores.append(max(both, key=lambda row: row["uniform"] + row["near"]))


def _score(
    method: str, made: Case, got: dict[str, Bools], truth: dict[str, Bools], name: str
) -> Row:
    agreement = {kind: iou(got[kind], truth[kind]) for kind in made.points}
    return _about(method, made.model, made.state) | agreement | {"truth": name}


def _about(method: str, model: Model, state: int) -> Row:
    return {
        "method": method,
        "case": f"{model.name} state {state}",
        "category": model.ref.category,
        "messy": model.messy,
        "real": model.real,
    }


def _failure(method: str, case: str, error: Exception) -> Row:
    text = " ".join(f"{type(error).__name__}: {error}".split())[:200]
    return {"method": method, "case": case, "error": text}


def _timed(work: Callable[[], Any]) -> tuple[Any, float, float]:
    """The result, seconds on the clock, seconds of all cores."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, time.perf_counter() - wall, time.process_time() - cpu


def median_by_case(rows: Iterable[Row], column: str = "seconds") -> dict[str, float]:
    """The median over the runs, for each case."""
    values: dict[str, list[float]] = {}
    for row in rows:
        values.setdefault(row["case"], []).append(row[column])
    return {case: statistics.median(v) for case, v in values.items()}
