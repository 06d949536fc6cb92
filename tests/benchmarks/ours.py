"""Ours: the stages of `instance.make_instance`, `articugen generate` as a process."""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from articugen.core.recipe import Recipe
from articugen.core.records import LabelledMesh
from articugen.instance import make, preparing
from tests.benchmarks.cases import Inside

STAGES = {
    "pose": "pose+render",
    "_labelled_grid": "occupancy",
    "_query_fields": "occupancy",
    "_surface": "surface",
    "_partial_fields": "partial",
}
"""The functions of articugen.instance.make that are timed, and as what. None calls another."""


def with_queries(recipe: Recipe, count: int) -> Recipe:
    """Half uniform, half near the surface, and no grids."""
    asked = {"grids": (), "uniform_points": count // 2, "near_points": count // 2}
    return recipe.model_copy(update={"sampling": recipe.sampling.model_copy(update=asked)})


@contextmanager
def stages() -> Iterator[dict[str, float]]:
    """Seconds spent in each stage while the context lasts."""
    spent = dict.fromkeys(STAGES.values(), 0.0)
    original = {name: getattr(make, name) for name in STAGES}

    def timed(function, stage: str):
        def call(*args, **kwargs):
            start = time.perf_counter()
            result = function(*args, **kwargs)
            spent[stage] += time.perf_counter() - start
            return result

        return call

    for name, stage in STAGES.items():
        setattr(make, name, timed(original[name], stage))
    try:
        yield spent
    finally:
        for name, function in original.items():
            setattr(make, name, function)


def alone(mesh: LabelledMesh, recipe: Recipe) -> Inside:
    """Our field of a mesh by itself, sheets thickened."""
    field = preparing.own_solid(preparing.solid_part(mesh, recipe), recipe).field
    return lambda points: ~field.is_free(points)


def end_to_end(folder: Path, category: str, *, objects: int, states: int, jobs: int) -> float:
    """Seconds of `articugen generate`, from the command line to the finished data set."""
    out = folder / f"out-{category}-{objects}x{states}-{jobs}"
    command = [
        sys.executable, "-m", "articugen", "generate", "--category", category,
        "--objects", str(objects), "--states", str(states),
        "--jobs", str(jobs), "--out", str(out), "--replace",
    ]  # fmt: skip
    start = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - start
    if done.returncode != 0:
        raise RuntimeError(f"articugen generate failed: {done.stderr or done.stdout}")
    return seconds
