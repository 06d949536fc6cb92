"""How the speed of ours scales, and a picture of it."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from articugen import instance, pipeline
from articugen.recipe import Recipe
from articugen.records import ArticulatedObject, Mesh
from tests.benchmarks.cases import Model

Curve = list[tuple[float, float]]
"""(x, instances a second), x ascending."""


def curves(model: Model, *, quick: bool, say: Callable[[str], None]) -> dict[str, Curve]:
    """Instances a second of one worker against triangles, views and query points.

    `make_instance` alone: neither what is done once an object nor the writing.
    """
    levels = range(2 if quick else 4)
    counts = (25, 50) if quick else (25, 50, 100, 200)
    queries = (2**14, 2**16) if quick else (2**14, 2**16, 2**18, 2**20)
    finer = [_subdivided(model.obj, k) for k in levels]
    say("scaling: triangles, views, query points")
    return {
        "triangles": [(_faces(obj), _rate(obj, model.recipe)) for obj in finer],
        "views": [(n, _rate(model.obj, _with_views(model.recipe, n))) for n in counts],
        "query points": [(n, _rate(model.obj, _with_queries(model.recipe, n))) for n in queries],
    }


def _rate(obj: ArticulatedObject, recipe: Recipe) -> float:
    prepared = instance.prepare(obj, recipe, 0)
    seconds = []
    for state in (1, 2, 3):
        start = time.perf_counter()
        instance.make_instance(prepared, state)
        seconds.append(time.perf_counter() - start)
    return 1.0 / float(np.median(seconds))


def _subdivided(obj: ArticulatedObject, times: int) -> ArticulatedObject:
    links = []
    for link in obj.links:
        vertices, faces = np.array(link.mesh.vertices), np.array(link.mesh.faces)
        for _ in range(times if len(faces) else 0):
            vertices, faces = trimesh.remesh.subdivide(vertices, faces)[:2]
        links.append(replace(link, mesh=Mesh(vertices, faces.astype(np.int32))))
    return replace(obj, links=tuple(links))


def _faces(obj: ArticulatedObject) -> int:
    return sum(len(link.mesh.faces) for link in obj.links)


def _with_views(recipe: Recipe, count: int) -> Recipe:
    return recipe.model_copy(update={"views": recipe.views.model_copy(update={"count": count})})


def _with_queries(recipe: Recipe, count: int) -> Recipe:
    asked = {"grids": (), "uniform_points": count // 2, "near_points": count // 2}
    return recipe.model_copy(update={"sampling": recipe.sampling.model_copy(update=asked)})


def draw(measured: dict[str, Curve], path: Path) -> str | None:
    """Draw the curves as a PNG; a sentence that says why not where matplotlib is missing."""
    try:
        import matplotlib as mpl  # noqa: PLC0415 - optional
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ModuleNotFoundError:
        return "no picture: matplotlib is not installed (pip install 'articugen[bench]')"
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(11, 2.8), layout="constrained")
        axes: Any = figure.subplots(1, len(measured))
        for axis, (name, curve) in zip(np.atleast_1d(axes), measured.items(), strict=True):
            _panel(axis, name, curve)
        figure.savefig(path, dpi=150)
    return None


def _panel(axis: Any, name: str, curve: Curve) -> None:
    x, y = zip(*curve, strict=True)
    axis.plot(x, y, "o-", color="#2a6f97", linewidth=1.5, markersize=4)
    for at, rate in curve:
        axis.annotate(f"{rate:.1f}", (at, rate), (0, 5), textcoords="offset points", ha="center")
    if name == "workers":
        axis.plot(x, [y[0] * n / x[0] for n in x], ":", color="grey", label="ideal")
        axis.set_xticks(x)
        axis.legend(frameon=False, loc="lower right")
    else:
        axis.set_xscale("log", base=2)
        axis.set_xticks(x, [_short(n) for n in x])
        axis.minorticks_off()
    axis.set_ylim(0, 1.2 * max(y))
    axis.set_xlabel(name)
    axis.set_ylabel("instances / s")
    axis.grid(alpha=0.25)


def _short(number: float) -> str:
    if number >= 1_000_000:
        return f"{number / 1e6:.1f}M"
    return f"{number / 1e3:.0f}k" if number >= 10_000 else f"{number:g}"


def worker_counts() -> tuple[int, ...]:
    """1, 2, 4, ... up to the cores that this process may use; 2 at least."""
    return tuple(n for n in (1, 2, 4, 8, 16, 32, 64) if n <= max(2, pipeline.default_jobs()))
