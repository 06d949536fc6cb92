"""How fast recipes learn on a device: alone, and many seeds at once; how much memory that takes."""

import resource
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from articugen.core.errors import ArticugenError
from articugen.learning.loop import batch_rows, draw, split_for
from articugen.learning.method import find_method
from articugen.learning.recipe import TrainRecipe

WARM_UP = 3
"""Iterations that count for nothing."""


@dataclass(frozen=True)
class Pace:
    """How fast some seeds of a recipe learn.

    Attributes:
        at_once: whether they take their steps together; else one after the other.
        iterations_per_second: of each of them; 0 where it fails.
        peak_bytes: of the device's memory; on a CPU the most that this process ever had.
        begin_seconds, validate_seconds: to load data and make the learners; to validate one of
            them once.
        failed: why there is no pace, or nothing.
    """

    recipe: str
    seeds: int
    at_once: bool = False
    iterations_per_second: float = 0.0
    peak_bytes: int = 0
    begin_seconds: float = 0.0
    validate_seconds: float = 0.0
    failed: str = ""


def pace(
    recipe: TrainRecipe,
    *,
    category: str,
    data: Path,
    beside: Path,
    device: str,
    seeds: int,
    seconds: float,
) -> Pace:
    """Let some seeds learn on a data set for about so many seconds.

    What a recipe asks and the data or the device do not have is the pace's `failed`.

    Args:
        beside: a folder for what learners keep of the data, see `Learner.begin`.
    """
    where = torch.device(device)
    try:
        return _measured(recipe, category, data, beside, where, seeds, seconds)
    except (ArticugenError, torch.OutOfMemoryError) as error:
        told = "out of memory" if isinstance(error, torch.OutOfMemoryError) else str(error)
        return Pace(recipe.name, seeds, failed=told)


def _measured(
    recipe: TrainRecipe,
    category: str,
    data: Path,
    beside: Path,
    where: torch.device,
    seeds: int,
    seconds: float,
) -> Pace:
    method, plan = find_method(recipe.method), recipe.schedule
    began = time.perf_counter()
    learners = [
        method.start(recipe, seed=draw(s, recipe.method, "weights"), device=where)
        for s in range(seeds)
    ]
    training, held_out = split_for(learners[0], data, category, where)
    team = method.team(learners) if seeds > 1 else None
    (team or learners[0]).begin(training, beside)
    begin_seconds = time.perf_counter() - began
    wait = _forget_peak(where)
    chances = [torch.Generator(where) for _ in (learners if team else learners[:1])]
    resolution = plan.stages[0].resolution

    def iterate(iteration: int) -> None:
        rows = []
        for seed, chance in enumerate(chances):
            chance.manual_seed(draw(seed, recipe.method, "batch", iteration))
            rows += batch_rows(iteration, plan.batch, len(training), seed, recipe.method)
        if team:
            batch = training.batch(rows, learners[0].inputs, resolution, chances)
            team.learn(batch, iteration=iteration)
        else:
            batch = training.batch(rows, learners[0].inputs, resolution, chances[0])
            learners[0].learn(batch, chances[0], iteration=iteration)

    for iteration in range(WARM_UP):
        iterate(iteration)
    wait()
    began, done = time.perf_counter(), 0
    while time.perf_counter() - began < seconds or not done:
        iterate(WARM_UP + done)
        done += 1
        if done % 10 == 0:  # else what is only asked for yet would count
            wait()
    wait()
    rate = done / (time.perf_counter() - began)
    began = time.perf_counter()
    if len(held_out):
        learners[0].validate(held_out)
    return Pace(
        recipe.name,
        seeds,
        at_once=team is not None,
        iterations_per_second=rate if team else rate / seeds,
        peak_bytes=_peak(where),
        begin_seconds=begin_seconds,
        validate_seconds=time.perf_counter() - began,
    )


def _forget_peak(where: torch.device) -> Callable[[], None]:
    """Count a GPU's memory anew; gives what waits for the device."""
    if where.type != "cuda":
        return lambda: None
    torch.cuda.reset_peak_memory_stats(where)
    return lambda: torch.cuda.synchronize(where)


def _peak(where: torch.device) -> int:
    if where.type == "cuda":
        return torch.cuda.max_memory_allocated(where)
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def pace_table(paces: list[Pace]) -> str:
    """Markdown, a row each."""
    lines = [
        "| recipe | seeds | iterations/s | seeds x iterations/s | peak | validation of one |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for p in paces:
        start = f"| {p.recipe} | {p.seeds}{' at once' if p.at_once else ''} |"
        if p.failed:
            lines.append(f"{start} failed: {p.failed} | | | |")
        else:
            each, whole = p.iterations_per_second, p.seeds * p.iterations_per_second
            lines.append(
                f"{start} {each:.3g} | {whole:.4g} | {p.peak_bytes / 2**30:.2f} GiB "
                f"| {p.validate_seconds:.2g} s |"
            )
    return "\n".join(lines) + "\n"
