"""Equal time for all: a recipe whose stages are as long as a budget allows.

How long an iteration takes is measured once, on the first ones of every stage, and all stages are
made longer or shorter by the same factor. The scaled recipe is then an ordinary one: it lies in the
run's folder, decides the learning rate at each iteration, and a run that was stopped resumes to the
same result. A clock that ended training would do neither.
"""

import shutil
from dataclasses import replace

import numpy as np

from articugen.core.errors import ArticugenError
from articugen.learning import loop
from articugen.learning.loop import Notify, Progress, Training
from articugen.learning.method import find_method
from articugen.learning.recipe import Budget, TrainRecipe
from articugen.learning.run_folder import META

PROBED, SKIPPED = 12, 2
"""Iterations of each stage that are tried, and how many of them are not yet at their pace."""

CHECKS = 5
"""How often a run is validated and saved."""


def scaled_to(seconds: float, what: Training, notify: Notify = lambda _: None) -> TrainRecipe:
    """Return a training's recipe, so long that it takes a number of seconds.

    It has one seed. What learns no numbers stays as it is.

    Args:
        seconds: as `loop.clock_of` counts them, from when data are read to the last checkpoint.
        what: the training; in a folder `pace` of its `runs` the pace is measured.

    Raises:
        ArticugenError: that is too short to train anything.
        Others as `loop.train`.
    """
    recipe = what.recipe
    if find_method(recipe.method).start(recipe, seed=0, device=META).parameters == 0:
        return recipe
    start, pace, check = _pace(what, notify)
    stages = recipe.schedule.stages
    whole = sum(n * stage.iterations for n, stage in zip(pace, stages, strict=True))
    share = (seconds - start - CHECKS * check) / whole
    if share * recipe.schedule.iterations < CHECKS:
        least = start + CHECKS * (check + max(pace))
        raise ArticugenError(
            f"{seconds:.0f} s are too few: reading data, validating and {CHECKS} iterations take "
            f"{least:.0f} s; give it a larger budget"
        )
    budget = Budget(seconds=seconds, start=round(start, 2), recipe_sha256=recipe.sha256())
    return recipe.scaled(share, CHECKS, budget=budget.model_dump())


def _pace(what: Training, notify: Notify) -> tuple[float, list[float], float]:
    """Return seconds before the first iteration, of an iteration in each stage, and of one time
    that it is validated and saved."""
    folder, recipe = what.runs / "pace", what.recipe
    shutil.rmtree(folder, ignore_errors=True)
    counts = [PROBED if stage.iterations else 0 for stage in recipe.schedule.stages]
    stages = [
        stage.model_copy(update={"iterations": count})
        for stage, count in zip(recipe.schedule.stages, counts, strict=True)
    ]
    schedule = recipe.schedule.model_copy(update={"stages": tuple(stages)})
    tried = recipe.model_copy(update={"schedule": schedule}).scaled(1.0, 1)
    clock, ends = loop.clock_of(what.device), []
    begun = clock()

    def note(now: Progress) -> None:
        if not now.said:
            ends.append(clock())
        notify(replace(now, iteration=0, terms=None, validation=None, said="measuring the pace"))

    loop.train(replace(what, recipe=tried, runs=folder, resume=None, name="0"), on_progress=note)
    took = np.diff([begun, *ends])
    last = np.cumsum(counts)
    pace = [
        float(np.mean(took[end - count + SKIPPED : end - (end == last[-1])])) if count else 0.0
        for end, count in zip(last, counts, strict=True)
    ]
    shutil.rmtree(folder / "0")
    shutil.copytree(folder, what.runs, dirs_exist_ok=True)  # what the method found in the data
    shutil.rmtree(folder)
    return max(float(took[0] - pace[0]), 0.0), pace, max(float(took[-1] - pace[-1]), 0.0)
