"""Several seeds trained in one loop, as one team: what a GPU is large enough for.

Each seed has its own run's folder, course and random numbers, and its curve is the one that it has
alone, but for rounding (see `Team`). So a race's seeds can change between the two ways.
"""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import torch
from torch import Tensor

from articugen.core.errors import InvalidRecipe
from articugen.learning.data.split import Folders
from articugen.learning.loop import (
    Course,
    Due,
    Progress,
    Tell,
    begun,
    draw,
    shared_folder,
    split_for,
)
from articugen.learning.method import Team, find_method
from articugen.learning.recipe import TrainRecipe
from articugen.learning.run_folder import LATEST


def train_together(
    recipe: TrainRecipe,
    *,
    category: str,
    data: Folders,
    runs: Path,
    seeds: Iterable[int],
    stop_after: int,
    device: str,
    on_progress: Tell = lambda _: None,
) -> set[int]:
    """Train the runs <runs>/<seed> to `stop_after`, those that there are from where they stand.

    Args:
        recipe, category, data, device: as `train` takes them.
        on_progress: called for each seed whenever something of it is logged.

    Returns:
        The seeds that diverged; their last checkpoints are of before that.

    Raises:
        As `train`, but for TrainingDiverged.
    """
    where = torch.device(device)
    method = find_method(recipe.method)
    splits, courses = None, []
    for seed in seeds:
        learner = method.start(recipe, seed=draw(seed, recipe.method, "weights"), device=where)
        splits = splits or split_for(learner, data, category, where)
        own = runs / str(seed)
        resume = own if (own / LATEST).is_file() else None
        courses.append(
            begun(learner, *splits, category, data, runs, seed, resume=resume, name=str(seed))
        )
    del splits  # the courses let go of what batches do not hold
    courses = [course for course in courses if course.iteration < stop_after]
    courses.sort(key=lambda course: course.iteration)
    diverged: set[int] = set()
    for _, some in groupby(courses, key=lambda course: course.iteration):
        level = list(some)  # one, unless checkpoints were being written when it was stopped
        team = method.team([course.learner for course in level])
        if team is None:
            raise InvalidRecipe(f"{recipe.name}: its seeds cannot learn at once")
        diverged |= follow_together(level, team, stop_after, on_progress)
    return diverged


def follow_together(
    courses: Sequence[Course], team: Team, stop_after: int, on_progress: Tell
) -> set[int]:
    """The loop for a team whose courses stand at the same iteration; the seeds that diverged."""
    first, diverged = courses[0], set[int]()
    plan, device = first.learner.settings.schedule, first.training.surface.device
    chances = [torch.Generator(device) for _ in courses]
    team.begin(first.training, shared_folder(first.run))
    training = first.training.for_batches()
    for course in courses:
        course.training = training
    with ExitStack() as stack:
        logs = [stack.enter_context(c.run.metrics_from(c.iteration, c.files)) for c in courses]
        for iteration in range(first.iteration, min(plan.iterations, stop_after)):
            for course, chance in zip(courses, chances, strict=True):
                chance.manual_seed(course.seed_at(iteration))
            rows = [row for course in courses for row in course.rows(iteration)]
            resolution = plan.stages[plan.index_at(iteration)].resolution
            batch = training.batch(rows, first.learner.inputs, resolution, chances)
            terms = team.learn(batch, iteration=iteration)

            due = Due.after(iteration, plan, stop_after, len(first.held_out))
            if not due:
                continue
            lost = team.diverged()
            diverged |= {c.seed for c, is_lost in zip(courses, lost, strict=True) if is_lost}
            if due.validates or due.saves:
                team.hand_out()
            values = _values(terms) if due.logs else [None] * len(courses)
            for course, own, log in zip(courses, values, logs, strict=True):
                if course.seed not in diverged:
                    checked = course.note(iteration, own, due, log)
                    done = Progress(iteration + 1, plan.iterations, own, checked)
                    on_progress(replace(done, seed=course.seed))
    return diverged


def _values(terms: Mapping[str, Tensor]) -> list[dict[str, float]]:
    """What each learner's terms are, read from the device at once."""
    values = torch.stack([value.detach() for value in terms.values()]).T.tolist()
    return [dict(zip(terms, own, strict=True)) for own in values]
