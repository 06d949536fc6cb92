"""Training, in one readable loop, whatever learns.

An iteration's random numbers depend on the seed and its number alone, so a run that was stopped and
resumed draws the same curve as one that was not.
"""

import hashlib
import math
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from articugen.core.errors import InvalidCheckpoint, UnfitData
from articugen.core.memory import given_back
from articugen.core.seeding import generator as seeded
from articugen.learning.data.split import Folders, PackedSplit, folders_of, load_split
from articugen.learning.data.windows import OBJECTS, Endless, Windows
from articugen.learning.method import Learner, find_method
from articugen.learning.recipe import TrainRecipe
from articugen.learning.run_folder import BEST, LATEST, META, Checkpoint, RunFolder, read_checkpoint
from articugen.store.manifest import Manifest


@dataclass(frozen=True)
class Progress:
    """Report of an iteration; `terms` and `validation` only where they were computed."""

    iteration: int
    iterations: int
    terms: dict[str, float] | None = None
    validation: dict[str, float] | None = None
    who: str = ""
    """Which of several trainings, if there are more: a seed that races, a recipe."""
    said: str = ""
    """What is done before the first iteration, where that takes time."""


SHARDS = 1 << 20
"""Bytes: what is as large as fields of a shard goes back to the system while data are made ready,
which takes as much again for a while."""

SEEDS = "seeds"
"""The folder of a race's own runs, in that of the race."""

Notify = Callable[[Progress], None]
Log = Callable[[dict[str, Any]], None]


@dataclass(frozen=True)
class Training:
    """A run to be: what is trained, on what, and where it is kept.

    Attributes:
        recipe: everything that decides the run, besides the data and the seed.
        data: the data set's folder, those of several that are learned from together, or a stream.
        runs: where a new, numbered run folder is made.
        seed: of the weights, the batches and everything drawn.
        resume: the folder of a run to resume instead.
        device: cpu, cuda or cuda:1.
        name: of the new run's folder, instead of a number.
        window: how many objects of a stream are learned from at a time.
    """

    recipe: TrainRecipe
    category: str
    data: Folders | Endless
    runs: Path
    seed: int = 0
    resume: Path | None = None
    device: str = "cpu"
    name: str | None = None
    window: int = OBJECTS

    def named(self, name: str) -> "Training":
        """Return the training of the run `name`, which resumes if it has a checkpoint; else what is
        left of it is removed, since there is nothing to resume."""
        path = self.runs / name
        resume = path if (path / LATEST).is_file() else None
        if not resume:
            shutil.rmtree(path, ignore_errors=True)
        return replace(self, name=name, resume=resume)

    @property
    def beside(self) -> Path:
        """The folder of all runs of a category; the runs of a race lie two folders deeper in it."""
        above = self.resume.parent if self.resume else self.runs
        return above.parent.parent if above.name == SEEDS else above

    @property
    def windows(self) -> Windows | None:
        """Windows of a stream; None of a stored set."""
        if not isinstance(self.data, Endless):
            return None
        start = partial(find_method(self.recipe.method).start, self.recipe, seed=0, device=META)
        return Windows(
            self.data, self.recipe, start, self._grids(start()), self.beside, self.window
        )

    def _grids(self, learner: Learner) -> frozenset[int]:
        """Return the resolutions of the grids that are read."""
        spec = learner.inputs
        stages = {stage.resolution for stage in self.recipe.schedule.stages if spec.grid_points}
        if small := [r for r in stages if r**3 < spec.grid_points]:
            raise UnfitData(f"data.grid_points: lower it, a stage's grid has {small[0]}^3 cells")
        return frozenset({*stages, *spec.grids})

    def instances(
        self, learner: Learner, iteration: int, notify: Callable[[str], None]
    ) -> tuple[Iterator[PackedSplit], PackedSplit]:
        """Return the training instances of an iteration, then of a stream those that follow, and
        the instances that are held out."""
        if windows := self.windows:
            return windows.since(iteration, notify), windows.held_out()
        training, held_out = self.split(learner)
        return iter([training].pop, None), held_out  # which nobody but the taker holds on to

    def split(self, learner: Learner) -> tuple[PackedSplit, PackedSplit]:
        """Return the training instances, and those of the objects that are held out."""
        assert not isinstance(self.data, Endless)
        grids = self._grids(learner)
        with given_back(SHARDS):
            everything = load_split(
                self.data, "train", learner.inputs, grids, category=self.category
            )
            count = self.recipe.data.validation_objects
            kept, held_out = split_objects(everything.object_id, count)
            return everything.of(kept), everything.of(held_out)

    def new_run(self) -> RunFolder:
        """Return a new run's folder, which says what it is trained on."""
        first, *others = self._described()
        data = first | ({"also": others} if others else {})
        about = {"category": self.category, "seed": self.seed, "data": data}
        return RunFolder.new(self.runs, self.name, self.recipe, **about)

    def resumed(self, path: Path) -> tuple[RunFolder, Checkpoint | None]:
        """Return a run's folder, and where it stands if it has a checkpoint yet.

        Raises:
            InvalidCheckpoint: the run is not one of this training, or of other data.
            ArticugenError: another process trains there.
        """
        run, latest = RunFolder.existing(path), path / LATEST
        is_race = (path / SEEDS).is_dir()  # which stands where its seeds do
        point = read_checkpoint(latest) if latest.is_file() and not is_race else None
        about, described = run.about(), self._described()
        started = [(about["recipe_sha256"], about["category"], about["seed"])]
        if point:
            started.append((point.recipe.sha256(), point.category, point.seed))
        if set(started) != {(self.recipe.sha256(), self.category, self.seed)}:
            raise InvalidCheckpoint(
                f"{path}: was started with another recipe, category or seed; start a new run"
            )
        digests = [p["content_sha256"] for p in (about["data"], *about["data"]["also"])]
        if digests != [part["content_sha256"] for part in described]:
            folders = ", ".join(part["folder"] for part in described)
            raise InvalidCheckpoint(
                f"{path}: was started on other data than {folders}; start a new run"
            )
        return run, point

    def _described(self) -> list[dict[str, str]]:
        """Return what run.json says of each data set, or of a stream."""
        if isinstance(self.data, Endless):
            text = f"{self.data}, {self.window} objects at a time"
            sha256 = hashlib.sha256(text.encode()).hexdigest()
            return [{"folder": text, "content_sha256": sha256}]
        return [
            {"folder": str(folder), "content_sha256": Manifest.read(folder).content_sha256}
            for folder in folders_of(self.data)
        ]

    def course(self, learner: Learner, notify: Callable[[str], None]) -> "Course":
        """Return the course of a new run, or of one to resume."""
        run, point = self.resumed(self.resume) if self.resume else (None, None)
        iteration = point.iteration if point else 0
        windows, held_out = self.instances(learner, iteration, notify)
        held_out, run = held_out.to(torch.device(self.device)), run or self.new_run()
        course = Course(self, learner, windows, held_out, run)
        if self.windows:
            course.stay = self.windows.stay
        if point:
            learner.load(point.state)
            course.iteration, course.best = point.iteration, point.best
        return course


@dataclass
class Course:
    """A learner, what it learns from and where it is kept.

    Attributes:
        windows: the training instances that come next.
        stay: iterations for which instances are learned from.
        iteration, best: how many iterations are done; the lowest validation loss so far.
        begun: the clock's seconds where the first iteration began, had nothing interrupted the run.
    """

    what: Training
    learner: Learner
    windows: Iterator[PackedSplit]
    held_out: PackedSplit
    run: RunFolder
    stay: int = sys.maxsize
    iteration: int = 0
    best: float = math.inf
    begun: float = 0.0

    def clock(self) -> float:
        """Return seconds of this process's CPU time, or of the clock where a GPU learns."""
        return clock_of(self.held_out.surface.device.type)()

    def renewed(self, notify: Callable[[str], None]) -> PackedSplit:
        """Return the training instances that come next, for which the learner is prepared."""
        with given_back(SHARDS):
            training = next(self.windows).to(self.held_out.surface.device)
            self.learner.begin(training, self.what.beside, notify)
            return training.for_batches(self.learner.inputs)

    def keep(self, name: str) -> None:
        """Write a checkpoint of where it stands."""
        about = self.what.category, self.what.seed, self.iteration, self.best
        self.run.keep(Checkpoint(self.learner.settings, *about, self.learner.state()), name)

    def note(
        self, terms: Mapping[str, Tensor], log: Log, *, stops: bool
    ) -> tuple[dict[str, float] | None, dict[str, float] | None]:
        """Note that an iteration is done: what is due is logged, validated, kept.

        Returns:
            The terms as numbers and what the objects held out say, where they were due.
        """
        plan, done = self.learner.settings.schedule, self.iteration
        last = done == plan.iterations
        logs = last or done % plan.log_every == 0
        validates = len(self.held_out) > 0 and (last or done % plan.validate_every == 0)
        saves = last or stops or done % plan.save_every == 0
        if logs or validates or saves:
            self.learner.check()
        values = checked = None
        if logs:  # read from the device at once
            numbers = torch.stack([value.detach() for value in terms.values()]).tolist()
            values = dict(zip(terms, numbers, strict=True))
            about = {"terms": values, "learning_rate": plan.rate_at(done - 1)}
            seconds = round(self.clock() - self.begun, 2)
            log({"iteration": done, "stage": plan.index_at(done - 1), **about, "seconds": seconds})
        if validates:
            checked = self.learner.validate(self.held_out)
            log({"iteration": done, "validation": checked})
            if (loss := next(iter(checked.values()))) < self.best:
                self.best, saves = loss, True
                self.keep(BEST)
        if last and self.learner.unjudged and (self.run.path / BEST).is_file():
            best, now = read_checkpoint(self.run.path / BEST), self.learner.state()
            state = best.state | {name: now[name] for name in self.learner.unjudged}
            self.run.keep(replace(best, state=state), BEST)
        if saves:
            self.keep(LATEST)
        return values, checked


def train(
    what: Training, *, stop_after: int | None = None, on_progress: Notify = lambda _: None
) -> RunFolder:
    """Train a model of one category.

    Args:
        stop_after: stop at this iteration, as an interruption would.
        on_progress: called after each iteration.

    Raises:
        UnfitData: the data cannot be trained on.
        InvalidCheckpoint: the run cannot be resumed with this recipe.
        TrainingDiverged: a term is no longer a finite number; the message says which.
    """
    recipe, device = what.recipe, torch.device(what.device)
    seed = draw(what.seed, recipe.method, "weights")
    learner = find_method(recipe.method).start(recipe, seed=seed, device=device)
    plan, method = recipe.schedule, recipe.method

    def notify(said: str) -> None:
        on_progress(Progress(course.iteration, plan.iterations, said=said))

    course = what.course(learner, notify)
    begin, end = course.iteration, min(plan.iterations, stop_after or plan.iterations)
    training = course.renewed(notify)
    with course.run.metrics_from(course.iteration) as log:
        course.begun = course.clock() - course.run.seconds()
        for iteration in range(begin, end):
            if iteration > begin and iteration % course.stay == 0:
                training = course.renewed(notify)
            rng = torch.Generator(training.surface.device)
            rng.manual_seed(draw(what.seed, method, "batch", iteration))
            resolution = plan.stages[plan.index_at(iteration)].resolution
            rows = batch_rows(iteration, plan.batch, len(training), what.seed, method)
            batch = training.batch(rows, learner.inputs, resolution, rng)
            terms = learner.learn(batch, rng, iteration=iteration)

            course.iteration = iteration + 1
            noted = course.note(terms, log, stops=course.iteration == stop_after)
            on_progress(Progress(course.iteration, plan.iterations, *noted))
    if not course.iteration:  # of a schedule without any
        course.keep(LATEST)
    return course.run


def clock_of(device: str) -> Callable[[], float]:
    """Return what counts training's seconds: of the CPU, ended workers' too, or a GPU's clock."""
    if device == "cpu":
        return lambda: time.process_time() + sum(os.times()[2:4])  # finer than all four of these
    return time.perf_counter


def split_objects(object_ids: Iterable[str], held_out: int) -> tuple[list[str], list[str]]:
    """Return (for training, held out): the same whatever the seed; at most a quarter is held out.

    Where there are two objects, one is; a single one is trained on.
    """
    objects = sorted(set(map(str, object_ids)))
    count = min(held_out, max(len(objects) // 4, 1), len(objects) - 1)
    chosen = seeded(0, "validation").permutation(len(objects))[:count]
    out = {objects[i] for i in chosen}
    return [o for o in objects if o not in out], sorted(out)


def draw(seed: int, *path: str | int) -> int:
    """Return a number for torch's generators, from the seed and what it is for."""
    return int(seeded(seed, *path).integers(2**63))


def batch_rows(iteration: int, batch: int, count: int, seed: int, method: str) -> list[int]:
    """Return the instances of a batch: epochs one after the other, each in an order of its own."""
    rows: list[int] = []
    at = iteration * batch
    while len(rows) < batch:
        epoch, offset = divmod(at + len(rows), count)
        order = _epoch(epoch, count, seed, method)
        rows += order[offset : offset + batch - len(rows)].tolist()
    return rows


@lru_cache(maxsize=256)
def _epoch(epoch: int, count: int, seed: int, method: str) -> NDArray[np.int64]:
    order = seeded(seed, method, "epoch", epoch).permutation(count)
    order.flags.writeable = False
    return order
