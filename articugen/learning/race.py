"""A race of seeds: all start, the worse half drops out at each halving, the best that is left wins.

Who goes on is decided by the loss on the objects of the training split that are held out, never by
test objects (successive halving: Jamieson and Talwalkar 2016). Each seed is an ordinary run, which
stops and resumes exactly, so that the outcome depends neither on interruptions nor on how many
processes take part.
"""

import json
import math
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from articugen.core.errors import InvalidCheckpoint, TrainingDiverged
from articugen.core.files import write_atomically
from articugen.core.memory import given_back
from articugen.core.processes import Crew, report
from articugen.learning.data.split import Folders
from articugen.learning.loop import (
    SEEDS,
    SHARDS,
    Progress,
    Tell,
    check_data,
    look,
    new_run,
    shared_folder,
    train,
)
from articugen.learning.recipe import TrainRecipe
from articugen.learning.run_folder import BEST, LATEST, METRICS, RunFolder, read_checkpoint

RACE = "race.json"


@dataclass(frozen=True)
class Heat:
    """One seed's way to an iteration; validation is what it reached there, None if it diverged."""

    recipe: TrainRecipe
    category: str
    data: Folders
    folder: Path
    seed: int
    stop: int
    device: str

    def run(self) -> dict[str, float] | None:
        """Train from where the seed stands to `stop`; returns the validation there."""
        if not self.is_done():
            path, started = self.folder / str(self.seed), self.is_started()
            try:
                train(
                    self.recipe,
                    category=self.category,
                    data=self.data,
                    runs=self.folder,
                    seed=self.seed,
                    name=str(self.seed),
                    resume=path if started else None,
                    stop_after=self.stop,
                    device=self.device,
                    on_progress=lambda progress: report(replace(progress, seed=self.seed)),
                )
            except TrainingDiverged:
                return None
        return self.reached()

    def is_done(self) -> bool:
        """Return whether the seed stands at `stop`, or beyond."""
        if not self.is_started():
            return False
        return read_checkpoint(self.folder / str(self.seed) / LATEST).iteration >= self.stop

    def is_started(self) -> bool:
        """Whether there is a checkpoint to go on from; without one nothing is left of the seed."""
        path = self.folder / str(self.seed)
        if not (path / LATEST).is_file():
            shutil.rmtree(path, ignore_errors=True)
        return (path / LATEST).is_file()

    def reached(self) -> dict[str, float]:
        """Return the validation at `stop`."""
        path = self.folder / str(self.seed)
        there = [r for r in RunFolder(path).metrics() if r["iteration"] == self.stop]
        found = [r["validation"] for r in there if r.get("validation")]
        if not found:
            raise InvalidCheckpoint(
                f"{path / METRICS}: lacks the validation at iteration {self.stop}; delete {path} "
                "and resume the race"
            )
        return found[0]


def race(
    recipe: TrainRecipe,
    *,
    category: str,
    data: Folders,
    runs: Path,
    seed: int = 0,
    resume: Path | None = None,
    stop_after: int | None = None,
    device: str = "cpu",
    jobs: int = 1,
    on_progress: Tell = lambda _: None,
) -> RunFolder:
    """Train `recipe.seeds.count` seeds from `seed` on, halving them, and keep the best.

    Args:
        recipe, category, data, runs, device: as `train` takes them.
        resume: the folder of a race to go on with instead of a new one.
        stop_after: stop when who goes on after this iteration is decided, as an interruption would.
        jobs: seeds that are trained at a time, each in a process and on one thread of its own. The
            outcome is the same whatever it is.
        on_progress: called after each iteration of each seed.

    Returns:
        The race's folder, with the winner's checkpoints and metrics once it is over.

    Raises:
        TrainingDiverged: no seed was left.
        ArticugenError: another process races there.
        Others as `train`.
    """
    begin = look(recipe, category, data)
    run = _run_to_race_in(recipe, category, data, runs, seed, resume)
    total = recipe.schedule.iterations
    heat = partial(Heat, recipe, category, data, run.path / SEEDS, device=device)
    with run.locked():
        with given_back(SHARDS):
            begin(shared_folder(run), lambda said: on_progress(Progress(0, total, said=said)))
        del begin  # it holds all instances
        with _crew(jobs, on_progress) as crew:
            racing = list(range(seed, seed + recipe.seeds.count))
            rounds: list[dict[str, Any]] = []
            for stop in (*recipe.seeds.halve_at, total):
                if stop_after is not None and stop > stop_after:
                    return run
                reached = crew.in_order([heat(seed=s, stop=stop) for s in racing])
                score = dict(zip(racing, reached, strict=True))
                racing = best_half(score, last=stop == total)
                reached_by = {str(s): found for s, found in score.items()}
                rounds.append({"iteration": stop, "validation": reached_by, "go_on": racing})
                _note(run, rounds)
                if not racing:
                    raise TrainingDiverged(
                        f"all seeds diverged before iteration {stop}; lower schedule.learning_rate"
                    )
        for name in (LATEST, BEST, METRICS):
            own = run.path / SEEDS / str(racing[0]) / name
            write_atomically(run.path / name, own.read_bytes())
        _note(run, rounds, winner=racing[0])
    return run


def _run_to_race_in(
    recipe: TrainRecipe, category: str, data: Folders, runs: Path, seed: int, resume: Path | None
) -> RunFolder:
    """Return a new run, or the one to go on with, as `race` takes them."""
    if resume is None:
        return new_run(recipe, category, data, runs, seed)
    run = RunFolder(resume)
    if run.recipe().sha256() != recipe.sha256():
        raise InvalidCheckpoint(f"{resume}: was started with another recipe; start a new run")
    check_data(run, data)
    return run


def best_half(score: dict[int, dict[str, float] | None], *, last: bool) -> list[int]:
    """The seeds that go on, best first: half of them, rounded up, or the best one at the `last`.

    The first number of a score is the loss. Those that diverged (None) never go on; of equals the
    lower seed is taken.
    """

    def loss(seed: int) -> float:
        found = next(iter((score[seed] or {}).values()), math.inf)
        return math.inf if math.isnan(found) else found

    kept = 1 if last else (len(score) + 1) // 2
    return [s for s in sorted(score, key=lambda s: (loss(s), s)) if score[s] is not None][:kept]


def _note(run: RunFolder, rounds: list[dict[str, Any]], **more: Any) -> None:
    scores = [score for each in rounds for score in each["validation"].values() if score]
    by = f"validation {next(iter(scores[0]))}" if scores else "validation"
    record = {"chosen_by": by, "rounds": rounds, **more}
    write_atomically(run.path / RACE, (json.dumps(record, indent=1) + "\n").encode())


@contextmanager
def _crew(jobs: int, tell: Tell) -> Iterator[Crew[Heat, dict[str, float] | None]]:
    """Who runs the heats: this process one after the other, or `jobs` workers."""
    threads = torch.get_num_threads()
    _use_one_thread()
    try:
        with Crew(
            Heat.run,
            workers=0 if jobs == 1 else jobs,
            ready=_use_one_thread,
            on_report=tell,
            name=lambda heat: f"seed {heat.seed}",
        ) as crew:
            yield crew
    finally:
        torch.set_num_threads(threads)


def _use_one_thread() -> None:
    """Sums of floats depend on how many threads share them."""
    torch.set_num_threads(1)
