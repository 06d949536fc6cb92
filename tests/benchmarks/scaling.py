"""How the speed of ours scales, and a picture of it."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from articugen.core import processes
from articugen.core.recipe import Recipe
from articugen.core.records import ArticulatedObject, Mesh
from articugen.instance import make, preparing
from tests.benchmarks import ours
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
        "query points": [
            (n, _rate(model.obj, ours.with_queries(model.recipe, n))) for n in queries
        ],
    }


def _rate(obj: ArticulatedObject, recipe: Recipe) -> float:
    prepared = preparing.prepare(obj, recipe, 0)
    seconds = []
    for state in (1, 2, 3):
        start = time.perf_counter()
        make.make_instance(prepared, state)
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


def draw(measured: dict[str, Curve], path: Path) -> str | None:
    """Draw the curves as a PNG; a sentence that says why not where matplotlib is missing."""

    def curves_on(axes: Any) -> None:
        for axis, (name, curve) in zip(axes, measured.items(), strict=True):
            (_bars if name == "workers" else _curve)(axis, name, curve)
        axes[0].set_ylabel("instances / s")

    return drawn(path, (11, 2.9), len(measured), curves_on)


def drawn(
    path: Path, inches: tuple[float, float], panels: int, on: Callable[[Any], None]
) -> str | None:
    """A PNG of a row of panels that `on` draws; why there is none where matplotlib is missing."""
    try:
        import matplotlib as mpl  # noqa: PLC0415 - optional
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ModuleNotFoundError:
        return "no picture: matplotlib is not installed (pip install 'articugen[bench]')"
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=inches, layout="constrained")
        on(np.atleast_1d(figure.subplots(1, panels)))
        figure.savefig(path, dpi=150)
    return None


BLUE, GREY = "#2a6f97", "#9aa5ac"


def _bars(axis: Any, name: str, curve: Curve) -> None:
    """End to end, with a mark where each worker would add as much as the first."""
    x, y = zip(*curve, strict=True)
    at = np.arange(len(x))
    axis.bar(at, y, 0.55, color=BLUE)
    ideal = [y[0] * n / x[0] for n in x]
    axis.hlines(ideal, at - 0.34, at + 0.34, color=GREY, linestyle="--", label="ideal")
    for k, rate in enumerate(y):
        axis.annotate(f"{rate:.1f}", (k, rate), (0, -12), textcoords="offset points", ha="center",
                      color="white")  # fmt: skip
    axis.set_xticks(at, [f"{n:g}" for n in x])
    axis.set_ylim(0, 1.15 * max(*ideal, *y))
    axis.set_xlabel(f"{name}, end to end")
    axis.legend(frameon=False, loc="upper left")


def _curve(axis: Any, name: str, curve: Curve) -> None:
    """One worker, `make_instance` alone, doubly logarithmic; dashed: time linear in x."""
    x, y = (np.array(values, float) for values in zip(*curve, strict=True))
    axis.plot(x, y[0] * x[0] / x, "--", color=GREY, linewidth=1.2, label="time linear")
    axis.plot(x, y, "o-", color=BLUE, linewidth=1.6, markersize=4.5)
    for at, rate in curve:
        axis.annotate(f"{rate:.3g}", (at, rate), (0, 6), textcoords="offset points", ha="center")
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xticks(x, [_short(n) for n in x])
    low, high = 0.6 * min(y), 1.8 * max(y)
    ticks = [t for t in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200) if low <= t <= high]
    axis.set_yticks(ticks, [f"{t:g}" for t in ticks])
    axis.minorticks_off()
    axis.set_ylim(low, high)
    axis.margins(x=0.12)
    axis.set_xlabel(f"{name}, one worker")
    axis.grid(alpha=0.25)
    axis.legend(frameon=False, loc="lower left")


def _short(number: float) -> str:
    if number >= 1_000_000:
        return f"{number / 1e6:.1f}M"
    return f"{number / 1e3:.0f}k" if number >= 1_000 else f"{number:g}"


def worker_counts() -> tuple[int, ...]:
    """1, 2, 4, ... up to the cores that this process may use; 2 at least."""
    return tuple(n for n in (1, 2, 4, 8, 16, 32, 64) if n <= max(2, processes.default_jobs()))
