"""The measurements: methods take turns on the same meshes; a busy machine slows all alike."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from articugen.core.records import LabelledMesh
from articugen.instance import make, preparing
from tests.benchmarks import cases, ours, rows, scores
from tests.benchmarks.cases import VOXEL, Case, Inside, Model
from tests.benchmarks.peers import Peer
from tests.benchmarks.rows import Results, Row
from tests.benchmarks.timing import time_many, time_ours, time_peer

Say = Callable[[str], None]
Build = Callable[[LabelledMesh], Inside]


@dataclass(frozen=True)
class Extent:
    """How much is measured.

    Attributes:
        states: random joint states an object.
        runs: on clean objects; slow peers run once, messy and real objects are measured once.
        points: of each kind, to judge by.
        labels: the larger budget of query points; Hunyuan3D-2.1 asks for 625,000 a mesh.
        slow_on: the categories whose first objects the slow peers get.
    """

    states: int
    runs: int
    points: int
    labels: int
    slow_on: tuple[str, ...]


def shapes(peers: Sequence[Peer], model: Model, results: Results, say: Say) -> None:
    """Sheets and growth. Warms all methods up."""
    builders: dict[str, Build] = {"ours": lambda mesh: ours.alone(mesh, model.recipe)}
    builders |= {p.name: lambda mesh, p=p: p.build(mesh).inside for p in peers}
    for method, build in builders.items():
        say(f"{method}: sheets, a drum")
        row: Row = {"method": method, "thickness": None, "growth": None}
        with _noted(method, "sheets", results):
            row["thickness"] = _thickness(build)
        with _noted(method, "a drum", results):
            row["growth"] = _growth(build)
        results.shapes.append(row)


@contextmanager
def _noted(method: str, case: str, results: Results) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # a peer's fault is a result
        results.failures.append(rows.failure(method, case, error))


REACH = 8 * VOXEL


def _thickness(build: Build) -> list[float]:
    """Of sheets of no thickness, in voxels: mean, least and most by the sheet."""
    sheets, feet, normals = cases.pages()
    by_sheet = cases.depth_along(build(sheets), feet, normals, REACH).reshape(5, -1).mean(axis=1)
    return [float(f(by_sheet)) for f in (np.mean, np.min, np.max)]


def _growth(build: Build) -> float:
    """Of a closed cylinder, a side, in voxels."""
    drum, on_drum, outwards = cases.drum()
    held = cases.depth_along(build(drum), on_drum, outwards, REACH)
    return float(held.mean()) - REACH / VOXEL


def objects(
    models: Sequence[Model], peers: Sequence[Peer], extent: Extent, results: Results, say: Say,
    folder: Path,
) -> None:  # fmt: skip
    """All methods on all objects; peers on state 1 of each category's first."""
    shared: dict[str, Case] = {}
    states = range(1, extent.states + 1)
    firsts = {(m.ref.category, m.messy): m for m in reversed(models)}
    make.make_instance(preparing.prepare(models[0].obj, models[0].recipe, 0), 1)  # warms up
    for run in range(extent.runs):
        for model in models:
            if run > 0 and model.messy:
                continue
            say(f"run {run + 1} of {extent.runs}: {model.name}")
            first = firsts[model.ref.category, model.messy] is model
            truth: scores.Held = {}
            prepared = time_ours(model, states, run, results, folder)
            if first and run == 0:
                made = cases.case(model, prepared, 1, extent.points)
                many = time_many(prepared, made, extent.labels, results, folder)
                made = shared[model.name] = replace(made, many=many)
                results.shared.append(made.name)
                truth = scores.truths(made, prepared.views)
                got = scores.of_ours(made, prepared)
                results.scores.append(scores.score("ours", made, got, truth))
            del prepared
            if first:
                _one_case(shared[model.name], truth, peers, extent, run, results, say)


def _one_case(
    made: Case, truth: scores.Held, peers: Sequence[Peer], extent: Extent, run: int,
    results: Results, say: Say,
) -> None:  # fmt: skip
    """Each peer in its turn; `truth` for the first run."""
    for peer in peers:
        if peer.slow and (run > 0 or made.model.ref.category not in extent.slow_on):
            continue
        say(f"run {run + 1}: {peer.name} on {made.name}")
        answer = time_peer(peer, made, run, results)
        if run == 0 and answer:
            got = scores.of_peer(made, answer.inside)
            its_truth = scores.peer_truths(made, answer, truth)
            results.scores.append(scores.score(peer.name, made, got, its_truth))


def real_models(
    models: Sequence[Model], peers: Sequence[Peer], extent: Extent, results: Results, say: Say,
    folder: Path,
) -> None:  # fmt: skip
    """Speed on models without a truth, and how far each peer agrees with ours; no slow peers."""
    for model in models:
        say(model.name)
        prepared = time_ours(model, range(1, extent.states + 1), 0, results, folder)
        made = cases.case(model, prepared, 1, extent.points)
        results.triangles[made.name] = len(made.mesh.faces)
        by_ours = scores.of_ours(made, prepared)
        for peer in peers:
            answer = None if peer.slow else time_peer(peer, made, 0, results)
            if answer:
                got = scores.of_peer(made, answer.inside)
                results.scores.append(scores.score(peer.name, made, got, by_ours))
